"""Every program of the ball against the exact motion: to rounding with located impacts, else by order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mdnum import ball
from mdnum.ball import ExactImpact, ExactPenalty
from mdnum.verbs import demos

# step sizes down to a ten-thousandth
pytestmark = pytest.mark.slow
NIGHTLY = pytest.mark.nightly
RULE = ball.PerInstance(1e-9, 200)


def test_located_impacts_meet_the_exact_motion_at_every_step():
    exact = ExactImpact(1.0, -0.5, 9.81, 0.8)
    world = ball.World.create(ball.Impact(0.8, 0.0), ball.EventLocated(0.01))
    run = ball.simulate(world, world.start(1.0, -0.5), 340)
    assert int(run.iterations.sum()) == int(exact.bounces(3.4)) == 8
    y, v = exact.state(run.time)
    np.testing.assert_allclose(run.y[:, 0], y.value, atol=2e-14)
    # next to an impact a rounding of the time moves the velocity across it
    away = np.abs(run.time[:, None] - exact.impact_time(np.arange(1, 12)).value).min(axis=1) > 1e-9
    np.testing.assert_allclose(run.v[away, 0], v.value[away], atol=2e-13)


def penalty(y0: Any, damping: float = 0.0) -> ExactPenalty:
    return ExactPenalty(y0, k=100.0, damping=damping)


@pytest.mark.parametrize(
    ("contact", "scheme", "exact", "order", "slope_order"),
    [
        # reset at the end of a step: the derivative by the start is exactly 0 at every step size
        (ball.Impact(), ball.ExplicitEuler, ExactImpact, 1, None),
        (ball.Projection(0.5, 0.5, RULE), ball.SemiImplicitEuler, ExactImpact, 1, None),
        # the kink of the force costs the value h² at a contact; the derivative sees its slope jump: order 1
        pytest.param(ball.Penalty(100.0), ball.ExplicitEuler, penalty, 1, 1, marks=NIGHTLY),
        (ball.Penalty(100.0), ball.SemiImplicitEuler, penalty, 1, 1),
        (ball.Penalty(100.0), ball.BallVerlet, penalty, 2, 1),
        pytest.param(ball.Penalty(100.0), ball.ImplicitMidpoint, penalty, 2, 1, marks=NIGHTLY),
        # a damper makes the force jump and costs the derivative its order
        (ball.Penalty(100.0, 3.0), ball.SemiImplicitEuler, lambda y0: penalty(y0, 3.0), 1, 0),
    ],
)
def test_a_program_approaches_the_motion_that_it_stands_for(contact, scheme, exact, order, slope_order):
    # three impacts each by the time 2, none of them near it
    start, time, counts = np.linspace(0.9, 1.1, 32), 2.0, (400, 800, 1600)
    if exact is not ExactImpact:
        start, counts = np.linspace(0.8, 1.2, 32), (400, 800, 1600, 3200)
    if slope_order == 0:
        start, time, counts = np.linspace(0.8, 1.2, 16), 1.7, (400, 1600, 6400)
    converge = demos.load("euler-choice").__globals__["converge"]
    found = converge(ball.World.create(contact, scheme(0.01)), exact, start, time, counts)
    assert abs(found.order() - order) < 0.2
    if slope_order is None:
        assert np.all(found.largest == 0.0)
    else:
        assert abs(found.order("slope") - slope_order) < (0.2 if slope_order else 0.1)
        assert slope_order or np.all(found.slope > 0.05)
