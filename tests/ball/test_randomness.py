"""Noise by step and ball, common random numbers against closed forms, and flips by key and by order."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from mdnum.ball.contacts import Impact, Projection
from mdnum.ball.integrators import EventLocated, SemiImplicitEuler
from mdnum.ball.problem import Problem
from mdnum.ball.randomness import (
    Flip,
    first_flips,
    noise,
    noisy_gradient,
    reordered,
    shaken,
    shares,
    two_by_two,
)
from mdnum.ball.stopping import GlobalSum
from mdnum.ball.world import World
from mdnum.errors import InputError
from mdnum.precision.policy import RolePrecision
from mdnum.precision.reductions import Exact, Sequential

H = 1 / 64


def dropped(steps: int, y0=1.0) -> Problem:
    return Problem(World.create(Impact(0.75), SemiImplicitEuler(H), gravity=9.75), y0, 0.0, steps)


def pressed(reduction, steps: int = 300) -> Problem:
    """Balls that sink in every step by about what the solver tolerates, in all, summed in float16."""
    balls, g = 16, 9.75
    tol = float(np.float16(balls * g * H * H))
    narrow = RolePrecision("float32", "float32", "float16", "float16", "float32")
    contact = Projection(0.5, 0.5, GlobalSum(tol, 50, reduction), restitution=0.0)
    control = 0.5 * np.random.default_rng(7).normal(size=(steps, balls))
    world = World.create(contact, SemiImplicitEuler(H), g, control, narrow)
    return Problem(world, np.zeros(balls), 0.0, steps)


def test_noise_belongs_to_its_step_and_its_ball() -> None:
    key = jax.random.key(3)
    small, large = np.asarray(noise(key, 5, 3)), np.asarray(noise(key, 9, 7))
    np.testing.assert_array_equal(small, large[:5, :3])
    assert len(np.unique(large)) == large.size
    many = np.asarray(noise(key, 200, 100))
    np.testing.assert_allclose([many.mean(), many.std()], [0, 1], atol=0.03)


def test_noise_is_added_to_the_control_with_the_right_strength() -> None:
    problem = dropped(400, np.ones(50))
    made = np.asarray(shaken(problem, 0, 2.0).world.control)
    np.testing.assert_allclose(made.std() * np.sqrt(H), 2.0, rtol=0.02)
    again = shaken(shaken(problem, 0, 2.0), 1, 1.0).world.control
    np.testing.assert_allclose(
        np.asarray(again) - made, np.asarray(shaken(problem, 1, 1.0).world.control), atol=1e-12
    )
    with pytest.raises(InputError, match="strength"):
        shaken(problem, 0, -1.0)


def test_in_free_flight_common_noise_drops_out_and_fresh_noise_has_its_known_variance() -> None:
    steps, strength, width, samples = 20, 0.3, 0.05, 2000
    found = noisy_gradient(dropped(steps), "v0", strength, width=width, samples=samples)
    # y_T = y0 + T v0 + h² Σ (T - s) u_s
    np.testing.assert_allclose(found.common.mean, steps * H, rtol=1e-12)
    assert found.common.deviation < 1e-12
    np.testing.assert_allclose(found.pathwise.mean, steps * H, rtol=1e-12)
    spread = H * H * strength / np.sqrt(H) * np.sqrt(np.sum(np.arange(1, steps + 1.0) ** 2))
    np.testing.assert_allclose(found.fresh.deviation, np.sqrt(2) * spread / (2 * width), rtol=0.06)
    assert abs(found.fresh.mean - steps * H) < 4 * found.fresh.error
    assert found.ratio > 1e12


def test_common_noise_is_worth_many_samples_where_the_loss_is_smooth_in_the_noise() -> None:
    world = World.create(Impact(0.75), EventLocated(H), gravity=9.75)
    found = noisy_gradient(Problem(world, 1.0, 0.0, 50), "y0", 0.05, width=0.02, samples=300)
    assert found.ratio > 20
    assert abs(found.common.mean - found.fresh.mean) < 4 * np.hypot(found.common.error, found.fresh.error)
    # an impact at its own time has a pathwise derivative, of the same mean
    np.testing.assert_allclose(found.pathwise.mean, found.common.mean, rtol=0.01)


def test_the_pathwise_derivative_of_steps_is_blind_to_the_bounce_and_differences_are_not() -> None:
    found = noisy_gradient(dropped(50), "y0", 0.05, width=0.05, samples=300)
    assert found.pathwise.mean == 0.0
    assert abs(found.common.mean) > 5 * found.common.error
    with pytest.raises(InputError):
        noisy_gradient(dropped(10), "y0", 0.1, width=0.0)


def test_reordering_changes_nothing_but_the_order_of_sums() -> None:
    problem = pressed(Exact())
    moved, order = reordered(problem, 5)
    assert sorted(order) == list(range(16))
    assert list(order) != list(range(16))
    np.testing.assert_array_equal(
        np.asarray(moved.world.control), np.asarray(problem.world.control)[:, order]
    )
    # an exact sum has no order
    table = first_flips(problem, 1e-4, (0,), (None, 1, 2, 3))
    assert table == [[Flip(None, "", (0, 0))] * 4]


def test_a_key_and_an_order_can_flip_the_same_event() -> None:
    # noise of the size of the sum's rounding
    table = two_by_two(pressed(Sequential()), 2e-4)
    assert table["same key", "same order"] == Flip(None, "", (0, 0))
    key, order = table["other key", "same order"], table["same key", "other order"]
    assert key.channel == order.channel == "stop"
    assert set(key.counts) == set(order.counts) == {0, 1}
    # and nothing but the two: the same key in the same order is the same program, as often as it is run
    forks = first_flips(pressed(Sequential()), 2e-4, range(4), (None, 1, 2, 3))
    assert forks[1][0] == key
    assert forks[0][1] == order
    by_key = {row[0].step for row in forks[1:]}
    by_order = {cell.step for cell in forks[0][1:]}
    assert by_key & by_order - {None}
    steps = np.array([[301 if cell.step is None else cell.step for cell in row] for row in forks], float)
    parts = shares(steps)
    assert parts["key"] > 0.05
    assert parts["order"] > 0.05


def test_shares_of_variance_add_up_and_find_their_cause() -> None:
    rows = np.array([1.0, 2.0, 4.0])[:, None] + np.zeros((1, 5))
    np.testing.assert_allclose(list(shares(rows).values()), [1, 0, 0], atol=1e-14)
    np.testing.assert_allclose(shares(rows.T)["order"], 1.0)
    assert set(shares(np.ones((3, 3))).values()) == {0.0}
    mixed = shares(np.random.default_rng(0).normal(size=(6, 4)))
    np.testing.assert_allclose(sum(mixed.values()), 1.0)
