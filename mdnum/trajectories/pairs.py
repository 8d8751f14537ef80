"""A fresh search: all pairs within a distance, in any box, images and all.

Distances in the search carry the rounding of wrapped coordinates. A pair closer to its threshold than a guard
is decided again from the coordinates as stored (`lattice.square_of`), so every search decides alike.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.trajectories.binned import Limits, Sides, binned
from mdnum.trajectories.bins import lattice_vector
from mdnum.trajectories.candidates import DIRECTED, INSIDE
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
    """The number that decides on a pair found with n added to the wrapped coordinates of j.

    The same number whichever of the two comes first: every rounding is that of the opposite number.
    """
    s0, s1, s2 = n0 + home[i, 0] - home[j, 0], n1 + home[i, 1] - home[j, 1], n2 + home[i, 2] - home[j, 2]
    return square_of(x, i, j, s0, s1, s2, vectors)


@numba.njit(cache=True, nogil=True)
def _settle(
    x, home, vectors, kind, species, square, radius, bound,
    i_in, j_in, code, tally, i_out, j_out, value,
):  # fmt: skip
    """Decide on the candidates that wrapped coordinates left open; returns the smallest |margin|.

    value holds the squares of wrapped coordinates, and then, of a directed search, those that decide.
    """
    smallest = np.inf
    for k in range(i_in.shape[0]):
        i, j = i_in[k], j_in[k]
        n0, n1, n2 = lattice_vector(code[k])
        real = exact_square(x, home, i, j, n0, n1, n2, vectors)
        if kind == DIRECTED:
            value[k] = real
            continue
        si, sj = species[i], species[j]
        margin = abs(radius[si, sj] - np.sqrt(real))
        smallest = min(smallest, margin)
        tally[2] += int(margin <= bound)
        if real < square[si, sj]:
            i_out[tally[0]], j_out[tally[0]] = i, j
            tally[0] += 1
    return smallest


@numba.njit(cache=True, nogil=True)
def _into_rows(i, j, directed, value, first, count, other, square):
    """A counting sort of pairs by their first atom, the lower one unless they are directed."""
    for k in range(i.shape[0]):
        count[i[k] if directed else min(i[k], j[k])] += 1
    total = 0
    for a in range(first.shape[0]):
        first[a] = total
        total += count[a]
        count[a] = 0
    for k in range(i.shape[0]):
        a = i[k] if directed else min(i[k], j[k])
        at = first[a] + count[a]
        other[at] = j[k] if directed else max(i[k], j[k])
        if directed:
            square[at] = value[k]
        count[a] += 1


@dataclass(frozen=True)
class Found:
    """What a search wrote down, a row per pair, in no order.

    Attributes:
        kind: `INSIDE` or `DIRECTED`.
        i, j: atoms; i the center of a directed one, else either. A pair appears once for each of its images.
        value: `DIRECTED`: squared distance.
        open: candidates that were decided from the coordinates as stored.
        close: pairs within the bound of their threshold.
        smallest: smallest |margin| among the pairs that were decided so; inf without one.
    """

    kind: int
    i: Int[np.ndarray, "pairs"]
    j: Int[np.ndarray, "pairs"]
    value: Float[np.ndarray, "valued"]
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
    room: int = 0,
    open_room: int = 0,
) -> Found:
    """Look for pairs; images of an atom itself are left out, they are those of `lattice.own_images`.

    Args:
        positions: as stored, anywhere, length.
        radii: length by species; negative for pairs that are never inside.
        kind: what to write down. `INSIDE`: pairs inside. `DIRECTED`: for each center everything within
            radius + band.
        band: pairs this close to their radius are decided from the coordinates as stored, length.
        bound: pairs this close are counted as close, length; at most the band.
        guard: how far the wrapped distance of a pair can be off, length; at most the band.
        room, open_room: pairs inside and pairs in the band to make room for, where it is known.
    Raises:
        InputError: more pairs than fit into memory.
    """
    radius = float(radii.max(initial=0.0))
    placed = binned(positions, lattice, sides, radius + band, guard)
    expected = _expected(lattice, len(placed.center_order), len(placed.order), radius)
    limits = Limits.of(radii, kind, band)
    tally = np.zeros(3, np.int64)
    sure = max(room or int(1.1 * expected), 1024) if kind == INSIDE else 0
    # half of the pairs that are met are met twice
    share = 2.0 * (1.0 + band / radius) ** 3 if kind == DIRECTED else 6.0 * band / radius
    doubtful = max(open_room or int(1.1 * expected * share), 1024)
    while True:
        i, j = np.empty(sure, np.int32), np.empty(sure, np.int32)
        i_open, j_open, code = (np.empty(doubtful, np.int32) for _ in range(3))
        value = np.empty(doubtful)
        count, left = placed.met(limits, placed.everywhere(), tally, i, j, i_open, j_open, code, value)
        # what is open may come to be inside
        if left <= doubtful and (kind != INSIDE or count + left <= sure):
            break
        _check_count(count + left, radius)
        sure, doubtful = (int(1.05 * (count + left)) if kind == INSIDE else 0), int(1.05 * left) + 1
    i_open, j_open, code, value = i_open[:left], j_open[:left], code[:left], value[:left]
    smallest = _settle(
        positions, placed.home, lattice.vectors, kind, sides.species,
        np.where(radii >= 0, radii * radii, -1.0), radii, bound, i_open, j_open, code, tally, i, j, value,
    )  # fmt: skip
    inside, close = int(tally[0]), int(tally[2])
    if kind == INSIDE:
        return Found(kind, i[:inside], j[:inside], value[:0], left, close, float(smallest))
    return Found(kind, i_open, j_open, value, left, close, float(smallest))


def rows_of(found: Found, atoms: int) -> Rows:
    """Pairs by their first atom."""
    first, count = np.zeros(atoms, np.int64), np.zeros(atoms, np.int64)
    other, square = np.empty(len(found.i), np.int32), np.empty(len(found.value))
    _into_rows(found.i, found.j, found.kind == DIRECTED, found.value, first, count, other, square)
    return Rows(first, count, other, square, found.close, found.smallest)


def _expected(lattice: Lattice, centers: int, others: int, radius: float) -> float:
    """About how many pairs there are, if atoms fill the box evenly; 0 where it has no end.

    Raises:
        InputError: a radius so large, in a box so small, that the pairs would not fit into memory or time.
    """
    if not lattice.periodic.all():
        return 0.0
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
    return pairs


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


def pairs_of(rows: Rows) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """(i, j) of all rows, one row after the other."""
    i = np.repeat(np.arange(len(rows.first)), rows.count)
    inside = np.arange(len(i)) - np.repeat(np.cumsum(rows.count) - rows.count, rows.count)
    return i, rows.other[rows.first[i] + inside].astype(np.int64)


def ranks(i: Int[np.ndarray, "pairs"], j: Int[np.ndarray, "pairs"]) -> Int[np.ndarray, "pairs"]:
    """0, 1, 2, ... within each run of equal (i, j)."""
    new = np.ones(len(i), bool)
    new[1:] = (i[1:] != i[:-1]) | (j[1:] != j[:-1])
    at = np.flatnonzero(new)
    return np.arange(len(i)) - np.repeat(at, np.diff(np.append(at, len(i))))
