"""Derivatives of iterative maps that act on each ball alone.

A `while_loop` has no reverse mode in JAX, because its tape would have no fixed size. A map that treats each
ball by itself has a diagonal Jacobian, though, whatever decides when its loop ends. A few tangents carried
along in the same loop give all of it; nothing is stored per iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

#: function(inputs, rest) -> (outputs, record); inputs and outputs are tuples of arrays of shape (balls,).
Map = Callable[[tuple, Any], tuple[tuple, Any]]


def elementwise(function: Map) -> Map:
    """A map with both derivative modes, for a function that contains a while_loop.

    The derivative is that of the iterations which ran, with every decision held fixed. The record, and
    whatever is in `rest`, carries none.

    Args:
        function: output b of every output depends on input b of every input only (and on `rest`).

    Returns:
        the same function, forward and reverse differentiable.

    Error: tangents are propagated in the dtype of the inputs, a rounding per operation.
    """

    @jax.custom_jvp
    def apply(inputs, rest):
        return function(inputs, rest)

    def rule(primals, tangents):
        inputs, rest = primals
        # an input that nothing differentiated depends on needs no tangent of its own in the loop
        moving = [k for k, rate in enumerate(tangents[0]) if not isinstance(rate, SymbolicZero)]

        def outputs(*given):
            every = list(inputs)
            for k, value in zip(moving, given, strict=True):
                every[k] = value
            return function(tuple(every), rest)

        varied = tuple(inputs[k] for k in moving)
        if not moving:
            made, record = outputs()
            return (made, record), (jax.tree.map(jnp.zeros_like, made), jax.tree.map(_no_tangent, record))
        basis = tuple(
            jnp.stack([jnp.full_like(x, row == column) for row in range(len(moving))])
            for column, x in enumerate(varied)
        )

        def along(direction):
            return jax.jvp(outputs, varied, direction, has_aux=True)

        made, jacobian, record = jax.vmap(along, out_axes=(None, 0, None))(basis)
        slopes = [tangents[0][k] for k in moving]
        rates = tuple(
            sum((rows[k] * slopes[k] for k in range(1, len(moving))), rows[0] * slopes[0])
            for rows in jacobian
        )
        return (made, record), (rates, jax.tree.map(_no_tangent, record))

    apply.defjvp(rule, symbolic_zeros=True)
    return apply


def _no_tangent(leaf: Any) -> Any:
    if jnp.issubdtype(leaf.dtype, jnp.floating):
        return jnp.zeros_like(leaf)
    return np.zeros(leaf.shape, jax.dtypes.float0)
