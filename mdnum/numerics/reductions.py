"""Sums that do not depend on the order of the terms. Also the registry of all summation orders.

A finite float is an integer multiple of its format's smallest subnormal number. The exact sum expresses all
terms as integers and adds them in a long accumulator of 32-bit limbs (Kulisch & Miranker 1986). The exact sum
is rounded once. The fixed-point sum rounds every term to a coarser unit. One int64 can then hold the sum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt64

from mdnum.errors import InputError
from mdnum.numerics.exact import integer_of
from mdnum.numerics.formats import FloatFormat, format_of
from mdnum.numerics.rounding import gamma, unit_roundoff
from mdnum.numerics.sums import (
    Add,
    Blocked,
    Kahan,
    Neumaier,
    Pairwise,
    Permuted,
    Reduction,
    Sequential,
    Sorted,
)
from mdnum.registry import Registry

_LIMB = 32
_MASK = 2**_LIMB - 1


def _parts(terms: Float[Array, "n columns"], form: FloatFormat) -> tuple[jax.Array, list[jax.Array]]:
    """Split each term into signed 32-bit pieces. Return the lowest piece's limb index, and all pieces."""
    bits = lax.bitcast_convert_type(terms, integer_of(terms.dtype)).astype(jnp.int64)
    magnitude = bits & ((1 << (8 * terms.dtype.itemsize - 1)) - 1)
    exponent, fraction = magnitude >> (form.significand - 1), magnitude & ((1 << (form.significand - 1)) - 1)
    digits = jnp.where(exponent > 0, fraction | (1 << (form.significand - 1)), fraction)
    # as a multiple of the smallest subnormal the term is digits * 2^shift
    shift = jnp.maximum(exponent, 1) - 1
    limb, shift = shift // _LIMB, shift % _LIMB
    low = (digits & _MASK) << shift
    pieces = [low & _MASK, low >> _LIMB]
    if form.significand > _LIMB:
        high = (digits >> _LIMB) << shift
        pieces = [pieces[0], pieces[1] + (high & _MASK), high >> _LIMB]
    sign = jnp.where(bits < 0, -1, 1)
    return limb, [sign * piece for piece in pieces]


def _carried(limbs: Int[Array, "limbs columns"]) -> tuple[Int[Array, "columns"], Int[Array, "limbs columns"]]:
    """Propagate carries between limbs. Return the final carry (-1 if negative) and limbs in [0, 2^32)."""

    def step(carry, limb):
        value = limb + carry
        return value >> _LIMB, value & _MASK

    return lax.scan(step, jnp.zeros_like(limbs[0]), limbs)


def _rounded(limbs: Int[Array, "limbs columns"], form: FloatFormat) -> UInt64[Array, "columns"]:
    """Return the bits of the nearest float to a non-negative number in limbs, ties to even."""
    count = limbs.shape[0]
    filled = limbs != 0
    place = count - 1 - jnp.argmax(filled[::-1], axis=0)

    def at(k):
        found = jnp.take_along_axis(limbs, jnp.maximum(place - k, 0)[None], axis=0)[0]
        return jnp.where(place >= k, found, 0).astype(jnp.uint64)

    top, middle, low = at(0), at(1), at(2)
    below = jnp.any(filled & (jnp.arange(count)[:, None] < place - 2), axis=0)
    # the leading bit to the left end of 64; what does not fit only says whether there is more
    leading = lax.clz(top.astype(jnp.uint32)).astype(jnp.int64)
    shift = leading.astype(jnp.uint64)
    window = (((top << _LIMB) | middle) << shift) | (low >> (jnp.uint64(_LIMB) - shift))
    more = below | (((low << shift) & jnp.uint64(_MASK)) != 0)
    length = _LIMB * (place + 1) - leading
    # a number no longer than the significand is exact, subnormal or not, and its bits are the number itself
    digits = jnp.clip(length, 1, form.significand)
    excess = jnp.maximum(length - form.significand, 0).astype(jnp.uint64)
    cut = (64 - digits).astype(jnp.uint64)
    kept, rest = window >> cut, window & ((jnp.uint64(1) << cut) - jnp.uint64(1))
    half = jnp.uint64(1) << (cut - jnp.uint64(1))
    up = (rest > half) | ((rest == half) & (more | (kept & jnp.uint64(1) == 1)))
    up = up & (excess > 0)
    bits = (excess << (form.significand - 1)) + kept + up.astype(jnp.uint64)
    infinity = jnp.uint64(form.top << (form.significand - 1))
    return jnp.where(jnp.any(filled, axis=0), jnp.minimum(bits, infinity), jnp.uint64(0))


@dataclass(frozen=True)
class Exact(Reduction):
    """The exact sum, rounded once to nearest.

    The error is at most half an ulp of the result for up to 2^31 terms. Intermediate sums do not overflow.
    Infinite and NaN terms give the result of IEEE addition.
    """

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Return the sum, computed with integer additions only."""
        dtype, shape = terms.dtype, terms.shape[1:]
        form = format_of(np.dtype(dtype).name)
        flat = terms.reshape(terms.shape[0], -1)
        place, pieces = _parts(flat, form)
        columns = jnp.broadcast_to(jnp.arange(flat.shape[1]), flat.shape)
        # two more than the largest term needs: one for its parts, one for 2^31 terms and the sign
        limbs = jnp.zeros(((form.top + form.significand) // _LIMB + 3, flat.shape[1]), jnp.int64)
        for k, piece in enumerate(pieces):
            limbs = limbs.at[place + k, columns].add(piece, mode="drop")
        out, _ = _carried(limbs)
        sign = jnp.where(out < 0, -1, 1)
        _, limbs = _carried(limbs * sign)
        negative = jnp.uint64(1 << (8 * dtype.itemsize - 1))
        bits = _rounded(limbs, form) | jnp.where(out < 0, negative, jnp.uint64(0))
        integer = jnp.dtype(f"uint{8 * dtype.itemsize}")
        total = lax.bitcast_convert_type(bits.astype(integer), dtype)
        special = jnp.any(~jnp.isfinite(flat), axis=0)
        return jnp.where(special, jnp.sum(flat, axis=0), total).reshape(shape)

    def bound(self, terms: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "..."]:
        """Return the error bound: unit roundoff times an upper bound of |sum|."""
        wide = terms.astype(np.float64)
        total = np.abs(wide.sum(axis=0)) + gamma(len(terms)) * np.abs(wide).sum(axis=0)
        return np.asarray(unit_roundoff(terms.dtype) * total)


@dataclass(frozen=True)
class FixedPoint(Reduction):
    """A fixed-point sum: every term is rounded to a multiple of 2^-bits, and the multiples are added.

    The result has the same bits for every order of the n terms. The error is at most n * 2^(-bits - 1) plus
    the rounding of the result. The result is NaN if a term exceeds 2^(62 - bits) / n, because the sum could
    overflow.
    """

    bits: int = 40  # binary digits after the point, from -1000 to 1000

    def __post_init__(self):
        if abs(self.bits) > 1000:
            raise InputError(f"bits = {self.bits} is out of range", remedy="Choose bits from -1000 to 1000.")

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Return the sum, computed with one int64 as accumulator."""
        scaled = terms.astype(jnp.float64) * 2.0**self.bits
        fits = jnp.all(jnp.abs(scaled) <= 2.0**62 / terms.shape[0], axis=0)
        total = jnp.sum(jnp.rint(jnp.where(fits, scaled, 0.0)).astype(jnp.int64), axis=0)
        value = total.astype(jnp.float64) * 2.0**-self.bits
        return jnp.where(fits, value, jnp.nan).astype(terms.dtype)

    def bound(self, terms: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "..."]:
        """Return the error bound: 2^(-bits - 1) per term, plus one rounding of the result."""
        size = np.abs(terms.astype(np.float64)).sum(axis=0)
        return np.asarray(len(terms) * 2.0 ** (-self.bits - 1) + 2 * unit_roundoff(terms.dtype) * size)


# --- by name ------------------------------------------------------------------------------------------


def _numbered(reduction: Callable[[int], Reduction], default: int) -> Callable[..., Reduction]:
    """Return a function that creates a summation order from its parameter, given as text."""

    def make(number: str | None = None) -> Reduction:
        try:
            return reduction(default if number is None else int(number))
        except ValueError:
            raise InputError(f"{number!r} is not an integer") from None

    return make


#: All orders of summation by name: "exact", "permuted:3" (random seed), "blocked:8" (width).
REDUCTIONS: Registry[Reduction] = Registry("reduction", "mdnum.reductions", kind=Reduction, separator=":")
REDUCTIONS.add("sequential", lambda: Sequential(), description="left to right, as a loop does")
REDUCTIONS.add("reversed", lambda: Sequential("reversed"), description="right to left")
REDUCTIONS.add("permuted", _numbered(Permuted, 0), description="a random order; a number is its seed")
REDUCTIONS.add("pairwise", lambda: Pairwise(), description="a balanced tree")
REDUCTIONS.add("blocked", _numbered(Blocked, 32), description="a tree; a number is the width of its nodes")
REDUCTIONS.add("kahan", lambda: Kahan(), description="a loop that carries what each addition lost")
REDUCTIONS.add("neumaier", lambda: Neumaier(), description="Kahan's for terms of any size")
REDUCTIONS.add("sorted", lambda: Sorted(), description="by magnitude, smallest first")
REDUCTIONS.add("exact", lambda: Exact(), description="exact, rounded once")
REDUCTIONS.add(
    "fixed-point", _numbered(FixedPoint, 40), description="of integers; a number is the bits after the point"
)


parse = REDUCTIONS.parse
#: Built-in orders with their default options.
BY_NAME = {name: parse(name) for name in REDUCTIONS.shipped}
