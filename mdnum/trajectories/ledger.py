"""Flips between consecutive frames as columns: sorted, in the file's numbers, each with its two margins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.trajectories.search import Changed

# flips in a part, about
_PART = 2048


class Columns:
    """A table: equally long columns, the fields of a frozen dataclass in their order."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self, rows: Any) -> Any:
        return type(self)(*(column[rows] for column in vars(self).values()))

    def equals(self, other: Columns) -> bool:
        """Whether all columns are the same to the last bit."""
        return all(map(np.array_equal, vars(self).values(), vars(other).values()))

    @classmethod
    def concatenate(cls, parts: Sequence[Any]) -> Any:
        """The rows of parts, one after the other; at least one part."""
        return cls(*map(np.concatenate, zip(*(vars(one).values() for one in parts), strict=True)))


@dataclass(frozen=True)
class Members(Columns):
    """The pairs inside at one frame, sorted by (i, j, rank), each once.

    Attributes:
        i: first atom, an index into the file's atoms. Where a rule is symmetric, i <= j.
        j: second atom; i == j for an atom and an image of itself.
        rank: 0 for the nearest image of j, 1 for the next, and so on. A name for images that wrapping an
            atom back into its box does not change.
        distance: length.
    """

    i: Int[np.ndarray, "pairs"]
    j: Int[np.ndarray, "pairs"]
    rank: Int[np.ndarray, "pairs"]
    distance: Float[np.ndarray, "pairs"]

    @classmethod
    def none(cls) -> Members:
        """No pair."""
        none = np.zeros(0, np.int64)
        return cls(none, none, none, np.zeros(0))


@dataclass(frozen=True)
class FlipTable(Columns):
    """A row per decision that differs from the frame before, sorted by (frame, i, j, rank).

    Attributes:
        frame: position among the frames looked at (not the number in the file); never 0.
        i: first atom, as in `Members`.
        j: second atom.
        rank: image, as in `Members`.
        entered: whether the pair is inside at `frame`.
        distance: at `frame`, length.
        before: distance at the frame before, length; nan where it is not known.
        margin: signed distance to the threshold at `frame`, positive inside, length.
        margin_before: the same at the frame before; nan where it is not known.
        bound: how far a margin can be off through the file's resolution and rounding, length.
        ambiguous: one of the two margins is within the bound: the file cannot tell that the flip happened.
    """

    frame: Int[np.ndarray, "flips"]
    i: Int[np.ndarray, "flips"]
    j: Int[np.ndarray, "flips"]
    rank: Int[np.ndarray, "flips"]
    entered: Bool[np.ndarray, "flips"]
    distance: Float[np.ndarray, "flips"]
    before: Float[np.ndarray, "flips"]
    margin: Float[np.ndarray, "flips"]
    margin_before: Float[np.ndarray, "flips"]
    bound: Float[np.ndarray, "flips"]
    ambiguous: Bool[np.ndarray, "flips"]

    @classmethod
    def none(cls) -> FlipTable:
        """No row."""
        whole, real, yes = np.zeros(0, np.int64), np.zeros(0), np.zeros(0, bool)
        return cls(whole, whole, whole, whole, yes, real, real, real, real, real, yes)


class Thresholds(NamedTuple):
    """What distances are compared with at two frames."""

    directed: bool  # whether they are those of an atom; else those of a pair of species
    species: Int[np.ndarray, "atoms"]  # of each atom that takes part
    radii: Float[np.ndarray, "species species"]  # by species, length
    last_in: Float[np.ndarray, "limits"]  # of each atom, now, length; see `search.Chosen`
    first_out: Float[np.ndarray, "limits"]
    old_last_in: Float[np.ndarray, "old_limits"]  # of each atom, at the frame before, length
    old_first_out: Float[np.ndarray, "old_limits"]


class LedgerRows:
    """Makes the rows of frame after frame; labels are the numbers in the file of the atoms that take part."""

    def __init__(self, labels: Int[np.ndarray, "participants"], atoms: int):
        self.labels, self.atoms = labels, atoms
        # kept from frame to frame: pages that are new to a process can cost more than what is done in them
        self._rows = np.empty((0, 7))

    def flips(
        self,
        frame: int,
        changed: Changed,
        distances: tuple[Float[np.ndarray, "flips"], Float[np.ndarray, "flips"]],
        thresholds: Thresholds,
        bound: float,
    ) -> FlipTable:
        """The rows of one frame from indices among the atoms that take part, and distances now and before."""
        count, ranks = len(changed.i), int(changed.rank.max(initial=0)) + 1
        if len(self._rows) < count:
            self._rows = np.empty((count + count // 8, 7))
        # parts of the atoms, each of whose flips fit into a core's cache
        shift = max(int(self.atoms).bit_length() - max(count // _PART, 1).bit_length(), 0)
        start = np.zeros((max(self.atoms, 1) - 1 >> shift) + 2, np.int64)
        _parted(changed, *distances, self.labels, ranks, shift, start, self._rows, thresholds)
        *columns, ambiguous = _sorted(start, shift, self._rows, ranks, bound, count)
        columns = [np.full(count, frame), *columns, np.full(count, bound), ambiguous]
        return FlipTable(*columns)


@numba.njit(cache=True, nogil=True)
def _parted(changed, distance, before, labels, ranks, shift, start, rows, of):
    """Rows (first, key, distance, before, margin, margin_before, entered), part by part of the first atoms.

    Integers among them are small enough for float64. What belongs together is moved together: where there are
    millions, a place in memory is dear, and its width is not.
    """
    i, j, directed = changed.i, changed.j, of.directed
    for k in range(i.shape[0]):
        one, other = labels[i[k]], labels[j[k]]
        start[((one if directed else min(one, other)) >> shift) + 1] += 1
    for part in range(1, start.shape[0]):
        start[part] += start[part - 1]
    cursor = start.copy()
    for k in range(i.shape[0]):
        a, yes = i[k], changed.entered[k]
        one, other = labels[a], labels[j[k]]
        if directed:
            limit = of.last_in[a] if yes else of.first_out[a]
            old_limit = of.old_first_out[a] if yes else of.old_last_in[a]
        else:
            one, other = min(one, other), max(one, other)
            limit = of.radii[of.species[a], of.species[j[k]]]
            old_limit = limit
        part = one >> shift
        at = cursor[part]
        cursor[part] = at + 1
        rows[at, 0], rows[at, 1] = one, other * ranks + changed.rank[k]
        rows[at, 2], rows[at, 3] = distance[k], before[k]
        rows[at, 4], rows[at, 5], rows[at, 6] = limit - distance[k], old_limit - before[k], yes


@numba.njit(cache=True, nogil=True)
def _sorted(start, shift, rows, ranks, bound, count):
    """The columns, in order: in each part a counting sort by the first atom, and then each atom's few."""
    i, j, rank = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64)
    distance, before = np.empty(count), np.empty(count)
    margin, margin_before = np.empty(count), np.empty(count)
    entered, ambiguous = np.empty(count, np.bool_), np.empty(count, np.bool_)
    cursor = np.empty((1 << shift) + 1, np.int64)
    most = 0
    for part in range(start.shape[0] - 1):
        most = max(most, start[part + 1] - start[part])
    order = np.empty(most, np.int64)
    for part in range(start.shape[0] - 1):
        low, high, lowest = start[part], start[part + 1], part << shift
        cursor[:] = 0
        for k in range(low, high):
            cursor[np.int64(rows[k, 0]) - lowest + 1] += 1
        for a in range(1, cursor.shape[0]):
            cursor[a] += cursor[a - 1]
        for k in range(low, high):
            a = np.int64(rows[k, 0]) - lowest
            order[cursor[a]] = k
            cursor[a] += 1
        # a cursor now stands where the next atom begins
        begin = 0
        for a in range(cursor.shape[0] - 1):
            end = cursor[a]
            # Shell's sort: that of a card player for a few, and no worse than others for many
            gap = 1
            while 9 * gap < end - begin:
                gap = 3 * gap + 1
            while gap > 0:
                for m in range(begin + gap, end):
                    k, at = order[m], m
                    key = rows[k, 1]
                    while at >= begin + gap and rows[order[at - gap], 1] > key:
                        order[at] = order[at - gap]
                        at -= gap
                    order[at] = k
                gap //= 3
            begin = end
        for m in range(high - low):
            k, at = order[m], low + m
            key = np.int64(rows[k, 1])
            i[at], j[at], rank[at] = np.int64(rows[k, 0]), key, 0
            if ranks > 1:
                j[at], rank[at] = key // ranks, key % ranks
            distance[at], before[at], margin[at], margin_before[at] = (
                rows[k, 2],
                rows[k, 3],
                rows[k, 4],
                rows[k, 5],
            )
            entered[at] = rows[k, 6] != 0.0
            ambiguous[at] = abs(rows[k, 4]) <= bound or abs(rows[k, 5]) <= bound
    return i, j, rank, entered, distance, before, margin, margin_before, ambiguous
