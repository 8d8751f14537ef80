"""A step acts on imposed decisions, and its bits are those of plain numpy in every dtype."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from ball import oracles

from mdnum import ball
from mdnum.ball.step import BallDecisions
from mdnum.ball.stopping import Reason
from mdnum.errors import InputError
from mdnum.numerics.roles import RolePrecision
from mdnum.numerics.sums import Sequential

SCHEMES = {
    "explicit-euler": ball.ExplicitEuler,
    "semi-implicit-euler": ball.SemiImplicitEuler,
    "velocity-verlet": ball.BallVerlet,
}
STEPS = 400
Y0, V0 = np.array([0.3, 0.45, 0.0078125]), np.array([0.0, -0.7, 1.1])


def run_of(contact, integrator, dtype="float64", start=(Y0, V0), **options):
    world = ball.World.create(contact, integrator, policy=RolePrecision.all(dtype))
    return ball.simulate(world, world.start(*start), STEPS, **options)


def same_bits(run, index, rows, decided):
    for name, column in (("y", 0), ("v", 1)):
        expected = np.array([row[column] for row in rows]).astype(np.float64)
        np.testing.assert_array_equal(getattr(run, name)[:, index].astype(np.float64), expected)
    np.testing.assert_array_equal(run.contact[:, index], decided)


MODELS = {
    "penalty": (ball.Penalty(900.0, damping=0.5), oracles.penalty, (900, 0.5)),
    "impact": (ball.Impact(0.8), oracles.impact, (0.8, 1e-6)),
}
#: Each model by each scheme, and every format.
TELLING = {
    ("penalty", "semi-implicit-euler", "float64"), ("impact", "semi-implicit-euler", "float64"),
    ("penalty", "velocity-verlet", "bfloat16"), ("impact", "explicit-euler", "bfloat16"),
    ("penalty", "explicit-euler", "float16"), ("impact", "velocity-verlet", "float32"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("model", "scheme", "dtype"),
    [
        pytest.param(*case, marks=[] if case in TELLING else pytest.mark.nightly)
        for case in itertools.product(MODELS, SCHEMES, oracles.DTYPES)
    ],
)
def test_a_step_has_the_bits_of_numpy(model, scheme, dtype):
    (contact, oracle, numbers), kind = MODELS[model], oracles.DTYPES[dtype]
    run = run_of(contact, SCHEMES[scheme](0.01), dtype)
    for index, (y, v) in enumerate(zip(Y0, V0, strict=True)):
        with np.errstate(over="ignore", invalid="ignore"):
            given = [kind(number) for number in (y, v, 0.01, 9.81, *numbers)]
            same_bits(run, index, *oracle(scheme, *given, STEPS))
    assert run.contact.any()


@pytest.mark.parametrize(
    "dtype",
    ["float64", "bfloat16", *(pytest.param(x, marks=pytest.mark.nightly) for x in ("float32", "float16"))],
)
def test_projection_has_the_bits_and_the_iterations_of_numpy(dtype):
    rule = ball.GlobalSum(1e-3, 50, Sequential())
    run = run_of(ball.Projection(0.5, 0.5, rule), ball.SemiImplicitEuler(0.01), dtype)
    kind = oracles.DTYPES[dtype]
    balls = [[kind(value) for value in values] for values in (Y0, V0)]
    numbers = [kind(number) for number in (0.01, 9.81, 0.5, 0.5, 0.8, 1e-3)]
    rows, decided, counts = oracles.projection("semi-implicit-euler", *balls, *numbers, 50, STEPS)
    for index in range(len(Y0)):
        same_bits(run, index, [(y[index], v[index]) for y, v in rows], [row[index] for row in decided])
    np.testing.assert_array_equal(run.iterations, counts)
    assert run.iterations.max() > 3


ALL = {
    "penalty": (ball.Penalty(900.0, damping=0.5), ball.SemiImplicitEuler(0.01)),
    "smooth penalty": (ball.Penalty(900.0, eps=0.01, smooth=True), ball.BallVerlet(0.01)),
    "implicit midpoint": (ball.Penalty(900.0, damping=0.5), ball.ImplicitMidpoint(0.01)),
    "projection": (ball.Projection(0.5, 0.5, ball.GlobalSum(1e-6)), ball.ExplicitEuler(0.01)),
    "projection per ball": (ball.Projection(0.5, 0.5, ball.PerInstance(1e-6)), ball.BallVerlet(0.01)),
    "impact": (ball.Impact(0.8), ball.SemiImplicitEuler(0.01)),
    "located impact": (ball.Impact(0.8), ball.EventLocated(0.01)),
}


@pytest.mark.parametrize("name", ALL)
def test_under_its_own_decisions_a_run_is_bit_identical_and_no_ball_feels_another(name):
    free = run_of(*ALL[name])
    again = run_of(*ALL[name], imposed=free.decisions())
    np.testing.assert_array_equal(np.stack([free.y, free.v]), np.stack([again.y, again.v]))
    assert ball.first_difference(free, again).seed is None
    if name not in ("penalty", "projection per ball", "located impact"):
        return
    for index in range(len(Y0)):
        # two that start in contact beside it; and one of the models by itself, as another program
        other = np.where(np.arange(len(Y0)) == index, Y0, -1e-3)
        batches = [(other, V0)] + [(Y0[index], V0[index])] * (name == "projection per ball")
        for start in batches:
            run = run_of(*ALL[name], start=start)
            np.testing.assert_array_equal(free.y[:, index], run.y[:, index % run.balls])


BELOW = float(np.nextafter(0.75, 0))


@pytest.mark.parametrize(
    ("y", "v", "gravity", "rest_speed", "after"),
    [
        # the rebound of 0.75 is the rest speed, or just above it: then it bounces for half of the step
        (0.5, -0.5, 2.0, 0.75, (0.0, 0.0)), (0.5, -0.5, 2.0, BELOW, (0.125, -0.25)),
        # without gravity nothing brings it back, and it stays all the same
        (0.5, -1.0, 0.0, 0.75, (0.0, 0.0)), (0.5, -1.0, 0.0, 0.25, (0.25, 0.5)),
        # what pulls it up takes it off the floor, however slow it is
        (0.75, -2.0, -2.0, 0.75, (0.5, 1.5)),
    ],
)  # fmt: skip
def test_a_ball_comes_to_rest_at_its_rest_speed_unless_it_is_pulled_up(y, v, gravity, rest_speed, after):
    """Parabolas with an impact after half a step, every number of which is exact in binary."""
    world = ball.World.create(ball.Impact(0.5, rest_speed), ball.EventLocated(1.0), gravity=gravity)
    run = ball.simulate(world, world.start(np.array([y]), np.array([v])), 1)
    assert (float(run.y[1, 0]), float(run.v[1, 0])) == after
    assert (run.reason[0, 0] == Reason.REST.value) == (after == (0.0, 0.0))


@pytest.mark.parametrize(
    ("name", "step", "index"),
    [("penalty", 26, 0), ("penalty", 100, 1), ("penalty", 301, 2), ("projection", 0, -1)],
)
def test_one_inverted_decision_is_found(name, step, index):
    free = run_of(*ALL[name])
    contact, iterations = free.contact.copy(), free.iterations.copy()
    if index < 0:
        step = int(np.flatnonzero(free.iterations > 5)[3]) + 1
        iterations[step - 1] += 1
    else:
        contact[step - 1, index] ^= True
    planted = run_of(*ALL[name], imposed=BallDecisions(contact, iterations))
    seen = ball.first_difference(free, planted)
    assert (seen.fork, seen.channel, seen.ball) == (step, "stop" if index < 0 else "contact", index)
    # semi-implicit Euler acts at once: the state of that very step differs
    assert seen.seed == step or index < 0
    assert index >= 0 or seen.margins[0] == seen.margins[1] > 0


def test_control_is_added_and_ends_at_its_last_value():
    control = np.array([9.81, 9.81, 19.62])
    world = ball.World.create(ball.Impact(), ball.SemiImplicitEuler(0.1), control=control)
    run = ball.simulate(world, world.start(1.0), 5)
    np.testing.assert_allclose(run.v[:, 0], [0, 0, 0, 0.981, 1.962, 2.943], atol=1e-14)


def test_parameters_are_named_and_unknown_ones_refused():
    world = ball.World.create(*ALL["projection"])
    assert world.parameters == ("k", "alpha", "restitution", "tol", "h", "gravity")
    assert float(world.with_values({"k": 0.25}).value("k")) == 0.25
    with pytest.raises(InputError, match="damping"):
        world.value("damping")


def test_stochastic_rounding_of_the_state_is_reproducible_and_unbiased():
    policy = RolePrecision(state="bfloat16", arithmetic="float32", rounding="stochastic", seed=3)
    world = ball.World.create(ball.Impact(), ball.SemiImplicitEuler(1e-3), gravity=0.0, policy=policy)
    start = world.start(np.full(4000, 1.0), np.full(4000, 0.5))
    first, second = (ball.simulate(world, start, 64) for _ in range(2))
    np.testing.assert_array_equal(first.y, second.y)
    # each step adds 5e-4, a sixteenth of the spacing of bfloat16 above 1: to nearest nothing ever moves
    moved = first.y[-1].astype(np.float64).mean() - 1.0
    error = first.y[-1].astype(np.float64).std() / np.sqrt(4000)
    assert abs(moved - 64 * 5e-4) < 4 * error
