"""The bouncing ball in closed form: impacts, apexes, the time to rest, and the derivative of each.

A ball above a floor at height 0, with gravity g and restitution e, starts at (y0, v0). It reaches the floor
with speed s = sqrt(v0² + 2 g y0) at t_1 = (v0 + s) / g; impact n has speed e^(n-1) s, and the time between
impacts n and n + 1 is 2 e^n s / g. So

    t_n = t_1 + (2 s / g) (e + e² + ... + e^(n-1)),   t_rest = t_1 + (2 s / g) e / (1 - e),

infinitely many impacts in a finite time (Zeno). Everything here is numpy in float64 on the host: it is what
the programs of this package are measured against, so it shares no code with them.
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


@dataclass(frozen=True)
class Known:
    """A quantity known in closed form, with its derivative with respect to every parameter.

    Attributes:
        value: shape of what was asked for (times or impact numbers).
        gradient: derivative by name of the parameter, each of that shape.
    """

    value: Float[np.ndarray, "..."]
    gradient: Mapping[str, Float[np.ndarray, "..."]]


def positive(name: str, value: float, *, zero: bool = False, most: float = np.inf) -> float:
    """A parameter as a float.

    Raises:
        InputError: it is not finite, not positive (or, with zero, negative), or above `most`.
    """
    value = float(value)
    if not np.isfinite(value) or value < 0 or (value == 0 and not zero) or value > most:
        low = "at least 0" if zero else "above 0"
        high = f" and at most {most:g}" if np.isfinite(most) else ""
        raise InputError(f"{name} is {value!r}", remedy=f"Choose a finite value {low}{high}", where=name)
    return value


def first_flight(y0: float, v0: float, gravity: float) -> tuple[Known, Known]:
    """Time and speed at which a ball that starts at y0 >= 0 (m) with v0 (m/s) first reaches height 0.

    Error: a few ulps each, for either sign of v0: (v0 + s) / g would cancel for a ball thrown down.
    """
    s = float(np.hypot(v0, np.sqrt(2 * gravity * y0)))
    t = (v0 + s) / gravity if v0 >= 0 else 2 * y0 / (s - v0)
    time = {"y0": 1 / s, "v0": t / s, "gravity": -t * t / (2 * s)}
    speed = {"y0": gravity / s, "v0": v0 / s, "gravity": y0 / s}
    return known(t, time), known(s, speed)


def in_flight(tau, rate, v, gravity, start: Mapping[str, Any], kick: Mapping[str, Any]):
    """Derivatives of height and velocity a time tau (s) after leaving height 0.

    Args:
        rate: names of the parameters.
        v: velocity now, m/s.
        start, kick: derivatives of the time of leaving and of the speed of leaving.
    """
    dy, dv = {}, {}
    for name in rate:
        own = float(name == "gravity")
        dy[name] = kick[name] * tau - v * start[name] - own * tau * tau / 2
        dv[name] = kick[name] + gravity * start[name] - own * tau
    return dy, dv


@dataclass(frozen=True)
class ExactImpact:
    """The exact motion of a ball with restitution.

    Impacts are numbered from 1. At the time of an impact the state is the one after it.

    Attributes:
        y0: height at the start, m, at least 0.
        v0: velocity at the start, m/s, upwards.
        gravity: m/s², positive, acts downwards.
        restitution: speed after an impact over the speed before it, 0 to 1.

    Raises:
        InputError: a parameter out of range, or a ball that starts at rest on the floor.

    Error: values and derivatives are those of a program without cancellation: impact speeds, times and
    apexes within some ten ulps plus n ulps for the n-th power of e, whatever e is, also at 1 and next to it;
    height and velocity within that of the motion at a time some ulps earlier or later.
    """

    y0: float
    v0: float = 0.0
    gravity: float = 9.81
    restitution: float = 0.8

    NAMES = ("y0", "v0", "gravity", "restitution")

    def __post_init__(self):
        positive("y0", self.y0, zero=True)
        positive("v0", abs(self.v0), zero=True)
        positive("gravity", self.gravity)
        positive("restitution", self.restitution, zero=True, most=1.0)
        if self.y0 == 0 and self.v0 == 0:
            raise InputError(
                "the ball starts at rest on the floor and has no impact",
                remedy="Give it a height or a velocity",
            )

    def impact_speed(self, n: Counts) -> Known:
        """Speed with which impact n meets the floor, e^(n-1) s, m/s."""
        n = self._numbers(n)
        return self._rebound(n - 1)

    def impact_time(self, n: Counts) -> Known:
        """Time of impact n, s."""
        n = self._numbers(n)
        between = self.restitution * _geometric(self.restitution, n - 1)
        return self._after_first(between, _geometric_slope(self.restitution, n))

    def apex(self, n: Counts) -> Known:
        """Greatest height between impacts n and n + 1, e^(2 n) s² / (2 g), m.

        n = 0 is the apex before the first impact; for a ball thrown down that is where it would have come
        from.
        """
        n = self._numbers(n, least=0)
        e, g = self.restitution, self.gravity
        share = e ** (2 * n)
        top = self.y0 + self.v0 * self.v0 / (2 * g)
        return known(
            share * top,
            {
                "y0": share,
                "v0": share * (self.v0 / g),
                "gravity": -share * (self.v0 * self.v0 / (2 * g * g)),
                "restitution": _power_slope(e, 2 * n) * top,
            },
        )

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
        t = later(t)
        first, speed = first_flight(self.y0, self.v0, self.gravity)
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

    def height(self, t: Times) -> Known:
        """Height at time t (s), m, never below 0."""
        return self.state(t)[0]

    def velocity(self, t: Times) -> Known:
        """Velocity at time t (s), m/s; after the impact where t is the time of one."""
        return self.state(t)[1]

    def state(self, t: Times) -> tuple[Known, Known]:
        """Height and velocity at time t (s); zero, with zero derivatives, once the ball lies still."""
        t = later(t)
        n, g = self.bounces(t), self.gravity
        still = np.isinf(n) | ((n > 0) & (self.restitution == 0))
        flying = (n == 0) & ~still
        number = np.where(still | flying, 1.0, n)
        left, kick = self.impact_time(number), self._rebound(number)
        tau = t - left.value
        v = kick.value - g * tau
        y = tau * (kick.value - 0.5 * g * tau)
        dy, dv = in_flight(tau, self.NAMES, v, g, left.gradient, kick.gradient)
        zero = np.zeros_like(t)
        dy0 = {"y0": zero + 1, "v0": t, "gravity": -t * t / 2, "restitution": zero}
        dv0 = {"y0": zero, "v0": zero + 1, "gravity": -t, "restitution": zero}

        def choose(first, later):
            return np.where(still, 0.0, np.where(flying, first, later))

        height = np.maximum(choose(self.y0 + t * (self.v0 - 0.5 * g * t), y), 0.0)
        return (
            known(height, {name: choose(dy0[name], dy[name]) for name in self.NAMES}),
            known(choose(self.v0 - g * t, v), {name: choose(dv0[name], dv[name]) for name in self.NAMES}),
        )

    def _numbers(self, n: Counts, least: int = 1) -> Float[np.ndarray, "*counts"]:
        n = np.asarray(n, np.float64)
        if np.any(n < least) or np.any(n != np.floor(n)) or np.any(np.isinf(n)):
            raise InputError(f"impact number {n!r}", remedy=f"Count in whole numbers from {least}")
        return n

    def _rebound(self, n: Counts) -> Known:
        """e^n s: the speed after impact n."""
        _, speed = first_flight(self.y0, self.v0, self.gravity)
        s, power = float(speed.value), self.restitution**n
        gradient = {name: power * value for name, value in speed.gradient.items()}
        return known(power * s, gradient | {"restitution": _power_slope(self.restitution, n) * s})

    def _after_first(self, between, slope) -> Known:
        """t_1 + (2 s / g) `between`, where `between` has the given slope in e."""
        first, speed = first_flight(self.y0, self.v0, self.gravity)
        s, g = float(speed.value), self.gravity
        scale = {
            "y0": 2 / s,
            "v0": 2 * self.v0 / (g * s),
            # 2 (ds/dg) / g - 2 s / g², collected into terms of one sign
            "gravity": -2 * (self.v0 * self.v0 + g * self.y0) / (s * g * g),
        }
        gradient = {name: first.gradient[name] + value * between for name, value in scale.items()}
        return known(
            first.value + 2 * s / g * between, gradient | {"restitution": 2 * s / g * np.asarray(slope)}
        )


def known(value, gradient: Mapping[str, Any]) -> Known:
    """A value and its derivatives, all as arrays of its shape."""
    value = np.asarray(value, np.float64)
    whole = {name: np.broadcast_to(np.asarray(d, np.float64), value.shape) for name, d in gradient.items()}
    return Known(value, whole)


def later(t: Times) -> Float[np.ndarray, "*times"]:
    """Times as an array.

    Raises:
        InputError: one lies before the start.
    """
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
