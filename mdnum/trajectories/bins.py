"""Atoms sorted by place into bins, in any box, and the loop that finds which of them are near one another.

Bins are those of the reduced lattice's coordinates. Directions that do not repeat have bins too, folded onto
a fixed number of them, so that one atom far away makes neither many bins nor a full one. Around each bin the
atoms of the bins in reach are gathered, with the lattice vector that brings them near, as often as a small
box repeats; then every atom of the bin is compared with all of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.errors import InputError
from mdnum.trajectories.lattice import ReducedLattice

#: repeats of a box along one direction within the cutoff
MOST_IMAGES = 500
#: centers examined in one go where pairs are handed on: what is found fits into a core's cache
BATCH = 1024
#: what a search records: pairs inside; pairs near their threshold; all in reach, from the centers
INSIDE, BAND, DIRECTED = 0, 1, 2


class Sides(NamedTuple):
    """Who is asked for neighbors, and who can be one.

    Attributes:
        others: atoms that can be one; the same array as centers where all are on both sides.
    """

    centers: Bool[np.ndarray, "atoms"]  # atoms whose neighbors are wanted
    others: Bool[np.ndarray, "atoms"]
    species: Int[np.ndarray, "atoms"]  # number of each atom's species


class SearchLimits(NamedTuple):
    """Squared distances that a search distinguishes, by species."""

    kind: int  # `INSIDE`, `BAND` or `DIRECTED`
    low: Float[np.ndarray, "species species"]  # pairs nearer than this are inside for certain
    high: Float[np.ndarray, "species species"]  # pairs further than this are not looked for
    largest: float  # of high

    @classmethod
    def of(cls, radii: Float[np.ndarray, "species species"], kind: int, band: float) -> SearchLimits:
        """Those of pairs within the band of their radius, or inside it."""
        low = np.where(radii >= 0, np.maximum(radii - band, 0.0) ** 2, np.inf)
        high = np.where(radii >= 0, (radii + band) ** 2, -1.0)
        return cls(kind, low, high, float((radii.max(initial=0.0) + band) ** 2))


class Candidates(NamedTuple):
    """Pairs as a search records them; what does not fit is counted only.

    Attributes:
        i_open, j_open, code, value: pairs that are not: with the code of j's lattice vector, and the square
            of their distance by wrapped coordinates.
        counts: of the first and of the second; a third number is free for whoever decides on them.
    """

    i: Int[np.ndarray, "room"]  # pairs that are inside for certain
    j: Int[np.ndarray, "room"]
    i_open: Int[np.ndarray, "open"]
    j_open: Int[np.ndarray, "open"]
    code: Int[np.ndarray, "open"]
    value: Float[np.ndarray, "open"]
    counts: Int[np.ndarray, "3"]

    @classmethod
    def room(cls, certain: int, open: int) -> Candidates:
        """Room for so many."""
        i, j, i_open, j_open, code = (np.empty(n, np.int32) for n in (certain, certain, open, open, open))
        return cls(i, j, i_open, j_open, code, np.empty(open), np.zeros(3, np.int64))


class Binned(NamedTuple):
    """Atoms of one frame in bins: all that the loop of a search needs.

    Attributes:
        center_start, center_order: atoms that are asked, by bin; the same arrays where all are on both sides.
    """

    lattice: ReducedLattice  # of the frame
    species: Int[np.ndarray, "atoms"]
    bins: Int[np.ndarray, "3"]  # number along each axis, and how many bins away a pair can be
    reach: Int[np.ndarray, "3"]
    half: bool  # pairs of one set, each met once from one of its atoms
    both: Bool[np.ndarray, "atoms"]  # atoms on both sides
    wrapped: Float[np.ndarray, "atoms 3"]  # positions in the box, length
    home: Int[np.ndarray, "atoms 3"]  # lattice vectors that wrapping took off each atom
    start: Int[np.ndarray, "edges"]  # atoms that can be a neighbor, by bin
    order: Int[np.ndarray, "others"]
    center_start: Int[np.ndarray, "edges"]
    center_order: Int[np.ndarray, "centers"]
    sorted_x: Float[np.ndarray, "3 others"]  # wrapped positions in the order of `order`
    atoms: int  # most atoms, and most runs of bins, around a bin
    runs: int

    def batches(self) -> list[tuple[int, int]]:
        """Bins, about `BATCH` centers at a time."""
        edges = np.searchsorted(self.center_start, np.arange(0, self.center_start[-1], BATCH), side="left")
        edges = np.unique(np.concatenate([[0], edges, [len(self.center_start) - 1]]))
        return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


def binned(
    positions: Float[np.ndarray, "atoms 3"], lattice: ReducedLattice, sides: Sides, reach: float, guard: float
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
    bins, away, step = grid_for(lattice, reach + guard, atoms, extent)
    wrapped, home = np.empty((atoms, 3)), np.zeros((atoms, 3), np.int64)
    bin_of = np.empty(atoms, np.int64)
    _place(positions, lattice, bins, step, wrapped, home, bin_of)
    if (away // bins * lattice.periodic).max() >= MOST_IMAGES - 1:
        raise InputError(
            f"a box of widths {np.round(lattice.widths, 6).tolist()} for pairs within {reach:g}",
            remedy="Check the unit of the cutoff, and the box",
            where="cutoff",
        )
    total, half = int(np.prod(bins)), sides.centers is sides.others
    start, order = _sorted_by_bin(bin_of, sides.others, total)
    centers = (start, order) if half else _sorted_by_bin(bin_of, sides.centers, total)
    sorted_x = np.ascontiguousarray(wrapped[order].T)
    return Binned(
        lattice, sides.species, bins, away, half, sides.centers & sides.others, wrapped, home, start, order,
        *centers, sorted_x, *_most_around(bins, away, start),
    )  # fmt: skip


def grid_for(lattice: ReducedLattice, radius: float, atoms: int, extent: Float[np.ndarray, "3"]):
    """(bins, reach, step): bins along each axis, how many bins away a pair can be, and the width of a bin.

    Args:
        radius: length, guard included.
        atoms: how many are to be binned; there are no more than about twice as many bins.
        extent: of the atoms along each axis that does not repeat, length.
    """
    bins, reach, step = np.ones(3, np.int64), np.ones(3, np.int64), np.ones(3)
    room = max(64.0, 2.0 * atoms)
    safe = radius * (1.0 + 1e-9)
    width = safe
    free = ~lattice.periodic
    while True:
        for k in range(3):
            if lattice.periodic[k]:
                bins[k] = max(1, int(min(lattice.widths[k] / width, 1e6)))
                step[k] = 1.0 / bins[k]
                reach[k] = int(np.ceil(safe * bins[k] / lattice.widths[k]))
            else:
                # three at least, so that no bin is met twice
                bins[k], step[k] = 3 + int(min(extent[k] / safe, 1e6)), safe
        # folding costs nothing, so the free directions give way first
        while np.prod(bins.astype(float)) > room and bins[free].max(initial=0) > 3:
            most = np.argmax(np.where(free, bins, 0))
            bins[most] = max(3, int(bins[most] * 0.8))
        if np.prod(bins.astype(float)) <= room or bins.max() <= 3:
            break
        width *= 1.1
    return bins, reach, step


@numba.njit(cache=True, nogil=True)
def _place(x, lattice, bins, step, wrapped, home, bin_of):
    """Wrap every atom and name its bin."""
    vectors, inverse, periodic = lattice.vectors, lattice.inverse, lattice.periodic
    for i in range(x.shape[0]):
        here = 0
        for c in range(3):
            wrapped[i, c] = x[i, c]
        for k in range(3):
            f = x[i, 0] * inverse[0, k] + x[i, 1] * inverse[1, k] + x[i, 2] * inverse[2, k]
            if periodic[k]:
                h = np.floor(f)
                b = np.int64((f - h) * bins[k])
                # a tiny negative coordinate rounds to the far end of the box
                b = min(max(b, 0), bins[k] - 1)
                home[i, k] = np.int64(h)
                if h != 0.0:
                    for c in range(3):
                        wrapped[i, c] -= h * vectors[k, c]
            else:
                g = np.floor(f / step[k])
                b = np.int64(g - bins[k] * np.floor(g / bins[k]))
                b = min(max(b, 0), bins[k] - 1)
                home[i, k] = 0
            here = here * bins[k] + b
        bin_of[i] = here


@numba.njit(cache=True, nogil=True)
def _sorted_by_bin(bin_of, chosen, total):
    """(start, order) of the chosen atoms: a counting sort that keeps their order within a bin."""
    start = np.zeros(total + 1, np.int64)
    count = 0
    for i in range(bin_of.shape[0]):
        if chosen[i]:
            start[bin_of[i] + 1] += 1
            count += 1
    for b in range(total):
        start[b + 1] += start[b]
    cursor = start[:-1].copy()
    order = np.empty(count, np.int32)
    for i in range(bin_of.shape[0]):
        if chosen[i]:
            order[cursor[bin_of[i]]] = i
            cursor[bin_of[i]] += 1
    return start, order


@numba.njit(cache=True, nogil=True)
def lattice_vector(code):
    """The three integers of the code of a lattice vector."""
    code = np.int64(code)
    return (code >> 20) - 512, ((code >> 10) & 1023) - 512, (code & 1023) - 512


@numba.njit(cache=True, nogil=True)
def _run(d0, d1, d2, b0, b1, b2, bins, last):
    """The run of bins that begins d away from a bin: lattice vector, first and last bin, next d2."""
    n0, n1, n2 = (b0 + d0) // bins[0], (b1 + d1) // bins[1], (b2 + d2) // bins[2]
    c0, c1, low = b0 + d0 - n0 * bins[0], b1 + d1 - n1 * bins[1], b2 + d2 - n2 * bins[2]
    high = min(bins[2] - 1, low + last - d2)
    row = (c0 * bins[1] + c1) * bins[2]
    return n0, n1, n2, row + low, row + high, d2 + high - low + 1


@numba.njit(cache=True, nogil=True)
def _most_around(bins, reach, start):
    """Most atoms, and most runs, around any bin."""
    atoms, runs = 0, 0
    for b0 in range(bins[0]):
        for b1 in range(bins[1]):
            for b2 in range(bins[2]):
                found, kinds = 0, 0
                for d0 in range(-reach[0], reach[0] + 1):
                    for d1 in range(-reach[1], reach[1] + 1):
                        d2 = -reach[2]
                        while d2 <= reach[2]:
                            _, _, _, first, last, d2 = _run(d0, d1, d2, b0, b1, b2, bins, reach[2])
                            found += start[last + 1] - start[first]
                            kinds += 1
                atoms, runs = max(atoms, found), max(runs, kinds)
    return atoms + 1, runs + 1


# Not inlined, and in loops from 0 over slices: an index that could be negative costs a test for each
# candidate, and the loop its vector instructions.
@numba.njit(cache=True, nogil=True, inline="never")
def _within(near, first, last, x0, x1, x2, largest, squares, flags, chosen):
    """Squares of near[:, first:last] as seen from x, and which of them, counted from first, are within."""
    near0, near1, near2 = near[0, first:last], near[1, first:last], near[2, first:last]
    for k in range(near0.shape[0]):
        y0, y1, y2 = near0[k] - x0, near1[k] - x1, near2[k] - x2
        squares[k] = y0 * y0 + y1 * y1 + y2 * y2
    for k in range(near0.shape[0]):
        flags[k] = squares[k] <= largest
    kept = 0
    # no branch to mispredict: every candidate is written, and overwritten unless it is kept
    for k in range(near0.shape[0]):
        chosen[kept] = k
        kept += flags[k]
    return kept


@numba.njit(cache=True, nogil=True)
def meet(atoms, limits, first_bin, end_bin, found):
    """Record the pairs of the centers in bins first_bin to end_bin - 1; returns how many of each kind.

    Pairs of one set are met once: from a bin, half of the bins around are examined. Otherwise everything
    around each center is; two atoms that are on both sides are met twice and count once.
    """
    written, left = 0, 0
    start, bins, reach, species = atoms.start, atoms.bins, atoms.reach, atoms.species
    vectors, sorted_x, order, wrapped = atoms.lattice.vectors, atoms.sorted_x, atoms.order, atoms.wrapped
    center_start, center_order, periodic = atoms.center_start, atoms.center_order, atoms.lattice.periodic
    kind, low, high, largest = limits.kind, limits.low, limits.high, limits.largest
    half = atoms.half and kind != DIRECTED
    # one species: no need to look it up
    several = low.shape[0] > 1
    near, squares, flags = np.empty((3, atoms.atoms)), np.empty(atoms.atoms), np.empty(atoms.atoms, np.uint8)
    atom, run = np.empty(atoms.atoms, np.int32), np.empty(atoms.atoms, np.int32)
    chosen, codes = np.empty(atoms.atoms, np.uint32), np.zeros(atoms.runs, np.int32)
    for here in range(first_bin, end_bin):
        if center_start[here] == center_start[here + 1]:
            continue
        b0, b1, b2 = here // (bins[1] * bins[2]), here // bins[2] % bins[1], here % bins[2]
        count, runs = 0, 0
        for d0 in range(0 if half else -reach[0], reach[0] + 1):
            for d1 in range(0 if half and d0 == 0 else -reach[1], reach[1] + 1):
                # of half the bins the bin itself comes first, then those after it
                alone = half and d0 == 0 and d1 == 0
                d2, last = (0, 0) if alone else (-reach[2], reach[2])
                while d2 <= reach[2]:
                    n0, n1, n2, low_bin, high_bin, d2 = _run(d0, d1, d2, b0, b1, b2, bins, last)
                    last = reach[2]
                    begin, more = start[low_bin], start[high_bin + 1] - start[low_bin]
                    if more == 0:
                        continue
                    codes[runs] = (
                        ((n0 * periodic[0] + 512) << 20)
                        + ((n1 * periodic[1] + 512) << 10)
                        + n2 * periodic[2]
                        + 512
                    )
                    s0 = n0 * vectors[0, 0] + n1 * vectors[1, 0] + n2 * vectors[2, 0]
                    s1 = n0 * vectors[0, 1] + n1 * vectors[1, 1] + n2 * vectors[2, 1]
                    s2 = n0 * vectors[0, 2] + n1 * vectors[1, 2] + n2 * vectors[2, 2]
                    for q in range(more):
                        near[0, count + q] = sorted_x[0, begin + q] + s0
                        near[1, count + q] = sorted_x[1, begin + q] + s1
                        near[2, count + q] = sorted_x[2, begin + q] + s2
                        atom[count + q] = order[begin + q]
                        run[count + q] = runs
                    count += more
                    runs += 1
        for q in range(center_start[here + 1] - center_start[here]):
            i = center_order[center_start[here] + q]
            first = q + 1 if half else 0
            x0, x1, x2 = wrapped[i, 0], wrapped[i, 1], wrapped[i, 2]
            kept = _within(near, first, count, x0, x1, x2, largest, squares, flags, chosen)
            atom_here, run_here, si = atom[first:count], run[first:count], species[i]
            twice = not half and atoms.both[i] and kind != DIRECTED
            for m in range(kept):
                k = chosen[m]
                j = atom_here[k]
                sj = species[j] if several else 0
                if squares[k] > high[si, sj] or i == j or (twice and atoms.both[j] and j < i):
                    continue
                if squares[k] < low[si, sj] and kind != DIRECTED:
                    if kind == INSIDE and written < found.i.shape[0]:
                        found.i[written], found.j[written] = i, j
                    written += 1
                else:
                    if left < found.i_open.shape[0]:
                        found.i_open[left], found.j_open[left] = i, j
                        found.code[left], found.value[left] = codes[run_here[k]], squares[k]
                    left += 1
    found.counts[0], found.counts[1] = written, left
    return written, left
