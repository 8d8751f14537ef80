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

    @apply.defjvp
    def rule(primals, tangents):
        inputs, rest = primals
        count = len(inputs)
        basis = tuple(
            jnp.stack([jnp.full_like(x, 1.0 if row == column else 0.0) for row in range(count)])
            for column, x in enumerate(inputs)
        )

        def along(direction):
            def outputs(*given):
                made, record = function(given, rest)
                return made, record

            made, tangent, record = jax.jvp(outputs, inputs, direction, has_aux=True)
            return made, tangent, record

        made, jacobian, record = jax.vmap(along, out_axes=(None, 0, None))(basis)
        rates = tuple(
            sum((rows[k] * tangents[0][k] for k in range(1, count)), rows[0] * tangents[0][0])
            for rows in jacobian
        )
        return (made, record), (rates, jax.tree.map(_no_tangent, record))

    return apply


def _no_tangent(leaf: Any) -> Any:
    if jnp.issubdtype(leaf.dtype, jnp.floating):
        return jnp.zeros_like(leaf)
    return np.zeros(leaf.shape, jax.dtypes.float0)
