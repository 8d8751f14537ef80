"""A fresh search: all pairs within a distance, in any box, images and all.

Atoms are binned in the coordinates of the reduced lattice; around each bin the atoms of the bins in reach are
gathered with the lattice vector that brings them near, as often as a small box repeats. Directions that do not
repeat have bins too, folded onto a fixed number of them, so that one atom far away makes neither many bins nor
a full one.

Distances in the search carry the rounding of wrapped coordinates. A pair closer to its threshold than a guard
is decided again from the coordinates as stored (`lattice.square_of`), so every search decides alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.errors import InputError
from mdnum.trajectories.lattice import Lattice, square_of

_LARGEST = 2**62
#: more pairs than this would not fit into the memory of a workstation
MOST_PAIRS = 2_000_000_000


@dataclass(frozen=True)
class Grid:
    """Bins of one search.

    Attributes:
        bins: number along each axis.
        reach: how many bins away a pair can be.
        step: width of a bin in the lattice's coordinates; folded where the axis does not repeat.
    """

    bins: Int[np.ndarray, "3"]
    reach: Int[np.ndarray, "3"]
    step: Float[np.ndarray, "3"]


def grid_for(lattice: Lattice, radius: float, atoms: int, extent: Float[np.ndarray, "3"]) -> Grid:
    """Bins for pairs within radius.

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
    return Grid(bins, reach, step)


@numba.njit(cache=True, nogil=True)
def _place(x, vectors, inverse, periodic, bins, step, wrapped, home, bin_of):
    """Wrap every atom and name its bin."""
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
def _gathered(b0, b1, b2, bins, reach, start, order, x, vectors, near, atom, code):
    """Candidates around one bin, moved by their lattice vectors; how many, or -1 where there is no room."""
    count = 0
    for d0 in range(-reach[0], reach[0] + 1):
        n0 = (b0 + d0) // bins[0]
        c0 = b0 + d0 - n0 * bins[0]
        for d1 in range(-reach[1], reach[1] + 1):
            n1 = (b1 + d1) // bins[1]
            c1 = b1 + d1 - n1 * bins[1]
            row = (c0 * bins[1] + c1) * bins[2]
            d2 = -reach[2]
            while d2 <= reach[2]:
                # bins along the last axis follow one another: a run of all that share a lattice vector
                n2 = (b2 + d2) // bins[2]
                low = b2 + d2 - n2 * bins[2]
                high = min(bins[2] - 1, low + reach[2] - d2)
                d2 += high - low + 1
                s0 = n0 * vectors[0, 0] + n1 * vectors[1, 0] + n2 * vectors[2, 0]
                s1 = n0 * vectors[0, 1] + n1 * vectors[1, 1] + n2 * vectors[2, 1]
                s2 = n0 * vectors[0, 2] + n1 * vectors[1, 2] + n2 * vectors[2, 2]
                for q in range(start[row + low], start[row + high + 1]):
                    if count >= near.shape[1]:
                        return -1
                    j = order[q]
                    near[0, count] = x[j, 0] + s0
                    near[1, count] = x[j, 1] + s1
                    near[2, count] = x[j, 2] + s2
                    atom[count] = j
                    code[count, 0], code[count, 1], code[count, 2] = n0, n1, n2
                    count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _squares(near, count, x0, x1, x2, squares):
    """Squared distances to all candidates; a loop without branches, which vectorizes."""
    for k in range(count):
        d0, d1, d2 = near[0, k] - x0, near[1, k] - x1, near[2, k] - x2
        squares[k] = d0 * d0 + d1 * d1 + d2 * d2


@numba.njit(cache=True, nogil=True)
def exact_square(x, home, i, j, code, vectors):
    """The number that decides on a pair found with lattice vector `code` added to wrapped j."""
    if i <= j:
        return square_of(
            x, i, j,
            code[0] + home[i, 0] - home[j, 0], code[1] + home[i, 1] - home[j, 1], code[2] + home[i, 2] - home[j, 2],
            vectors,
        )  # fmt: skip
    return square_of(
        x, j, i,
        home[j, 0] - home[i, 0] - code[0], home[j, 1] - home[i, 1] - code[1], home[j, 2] - home[i, 2] - code[2],
        vectors,
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _search(
    x, wrapped, home, vectors, periodic, bins, reach,
    center_start, center_order, start, order,
    both, directed, species, low, high, square, radius, largest, bound,
    first, count, out, out_square,
):  # fmt: skip
    """Rows of neighbors; returns (pairs written, near the threshold, smallest |margin|, room for candidates).

    low, high: squares by species outside of which wrapped coordinates decide. Directed rows hold everything
    within `high` with its exact square, and nothing is decided. Rows that do not fit are counted, not written.
    """
    written, close, smallest = 0, 0, np.inf
    room = 256
    near, atom = np.empty((3, room)), np.empty(room, np.int32)
    code = np.empty((room, 3), np.int64)
    squares, chosen = np.empty(room), np.empty(room, np.int32)
    tag = np.empty(room, np.int64)
    free = np.empty(3, np.int64)
    for k in range(3):
        free[k] = 1 if periodic[k] else 0
    for b0 in range(bins[0]):
        for b1 in range(bins[1]):
            for b2 in range(bins[2]):
                here = (b0 * bins[1] + b1) * bins[2] + b2
                if center_start[here] == center_start[here + 1]:
                    continue
                found = _gathered(b0, b1, b2, bins, reach, start, order, wrapped, vectors, near, atom, code)
                while found < 0:
                    room *= 2
                    near, atom = np.empty((3, room)), np.empty(room, np.int32)
                    code = np.empty((room, 3), np.int64)
                    squares, chosen = np.empty(room), np.empty(room, np.int32)
                    tag = np.empty(room, np.int64)
                    found = _gathered(
                        b0, b1, b2, bins, reach, start, order, wrapped, vectors, near, atom, code
                    )
                for k in range(found):
                    # a pair of atoms that are on both sides is met from both, and counts from the lower
                    tag[k] = atom[k] if both[atom[k]] else _LARGEST
                    for c in range(3):
                        code[k, c] *= free[c]
                for q in range(center_start[here], center_start[here + 1]):
                    i = center_order[q]
                    _squares(near, found, wrapped[i, 0], wrapped[i, 1], wrapped[i, 2], squares)
                    above = i if both[i] and not directed else -1
                    kept = 0
                    # no branch to mispredict: every candidate is written, and overwritten unless it is kept
                    for k in range(found):
                        chosen[kept] = k
                        kept += int((squares[k] <= largest) & (tag[k] > above))
                    first[i] = written
                    si = species[i]
                    for m in range(kept):
                        k = chosen[m]
                        j = atom[k]
                        if j == i:
                            continue
                        sj = species[j]
                        if squares[k] > high[si, sj]:
                            continue
                        if directed:
                            if written < out.shape[0]:
                                out[written] = j
                                out_square[written] = exact_square(x, home, i, j, code[k], vectors)
                            written += 1
                            continue
                        if squares[k] >= low[si, sj]:
                            real = exact_square(x, home, i, j, code[k], vectors)
                            margin = abs(radius[si, sj] - np.sqrt(real))
                            close += int(margin <= bound)
                            smallest = min(smallest, margin)
                            if not real < square[si, sj]:
                                continue
                        if written < out.shape[0]:
                            out[written] = j
                        written += 1
                    count[i] = written - first[i]
    return written, close, smallest


@dataclass
class Rows:
    """Neighbors of each atom, one after the other.

    Attributes:
        first: where the row of each atom begins in `other`.
        count: length of the row; an atom appears once for each of its images.
        other: neighbors, in no order.
        square: squared distances, where the rule is directed; else empty.
        close: pairs within the bound of their threshold.
        smallest: smallest |margin| among the pairs nearer to their threshold than the band; inf without one.
    """

    first: Int[np.ndarray, "atoms"]
    count: Int[np.ndarray, "atoms"]
    other: Int[np.ndarray, "pairs"]
    square: Float[np.ndarray, "stored"]
    close: int
    smallest: float


@dataclass(frozen=True)
class Sides:
    """Who is asked for neighbors, and who can be one.

    Attributes:
        centers: atoms whose rows are wanted.
        others: atoms that can be in them.
        species: number of each atom's species.
    """

    centers: Bool[np.ndarray, "atoms"]
    others: Bool[np.ndarray, "atoms"]
    species: Int[np.ndarray, "atoms"]


def search(
    positions: Float[np.ndarray, "atoms 3"],
    lattice: Lattice,
    sides: Sides,
    radii: Float[np.ndarray, "species species"],
    *,
    band: float,
    bound: float,
    guard: float,
    directed: bool = False,
    room: int = 0,
) -> Rows:
    """Neighbors of the centers within the radius of their species.

    Images of an atom itself are not in its row: they are those of the box (`lattice.own_images`).

    Args:
        positions: as stored, anywhere, length.
        radii: length by species; negative for pairs that are never inside.
        band: pairs this close to their radius are decided from the coordinates as stored, length.
        bound: pairs this close are counted as close, length; at most the band.
        guard: how far the wrapped distance of a pair can be off, length; at most the band.
        directed: rows hold every neighbor (not only those with a higher index) within radius + guard and its
            squared distance.
        room: pairs to make room for.
    Raises:
        InputError: more pairs than fit into memory.
    """
    atoms = len(positions)
    largest = float(radii.max(initial=0.0)) + band
    components = positions @ lattice.inverse
    extent = np.where(lattice.periodic, 0.0, np.ptp(components, axis=0)) if atoms else np.zeros(3)
    wrapped, home = np.empty((atoms, 3)), np.zeros((atoms, 3), np.int64)
    bin_of = np.empty(atoms, np.int64)
    grid = grid_for(lattice, largest + guard, atoms, extent)
    _place(
        positions, lattice.vectors, lattice.inverse, lattice.periodic, grid.bins, grid.step, wrapped, home, bin_of
    )  # fmt: skip
    total = int(np.prod(grid.bins))
    start, order = _sorted_by_bin(bin_of, sides.others, total)
    center_start, center_order = (
        (start, order) if sides.centers is sides.others else _sorted_by_bin(bin_of, sides.centers, total)
    )
    _check_size(lattice, len(center_order), len(order), largest)
    allowed = radii >= 0
    outer = np.where(allowed, (radii + band) ** 2, -1.0)
    inner = np.where(allowed, np.maximum(radii - band, 0.0) ** 2, np.inf)
    room = max(room, 1024)
    while True:
        first, count = np.zeros(atoms, np.int64), np.zeros(atoms, np.int64)
        out, squares = np.empty(room, np.int32), np.empty(room if directed else 0)
        written, close, smallest = _search(
            positions, wrapped, home, lattice.vectors, lattice.periodic, grid.bins, grid.reach,
            center_start, center_order, start, order,
            sides.centers & sides.others, directed, sides.species,
            inner, outer, np.where(allowed, radii * radii, -1.0), radii, largest**2, bound,
            first, count, out, squares,
        )  # fmt: skip
        if written <= room:
            kept = squares[:written] if directed else squares
            return Rows(first, count, out[:written], kept, int(close), float(smallest))
        room = int(written * 1.1)


def _check_size(lattice: Lattice, centers: int, others: int, radius: float) -> None:
    """Refuse a radius so large, in a box so small, that the pairs would not fit into memory."""
    if not lattice.periodic.all():
        return
    pairs = 0.5 * centers * others * (4.0 / 3.0 * np.pi * radius**3) / lattice.volume
    if pairs > MOST_PAIRS:
        raise InputError(
            f"about {pairs:.1e} pairs within {radius:g} in a box of volume {lattice.volume:g}",
            remedy="Check the unit of the cutoff, and the box; or select fewer atoms",
            where="cutoff",
        )


def ordered(rows: Rows) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """(i, j) of all rows, sorted."""
    atoms = len(rows.first)
    i = np.repeat(np.arange(atoms), rows.count)
    if len(i) == 0:
        return i, i.copy()
    inside = np.arange(len(i)) - np.repeat(np.cumsum(rows.count) - rows.count, rows.count)
    j = rows.other[rows.first[i] + inside].astype(np.int64)
    order = np.argsort(i * np.int64(atoms) + j, kind="stable")
    return i[order], j[order]


def ranks(i: Int[np.ndarray, "pairs"], j: Int[np.ndarray, "pairs"]) -> Int[np.ndarray, "pairs"]:
    """0, 1, 2, ... within each run of equal (i, j)."""
    new = np.ones(len(i), bool)
    new[1:] = (i[1:] != i[:-1]) | (j[1:] != j[:-1])
    at = np.flatnonzero(new)
    return np.arange(len(i)) - np.repeat(at, np.diff(np.append(at, len(i))))


__all__ = ["Grid", "Rows", "Sides", "grid_for", "ordered", "ranks", "search"]
