"""What the formats of the ball can hold, and the smallest tolerance that its solver can meet; without jax."""

from __future__ import annotations

import math
from typing import Any

import ml_dtypes
import numpy as np

DTYPES = {
    "float16": np.dtype(np.float16),
    "bfloat16": np.dtype(ml_dtypes.bfloat16),
    "float32": np.dtype(np.float32),
    "float64": np.dtype(np.float64),
}
#: What the ranges of a run are told of, by the name in the columns of its table of steps.
RANGES = {
    "y": "height (m)",
    "v": "velocity (m/s)",
    "depth": "penetration (m)",
    "push": "force of the floor (m/s²)",
}
#: Roles that a tolerance has to do with, by what it is a tolerance of.
_ROLES = {
    "sum": ("decision", "accumulate", "state", "arithmetic"),
    "relative": ("decision",),
    "term": ("decision", "state", "arithmetic"),
}


def smallest(name: str) -> float:
    """The smallest positive number that the ball's arithmetic keeps in a format.

    XLA on a CPU flushes subnormals to zero in every format but float16, whose arithmetic it does in float32.
    """
    limits = ml_dtypes.finfo(DTYPES[name])
    return float(limits.smallest_subnormal if name == "float16" else limits.smallest_normal)


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


def extremes(values: Any) -> tuple[Any, Any]:
    """Largest magnitude and smallest one that is not 0 of each row, shape (rows,); NaN where all are 0."""
    size = np.abs(np.asarray(values, np.float64))
    with np.errstate(invalid="ignore"):
        least = np.min(np.where(size > 0, size, np.inf), axis=1, initial=np.inf)
    return size.max(axis=1, initial=0.0), np.where(np.isfinite(least), least, np.nan)


def first_outside(most: Any, least: Any, name: str) -> tuple[int | None, int | None]:
    """The first rows whose numbers a format cannot hold, from the extremes of each row.

    Args:
        most, least: as `extremes` has them.
        name: of the format.

    Returns:
        the row at which the largest number would be infinite, and the one at which the smallest would be 0;
        None where there is none.
    """
    with np.errstate(over="ignore", under="ignore"):
        over = np.isinf(np.asarray(most, np.float64).astype(DTYPES[name]).astype(np.float64))
        kept = np.asarray(least, np.float64).astype(DTYPES[name]).astype(np.float64)
    lost = kept < smallest(name)
    return tuple(int(np.argmax(hit)) if hit.any() else None for hit in (over, lost))  # type: ignore[return-value]


def smallest_tolerance(precision: Any, gain: float = 1.0, kind: str = "term") -> dict[str, float]:
    """The smallest tolerance that a solver can meet, m, by the role whose format asks for it.

    A penetration so small that its share `gain` rounds to nothing no longer shrinks, and a tolerance that is
    no number of a format is another tolerance. The largest of the values is the smallest usable tolerance.

    Args:
        precision: names of formats by role, as attributes.
        gain: share of a penetration that an iteration takes (alpha k of a projection; 1 for Newton's method).
        kind: what is compared with the tolerance: "sum" of the residuals, "relative" to the first one, or
            "term" (one of them, or the largest).

    Error: exact up to the rounding of alpha k; tested against every small penetration.
    """
    found = {}
    for role in _ROLES[kind]:
        name = getattr(precision, role)
        found[role] = _stuck(name, gain) if role == "arithmetic" else smallest(name)
    return found


def _stuck(name: str, gain: float) -> float:
    """The smallest number of a format below which a penetration may be that no longer shrinks."""
    if name == "float16":
        # of n grains the iteration takes gain * n, which rounds to none up to one half
        return (math.floor(0.5 / gain) + 1) * smallest(name)
    return smallest(name) / min(gain, 1.0)
