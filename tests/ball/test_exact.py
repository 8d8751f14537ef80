"""The closed forms against a ball that mpmath bounces one contact at a time, in 50 digits, and a program that
locates its impacts against them."""

from __future__ import annotations

import itertools

import mpmath
import numpy as np
import pytest
from mpmath import mp, mpf

from mdnum.ball import EventLocated, ExactImpact, ExactPenalty, Impact, World, simulate
from mdnum.errors import InputError

EPS = 2.0**-52
BALLS = [
    (1.0, 0.0, 9.81, 0.8),
    (0.3, -2.5, 9.81, 0.55),
    (2.0, 3.0, 1.62, 0.95),
    (0.0, 4.0, 9.81, 0.7),
    (1e-6, -30.0, 9.81, 0.9),
    (1.0, 0.5, 9.81, 1.0),
    (1.0, 0.5, 9.81, 1 - 2.0**-40),
]
#: Where the sums of powers cancel most.
NEAR_ONE = [((1.0, 0.5, 9.81, e), 300) for e in (0.999, 1 - 1e-9, 1 - 2.0**-50)]
NAMES = ("y0", "v0", "gravity", "restitution")


@pytest.fixture(autouse=True)
def fifty_digits():
    with mpmath.workdps(50):
        yield


def bounce(y0, v0, g, e, impacts):
    """Times and speeds of the impacts, one after another."""
    speed = mp.sqrt(v0 * v0 + 2 * g * y0)
    time = (v0 + speed) / g
    found = [(time, speed)]
    for _ in range(impacts - 1):
        speed = e * speed
        time = time + 2 * speed / g
        found.append((time, speed))
    return found


def fly(y0, v0, g, e, t, impacts):
    """Height and velocity at t, which lies after exactly this many impacts."""
    if impacts == 0:
        return y0 + v0 * t - g * t * t / 2, v0 - g * t
    time, speed = bounce(y0, v0, g, e, impacts)[-1]
    tau = t - time
    return e * speed * tau - g * tau * tau / 2, e * speed - g * tau


def slopes(function, ball):
    """Derivative with respect to every parameter by mpmath's differences."""
    exact = [mpf(x) for x in ball]
    return [
        mpmath.diff(lambda x, k=k: function(*exact[:k], x, *exact[k + 1 :]), one)
        for k, one in enumerate(exact)
    ]


def close(found, exact, ulps, scale=0.0):
    """Within so many ulps of the exact value, or of a scale where the value itself cancels."""
    return abs(mpf(float(found)) - exact) <= ulps * EPS * max(abs(exact), mpf(scale))


@pytest.mark.parametrize(("ball", "n"), [*itertools.product(BALLS, [1, 2, 3, 7, 40]), *NEAR_ONE])
def test_impacts_with_their_derivatives(ball, n):
    exact = ExactImpact(*ball)
    for which, found in enumerate((exact.impact_time(n), exact.impact_speed(n))):

        def function(*p, which=which):
            return bounce(*p, n)[-1][which]

        assert close(found.value, function(*map(mpf, ball)), 10 + 2 * n), which
        for name, slope in zip(NAMES, slopes(function, ball), strict=True):
            assert close(found.gradient[name], slope, 20 + 4 * n, scale=1e-40), (which, name)


@pytest.mark.parametrize("ball", BALLS[:5])
def test_the_time_to_rest_is_the_limit_of_the_impact_times(ball):
    found = ExactImpact(*ball).rest_time()

    def limit(y0, v0, g, e):
        speed = mp.sqrt(v0 * v0 + 2 * g * y0)
        return (v0 + speed) / g + mpmath.nsum(lambda n: 2 * speed * e**n / g, [1, mpmath.inf])

    assert close(found.value, limit(*map(mpf, ball)), 20)
    # by differences of a longer sum than double precision can see
    long = slopes(lambda *p: bounce(*p, 1500)[-1][0], ball)
    for name, slope in zip(NAMES, long, strict=True):
        assert close(found.gradient[name], slope, 40), name


@pytest.mark.parametrize("ball", BALLS)
def test_the_state_between_impacts_with_its_derivatives(ball):
    exact = ExactImpact(*ball)
    times = bounce(*map(mpf, ball), 12)
    starts = [mpf(0)] + [t for t, _ in times]
    for impacts, (left, right) in enumerate(itertools.pairwise(starts)):
        for part in (0.13, 0.5, 0.91):
            t = float(left + part * (right - left))
            if not left < t < right:  # a flight shorter than an ulp of its time
                continue
            assert exact.bounces(t) == impacts
            y, v = exact.state(t)
            for found, which, most in ((y, 0, abs(float(v.value))), (v, 1, ball[2])):

                def function(*p, t=t, n=impacts, which=which):
                    return fly(*p, mpf(t), n)[which]

                # the promise: the motion at a time some ulps away, and some ulps of the parts summed
                scale = most * t + abs(float(found.value)) + float(times[0][1]) * (t if which == 0 else 1)
                assert close(found.value, function(*map(mpf, ball)), 8 + 2 * impacts, scale), (t, which)
                for name, slope in zip(NAMES, slopes(function, ball), strict=True):
                    size = scale / max(abs(mpf(ball[NAMES.index(name)])), mpf("1e-3")) * (1 + impacts)
                    bound = max(abs(slope), size if impacts else 0)
                    assert close(found.gradient[name], slope, 100 + 10 * impacts, bound), (t, which, name)


def test_the_state_is_the_one_after_the_impact_and_rest_is_rest():
    exact = ExactImpact(1.0, 0.0, 8.0, 0.5)
    # s = 4, t_1 = 1/2, t_2 = 1, t_3 = 5/4, at rest at 3/2: all exact in binary
    t = np.array([0.0, 0.5, 1.0, 1.25, 1.375, 1.5, 2.0])
    assert exact.bounces(t).tolist() == [0, 1, 2, 3, 4, np.inf, np.inf]
    y, v = exact.state(t)
    assert y.value.tolist() == [1, 0, 0, 0, 0, 0, 0]
    assert v.value.tolist() == [0, 2, 1, 0.5, 0.25, 0, 0]
    assert float(exact.rest_time().value) == 1.5
    for gradient in (y.gradient, v.gradient):
        for name in NAMES:
            assert gradient[name][-2:].tolist() == [0, 0]
    # without restitution the first impact is the last
    exact = ExactImpact(1.0, 0.0, 8.0, 0.0)
    assert exact.bounces(np.array([0.25, 0.5, 3.0])).tolist() == [0, 1, 1]
    assert exact.height(np.array([0.25, 0.5, 3.0])).value.tolist() == [0.75, 0, 0]
    assert float(exact.rest_time().value) == 0.5
    assert float(exact.rest_time().gradient["restitution"]) == 1.0


def test_no_time_is_lost_on_the_way_to_rest():
    """Whatever the number of impacts, the height stays within the flight and the count grows."""
    exact = ExactImpact(1.0, 0.0, 9.81, 0.8)
    rest = float(exact.rest_time().value)
    t = np.sort(rest * (1 - np.logspace(0, -15.5, 4001)))
    n = exact.bounces(t)
    assert np.all(np.diff(n) >= 0) and n[-1] > 100
    assert np.all(exact.impact_time(np.maximum(n, 1)).value[n > 0] <= t[n > 0])
    assert np.all(exact.impact_time(n + 1).value >= t)
    y = exact.height(t).value
    assert np.all(y >= 0)
    # the apex between impacts n and n + 1 is (e^n s)² / (2 g)
    apex = exact.impact_speed(n + 1).value ** 2 / (2 * 9.81)
    assert np.all(y <= apex + 4 * EPS * rest * exact.impact_speed(n + 1).value)


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        (lambda: ExactImpact(y0=-1.0), "y0 = -1"),
        (lambda: ExactImpact(y0=0.0), "at rest"),
        (lambda: ExactImpact(y0=1.0, restitution=1.1), "restitution = 1.1"),
        (lambda: ExactImpact(y0=1.0, gravity=0.0), "gravity = 0"),
        (lambda: ExactImpact(y0=np.nan), "y0 = nan"),
        (lambda: ExactImpact(1.0, restitution=1.0).rest_time(), "never comes to rest"),
        (lambda: ExactImpact(1.0).impact_time(0), "numbered by integers from 1"),
        (lambda: ExactImpact(1.0).height(-0.1), "time is negative"),
        (lambda: ExactPenalty(1.0, k=-1.0), "k = -1"),
        (lambda: ExactPenalty(1.0, k=25.0, damping=10.0), "critical damping"),
        (lambda: ExactPenalty(1.0, damping=-1.0), "damping = -1"),
    ],
)
def test_what_has_no_exact_motion_is_refused(motion, message):
    with pytest.raises(InputError, match=message):
        motion()


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


# The spring floor

SPRINGS = [
    (1.0, 0.0, 9.81, 1e4, 0.0), (0.3, -2.5, 9.81, 50.0, 0.0), (2.0, 3.0, 1.62, 1.0, 0.0),
    (0.01, 0.0, 9.81, 10.0, 0.0), (0.7, -0.4, 9.81, 80.0, 2.5), (0.2, 0.0, 9.81, 400.0, 12.0),
]  # fmt: skip


def spring(y0, v0, g, k, c, t):
    """Height and velocity at t: flights and contacts in turn, each contact's end by mpmath's root finder."""
    y, v, now = y0, v0, mpf(0)
    w = mp.sqrt(k - c * c / 4)

    def contact(v, tau):
        # a solution of y'' = -g - k y - c y' from height 0
        a, fade = g / k, mp.exp(-c * tau / 2)
        b = (v + c * a / 2) / w
        height = fade * (a * mp.cos(w * tau) + b * mp.sin(w * tau)) - a
        slope = fade * (b * w * mp.cos(w * tau) - a * w * mp.sin(w * tau)) - c / 2 * (height + a)
        return height, slope

    while True:
        lasting = (v + mp.sqrt(v * v + 2 * g * y)) / g
        if now + lasting >= t:
            tau = t - now
            return y + v * tau - g * tau * tau / 2, v - g * tau
        now, y, v = now + lasting, mpf(0), v - g * lasting
        # from the lowest point on the height rises for half a turn
        low = mp.findroot(lambda x, v=v: contact(v, x)[1], mp.atan2(-v * w, -g - c * v / 2) / w)
        if contact(v, low + mp.pi / w)[0] <= 0:
            return contact(v, t - now)
        ends = (low, low + mp.pi / w)
        lasting = mp.findroot(lambda x, v=v: contact(v, x)[0], ends, solver="anderson", tol=1e-70)
        if now + lasting >= t:
            return contact(v, t - now)
        now, v = now + lasting, contact(v, lasting)[1]


@pytest.mark.parametrize("ball", SPRINGS)
def test_the_spring_floor_with_its_derivatives(ball):
    exact = ExactPenalty(*ball)
    for t in np.array([0.4, 1.02, 1.3, 1.9, 2.7, 4.1]) * float(exact.first_contact().value):
        y, v = exact.state(t)
        for found, which in ((y, 0), (v, 1)):

            def function(*p, t=t, which=which):
                return spring(*p, mpf(t))[which]

            size = 1 + abs(float(found.value))
            assert close(found.value, function(*map(mpf, ball)), 400, size), (t, which)
            for name, slope in zip(exact.NAMES, slopes(function, ball), strict=True):
                scale = max(1e-3, *(abs(float(g)) for g in (y.gradient[name], v.gradient[name])))
                assert close(found.gradient[name], slope, 8000, scale), (t, which, name)


def test_the_ball_comes_to_rest_in_the_floor():
    y, v = ExactPenalty(1.0, 0.0, 9.81, 400.0, 4.0).state(np.array([20.0]))
    assert float(y.value[0]) == pytest.approx(-9.81 / 400, rel=1e-12)
    assert abs(float(v.value[0])) < 1e-12
    assert float(y.gradient["gravity"][0]) == pytest.approx(-1 / 400, rel=1e-9)
    # overdamped: one contact, for good
    assert np.all(ExactPenalty(1.0, 0.0, 9.81, 100.0, 50.0).height(np.array([0.5, 3.0])).value < 0)
