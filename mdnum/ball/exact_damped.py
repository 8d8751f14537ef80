"""The ball on a damped spring floor: exact motion between contacts and within them, impact by impact.

Below the floor y'' = -g - k y - c y', as long as the ball is below it (so the damper may pull at the end).
Each contact is a damped cosine in closed form; its end is the root of one equation, which lies between the
lowest point and the first crest after it, both known in closed form. A ball whose crest stays below the
floor has come to rest in it, g / k deep.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mdnum.ball.exact import Known, Times, known, later, positive
from mdnum.errors import InputError

#: Imaginary step of the derivatives: its square is far below rounding.
_STEP = 1e-40
#: Contacts after which something is wrong: each one takes a share of the energy.
_MOST = 100_000


@dataclass(frozen=True)
class ExactDamped:
    """The exact motion of a ball on a damped penalty contact.

    Attributes:
        y0: height at the start, m, at least 0.
        v0: velocity at the start, m/s, upwards.
        gravity: m/s², positive, acts downwards.
        k: stiffness per mass, 1/s².
        damping: per mass, 1/s; not the critical 2 sqrt(k) exactly.

    Raises:
        InputError: a parameter out of range.

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
        positive("y0", self.y0, zero=True)
        positive("v0", abs(self.v0), zero=True)
        positive("gravity", self.gravity)
        positive("k", self.k)
        positive("damping", self.damping, zero=True)
        if self.y0 == 0 and self.v0 == 0:
            raise InputError(
                "the ball starts on the floor without velocity", remedy="Give it a height or a velocity"
            )
        if self.damping**2 == 4 * self.k:
            raise InputError(
                "critical damping has no such closed form", remedy="Change the damping by an ulp"
            )

    def height(self, t: Times) -> Known:
        """Height at time t (s), m; negative in contact."""
        return self.state(t)[0]

    def velocity(self, t: Times) -> Known:
        """Velocity at time t (s), m/s."""
        return self.state(t)[1]

    def state(self, t: Times) -> tuple[Known, Known]:
        """Height and velocity at time t (s)."""
        t = later(t)
        values = {name: complex(getattr(self, name)) for name in self.NAMES}
        y, v = _motion(values, t)
        dy, dv = {}, {}
        for name in self.NAMES:
            moved = _motion(values | {name: values[name] + 1j * _STEP}, t)
            dy[name], dv[name] = (np.imag(x) / _STEP for x in moved)
        return known(np.real(y), dy), known(np.real(v), dv)


def _motion(p: Mapping[str, complex], t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height and velocity with complex parameters, at real times."""
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
        speed = _arc(p, down, lasting)[1]
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
    y = fade * (deep * cosine + (half * deep - s) * sine) - deep
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
    high = low + np.pi / w
    if _arc(p, s, high)[0].real <= 0:
        return None
    while True:
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        low, high = (middle, high) if _arc(p, s, middle)[0].real < 0 else (low, middle)
    tau = complex(high)
    # Newton in complex numbers takes the derivative along, exact after the first step
    for _ in range(2):
        y, v = _arc(p, s, tau)
        tau = tau - y / v
    return tau
