"""Ranges of floating-point formats, and the smallest usable tolerance of a contact solver."""

from __future__ import annotations

import math
from typing import Any

import ml_dtypes
import numpy as np

from mdnum.ranges import DTYPES, smallest

#: Roles whose precision affects a tolerance, by the quantity of the tolerance.
_ROLES = {
    "sum": ("decision", "accumulate", "state", "arithmetic"),
    "relative": ("decision",),
    "term": ("decision", "state", "arithmetic"),
}


def largest(name: str) -> float:
    """Return the largest finite number of a floating-point format."""
    return float(ml_dtypes.finfo(DTYPES[name]).max)


def spacing(value: float, name: str) -> float:
    """Return the distance from a number to the next larger number of a floating-point format."""
    limits = ml_dtypes.finfo(DTYPES[name])
    exponent = int(np.floor(np.log2(max(abs(value), float(limits.smallest_normal)))))
    return float(limits.eps) * 2.0**exponent


def rounded(value: float, name: str) -> float:
    """Return the number of a floating-point format that is nearest to a value."""
    with np.errstate(over="ignore"):
        return float(np.asarray(value, DTYPES[name]))


def smallest_tolerance(precision: Any, gain: float = 1.0, kind: str = "term") -> dict[str, float]:
    """Return the smallest tolerance (m) that a solver can reach in each of its formats.

    A penetration no longer decreases if `gain` times the penetration rounds to zero. A tolerance below the
    smallest number of a format rounds to zero. A usable tolerance is at least the largest of the returned
    tolerances.

    Args:
        precision: names of formats by role, as attributes.
        gain: fraction of a penetration removed by an iteration (alpha k of a projection; 1 for Newton's
            method).
        kind: the quantity compared with the tolerance: "sum" of the residuals, "relative" to the first sum,
            or "term" (a single residual, or the largest).

        Error: exact except for the rounding of alpha k; tested for every small penetration.
    """
    formats = {role: getattr(precision, role) for role in _ROLES[kind]}
    least = {role: smallest(name) for role, name in formats.items()}
    return least | ({"arithmetic": _stuck(formats["arithmetic"], gain)} if "arithmetic" in formats else {})


def _stuck(name: str, gain: float) -> float:
    """Return the penetration above which each iteration still changes the rounded penetration."""
    if name == "float16":
        # of n grains the iteration takes gain * n, which rounds to none up to one half
        return (math.floor(0.5 / gain) + 1) * smallest(name)
    return smallest(name) / min(gain, 1.0)
