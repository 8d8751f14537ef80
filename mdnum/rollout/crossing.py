"""Pairs that two runs decide differently, kept up to date from the flips of both."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, overload

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class CrossFlip:
    """A pair that the two runs decide differently from this step on, or no longer.

    Attributes:
        step: of the flip.
        i, j: the pair, labels of the first run, i < j.
        differs: whether the decisions differ now.
        run: which run flipped at this step: "A" or "B".
        entered: whether the pair entered its cutoff there.
        margin, bound: of that run's decision, in the quantity's space.
    """

    step: int
    i: int
    j: int
    differs: bool
    run: str
    entered: bool
    margin: float
    bound: float


class Flips(NamedTuple):
    """Flips of one run, in the labels of the first run, a column each.

    Attributes:
        step: of the flip.
        key: i * atoms + j of the pair, i < j.
        entered: whether it entered its cutoff.
        margin, bound: of the decision, in the quantity's space.
    """

    step: Int[np.ndarray, "flips"]
    key: Int[np.ndarray, "flips"]
    entered: Bool[np.ndarray, "flips"]
    margin: Float[np.ndarray, "flips"]
    bound: Float[np.ndarray, "flips"]

    @classmethod
    def joined(cls, parts: Sequence[Flips]) -> Flips:
        """The flips of several stretches."""
        if not parts:
            whole, real = np.zeros(0, np.int64), np.zeros(0)
            return cls(whole, whole, np.zeros(0, bool), real, real)
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def where(self, chosen) -> Flips:
        """Some of them: a mask, a slice or indices."""
        return Flips(*(column[chosen] for column in self))


@dataclass(frozen=True)
class CrossFlips(Sequence[CrossFlip]):
    """Cross-run flips in order; objects are made only of those that are looked at: there may be millions.

    Attributes:
        flips: of either run.
        from_b: which of them are the second run's.
        differs: whether the decisions differ from then on.
        atoms: number of atoms.
    """

    flips: Flips
    from_b: Bool[np.ndarray, "flips"]
    differs: Bool[np.ndarray, "flips"]
    atoms: int

    def __len__(self) -> int:
        return len(self.differs)

    @overload
    def __getitem__(self, at: int) -> CrossFlip: ...
    @overload
    def __getitem__(self, at: slice) -> CrossFlips: ...
    def __getitem__(self, at: int | slice) -> CrossFlip | CrossFlips:
        if isinstance(at, slice):
            return CrossFlips(self.flips.where(at), self.from_b[at], self.differs[at], self.atoms)
        place = range(len(self))[at]
        return next(iter(self[place : place + 1]))

    def __iter__(self) -> Iterator[CrossFlip]:
        i, j = np.divmod(self.flips.key, self.atoms)
        columns = (self.flips.step, i, j, self.differs, self.from_b, *self.flips[2:])
        for step, i, j, differs, from_b, entered, margin, bound in zip(
            *(column.tolist() for column in columns), strict=True
        ):
            yield CrossFlip(step, i, j, differs, "B" if from_b else "A", entered, margin, bound)


class Crossing:
    """The pairs on which two runs differ now.

    Args:
        a, b: keys of the pairs inside at the first step, in the labels of the first run.
        atoms: number of atoms.
    """

    def __init__(self, a: Int[np.ndarray, "inside"], b: Int[np.ndarray, "others"], atoms: int):
        self.atoms = atoms
        self.differing: Int[np.ndarray, "pairs"] = np.setxor1d(a, b, assume_unique=True)

    def opening(self) -> list[CrossFlip]:
        """The pairs on which they differ from the start, as flips at step 0."""
        i, j = np.divmod(self.differing, self.atoms)
        pairs = zip(i.tolist(), j.tolist(), strict=True)
        return [CrossFlip(0, i, j, True, "B", False, np.nan, np.nan) for i, j in pairs]

    def take(self, first: int, rows: int, a: Flips, b: Flips) -> tuple[Int[np.ndarray, "rows"], CrossFlips]:
        """Number of pairs that differ at each of the next steps, and how that came about.

        Args:
            first: step of the first row.
            rows: number of steps.
            a, b: the flips of either run among them.
        """
        every = Flips.joined([a, b])
        from_b = np.repeat([False, True], [len(a.step), len(b.step)])
        order = np.lexsort((from_b, every.key, every.step))
        every, from_b = every.where(order), from_b[order]
        # both runs flipped the pair at one step: what differed still does, and what did not does not
        alike = (np.diff(every.step) == 0) & (np.diff(every.key) == 0)
        alone = np.ones(len(order), bool)
        alone[:-1] &= ~alike
        alone[1:] &= ~alike
        every, from_b = every.where(alone), from_b[alone]
        differs = np.isin(every.key, self.differing) ^ (_times_before(every.key) % 2 == 0)
        counts = len(self.differing) + np.cumsum(np.append(0, np.where(differs, 1, -1)))
        reached = np.searchsorted(every.step, np.arange(first, first + rows), side="right")
        keys, times = np.unique(every.key, return_counts=True)
        self.differing = np.setxor1d(self.differing, keys[times % 2 == 1], assume_unique=True)
        return counts[reached], CrossFlips(every, from_b, differs, self.atoms)


def _times_before(keys: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """How often each key was there before."""
    order = np.argsort(keys, kind="stable")
    ranked = keys[order]
    starts = np.flatnonzero(np.append(True, ranked[1:] != ranked[:-1])) if len(keys) else np.zeros(0, int)
    run = np.diff(np.append(starts, len(keys)))
    times = np.empty(len(keys), np.int64)
    times[order] = np.arange(len(keys)) - np.repeat(starts, run)
    return times
