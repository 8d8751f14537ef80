"""Flips between consecutive frames as columns: sorted, in the file's numbers, each with its two margins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int


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
    """The pairs inside at one frame, sorted by (i, j, rank), each once."""

    i: Int[
        np.ndarray, "pairs"
    ]  # first atom, an index into the file's atoms; i <= j where a rule is symmetric
    j: Int[np.ndarray, "pairs"]  # second atom; i == j for an atom and an image of itself
    # 0 for the nearest image of j, 1 for the next, and so on, which wrapping an atom does not change
    rank: Int[np.ndarray, "pairs"]
    distance: Float[np.ndarray, "pairs"]  # length

    @classmethod
    def none(cls) -> Members:
        """No pair."""
        none = np.zeros(0, np.int64)
        return cls(none, none, none, np.zeros(0))


@dataclass(frozen=True)
class FlipTable(Columns):
    """A row per decision that differs from the frame before, sorted by (frame, i, j, rank)."""

    frame: Int[
        np.ndarray, "flips"
    ]  # position among the frames looked at, not the number in the file; never 0
    i: Int[np.ndarray, "flips"]  # the pair, as in `Members`
    j: Int[np.ndarray, "flips"]
    rank: Int[np.ndarray, "flips"]
    entered: Bool[np.ndarray, "flips"]  # whether the pair is inside at `frame`
    distance: Float[np.ndarray, "flips"]  # at `frame`, length
    before: Float[np.ndarray, "flips"]  # distance at the frame before, length; nan where it is not known
    margin: Float[np.ndarray, "flips"]  # signed distance to the threshold at `frame`, positive inside, length
    margin_before: Float[np.ndarray, "flips"]  # at the frame before; nan where it is not known
    bound: Float[np.ndarray, "flips"]  # how far a margin can be off by resolution and rounding, length
    ambiguous: Bool[np.ndarray, "flips"]  # one of the margins is within the bound: the file does not tell

    @classmethod
    def none(cls) -> FlipTable:
        """No row."""
        whole, real, yes = np.zeros(0, np.int64), np.zeros(0), np.zeros(0, bool)
        return cls(whole, whole, whole, whole, yes, real, real, real, real, real, yes)
