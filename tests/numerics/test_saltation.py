"""Saltation against motions that are known in closed form."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.ball.exact import ExactImpact
from mdnum.numerics.saltation import GRAZING, carry, grazing, time_shift

EPS = 2.0**-52


def impact(v, e, g):
    """Reset, flows and normal of a ball that meets the floor with velocity v."""
    return (
        np.array([[1.0, 0.0], [0.0, -e]]),
        np.array([v, -g]),
        np.array([-e * v, -g]),
        np.array([1.0, 0.0]),
    )


def saltation(*event):
    """The matrix of an event: what becomes of perturbations of one component each."""
    xp = event[-1].__array_namespace__()
    one = xp.ones_like(event[-1])
    return xp.stack([carry(one * row, *event) for row in np.eye(one.shape[-1])], axis=-1)


def flight(t):
    """Tangent of a flight that lasts t."""
    return np.array([[1.0, t], [0.0, 1.0]])


def test_the_matrix_of_an_impact_and_of_a_force_jump_written_out():
    v, e, g = -3.0, 0.75, 10.0
    expected = [[-e, 0.0], [-(1 + e) * g / v, -e]]
    np.testing.assert_allclose(saltation(*impact(v, e, g)), expected, rtol=0, atol=8 * EPS)
    # a pair that leaves its cutoff with speed 2, where the force would have been -0.5
    before, after = np.array([2.0, -0.5]), np.array([2.0, 0.0])
    found = saltation(np.eye(2), before, after, np.array([1.0, 0.0]))
    np.testing.assert_array_equal(found, [[1.0, 0.0], [0.25, 1.0]])


@pytest.mark.parametrize("ball", [(1.0, 0.0, 9.81, 0.8), (0.3, -2.5, 1.62, 0.95), (2.0, 3.0, 9.81, 0.5)])
def test_flights_and_saltations_multiply_to_the_exact_derivative(ball):
    """Five impacts: the product of the tangents is the derivative of the closed form."""
    exact = ExactImpact(*ball)
    e, g = ball[3], ball[2]
    times = np.concatenate([[0.0], exact.impact_time(np.arange(1, 6)).value])
    speeds = exact.impact_speed(np.arange(1, 6)).value
    t = 0.5 * float(exact.impact_time(5).value + exact.impact_time(6).value)
    tangent = np.eye(2)
    for (left, right), speed in zip(itertools.pairwise(times), speeds, strict=True):
        tangent = saltation(*impact(-speed, e, g)) @ flight(right - left) @ tangent
    tangent = flight(t - times[-1]) @ tangent
    y, v = exact.state(t)
    known = [[float(q.gradient[name]) for name in ("y0", "v0")] for q in (y, v)]
    np.testing.assert_allclose(tangent, known, rtol=1e-12, atol=1e-14)
    # and without the saltation, by the reset alone, it is wrong, not merely inexact
    naive = np.linalg.multi_dot([flight(t), np.diag([1.0, (-e) ** 5])])
    assert np.max(np.abs(naive - known)) > 0.1


def test_the_restitution_itself_is_a_parameter_of_the_reset():
    ball = ExactImpact(1.0, 0.0, 9.81, 0.8)
    speed, t_1 = float(ball.impact_speed(1).value), float(ball.impact_time(1).value)
    t = 1.3 * t_1
    reset, before, after, normal = impact(-speed, 0.8, 9.81)
    tangent = carry(np.zeros(2), reset, before, after, normal, reset_rate=np.array([0.0, speed]))
    found = flight(t - t_1) @ tangent
    y, v = ball.state(t)
    np.testing.assert_allclose(
        found, [float(y.gradient["restitution"]), float(v.gradient["restitution"])], rtol=1e-13
    )


def test_the_cutoff_as_the_parameter():
    """A threshold that moves: dv/dr_cut = -u'(r_cut) / v for the pair that leaves, and 0 by steps alone."""
    v, force, normal = 1.3, -0.0389, np.array([1.0, 0.0])
    before, after = np.array([v, force]), np.array([v, 0.0])
    found = carry(np.zeros(2), None, before, after, normal, threshold_rate=-1.0)
    np.testing.assert_allclose(found[1], force / v, rtol=1e-14)
    assert found[0] == 0
    np.testing.assert_allclose(time_shift(np.zeros(2), before, normal, -1.0), 1 / v, rtol=1e-14)


def test_batches_and_jax_give_what_single_events_give():
    rng = np.random.default_rng(3)
    reset, before, after, normal = (
        rng.normal(size=shape) for shape in ((4, 3, 5, 5), (4, 3, 5), (4, 3, 5), (4, 3, 5))
    )
    tangent = rng.normal(size=(4, 3, 5))
    matrices = saltation(reset, before, after, normal)
    carried = carry(tangent, reset, before, after, normal)
    for place in np.ndindex(4, 3):
        one = [x[place] for x in (reset, before, after, normal)]
        np.testing.assert_allclose(matrices[place], saltation(*one), rtol=1e-12, atol=1e-12)
        speed = one[3] @ one[1]
        plain = one[0] + np.outer(one[2] - one[0] @ one[1], one[3]) / speed
        np.testing.assert_allclose(matrices[place], plain, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(carried[place], plain @ tangent[place], rtol=1e-9, atol=1e-11)
    with jax.enable_x64(True):
        inside = jax.jit(saltation)(*map(jnp.asarray, (reset, before, after, normal)))
        np.testing.assert_allclose(np.asarray(inside), matrices, rtol=1e-9, atol=1e-11)
        traced = jax.jit(carry)(*map(jnp.asarray, (tangent, reset, before, after, normal)))
        np.testing.assert_allclose(np.asarray(traced), carried, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("speed", [0.0, 0.5 * GRAZING, -0.5 * GRAZING, np.nan])
def test_a_grazing_event_is_flagged(speed):
    reset, before, after, normal = impact(speed * 9.81, 0.8, 9.81)
    with jax.enable_x64(True):
        assert bool(jax.jit(grazing)(*map(jnp.asarray, (before, normal))))
        if not np.isfinite(speed):
            return
        matrix = jax.jit(saltation)(*map(jnp.asarray, (reset, before, after, normal)))
        np.testing.assert_array_equal(np.asarray(matrix), reset)
        # and a gradient through the flagged branch is finite
        slope = jax.grad(lambda f: saltation(*map(jnp.asarray, (reset, f, after, normal))).sum())
        assert np.all(np.isfinite(np.asarray(slope(jnp.asarray(before)))))


def test_of_several_events_the_one_that_grazes_is_flagged():
    _, before, _, normal = (np.stack([x] * 3) for x in impact(-2.0, 0.8, 9.81))
    before[1, 0] = 0.0
    assert grazing(before, normal).tolist() == [False, True, False]
