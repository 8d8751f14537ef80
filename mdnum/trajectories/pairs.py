"""A fresh search: all pairs within a distance, in any box, images and all.

Distances in the search carry the rounding of wrapped coordinates. A pair closer to its threshold than a guard
is decided again from the coordinates as stored (`lattice.square_of`), so every search decides alike.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.errors import InputError
from mdnum.trajectories.bins import MOST_IMAGES, grid_for, lattice_code, lattice_vector, place, sorted_by_bin
from mdnum.trajectories.candidates import BAND, DIRECTED, INSIDE, met_from_centers, met_once
from mdnum.trajectories.lattice import Lattice, square_of

#: more pairs than this would take longer than anybody waits
MOST_PAIRS = 2_000_000_000
# bytes that a pair takes while members are sorted, as measured
_BYTES = 95
# Pairs beyond this many images are an error in the unit, not a wish, where there are so many pairs: every
# flip among them is looked for among all images of its pair.
_MOST_IMAGES_EACH, _MOST_REPEATED = 100, 2_000_000


@numba.njit(cache=True, nogil=True, inline="always")
def exact_square(x, home, i, j, n0, n1, n2, vectors):
    """The number that decides on a pair found with n added to the wrapped coordinates of j; i < j."""
    s0, s1, s2 = n0 + home[i, 0] - home[j, 0], n1 + home[i, 1] - home[j, 1], n2 + home[i, 2] - home[j, 2]
    return square_of(x, i, j, s0, s1, s2, vectors)


@numba.njit(cache=True, nogil=True)
def _settle(
    x, home, vectors, kind, species, square, radius, bound, narrow, guard,
    i_in, j_in, code, tally, i_out, j_out, value,
):  # fmt: skip
    """Decide on the candidates that wrapped coordinates left open; returns the smallest |margin|.

    value holds the squares of wrapped coordinates, and then what `Found.value` says. A margin beyond `narrow`
    is lessened by the guard rather than computed again.
    """
    smallest = np.inf
    for k in range(i_in.shape[0]):
        i, j = i_in[k], j_in[k]
        si, sj = species[i], species[j]
        if kind == BAND:
            margin = radius[si, sj] - np.sqrt(value[k])
            if abs(margin) > narrow:
                if i > j:
                    n0, n1, n2 = lattice_vector(code[k])
                    i_in[k], j_in[k], code[k] = j, i, lattice_code(-n0, -n1, -n2)
                value[k] = margin - guard if margin > 0 else margin + guard
                tally[0] += int(margin > 0)
                continue
        n0, n1, n2 = lattice_vector(code[k])
        if i < j:
            real = exact_square(x, home, i, j, n0, n1, n2, vectors)
        else:
            real = exact_square(x, home, j, i, -n0, -n1, -n2, vectors)
        if kind == DIRECTED:
            value[k] = real
            continue
        margin = radius[si, sj] - np.sqrt(real)
        inside = real < square[si, sj]
        smallest = min(smallest, abs(margin))
        tally[2] += int(abs(margin) <= bound)
        if kind == BAND:
            if i > j:
                i_in[k], j_in[k], code[k] = j, i, lattice_code(-n0, -n1, -n2)
            tally[0] += int(inside)
            # with the sign of the decision, whatever the root rounds to
            value[k] = abs(margin) if inside else -abs(margin)
        elif inside:
            i_out[tally[0]], j_out[tally[0]] = min(i, j), max(i, j)
            tally[0] += 1
    return smallest


@numba.njit(cache=True, nogil=True)
def _into_rows(i, j, value, first, count, other, square):
    """A counting sort of pairs by their first atom."""
    for k in range(i.shape[0]):
        count[i[k]] += 1
    total = 0
    for a in range(first.shape[0]):
        first[a] = total
        total += count[a]
        count[a] = 0
    for k in range(i.shape[0]):
        a = i[k]
        at = first[a] + count[a]
        other[at] = j[k]
        if square.shape[0]:
            square[at] = value[k]
        count[a] += 1


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
class Found:
    """What a search wrote down, a row per pair, in no order.

    Attributes:
        i, j: atoms; i < j unless directed. A pair appears once for each of its images.
        code: `BAND` only: the lattice vector added to wrapped j, see `lattice_vector`.
        value: `BAND`: margin, length, with the sign of the decision, at most the real one; `DIRECTED`:
            squared distance.
        home: lattice vectors that wrapping took off each atom.
        inside: pairs inside, written down or not.
        open: candidates that were decided from the coordinates as stored.
        close: pairs within the bound of their threshold.
        smallest: smallest |margin| among the pairs that were decided so; inf without one.
    """

    i: Int[np.ndarray, "pairs"]
    j: Int[np.ndarray, "pairs"]
    code: Int[np.ndarray, "coded"]
    value: Float[np.ndarray, "valued"]
    home: Int[np.ndarray, "atoms 3"]
    inside: int
    open: int
    close: int
    smallest: float


@dataclass(frozen=True)
class Rows:
    """Neighbors of each atom, one after the other.

    Attributes:
        first: where the row of each atom begins in `other`.
        count: length of the row; an atom appears once for each of its images.
        other: neighbors, in no order.
        square: squared distances, where the rule is directed; else empty.
        close: pairs within the bound of their threshold.
        smallest: smallest |margin| among the pairs within the band of their threshold; inf without one.
    """

    first: Int[np.ndarray, "atoms"]
    count: Int[np.ndarray, "atoms"]
    other: Int[np.ndarray, "pairs"]
    square: Float[np.ndarray, "stored"]
    close: int
    smallest: float


def search(
    positions: Float[np.ndarray, "atoms 3"],
    lattice: Lattice,
    sides: Sides,
    radii: Float[np.ndarray, "species species"],
    kind: int,
    *,
    band: float,
    bound: float,
    guard: float,
    narrow: float = 0.0,
    room: int = 0,
    open_room: int = 0,
) -> Found:
    """Look for pairs; images of an atom itself are left out, they are those of `lattice.own_images`.

    Args:
        positions: as stored, anywhere, length.
        radii: length by species; negative for pairs that are never inside.
        kind: what to write down. `INSIDE`: pairs inside. `BAND`: pairs within the band of their radius, on
            either side; no direction may repeat so soon that a pair has two images there. `DIRECTED`: for
            each center everything within radius + band.
        band: pairs this close to their radius are decided from the coordinates as stored, length.
        bound: pairs this close are counted as close, length; at most the band.
        guard: how far the wrapped distance of a pair can be off, length; at most the band.
        narrow: `BAND`: margins up to here are exact; others may be too small by the guard, length.
        room, open_room: pairs inside and pairs in the band to make room for, where it is known.
    Raises:
        InputError: more pairs than fit into memory.
    """
    atoms = len(positions)
    largest = float(radii.max(initial=0.0)) + band
    extent = np.zeros(3)
    if atoms and not lattice.periodic.all():
        extent = np.where(lattice.periodic, 0.0, np.ptp(positions @ lattice.inverse, axis=0))
    wrapped, home = np.empty((atoms, 3)), np.zeros((atoms, 3), np.int64)
    bin_of = np.empty(atoms, np.int64)
    grid = grid_for(lattice, largest + guard, atoms, extent)
    place(
        positions, lattice.vectors, lattice.inverse, lattice.periodic, grid.bins, grid.step,
        wrapped, home, bin_of,
    )  # fmt: skip
    if (grid.reach // grid.bins * lattice.periodic).max() >= MOST_IMAGES - 1:
        raise InputError(
            f"a box of widths {np.round(lattice.widths, 6).tolist()} for pairs within {largest:g}",
            remedy="Check the unit of the cutoff, and the box",
            where="cutoff",
        )
    total = int(np.prod(grid.bins))
    start, order = sorted_by_bin(bin_of, sides.others, total)
    sorted_x = np.ascontiguousarray(wrapped[order].T)
    _check_size(lattice, int(sides.centers.sum()), len(order), float(radii.max(initial=0.0)))
    allowed = radii >= 0
    low = np.where(allowed, np.maximum(radii - band, 0.0) ** 2, np.inf)
    high = np.where(allowed, (radii + band) ** 2, -1.0)
    free = lattice.periodic.astype(np.int64)
    half = sides.centers is sides.others and kind != DIRECTED
    if not half:
        center_start, center_order = sorted_by_bin(bin_of, sides.centers, total)
        both = sides.centers & sides.others
    everything = (free, grid.bins, grid.reach)
    sure, doubtful = max(room, 1024) if kind == INSIDE else 0, max(open_room, 1024)
    while True:
        i, j = np.empty(sure, np.int32), np.empty(sure, np.int32)
        i_open, j_open, code = (np.empty(doubtful, np.int32) for _ in range(3))
        value = np.empty(doubtful)
        tally = np.zeros(3, np.int64)
        written = (kind, sides.species, low, high, largest**2, tally, i, j, i_open, j_open, code, value)
        if half:
            met_once(sorted_x, lattice.vectors, *everything, start, order, *written)
        else:
            met_from_centers(
                wrapped, sorted_x, lattice.vectors, *everything,
                center_start, center_order, start, order, both, *written,
            )  # fmt: skip
        count, left = int(tally[0]), int(tally[1])
        # what is open may come to be inside
        if left <= doubtful and (kind != INSIDE or count + left <= sure):
            break
        _check_count(count + left, float(radii.max(initial=0.0)))
        sure, doubtful = (int(1.05 * (count + left)) if kind == INSIDE else 0), int(1.05 * left) + 1
    i_open, j_open, code, value = i_open[:left], j_open[:left], code[:left], value[:left]
    smallest = _settle(
        positions, home, lattice.vectors, kind, sides.species, np.where(allowed, radii * radii, -1.0), radii,
        bound, narrow + guard, guard, i_open, j_open, code, tally, i, j, value,
    )  # fmt: skip
    inside, close = int(tally[0]), int(tally[2])
    if kind == INSIDE:
        return Found(i[:inside], j[:inside], code[:0], value[:0], home, inside, left, close, float(smallest))
    return Found(i_open, j_open, code, value, home, inside, left, close, float(smallest))


def rows_of(found: Found, atoms: int) -> Rows:
    """Pairs by their first atom."""
    first, count = np.zeros(atoms, np.int64), np.zeros(atoms, np.int64)
    other, square = np.empty(len(found.i), np.int32), np.empty(len(found.value))
    _into_rows(found.i, found.j, found.value, first, count, other, square)
    return Rows(first, count, other, square, found.close, found.smallest)


def _check_size(lattice: Lattice, centers: int, others: int, radius: float) -> None:
    """Refuse a radius so large, in a box so small, that the pairs would not fit into memory or time."""
    if not lattice.periodic.all():
        return
    images = (4.0 / 3.0 * np.pi * radius**3) / lattice.volume
    pairs = 0.5 * centers * others * images
    if images > _MOST_IMAGES_EACH and pairs > _MOST_REPEATED:
        widths = np.round(lattice.widths, 3).tolist()
        raise InputError(
            f"about {pairs:,.0f} pairs within {radius:.6g}: any two atoms through about {images:,.0f} images "
            f"in a box of widths {widths}",
            remedy="Check the unit of the cutoff, and the box; or select fewer atoms",
            where="cutoff",
        )
    _check_count(pairs, radius)


def _check_count(pairs: float, radius: float) -> None:
    """Refuse more pairs than there is memory for."""
    if pairs <= min(MOST_PAIRS, _memory() / _BYTES):
        return
    raise InputError(
        f"about {pairs:,.0f} pairs within {radius:.6g}, which would take {pairs * _BYTES / 1e9:,.0f} GB of "
        f"this machine's {_memory() / 1e9:,.0f}",
        remedy="Check the unit of the cutoff, and the box; or select fewer atoms",
        where="cutoff",
    )


def _memory() -> float:
    """Bytes of memory that the machine has; 32 GB where it does not say."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return 32e9


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
