"""Atoms in bins, ready to be searched: everything that the loops of a search need, made once for a frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.errors import InputError
from mdnum.trajectories.bins import MOST_IMAGES, Grid, grid_for, most_around, place, sorted_by_bin
from mdnum.trajectories.candidates import DIRECTED, met_from_centers, met_once
from mdnum.trajectories.lattice import Lattice

#: centers looked at in one go where pairs are handed on: what is found fits into a core's cache
BATCH = 1024


@dataclass(frozen=True)
class Sides:
    """Who is asked for neighbors, and who can be one.

    Attributes:
        centers: atoms whose neighbors are wanted.
        others: atoms that can be one; the same array as centers where all are on both sides.
        species: number of each atom's species.
    """

    centers: Bool[np.ndarray, "atoms"]
    others: Bool[np.ndarray, "atoms"]
    species: Int[np.ndarray, "atoms"]


@dataclass(frozen=True)
class Limits:
    """Squared distances that a search tells apart, by species.

    Attributes:
        kind: what to write down, see `pairs.search`.
        low: pairs nearer than this are inside for certain.
        high: pairs further than this are not looked for.
        largest: of high.
    """

    kind: int
    low: Float[np.ndarray, "species species"]
    high: Float[np.ndarray, "species species"]
    largest: float

    @classmethod
    def of(cls, radii: Float[np.ndarray, "species species"], kind: int, band: float) -> Limits:
        """Those of pairs within the band of their radius, or inside it."""
        allowed = radii >= 0
        low = np.where(allowed, np.maximum(radii - band, 0.0) ** 2, np.inf)
        high = np.where(allowed, (radii + band) ** 2, -1.0)
        return cls(kind, low, high, float((radii.max(initial=0.0) + band) ** 2))


@dataclass(frozen=True)
class Binned:
    """Atoms of one frame in bins.

    Attributes:
        lattice: of the frame.
        sides: who is on which.
        grid: the bins.
        half: pairs of one set, each met once from one of its atoms.
        wrapped: positions in the box, length.
        home: lattice vectors that wrapping took off each atom.
        start, order: atoms that can be a neighbor, by bin.
        center_start, center_order: atoms that are asked, by bin; the same arrays where all are on both sides.
        sorted_x: wrapped positions in the order of `order`.
        around: most atoms, and most runs of bins, around a bin.
    """

    lattice: Lattice
    sides: Sides
    grid: Grid
    half: bool
    wrapped: Float[np.ndarray, "atoms 3"]
    home: Int[np.ndarray, "atoms 3"]
    start: Int[np.ndarray, "edges"]
    order: Int[np.ndarray, "others"]
    center_start: Int[np.ndarray, "edges"]
    center_order: Int[np.ndarray, "centers"]
    sorted_x: Float[np.ndarray, "3 others"]
    around: tuple[int, int]

    def met(self, limits: Limits, bins: tuple[int, int], tally, *written: np.ndarray) -> tuple[int, int]:
        """Look for pairs from the atoms of some bins.

        Args:
            limits: what to look for.
            bins: first of them, and the one after the last.
            tally: two whole numbers to count in.
            written: i and j of pairs that are certain; i, j, lattice code and square of those that are not.
                What does not fit is counted only.
        Returns:
            (pairs that are certain, pairs that are not).
        """
        grid, lattice, free = self.grid, self.lattice, self.lattice.periodic.astype(np.int64)
        what = (limits.kind, self.sides.species, limits.low, limits.high, limits.largest, tally, *written)
        if self.half and limits.kind != DIRECTED:
            met_once(
                *bins, *self.around, self.sorted_x, lattice.vectors, free, grid.bins, grid.reach,
                self.start, self.order, *what,
            )  # fmt: skip
        else:
            met_from_centers(
                *bins, *self.around, self.wrapped, self.sorted_x, lattice.vectors, free, grid.bins,
                grid.reach, self.center_start, self.center_order, self.start, self.order,
                self.sides.centers & self.sides.others, *what,
            )  # fmt: skip
        return int(tally[0]), int(tally[1])

    def everywhere(self) -> tuple[int, int]:
        """All bins."""
        return 0, len(self.start) - 1

    def batches(self) -> Iterator[tuple[int, int]]:
        """Bins, about `BATCH` centers at a time."""
        edges = np.searchsorted(self.center_start, np.arange(0, self.center_start[-1], BATCH), side="left")
        edges = np.unique(np.concatenate([[0], edges, [len(self.center_start) - 1]]))
        yield from zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)


def binned(
    positions: Float[np.ndarray, "atoms 3"], lattice: Lattice, sides: Sides, reach: float, guard: float
) -> Binned:
    """Put atoms into bins.

    Args:
        positions: as stored, anywhere, length.
        reach: pairs within this are to be found, length.
        guard: how far the wrapped distance of a pair can be off, length.
    Raises:
        InputError: the box repeats too often within reach.
    """
    atoms = len(positions)
    extent = np.zeros(3)
    if atoms and not lattice.periodic.all():
        extent = np.where(lattice.periodic, 0.0, np.ptp(positions @ lattice.inverse, axis=0))
    wrapped, home = np.empty((atoms, 3)), np.zeros((atoms, 3), np.int64)
    bin_of = np.empty(atoms, np.int64)
    grid = grid_for(lattice, reach + guard, atoms, extent)
    place(
        positions, lattice.vectors, lattice.inverse, lattice.periodic, grid.bins, grid.step,
        wrapped, home, bin_of,
    )  # fmt: skip
    if (grid.reach // grid.bins * lattice.periodic).max() >= MOST_IMAGES - 1:
        raise InputError(
            f"a box of widths {np.round(lattice.widths, 6).tolist()} for pairs within {reach:g}",
            remedy="Check the unit of the cutoff, and the box",
            where="cutoff",
        )
    total = int(np.prod(grid.bins))
    start, order = sorted_by_bin(bin_of, sides.others, total)
    centers = (start, order) if sides.centers is sides.others else sorted_by_bin(bin_of, sides.centers, total)
    sorted_x = np.ascontiguousarray(wrapped[order].T)
    around = most_around(grid.bins, grid.reach, start)
    return Binned(
        lattice, sides, grid, sides.centers is sides.others, wrapped, home, start, order, *centers,
        sorted_x, (int(around[0]), int(around[1])),
    )  # fmt: skip
