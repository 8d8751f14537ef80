"""The ball on a spring floor in closed form: parabolas and arcs of a cosine, with their derivatives.

Above the floor y'' = -g; below it y'' = -g - k y, without damping, so every contact gives the speed s back
that it took, and the motion repeats with the period

    P = 2 s / g + (2 / w) (pi / 2 + atan2(g, s w)),   w = sqrt(k),   s = sqrt(v0² + 2 g y0).

This is the differential equation that the penalty integrators discretize; the ball with restitution is
not, not even in the limit of stiff springs, unless its restitution is 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mdnum.ball.exact import Counts, Known, Times, first_flight, in_flight, known, later, positive
from mdnum.errors import InputError

#: Terms of the two series below, enough for double precision up to an angle of 1.
_TERMS = 9


@dataclass(frozen=True)
class ExactPenalty:
    """The exact motion of a ball on an undamped penalty contact.

    Contacts are numbered from 1.

    Attributes:
        y0: height at the start, m, at least 0.
        v0: velocity at the start, m/s, upwards.
        gravity: m/s², positive, acts downwards.
        k: stiffness per mass, 1/s².

    Raises:
        InputError: a parameter out of range, or a ball that starts on the floor without velocity.

    Error: contact times and durations within some ulps; height and velocity within that of the motion at a
    time some ulps earlier or later.
    """

    y0: float
    v0: float = 0.0
    gravity: float = 9.81
    k: float = 1e4

    NAMES = ("y0", "v0", "gravity", "k")

    def __post_init__(self):
        positive("y0", self.y0, zero=True)
        positive("v0", abs(self.v0), zero=True)
        positive("gravity", self.gravity)
        positive("k", self.k)
        if self.y0 == 0 and self.v0 == 0:
            raise InputError(
                "the ball starts on the floor without velocity", remedy="Give it a height or a velocity"
            )

    def duration(self) -> Known:
        """How long a contact lasts, s: pi / w and more, because gravity presses."""
        speed, g, k = self._speed(), self.gravity, self.k
        s, w = float(speed.value), np.sqrt(k)
        value = 2 / w * (np.pi / 2 + np.arctan2(g, s * w))
        d = g * g + s * s * k
        own = {"gravity": 2 * s / d, "k": -value / (2 * k) - g * s / (k * d)}
        return self._with_speed(value, -2 * g / d, own)

    def period(self) -> Known:
        """Time from one contact to the next, s."""
        s, g, k = float(self._speed().value), self.gravity, self.k
        d = g * g + s * s * k
        # differences of the flight's and the contact's terms, collected so that nothing cancels
        own = {"gravity": -2 * s**3 * k / (g * g * d), "k": self.duration().gradient["k"]}
        return self._with_speed(2 * s / g + self.duration().value, 2 * s * s * k / (g * d), own)

    def contact_time(self, n: Counts) -> Known:
        """Time at which contact n begins, s."""
        n = np.asarray(n, np.float64)
        if np.any(n < 1) or np.any(n != np.floor(n)):
            raise InputError(f"contact number {n!r}", remedy="Count in whole numbers from 1")
        first, _ = first_flight(self.y0, self.v0, self.gravity)
        period = self.period()
        gradient = {
            name: first.gradient.get(name, 0.0) + (n - 1) * slope for name, slope in period.gradient.items()
        }
        return known(first.value + (n - 1) * period.value, gradient)

    def deepest(self) -> Known:
        """Greatest penetration, m: g / k + sqrt(g² / k² + s² / k)."""
        speed, g, k = self._speed(), self.gravity, self.k
        s = float(speed.value)
        root = np.sqrt(g * g + s * s * k)
        own = {
            "gravity": (1 + g / root) / k,
            "k": -(g + root) / k**2 + s * s / (2 * k * root),
        }
        return self._with_speed((g + root) / k, s / root, own)

    def contacts(self, t: Times) -> Float[np.ndarray, "*times"]:
        """Number of contacts that have begun up to and including time t (s)."""
        t = later(t)
        first, _ = first_flight(self.y0, self.v0, self.gravity)
        n = np.maximum(np.floor((t - first.value) / self.period().value) + 1, 0.0)
        n = np.where(self.contact_time(n + 1).value <= t, n + 1, n)
        return np.where((n > 0) & (self.contact_time(np.maximum(n, 1.0)).value > t), n - 1, n)

    def height(self, t: Times) -> Known:
        """Height at time t (s), m; negative in contact."""
        return self.state(t)[0]

    def velocity(self, t: Times) -> Known:
        """Velocity at time t (s), m/s."""
        return self.state(t)[1]

    def state(self, t: Times) -> tuple[Known, Known]:
        """Height and velocity at time t (s)."""
        t = later(t)
        n, g = self.contacts(t), self.gravity
        speed = self._speed()
        s = float(speed.value)
        begin, lasting = self.contact_time(np.maximum(n, 1.0)), self.duration()
        tau = t - begin.value
        inside = tau < lasting.value
        # flight after the contact; its parameters all move the moment of leaving
        leave = {name: begin.gradient[name] + lasting.gradient[name] for name in self.NAMES}
        kick = {name: speed.gradient.get(name, np.zeros(())) for name in self.NAMES}
        after = tau - lasting.value
        fly_y, fly_v = after * (s - 0.5 * g * after), s - g * after
        fly_dy, fly_dv = in_flight(after, self.NAMES, fly_v, g, leave, kick)
        arc_y, arc_v, arc_dy, arc_dv = self._arc(np.where(inside, tau, 0.0), begin.gradient, kick)
        zero = np.zeros_like(t)
        dy0 = {"y0": zero + 1, "v0": t, "gravity": -t * t / 2, "k": zero}
        dv0 = {"y0": zero, "v0": zero + 1, "gravity": -t, "k": zero}

        def choose(first, contact, flight):
            return np.where(n == 0, first, np.where(inside, contact, flight))

        return (
            known(
                choose(self.y0 + t * (self.v0 - 0.5 * g * t), arc_y, fly_y),
                {name: choose(dy0[name], arc_dy[name], fly_dy[name]) for name in self.NAMES},
            ),
            known(
                choose(self.v0 - g * t, arc_v, fly_v),
                {name: choose(dv0[name], arc_dv[name], fly_dv[name]) for name in self.NAMES},
            ),
        )

    def _arc(self, tau, begin, kick):
        """Height, velocity and their derivatives a time tau into a contact."""
        g, k, s = self.gravity, self.k, float(self._speed().value)
        w = np.sqrt(k)
        x = w * tau
        sine, cosine, half = np.sin(x), np.cos(x), np.sin(x / 2)
        y = -2 * g / k * half * half - s / w * sine
        v = -g / w * sine - s * cosine
        a = -g - k * y
        own_y = {
            "gravity": -2 / k * half * half,
            "k": g / k**2 * _lag(x) + s / (2 * w**3) * _sine_lag(x),
        }
        own_v = {
            "gravity": -sine / w,
            "k": g / (2 * w**3) * _sine_lag(x) + s / (2 * k) * x * sine,
        }
        dy, dv = {}, {}
        for name in self.NAMES:
            dy[name] = own_y.get(name, 0.0) - sine / w * kick[name] - v * begin[name]
            dv[name] = own_v.get(name, 0.0) - cosine * kick[name] - a * begin[name]
        return y, v, dy, dv

    def _speed(self) -> Known:
        return first_flight(self.y0, self.v0, self.gravity)[1]

    def _with_speed(self, value, slope, own) -> Known:
        """A function of the impact speed, with this slope in it, and of g and k themselves."""
        speed = self._speed().gradient
        return known(value, {name: slope * speed.get(name, 0.0) + own.get(name, 0.0) for name in self.NAMES})


def _sine_lag(x):
    """sin x - x cos x, without the cancellation of small angles."""
    small = np.where(np.abs(x) < 1, x, 0.0)
    term, series = small**3 / 3, 0.0
    for j in range(1, _TERMS + 1):
        series = series + term
        # x^(2j+1) (-1)^(j+1) 2j / (2j+1)!
        term = -term * small * small * (j + 1) / (j * (2 * j + 2) * (2 * j + 3))
    return np.where(np.abs(x) < 1, series, np.sin(x) - x * np.cos(x))


def _lag(x):
    """1 - cos x - (x sin x) / 2, without the cancellation of small angles."""
    small = np.where(np.abs(x) < 1, x, 0.0)
    # x^(2j) (-1)^(j+1) (1 - j) / (2j)!, from j = 2
    power, series = small**4 / 24, 0.0
    for j in range(2, _TERMS + 2):
        series = series + (j - 1) * power
        power = -power * small * small / ((2 * j + 1) * (2 * j + 2))
    return np.where(np.abs(x) < 1, series, 1 - np.cos(x) - x * np.sin(x) / 2)
