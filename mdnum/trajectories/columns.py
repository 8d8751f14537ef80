"""Flips as the columns of a ledger: sorted, in the file's numbers, each with its two margins."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.trajectories.table import Flips

# flips in a part, about
_PART = 2048


@dataclass(frozen=True)
class Thresholds:
    """What distances are compared with at two frames.

    Attributes:
        directed: whether they are those of an atom; else those of a pair of species.
        species: of each atom that takes part.
        radii: by species, length.
        last_in, first_out: of each atom, now, length; see `nearest.Chosen`.
        old_last_in, old_first_out: of each atom, at the frame before, length.
    """

    directed: bool
    species: Int[np.ndarray, "atoms"]
    radii: Float[np.ndarray, "species species"]
    last_in: Float[np.ndarray, "limits"]
    first_out: Float[np.ndarray, "limits"]
    old_last_in: Float[np.ndarray, "old_limits"]
    old_first_out: Float[np.ndarray, "old_limits"]


@dataclass(frozen=True)
class Changed:
    """Decisions that differ between two frames, in no order.

    Attributes:
        i, j: indices among the atoms that take part.
        rank: image, as in `Flips`.
        entered: whether the pair is inside now.
        distance, before: now, and at the frame before, length.
    """

    i: Int[np.ndarray, "flips"]
    j: Int[np.ndarray, "flips"]
    rank: Int[np.ndarray, "flips"]
    entered: Bool[np.ndarray, "flips"]
    distance: Float[np.ndarray, "flips"]
    before: Float[np.ndarray, "flips"]


class Ledger:
    """Makes the rows of frame after frame.

    Args:
        labels: numbers in the file of the atoms that take part.
        atoms: of the file.
    """

    def __init__(self, labels: Int[np.ndarray, "participants"], atoms: int):
        self.labels, self.atoms = labels, atoms
        # kept from frame to frame: pages that are new to a process can cost more than what is done in them
        self._rows = np.empty((0, 7))

    def flips(self, frame: int, changed: Changed, thresholds: Thresholds, bound: float) -> Flips:
        """The rows of one frame.

        Args:
            frame: its position among the frames looked at.
            changed: indices among the atoms that take part.
            thresholds: what the distances are compared with.
            bound: how far a margin can be off, length.
        """
        count, ranks = len(changed.i), int(changed.rank.max(initial=0)) + 1
        if len(self._rows) < count:
            self._rows = np.empty((count + count // 8, 7))
        # parts of the atoms, each of whose flips fit into a core's cache
        shift = max(int(self.atoms).bit_length() - max(count // _PART, 1).bit_length(), 0)
        start = np.zeros((max(self.atoms, 1) - 1 >> shift) + 2, np.int64)
        _parted(
            changed.i, changed.j, changed.rank, changed.entered, changed.distance, changed.before,
            self.labels, ranks, shift, start, self._rows, *vars(thresholds).values(),
        )  # fmt: skip
        first, second, rank = (np.empty(count, np.int64) for _ in range(3))
        distance, distance_before, margin, margin_before = (np.empty(count) for _ in range(4))
        entered, ambiguous = (np.empty(count, np.bool_) for _ in range(2))
        _sorted(
            start, shift, self._rows, ranks, bound, first, second, rank,
            distance, distance_before, margin, margin_before, entered, ambiguous,
        )  # fmt: skip
        return Flips(
            np.full(count, frame), first, second, rank, entered,
            distance, distance_before, margin, margin_before, np.full(count, bound), ambiguous,
        )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _parted(
    i, j, rank, entered, distance, before, labels, ranks, shift, start, rows,
    directed, species, radii, last_in, first_out, old_last_in, old_first_out,
):  # fmt: skip
    """Rows (first, key, distance, before, margin, margin_before, entered), part by part of the first atoms.

    Whole numbers among them are small enough for float64. What belongs together is moved together: where
    there are millions, a place in memory is dear, and its width is not.
    """
    for k in range(i.shape[0]):
        one, other = labels[i[k]], labels[j[k]]
        start[((one if directed else min(one, other)) >> shift) + 1] += 1
    for part in range(1, start.shape[0]):
        start[part] += start[part - 1]
    cursor = start.copy()
    for k in range(i.shape[0]):
        a, yes = i[k], entered[k]
        one, other = labels[a], labels[j[k]]
        if directed:
            limit = last_in[a] if yes else first_out[a]
            old_limit = old_first_out[a] if yes else old_last_in[a]
        else:
            one, other = min(one, other), max(one, other)
            limit = radii[species[a], species[j[k]]]
            old_limit = limit
        part = one >> shift
        at = cursor[part]
        cursor[part] = at + 1
        rows[at, 0], rows[at, 1] = one, other * ranks + rank[k]
        rows[at, 2], rows[at, 3] = distance[k], before[k]
        rows[at, 4], rows[at, 5], rows[at, 6] = limit - distance[k], old_limit - before[k], yes


@numba.njit(cache=True, nogil=True)
def _sorted(
    start, shift, rows, ranks, bound,
    first, second, rank, distance, before, margin, margin_before, entered, ambiguous,
):  # fmt: skip
    """The columns, in order: in each part a counting sort by the first atom, and then each atom's few."""
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
            first[at], second[at], rank[at] = np.int64(rows[k, 0]), key, 0
            if ranks > 1:
                second[at], rank[at] = key // ranks, key % ranks
            distance[at], before[at] = rows[k, 2], rows[k, 3]
            margin[at], margin_before[at] = rows[k, 4], rows[k, 5]
            entered[at] = rows[k, 6] != 0.0
            ambiguous[at] = abs(rows[k, 4]) <= bound or abs(rows[k, 5]) <= bound
