"""What the formats of the ball can hold, told without jax."""

from __future__ import annotations

import ml_dtypes
import numpy as np

DTYPES = {
    "float16": np.dtype(np.float16),
    "bfloat16": np.dtype(ml_dtypes.bfloat16),
    "float32": np.dtype(np.float32),
    "float64": np.dtype(np.float64),
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
