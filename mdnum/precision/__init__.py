"""What a number is: dtype by role, rounding bounds, ulps, arithmetic that is the same everywhere."""

from __future__ import annotations

import jax

from mdnum.precision.bounds import Reach, distance_bound, gamma, squared_distance_bound
from mdnum.precision.policy import PrecisionPolicy, RolePrecision
from mdnum.precision.ulp import neighbor, ordinal, ulp_distance, unit_roundoff

# every threshold, margin and ledger entry is a float64; jax would otherwise make them float32 in silence
jax.config.update("jax_enable_x64", True)

__all__ = [
    "PrecisionPolicy",
    "Reach",
    "RolePrecision",
    "distance_bound",
    "gamma",
    "neighbor",
    "ordinal",
    "squared_distance_bound",
    "ulp_distance",
    "unit_roundoff",
]
