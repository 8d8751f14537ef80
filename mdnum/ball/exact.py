"""The bouncing ball in closed form: its motion, and the derivative of it by every parameter.

A ball above a floor at height 0, with gravity g, starts at (y0, v0). It reaches the floor with speed
s = sqrt(v0² + 2 g y0) at t_1 = (v0 + s) / g. With restitution e, impact n has speed e^(n-1) s, and the time
between impacts n and n + 1 is 2 e^n s / g. So

    t_n = t_1 + (2 s / g) (e + e² + ... + e^(n-1)),   t_rest = t_1 + (2 s / g) e / (1 - e),

infinitely many impacts in a finite time (Zeno). On a spring y'' = -g - k y - c y' below the floor, and each
contact is a damped cosine. That is the differential equation that penalty contacts discretize; the ball with
restitution is not, not even in the limit of stiff springs, unless its restitution is 1.

Everything here is numpy in float64 on the host: it is what the programs of this package are measured against,
so it shares no code with them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from mdnum.errors import InputError

Times = float | Shaped[np.ndarray, "*times"]
Counts = int | float | Shaped[np.ndarray, "*counts"]

#: Terms of the series in 1 - e that stands in for the geometric sums' slope near e = 1; below m (1 - e) = 1
#: the first neglected one is under 1e-17 of the sum.
_TERMS = 20
#: Imaginary step of a derivative: its square is far below rounding.
_STEP = 1e-40
#: Contacts after which something is wrong: each damped one takes a share of the energy.
_MOST = 100_000


@dataclass(frozen=True)
class Known:
    """A quantity known in closed form, with its derivative with respect to every parameter.

    Attributes:
        value: shape of what was asked for (times or impact numbers).
        gradient: derivative by name of the parameter, each of that shape.
    """

    value: Float[np.ndarray, "..."]
    gradient: Mapping[str, Float[np.ndarray, "..."]]


def _known(value, gradient: Mapping[str, Any]) -> Known:
    value = np.asarray(value, np.float64)
    whole = {name: np.broadcast_to(np.asarray(d, np.float64), value.shape) for name, d in gradient.items()}
    return Known(value, whole)


class _Motion:
    """What both motions check of a start, and their height and velocity one by one."""

    y0: float
    v0: float
    gravity: float

    def _check(self, *, y0: float, v0: float, gravity: float):
        _positive("y0", y0, zero=True)
        _positive("v0", abs(v0), zero=True)
        _positive("gravity", gravity)
        if y0 == 0 and v0 == 0:
            raise InputError("the ball starts at rest on the floor", remedy="Give it a height or a velocity")

    def first_contact(self) -> Known:
        """Time at which the ball first reaches the floor, s."""
        return self._first_flight()[0]

    def _first_flight(self) -> tuple[Known, Known]:
        """Time and speed at which the ball first reaches height 0.

        Error: a few ulps each, for either sign of v0: (v0 + s) / g would cancel for a ball thrown down.
        """
        y0, v0, g = self.y0, self.v0, self.gravity
        s = float(np.hypot(v0, np.sqrt(2 * g * y0)))
        t = (v0 + s) / g if v0 >= 0 else 2 * y0 / (s - v0)
        time = {"y0": 1 / s, "v0": t / s, "gravity": -t * t / (2 * s)}
        return _known(t, time), _known(s, {"y0": g / s, "v0": v0 / s, "gravity": y0 / s})

    def state(self, t: Times) -> tuple[Known, Known]:
        """Height (m) and velocity (m/s) at time t (s)."""
        raise NotImplementedError

    def height(self, t: Times) -> Known:
        """Height at time t (s), m."""
        return self.state(t)[0]

    def velocity(self, t: Times) -> Known:
        """Velocity at time t (s), m/s; after the impact where t is the time of one."""
        return self.state(t)[1]


@dataclass(frozen=True)
class ExactImpact(_Motion):
    """The exact motion of a ball with restitution.

    Impacts are numbered from 1. At the time of an impact the state is the one after it.

    Attributes:
        y0: height at the start, m, at least 0.
        v0: velocity at the start, m/s, upwards.
        gravity: m/s², positive, acts downwards.
        restitution: speed after an impact over the speed before it, 0 to 1.

    Raises:
        InputError: a parameter out of range, or a ball that starts at rest on the floor.

    Error: values and derivatives are those of a program without cancellation: impact speeds and
    times within some ten ulps plus n ulps for the n-th power of e, whatever e is, also at 1 and next to it;
    height and velocity within that of the motion at a time some ulps earlier or later.
    """

    y0: float
    v0: float = 0.0
    gravity: float = 9.81
    restitution: float = 0.8

    NAMES = ("y0", "v0", "gravity", "restitution")

    def __post_init__(self):
        self._check(y0=self.y0, v0=self.v0, gravity=self.gravity)
        _positive("restitution", self.restitution, zero=True, most=1.0)

    def impact_speed(self, n: Counts) -> Known:
        """Speed with which impact n meets the floor, e^(n-1) s, m/s."""
        return self._rebound(_numbers(n) - 1)

    def impact_time(self, n: Counts) -> Known:
        """Time of impact n, s."""
        n, e = _numbers(n), self.restitution
        return self._after_first(e * _geometric(e, n - 1), _geometric_slope(e, n))

    def rest_time(self) -> Known:
        """Time after which the ball lies still, infinitely many impacts later, s.

        Raises:
            InputError: the restitution is 1.
        """
        e = self.restitution
        if e == 1:
            raise InputError(
                "a ball of restitution 1 never comes to rest",
                remedy="Choose a restitution below 1",
                where="restitution",
            )
        return self._after_first(np.asarray(e / (1 - e)), np.asarray(1 / (1 - e) ** 2))

    def bounces(self, t: Times) -> Float[np.ndarray, "*times"]:
        """Number of impacts up to and including time t (s); infinite once the ball lies still."""
        t = _later(t)
        first, speed = self._first_flight()
        t_1, e, scale = float(first.value), self.restitution, 2 * float(speed.value) / self.gravity
        if e == 0:
            # one impact, and the ball stays
            return np.where(t >= t_1, 1.0, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            if e == 1:
                n = np.floor((t - t_1) / scale) + 1
            else:
                left = float(self.rest_time().value) - t
                n = np.floor(np.log(left * (1 - e) / scale) / np.log(e))
                n = np.where(left > 0, n, np.inf)
        n = np.where(t < t_1, 0.0, np.maximum(n, 1.0))
        # the logarithm is right to some ulps; the impact times themselves have the last word
        finite = np.isfinite(n) & (n > 0)
        now = np.where(finite, n, 1.0)
        n = np.where(finite & (self.impact_time(now + 1).value <= t), now + 1, n)
        now = np.where(finite, n, 2.0)
        return np.where(finite & (self.impact_time(now).value > t) & (n > 1), n - 1, n)

    def state(self, t: Times) -> tuple[Known, Known]:
        """Height and velocity at time t (s); zero, with zero derivatives, once the ball lies still."""
        t = _later(t)
        n, g = self.bounces(t), self.gravity
        still = np.isinf(n) | ((n > 0) & (self.restitution == 0))
        flying = (n == 0) & ~still
        number = np.where(still | flying, 1.0, n)
        left, kick = self.impact_time(number), self._rebound(number)
        tau = t - left.value
        v = kick.value - g * tau
        y = tau * (kick.value - 0.5 * g * tau)
        zero = np.zeros_like(t)
        dy0 = {"y0": zero + 1, "v0": t, "gravity": -t * t / 2, "restitution": zero}
        dv0 = {"y0": zero, "v0": zero + 1, "gravity": -t, "restitution": zero}

        def choose(first, later):
            return np.where(still, 0.0, np.where(flying, first, later))

        dy, dv = {}, {}
        for name in self.NAMES:
            own = tau * float(name == "gravity")
            start, faster = left.gradient[name], kick.gradient[name]
            dy[name] = choose(dy0[name], faster * tau - v * start - own * tau / 2)
            dv[name] = choose(dv0[name], faster + g * start - own)
        height = np.maximum(choose(self.y0 + t * (self.v0 - 0.5 * g * t), y), 0.0)
        return _known(height, dy), _known(choose(self.v0 - g * t, v), dv)

    def _rebound(self, n: Counts) -> Known:
        """e^n s: the speed after impact n."""
        speed = self._first_flight()[1]
        s, power = float(speed.value), self.restitution**n
        gradient = {name: power * value for name, value in speed.gradient.items()}
        return _known(power * s, gradient | {"restitution": _power_slope(self.restitution, n) * s})

    def _after_first(self, between, slope) -> Known:
        """t_1 + (2 s / g) `between`, where `between` has the given slope in e."""
        first, speed = self._first_flight()
        s, g, v0 = float(speed.value), self.gravity, self.v0
        # by g: 2 (ds/dg) / g - 2 s / g², collected into terms of one sign
        scale = {"y0": 2 / s, "v0": 2 * v0 / (g * s), "gravity": -2 * (v0 * v0 + g * self.y0) / (s * g * g)}
        gradient = {name: first.gradient[name] + value * between for name, value in scale.items()}
        gradient["restitution"] = 2 * s / g * np.asarray(slope)
        return _known(first.value + 2 * s / g * between, gradient)


@dataclass(frozen=True)
class ExactPenalty(_Motion):
    """The exact motion of a ball on a penalty contact, with or without damping.

    Below the floor y'' = -g - k y - c y', as long as the ball is below it (so the damper may pull at the
    end). The end of a contact is closed without damping; with it, it is the root of one equation between the
    lowest point and the first crest after it. A ball whose crest stays below the floor has come to rest in
    it, g / k deep.

    Attributes:
        y0: height at the start, m, at least 0.
        v0: velocity at the start, m/s, upwards.
        gravity: m/s², positive, acts downwards.
        k: stiffness per mass, 1/s².
        damping: per mass, 1/s; not the critical 2 sqrt(k) exactly.

    Raises:
        InputError: a parameter out of range, or a ball that starts at rest on the floor.

    Error: some ten ulps per contact, in values and in derivatives.

    Source: derivatives by the complex step, in which nothing cancels (Squire & Trapp, SIAM Review 40 (1998)
    110).
    """

    y0: float
    v0: float = 0.0
    gravity: float = 9.81
    k: float = 1e4
    damping: float = 0.0

    NAMES = ("y0", "v0", "gravity", "k", "damping")

    def __post_init__(self):
        self._check(y0=self.y0, v0=self.v0, gravity=self.gravity)
        _positive("k", self.k)
        _positive("damping", self.damping, zero=True)
        if self.damping**2 == 4 * self.k:
            raise InputError(
                "critical damping has no such closed form", remedy="Change the damping by an ulp"
            )

    def state(self, t: Times) -> tuple[Known, Known]:
        """Height and velocity at time t (s); the height is negative in contact."""
        t = _later(t)
        values = {name: complex(getattr(self, name)) for name in self.NAMES}
        y, v = _bounced(values, t)
        dy, dv = {}, {}
        for name in self.NAMES:
            moved = _bounced(values | {name: values[name] + 1j * _STEP}, t)
            dy[name], dv[name] = (np.imag(x) / _STEP for x in moved)
        return _known(np.real(y), dy), _known(np.real(v), dv)


def _bounced(p: Mapping[str, complex], t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height and velocity on a penalty contact with complex parameters, at real times."""
    y, v = np.zeros(t.shape, complex), np.zeros(t.shape, complex)
    g = p["gravity"]
    # where the current flight began, and how
    begin, height, speed = 0j, p["y0"], p["v0"]
    for _ in range(_MOST):
        down = np.sqrt(speed * speed + 2 * g * height)
        lasting = (speed + down) / g if speed.real >= 0 else 2 * height / (down - speed)
        here = t >= begin.real
        tau = t[here] - begin
        y[here], v[here] = height + tau * (speed - 0.5 * g * tau), speed - g * tau
        begin = begin + lasting
        here = t >= begin.real
        if not np.any(here):
            break
        y[here], v[here] = _arc(p, down, t[here] - begin)
        lasting = _end(p, down)
        if lasting is None:
            break
        begin, height = begin + lasting, 0j
        speed = down if p["damping"] == 0 else _arc(p, down, lasting)[1]
        if not np.any(t >= begin.real):
            break
    else:
        raise InputError(f"more than {_MOST:,} contacts before the last time", remedy="Ask for earlier times")
    return y, v


def _arc(p: Mapping[str, complex], s: complex, tau):
    """Height and velocity a time tau into a contact entered with speed s."""
    k, half, deep = p["k"], p["damping"] / 2, p["gravity"] / p["k"]
    w = np.sqrt(k - half * half)
    fade, cosine, sine = np.exp(-half * tau), np.cos(w * tau), np.sin(w * tau) / w
    # exp(-half tau) cos(w tau) - 1 without the cancellation of short times
    dip = np.expm1(-half * tau) * cosine - 2 * np.sin(w * tau / 2) ** 2
    y = deep * dip + fade * (half * deep - s) * sine
    v = fade * (-s * cosine + (half * s - p["gravity"]) * sine)
    return y, v


def _end(p: Mapping[str, complex], s: complex) -> complex | None:
    """How long a contact entered with speed s lasts; None for ever."""
    half = p["damping"].real / 2
    if half * half > p["k"].real:
        return None
    w = np.sqrt(p["k"].real - half * half)
    # the velocity vanishes first at the lowest point, then half a turn later at the crest
    low = float(np.arctan2(s.real * w, half * s.real - p["gravity"].real) / w)
    if half == 0:
        tau = complex(2 * low)
    else:
        high = low + np.pi / w
        if _arc(p, s, high)[0].real <= 0:
            return None
        while low < (middle := 0.5 * (low + high)) < high:
            low, high = (middle, high) if _arc(p, s, middle)[0].real < 0 else (low, middle)
        tau = complex(high)
    # Newton in complex numbers takes the derivative along, exact after the first step
    for _ in range(2):
        y, v = _arc(p, s, tau)
        tau = tau - y / v
    return tau


def _positive(name: str, value: float, *, zero: bool = False, most: float = np.inf) -> None:
    value = float(value)
    if not np.isfinite(value) or value < 0 or (value == 0 and not zero) or value > most:
        low = "at least 0" if zero else "above 0"
        high = f" and at most {most:g}" if np.isfinite(most) else ""
        raise InputError(f"{name} is {value!r}", remedy=f"Choose a finite value {low}{high}", where=name)


def _numbers(n: Counts, least: int = 1) -> Float[np.ndarray, "*counts"]:
    n = np.asarray(n, np.float64)
    if np.any(n < least) or np.any(n != np.floor(n)) or np.any(np.isinf(n)):
        raise InputError(f"impact number {n!r}", remedy=f"Count in whole numbers from {least}")
    return n


def _later(t: Times) -> Float[np.ndarray, "*times"]:
    t = np.asarray(t, np.float64)
    if not np.all(t >= 0):
        raise InputError("a time before the start", remedy="Ask for times of at least 0")
    return t


def _power_slope(e: float, n):
    """n e^(n-1), zero for n = 0."""
    return np.where(n > 0, n * e ** np.maximum(n - 1, 0.0), 0.0)


def _geometric(e: float, m):
    """1 + e + ... + e^(m-1)."""
    if e == 1:
        return m
    if e == 0:
        return np.where(m > 0, 1.0, 0.0)
    # 1 - e is exact from e = 1/2 on, and the exponential is near 1 only where the logarithm is small
    return -np.expm1(m * np.log(e)) / (1 - e)


def _geometric_slope(e: float, m):
    """1 + 2 e + ... + (m-1) e^(m-2): the derivative of the sum above.

    (G - m e^(m-1)) / (1 - e) loses everything where m (1 - e) is small; there it is a short alternating
    series in 1 - e with the terms j binom(m, j + 1) (e - 1)^(j-1).
    """
    d = 1 - e
    near = m * d < 1
    few = np.where(near, m, 0.0)
    term, series = few * (few - 1) / 2, 0.0
    for j in range(1, _TERMS):
        series = series + j * term
        term = -term * d * (few - j - 1) / (j + 2)
    many = np.where(near, 2.0, m)
    direct = (_geometric(e, many) - _power_slope(e, many)) / d if d else 0.0
    return np.where(near, series, direct)
