"""Ranges of the numbers in a run, and floating-point formats that are too narrow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import ml_dtypes
import numpy as np

DTYPES = {name: np.dtype(name) for name in ("float16", "bfloat16", "float32", "float64")}


def smallest(name: str) -> float:
    """Return the smallest positive number that is not flushed to zero."""
    limits = ml_dtypes.finfo(DTYPES[name])
    # XLA on a CPU flushes subnormals to zero in every format but float16, whose arithmetic it does in float32
    return float(limits.smallest_subnormal if name == "float16" else limits.smallest_normal)


def columns(quantities: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return columns with the largest and the smallest magnitude of each row.

    `largest_NAME` is the largest magnitude. `smallest_NAME` is the smallest nonzero magnitude (or NaN).
    """
    made = {}
    for name, values in quantities.items():
        size = np.abs(np.asarray(values, np.float64))
        least = np.min(size, axis=1, initial=np.inf, where=size > 0)
        made[f"largest_{name}"] = size.max(axis=1, initial=0.0)
        made[f"smallest_{name}"] = np.where(np.isfinite(least), least, np.nan)
    return made


def first_outside(most: Any, least: Any, name: str) -> dict[str, tuple[int, float]]:
    """Return the first values of a quantity that are outside the range of a format.

    Returns:
        row and number that would first be infinite ("overflows"), lose digits ("subnormal") or be 0 ("lost");
        cases that do not occur are omitted.
    """
    with np.errstate(over="ignore", under="ignore"):
        high, low = (np.asarray(one).astype(DTYPES[name]).astype(np.float64) for one in (most, least))
    lost, few = low < smallest(name), low < float(ml_dtypes.finfo(DTYPES[name]).smallest_normal)
    hits = {"overflows": (most, np.isinf(high)), "subnormal": (least, few & ~lost), "lost": (least, lost)}
    return {how: ((at := int(hit.argmax())), float(of[at])) for how, (of, hit) in hits.items() if hit.any()}
