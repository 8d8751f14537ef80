"""The damped spring floor against the undamped one, against mpmath's solver, and against rollouts."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from mpmath import mpf

from mdnum.ball.contacts import Penalty
from mdnum.ball.convergence import converge
from mdnum.ball.exact import ExactPenalty
from mdnum.ball.gradients import EventAware
from mdnum.ball.integrators import SemiImplicitEuler
from mdnum.ball.problem import Problem
from mdnum.ball.world import World
from mdnum.errors import InputError

BALL = (0.7, -0.4, 9.81, 80.0, 2.5)


def test_without_damping_it_is_the_undamped_motion():
    t = np.linspace(0, 3, 301)
    damped, plain = ExactDamped(0.7, 0.3, 9.81, 200.0).state(t), ExactPenalty(0.7, 0.3, 9.81, 200.0).state(t)
    for one, other in zip(damped, plain, strict=True):
        np.testing.assert_allclose(one.value, other.value, atol=1e-12)
        for name in ("y0", "v0", "gravity", "k"):
            np.testing.assert_allclose(one.gradient[name], other.gradient[name], rtol=1e-9, atol=1e-11)


def integrate(y0, v0, g, k, c, t):
    """Height and velocity by Taylor series of the equation itself, contact ends by mpmath's root finder."""
    y, v, now = mpf(y0), mpf(v0), mpf(0)
    while True:
        lasting = (v + mpmath.sqrt(v * v + 2 * g * y)) / g
        if now + lasting >= t:
            tau = t - now
            return y + v * tau - g * tau * tau / 2, v - g * tau
        now, y, v = now + lasting, mpf(0), v - g * lasting
        step = mpf(1) / 64
        while True:
            after = taylor(y, v, g, k, c, step)
            if now + step >= t and taylor(y, v, g, k, c, t - now)[0] < 0:
                return taylor(y, v, g, k, c, t - now)
            if after[0] >= 0:
                tau = mpmath.findroot(
                    lambda x, y=y, v=v: taylor(y, v, g, k, c, x)[0], (step / 1000, step), solver="anderson"
                )
                now, v, y = now + tau, taylor(y, v, g, k, c, tau)[1], mpf(0)
                break
            now, (y, v) = now + step, after


def taylor(y, v, g, k, c, step):
    """One step of y'' = -g - k y - c y' by 30 terms of its Taylor series."""
    height, speed = y, v
    power = mpf(1)
    before, now = v, -g - k * y - c * v
    for n in range(1, 30):
        power = power * step / n
        height += before * power
        speed += now * power
        before, now = now, -k * before - c * now
    return height, speed


@pytest.mark.parametrize("t", [0.2, 0.55, 0.9, 1.6, 2.2])
def test_the_motion_is_that_of_the_equation(t):
    with mpmath.workdps(30):
        y, v = ExactDamped(*BALL).state(t)
        exact = integrate(*map(mpf, BALL), mpf(t))
        assert abs(float(y.value) - exact[0]) < 1e-13
        assert abs(float(v.value) - exact[1]) < 1e-12
        for k, name in enumerate(ExactDamped.NAMES):
            for found, which in ((y, 0), (v, 1)):
                moved = [
                    integrate(*[mpf(x) + sign * mpf("1e-9") * (i == k) for i, x in enumerate(BALL)], mpf(t))
                    for sign in (1, -1)
                ]
                slope = (moved[0][which] - moved[1][which]) / mpf("2e-9")
                assert abs(float(found.gradient[name]) - slope) < 1e-10 * (1 + abs(slope)), name


def test_the_ball_comes_to_rest_in_the_floor():
    exact = ExactDamped(1.0, 0.0, 9.81, 400.0, 4.0)
    y, v = exact.state(np.array([20.0]))
    assert float(y.value[0]) == pytest.approx(-9.81 / 400, rel=1e-12)
    assert abs(float(v.value[0])) < 1e-12
    assert float(y.gradient["gravity"][0]) == pytest.approx(-1 / 400, rel=1e-9)
    # overdamped: one contact, for good
    y, v = ExactDamped(1.0, 0.0, 9.81, 100.0, 50.0).state(np.array([0.5, 3.0]))
    assert np.all(y.value < 0)


def test_the_energy_of_a_contact_decays_as_the_envelope():
    """Far from gravity's reach the speeds before and after have the ratio of a damped half turn."""
    k, c = 1e8, 2e3
    exact = ExactDamped(1.0, 0.0, 9.81, k, c)
    first, w = np.sqrt(2 / 9.81), np.sqrt(k - c * c / 4)
    before, after = exact.velocity(np.array([first, first + 1.1 * np.pi / w])).value
    # with the damper pulling to the end the contact lasts half a turn
    assert -after / before == pytest.approx(np.exp(-c / 2 * np.pi / w), rel=1e-3)


def test_rollouts_approach_it_and_their_derivatives_do_not():
    """The damper makes the force jump at the floor: order 1 in the value, no order in the derivative.

    This is the ball's twin of a force that jumps at a cutoff; with the saltation term of the jump the
    derivative is of order 1 again.
    """
    k, c, time, counts = 100.0, 3.0, 1.7, (400, 1600, 6400)
    world = World.create(Penalty(k, c), SemiImplicitEuler(0.01))
    found = converge(world, lambda y: ExactDamped(y, k=k, damping=c), np.linspace(0.8, 1.2, 16), time, counts)
    assert abs(found.order() - 1) < 0.2
    assert abs(found.order("slope")) < 0.1
    assert np.all(found.slope > 0.05)
    known = float(ExactDamped(1.0, k=k, damping=c).height(time).gradient["y0"])
    off = []
    for count in counts[::2]:
        problem = Problem(world.with_values({"h": time / count}), 1.0, 0.0, count)
        off.append(abs(EventAware()(problem, ["y0"]).gradient["y0"] - known))
    assert off[1] < off[0] / 4
    assert off[1] < 0.01


def test_refusals():
    with pytest.raises(InputError, match="critical damping"):
        ExactDamped(1.0, k=25.0, damping=10.0)
    with pytest.raises(InputError, match="damping is -1"):
        ExactDamped(1.0, damping=-1.0)
