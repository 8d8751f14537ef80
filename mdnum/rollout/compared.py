"""Comparison of two runs whose atom labels or axes may differ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mdnum.compiled import njit
from mdnum.md.cell import Cell, box_of, nearest_image, stacked
from mdnum.md.ledger import Columns
from mdnum.md.neighbors import PairTable


@dataclass(frozen=True)
class ReferenceFrame:
    """Mapping of atom labels and axes of one run to those of another run."""

    labels: Int[np.ndarray, "atoms"]  # atom b of this run is atom labels[b] of the other, shape (atoms,)
    axes: Int[np.ndarray, "3"]  # axis a of the other run is axis axes[a] of this one, shape (3,)
    signs: Float[np.ndarray, "3"]  # and with this sign, shape (3,)
    # this run's positions are those of the other, turned, plus this, length, shape (3,)
    shift: Float[np.ndarray, "3"]

    @classmethod
    def same(cls, atoms: int) -> ReferenceFrame:
        """Return the mapping of a run to itself."""
        return cls(np.arange(atoms), np.arange(3), np.ones(3), np.zeros(3))

    @property
    def is_same(self) -> bool:
        """True if atom labels, axes and origin are the same in both runs."""
        return (
            bool((self.labels == np.arange(len(self.labels))).all())
            and bool((self.axes == np.arange(3)).all())
            and bool((self.signs == 1).all())
            and not self.shift.any()
        )

    @property
    def inverse(self) -> ReferenceFrame:
        """Inverse mapping, from the other run to this run."""
        shift = -self.signs * self.shift[self.axes]
        axes = np.argsort(self.axes)
        return ReferenceFrame(np.argsort(self.labels), axes, self.signs[axes], shift)

    def positions(
        self, x: Float[np.ndarray, "rows 3 atoms"], by: Float[np.ndarray, "rows 3 3"] | None = None
    ) -> Float[np.ndarray, "rows 3 atoms"]:
        """Convert positions to the other run's labels and axes, without wrapping.

        Args:
            by: deformation of the box since the start for each row; None if the box is fixed.
        """
        if self.is_same:
            return x
        shift = self.shift[None, :] if by is None else self.shift @ by
        return self.vectors(x - shift[:, :, None])

    def boxes(self, cells: Sequence[Cell], first: Cell) -> tuple[Cell, ...]:
        """Convert boxes of this run to the axes of the other run.

        Args:
            first: the box of both runs at the start, which the change of axes does not alter.
        """
        if bool((self.axes == np.arange(3)).all()) and bool((self.signs == 1).all()):
            return tuple(cells)
        turn = np.zeros((3, 3))
        turn[self.axes, np.arange(3)] = self.signs
        if np.array_equal(turn.T @ first.matrix @ turn, first.matrix):
            matrices = (turn.T @ cell.matrix @ turn for cell in cells)
        else:
            # other axes exchange its vectors: what is turned is how it deformed
            matrices = (first.matrix @ turn.T @ first.deformation(cell) @ turn for cell in cells)
        return tuple(Cell.create(matrix, first.pbc) for matrix in matrices)

    def vectors(self, v: Float[np.ndarray, "rows 3 atoms"]) -> Float[np.ndarray, "rows 3 atoms"]:
        """Convert velocities to the atom labels and axes of the other run."""
        if self.is_same:
            return v
        out = np.empty_like(v)
        out[:, :, self.labels] = v[:, self.axes, :] * self.signs[None, :, None]
        return out

    def keys(self, own: Int[np.ndarray, "pairs"]) -> Int[np.ndarray, "pairs"]:
        """Convert keys of pairs to the labels of the other run, and sort the keys."""
        return np.sort(self.keys_of(*np.divmod(own, len(self.labels))))

    def keys_of(self, i: Int[np.ndarray, "pairs"], j: Int[np.ndarray, "pairs"]) -> Int[np.ndarray, "pairs"]:
        """Return keys of pairs i, j with the labels of the other run."""
        atoms = len(self.labels)
        channel, i = np.divmod(i, atoms)
        a, b = self.labels[i], self.labels[j]
        return (channel * atoms + np.minimum(a, b).astype(np.int64)) * atoms + np.maximum(a, b)


# --- pairs that two runs decide differently, kept up to date from the flips of both -------------------


@dataclass(frozen=True)
class CrossFlip:
    """Pair whose decision starts or stops differing between two runs."""

    step: int  # of the flip
    # i, j: the pair, labels of the first run, i < j
    i: int
    j: int
    differs: bool  # whether the decisions differ now
    run: str  # which run flipped at this step: "A" or "B"
    entered: bool  # whether the pair entered its cutoff there
    # margin, bound: of that run's decision, in the quantity's space
    margin: float
    bound: float


@dataclass(frozen=True)
class PairFlips(Columns):
    """Columns of the flips in one of two runs, with the labels of the first run."""

    step: Int[np.ndarray, "flips"]  # of the flip
    key: Int[np.ndarray, "flips"]  # i * atoms + j of the pair, i < j
    entered: Bool[np.ndarray, "flips"]  # whether it entered its cutoff
    # margin, bound: of the decision, in the quantity's space
    margin: Float[np.ndarray, "flips"]
    bound: Float[np.ndarray, "flips"]


@dataclass(frozen=True)
class CrossFlips(Sequence[CrossFlip]):
    """Sequence of `CrossFlip`s, sorted by step and stored as arrays."""

    flips: PairFlips  # of either run
    from_b: Bool[np.ndarray, "flips"]  # which of them are the second run's
    differs: Bool[np.ndarray, "flips"]  # whether the decisions differ from then on
    atoms: int  # number of atoms

    def __len__(self) -> int:
        return len(self.differs)

    @overload
    def __getitem__(self, at: int) -> CrossFlip: ...
    @overload
    def __getitem__(self, at: slice) -> CrossFlips: ...
    def __getitem__(self, at: int | slice) -> CrossFlip | CrossFlips:
        if isinstance(at, slice):
            return CrossFlips(self.flips[at], self.from_b[at], self.differs[at], self.atoms)
        place = range(len(self))[at]
        return next(self._of(slice(place, place + 1)))

    def __iter__(self) -> Iterator[CrossFlip]:
        return self._of(slice(None))

    def _of(self, rows: slice) -> Iterator[CrossFlip]:
        flips = self.flips[rows]
        i, j = np.divmod(flips.key, self.atoms)
        columns = flips.step, i, j, self.differs[rows], self.from_b[rows]
        columns += flips.entered, flips.margin, flips.bound
        for step, i, j, differs, from_b, entered, margin, bound in zip(
            *(column.tolist() for column in columns), strict=True
        ):
            yield CrossFlip(step, i, j, differs, "B" if from_b else "A", entered, margin, bound)


class CrossRecorder:
    """Record of the pairs that are inside the cutoff in only one run.

    Args:
        a, b: keys of the pairs inside the cutoff at the first step, with labels of the first run.
        atoms: number of atoms.
    """

    def __init__(self, a: Int[np.ndarray, "inside"], b: Int[np.ndarray, "others"], atoms: int):
        self.atoms = atoms
        self.differing: Int[np.ndarray, "pairs"] = np.setxor1d(a, b, assume_unique=True)

    def opening(self) -> list[CrossFlip]:
        """Return the pairs whose decisions differ at step 0."""
        i, j = np.divmod(self.differing, self.atoms)
        pairs = zip(i.tolist(), j.tolist(), strict=True)
        return [CrossFlip(0, i, j, True, "B", False, np.nan, np.nan) for i, j in pairs]

    def take(
        self, first: int, rows: int, a: PairFlips, b: PairFlips
    ) -> tuple[Int[np.ndarray, "rows"], CrossFlips]:
        """Return the number of pairs with different decisions by step, and the `CrossFlips`.

        Args:
            first: step of the first row.
            rows: number of steps.
            a, b: flips of each run during these steps.
        """
        every = PairFlips.concatenate([a, b])
        from_b = np.repeat([False, True], [len(a.step), len(b.step)])
        order = np.lexsort((from_b, every.key, every.step))
        every, from_b = every[order], from_b[order]
        # both runs flipped the pair at one step: what differed still does, and what did not does not
        alike = (np.diff(every.step) == 0) & (np.diff(every.key) == 0)
        alone = np.ones(len(order), bool)
        alone[:-1] &= ~alike
        alone[1:] &= ~alike
        every, from_b = every[alone], from_b[alone]
        differs = np.isin(every.key, self.differing) ^ (_times_before(every.key) % 2 == 0)
        counts = len(self.differing) + np.cumsum(np.append(0, np.where(differs, 1, -1)))
        reached = np.searchsorted(every.step, np.arange(first, first + rows), side="right")
        keys, times = np.unique(every.key, return_counts=True)
        self.differing = np.setxor1d(self.differing, keys[times % 2 == 1], assume_unique=True)
        return counts[reached], CrossFlips(every, from_b, differs, self.atoms)


def _times_before(keys: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Return how often each integer occurs earlier in the array."""
    order, times = np.argsort(keys, kind="stable"), np.empty(len(keys), np.int64)
    times[order] = np.arange(len(keys)) - np.searchsorted(keys[order], keys[order])
    return times


# --- rows of two runs: atoms in one order, and the separation of the same atoms ------------------------


@njit
def _place(values, order, out):
    for row in range(values.shape[0]):
        for axis in range(values.shape[1]):
            for k in range(order.shape[0]):
                out[row, axis, order[k]] = values[row, axis, k]


def in_user_order(
    values: Float[np.ndarray, "rows 3 atoms"], order: Int[np.ndarray, "atoms"]
) -> Float[np.ndarray, "rows 3 atoms"]:
    """Return vectors of atoms, such as positions, in the user's order.

    Args:
        order: atom k of the record is atom order[k].
    """
    out = np.empty(values.shape, np.float64)
    _place(values, order, out)
    return out


@njit
def _largest(a, b, boxes, out):
    for row in range(out.shape[0]):
        most, box = 0.0, box_of(boxes, row)
        for k in range(a.shape[2]):
            x, y, z = b[row, 0, k] - a[row, 0, k], b[row, 1, k] - a[row, 1, k], b[row, 2, k] - a[row, 2, k]
            x, y, z = nearest_image(box, x, y, z)
            square = x * x + y * y + z * z
            # what is not a number stays the largest
            if not square <= most:
                most = square
            if most != most:
                break
        out[row] = np.sqrt(most)


@njit
def _overridden(own, imposed, index, order, x, species, r_cut, boxes, count, furthest):
    atoms, listed = order.shape[0], index.shape[0] // 8
    for row in range(count.shape[0]):
        at, box = x[row], box_of(boxes, row)
        for word in range(own.shape[1]):
            any_bit = np.uint8(0)
            for column in range(atoms):
                any_bit |= own[row, word, column] ^ imposed[row, word, column]
            if any_bit == 0:
                continue
            for column in range(atoms):
                bits = own[row, word, column] ^ imposed[row, word, column]
                for k in range(8):
                    if not (bits >> k) & 1:
                        continue
                    other = index[8 * (word % listed) + k, column]
                    # a pair is listed from both ends
                    if other >= atoms or order[column] >= order[other]:
                        continue
                    # in double precision, whatever the state
                    dx = np.float64(at[0, other]) - np.float64(at[0, column])
                    dy = np.float64(at[1, other]) - np.float64(at[1, column])
                    dz = np.float64(at[2, other]) - np.float64(at[2, column])
                    dx, dy, dz = nearest_image(box, dx, dy, dz)
                    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
                    own_cut = r_cut[word // listed]
                    off = abs(distance - own_cut[species[order[column]], species[order[other]]])
                    count[row] += 1
                    if furthest[row] == furthest[row] and not off <= furthest[row]:
                        furthest[row] = off


def separations(
    cells: Sequence[Cell],
    a: Float[np.ndarray, "rows 3 atoms"],
    b: Float[np.ndarray, "rows 3 atoms"],
    others: Sequence[Cell] = (),
) -> Float[np.ndarray, "rows"]:
    """Return the largest distance of an atom between two runs, by step. NaN if a position is NaN.

    Args:
        cells: the box, or one box for each row; distances are minimum-image distances.
        others: boxes of the second run for each row, if they differ. Positions of the second run are then
            transformed to the box of the first run, so that a difference between boxes is not a displacement.
    """
    out = np.empty(len(a))
    if others:
        by = np.array([other.deformation(cell) for cell, other in zip(cells, others, strict=True)])
        b = np.einsum("rkn,rkl->rln", b, by)
    _largest(a, b, stacked(cells), out)
    return out


def strains(cells: Sequence[Cell], others: Sequence[Cell]) -> Float[np.ndarray, "rows"]:
    """Return, by step, the strain between two boxes (the largest relative change of length)."""
    by = np.array([cell.deformation(other) for cell, other in zip(cells, others, strict=True)])
    out, known = np.full(len(by), np.nan), np.flatnonzero(np.isfinite(by).all(axis=(1, 2)))
    # a rotation is no strain
    out[known] = np.abs(np.linalg.svd(by[known], compute_uv=False) - 1).max(axis=1, initial=0.0)
    return out


def overridden(
    cells: Sequence[Cell],
    own: UInt8[np.ndarray, "rows words atoms"],
    imposed: UInt8[np.ndarray, "rows words atoms"],
    table: PairTable,
    x: Float[np.ndarray, "rows 3 atoms"],
    species: Int[np.ndarray, "atoms"],
    r_cut: Float[np.ndarray, "channels species species"],
) -> tuple[Int[np.ndarray, "rows"], Float[np.ndarray, "rows"]]:
    """Return the number of pairs with different decisions, and their largest |r - r_cut|.

    Args:
        cells: as for `separations`.
        own, imposed: packed decisions for the neighbor list `table`.
        x: positions, with atoms in the order of the neighbor list.
        species: species of each atom, in the user's order.
        r_cut: cutoff of each channel for each pair of species, length.
    """
    count, furthest = np.zeros(len(own), np.int64), np.zeros(len(own))
    order, boxes = table.order, stacked(cells)
    _overridden(own, imposed, table.index, order, x, species, r_cut, boxes, count, furthest)
    return count, furthest


def differ(
    a: Float[np.ndarray, "rows 3 atoms"], b: Float[np.ndarray, "rows 3 atoms"]
) -> Bool[np.ndarray, "rows"]:
    """Return True for each step at which numbers differ or are NaN."""
    return (a != b).any(axis=(1, 2))
