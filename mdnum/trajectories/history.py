"""Flips and contacts of pairs in a trajectory. Flips are also counted for every nth frame.

From these counts, the module `lost` estimates the flips missed between frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.bits import digit_order
from mdnum.md.ledger import Columns, FlipTable, Members
from mdnum.trajectories.frame import Frame

# a pair's three numbers are packed into one where they fit: sorting one column is far faster
_ROOM = 2**62


class Sums:
    """Counts for a subset of the atom pairs. Counts of two subsets can be added."""

    # what is the same for all pairs
    _common: tuple[str, ...] = ()

    def __add__(self, other: Any) -> Any:
        both = {name: (mine, getattr(other, name)) for name, mine in vars(self).items()}
        return type(self)(
            **{name: a if a is None or name in self._common else a + b for name, (a, b) in both.items()}
        )


@dataclass(frozen=True)
class History:
    """Flips of each pair that was ever inside the cutoff, in frame order."""

    i: Int[np.ndarray, "pairs"]  # the pairs, sorted, each once; see `ledger.Members`
    j: Int[np.ndarray, "pairs"]
    rank: Int[np.ndarray, "pairs"]
    inside: Bool[np.ndarray, "pairs"]  # at the first frame
    rows: Int[np.ndarray, "pairs_and_one"]  # flips of pair p are rows[p] to rows[p + 1] of what follows
    frame: Int[np.ndarray, "flips"]  # position among the frames examined, from 1
    entered: Bool[np.ndarray, "flips"]  # whether the pair is inside at that frame
    ambiguous: Bool[np.ndarray, "flips"]  # whether the file's resolution may have made the flip
    frames: int  # examined

    @classmethod
    def of(
        cls,
        flips: FlipTable | Mapping[str, np.ndarray],
        first: Members | Mapping[str, np.ndarray],
        frames: int,
    ) -> History:
        """Build the histories of pairs from a ledger of flips.

        Args:
            flips: all flips of a subset of the pairs, in frame order: a table, or its columns frame, entered,
                i, j, rank and ambiguous.
            first: the pairs of this subset inside at the first frame: a table, or its columns i, j and rank.
            frames: number of frames examined, at least 1.
        """
        flips, first = (one if isinstance(one, Mapping) else vars(one) for one in (flips, first))
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
        told = {name: np.asarray(flips[name])[source] for name in ("frame", "entered", "ambiguous")}
        return cls(i, j, rank, inside, rows, frames=frames, **told)

    def __len__(self) -> int:
        return len(self.i)

    @property
    def flips(self) -> Int[np.ndarray, "pairs"]:
        """Number of flips of each pair."""
        return np.diff(self.rows)

    @property
    def pair(self) -> Int[np.ndarray, "flips"]:
        """Index of the pair to which each flip belongs."""
        return np.repeat(np.arange(len(self)), self.flips)


def _grouped(columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices that sort rows by all columns, and a mask of the first of equal rows."""
    if not len(columns[0]):
        return np.zeros(0, np.int64), np.zeros(0, bool)
    sizes = [int(column.max()) + 1 for column in columns]
    if sizes[0] * sizes[1] * sizes[2] < _ROOM and min(int(column.min()) for column in columns) >= 0:
        packed = (columns[0] * sizes[1] + columns[1]) * sizes[2] + columns[2]
        room = np.empty((4, len(packed)), np.int64)
        room[0] = packed
        order = digit_order(room, len(packed), sizes[0] * sizes[1] * sizes[2])
        changed = np.diff(packed[order]) != 0
    else:
        order = np.lexsort(columns[::-1])
        changed = np.any([np.diff(column[order]) != 0 for column in columns], axis=0)
    return order, np.concatenate([[True], changed])


@dataclass(frozen=True)
class Contacts(Columns):
    """Periods in which a pair is inside the cutoff, sorted by (i, j, image rank, first frame).

    The pair is inside the cutoff at the frames `begin`, ..., `end - 1`. A contact begins between the frames
    `begin - 1` and `begin`. A break of contact between two frames is not detected.
    """

    i: Int[np.ndarray, "stays"]  # the pair; see `ledger.Members`
    j: Int[np.ndarray, "stays"]
    rank: Int[np.ndarray, "stays"]
    begin: Int[np.ndarray, "stays"]  # first frame inside, a position among the frames examined
    end: Int[np.ndarray, "stays"]  # first frame outside again; the number of frames where that was not seen
    began: Bool[np.ndarray, "stays"]  # whether it was seen to enter, else it is older (censored on the left)
    ended: Bool[np.ndarray, "stays"]  # whether it was seen to leave, else it goes on (censored on the right)

    @property
    def length(self) -> Int[np.ndarray, "stays"]:
        """Duration of each contact, in frames."""
        return self.end - self.begin


def contacts(history: History) -> Contacts:
    """Return all contacts of every pair.

    Raises:
        ValueError: a flip is missing: the flips of a pair do not alternate between entering and leaving.
    """
    pair, inside, entered = history.pair, history.inside, history.entered
    odd = (np.arange(len(pair)) - history.rows[pair]) % 2 == 1
    if (entered == inside[pair] ^ odd).any():
        raise ValueError("a flip is missing: a pair enters the cutoff while inside, or leaves while outside")
    # a stay begins where a pair enters or at the first frame, and ends where it leaves or behind the last
    first, last = np.flatnonzero(inside), np.flatnonzero(inside ^ (history.flips % 2 == 1))
    of, leaver = np.concatenate([first, pair[entered]]), np.concatenate([pair[~entered], last])
    begin = np.concatenate([np.zeros(len(first), np.int64), history.frame[entered]])
    end = np.concatenate([history.frame[~entered], np.full(len(last), history.frames)])
    order = np.argsort(of, kind="stable")
    of, begin, end = of[order], begin[order], end[np.argsort(leaver, kind="stable")]
    # flips are of frames after the first
    return Contacts(
        history.i[of], history.j[of], history.rank[of], begin, end, begin > 0, end < history.frames
    )


def mended(stays: Contacts, gap: int) -> Contacts:
    """Merge contacts of a pair that are at most `gap` frames apart (intermittent contacts)."""
    if gap < 1 or not len(stays):
        return stays
    same = np.all([column[1:] == column[:-1] for column in (stays.i, stays.j, stays.rank)], axis=0)
    joined = same & (stays.begin[1:] - stays.end[:-1] <= gap)
    heads = np.flatnonzero(np.concatenate([[True], ~joined]))
    tails = np.flatnonzero(np.concatenate([~joined, [True]]))
    return replace(stays[heads], end=stays.end[tails], ended=stays.ended[tails])


# ---- between the frames


@dataclass(frozen=True)
class Strides(Sums):
    """Number of flips that are found if only every nth frame is examined."""

    _common = ("stride",)

    stride: Int[np.ndarray, "strides"]  # 1, 2, 4,
    flips: Int[np.ndarray, "strides"]  # of the frames 0, stride, 2 stride,
    of: Int[np.ndarray, "strides"]  # flips of all frames, as far as these reach
    # of those that are left out, flips that the rounding of the file may have made
    doubtful: Int[np.ndarray, "strides"]

    @classmethod
    def of_history(cls, history: History, strides: Sequence[int]) -> Strides:
        """Count flips at each stride. An odd number of flips in one stride counts as one flip."""
        found = []
        for stride in strides:
            rows = np.flatnonzero(history.frame <= (history.frames - 1) // stride * stride)
            # the pair, and the next frame that is kept
            pair, end = history.pair[rows], -(-history.frame[rows] // stride)
            begin = np.flatnonzero(np.append(True, (np.diff(pair) != 0) | (np.diff(end) != 0))[: len(rows)])
            out = np.diff(np.append(begin, len(rows))) // 2 * 2
            unsure = np.add.reduceat(history.ambiguous[rows].astype(np.int64), begin)
            found.append((len(rows) - out.sum(), len(rows), np.minimum(out, unsure).sum()))
        return cls(np.array(strides, np.int64), *np.array(found, np.int64).reshape(-1, 3).T)

    @property
    def share(self) -> Float[np.ndarray, "strides"]:
        """Fraction of the flips that each stride finds. nan if there are no flips."""
        return np.divide(self.flips, self.of, out=np.full(len(self.of), np.nan), where=self.of > 0)


def doublings(frames: int) -> list[int]:
    """Return strides in frames (1, 2, 4, ...) that fit at least four times into the trajectory."""
    strides = [1]
    while (frames - 1) // (2 * strides[-1]) >= 4:
        strides.append(2 * strides[-1])
    return strides


def crossings(frame: Frame, count: Callable[[Frame, Frame], int], move: float) -> tuple[int, float] | None:
    """Count the flips of pairs if all atoms move in straight lines for a short time.

    The root mean square displacement of the atoms is `move`. Choose `move` so short that paths are straight.
    Many pairs must still cross the cutoff. `count` returns the number of flips between two frames.

    Returns:
        (number of flips, duration of the motion in the time unit of the velocities); None if no atom moves.
    """
    if frame.velocities is None:
        return None
    speed = float(np.sqrt(np.mean(np.sum(frame.velocities**2, axis=1))))
    if not (math.isfinite(speed) and speed > 0):
        return None
    moment = move / speed
    later = Frame(frame.index, frame.time + moment, frame.positions + moment * frame.velocities, frame.box)
    return count(frame, later), moment
