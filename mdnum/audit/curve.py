"""Energy and force along one coordinate: scatter of rounding, one-sided derivatives, neighboring doubles."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

#: One-sided first derivative from five points, error fourth power of the spacing.
_SLOPE = np.array([-25.0, 48.0, -36.0, 16.0, -3.0]) / 12.0

_CLOSER = (3e-9, 1e-7, 1e-6, 1e-5)
"""Spacings (relative) at which scatter is looked for: a float32 calculator is constant over the first."""

_WIDTHS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
"""Spacings from which a one-sided slope is taken; the one with the smallest error is kept."""


class Curve:
    """Energy and force along one coordinate, each place evaluated once.

    Args:
        at: gives (energy, force = -dE/dx) at a coordinate.
    """

    def __init__(self, at: Callable[[float], tuple[float, float]]):
        self._at = at
        self.known: dict[float, tuple[float, float]] = {}

    def __call__(self, x: float) -> tuple[float, float]:
        """(energy, force) at x."""
        x = float(x)
        if x not in self.known:
            self.known[x] = self._at(x)
        return self.known[x]

    def many(self, places: Sequence[float] | np.ndarray) -> Float[np.ndarray, "2 points"]:
        """Energies and forces as rows."""
        return np.array([self(float(x)) for x in places]).T


def bisect(told: Callable[[float], bool], low: float, high: float) -> tuple[float, float]:
    """Neighboring doubles between which an answer changes.

    Args:
        told: the question; its answers at low and at high differ.
        low, high: low < high.
    """
    before = told(low)
    while True:
        middle = low + 0.5 * (high - low)
        if not low < middle < high:
            return low, high
        if told(middle) == before:
            low = middle
        else:
            high = middle


def grid(low: float, high: float, step: float) -> Float[np.ndarray, "points"]:
    """Where `find_jumps` looks first."""
    return np.linspace(low, high, max(int(np.ceil((high - low) / step)), 12) + 1)


def scatter(curve: Curve, low: float, high: float, room: float) -> Float[np.ndarray, "2 2"]:
    """Scatter of energy and force (columns) from rounding, before low and after high (rows).

    The largest that any of some spacings shows: a calculator in float32 is constant over the smallest.
    """
    sides = []
    for start, sign in ((low, -1.0), (high, 1.0)):
        worst = np.zeros(2)
        for relative in _CLOSER:
            width = max(abs(start), 1.0) * relative
            if 9 * width > room:
                break
            values = curve.many(start + sign * width * np.arange(1, 9))
            worst = np.maximum(worst, np.abs(np.diff(values, 4, axis=1)).max(axis=1) / np.sqrt(70.0))
        sides.append(worst)
    return np.array(sides)


def slope(curve: Curve, start: float, sign: int, room: float, noise: float) -> tuple[float, float]:
    """(dF/dx at start from one side, its error) at the spacing that makes the error least."""
    best = (0.0, np.inf)
    for relative in _WIDTHS:
        width = max(abs(start), 1.0) * relative
        if 8 * width > 2 * room and np.isfinite(best[1]):
            break
        fine = curve.many(start + sign * width * np.arange(5))[1] @ _SLOPE * sign / width
        coarse = curve.many(start + sign * 2 * width * np.arange(5))[1] @ _SLOPE * sign / (2 * width)
        error = abs(fine - coarse) + 12 * noise / width + 1e-14 * abs(fine)
        if error < best[1]:
            best = (float(fine), float(error))
    return best


def bend(curve: Curve, start: float, sign: int, room: float) -> float:
    """|second derivative of the force| to one side, roughly."""
    width = min(1e-3 * max(abs(start), 1.0), room / 4)
    force = curve.many(start + sign * width * np.arange(3))[1]
    return abs(float(force[0] - 2 * force[1] + force[2])) / width**2


def close(curve: Curve, start: float, toward: float) -> Float[np.ndarray, "2 points"]:
    places = [start]
    for _ in range(3):
        places.append(float(np.nextafter(places[-1], toward)))
    return curve.many(places)
