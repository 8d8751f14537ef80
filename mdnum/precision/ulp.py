"""Floats as integers: unit roundoff, ulp distance and neighbors."""

from __future__ import annotations

import ml_dtypes
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import DTypeLike

_SIGNED = {
    np.dtype(np.float64): np.int64,
    np.dtype(np.float32): np.int32,
    np.dtype(np.float16): np.int16,
    np.dtype(ml_dtypes.bfloat16): np.int16,
}


def unit_roundoff(dtype: DTypeLike) -> float:
    """Half the spacing of the floats at 1: the largest relative error of one rounding (Higham 2002, 2.1)."""
    # ml_dtypes' finfo knows bfloat16 too
    return float(ml_dtypes.finfo(np.dtype(dtype)).eps) / 2


def ordinal(x: Float[np.ndarray, "..."]) -> Int[np.ndarray, "..."]:
    """Position of x among all floats of its dtype, as a signed integer; -0 and +0 share 0.

    Adjacent finite floats have adjacent ordinals, so differences count ulps. NaN has no meaningful ordinal.
    """
    x = np.asarray(x)
    integer = _SIGNED[x.dtype]
    bits = x.view(integer).astype(np.int64)
    lowest = np.int64(np.iinfo(integer).min)
    return np.where(bits < 0, lowest - bits, bits)


def ulp_distance(a, b, dtype: DTypeLike = np.float64) -> Int[np.ndarray, "..."]:
    """How many floats of dtype lie from a to b, with sign (b above a is positive).

    Error: exact up to 2^62; further apart (floats of opposite sign) the answer is ±2^62.
    """
    start, end = ordinal(np.asarray(a, dtype)), ordinal(np.asarray(b, dtype))
    limit = np.int64(2**62)
    # halves cannot overflow, and tell where the difference would
    far = np.abs(end // 2 - start // 2) >= limit // 2
    with np.errstate(over="ignore"):
        return np.where(far, np.where(end > start, limit, -limit), end - start)


def neighbor(x, ulps: int, dtype: DTypeLike = np.float64):
    """The float that lies the given number of ulps above x (below, where negative)."""
    x = np.asarray(x, dtype)
    integer = _SIGNED[x.dtype]
    place = ordinal(x) + ulps
    lowest = np.int64(np.iinfo(integer).min)
    # the branch not taken must not overflow
    bits = np.where(place < 0, lowest - np.minimum(place, 0), place)
    return bits.astype(integer).view(x.dtype)[()]
