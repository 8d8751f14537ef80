"""The order in which a sum is made, as an object.

A reduction serves two callers. The force loop of molecular dynamics hands it blocks of terms (leading
axis: the slots of the block) and keeps a carry, so that the terms of a whole neighbor list never exist at
once; a reduction that needs all terms stacks them and sums at the end. Everything else hands it a whole
array and gets the sum over the leading axis, rounded after every addition in the dtype of the terms: what
a numpy loop in that dtype gives, bit for bit. `jnp.sum` is none of these: it adds sixteen-bit terms in
float32 and in an order of its own, which hides what a narrow accumulator does.

The derivative of every reduction is that of the sum: rounding and order have none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, Protocol

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from mdnum.precision.exact import fence, integer_of

Add = Callable[[jax.Array, jax.Array], jax.Array]


class Reduction(Protocol):
    """Order of a sum, over slots that arrive in blocks or over the leading axis of an array."""

    def within(self, total: jax.Array, terms: Sequence[jax.Array]) -> tuple[jax.Array, jax.Array | None]:
        """Take one block; returns the carried total and, if it is to be summed later, the block's own sum."""
        ...

    def finish(self, total: jax.Array, blocks: jax.Array | None) -> jax.Array:
        """The sum, from the carried total and the stacked block sums (leading axis: blocks)."""
        ...

    def __call__(
        self, terms: Float[Array, "n ..."], zero: Int[Array, ""] | None = None
    ) -> Float[Array, "..."]:
        """The sum over the leading axis, rounded after every addition in the dtype of the terms.

        Args:
            terms: what is summed.
            zero: an integer zero that XLA must not know (`exact.zero_bits`), for the fences. Without one,
                sixteen-bit sums take one from the data; then products that were not fenced by the caller
                may still be contracted into the sum.
        """
        ...


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _summed(reduction: Whole, terms, zero):
    if zero is None and terms.dtype.itemsize == 2:
        zero = _data_zero(terms)
    return reduction.sum_of(terms if zero is None else fence(terms, zero), _adder(zero))


@_summed.defjvp
def _summed_jvp(reduction, primals, tangents):
    terms, zero = primals
    return _summed(reduction, terms, zero), jnp.sum(tangents[0], axis=0)


def _data_zero(terms: jax.Array) -> jax.Array:
    """A zero that the compiler of array operations does not see through: the sign bit of an absolute value."""
    integer = integer_of(terms.dtype)
    bits = lax.bitcast_convert_type(jnp.abs(terms.reshape(-1)[0]), integer)
    return lax.shift_right_logical(bits, jnp.asarray(8 * terms.dtype.itemsize - 1, integer))


class Whole:
    """Base of a reduction of a whole array, with its derivative; blocks are stacked and summed at the end."""

    def within(self, total, terms):
        """Keep the block; it is summed by `finish`."""
        return total, jnp.stack(list(terms))

    def finish(self, total, blocks):
        """The sum of all blocks, in the order of their slots."""
        return self(blocks.reshape(-1, *blocks.shape[2:]))

    def __call__(
        self, terms: Float[Array, "n ..."], zero: Int[Array, ""] | None = None
    ) -> Float[Array, "..."]:
        """The sum over the leading axis (see `Reduction`)."""
        if terms.size == 0:
            return jnp.zeros(terms.shape[1:], terms.dtype)
        return _summed(self, terms, zero)

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """The sum of at least one term; `add` adds two and rounds."""
        raise NotImplementedError(type(self).__name__)


def _adder(zero: jax.Array | None) -> Add:
    return jnp.add if zero is None else lambda a, b: fence(a + b, zero)


def in_order(terms, add):
    """((0 + t0) + t1) + ..., a scan: XLA does not reorder it. Unrolled, since a step of a loop costs more
    than an addition."""
    total, _ = lax.scan(
        lambda total, term: (add(total, term), None),
        jnp.zeros(terms.shape[1:], terms.dtype),
        terms,
        unroll=min(16, terms.shape[0]),
    )
    return total


@dataclass(frozen=True)
class Sequential(Whole):
    """Term after term. Error: at most gamma_{n-1} * sum |terms| (Higham 2002, 4.4).

    Attributes:
        order: "forward" (left to right, as a loop does) or "reversed".
    """

    order: Literal["forward", "reversed"] = "forward"

    def within(self, total, terms):
        if self.order == "reversed":
            return super().within(total, terms)
        for term in terms:
            total = total + term
        return total, None

    def finish(self, total, blocks):
        return total if self.order == "forward" else super().finish(total, blocks)

    def sum_of(self, terms, add):
        return in_order(terms[::-1] if self.order == "reversed" else terms, add)


def _tree(terms: list[jax.Array]) -> jax.Array:
    while len(terms) > 1:
        pairs = [terms[k] + terms[k + 1] for k in range(0, len(terms) - 1, 2)]
        terms = pairs + terms[len(terms) - len(terms) % 2 :]
    return terms[0]


def _levels(terms, add, width: int):
    """A tree whose nodes add `width` neighbors left to right, until one node is left."""
    while terms.shape[0] > 1:
        count = terms.shape[0]
        groups = -(-count // width)
        # minus zero is the one addend that changes nothing, not even the sign of a zero
        padding = jnp.full((groups * width - count, *terms.shape[1:]), -0.0, terms.dtype)
        nodes = jnp.concatenate([terms, padding]).reshape(groups, width, *terms.shape[1:])
        total = nodes[:, 0]
        if width <= 16:
            for k in range(1, width):
                total = add(total, nodes[:, k])
        else:
            rest = jnp.moveaxis(nodes[:, 1:], 1, 0)
            total, _ = lax.scan(lambda t, x: (add(t, x), None), total, rest, unroll=16)
        terms = total
    return terms[0]


@dataclass(frozen=True)
class Pairwise(Whole):
    """A balanced tree. Error: at most gamma_{log2 n} * sum |terms| (Higham 2002, 4.6)."""

    def within(self, total, terms):
        return total, _tree(list(terms))

    def finish(self, total, blocks):
        return _tree(list(jnp.asarray(blocks)))

    def sum_of(self, terms, add):
        return _levels(terms, add, 2)
