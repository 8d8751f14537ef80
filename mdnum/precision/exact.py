"""Arithmetic inside jit that has the same bits everywhere.

XLA on a CPU contracts a*b + c into a fused multiply-add, so the same expression has other bits in
another fusion, another instruction set, or in numpy. A decision must not depend on that: it is written
with the products fenced, and then the host reproduces it bit for bit.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
from jax import lax

_INTEGER = {
    np.dtype(np.float64): jnp.int64,
    np.dtype(np.float32): jnp.int32,
    np.dtype(np.float16): jnp.int16,
    np.dtype(ml_dtypes.bfloat16): jnp.int16,
}


def integer_of(dtype):
    """The signed integer type as wide as a float dtype."""
    return _INTEGER[np.dtype(dtype)]


def zero_bits(dtype) -> jax.Array:
    """An integer zero of the width of dtype; pass it into jit as an argument, so that XLA cannot fold it."""
    return jnp.zeros((), integer_of(dtype))


def _through_integers(x, zero):
    integer = integer_of(x.dtype)
    return lax.bitcast_convert_type(lax.bitcast_convert_type(x, integer) ^ zero.astype(integer), x.dtype)


@jax.custom_jvp
def fence(x: jax.Array, zero: jax.Array) -> jax.Array:
    """x, opaque to fused multiply-add contraction: XLA sees an integer operation with a runtime zero.

    It also forces the rounding to float16 and bfloat16: XLA may keep the float32 in which it computed (a
    bfloat16 product that is widened at once is never rounded on a CPU), but an integer needs the bits.

    Source: optimization_barrier and reduce_precision do not stop the contraction on CPU
    (openxla/xla#41579); the exclusive-or with a runtime integer does.
    """
    return _through_integers(x, zero)


@fence.defjvp
def _fence_jvp(primals, tangents):
    x, zero = primals
    return _through_integers(x, zero), tangents[0]


def squared_norm(dx: jax.Array, dy: jax.Array, dz: jax.Array, zero: jax.Array) -> jax.Array:
    """dx² + dy² + dz², rounded after every operation: the bits of numpy's `dx*dx + dy*dy + dz*dz`.

    Error: at most gamma_3 * r² for exact components (Higham 2002, 3.1).
    """
    return (fence(dx * dx, zero) + fence(dy * dy, zero)) + fence(dz * dz, zero)
