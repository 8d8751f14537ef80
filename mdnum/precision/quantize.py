"""Fake quantization: a float that takes only the values that a few bits could hold.

Used where a network's or a sensor's numbers are stored in integers. The forward value is clamped, rounded
to the grid and scaled back; the derivative pretends that nothing was rounded (straight through), because
the true one is zero almost everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mdnum.errors import InputError
from mdnum.precision.exact import fence


@jax.custom_jvp
def quantize(
    x: Float[Array, "..."],
    scale: Float[Array, ""],
    lowest: Float[Array, ""],
    highest: Float[Array, ""],
) -> Float[Array, "..."]:
    """The multiple of scale nearest to x, from lowest * scale to highest * scale; all may be traced.

    Derivative 1 inside, 0 where clamped. Error: at most scale/2 inside, plus one rounding.
    """
    return jnp.clip(jnp.rint(x / jnp.broadcast_to(scale, x.shape)), lowest, highest) * scale


@quantize.defjvp
def _quantize_jvp(primals, tangents):
    x, scale, lowest, highest = primals
    inside = (x >= lowest * scale) & (x <= highest * scale)
    return quantize(*primals), jnp.where(inside, tangents[0], jnp.zeros_like(x))


@dataclass(frozen=True)
class Grid:
    """A uniform grid of 2^bits values.

    Attributes:
        bits: from 1 to 30.
        scale: distance of neighboring values.
        offset: the value of integer 0.
        signed: integers from -2^(bits-1) to 2^(bits-1) - 1, else from 0 to 2^bits - 1.
    """

    bits: int
    scale: float
    offset: float = 0.0
    signed: bool = True

    def __post_init__(self):
        if not 1 <= self.bits <= 30:
            raise InputError(f"{self.bits} bits", remedy="Give 1 to 30.")
        if not 0 < self.scale < float("inf"):
            raise InputError(f"a grid of scale {self.scale}", remedy="Give a positive number.")

    @classmethod
    def over(cls, low: float, high: float, bits: int) -> Grid:
        """The grid with its first value at low and its last at high.

        Raises:
            InputError: high is not above low.
        """
        if not low < high:
            raise InputError(f"a grid from {low} to {high}", remedy="Give an interval that is not empty.")
        return cls(bits, (high - low) / (2**bits - 1), low, signed=False)

    @property
    def range(self) -> tuple[int, int]:
        """The lowest and the highest integer."""
        if self.signed:
            return -(2 ** (self.bits - 1)), 2 ** (self.bits - 1) - 1
        return 0, 2**self.bits - 1

    @property
    def limits(self) -> tuple[float, float]:
        """The lowest and the highest value."""
        low, high = self.range
        return self.offset + low * self.scale, self.offset + high * self.scale

    def __call__(self, x: Float[Array, "..."], zero: Int[Array, ""] | None = None) -> Float[Array, "..."]:
        """x clamped to the limits and rounded to the grid, ties to even; derivative 1 inside, 0 outside.

        Error: at most scale/2 inside the limits, plus the rounding of the dtype of x.

        Args:
            x: any shape.
            zero: an integer zero that XLA must not know (`exact.zero_bits`): with it the bits are those of
                numpy; without, the last product may be contracted into the sum with the offset.
        """
        low, high = (jnp.asarray(q, x.dtype) for q in self.range)
        scale, offset = jnp.asarray(self.scale, x.dtype), jnp.asarray(self.offset, x.dtype)
        value = quantize(x - offset, scale, low, high)
        return offset + (value if zero is None else fence(value, zero))


def fake_quantize(
    x: Float[Array, "..."], bits: int, scale: float, offset: float = 0.0, signed: bool = True
) -> Float[Array, "..."]:
    """x on a grid of 2^bits values with a straight-through derivative (see `Grid`)."""
    return Grid(bits, scale, offset, signed)(x)
