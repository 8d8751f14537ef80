"""On the ball the cause of a split is known: the one decision that was made to differ."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum import ball
from mdnum.errors import InputError
from mdnum.forks.bounce import fork


def adjacent(differs, low: float, high: float) -> tuple[float, float]:
    """Adjacent doubles between which an answer changes."""
    first = differs(low)
    assert differs(high) != first
    while True:
        middle = low + (high - low) / 2
        if middle in (low, high):
            return low, high
        low, high = (middle, high) if differs(middle) == first else (low, middle)


def test_a_contact_one_step_earlier_is_the_cause():
    world = ball.World.create(ball.Impact(0.8), ball.SemiImplicitEuler(0.01))

    def first_contact(y0):
        return int(ball.simulate(world, world.start(y0), 80).first_contact[0])

    low, high = adjacent(first_contact, 1.0, 1.05)
    found = fork(world, world, world.start(low), world.start(high), 400)
    assert np.nextafter(low, high) == high
    assert found.dates.fork == first_contact(low) == first_contact(high) - 1
    assert found.difference.channel == "contact" and found.difference.ball == 0
    assert found.free.max() > 0.05
    # under the other's decisions the two never part by more than the ulp grows to
    assert found.handed.max() < 1e-14 and found.back.max() < 1e-14
    assert found.verdict.word == "cause"


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
    found = fork(world, world, world.start(low), world.start(high), 400, split=1e-4)
    assert found.difference.channel == "stop"
    assert found.dates.split is not None
    assert found.handed.max() < 1e-13
    assert found.verdict.word == "cause"


def test_a_ball_and_itself():
    world = ball.World.create(ball.Penalty(1e4), ball.SemiImplicitEuler(1e-3))
    assert fork(world, world, world.start(1.0), steps=200).verdict.word == "same"


def test_a_tolerance_that_never_flips_a_decision():
    world = ball.World.create(ball.Penalty(1e4), ball.SemiImplicitEuler(1e-3))
    found = fork(world, world, world.start(1.0), world.start(1.0 + 1e-12), 800)
    assert found.verdict.word == "no fork"
    np.testing.assert_array_equal(found.free, found.handed)


def test_programs_that_decide_different_things_are_refused():
    penalty = ball.World.create(ball.Penalty(1e4), ball.SemiImplicitEuler(1e-3))
    impact = ball.World.create(ball.Impact(), ball.SemiImplicitEuler(1e-3))
    with pytest.raises(InputError, match="Penalty and Impact"):
        fork(penalty, impact, penalty.start(1.0))
