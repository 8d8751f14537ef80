"""Pairs inside a cutoff that a neighbor list lacks, and for how long.

A list is incomplete if the skin was exceeded, a buffer overflowed, or images are not supported. The program
then omits the interactions of the missing pairs. Missing pairs whose distance equals the cutoff within its
error are not counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from mdnum.compiled import njit
from mdnum.errors import InputError
from mdnum.md.ledger import Members
from mdnum.trajectories.arrays import host
from mdnum.trajectories.frame import Frame
from mdnum.trajectories.images import cell_of, image_shifts
from mdnum.trajectories.lattice import Placed, lattice_of
from mdnum.trajectories.residues import ResidueTracker
from mdnum.trajectories.rules import Rule
from mdnum.trajectories.search import image_distances
from mdnum.trajectories.tracker import Tracker

# share of pairs that a list has from both atoms, from which on it is a full one that lacks some
_FULL = 0.1
# atoms whose entries are looked up for that
_SOME = 16
# shifts that are told apart along each vector
_APART = 256
_KNOWN = (
    "Give jax-md's NeighborList, (i, j) or (i, j, S) as ASE, matscipy and vesin have them, or an array "
    "(2, pairs) or (atoms, neighbors) padded with the number of atoms"
)


@njit
def _same(given, known):
    """Return True if two arrays of equal length are equal in every element."""
    for begin in range(0, len(known), 8192):
        some, others, differ = given[begin : begin + 8192], known[begin : begin + 8192], 0
        for k in range(len(some)):
            differ += some[k] != others[k]
        if differ:
            return False
    return True


class GivenList(NamedTuple):
    """Neighbor list of a program, without padding and sorted by atom."""

    shifted: bool  # whether it says which image each neighbor is; else the nearest alone
    full: bool  # whether it has each pair from both of its atoms; else from the lower one here
    first: Int[np.ndarray, "ends"]  # where the entries of each atom begin, and after the last
    i: Int[np.ndarray, "entries"]
    j: Int[np.ndarray, "entries"]
    image: Int[np.ndarray, "entries"]  # by `_image`: x[j] + shift @ box is meant

    @classmethod
    def of(cls, parts: list[np.ndarray], atoms: int) -> GivenList:
        """Build a neighbor list, in int32, from the arrays returned by `arrays_of`."""
        i, j, *shifts = parts
        image = _image(*shifts[0].T) if shifts else np.zeros(len(i), np.int32)
        there = (i >= 0) & (i < atoms) & (j >= 0) & (j < atoms) & ((i != j) | (image != 0))
        if not there.all():
            i, j, image = i[there], j[there], image[there]
        found = cls._ordered(bool(shifts), True, i, j, image, atoms)
        # as far as some of the atoms show
        rows = np.flatnonzero(np.diff(found.first))
        ends = (found.first[rows[:: len(rows) // _SOME + 1] + k].tolist() for k in (0, 1))
        some = np.concatenate([np.arange(0), *map(np.arange, *ends)])
        back = found.has(found.j[some], found.i[some], _opposite(found.image[some]))
        if back.sum() > _FULL * len(back):
            return found
        # of an atom and an image of itself, the first component that is not 0 is positive
        turned, own = i > j, np.flatnonzero(i == j)
        turned[own] = np.sign(_shift(image[own])) @ [4, 2, 1] < 0
        if turned.any():
            i, j = np.where(turned, j, i), np.where(turned, i, j)
            image = np.where(turned, _opposite(image), image)
        return cls._ordered(bool(shifts), False, i, j, image, atoms)

    @classmethod
    def _ordered(cls, shifted: bool, full: bool, *columns: Any) -> GivenList:
        i, j, image, atoms = columns
        if (i[1:] < i[:-1]).any():
            order = np.argsort(i)
            i, j, image = i[order], j[order], image[order]
        return cls(shifted, full, np.searchsorted(i, np.arange(atoms + 1, dtype=i.dtype)), i, j, image)

    def has(self, i: np.ndarray, j: np.ndarray, image: np.ndarray) -> Bool[np.ndarray, "pairs"]:
        """Return True for each given pair that the list contains. The search is fastest if i is sorted."""
        return _has(self.first, self.j, self.image, i, j, image, self.shifted)

    def missing(self, frame: Frame, pairs: Members) -> Int[np.ndarray, "pairs"]:
        """Return the number of missing entries of each pair. A full list has two per pair."""
        i, j, image, near = pairs.i, pairs.j, np.zeros(len(pairs), np.int64), pairs.rank == 0
        if self.shifted:
            image, near = _image(*image_shifts(frame, pairs).T), np.True_
        if not self.full:
            return 1 - (near & self.has(i, j, image))
        i, j, image = np.append(i, j), np.append(j, i), np.append(image, _opposite(image))
        found, order = np.empty(len(i), bool), np.argsort(i)
        found[order] = self.has(i[order], j[order], image[order])
        return 2 - (near & found.reshape(2, -1)).sum(axis=0)


@njit
def _image(s0, s1, s2):
    """Encode a lattice shift as one integer."""
    return (s0 % _APART * _APART + s1 % _APART) * _APART + s2 % _APART


def _shift(image: np.ndarray) -> Int[np.ndarray, "images 3"]:
    """Decode lattice shifts from integer codes."""
    return np.stack([image >> 16, image >> 8, image], axis=-1).astype(np.int8).astype(np.int32)


def _opposite(image: np.ndarray) -> Int[np.ndarray, "images"]:
    """Return the integer codes of the opposite lattice shifts."""
    return _image(*-_shift(image).T)


@njit
def _has(first, other, images, i, j, image, shifted):
    found = np.zeros(len(i), np.bool_)
    # whose entry another atom was last met in; the last such entry, and the one before each
    of, row, begin = np.full(len(first), -1, np.int32), -1, 0
    last, before = np.empty(len(first), np.int32), np.empty(np.diff(first).max(), np.int32)
    for k in range(len(i)):
        if i[k] != row:
            row = i[k]
            begin = first[row]
            for m in range(first[row + 1] - begin):
                b = other[begin + m]
                if shifted:
                    before[m] = last[b] if of[b] == row else -1
                    last[b] = m
                of[b] = row
        found[k] = of[j[k]] == row
        if shifted and found[k]:
            m = last[j[k]]
            while m >= 0 and images[begin + m] != image[k]:
                m = before[m]
            found[k] = m >= 0
    return found


def arrays_of(neighbors: Any, atoms: int) -> list[np.ndarray]:
    """Return i, j and optional shifts of a neighbor list in any supported form."""
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
        raise InputError(f"neighbors of {atoms} atoms have shape {shapes}", remedy=_KNOWN, where="neighbors")
    return parts


class ListCheck:
    """Comparison of a neighbor list with the pairs inside the cutoff at each frame."""

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
        """Return the list as a `GivenList`. If the list is unchanged, the same object is returned."""
        if self._newest is None:
            if self._rule.directed:
                message = f"a neighbor list needs a cutoff, but the rule is {self._rule.name}"
                raise InputError(message, remedy="Give r_cut first", where="neighbors")
            self._kinds, self._radii = self._rule.table(species)
        parts = arrays_of(neighbors, len(self._kinds))
        known = zip(parts, self._parts, strict=False)
        if len(parts) != len(self._parts) or not all(
            one.shape == other.shape and _same(one.ravel(), other.ravel()) for one, other in known
        ):
            # copies: programs write into their arrays again
            self._parts = [np.array(one, np.int32) for one in parts]
            self._newest = GivenList.of(self._parts, len(self._kinds))
        assert self._newest is not None
        return self._newest

    def step(
        self,
        frame: Frame,
        at: int,
        tracker: Tracker | ResidueTracker,
        flips: Mapping[str, np.ndarray],
        now: GivenList,
    ) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """Compare a list with the pairs inside the cutoff. Return results, and rows of missing pairs.

        Args:
            at: index of the frame among the frames examined.
            tracker, flips: tracker of the rule after this frame, and the table columns of the frame's flips.
            now: the neighbor list in use.
        """
        new, earlier, before = now is not self._list, self._list, self._before
        x, lattice, reach = frame.positions, lattice_of(frame.box), self._rule.reach
        placed = Placed(x, lattice, lattice.rounding(frame.furthest, reach))
        self._list, self._before = now, frame
        if before is None or earlier is None or lattice.narrowest < 2 * reach:
            every = True
        elif new:
            every = self._drops(earlier, now, frame, before, placed)
        else:
            # shifts belong to the cells that atoms were in
            every = now.shifted and np.abs(x - before.positions).max() > lattice.narrowest / 4
        if every:
            pairs = tracker.members()
        else:
            columns, entered = [flips[name] for name in ("i", "j", "rank")], flips["entered"]
            ids = np.array([column[entered] for column in columns], np.int64)
            if self._open:
                left = set(zip(*(column[~entered].tolist() for column in columns), strict=True))
                still = [key for key in self._open if key not in left]
                ids = np.concatenate([ids, np.array(still, np.int64).reshape(-1, 3).T], axis=1)
            i, j, rank = ids
            pairs = Members(i, j, rank, image_distances(placed, i, j, rank))
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
        row = {"listed": len(now.j), "new_list": new, "lost": len(certain), "deepest": deepest}
        return row, self.ended(at, tracker.bound, {key: known[key] for key in gone})

    def _drops(self, earlier: GivenList, now: GivenList, frame: Frame, before: Frame, placed: Placed) -> bool:
        """Return True if the new list may lack pairs that the previous list contained."""
        i, j, image, reach = earlier.i, earlier.j, earlier.image, self._rule.reach
        x, (matrix, inverse) = placed.positions, cell_of(frame)
        if (earlier.shifted, earlier.full) != (now.shifted, now.full):
            return True
        if now.shifted:
            moved = (x - before.positions) @ inverse * frame.box.pbc
            whole = np.rint(moved).astype(int)
            # as long as that tells which image a pair inside goes on as
            if np.abs(moved - whole).max() + reach / placed.lattice.narrowest >= 0.5:
                return True
            there = np.asarray(whole.any(axis=1))
            some, image = np.flatnonzero(there[i] | there[j]), image.copy()
            image[some] = _image(*(_shift(image[some]) + whole[i[some]] - whole[j[some]]).T)
        gone = np.flatnonzero(~now.has(i, j, image))
        i, j = i[gone], j[gone]
        if now.shifted:
            distance = np.linalg.norm(x[j] - x[i] + _shift(image[gone]) @ matrix, axis=1)
        else:
            distance = image_distances(placed, i, j, np.zeros_like(i))
        return bool((distance <= self._radii[self._kinds[i], self._kinds[j]] + placed.rounding).any())

    def ended(self, at: int, bound: float, stays: Mapping[Any, Any] | None = None) -> list[dict[str, Any]]:
        """Return table rows of the pairs that were missing until frame `at`. `stays` restricts the pairs."""
        names = ("i", "j", "rank", "missing", "begin", "number", "deepest", "end")
        held = sorted((self._open if stays is None else stays).items())
        rows = [(*key, *told, at) for key, told in held if told[-1] > bound]
        return [dict(zip(names, row, strict=True)) for row in rows]
