"""The exact ball against plain rationals."""

from __future__ import annotations

from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np
import pytest
from ball import oracles
from hypothesis import given
from hypothesis import strategies as st

from mdnum.ball import (
    BallVerlet,
    EventLocated,
    ExplicitEuler,
    GlobalSum,
    Impact,
    ImplicitMidpoint,
    Penalty,
    PerInstance,
    Projection,
    SemiImplicitEuler,
    World,
    simulate,
)
from mdnum.ball.rollout import cross_decisions
from mdnum.errors import InputError
from mdnum.forks.exact import ball as exact
from mdnum.forks.exact.ball import ball_history

SCHEMES = {
    "explicit-euler": ExplicitEuler,
    "semi-implicit-euler": SemiImplicitEuler,
    "velocity-verlet": BallVerlet,
}
H, G, START = 0.01, 9.81, 0.71
#: Shares of a number that are far below the last digit of a float, and none.
TINY = (Decimal(0), Decimal("1e-900"), Decimal("-1e-900"))


@given(
    st.floats(-1e6, 1e6).filter(lambda x: x == 0 or abs(x) > 1e-100),
    st.floats(-1e6, 1e6).filter(lambda x: x == 0 or abs(x) > 1e-100),
    st.floats(-1e6, 1e6).filter(lambda x: x == 0 or abs(x) > 1e-100),
)
def test_exact_numbers(a, b, c):
    x, y, z = (exact.exactly(value) for value in (a, b, c))
    p, q, r = (Fraction(value) for value in (a, b, c))
    with localcontext(exact._EXACT):
        assert Fraction(x * y - z + -x) == p * q - r - p
        assert (x < y) == (p < q) and (x <= y) == (p <= q) and (x * y < z) == (p * q < r)
        assert exact.nearest(x) == a and exact.nearest(x * y) == float(p * q)
        # halfway between two floats, and a little beyond
        middle = (x + exact.exactly(np.nextafter(a, np.inf))) * exact.HALF
        assert [exact.nearest(middle + y * step) for step in TINY] == [
            float(Fraction(middle) + q * Fraction(step)) for step in TINY
        ]


def test_a_number_that_is_none():
    with pytest.raises(ValueError, match="not a number"):
        exact.exactly(float("nan"))


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(
    ("contact", "oracle", "numbers", "steps"),
    [
        (Penalty(900.0, 3.0), oracles.penalty, (900.0, 3.0), 60),
        (Impact(0.8, 0.5), oracles.impact, (0.8, 0.5), 250),
    ],
)
def test_a_step_against_fractions(contact, oracle, numbers, steps, scheme):
    world = World.create(contact, SCHEMES[scheme](H), G)
    history = ball_history(world, world.start(START), steps)
    rows, decided = oracle(scheme, *oracles.rational(START, 0.0, H, G, *numbers), steps)
    np.testing.assert_array_equal(history.contact[:, 0], decided)
    np.testing.assert_array_equal(history.y[:, 0], [float(y) for y, _ in rows])
    np.testing.assert_array_equal(history.v[:, 0], [float(v) for _, v in rows])
    assert 5 <= sum(decided) < steps


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_projection_against_fractions(scheme):
    alpha, k, e, tol, cap, steps = 0.5, 0.5, 0.8, 1e-4, 100, 120
    world = World.create(Projection(k, alpha, GlobalSum(tol, cap), e), SCHEMES[scheme](H), G)
    starts = [0.3, 0.41, 0.52]
    history = ball_history(world, world.start(starts), steps)
    rows, decided, counts = oracles.projection(
        scheme,
        oracles.rational(*starts),
        oracles.rational(0.0, 0.0, 0.0),
        *oracles.rational(H, G, alpha, k, e, tol),
        cap,
        steps,
    )
    np.testing.assert_array_equal(history.contact, decided)
    np.testing.assert_array_equal(history.iterations, counts)
    np.testing.assert_array_equal(history.y, [[float(c) for c in y] for y, _ in rows])
    assert max(counts) > 5
    # a rule for each ball makes no ball iterate for another
    alone = World.create(Projection(k, alpha, PerInstance(tol, cap), e), SCHEMES[scheme](H), G)
    own = ball_history(alone, alone.start(starts), steps)
    assert np.all(own.iterations[~own.contact] == 0) and history.iterations.shape == (steps,)


def test_control_and_hysteresis_as_the_program_has_them():
    """Short enough for float64 to decide as exact arithmetic does."""
    control = np.linspace(-3.0, 3.0, 40)
    world = World.create(Penalty(900.0, 2.0), BallVerlet(H), G, control, hysteresis=0.02)
    start = world.start([0.2, 0.35])
    history, run = ball_history(world, start, 80), simulate(world, start, 80)
    np.testing.assert_array_equal(history.contact, run.contact)
    np.testing.assert_allclose(history.y, run.y, atol=1e-13)
    assert np.any(history.contact & (history.height > 0))


def test_a_stop_that_differs_is_dated():
    world = World.create(Projection(0.5, 0.5, GlobalSum(1e-4, 100)), SemiImplicitEuler(0.01))
    start = world.start([1.0, 1.1, 1.3])
    history, run = ball_history(world, start, 60), simulate(world, start, 60)
    assert not cross_decisions(history, run)
    # planted: one iteration more in one step
    counts = run.iterations.copy()
    counts[50] += 1
    object.__setattr__(run, "iterations", counts)
    (flip,) = cross_decisions(history, run)
    assert (flip.step, flip.channel) == (51, "stop") and flip.b == flip.a + 1 == int(counts[50])


@pytest.mark.parametrize(
    ("contact", "scheme", "message"),
    [
        (Impact(), EventLocated(0.01), "exact arithmetic"),
        (Penalty(900.0), ImplicitMidpoint(0.01), "ImplicitMidpoint"),
        (Penalty(900.0, eps=0.01, smooth=True), SemiImplicitEuler(0.01), "without smoothing"),
    ],
)
def test_what_is_not_rational_is_refused(contact, scheme, message):
    world = World.create(contact, scheme)
    with pytest.raises(InputError, match=message):
        ball_history(world, world.start(1.0), 10)
