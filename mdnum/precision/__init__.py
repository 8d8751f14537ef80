"""What a number is: dtype by role, rounding bounds, ulps, arithmetic that is the same everywhere."""

from __future__ import annotations

import jax

# every threshold, margin and ledger entry is a float64; jax would otherwise make them float32 in silence
jax.config.update("jax_enable_x64", True)
