"""Sums that frameworks make behind one's back: duplicates of a sparse tensor, segments, scattered additions.

A sparse tensor in coordinate form may list an index more than once; coalescing adds the duplicates. In
which order they are added is decided by storage order, by a sort, or by atomics, and so are the bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mdnum.errors import InputError
from mdnum.precision.orders import Reduction, Sequential


def grouped(
    index: Int[np.ndarray, "entries"], values: Float[Array, "entries ..."], segments: int
) -> Float[Array, "most segments ..."]:
    """Entries of the same index side by side, in storage order, for a reduction over the leading axis.

    Shorter groups are filled with minus zero, which changes no sum and no sign.

    Args:
        index: segment of each entry, known (not traced).
        values: the entries.
        segments: how many segments there are.

    Raises:
        InputError: an index outside 0 ... segments - 1.
    """
    index = np.asarray(index)
    if len(index) and not (index.min() >= 0 and index.max() < segments):
        raise InputError(f"an index outside 0 ... {segments - 1}")
    order = np.argsort(index, kind="stable")
    counts = np.bincount(index, minlength=segments)
    starts = np.concatenate([[0], np.cumsum(counts)])[:-1]
    place = np.arange(len(index)) - np.repeat(starts, counts)
    shape = (int(counts.max(initial=0)), segments, *values.shape[1:])
    return jnp.full(shape, -0.0, values.dtype).at[place, index[order]].set(values[order])


def segment_sum(
    values: Float[Array, "entries ..."],
    index: Int[np.ndarray, "entries"],
    segments: int,
    reduction: Reduction = Sequential(),
    zero: Int[Array, ""] | None = None,
) -> Float[Array, "segments ..."]:
    """The sum of each segment in the order of a reduction, rounded after every addition.

    Args:
        values: the entries.
        index: segment of each entry, known (not traced), not necessarily sorted.
        segments: how many segments there are.
        reduction: applied to each segment's entries in storage order.
        zero: see `Reduction`.
    """
    return reduction(grouped(index, values, segments), zero)


def scatter_add(
    values: Float[Array, "entries ..."], index: Int[Array, "entries"], segments: int
) -> Float[Array, "segments ..."]:
    """The sum of each segment as XLA's scatter makes it: in storage order on a CPU, in any on a device."""
    return jnp.zeros((segments, *values.shape[1:]), values.dtype).at[index].add(values)


@dataclass(frozen=True)
class Coordinates:
    """A sparse matrix in coordinate form, duplicates allowed.

    Attributes:
        row, column: shape (entries,).
        values: shape (entries,).
        shape: of the matrix.
    """

    row: Int[np.ndarray, "entries"]
    column: Int[np.ndarray, "entries"]
    values: Float[np.ndarray, "entries"]
    shape: tuple[int, int]

    def __post_init__(self):
        for name, index, size in (("row", self.row, self.shape[0]), ("column", self.column, self.shape[1])):
            if len(index) and not (index.min() >= 0 and index.max() < size):
                raise InputError(f"a {name} outside 0 ... {size - 1}")

    def stored(self, order: Int[np.ndarray, "entries"]) -> Coordinates:
        """The same entries in another storage order: the same matrix in exact arithmetic."""
        return replace(self, row=self.row[order], column=self.column[order], values=self.values[order])

    def coalesced(self, reduction: Reduction = Sequential(), by_value: bool = False) -> Coordinates:
        """Without duplicates, rows and columns ascending.

        Args:
            reduction: how duplicates are added.
            by_value: sort the duplicates of an index by value first, so that storage order does not matter.
        """
        flat = self.row * self.shape[1] + self.column
        keys = (self.values.astype(np.float64), flat) if by_value else (flat,)
        order = np.lexsort(keys)
        places, segment = np.unique(flat[order], return_inverse=True)
        values = segment_sum(jnp.asarray(self.values[order]), segment, len(places), reduction)
        return Coordinates(places // self.shape[1], places % self.shape[1], np.asarray(values), self.shape)

    def dense(self) -> Float[np.ndarray, "rows columns"]:
        """The matrix, duplicates added in storage order."""
        out = np.zeros(self.shape, self.values.dtype)
        for row, column, value in zip(self.row, self.column, self.values, strict=True):
            out[row, column] += value
        return out


def orders(entries: int, count: int, seed: int = 0) -> list[Int[np.ndarray, "entries"]]:
    """Storage orders to try: as given, reversed, and random ones up to `count`."""
    rng = np.random.default_rng(seed)
    given = np.arange(entries)
    return [given, given[::-1], *(rng.permutation(entries) for _ in range(count - 2))][:count]


def distinct_bits(function: Callable[[Any], Any], inputs: Iterable[Any]) -> int:
    """How many different bit patterns a function gives over inputs that should all give the same."""
    return len({tuple(np.asarray(x).tobytes() for x in jax.tree.leaves(function(one))) for one in inputs})
