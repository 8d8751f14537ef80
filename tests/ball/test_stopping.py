"""Stopping rules: how many iterations, what ended them, and who feels whom."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ball import oracles
from hypothesis import example, given
from hypothesis import strategies as st

from mdnum import ball
from mdnum.errors import InputError
from mdnum.numerics.roles import RolePrecision
from mdnum.numerics.sums import Sequential

NIGHTLY = pytest.mark.nightly
SUM6 = ball.GlobalSum(1e-6)


def solve(depths, stop, k=0.5, alpha=0.5, policy=None, steps=1, history=False):
    """Balls below the floor at rest and without gravity: the first step is the projection alone.

    Balls on the floor fill up the batch, so that a rule is compiled once.
    """
    contact = ball.Projection(k, alpha, stop)
    world = ball.World.create(contact, ball.SemiImplicitEuler(0.1), gravity=0.0, policy=policy)
    start = world.start(-np.pad(np.asarray(depths, float), (0, max(0, 4 - len(depths)))))
    return ball.simulate(world, start, steps, history=history)


@given(st.floats(0.05, 0.9), st.floats(1e-6, 1e-2), st.floats(0.05, 1.0))
@example(0.25, 1e-2, 0.45)
@example(0.25, 1e-6, 0.45)
def test_iterations_follow_from_the_contraction(gain, tol, depth):
    run = solve([depth], ball.GlobalSum(tol, 1000), k=gain, alpha=1.0, history=True)
    count = int(run.iterations[0])
    exact = math.log(tol / depth) / math.log1p(-gain)
    # within rounding of a whole number of iterations either neighbor is right
    allowed = {max(0, math.ceil(exact + shift)) for shift in (-1e-9, 0, 1e-9)}
    assert count in allowed or (exact == int(exact) and count == exact + 1)
    made = run.history[0][np.isfinite(run.history[0])]
    assert len(made) == count + 1
    np.testing.assert_allclose(made[1:] / made[:-1], 1 - gain, rtol=1e-12)


def needed(tol: float, depth: float) -> int:
    """Iterations that each leave three quarters."""
    return math.ceil(math.log(tol / depth) / math.log(0.75))


@pytest.mark.parametrize(
    ("depths", "rule", "iterations", "ended"),
    [
        ([0.45], ball.GlobalSum(1e-9, 46), 46, "cap"),
        ([0.45], ball.GlobalSum(1e-6, 46), 46, "tolerance"),
        ([0.45, 0.0], ball.FixedCount(7), 7, "fixed"),
        # each ball by itself
        ([0.45, 1e-3, 0.0, 1e-7], ball.PerInstance(1e-4), [30, 9, 0, 0], "tolerance"),
        # starts above one threshold and runs below another
        ([0.9e-3], ball.HysteresisStop(SUM6, 1e-3), 0, "tolerance"),
        ([1.1e-3], ball.HysteresisStop(SUM6, 1e-3), needed(1e-6, 1.1e-3), "tolerance"),
        *(([depth], ball.Relative(1e-3), needed(1e-3, 1.0), "tolerance") for depth in (1e-8, 1.0, 1e5)),
        ([0.0], ball.Relative(1e-3), 0, "tolerance"),
    ],
)
def test_a_rule_ends_a_solve(depths, rule, iterations, ended):
    run = solve(depths, rule)
    np.testing.assert_array_equal(run.iterations[0], iterations)
    assert list(run.ended()) == [ended]
    if iterations == 46:
        # the margin says by how much
        np.testing.assert_allclose(run.margin[0], rule.tol - 0.45 * 0.75**46, rtol=1e-9)
        assert run.margin[0] > run.before[0] and run.before[0] < 0


def test_a_global_sum_couples_balls_and_a_rule_per_ball_does_not():
    near = 1e-4 / 0.75**10 * (1 - 1e-9)
    for rule, coupling in ((ball.GlobalSum, 1), (ball.Relative, 0), (ball.PerInstance, 0), (ball.Maximum, 0)):
        runs = [solve(depths, rule(1e-4)) for depths in ([near], [near, 1e-12], [near, 1e-8])]
        alone, joined, both = (int(np.ravel(run.iterations[0])[0]) for run in runs)
        assert (joined, both) == (alone, alone + coupling), rule


@pytest.mark.parametrize(
    "dtype", ["float16", pytest.param("bfloat16", marks=NIGHTLY), pytest.param("float32", marks=NIGHTLY)]
)
def test_nothing_to_solve_is_below_a_relative_tolerance_in_every_dtype(dtype):
    run = solve([0.0], ball.Relative(1e-2, 7), policy=RolePrecision(dtype, dtype, dtype, dtype, "float64"))
    assert (run.ended(), run.iterations[0]) == ({"tolerance": 1}, 0)


@pytest.mark.parametrize(
    ("dtype", "accumulate", "iterations"),
    [
        ("float32", "float32", 1), ("bfloat16", "bfloat16", 0), ("bfloat16", "float32", 1),
        pytest.param("float16", "float16", 0, marks=NIGHTLY),
        pytest.param("float16", "float32", 1, marks=NIGHTLY),
    ],
)  # fmt: skip
def test_a_fragile_sum_stops_before_the_first_iteration(dtype, accumulate, iterations):
    low = "bfloat16" if dtype == "float32" else dtype
    tol = oracles.DTYPES[low](1e-3)
    below = float(np.nextafter(tol, tol.dtype.type(0)))
    ulp = float(tol) - below
    policy = RolePrecision(dtype, dtype, accumulate, accumulate, "float32")
    rule = ball.GlobalSum(float(tol), 25, Sequential())
    run = solve([below] + [ulp / 8] * 8, rule, policy=policy, steps=4)
    np.testing.assert_array_equal(run.iterations, [iterations, 0, 0, 0])


EULER, LOCATED, SUM = ball.ExplicitEuler(0.1), ball.EventLocated(0.1), ball.GlobalSum(1e-3)


@pytest.mark.parametrize(
    ("contact", "scheme", "message"),
    [
        (ball.Penalty(0.0), EULER, "k = 0"),
        (ball.Penalty(float("nan")), EULER, "k = nan"),
        (ball.Penalty(1.0), ball.ExplicitEuler(0.0), "h = 0"),
        (ball.Penalty(1.0), ball.ExplicitEuler(-1.0), "h = -1"),
        (ball.Penalty(1.0, eps=-1.0, smooth=True), EULER, "eps = -1"),
        (ball.Penalty(1.0, damping=-1.0), EULER, "damping = -1"),
        (ball.Penalty(1.0), LOCATED, "needs an impact"),
        (ball.Impact(1.5), LOCATED, "restitution = 1.5"),
        (ball.Impact(0.5, -1.0), LOCATED, "rest_speed = -1"),
        (ball.Projection(0.5, 0.5, ball.GlobalSum(0.0)), EULER, "tol = 0"),
        (ball.Projection(0.5, 0.5, ball.GlobalSum(1e-3, 0)), EULER, "max_iter = 0"),
        # 2^32 would be counted as 0
        (ball.Projection(0.5, 0.5, ball.GlobalSum(1e-3, 2**32)), EULER, "max_iter = 4294967296"),
        (ball.Impact(0.5), ball.EventLocated(0.1, 2**32), "max_impacts = 4294967296"),
        (ball.Projection(0.5, 0.5, ball.HysteresisStop(SUM, 1e-4)), EULER, "below tol = "),
        (ball.Projection(4.0, 0.5, SUM), EULER, r"alpha \* k = 2.*only if alpha"),
    ],
)
def test_numbers_out_of_range_are_refused(contact, scheme, message):
    with pytest.raises(InputError, match=message):
        ball.World.create(contact, scheme)


def test_a_projection_that_overshoots_leaves_no_penetration():
    assert solve([0.1], SUM, k=3.9).iterations[0] == 1
