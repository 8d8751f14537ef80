"""What every pair did over the frames: flips by pair rather than by frame, and every stay inside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from mdnum.trajectories.ledger import FlipTable, Members

# a pair's three numbers are packed into one where they fit: sorting one column is ten times as fast
_ROOM = 2**62


class Sums:
    """Counts of some of the pairs, to which those of others are added field by field; None stays None."""

    # what is the same for all pairs
    _common: tuple[str, ...] = ()

    def __add__(self, other: Any) -> Any:
        summed = {}
        for field in fields(self):  # type: ignore[arg-type] -- a dataclass
            mine, theirs = getattr(self, field.name), getattr(other, field.name)
            keep = mine is None or field.name in self._common
            summed[field.name] = mine if keep else mine + theirs
        return type(self)(**summed)


@dataclass(frozen=True)
class History:
    """Pairs that were ever inside or flipped, each with its flips in the order of frames.

    Attributes:
        i, j, rank: the pairs, sorted, each once; see `ledger.Members`.
        inside: whether each was inside at the first frame.
        rows: flips of pair p are rows `rows[p]` to `rows[p + 1]` of what follows.
        frame: position among the frames examined, from 1.
        entered: whether the pair is inside at that frame.
        ambiguous: whether the file's resolution may have made each flip.
        frames: frames examined.
    """

    i: Int[np.ndarray, "pairs"]
    j: Int[np.ndarray, "pairs"]
    rank: Int[np.ndarray, "pairs"]
    inside: Bool[np.ndarray, "pairs"]
    rows: Int[np.ndarray, "pairs_and_one"]
    frame: Int[np.ndarray, "flips"]
    entered: Bool[np.ndarray, "flips"]
    ambiguous: Bool[np.ndarray, "flips"]
    frames: int

    @classmethod
    def of(
        cls,
        flips: FlipTable | Mapping[str, np.ndarray],
        first: Members | Mapping[str, np.ndarray],
        frames: int,
    ) -> History:
        """The histories behind a ledger.

        Args:
            flips: all flips of some of the pairs, in the order of frames, or their columns frame, entered, i,
                j, rank and ambiguous.
            first: those of the pairs that are inside at the first frame, or their columns i, j and rank.
            frames: frames examined, at least 1.
        """
        if not isinstance(flips, Mapping):
            flips = vars(flips)
        if not isinstance(first, Mapping):
            first = vars(first)
        if frames < 1:
            raise ValueError(f"frames = {frames}; a history has at least one")
        starts, count = len(first["i"]), len(flips["frame"])
        columns = [np.concatenate([first[name], flips[name]]).astype(np.int64) for name in ("i", "j", "rank")]
        # first what was inside, then the flips as they came: a stable sort keeps that order in each pair
        order, new = _grouped(columns)
        pairs = np.cumsum(new) - 1
        heads = order[np.flatnonzero(new)]
        flip = order >= starts
        inside = np.zeros(len(heads), bool)
        inside[pairs[~flip]] = True
        rows = np.zeros(len(heads) + 1, np.int64)
        rows[1:] = np.cumsum(np.bincount(pairs[flip], minlength=len(heads))) if count else 0
        source = order[flip] - starts
        i, j, rank = (column[heads] for column in columns)
        frame, entered, ambiguous = (
            np.asarray(flips[name])[source] for name in ("frame", "entered", "ambiguous")
        )
        return cls(i, j, rank, inside, rows, frame, entered, ambiguous, frames)

    def __len__(self) -> int:
        return len(self.i)

    @property
    def flips(self) -> Int[np.ndarray, "pairs"]:
        """Flips of each pair."""
        return np.diff(self.rows)

    @property
    def pair(self) -> Int[np.ndarray, "flips"]:
        """The pair of each flip."""
        return np.repeat(np.arange(len(self)), self.flips)

    @property
    def last(self) -> Bool[np.ndarray, "pairs"]:
        """Whether each pair is inside at the last frame."""
        return self.inside ^ (self.flips % 2 == 1)

    def broken(self) -> Int[np.ndarray, "broken"]:
        """Pairs that enter while inside or leave while outside: a flip of theirs is missing."""
        pair = self.pair
        # the nth flip of a pair enters if the pair was outside and n is even, or inside and n is odd
        turn = np.arange(len(self.frame)) - self.rows[:-1][pair]
        expected = self.inside[pair] ^ (turn % 2 == 0)
        return np.unique(pair[expected != self.entered])


def _grouped(columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """A stable order that sorts by all columns, and in that order which rows differ from the one before."""
    if not len(columns[0]):
        return np.zeros(0, np.int64), np.zeros(0, bool)
    sizes = [int(column.max()) + 1 for column in columns]
    if sizes[0] * sizes[1] * sizes[2] < _ROOM and min(int(column.min()) for column in columns) >= 0:
        packed = (columns[0] * sizes[1] + columns[1]) * sizes[2] + columns[2]
        order = np.argsort(packed, kind="stable")
        changed = np.diff(packed[order]) != 0
    else:
        order = np.lexsort(columns[::-1])
        changed = np.any([np.diff(column[order]) != 0 for column in columns], axis=0)
    return order, np.concatenate([[True], changed])


@dataclass(frozen=True)
class Contacts:
    """Stays inside, sorted by (i, j, rank, begin).

    The frames say no more than that a pair was inside at `begin`, ..., `end - 1`: it entered some time
    between the frames `begin - 1` and `begin`, and it may have been outside for a while between two frames.

    Attributes:
        i, j, rank: the pair; see `ledger.Members`.
        begin: first frame inside, a position among the frames examined.
        end: first frame outside again; the number of frames where that was not seen.
        began: whether the pair was seen to enter. If not the stay is censored on the left: it is older than
            it looks.
        ended: whether it was seen to leave. If not the stay is censored on the right: it goes on.
    """

    i: Int[np.ndarray, "stays"]
    j: Int[np.ndarray, "stays"]
    rank: Int[np.ndarray, "stays"]
    begin: Int[np.ndarray, "stays"]
    end: Int[np.ndarray, "stays"]
    began: Bool[np.ndarray, "stays"]
    ended: Bool[np.ndarray, "stays"]

    def __len__(self) -> int:
        return len(self.i)

    @property
    def length(self) -> Int[np.ndarray, "stays"]:
        """Frames inside."""
        return self.end - self.begin


def contacts(history: History) -> Contacts:
    """The stays inside of every pair.

    Raises:
        ValueError: flips of a pair do not enter and leave in turn (see `History.broken`).
    """
    if len(history.broken()):
        raise ValueError("flips are missing: a pair enters while inside, or leaves while outside")
    pair = history.pair
    there, stayed = np.flatnonzero(history.inside), np.flatnonzero(history.last)
    enters, leaves = history.entered, ~history.entered
    # a pair inside at the first frame has one begin more, before its others; one inside at the last, one end
    begin_pair = np.concatenate([there, pair[enters]])
    begin = np.concatenate([np.zeros(len(there), np.int64), history.frame[enters]])
    end_pair = np.concatenate([pair[leaves], stayed])
    end = np.concatenate([history.frame[leaves], np.full(len(stayed), history.frames)])
    first, second = (np.argsort(one, kind="stable") for one in (begin_pair, end_pair))
    of = begin_pair[first]
    return Contacts(
        history.i[of],
        history.j[of],
        history.rank[of],
        begin[first],
        end[second],
        first >= len(there),
        second < len(pair) - int(np.count_nonzero(enters)),
    )


def mended(stays: Contacts, gap: int) -> Contacts:
    """Intermittent contacts: stays of a pair that are at most so many frames apart count as one.

    Args:
        gap: frames outside that are overlooked; 0 changes nothing.
    """
    if gap < 1 or not len(stays):
        return stays
    same = np.all([column[1:] == column[:-1] for column in (stays.i, stays.j, stays.rank)], axis=0)
    joined = same & (stays.begin[1:] - stays.end[:-1] <= gap)
    heads = np.flatnonzero(np.concatenate([[True], ~joined]))
    tails = np.flatnonzero(np.concatenate([~joined, [True]]))
    values = {one.name: getattr(stays, one.name)[heads] for one in fields(Contacts)}
    return Contacts(**{**values, "end": stays.end[tails], "ended": stays.ended[tails]})
