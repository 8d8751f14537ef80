"""Stability by eigenvalues against the core's own steps, and against balls that were run."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.ball.contacts import Penalty
from mdnum.ball.stability import (
    GROWTH,
    SCHEMES,
    bounce_growth,
    limit,
    measure,
    measured_limit,
    spectral_radius,
    step_matrix,
)
from mdnum.ball.world import World
from mdnum.errors import InputError

EXPLICIT = ("explicit-euler", "semi-implicit-euler", "velocity-verlet")


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("z", "zeta"), [(0.1, 0.0), (1.3, 0.0), (0.7, 0.2), (2.5, 0.6)])
def test_the_matrix_is_the_jacobian_of_a_step_in_contact(scheme, z, zeta):
    h = 0.125
    k = (z / h) ** 2
    world = World.create(Penalty(k, 2 * zeta * np.sqrt(k)), SCHEMES[scheme](h), 9.81)
    half = scheme == "velocity-verlet"

    @jax.jit
    def step(x):
        """From (sqrt(k) y, v), for velocity Verlet with the v of the half step, to the same a step later."""
        y, v = x[:1] / np.sqrt(k), x[1:]
        state = world.start(y, v)
        a = world.contact.acceleration(y, v, state.a * 0 - 9.81, jnp.ones(1, bool), world.rounding)
        state = state._replace(y=y, v=v - h / 2 * a if half else v, a=a)
        after = world.advance(state)[0]
        v = after.v + h / 2 * after.a if half else after.v
        return jnp.concatenate([after.y * np.sqrt(k), v])

    # deep in contact, so that the step ends there too
    jacobian = jax.jacfwd(step)(jnp.array([-3.0, 0.1]))
    np.testing.assert_allclose(np.asarray(jacobian), step_matrix(scheme, z, zeta), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("zeta", [0.0, 0.05, 0.7, 1.0, 3.0])
def test_the_limit_is_where_an_eigenvalue_leaves_the_unit_circle(scheme, zeta):
    known = limit(scheme, zeta)
    z = np.linspace(1e-3, min(known, 50.0) * (1 - 1e-9), 500)
    if known:
        assert np.all(spectral_radius(scheme, z, zeta) <= 1 + 1e-9)
    if np.isfinite(known):
        beyond = np.linspace(known + 1e-6, 3 * known + 1, 500)
        assert np.all(spectral_radius(scheme, beyond, zeta) > 1)


def test_limits_that_everyone_knows():
    assert [limit(scheme) for scheme in SCHEMES] == [0, 2, 2, np.inf]
    assert limit("semi-implicit-euler", 0.75) == 1.0
    with pytest.raises(InputError, match="There are explicit-euler"):
        limit("leapfrog")


@pytest.mark.parametrize("scheme", EXPLICIT)
@pytest.mark.parametrize("zeta", [0.0, 0.1, 0.7])
def test_balls_held_in_contact_run_away_where_the_eigenvalues_say(scheme, zeta):
    steps = 2000
    found = measured_limit(scheme, zeta, steps=steps)
    # the growth that was waited for, up to the part of it that is not in the fastest eigenvector
    power = steps * np.log(spectral_radius(scheme, found, zeta))
    if limit(scheme, zeta) == 2:
        assert abs(found - 2) < 1e-5
    else:
        assert abs(power - np.log(GROWTH)) < 0.4 * np.log(GROWTH)
        assert 0 < found - limit(scheme, zeta) < 0.1
    # rounding does not move the limit: float32 finds the same to a thousandth
    assert abs(measured_limit(scheme, zeta, steps=steps, dtype="float32") - found) < 1e-3 * found


def test_the_implicit_midpoint_has_no_limit():
    assert measured_limit("implicit-midpoint", steps=500) == 4.0


def test_derivatives_grow_far_below_the_limit():
    """The three regions of semi-implicit Euler: nothing grows, only the derivative, everything."""
    found = measure("semi-implicit-euler", np.array([0.05, 0.7, 2.5]), steps=2000, times=4)
    assert found.kind[-1, 0].tolist() == [0, 1, 2]
    assert found.exact[-1] < 100
    assert found.energy[-1, 0, 1] < 4
    assert found.gradient[-1, 0, 1] > 1e18
    assert np.all(np.diff(found.gradient, axis=0) >= 0)


def test_the_derivative_overflows_while_the_ball_looks_fine():
    found = measure("semi-implicit-euler", np.array([0.6]), steps=40_000, times=10, starts=(1.0,))
    assert np.isinf(found.gradient[-1, 0, 0])
    assert found.energy[-1, 0, 0] < 10
    assert found.kind[-1, 0, 0] == 1


def test_the_growth_per_bounce_is_predicted_by_eigenvalues():
    """Averaged over starts: within a quarter of the mean over the phases of entry."""
    z, steps, h = np.array([0.6, 0.8, 1.2]), 4000, 0.01
    flight = 2 * np.sqrt(2 * 9.81) / (9.81 * h)
    starts = [1.0 + 0.0137 * i for i in range(8)]
    logs = np.mean(
        [np.log(measure("semi-implicit-euler", z, steps=steps, starts=(y,)).gradient[-1, 0]) for y in starts],
        axis=0,
    )
    for x, seen in zip(z, logs, strict=True):
        bounces = steps / (flight + np.pi / x)
        predicted = bounce_growth("semi-implicit-euler", x, flight_steps=round(flight)) * bounces
        assert abs(seen - predicted) < 0.25 * predicted, (x, seen, predicted)


def test_half_a_turn_in_whole_steps_has_no_growth():
    """At z = 1 three contact steps are minus the identity, whatever the phase, as in the exact motion."""
    np.testing.assert_allclose(
        np.linalg.matrix_power(step_matrix("semi-implicit-euler", 1.0), 3), -np.eye(2), atol=1e-15
    )
    assert bounce_growth("semi-implicit-euler", 1.0) < 1e-6
    assert bounce_growth("semi-implicit-euler", 0.9) > 1.0


def test_a_damped_ball_that_stays_is_said_to_stay():
    assert bounce_growth("semi-implicit-euler", 0.1, zeta=3.0) == np.inf
