"""Arithmetic inside jit that has the same bits everywhere.

XLA on a CPU contracts a*b + c into a fused multiply-add, so the same expression has other bits in
another fusion, another instruction set, or in numpy. A decision must not depend on that: it is written
with the products fenced, and then the host reproduces it bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

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


def rounded(function: Callable[..., Any], zero: jax.Array) -> Callable[..., Any]:
    """The function with every sixteen-bit result in it rounded, one operation after the other.

    XLA on a CPU computes in float32 what is written in float16 or bfloat16, and may leave out the roundings
    between two operations. Here a fence stands behind each: numpy with ml_dtypes then gives the same bits,
    for + - * / and sqrt (exp and cos are float32's, which libraries round differently). Results of other
    dtypes are left alone.

    Args:
        function: of arrays; it may close over others.
        zero: an integer zero that XLA must not know (`zero_bits`).
    """

    def stepwise(*args: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        program, shape = jax.make_jaxpr(
            lambda *leaves: function(*jax.tree.unflatten(tree, leaves)), return_shape=True
        )(*leaves)
        results = _stepwise(program.jaxpr, program.consts, leaves, zero)
        return jax.tree.unflatten(jax.tree.structure(shape), results)

    return stepwise


# what a function that is jitted by itself, as jnp.where is, looks like inside another
_CALLS = ("jit", "pjit")


def _stepwise(program: Any, constants: Sequence[Any], arguments: Sequence[Any], zero: jax.Array) -> list[Any]:
    """Run a program equation by equation, with a fence behind each sixteen-bit result."""
    known = dict(zip(program.constvars, constants, strict=True))
    known.update(zip(program.invars, arguments, strict=True))

    def value(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else known[atom]

    for equation in program.eqns:
        inputs = [value(atom) for atom in equation.invars]
        inner = equation.params.get("jaxpr")
        if equation.primitive.name in _CALLS and isinstance(inner, ClosedJaxpr):
            outputs = _stepwise(inner.jaxpr, inner.consts, inputs, zero)
        else:
            if any(isinstance(param, Jaxpr | ClosedJaxpr) for param in equation.params.values()):
                raise TypeError(f"{equation.primitive.name} cannot be rounded operation by operation")
            outputs = equation.primitive.bind(*inputs, **equation.params)
            outputs = list(outputs) if equation.primitive.multiple_results else [outputs]
            outputs = [fence(x, zero) if _is_short(x.dtype) else x for x in outputs]
        known.update(zip(equation.outvars, outputs, strict=True))
    return [value(atom) for atom in program.outvars]


def _is_short(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jnp.floating) and np.dtype(dtype).itemsize == 2


def squared_norm(dx: jax.Array, dy: jax.Array, dz: jax.Array, zero: jax.Array) -> jax.Array:
    """dx² + dy² + dz², rounded after every operation: the bits of numpy's `dx*dx + dy*dy + dz*dz`.

    Error: at most gamma_3 * r² for exact components (Higham 2002, 3.1).
    """
    return (fence(dx * dx, zero) + fence(dy * dy, zero)) + fence(dz * dz, zero)
