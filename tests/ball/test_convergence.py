"""Every program of the ball against the exact motion: to rounding with located impacts, else by order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mdnum.ball import (
    BallVerlet,
    EventLocated,
    ExactImpact,
    ExactPenalty,
    ExplicitEuler,
    Impact,
    ImplicitMidpoint,
    Penalty,
    PerInstance,
    Projection,
    SemiImplicitEuler,
    World,
    simulate,
)
from mdnum.verbs import demos

# step sizes down to a ten-thousandth
pytestmark = pytest.mark.slow
# three impacts each by the time 2, none of them near it
STARTS = np.linspace(0.9, 1.1, 32)
TIME = 2.0
COUNTS = (400, 800, 1600)
STIFFNESS = 100.0


def converge(*given: Any) -> Any:
    """As the demonstration of the two Eulers has it."""
    return demos.load("euler-choice").__globals__["converge"](*given)


def test_located_impacts_meet_the_exact_motion_at_every_step():
    exact = ExactImpact(1.0, -0.5, 9.81, 0.8)
    world = World.create(Impact(0.8, 0.0), EventLocated(0.01))
    run = simulate(world, world.start(1.0, -0.5), 340)
    assert int(run.iterations.sum()) == int(exact.bounces(3.4)) == 8
    y, v = exact.state(run.time)
    np.testing.assert_allclose(run.y[:, 0], y.value, atol=2e-14)
    # next to an impact a rounding of the time moves the velocity across it
    away = np.abs(run.time[:, None] - exact.impact_time(np.arange(1, 12)).value).min(axis=1) > 1e-9
    np.testing.assert_allclose(run.v[away, 0], v.value[away], atol=2e-13)


@pytest.mark.parametrize(
    "name", ["y0", "restitution", *(pytest.param(x, marks=pytest.mark.nightly) for x in ("v0", "gravity"))]
)
def test_located_impacts_have_the_exact_derivatives(name):
    world = World.create(Impact(0.8, 0.0), EventLocated(0.01))
    # 2.9 s: eight impacts of the lowest ball, five of the highest
    found = converge(world, ExactImpact, np.linspace(0.75, 1.15, 9), 2.9, (29,), name)
    assert np.all(found.value < 5e-15)
    assert np.all(found.slope < 1e-10)
    assert np.all(found.largest > 0.1)


@pytest.mark.parametrize(
    ("contact", "scheme"),
    [
        (Impact(), ExplicitEuler),
        pytest.param(Impact(), SemiImplicitEuler, marks=pytest.mark.nightly),
        pytest.param(Impact(), BallVerlet, marks=pytest.mark.nightly),
        (Projection(0.5, 0.5, PerInstance(1e-9, 200)), SemiImplicitEuler),
    ],
)
def test_a_reset_at_the_end_of_a_step_is_of_order_one_and_its_derivative_is_zero(contact, scheme):
    """The derivative by y0 is exactly 0.0 at every step size: an error that does not shrink."""
    found = converge(World.create(contact, scheme(0.01)), ExactImpact, STARTS, TIME, COUNTS)
    assert abs(found.order() - 1) < 0.2
    assert np.all(found.largest == 0.0)


@pytest.mark.parametrize(
    ("scheme", "order"),
    [
        pytest.param(ExplicitEuler, 1, marks=pytest.mark.nightly),
        (SemiImplicitEuler, 1),
        (BallVerlet, 2),
        pytest.param(ImplicitMidpoint, 2, marks=pytest.mark.nightly),
    ],
)
def test_a_penalty_approaches_the_spring_floor(scheme, order):
    """Values to the scheme's order; derivatives to the first whatever the scheme.

    The force has a kink at the floor. It costs the value an error of h² at each contact, which a scheme of
    order 2 can afford; the derivative sees a jump in the force's slope there, and is of order 1.
    """
    starts, counts = np.linspace(0.8, 1.2, 32), (400, 800, 1600, 3200)
    world = World.create(Penalty(STIFFNESS), scheme(0.01))
    found = converge(world, lambda y0: ExactPenalty(y0, k=STIFFNESS), starts, TIME, counts)
    assert abs(found.order() - order) < 0.2
    assert abs(found.order("slope") - 1) < 0.2


def test_a_damper_makes_the_force_jump_and_costs_the_derivative_its_order():
    world = World.create(Penalty(100.0, 3.0), SemiImplicitEuler(0.01))
    starts, counts = np.linspace(0.8, 1.2, 16), (400, 1600, 6400)
    found = converge(world, lambda y0: ExactPenalty(y0, k=100.0, damping=3.0), starts, 1.7, counts)
    assert abs(found.order() - 1) < 0.2
    assert abs(found.order("slope")) < 0.1 and np.all(found.slope > 0.05)
