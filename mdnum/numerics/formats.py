"""Emulation of floating-point formats: rounding and loss scaling.

The emulation reproduces the rounding of a format, not its speed. Some devices use TF32 for float32 matrix
products by default. TF32 products keep 10 of 23 fraction bits. Sums are in float32.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from mdnum.errors import InputError


@dataclass(frozen=True)
class FloatFormat:
    """A binary floating-point format with subnormals and infinities, as IEEE 754 defines them."""

    name: str  # such as "tf32"
    bits: int  # width in memory (TF32 lives in 32)
    significand: int  # binary digits of the significand, the implicit one included
    exponent: int  # bits of the exponent

    @property
    def emin(self) -> int:
        """Binary exponent of the smallest normal number of the format."""
        return 2 - 2 ** (self.exponent - 1)

    @property
    def top(self) -> int:
        """The value of the exponent field that represents infinity."""
        return 2**self.exponent - 1

    @property
    def largest(self) -> float:
        """The largest finite number."""
        return 2.0 ** (1 - self.emin) * (2.0 - 2.0 ** (1 - self.significand))

    @property
    def smallest_normal(self) -> float:
        """The smallest positive number of the format with full precision."""
        return 2.0**self.emin

    @property
    def smallest_subnormal(self) -> float:
        """The smallest positive number. The number is also the spacing of subnormal numbers."""
        return 2.0 ** (self.emin + 1 - self.significand)


FORMATS: Mapping[str, FloatFormat] = {
    form.name: form
    for form in (
        FloatFormat("float64", 64, 53, 11),
        FloatFormat("float32", 32, 24, 8),
        FloatFormat("tf32", 32, 11, 8),
        FloatFormat("float16", 16, 11, 5),
        FloatFormat("bfloat16", 16, 8, 8),
    )
}


def format_of(name: str) -> FloatFormat:
    """Return the floating-point format of a given name.

    Raises:
        InputError: no format has this name.
    """
    if name not in FORMATS:
        raise InputError(f"{name!r} is not a known number format; known formats are {', '.join(FORMATS)}")
    return FORMATS[name]


@jax.custom_jvp
def _identity_slope(x, rounded):
    return rounded


@_identity_slope.defjvp
def _identity_slope_jvp(primals, tangents):
    return _identity_slope(*primals), tangents[0]


def round_to(
    x: Float[Array, "..."], name: str, whole: Callable[[Array], Array] = jnp.rint
) -> Float[Array, "..."]:
    """Round x to the nearest number of a format, in the dtype of x. Ties are rounded to the even number.

    Subnormal numbers are kept (unlike in `lax.reduce_precision`). Numbers beyond the format's range become
    infinite. A float64 number is rounded once, whereas a cast may round twice. The derivative is 1.

    Args:
        x: float64 or narrower.
        name: name of the format; a format with more digits or range than the dtype of x leaves x unchanged.
        whole: another rounding of x, in units of the local spacing, to a whole number of spacings.
    """
    form = format_of(name)
    if form.significand >= 53:
        return x
    wide = lax.stop_gradient(x).astype(jnp.float64)
    # the format's spacing around x: jnp.frexp has no derivative rule for its exponent; the bits say the same
    field = (lax.bitcast_convert_type(wide, jnp.int64) >> 52) & 0x7FF
    exponent = jnp.maximum(field - 1023, form.emin) + 1 - form.significand
    # a power of two from its bits: exact, where exp2 need not be
    spacing = lax.bitcast_convert_type((jnp.maximum(exponent, -1022) + 1023) << 52, jnp.float64)
    rounded = whole(wide / spacing) * spacing
    rounded = jnp.where(jnp.abs(rounded) > form.largest, jnp.sign(wide) * jnp.inf, rounded)
    return _identity_slope(x, jnp.where(jnp.isfinite(wide), rounded, wide).astype(x.dtype))


def stochastic_round(x: Float[Array, "..."], name: str, key: Array) -> Float[Array, "..."]:
    """Round x at random to one of its two neighbors in a format.

    The result has the dtype of x. Numbers that the format can represent are unchanged. In the range of the
    format, the expected value is x. The standard deviation is at most half the spacing of numbers. A long sum
    of small terms therefore does not stagnate. The random numbers have 53 bits. The derivative of the result
    with respect to x is defined as 1. Source: Croci et al., R. Soc. Open Sci. 9, 211631 (2022).
    """

    def up_or_down(places: Array) -> Array:
        below = jnp.floor(places)
        up = jax.random.uniform(key, x.shape, jnp.float64) < places - below
        return below + up.astype(jnp.float64)

    return round_to(x, name, up_or_down)


# --- loss scaling -----------------------------------------------------------------------------------------
#
# A gradient that would fall below the smallest float16 is computed larger and divided after. The scale is the
# cotangent with which the backward pass starts, so the loss itself is not multiplied and cannot overflow.
# Unscaling happens in float64: a power of two, exact.


class ScaledGradient(NamedTuple):
    """The value of a loss and its gradient."""

    value: Float[Array, ""]  # the loss, in its own dtype
    gradient: PyTree  # as the differentiated argument, leaves in float64
    finite: Bool[Array, ""]  # whether every number of the gradient is finite
    scale: Float[Array, ""]  # the factor that was used


def scaled_gradient(function: Callable[..., Any], scale: float | Array, *args: Any) -> ScaledGradient:
    """Compute the loss `function(*args)` and its gradient with respect to the first argument.

    Args:
        function: function of arrays that returns a scalar.
        scale: a power of two (`check_scale`); if too small, gradients vanish, if too large, they overflow.
    """
    scale = jnp.asarray(scale, jnp.float64)
    value, pullback = jax.vjp(lambda first: function(first, *args[1:]), args[0])
    (gradient,) = pullback(scale.astype(value.dtype))
    gradient = jax.tree.map(lambda g: g.astype(jnp.float64) / jnp.broadcast_to(scale, g.shape), gradient)
    finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(g)) for g in jax.tree.leaves(gradient)], bool))
    return ScaledGradient(value, gradient, finite, scale)


def check_scale(scale: float) -> None:
    """Check that multiplying the loss by a scaling factor causes no rounding error.

    Raises:
        InputError: the factor is not a power of two.
    """
    if not (scale > 0 and math.frexp(scale)[0] == 0.5):
        raise InputError(
            f"the scale of the number format is {scale:g}, which is not a power of two",
            remedy="Give a power of two, because other scales cause rounding errors",
        )
