"""Loops over the rows of a stretch that end where its record ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def over_rows(
    step: Callable[[Any, Any], tuple[Any, Any]], carry: Any, rows: Any, used: Any, *, backward: bool = False
) -> tuple[Any, Any]:
    """As `jax.lax.scan`, but over the first rows alone.

    Every stretch has the room of the longest, so that one program serves all; a loop over that room would
    spend most of its time on rows that hold nothing.

    Args:
        step: (carry, row) to (carry, output).
        carry: where it starts.
        rows: a pytree of arrays that share their first axis.
        used: how many of the rows are used; may be traced.
        backward: last used row first.

    Returns:
        The last carry, and the outputs; those of unused rows are zero.
    """
    first = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), rows)
    _, out = jax.eval_shape(step, carry, first)
    room = jax.tree.leaves(rows)[0].shape[0]
    outputs = jax.tree.map(lambda leaf: jnp.zeros((room, *leaf.shape), leaf.dtype), out)

    def body(k, both):
        carry, outputs = both
        at = used - 1 - k if backward else k
        row = jax.tree.map(lambda leaf: lax.dynamic_index_in_dim(leaf, at, keepdims=False), rows)
        carry, new = step(carry, row)
        return carry, jax.tree.map(
            lambda all, one: lax.dynamic_update_index_in_dim(all, one, at, 0), outputs, new
        )

    return lax.fori_loop(0, used, body, (carry, outputs))
