"""Loss scaling: a gradient that would fall below the smallest float16 is computed larger and divided after.

The scale is the cotangent with which the backward pass starts, so the loss itself is not multiplied and
cannot overflow. Unscaling happens in float64: a power of two, exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from mdnum.errors import InputError


class ScaledGradient(NamedTuple):
    """A loss with its gradient.

    Attributes:
        value: the loss, in its own dtype.
        gradient: as the differentiated argument, leaves in float64.
        finite: whether every number of the gradient is finite.
        scale: the factor that was used.
    """

    value: Float[Array, ""]
    gradient: PyTree
    finite: Bool[Array, ""]
    scale: Float[Array, ""]


def scaled_gradient(function: Callable[..., Any], scale: float | Array, *args: Any) -> ScaledGradient:
    """The loss `function(*args)` and its gradient by the first argument.

    Args:
        function: of arrays; returns a scalar.
        scale: a power of two (`check_scale`); too small and gradients vanish, too large and they overflow.
    """
    scale = jnp.asarray(scale, jnp.float64)
    value, pullback = jax.vjp(lambda first: function(first, *args[1:]), args[0])
    (gradient,) = pullback(scale.astype(value.dtype))
    gradient = jax.tree.map(lambda g: g.astype(jnp.float64) / jnp.broadcast_to(scale, g.shape), gradient)
    finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(g)) for g in jax.tree.leaves(gradient)], bool))
    return ScaledGradient(value, gradient, finite, scale)


def check_scale(scale: float) -> None:
    """That scaling by this factor is exact.

    Raises:
        InputError: it is no power of two.
    """
    if not (scale > 0 and math.frexp(scale)[0] == 0.5):
        raise InputError(
            f"a scale of {scale:g} is not a power of two", remedy="Give one; then scaling is exact"
        )
