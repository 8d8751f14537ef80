"""Exact motion of a bouncing ball, and its derivatives with respect to all parameters.

A ball starts at height y0 with velocity v0, under gravity g. The ball reaches the floor at t_1 = (v0 + s) / g
with speed s = sqrt(v0² + 2 g y0). With restitution e, impact n has speed e^(n-1) s. The next impact is 2 e^n
s / g later. Therefore

    t_n = t_1 + (2 s / g) (e + e² + ... + e^(n-1)),   t_rest = t_1 + (2 s / g) e / (1 - e).

Infinitely many impacts take place before the finite time t_rest (Zeno behavior). With a spring and a damper,
y'' = -g - k y - c y' below the floor. A simulation with penalty contacts discretizes the equation of motion
in time. The limit of stiff springs differs from a ball with restitution, unless e = 1.

All computations use numpy in float64. The exact solution shares no code with the simulations of this package.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Shaped

from mdnum.errors import InputError

Times = float | Shaped[np.ndarray, "*times"]
Counts = int | float | Shaped[np.ndarray, "*counts"]

_STEP = 1e-40  # imaginary step of a derivative: its square is far below rounding
_MOST = 100_000  # contacts after which something is wrong: each damped one takes a share of the energy


@dataclass(frozen=True)
class Known:
    """The exact value of a quantity, and its derivatives."""

    value: Float[np.ndarray, "..."]  # shape of what was asked for (times or impact numbers)
    # derivative by name of the parameter, each of that shape
    gradient: Mapping[str, Float[np.ndarray, "..."]]


Parameters = Mapping[str, complex]


class _Motion:
    """Base class of exact motions: height, velocity and derivatives of a ball.

    Complex-step derivatives have no cancellation (Squire & Trapp, SIAM Review 40 (1998) 110).
    """

    y0: float
    v0: float
    gravity: float
    NAMES: ClassVar[tuple[str, ...]]

    def _check(self):
        for name, zero in (("y0", True), ("v0", True), ("gravity", False)):
            value = getattr(self, name)
            _positive(name, abs(value) if name == "v0" else value, zero=zero)
        if self.y0 == 0 and self.v0 == 0:
            raise InputError("the ball starts at rest on the floor", remedy="Set a height or a velocity")

    def _known(self, quantities: Callable[[Parameters], tuple[Any, ...]]) -> tuple[Known, ...]:
        """Evaluate functions of complex parameters; return their values and complex-step derivatives."""
        at = self._at
        moved = {name: quantities(at | {name: value + 1j * _STEP}) for name, value in at.items()}
        found = []
        for k, value in enumerate(quantities(at)):
            gradient = {name: np.asarray(np.imag(one[k]) / _STEP) for name, one in moved.items()}
            found.append(Known(np.asarray(np.real(value)), gradient))
        return tuple(found)

    @property
    def _at(self) -> dict[str, complex]:
        return {name: complex(getattr(self, name)) for name in self.NAMES}

    def first_contact(self) -> Known:
        """Return the time (s) at which the ball first reaches the floor.

        The error is a few ulps for any sign of v0.
        """
        return self._known(_down)[0]

    def state(self, t: Times) -> tuple[Known, Known]:
        """Return height (m) and velocity (m/s) at time t (s)."""
        raise NotImplementedError

    def height(self, t: Times) -> Known:
        """Return the height (m) at time t (s)."""
        return self.state(t)[0]

    def velocity(self, t: Times) -> Known:
        """Return the velocity (m/s) at time t (s). At an impact, return the velocity after the impact."""
        return self.state(t)[1]


def _down(p: Parameters) -> tuple[complex, complex]:
    """Return time (s) and speed (m/s) of the first contact, without cancellation."""
    y0, v0, g = p["y0"], p["v0"], p["gravity"]
    speed = np.sqrt(v0 * v0 + 2 * g * y0)
    return (v0 + speed) / g if v0.real >= 0 else 2 * y0 / (speed - v0), speed


def _impact(p: Parameters, n: Any) -> tuple[Any, Any]:
    """Return the time (s) of impact n, and the speed (m/s) after the impact."""
    first, speed = _down(p)
    e = p["restitution"]
    power, between = _powers(e, np.asarray(n, np.float64) - 1)
    return first + 2 * speed / p["gravity"] * e * between, power * e * speed


@dataclass(frozen=True)
class ExactImpact(_Motion):
    """The exact motion of a ball that bounces with a coefficient of restitution.

    Impacts are numbered from 1. At the time of an impact, height and velocity are those after the impact.

    Raises:
        InputError: a parameter is out of range, or the ball starts at rest on the floor.

        Error: values and derivatives are computed without cancellation. Impact speeds and times have errors
            of about ten ulps, plus n ulps for the n-th power of e, for any e including values at and near 1.
            Height and velocity have the same errors, plus the effect of a change of the time by a few ulps.
    """

    y0: float  # height at the start, m, at least 0
    v0: float = 0.0  # velocity at the start, m/s, upwards
    gravity: float = 9.81  # m/s², positive, acts downwards
    restitution: float = 0.8  # speed after an impact over the speed before it, 0 to 1

    NAMES = ("y0", "v0", "gravity", "restitution")

    def __post_init__(self):
        self._check()
        _positive("restitution", self.restitution, zero=True, most=1.0)

    def impact_speed(self, n: Counts) -> Known:
        """Return the speed e^(n-1) s (m/s) with which impact n meets the floor."""
        power = _numbers(n) - 1
        return self._known(lambda p: (_powers(p["restitution"], power)[0] * _down(p)[1],))[0]

    def impact_time(self, n: Counts) -> Known:
        """Return the time (s) of impact n."""
        n = _numbers(n)
        return self._known(lambda p: _impact(p, n))[0]

    def rest_time(self) -> Known:
        """Return the time (s) at which the ball comes to rest.

        Raises:
            InputError: the coefficient of restitution is 1.
        """
        if self.restitution == 1:
            raise InputError(
                "a ball with restitution 1 never comes to rest",
                remedy="Choose a restitution below 1",
                where="restitution",
            )

        def at_rest(p):
            (first, speed), e = _down(p), p["restitution"]
            return (first + 2 * speed / p["gravity"] * e / (1 - e),)

        return self._known(at_rest)[0]

    def bounces(self, t: Times) -> Float[np.ndarray, "*times"]:
        """Return the number of impacts up to time t (s). It is infinite at rest."""
        t = _later(t)
        at = self._at
        first, speed = (part.real for part in _down(at))
        t_1, e, scale = first, self.restitution, 2 * speed / self.gravity
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
        n = np.where(finite & (np.real(_impact(at, now + 1)[0]) <= t), now + 1, n)
        now = np.where(finite, n, 2.0)
        return np.where(finite & (np.real(_impact(at, now)[0]) > t) & (n > 1), n - 1, n)

    def state(self, t: Times) -> tuple[Known, Known]:
        """Return height and velocity at time t (s). At rest, they are zero."""
        t = _later(t)
        n = self.bounces(t)
        still = np.isinf(n) | ((n > 0) & (self.restitution == 0))
        number = np.where(still, 1.0, np.maximum(n, 1.0))

        def moved(p):
            left, kick = _impact(p, number)
            tau, v, g = t - np.where(n == 0, 0, left), np.where(n == 0, p["v0"], kick), p["gravity"]
            height = np.where(n == 0, p["y0"], 0) + tau * (v - 0.5 * g * tau)
            height = np.maximum(height.real, 0) + 1j * height.imag
            return np.where(still, 0, height), np.where(still, 0, v - g * tau)

        y, v = self._known(moved)
        return y, v


@dataclass(frozen=True)
class ExactPenalty(_Motion):
    """The exact motion of a ball on a penalty contact.

    The equation y'' = -g - k y - c y' holds below the floor, so the damper may pull the ball down. Without
    damping, the end time of a contact has a closed form. With damping, the end time is the root of height = 0
    after the lowest point. A ball that cannot leave the floor comes to rest at depth g / k.

    Raises:
        InputError: a parameter is out of range, or the ball starts at rest on the floor.

        The error of values and derivatives is about ten ulps per contact.
    """

    y0: float  # height at the start, m, at least 0
    v0: float = 0.0  # velocity at the start, m/s, upwards
    gravity: float = 9.81  # m/s², positive, acts downwards
    k: float = 1e4  # stiffness per mass, 1/s²
    damping: float = 0.0  # per mass, 1/s; not the critical 2 sqrt(k) exactly

    NAMES = ("y0", "v0", "gravity", "k", "damping")

    def __post_init__(self):
        self._check()
        _positive("k", self.k)
        _positive("damping", self.damping, zero=True)
        if self.damping**2 == 4 * self.k:
            raise InputError(
                "the formula for the motion fails at critical damping", remedy="Change the damping slightly"
            )

    def state(self, t: Times) -> tuple[Known, Known]:
        """Return height and velocity at time t (s). The height is negative during contact."""
        t = _later(t)
        y, v = self._known(lambda p: _bounced(p, t))
        return y, v


def _bounced(p: Parameters, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute height and velocity on a penalty contact, for complex parameters."""
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
        raise InputError(
            f"the ball makes more than {_MOST:,} contacts with the floor before the last requested time",
            remedy="Request earlier times",
        )
    return y, v


def _arc(p: Parameters, s: complex, tau):
    """Return height and velocity at time tau after the beginning of a contact with speed s."""
    k, half, deep = p["k"], p["damping"] / 2, p["gravity"] / p["k"]
    w = np.sqrt(k - half * half)
    fade, cosine, sine = np.exp(-half * tau), np.cos(w * tau), np.sin(w * tau) / w
    # exp(-half tau) cos(w tau) - 1 without the cancellation of short times
    dip = np.expm1(-half * tau) * cosine - 2 * np.sin(w * tau / 2) ** 2
    y = deep * dip + fade * (half * deep - s) * sine
    v = fade * (-s * cosine + (half * s - p["gravity"]) * sine)
    return y, v


def _end(p: Parameters, s: complex) -> complex | None:
    """Return the duration (s) of a contact that begins with speed s. None if it never ends."""
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
        raise InputError(f"{name} = {value!r}; expected a finite value {low}{high}", where=name)


def _numbers(n: Counts, least: int = 1) -> Float[np.ndarray, "*counts"]:
    n = np.asarray(n, np.float64)
    if np.any(n < least) or np.any(n != np.floor(n)) or np.any(np.isinf(n)):
        raise InputError(f"there is no impact number {n!r}; impacts are numbered by integers from {least}")
    return n


def _later(t: Times) -> Float[np.ndarray, "*times"]:
    t = np.asarray(t, np.float64)
    if not np.all(t >= 0):
        raise InputError("a requested time is negative", remedy="Request only times of 0 or later")
    return t


def _powers(e: complex, n: Any) -> tuple[Any, Any]:
    """Return e^n and 1 + e + ... + e^(n-1) for integers n, without cancellation.

    Near e = 1, the formula (1 - e^n) / (1 - e) loses all digits.
    """
    n = np.asarray(n, np.float64)
    power, total = np.ones(n.shape, complex), np.zeros(n.shape, complex)
    for bit in reversed(range(int(np.max(n, initial=0)).bit_length())):
        power, total = power * power, total * (1 + power)
        odd = np.floor(n / 2.0**bit) % 2 == 1
        power, total = np.where(odd, power * e, power), np.where(odd, 1 + e * total, total)
    return power, total
