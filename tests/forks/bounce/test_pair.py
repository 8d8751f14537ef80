"""On the ball the cause of a split is known: the one decision that was made to differ."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from mdnum.ball.determinism import fingerprint
from mdnum.forks.bounce import BallTwin, Pin, fork
from mdnum.forks.bounce.cross import differing, overridden
from mdnum.forks.bounce.pair import between, reordered
from mdnum.forks.bounce.twin import as_in_a, told

from mdnum import ball
from mdnum.errors import InputError


def adjacent(differs, low: float, high: float) -> tuple[float, float]:
    """Adjacent doubles between which an answer changes."""
    first = differs(low)
    assert differs(high) != first
    while True:
        middle = low + (high - low) / 2
        if middle in (low, high):
            return low, high
        low, high = (middle, high) if differs(middle) == first else (low, middle)


def projection(rule, **options) -> ball.World:
    return ball.World.create(ball.Projection(0.5, 0.5, rule), ball.SemiImplicitEuler(0.01), **options)


def test_a_contact_one_step_earlier_is_the_cause():
    world = ball.World.create(ball.Impact(0.8), ball.SemiImplicitEuler(0.01))

    def first_contact(y0):
        return int(ball.simulate(world, world.start(y0), 80).first_contact[0])

    low, high = adjacent(first_contact, 1.0, 1.05)
    found = fork(between(world, world, world.start(low), world.start(high), 400))
    assert np.nextafter(low, high) == high
    assert found.dates.fork == first_contact(low) == first_contact(high) - 1
    made = found.decision
    assert made is not None and (made.channel, made.ball, made.a, made.b, made.run) == (
        "contact",
        0,
        1,
        0,
        "A",
    )
    # heights on both sides of the floor, no further from it than the runs were apart
    assert made.margins["A"] > 0 >= made.margins["B"]
    assert made.margins["A"] - made.margins["B"] <= 1.5 * found.series["B"][made.step - 1]
    free, handed = found.series["B"], found.series["B|A"]
    assert made.separation == free[made.step - 1]
    assert free.max() > 0.05
    # under the other's decisions the two never part by more than the ulp grows to
    assert handed.max() < 1e-14 and found.series["A|B"].max() < 1e-14
    assert found.verdict.word == "cause"
    assert found.splits["B"] is not None and found.splits["B|A"] is None and found.splits["A|B"] is None
    assert {(cell.arithmetic, cell.decisions, cell.reference) for cell in found.table} == {
        (arithmetic, decisions, one) for arithmetic in "AB" for decisions in "AB" for one in "AB"
    }


def test_one_more_solver_iteration_is_the_cause():
    rule = ball.GlobalSum(1e-3)
    world = ball.World.create(ball.Projection(1.5, 1.0, rule), ball.SemiImplicitEuler(0.01))

    def iterations(y0):
        return int(ball.simulate(world, world.start(y0), 60).iterations.sum())

    # a ball that passes the floor by the tolerance or a little less: iterated past the floor, or put on it
    heights = np.linspace(1.0, 1.05, 400)
    counts = ball.simulate(
        ball.World.create(ball.Projection(1.5, 1.0, ball.PerInstance(1e-3)), ball.SemiImplicitEuler(0.01)),
        world.start(heights),
        60,
    ).iterations.sum(axis=0)
    place = int(np.flatnonzero(counts[1:] != counts[:-1])[0])
    low, high = adjacent(iterations, float(heights[place]), float(heights[place + 1]))
    found = fork(between(world, world, world.start(low), world.start(high), 400), split=1e-4)
    assert found.decision is not None and found.decision.channel == "stop"
    assert abs(found.decision.a - found.decision.b) == 1
    assert found.dates.split is not None
    assert found.series["B|A"].max() < 1e-13
    assert found.verdict.word == "cause"


def test_a_ball_and_itself():
    world = ball.World.create(ball.Penalty(1e4), ball.SemiImplicitEuler(1e-3))
    found = fork(between(world, world, world.start(1.0), steps=200))
    assert found.verdict.word == "same" and found.decision is None and not len(found.crossed)
    # a run that is handed its own decisions has its own bits
    assert fingerprint(found.runs["B|A"]) == fingerprint(found.runs["A"])
    assert not found.series["overridden"].any()


def test_bits_that_differ_without_a_decision_that_does():
    world = ball.World.create(ball.Penalty(1e4), ball.SemiImplicitEuler(1e-3))
    found = fork(between(world, world, world.start(1.0), world.start(1.0 + 1e-12), 800))
    assert found.verdict.word == "no fork"
    np.testing.assert_array_equal(found.series["B"], found.series["B|A"])
    assert found.splits["B"] is None and found.repeats == ()


def test_another_gravity_needs_no_decision_to_split():
    """What parts the runs is their flight: the contacts that differ only come along."""
    light, heavy = (
        ball.World.create(ball.Penalty(1e4), ball.SemiImplicitEuler(1e-3), gravity)
        for gravity in (9.81, 9.75)
    )
    found = fork(between(light, heavy, light.start(1.0), steps=2000))
    assert found.dates.fork is not None and found.dates.split is not None
    assert found.verdict.word == "bystander", found.verdict
    # six of six are not later without them
    assert len(found.repeats) == 5 and found.verdict.count.not_later == 6


def test_programs_that_decide_different_things_are_refused():
    penalty = ball.World.create(ball.Penalty(1e4), ball.SemiImplicitEuler(1e-3))
    impact = ball.World.create(ball.Impact(), ball.SemiImplicitEuler(1e-3))
    with pytest.raises(InputError, match="Penalty and Impact"):
        fork(between(penalty, impact, penalty.start(1.0)))
    twin = between(penalty, penalty, penalty.start(1.0), steps=10)
    with pytest.raises(InputError, match="split = 0"):
        fork(twin, split=0.0)
    with pytest.raises(InputError, match="1 balls and 2"):
        fork(BallTwin(twin.a, dataclasses.replace(twin.b, y0=np.ones(2)), ""))


# --- planted faults -----------------------------------------------------------------------------------

WORLDS = {
    "global": projection(ball.GlobalSum(1e-4)),
    "per-instance": projection(ball.PerInstance(1e-4)),
    "located": ball.World.create(ball.Impact(0.8), ball.EventLocated(0.01)),
    "newton": ball.World.create(ball.Penalty(900.0), ball.ImplicitMidpoint(0.01)),
}
STARTS = np.array([0.3, 0.41, 0.52])


@pytest.fixture(scope="module")
def runs() -> dict[str, ball.BallRun]:
    return {name: ball.simulate(world, world.start(STARTS), 60) for name, world in WORLDS.items()}


@pytest.mark.parametrize("name", WORLDS)
def test_a_run_that_is_told_nothing_in_particular_has_its_own_bits(name, runs):
    world, run = WORLDS[name], runs[name]
    own = run.told()
    silent = ball.Decisions(np.full(own.contact.shape, -1, np.int8), np.full_like(own.iterations, -1))
    again = ball.simulate(world, world.start(STARTS), 60, told=silent)
    assert fingerprint(again) == fingerprint(run)


def contact_pin(run: ball.BallRun, number: int) -> Pin:
    """A contact that begins a step early."""
    rows = np.flatnonzero(run.contacts.entered)
    step, one = int(run.contacts.step[rows[number]]), int(run.contacts.subject[rows[number], 0])
    return Pin("contact", step - 1, one, 1)


@pytest.mark.parametrize("name", ["global", "per-instance"])
def test_one_inverted_contact_is_found_exactly(name, runs):
    world, run = WORLDS[name], runs[name]
    pin = contact_pin(run, 1)
    problem = ball.Problem(world, STARTS, 0.0, 60)
    found = fork(BallTwin(problem, problem, "planted", pins=(pin,)), repeats=0)
    made = found.decision
    assert made is not None
    assert (found.dates.fork, made.channel, made.ball, made.a, made.b) == (
        pin.step,
        "contact",
        pin.ball,
        0,
        1,
    )
    # nothing before, and at the fork the bits of that ball alone
    assert found.dates.seed == pin.step
    other = np.delete(np.arange(3), pin.ball)
    np.testing.assert_array_equal(
        found.runs["B"].y[: pin.step + 1, other], found.runs["A"].y[: pin.step + 1, other]
    )
    # told A's decisions, the planted one among them, B is A
    assert fingerprint(found.runs["B|A"]) == fingerprint(found.runs["A"])


@pytest.mark.parametrize("name", ["global", "per-instance", "newton"])
def test_one_more_iteration_is_found_exactly(name, runs):
    world, run = WORLDS[name], runs[name]
    busy = run.iterations.reshape(60, -1)
    row = int(np.flatnonzero(busy.any(axis=1))[-1])
    one = int(busy[row].argmax()) if run.iterations.ndim == 2 else -1
    count = int(busy[row].max())
    problem = ball.Problem(world, STARTS, 0.0, 60)
    pin = Pin("stop", row + 1, one, count + 1)
    found = fork(BallTwin(problem, problem, "planted", pins=(pin,)), repeats=0, counterfactual=False)
    made = found.decision
    assert made is not None
    assert (made.step, made.channel, made.ball, made.a, made.b) == (row + 1, "stop", one, count, count + 1)
    # A stopped there, B went on at the same residual
    assert made.run == "A" and made.margins["A"] == made.margins["B"] > 0


def test_what_a_told_run_would_have_decided(runs):
    world, run = WORLDS["global"], runs["global"]
    count, far = overridden(run)
    assert not count.any() and not far.any()
    pin = contact_pin(run, 0)
    other = ball.simulate(world, world.start(STARTS), 60, told=told((pin,), run))
    count, far = overridden(other)
    assert count[pin.step] == 1 and count[: pin.step].sum() == 0
    assert far[pin.step] == other.height[pin.step - 1, pin.ball] > 0


# --- order of the batch -------------------------------------------------------------------------------


def test_balls_in_another_order_are_compared_ball_by_ball(runs):
    world, run = WORLDS["per-instance"], runs["per-instance"]
    order = (2, 0, 1)
    problem = ball.Problem(world, STARTS, 0.0, 60)
    turned = reordered(problem, order)
    np.testing.assert_array_equal(turned.y0, STARTS[[2, 0, 1]])
    back = as_in_a(turned.run(), order)
    assert fingerprint(back) == fingerprint(run)
    for name in ("step", "subject", "entered", "margin"):
        np.testing.assert_array_equal(getattr(back.contacts, name), getattr(run.contacts, name))


def test_rules_for_all_and_for_each_are_compared_where_iterations_do_something(runs):
    """A ball that does not touch is none the wiser for the iterations of the others."""
    assert not len(differing(runs["global"], runs["per-instance"]))
    # the first two touch in one step, one of them deeper
    starts = np.array([0.3, 0.301, 0.52])
    problems = (ball.Problem(WORLDS[name], starts, 0.0, 60) for name in ("global", "per-instance"))
    found = fork(BallTwin(*problems, "rules"), repeats=0)
    rows = found.crossed
    assert len(rows) and np.all(rows.channel == "stop") and set(rows.ball.tolist()) <= {0, 1}
    touches = found.runs["A"].contact | found.runs["B"].contact
    assert np.all(touches[rows.step - 1, rows.ball])
    # each told the other's counts does what the other does
    np.testing.assert_array_equal(found.runs["B|A"].y, found.runs["A"].y)
    np.testing.assert_array_equal(found.runs["A|B"].y, found.runs["B"].y)


def test_a_run_that_blows_up_ends_the_comparison():
    tame, wild = (
        ball.World.create(ball.Penalty(k), ball.ExplicitEuler(0.1), policy=ball_policy()) for k in (10.0, 6e4)
    )
    found = fork(between(tame, wild, tame.start(0.5), steps=400), repeats=0)
    assert found.failed == {"B": "blow-up"}
    assert 0 < found.steps < 400 and found.asked == 400
    # whether or not a decision differs before
    assert found.dates.fork is not None and found.dates.fork <= found.steps
    assert all(len(values) == found.steps + 1 for values in found.series.values())
    assert np.isfinite(found.series["B"]).all()


def ball_policy():
    from mdnum.precision import RolePrecision

    return RolePrecision.all("float16")
