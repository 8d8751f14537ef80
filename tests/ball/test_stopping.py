"""Stopping rules: how many iterations, what ended them, and who feels whom."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ball import oracles
from hypothesis import given
from hypothesis import strategies as st

from mdnum import ball
from mdnum.errors import InputError
from mdnum.numerics.roles import RolePrecision
from mdnum.numerics.sums import Sequential


def solve(depths, stop, k=0.5, alpha=0.5, policy=None, steps=1, history=False):
    """Balls below the floor at rest and without gravity: the first step is the projection alone.

    Balls on the floor fill up the batch, so that a rule is compiled once.
    """
    contact = ball.Projection(k, alpha, stop)
    world = ball.World.create(contact, ball.SemiImplicitEuler(0.1), gravity=0.0, policy=policy)
    start = world.start(-np.pad(np.asarray(depths, float), (0, max(0, 4 - len(depths)))))
    return ball.simulate(world, start, steps, history=history)


@pytest.mark.parametrize(("tol", "iterations"), [(1e-2, 14), (1e-4, 30), (1e-6, 46)])
def test_known_iteration_counts(tol, iterations):
    assert solve([0.45], ball.GlobalSum(tol)).iterations[0] == iterations


@given(
    st.floats(0.05, 0.9),
    st.floats(1e-6, 1e-2),
    st.floats(0.05, 1.0),
)
def test_iterations_follow_from_the_contraction(gain, tol, depth):
    run = solve([depth], ball.GlobalSum(tol, 1000), k=gain, alpha=1.0, history=True)
    count = int(run.iterations[0])
    exact = math.log(tol / depth) / math.log1p(-gain)
    # within rounding of a whole number of iterations either neighbor is right
    allowed = {max(0, math.ceil(exact + shift)) for shift in (-1e-9, 0, 1e-9)}
    assert count in allowed or (exact == int(exact) and count == exact + 1)
    history = run.history[0]
    there = history[np.isfinite(history)]
    assert len(there) == count + 1
    np.testing.assert_allclose(there[1:] / there[:-1], 1 - gain, rtol=1e-12)


def test_the_cap_is_named_and_the_margin_says_by_how_much():
    run = solve([0.45], ball.GlobalSum(1e-9, 46))
    assert run.ended() == {"cap": 1}
    assert run.iterations[0] == 46
    np.testing.assert_allclose(run.margin[0], 1e-9 - 0.45 * 0.75**46, rtol=1e-12)
    met = solve([0.45], ball.GlobalSum(1e-6, 46))
    assert met.ended() == {"tolerance": 1}
    assert met.margin[0] > 0 > met.before[0]


def test_a_fixed_count_decides_nothing():
    run = solve([0.45, 0.0], ball.FixedCount(7))
    assert run.iterations[0] == 7
    assert run.ended() == {"fixed": 1}


def test_a_global_sum_couples_balls_and_a_rule_per_ball_does_not():
    near = 1e-4 / 0.75**10 * (1 - 1e-9)
    for rule, coupling in ((ball.GlobalSum, 1), (ball.Relative, 0), (ball.PerInstance, 0), (ball.Maximum, 0)):
        alone = solve([near], rule(1e-4))
        joined = solve([near, 1e-12], rule(1e-4))
        both = solve([near, 1e-8], rule(1e-4))
        counts = [int(np.ravel(run.iterations[0])[0]) for run in (alone, joined, both)]
        assert counts[2] - counts[0] == coupling, rule
        assert counts[1] == counts[0]


def test_each_ball_stops_by_itself():
    depths = np.array([0.45, 1e-3, 0.0, 1e-7])
    run = solve(depths, ball.PerInstance(1e-4))
    expected = [max(0, math.ceil(math.log(1e-4 / p) / math.log(0.75))) if p else 0 for p in depths]
    np.testing.assert_array_equal(run.iterations[0], expected)
    assert run.iterations.shape == (1, 4)


def test_hysteresis_starts_above_one_threshold_and_runs_below_another():
    rule = ball.HysteresisStop(ball.GlobalSum(1e-6), 1e-3)
    assert solve([0.9e-3], rule).iterations[0] == 0
    assert solve([1.1e-3], rule).iterations[0] == math.ceil(math.log(1e-6 / 1.1e-3) / math.log(0.75))


def test_relative_tolerance_scales():
    for depth in (1e-8, 1.0, 1e5):
        assert solve([depth], ball.Relative(1e-3)).iterations[0] == math.ceil(math.log(1e-3) / math.log(0.75))
    assert solve([0.0], ball.Relative(1e-3)).iterations[0] == 0


@pytest.mark.parametrize(
    "dtype", ["float16", *(pytest.param(x, marks=pytest.mark.nightly) for x in ("bfloat16", "float32"))]
)
def test_nothing_to_solve_is_below_a_relative_tolerance_in_every_dtype(dtype):
    run = solve([0.0], ball.Relative(1e-2, 7), policy=RolePrecision(dtype, dtype, dtype, dtype, "float64"))
    assert run.ended() == {"tolerance": 1}
    assert run.iterations[0] == 0


@pytest.mark.parametrize(("dtype", "accumulate", "iterations"), [
    ("float32", "float32", 1),
    ("bfloat16", "bfloat16", 0),
    ("bfloat16", "float32", 1),
    pytest.param("float16", "float16", 0, marks=pytest.mark.nightly),
    pytest.param("float16", "float32", 1, marks=pytest.mark.nightly),
])  # fmt: skip
def test_a_fragile_sum_stops_before_the_first_iteration(dtype, accumulate, iterations):
    low = "bfloat16" if dtype == "float32" else dtype
    kind = oracles.DTYPES[low]
    tol = kind(1e-3)
    below = np.nextafter(tol, kind(0)) if low == "float16" else kind(float(tol) - 2.0**-17)
    ulp = float(tol) - float(below)
    policy = RolePrecision(dtype, dtype, accumulate, accumulate, "float32")
    depths = np.array([float(below)] + [ulp / 8] * 8)
    run = solve(depths, ball.GlobalSum(float(tol), 25, Sequential()), policy=policy, steps=4)
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
        (ball.Projection(0.5, 0.5, ball.HysteresisStop(SUM, 1e-4)), EULER, "enter is the larger"),
        (ball.Projection(4.0, 0.5, SUM), EULER, r"alpha \* k = 2.*cannot converge"),
    ],
)
def test_numbers_out_of_range_are_refused(contact, scheme, message):
    with pytest.raises(InputError, match=message):
        ball.World.create(contact, scheme)


def test_a_projection_that_overshoots_leaves_no_penetration():
    assert solve([0.1], SUM, k=3.9).iterations[0] == 1
