"""What every pair did over the frames: flips by pair rather than by frame, for all that asks how long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from mdnum.trajectories.ledger import Flips, Members

# a pair's three numbers are packed into one where they fit: sorting one column is ten times as fast
_ROOM = 2**62


@dataclass(frozen=True)
class History:
    """Pairs that were ever inside or flipped, each with its flips in the order of frames.

    Attributes:
        i, j, rank: the pairs, sorted, each once; see `mdnum.trajectories.ledger.Members`.
        inside: whether each was inside at the first frame.
        rows: flips of pair p are rows `rows[p]` to `rows[p + 1]` of what follows.
        frame: position among the frames looked at, from 1.
        entered: whether the pair is inside at that frame.
        frames: frames looked at.
        ambiguous: whether the file's resolution may have made each flip; none where that is not known.
    """

    i: Int[np.ndarray, "pairs"]
    j: Int[np.ndarray, "pairs"]
    rank: Int[np.ndarray, "pairs"]
    inside: Bool[np.ndarray, "pairs"]
    rows: Int[np.ndarray, "pairs_and_one"]
    frame: Int[np.ndarray, "flips"]
    entered: Bool[np.ndarray, "flips"]
    frames: int
    ambiguous: Bool[np.ndarray, "flips"]

    @classmethod
    def of(cls, flips: Flips, first: Members, frames: int) -> History:
        """The histories behind a ledger.

        Args:
            flips: all flips, in the order of their frames.
            first: pairs inside at the first frame.
            frames: frames looked at, at least 1.
        """
        pair, members = (flips.i, flips.j, flips.rank), (first.i, first.j, first.rank)
        return cls.of_columns(flips.frame, flips.entered, pair, members, frames, flips.ambiguous)

    @classmethod
    def of_columns(
        cls,
        frame: Int[np.ndarray, "flips"],
        entered: Bool[np.ndarray, "flips"],
        pair: Sequence[Int[np.ndarray, "flips"]],
        first: Sequence[Int[np.ndarray, "members"]],
        frames: int,
        ambiguous: Bool[np.ndarray, "flips"] | None = None,
    ) -> History:
        """As `of`, from the columns that it looks at.

        Args:
            frame, entered, ambiguous: of each flip, in the order of frames.
            pair: i, j and rank of each flip.
            first: i, j and rank of each pair inside at the first frame.
        """
        if frames < 1:
            raise ValueError(f"frames = {frames}; a history has at least one")
        starts, flips = len(first[0]), len(frame)
        columns = [
            np.concatenate([there, moved]).astype(np.int64) for there, moved in zip(first, pair, strict=True)
        ]
        # first what was inside, then the flips as they came: a stable sort keeps that order in each pair
        order, new = _grouped(columns)
        pairs = np.cumsum(new) - 1
        heads = order[np.flatnonzero(new)]
        flip = order >= starts
        of_flip = pairs[flip]
        inside = np.zeros(len(heads), bool)
        inside[pairs[~flip]] = True
        rows = np.zeros(len(heads) + 1, np.int64)
        rows[1:] = np.cumsum(np.bincount(of_flip, minlength=len(heads))) if flips else 0
        source = order[flip] - starts
        i, j, rank = (column[heads] for column in columns)
        unsure = np.zeros(flips, bool) if ambiguous is None else np.asarray(ambiguous)
        return cls(
            i, j, rank, inside, rows, np.asarray(frame)[source], np.asarray(entered)[source], frames,
            unsure[source],
        )  # fmt: skip

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
