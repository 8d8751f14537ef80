"""Pairs inside a cutoff that a program's own neighbor list lacks, and for how long.

Whatever made the list incomplete (a skin that was used up, a buffer that overflowed, images that it does not
know), what it did to the program is the pairs that were missing while they were inside. Those within the
bound of the cutoff are a matter of rounding and are not counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from mdnum.errors import InputError
from mdnum.md.ledger import Members
from mdnum.trajectories.arrays import host
from mdnum.trajectories.frame import Frame
from mdnum.trajectories.images import image_shifts, pair_keys
from mdnum.trajectories.lattice import Placed, lattice_of
from mdnum.trajectories.rules import Rule
from mdnum.trajectories.search import image_distances
from mdnum.trajectories.tracker import Tracker

# share of pairs that a list has from both atoms, from which on it is a full one that lacks some
_FULL = 0.1
# entries that are looked up for that
_SOME = 10_000
_KNOWN = (
    "Give jax-md's NeighborList, (i, j) or (i, j, S) as ASE, matscipy and vesin have them, or an array "
    "(2, pairs) or (atoms, neighbors) padded with the number of atoms"
)


@dataclass(frozen=True)
class GivenList:
    """A neighbor list as a program has it."""

    entries: int
    keys: Int[np.ndarray, "entries"]  # ascending
    shifted: bool  # whether it says which image each neighbor is; else the nearest alone
    full: bool  # whether it has each pair from both of its atoms
    atoms: int

    @classmethod
    def of(cls, parts: list[np.ndarray], atoms: int) -> GivenList:
        """A list of the arrays that `arrays_of` gives, whose padding is left out."""
        i, j, *shifts = parts
        shift = shifts[0] if shifts else np.zeros((len(i), 0), int)
        there = (i >= 0) & (i < atoms) & (j >= 0) & (j < atoms) & ((i != j) | shift.any(axis=1))
        i, j, shift = i[there].astype(np.int64), j[there].astype(np.int64), shift[there].astype(np.int64)
        keys, some = np.sort(pair_keys(i, j, shift, atoms)), slice(None, None, len(i) // _SOME + 1)
        back = _among(pair_keys(j[some], i[some], -shift[some], atoms), keys)
        return cls(len(i), keys, bool(shifts), bool(back.sum() > _FULL * len(back)), atoms)

    def missing(self, frame: Frame, pairs: Members) -> Int[np.ndarray, "pairs"]:
        """From how many of its atoms each pair is missing: 0, 1, and 2 in a list that is full."""
        shift = image_shifts(frame, pairs) if self.shifted else np.zeros((len(pairs), 0), int)
        there = _among(pair_keys(pairs.i, pairs.j, shift, self.atoms), self.keys)
        back = _among(pair_keys(pairs.j, pairs.i, -shift, self.atoms), self.keys)
        if not self.shifted:
            there, back = there & (pairs.rank == 0), back & (pairs.rank == 0)
        return 2 - there.astype(int) - back if self.full else 1 - (there | back).astype(int)


def arrays_of(neighbors: Any, atoms: int) -> list[np.ndarray]:
    """i, j and shifts, where there are any, of a list in one of the forms that `mdnum.Recorder.see` takes."""
    given = getattr(neighbors, "idx", neighbors)
    shifts = getattr(neighbors, "shifts", None)
    given = [*(given if isinstance(given, tuple) else (given,)), *(() if shifts is None else (shifts,))]
    first, *more = parts = [host(one, "neighbors", "iu") for one in given]
    if first.ndim == 2:
        name = getattr(getattr(neighbors, "format", None), "name", "")
        if len(first) == atoms and (name == "Dense" or 2 not in first.shape):
            i = np.repeat(np.arange(atoms), first.shape[1])
            parts = [i, first.ravel(), *(one.reshape(-1, 3) for one in more)]
        else:
            parts = [*(first if len(first) == 2 else first.T), *more]
    if len(parts) not in (2, 3) or [one.ndim for one in parts] != [1, 1, 2][: len(parts)]:
        shapes = ", ".join(str(one.shape) for one in parts[:4])
        raise InputError(f"neighbors of shape {shapes}, of {atoms} atoms", remedy=_KNOWN, where="neighbors")
    return parts


def _among(values: np.ndarray, ordered: np.ndarray) -> Bool[np.ndarray, "values"]:
    """Which values are among others in ascending order."""
    at = np.minimum(np.searchsorted(ordered, values), len(ordered) - 1)
    return ordered[at] == values if len(ordered) else np.zeros(len(values), bool)


class ListCheck:
    """Compares the list in use with the pairs inside, frame after frame; while it stays, only by flips."""

    def __init__(self, rule: Rule) -> None:
        self._rule = rule
        self._parts: list[np.ndarray] = []
        # given last, and examined last
        self._newest: GivenList | None = None
        self._list: GivenList | None = None
        self._before: Frame | None = None
        # (missing, first frame, its number, deepest margin) of pairs (i, j, rank) that are missing
        self._open: dict[tuple[int, int, int], tuple[int, int, int, float]] = {}

    def given(self, neighbors: Any, species: np.ndarray) -> GivenList:
        """A list; the same object where it did not change."""
        if self._newest is None:
            if self._rule.directed:
                message = f"a neighbor list is compared with a cutoff, and the rule is {self._rule.name}"
                raise InputError(message, remedy="Give r_cut first", where="neighbors")
            self._kinds, self._radii = self._rule.table(species)
        parts = arrays_of(neighbors, len(self._kinds))
        same = len(parts) == len(self._parts) and all(map(np.array_equal, parts, self._parts))
        if self._newest is None or not same:
            # copies: programs write into their arrays again
            self._parts = [np.array(one) for one in parts]
            self._newest = GivenList.of(self._parts, len(self._kinds))
        return self._newest

    def step(
        self, frame: Frame, at: int, tracker: Tracker, flips: Mapping[str, np.ndarray], now: GivenList
    ) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """(what is known of the list at a frame, rows of pairs that were missing up to the one before).

        Args:
            at: position of the frame among those examined.
            tracker, flips: of the rule, after this frame; flips by columns.
            now: the list in use.
        """
        new, lattice = now is not self._list, lattice_of(frame.box)
        narrow = lattice.narrowest < 2 * float(self._radii.max())
        # shifts belong to the cells that atoms were in
        x, before = frame.positions, self._before
        jumped = before is not None and np.abs(x - before.positions).max() > lattice.narrowest / 4
        self._list, self._before = now, frame
        if new or narrow or (jumped and now.shifted):
            pairs = tracker.members()
        else:
            rows = zip(*(flips[name].tolist() for name in ("i", "j", "rank", "entered")), strict=True)
            changed = {(i, j, rank): on for i, j, rank, on in rows}
            keys = [key for key in {**self._open, **changed} if changed.get(key, True)]
            i, j, rank = np.array(keys, np.int64).reshape(-1, 3).T
            pairs = Members(i, j, rank, image_distances(Placed(x, lattice, 0.0), i, j, rank))
        missing = now.missing(frame, pairs)
        pairs, missing = pairs[missing > 0], missing[missing > 0]
        margins = self._radii[self._kinds[pairs.i], self._kinds[pairs.j]] - pairs.distance
        known, self._open = self._open, {}
        columns = (pairs.i, pairs.j, pairs.rank, missing, margins)
        for i, j, rank, lacks, margin in zip(*(one.tolist() for one in columns), strict=True):
            _, begin, number, deepest = known.get((i, j, rank), (lacks, at, frame.index, margin))
            self._open[i, j, rank] = lacks, begin, number, max(margin, deepest)
        certain = margins[margins > tracker.bound]
        deepest, gone = certain.max(initial=0.0), known.keys() - self._open.keys()
        row = {"listed": now.entries, "new_list": new, "lost": len(certain), "deepest": deepest}
        return row, self.ended(at, tracker.bound, {key: known[key] for key in gone})

    def ended(self, at: int, bound: float, stays: Mapping[Any, Any] | None = None) -> list[dict[str, Any]]:
        """Rows of pairs that were missing up to a frame; of those that still are, where none are named."""
        names = ("i", "j", "rank", "missing", "begin", "number", "deepest", "end")
        held = sorted((self._open if stays is None else stays).items())
        rows = [(*key, *told, at) for key, told in held if told[-1] > bound]
        return [dict(zip(names, row, strict=True)) for row in rows]
