"""Floating-point precision, rounding bounds, sums, and discrete events such as pairs crossing a cutoff."""

from __future__ import annotations

import jax

from mdnum.bits import changes_in_time, count_set, set_bits
from mdnum.numerics.events import Hysteresis, Ledger, Threshold
from mdnum.numerics.forked import check_not_forked
from mdnum.numerics.roles import PrecisionPolicy, RolePrecision
from mdnum.numerics.rounding import (
    Reach,
    distance_bound,
    gamma,
    neighbor,
    ordinal,
    squared_distance_bound,
    unit_roundoff,
)

# every threshold, margin and ledger entry is a float64; jax would otherwise make them float32 in silence
jax.config.update("jax_enable_x64", True)

__all__ = [
    "Hysteresis", "Ledger", "PrecisionPolicy", "Reach", "RolePrecision", "Threshold", "changes_in_time",
    "check_not_forked", "count_set", "distance_bound", "gamma", "neighbor", "ordinal", "set_bits",
    "squared_distance_bound", "unit_roundoff",
]  # fmt: skip
