"""The record of a rollout: complete, independent of chunks, and right against exact rationals."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from ball import oracles
from oracles import broken_alternations

from mdnum import ball
from mdnum.ball import rollout
from mdnum.errors import InputError
from mdnum.numerics.roles import RolePrecision

NIGHTLY = pytest.mark.nightly
LOCATED, EULER = ball.EventLocated(0.01), ball.SemiImplicitEuler(0.01)
WORLDS = {
    "penalty": (ball.Penalty(900.0), EULER),
    "projection": (ball.Projection(0.5, 0.5, ball.PerInstance(1e-6)), EULER),
    "located": (ball.Impact(0.9), LOCATED),
}
HEIGHTS = np.linspace(0.05, 1.5, 23)


def run_of(contact, integrator, steps: int = 500, policy=None, **options):
    world = ball.World.create(contact, integrator, policy=policy)
    return ball.simulate(world, world.start(HEIGHTS), steps, **options)


@pytest.mark.parametrize("name", WORLDS)
def test_the_ledger_is_complete(name):
    run = run_of(*WORLDS[name])
    ledger, first = run.contacts, np.arange(23)
    assert len(ledger) > 20 and broken_alternations(ledger) == 0
    # row by row, found again from the matrix of decisions
    changed = np.diff(np.vstack([HEIGHTS < 0, run.contact]).astype(int), axis=0)
    again = {(s + 1, b, bool(changed[s, b] > 0)) for s, b in np.argwhere(changed)}
    assert again == set(zip(ledger.step, ledger.subject[:, 0], ledger.entered, strict=True))
    np.testing.assert_array_equal(ledger.margin, -run.height[ledger.step - 1, ledger.subject[:, 0]])
    np.testing.assert_array_equal(ledger.entered, ledger.margin > 0)
    # the decision of step s is about the height after s - 1 steps, or after s of them
    fall = np.sqrt(2 * HEIGHTS / 9.81) / 0.01
    assert (np.abs(run.first_contact - 0.5 - fall) < 2).all() and run.time[-1] == pytest.approx(5.0)
    if name == "located":
        # an impact takes away what the square of the restitution does not leave
        rows = [np.flatnonzero(ledger.entered & (ledger.subject[:, 0] == k))[0] for k in first[HEIGHTS > 0.3]]
        lost = -(1 - 0.9**2) * 9.81 * HEIGHTS[HEIGHTS > 0.3]
        np.testing.assert_allclose(ledger.jump[rows], lost, rtol=1e-12)


@pytest.mark.parametrize(
    "name", ["located", pytest.param("penalty", marks=NIGHTLY), pytest.param("projection", marks=NIGHTLY)]
)
def test_chunks_leave_no_trace(name, monkeypatch):
    whole = run_of(*WORLDS[name])
    monkeypatch.setattr(rollout, "_CHUNK", 23 * 125)
    cut, light = run_of(*WORLDS[name]), run_of(*WORLDS[name], keep=False)
    for field in ("y", "v", "height", "contact", "iterations", "reason"):
        np.testing.assert_array_equal(getattr(whole, field), getattr(cut, field))
    for field in ("step", "subject", "entered", "margin", "bound", "jump"):
        np.testing.assert_array_equal(getattr(whole.contacts, field), getattr(cut.contacts, field))
    np.testing.assert_array_equal(light.contacts.margin, whole.contacts.margin)
    np.testing.assert_array_equal(light.y, whole.y[[0, -1]])


@pytest.mark.parametrize("dtype", ["float16", pytest.param("float32", marks=NIGHTLY)])
def test_bounds_hold_the_error_of_the_height_that_was_compared(dtype):
    """Heights recomputed in exact rationals from the recorded state before."""
    run = run_of(*WORLDS["projection"], 300, RolePrecision.all(dtype))
    ledger = run.contacts
    h, g = oracles.rational(run.world.value("h"), run.world.value("gravity"))
    for row in range(0, len(ledger), 3):
        s, b = int(ledger.step[row]), int(ledger.subject[row, 0])
        y, v = oracles.rational(run.y[s - 1, b], run.v[s - 1, b])
        exact, _ = oracles.fly("semi-implicit-euler", y, v, -g, h)
        error = abs(Fraction(float(-ledger.margin[row])) - exact)
        assert error <= Fraction(float(ledger.bound[row]))


@pytest.mark.parametrize(
    ("dtype", "first"),
    [
        ("float32", None),
        ("bfloat16", 66),
        pytest.param("float64", None, marks=NIGHTLY),
        pytest.param("float16", 170, marks=NIGHTLY),
    ],
)
def test_contact_history_against_exact_rationals(dtype, first):
    """The same program in exact arithmetic: the events of 64 and 32 bits hold, those of 16 bits do not."""
    steps, start, h, g, k = 300, 0.40625, 2.0**-6, 9.75, 512.0
    _, exact = oracles.penalty("semi-implicit-euler", *oracles.rational(start, 0.0, h, g, k, 0.0), steps)
    policy = RolePrecision.all(dtype)
    world = ball.World.create(ball.Penalty(k), ball.SemiImplicitEuler(h), gravity=g, policy=policy)
    differ = ball.simulate(world, world.start(start), steps).contact[:, 0] != np.array(exact)
    assert sum(exact) > 30
    assert (int(differ.argmax()) + 1 if differ.any() else None) == first


def test_no_step_is_refused():
    with pytest.raises(InputError, match="steps = 0"):
        run_of(*WORLDS["penalty"], 0)


@pytest.mark.parametrize(
    ("one", "other", "channel", "counted"),
    [
        # impacts that are located are no iterations of a solver, and both reset at the end of a step
        ((ball.Impact(0.8), LOCATED), (ball.Impact(0.8), EULER), "contact", False),
        (WORLDS["projection"], (ball.Impact(0.8), EULER), "", False),
        # two counts of one solver, or of one kind of impact
        ((ball.Projection(0.5, 0.5, ball.Maximum(1e-3)), EULER), WORLDS["projection"], "stop", True),
        ((ball.Impact(0.8), LOCATED), (ball.Impact(0.8, 0.1), LOCATED), "contact", True),
    ],
)  # fmt: skip
def test_counts_are_compared_where_they_count_the_same(one, other, channel, counted):
    runs = [run_of(*given) for given in (one, other)]
    assert runs[0].iterations.sum() > 0
    found = ball.first_difference(*runs)
    assert (found.channel, found.iterations_differ > 0) == (channel, counted)
