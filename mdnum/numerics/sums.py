"""Summation orders and their error bounds.

A summation order is used in two ways. The force loop adds blocks of terms, and carries a partial sum from
block to block. The terms of a whole neighbor list are therefore never stored at once. An order that needs all
terms stores the terms and adds them at the end. Code outside of the force loop passes a whole array, and gets
the sum over its first axis. The sum is rounded after every addition. A numpy loop in the dtype of the terms
gives the same bits. `jnp.sum`, in contrast, adds 16-bit terms in float32.

The derivative of every sum is that of the exact sum.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from mdnum.errors import InputError
from mdnum.numerics.exact import fence, integer_of
from mdnum.numerics.rounding import gamma, unit_roundoff

Add = Callable[[jax.Array, jax.Array], jax.Array]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _summed(reduction: Reduction, terms, zero):
    if zero is None and terms.dtype.itemsize == 2:
        # a zero that XLA cannot fold: the sign bit of an absolute value
        integer = integer_of(terms.dtype)
        bits = lax.bitcast_convert_type(jnp.abs(terms.reshape(-1)[0]), integer)
        zero = lax.shift_right_logical(bits, jnp.asarray(8 * terms.dtype.itemsize - 1, integer))
    if zero is None:
        return reduction.sum_of(terms, jnp.add)
    return reduction.sum_of(fence(terms, zero), lambda a, b: fence(a + b, zero))


@_summed.defjvp
def _summed_jvp(reduction, primals, tangents):
    terms, zero = primals
    return _summed(reduction, terms, zero), jnp.sum(tangents[0], axis=0)


# called outside of jit, a sum is one program all the same: operation by operation it would take seconds
_compiled = partial(jax.jit, static_argnums=0)(_summed)


class Reduction:
    """Base class of summation orders.

    A subclass defines the sum of a whole array. By default, blocks are stacked and summed at the end.
    """

    def within(self, total: jax.Array, terms: Sequence[jax.Array]) -> tuple[jax.Array, jax.Array | None]:
        """Process a block of terms. Return the partial sum, and data for `finish` (or None)."""
        return total, jnp.stack(list(terms))

    def finish(self, total: jax.Array, blocks: jax.Array | None) -> jax.Array:
        """Return the sum, from the partial sum and the stacked results of the blocks."""
        assert blocks is not None
        return self(blocks.reshape(-1, *blocks.shape[2:]))

    def __call__(
        self, terms: Float[Array, "n ..."], zero: Int[Array, ""] | None = None
    ) -> Float[Array, "..."]:
        """Return the sum over the first axis, rounded after every addition.

        Args:
            terms: the terms of the sum.
            zero: an integer zero that XLA must not know (`exact.zero_bits`), for the fences. Without it,
                sixteen-bit sums take a zero from the data; then products that were not fenced by the caller
                may still be contracted into the sum.
        """
        if terms.size == 0:
            return jnp.zeros(terms.shape[1:], terms.dtype)
        return _compiled(self, terms, zero)

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Return the sum of one or more terms. The function `add` adds two numbers and rounds."""
        raise NotImplementedError(type(self).__name__)

    def bound(self, terms: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "..."]:
        """Return a bound on the difference between the computed and the exact sum, in float64.

        The bound holds if no sum overflows or is subnormal. On CPUs, XLA sets subnormal numbers to zero in
        every dtype except float16.
        """
        factor = gamma(self.depth(len(terms)), terms.dtype)
        return np.asarray((factor if factor >= 0 else np.inf) * np.abs(terms.astype(np.float64)).sum(axis=0))

    def depth(self, n: int) -> int:
        """Return the largest number of additions that one of n terms passes through."""
        return max(n - 1, 0)


def in_order(terms, add, start=None):
    """Return ((0 + t0) + t1) + ... by a scan. XLA does not reorder a scan. The scan is unrolled, because loop
    steps are slower than additions.
    """
    total, _ = lax.scan(
        lambda total, term: (add(total, term), None),
        jnp.zeros(terms.shape[1:], terms.dtype) if start is None else start,
        terms,
        unroll=min(16, terms.shape[0]),
    )
    return total


@dataclass(frozen=True)
class Sequential(Reduction):
    """A sum in forward or reversed order. The error bound is gamma_{n-1} * sum |terms| (Higham 2002, 4.4)."""

    # "forward" (left to right, as a loop does) or "reversed"
    order: Literal["forward", "reversed"] = "forward"

    def within(self, total, terms):
        """Add the terms in forward order. In reversed order, return the terms."""
        if self.order == "reversed":
            return super().within(total, terms)
        for term in terms:
            total = total + term
        return total, None

    def finish(self, total, blocks):
        """Return the partial sum. In reversed order, add the stored terms."""
        return total if self.order == "forward" else super().finish(total, blocks)

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Add the terms one after the other, starting from zero."""
        return in_order(terms[::-1] if self.order == "reversed" else terms, add)


def _tree(terms: list[jax.Array]) -> jax.Array:
    while len(terms) > 1:
        pairs = [terms[k] + terms[k + 1] for k in range(0, len(terms) - 1, 2)]
        terms = pairs + terms[len(terms) - len(terms) % 2 :]
    return terms[0]


def _levels(terms, add, width: int):
    """Sum by a tree: add groups of `width` adjacent terms until one number is left."""
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
class Blocked(Reduction):
    """A summation tree, as on GPUs: each node adds `width` adjacent terms from left to right.

    The error is at most gamma_{(width - 1) * levels} * sum |terms|. Width 2 gives the balanced tree. A width
    of at least the number of terms gives a sequential loop.
    """

    width: int = 32  # children of a node, at least 2

    def __post_init__(self):
        if self.width < 2:
            raise InputError(f"a summation tree cannot have width {self.width}", remedy="Set width above 1")

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Add the terms level by level in the tree."""
        return _levels(terms, add, self.width)

    def depth(self, n: int) -> int:
        """Return (width - 1) times the number of levels."""
        levels = 0
        while n > 1:
            n, levels = -(-n // self.width), levels + 1
        return (self.width - 1) * levels


@dataclass(frozen=True)
class Pairwise(Blocked):
    """A balanced summation tree. The error is at most gamma_{log2 n} * sum |terms| (Higham 2002, 4.6)."""

    width: int = field(default=2, init=False)

    def within(self, total, terms):
        """Sum one block by a balanced tree."""
        return total, _tree(list(terms))

    def finish(self, total, blocks):
        """Sum the block sums by a balanced tree."""
        return _tree(list(jnp.asarray(blocks)))


@dataclass(frozen=True)
class Permuted(Reduction):
    """A sequential sum in a random order: a reproducible model of atomic additions on a GPU."""

    seed: int = 0  # of the order; the same for every sum of as many terms

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Add the terms in a random order. This order depends only on the seed and the number of terms."""
        return in_order(terms[np.random.default_rng(self.seed).permutation(len(terms))], add)


@dataclass(frozen=True)
class Halves(Reduction):
    """The sum of the first half of the terms plus the sum of the second half, each added sequentially.

    Scatter operations over pairs, one for each atom of a pair, add the two halves in turn.
    The error is at most gamma_{n/2} * sum |terms| for n terms.
    """

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Add the sums of both halves. The second half has the odd term."""
        half = terms.shape[0] // 2
        if half == 0:
            return in_order(terms, add)
        return add(in_order(terms[:half], add), in_order(terms[half:], add))

    def depth(self, n: int) -> int:
        """Return the number of additions in the longer half, plus one."""
        return n - n // 2 if n > 1 else 0


@dataclass(frozen=True)
class Twice(Reduction):
    """A sequential sum in two passes, each of which adds all terms divided by 2.

    A scatter operation adds each halved term twice if the list stores each pair for both atoms. The error is
    at most gamma_{2n} * sum |terms| for n terms without subnormal halves.
    """

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Add all halved terms twice. Halving is exact."""
        halves = terms * jnp.asarray(0.5, terms.dtype)
        return in_order(halves, add, in_order(halves, add))

    def depth(self, n: int) -> int:
        """Return the largest number of additions that one term passes through, in both passes."""
        return max(2 * n - 1, 0)


@dataclass(frozen=True)
class Sorted(Reduction):
    """A sequential sum of terms sorted by magnitude and sign, so that the storage order does not matter.

    Ascending order has the smallest error if all terms have the same sign (Higham 2002, 4.2). Descending
    order is best if terms cancel.
    """

    order: Literal["ascending", "descending"] = "ascending"  # of magnitudes, "ascending" or "descending"

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Sort the terms along the first axis and add them."""
        _, terms = lax.sort((jnp.abs(terms), terms), dimension=0, num_keys=2)
        return in_order(terms if self.order == "ascending" else terms[::-1], add)


# --- compensated: the rounding error of every addition is computed exactly and carried along ------------


def _start(terms: jax.Array) -> tuple[jax.Array, jax.Array]:
    zeros = jnp.zeros(terms.shape[1:], terms.dtype)
    return zeros, zeros


class _Compensated(Reduction):
    def bound(self, terms: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "..."]:
        """Return the error bound (2u + 8(n u)²) * sum |terms|, for n well below 1/u (Higham 2002, 4.3)."""
        u, n = unit_roundoff(terms.dtype), len(terms)
        factor = 2 * u + 8 * (n * u) ** 2 if n * u < 0.1 else np.inf
        return np.asarray(factor * np.abs(terms.astype(np.float64)).sum(axis=0))


@dataclass(frozen=True)
class Kahan(_Compensated):
    """Compensated summation: the error of each addition is subtracted from the next term (Kahan 1965).

    The error is at most (2u + O(n u²)) * sum |terms|. The compensation fails for a term much larger than the
    partial sum. Source: Kahan, CACM 8, 40 (1965).
    """

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Sum the terms with four additions for each term."""

        def step(carry, term):
            total, lost = carry
            addend = add(term, -lost)
            new = add(total, addend)
            return (new, add(add(new, -total), -addend)), None

        (total, _), _ = lax.scan(step, _start(terms), terms, unroll=min(4, terms.shape[0]))
        return total


@dataclass(frozen=True)
class Neumaier(_Compensated):
    """Compensated summation that accumulates all rounding errors separately and adds them at the end.

    The error is at most u |sum| + O(n² u²) * sum |terms|. Source: Neumaier, ZAMM 54, 39 (1974).
    """

    def sum_of(self, terms: jax.Array, add: Add) -> jax.Array:
        """Sum the terms with four additions per term and one final addition."""

        def step(carry, term):
            total, lost = carry
            new = add(total, term)
            larger = jnp.abs(total) >= jnp.abs(term)
            big, small = jnp.where(larger, total, term), jnp.where(larger, term, total)
            return (new, add(lost, add(add(big, -new), small))), None

        (total, lost), _ = lax.scan(step, _start(terms), terms, unroll=min(4, terms.shape[0]))
        return add(total, lost)
