"""Largest numbers of the ball's formats and smallest tolerance that its solver can meet; without jax."""

from __future__ import annotations

import math
from typing import Any

import ml_dtypes
import numpy as np

from mdnum.ranges import DTYPES, smallest

#: Roles that a tolerance has to do with, by what it is a tolerance of.
_ROLES = {
    "sum": ("decision", "accumulate", "state", "arithmetic"),
    "relative": ("decision",),
    "term": ("decision", "state", "arithmetic"),
}


def largest(name: str) -> float:
    """The largest finite number of a format."""
    return float(ml_dtypes.finfo(DTYPES[name]).max)


def spacing(value: float, name: str) -> float:
    """Distance from the number to the next one of a format."""
    limits = ml_dtypes.finfo(DTYPES[name])
    exponent = int(np.floor(np.log2(max(abs(value), float(limits.smallest_normal)))))
    return float(limits.eps) * 2.0**exponent


def rounded(value: float, name: str) -> float:
    """The number of a format nearest to value."""
    with np.errstate(over="ignore"):
        return float(np.asarray(value, DTYPES[name]))


def smallest_tolerance(precision: Any, gain: float = 1.0, kind: str = "term") -> dict[str, float]:
    """The smallest tolerance that a solver can meet, m, for each role whose format limits the tolerance.

    A penetration so small that its share `gain` rounds to nothing no longer shrinks, and a tolerance that is
    no number of a format is another tolerance. The largest of the values is the smallest usable tolerance.

    Args:
        precision: names of formats by role, as attributes.
        gain: share of a penetration that an iteration takes (alpha k of a projection; 1 for Newton's method).
        kind: what is compared with the tolerance: "sum" of the residuals, "relative" to the first one, or
            "term" (one of them, or the largest).

    Error: exact up to the rounding of alpha k; tested against every small penetration.
    """
    formats = {role: getattr(precision, role) for role in _ROLES[kind]}
    least = {role: smallest(name) for role, name in formats.items()}
    return least | ({"arithmetic": _stuck(formats["arithmetic"], gain)} if "arithmetic" in formats else {})


def _stuck(name: str, gain: float) -> float:
    """The smallest number above every penetration that an iteration may leave unchanged by rounding."""
    if name == "float16":
        # of n grains the iteration takes gain * n, which rounds to none up to one half
        return (math.floor(0.5 / gain) + 1) * smallest(name)
    return smallest(name) / min(gain, 1.0)
