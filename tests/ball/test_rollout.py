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

WORLDS = {
    "penalty": (ball.Penalty(900.0), ball.SemiImplicitEuler(0.01)),
    "projection": (ball.Projection(0.5, 0.5, ball.PerInstance(1e-6)), ball.SemiImplicitEuler(0.01)),
    "located": (ball.Impact(0.9), ball.EventLocated(0.01)),
}
LOCATED, EULER = ball.EventLocated(0.01), ball.SemiImplicitEuler(0.01)
HEIGHTS = np.linspace(0.05, 1.5, 23)


def run_of(name, **options):
    world = ball.World.create(*WORLDS[name])
    return ball.simulate(world, world.start(HEIGHTS), 500, **options)


@pytest.mark.parametrize("name", WORLDS)
def test_the_ledger_is_complete(name):
    run = run_of(name)
    ledger = run.contacts
    assert len(ledger) > 20
    assert broken_alternations(ledger) == 0
    entered, left = ledger.counts(run.steps)
    np.testing.assert_array_equal(np.cumsum(entered - left)[1:], run.contact.sum(axis=1))
    # row by row, found again from the matrix of decisions
    again = {
        (s + 1, b, bool(run.contact[s, b]))
        for s in range(run.steps)
        for b in range(run.balls)
        if run.contact[s, b] != (run.contact[s - 1, b] if s else HEIGHTS[b] < 0)
    }
    assert again == set(zip(ledger.step, ledger.subject[:, 0], ledger.entered, strict=True))
    heights = run.height[ledger.step - 1, ledger.subject[:, 0]]
    np.testing.assert_array_equal(ledger.margin, -heights)
    np.testing.assert_array_equal(ledger.entered, ledger.margin > 0)


@pytest.mark.parametrize(
    "name", ["located", *(pytest.param(x, marks=pytest.mark.nightly) for x in ("penalty", "projection"))]
)
def test_chunks_leave_no_trace(name, monkeypatch):
    whole = run_of(name)
    monkeypatch.setattr(rollout, "_CHUNK", 23 * 125)
    cut = run_of(name)
    for field in ("y", "v", "height", "contact", "iterations", "reason"):
        np.testing.assert_array_equal(getattr(whole, field), getattr(cut, field))
    for field in ("step", "subject", "entered", "margin", "bound", "jump"):
        np.testing.assert_array_equal(getattr(whole.contacts, field), getattr(cut.contacts, field))
    light = run_of(name, keep=False)
    np.testing.assert_array_equal(light.contacts.margin, whole.contacts.margin)
    np.testing.assert_array_equal(light.y, whole.y[[0, -1]])


def test_first_contact_and_time():
    run = run_of("penalty")
    fall = np.sqrt(2 * HEIGHTS / 9.81) / 0.01
    # the decision of step s is about the height after s - 1 steps
    assert (np.abs(run.first_contact - 1 - fall) < 2).all()
    assert run.time[-1] == pytest.approx(5.0)


def test_energy_of_a_bounce_falls_by_the_square_of_the_restitution():
    run = run_of("located")
    ledger = run.contacts
    high = np.flatnonzero(HEIGHTS > 0.3)
    for index in high:
        row = np.flatnonzero(ledger.entered & (ledger.subject[:, 0] == index))[0]
        before = 9.81 * HEIGHTS[index]
        assert ledger.jump[row] == pytest.approx(-(1 - 0.9**2) * before, rel=1e-12)


@pytest.mark.parametrize("dtype", ["float16", pytest.param("float32", marks=pytest.mark.nightly)])
def test_bounds_hold_the_error_of_the_height_that_was_compared(dtype):
    """Heights recomputed in exact rationals from the recorded state before."""
    world = ball.World.create(*WORLDS["projection"], policy=RolePrecision.all(dtype))
    run = ball.simulate(world, world.start(HEIGHTS), 300)
    ledger = run.contacts
    h, g = oracles.rational(world.value("h"), world.value("gravity"))
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
        pytest.param("float64", None, marks=pytest.mark.nightly),
        pytest.param("float16", 170, marks=pytest.mark.nightly),
    ],
)
def test_contact_history_against_exact_rationals(dtype, first):
    """The same program in exact arithmetic: the events of 64 and 32 bits hold, those of 16 bits do not."""
    steps, start, h, g, k = 300, 0.40625, 2.0**-6, 9.75, 512.0
    _, exact = oracles.penalty("semi-implicit-euler", *oracles.rational(start, 0.0, h, g, k, 0.0), steps)
    world = ball.World.create(
        ball.Penalty(k), ball.SemiImplicitEuler(h), gravity=g, policy=RolePrecision.all(dtype)
    )
    differ = ball.simulate(world, world.start(start), steps).contact[:, 0] != np.array(exact)
    assert sum(exact) > 30
    assert (int(differ.argmax()) + 1 if differ.any() else None) == first


def test_no_step_is_refused():
    world = ball.World.create(*WORLDS["penalty"])
    with pytest.raises(InputError, match="steps = 0"):
        ball.simulate(world, world.start(1.0), 0)


@pytest.mark.parametrize(
    ("one", "other", "channel", "counted"),
    [
        # impacts that are located are no iterations of a solver, and both reset at the end of a step
        ((ball.Impact(0.8), LOCATED), (ball.Impact(0.8), EULER), "contact", False),
        ((ball.Projection(0.5, 0.5, ball.Maximum(1e-9)), EULER), (ball.Impact(0.8), EULER), "", False),
        # two counts of one solver, or of one kind of impact
        ((ball.Projection(0.5, 0.5, ball.Maximum(1e-3)), EULER),
         (ball.Projection(0.5, 0.5, ball.PerInstance(1e-9)), EULER), "stop", True),
        ((ball.Impact(0.8), LOCATED), (ball.Impact(0.8, 0.1), LOCATED), "contact", True),
    ],
)  # fmt: skip
def test_counts_are_compared_where_they_count_the_same(one, other, channel, counted):
    worlds = (ball.World.create(*given) for given in (one, other))
    runs = [ball.simulate(world, world.start(HEIGHTS), 500) for world in worlds]
    assert runs[0].iterations.sum() > 0
    found = ball.first_difference(*runs)
    assert (found.channel, found.iterations_differ > 0) == (channel, counted)
