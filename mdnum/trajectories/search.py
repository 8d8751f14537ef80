"""Searches for pairs and nearest neighbors in a frame, and comparison of frames.

Distances in a search contain the rounding error of wrapped coordinates. Distances close to a threshold are
recomputed (`lattice.square_of`), so all algorithms find the same pairs.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mdnum.bits import digit_order
from mdnum.compiled import njit
from mdnum.errors import InputError
from mdnum.trajectories.lattice import (
    DIRECTED,
    INSIDE,
    Candidates,
    Participants,
    Placed,
    ReducedLattice,
    SearchLimits,
    binned,
    image_square,
    lattice_vector,
    meet,
    near_squares,
    own_images,
    square_of,
)
from mdnum.trajectories.rules import Capped, Nearest

#: Largest number of pairs; a search for more would take too long.
MOST_PAIRS = 2_000_000_000
# bytes that a pair takes while members are sorted, as measured
_BYTES = 95
# Pairs beyond this many images are an error in the unit, not a wish, where there are so many pairs: every
# flip among them is looked for among all images of its pair.
_MOST_IMAGES_EACH, _MOST_REPEATED = 100, 2_000_000


class Found(NamedTuple):
    """Pairs found by a search, in any order. Each image of an atom forms a separate pair."""

    kind: int  # `INSIDE` or `DIRECTED`
    i: Int[np.ndarray, "pairs"]  # the center of a directed one, else either
    j: Int[np.ndarray, "pairs"]
    value: Float[np.ndarray, "valued"]  # `DIRECTED`: squared distance
    open: int  # candidates that were decided from the coordinates as stored
    close: int  # pairs within the bound of their threshold
    smallest: float  # smallest |margin| among the pairs that were decided so; inf without one


class NeighborRows(NamedTuple):
    """Neighbors of all atoms, stored as one row per atom."""

    first: Int[np.ndarray, "atoms"]  # where the row of each atom begins in `other`, and its length
    count: Int[np.ndarray, "atoms"]
    other: Int[np.ndarray, "pairs"]  # neighbors, in no order; an atom appears once for each of its images
    square: Float[np.ndarray, "stored"]  # squared distances, where the rule is directed; else empty

    def pairs(self) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
        """Return the atoms i and j of all pairs, row by row."""
        i = np.repeat(np.arange(len(self.first)), self.count)
        inside = np.arange(len(i)) - np.repeat(np.cumsum(self.count) - self.count, self.count)
        return i, self.other[self.first[i] + inside].astype(np.int64)


def search(
    placed: Placed,
    who: Participants,
    kind: int,
    *,
    band: float,
    bound: float,
    room: int = 0,
    open_room: int = 0,
) -> Found:
    """Find pairs of atoms within a radius. For an atom's own images, see `lattice.own_images`.

    Args:
        kind: pairs to record: `INSIDE` (inside the radius) or `DIRECTED` (within radius + band of each
            center).
        band: half width of the guard band, at least the rounding error of a distance, length.
        bound: pairs whose distance is within this length of their radius are counted as close; at most
            `band`.
        room, open_room: expected numbers of pairs inside and of pairs in the band, if known.

    Raises:
        InputError: the pairs do not fit into memory.
    """
    radius, radii = who.radius, who.radii
    atoms = binned(placed, who, radius + band)
    expected = _expected(placed.lattice, len(atoms.center_order), len(atoms.order), radius)
    sure = max(room or int(1.1 * expected), 1024) if kind == INSIDE else 0
    # half of the pairs that are met are met twice
    share = 2.0 * (1.0 + band / radius) ** 3 if kind == DIRECTED else 6.0 * band / radius
    doubtful = max(open_room or int(1.1 * expected * share), 1024)
    while True:
        found = Candidates.room(sure, doubtful)
        count, left = meet(atoms, SearchLimits.of(radii, kind, band), found)
        # what is open may come to be inside
        if left <= doubtful and (kind != INSIDE or count + left <= sure):
            break
        _check_count(count + left, radius)
        sure, doubtful = (int(1.05 * (count + left)) if kind == INSIDE else 0), int(1.05 * left) + 1
    smallest = float(_settle(placed.positions, atoms, kind, who.squares, radii, bound, found))
    inside, close = int(found.counts[0]), int(found.counts[2])
    if kind == INSIDE:
        return Found(kind, found.i[:inside], found.j[:inside], found.value[:0], left, close, smallest)
    return Found(kind, found.i_open[:left], found.j_open[:left], found.value[:left], left, close, smallest)


@njit(inline="always")
def exact_square(x, home, i, j, n0, n1, n2, vectors):
    """Return the squared distance that is compared with the threshold. n is the image of j.

    The squared distance has the same bits if i and j are exchanged.
    """
    s0, s1, s2 = n0 + home[i, 0] - home[j, 0], n1 + home[i, 1] - home[j, 1], n2 + home[i, 2] - home[j, 2]
    return square_of(x, i, j, s0, s1, s2, vectors)


@njit
def _settle(x, atoms, kind, square, radius, bound, found):
    """Decide from stored coordinates which pairs near thresholds are inside. Return the smallest |margin|.

    In a directed search, squared distances are recomputed from stored coordinates.
    """
    smallest, home, vectors, species = np.inf, atoms.home, atoms.lattice.vectors, atoms.species
    for k in range(found.counts[1]):
        i, j = found.i_open[k], found.j_open[k]
        n0, n1, n2 = lattice_vector(found.code[k])
        real = exact_square(x, home, i, j, n0, n1, n2, vectors)
        if kind == DIRECTED:
            found.value[k] = real
            continue
        si, sj = species[i], species[j]
        margin = abs(radius[si, sj] - np.sqrt(real))
        smallest = min(smallest, margin)
        found.counts[2] += int(margin <= bound)
        if real < square[si, sj]:
            found.i[found.counts[0]], found.j[found.counts[0]] = i, j
            found.counts[0] += 1
    return smallest


def _expected(lattice: ReducedLattice, centers: int, others: int, radius: float) -> float:
    """Estimate the number of pairs within `radius`. 0 if an axis is not periodic."""
    if not lattice.periodic.all():
        return 0.0
    images = (4.0 / 3.0 * np.pi * radius**3) / lattice.volume
    pairs = 0.5 * centers * others * images
    if images > _MOST_IMAGES_EACH and pairs > _MOST_REPEATED:
        raise InputError(
            f"about {pairs:,.0f} pairs of atoms are closer than {radius:.6g}. In a box of widths "
            f"{np.round(lattice.widths, 3).tolist()}, a sphere of radius {radius:.6g} contains about "
            f"{images:,.0f} periodic images of each atom",
            remedy="Check the length unit of the cutoff and of the box, or select fewer atoms",
            where="cutoff",
        )
    _check_count(pairs, radius)
    return pairs


def _check_count(pairs: float, radius: float) -> None:
    """Raise an error if the pairs of atoms do not fit into memory."""
    memory = _memory()
    if pairs > min(MOST_PAIRS, memory / _BYTES):
        raise InputError(
            f"a list of the pairs of atoms closer than {radius:.6g} (about {pairs:,.0f} pairs) needs "
            f"{pairs * _BYTES / 1e9:,.0f} GB of memory; the computer has {memory / 1e9:,.0f} GB",
            remedy="Check the length unit of the cutoff and of the box, or select fewer atoms",
            where="cutoff",
        )


def _memory() -> float:
    """Return the memory of the machine in bytes. 32 GB if unknown."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return 32e9


def rows_of(found: Found, atoms: int) -> NeighborRows:
    """Sort pairs into one row per atom. Undirected pairs have the lower index first."""
    i, j, directed = found.i, found.j, found.kind == DIRECTED
    low, high = (i, j) if directed else (np.minimum(i, j), np.maximum(i, j))
    room = np.empty((4, len(i)), np.int64)
    room[0] = low
    order, count = digit_order(room, len(i), atoms), np.bincount(low, minlength=atoms)
    return NeighborRows(np.cumsum(count) - count, count, high[order], found.value[order if directed else []])


# ---- the nearest few


class Chosen(NamedTuple):
    """Nearest neighbors of each center, sorted by distance."""

    rows: NeighborRows  # the squares are those of the neighbors
    close: int  # as of `Found`
    smallest: float
    last_in: Float[np.ndarray, "atoms"]  # under which a neighbor stays one: the first outside, or the radius
    first_out: Float[np.ndarray, "atoms"]  # under which another would be one: the last inside, or the radius


def nearest(
    placed: Placed, who: Participants, rule: Nearest | Capped, *, band: float, bound: float
) -> Chosen:
    """Find the nearest neighbors of each center (arguments as in `search`)."""
    positions, lattice = placed.positions, placed.lattice
    atoms, reach, centers = len(positions), rule.reach, who.centers
    # a distance that no pair exceeds: a lattice has no end
    everything = np.inf
    if not lattice.periodic.any():
        everything = float(np.linalg.norm(np.ptp(positions, axis=0))) * (1 + 1e-9) + 1e-300 if atoms else 0.0
    radius = reach if np.isfinite(reach) else _guess(placed, who, rule.most, everything)
    none = np.zeros(atoms, np.int64)
    made = NeighborRows(none, none.copy(), np.empty(0, np.int32), np.empty(0))
    last_in, first_out = np.full(atoms, reach), np.full(atoms, reach)
    close, smallest, one = 0, np.inf, np.zeros(atoms, np.int64)
    while True:
        asked = replace(who, centers=centers, species=one, radii=np.array([[radius]]))
        found = search(placed, asked, DIRECTED, band=band, bound=bound)
        rows, own = rows_of(found, atoms), own_images(lattice, radius + band)
        room = min(int(centers.sum()) * rule.most, len(rows.other) + 2 * len(own) * int(centers.sum()))
        part = made._replace(other=np.empty(room, np.int32), square=np.empty(room))
        lacking = np.zeros(atoms, bool)
        # a free direction ends somewhere; along a lattice there is always one more
        complete = np.isfinite(reach) or radius >= everything
        written, near, least, short = _choose(
            rows, part, own, centers, who.both, rule.most, reach, bound, complete, radius, last_in, first_out,
            lacking,
        )  # fmt: skip
        made.first[centers & ~lacking] += len(made.other)
        made = made._replace(
            other=np.concatenate([made.other, part.other[:written]]),
            square=np.concatenate([made.square, part.square[:written]]),
        )
        close, smallest = close + near, min(smallest, least)
        if not short:
            return Chosen(made, int(close), float(smallest), last_in, first_out)
        centers, radius = lacking, min(radius * 1.4, everything)


@njit
def _choose(
    rows, made, own, centers, both, most, reach, bound, complete, searched, last_in, first_out, lacking
):  # fmt: skip
    """Keep the nearest neighbors of each center. Return counts and the smallest |margin|."""
    written, close, smallest, short = 0, 0, np.inf, 0
    for i in range(rows.first.shape[0]):
        if not centers[i]:
            continue
        first, count = rows.first[i], rows.count[i]
        length = count + (2 * own.shape[0] if both[i] else 0)
        squares, js = np.empty(length), np.empty(length, np.int32)
        for k in range(length):
            if k < count:
                squares[k], js[k] = rows.square[first + k], rows.other[first + k]
            else:
                squares[k], js[k] = own[(k - count) // 2], i
        # Shell's sort by (square, index): numba takes seconds to compile its own
        order, gap = np.arange(length), 1
        while 9 * gap < length:
            gap = 3 * gap + 1
        while gap > 0:
            for m in range(gap, length):
                k, at = order[m], m
                while at >= gap:
                    other = order[at - gap]
                    if squares[other] < squares[k] or (squares[other] == squares[k] and js[other] <= js[k]):
                        break
                    order[at] = other
                    at -= gap
                order[at] = k
            gap //= 3
        inside = 0
        for k in range(length):
            inside += int(squares[k] < reach * reach)
        kept = min(inside, most)
        # the first outside must have been seen, and all that come as close as it matters
        if not complete and (length <= kept or np.sqrt(squares[order[kept]]) > searched):
            lacking[i] = True
            short += 1
            continue
        limit_in, limit_out = reach, reach
        if kept == most:
            limit_out = np.sqrt(squares[order[kept - 1]])
            if kept < length:
                limit_in = min(reach, np.sqrt(squares[order[kept]]))
        last_in[i], first_out[i] = limit_in, limit_out
        made.first[i], made.count[i] = written, kept
        for k in range(length):
            margin = abs((limit_in if k < kept else limit_out) - np.sqrt(squares[order[k]]))
            close += int(margin <= bound)
            smallest = min(smallest, margin)
            if k < kept:
                if written < made.other.shape[0]:
                    made.other[written], made.square[written] = js[order[k]], squares[order[k]]
                written += 1
    return written, close, smallest, short


def _guess(placed: Placed, who: Participants, most: int, everything: float) -> float:
    """Estimate a radius within which most atoms have enough neighbors."""
    lattice, candidates = placed.lattice, int(who.others.sum())
    if not candidates:
        return 1.0 if not np.isfinite(everything) else max(everything, 1e-300)
    extent = np.ptp(placed.positions @ lattice.inverse, axis=0)
    extent = np.where(lattice.periodic, 1.0, np.maximum(extent, 1e-3 * max(extent.max(), 1e-12)))
    volume = float(np.prod(extent)) * lattice.volume
    radius = (3.0 * (1.6 * most + 8) * volume / (4.0 * np.pi * candidates)) ** (1 / 3)
    return float(min(radius, everything))


# ---- two searches


class Changed(NamedTuple):
    """Pairs of atoms whose decision differs between two frames."""

    i: Int[np.ndarray, "flips"]
    j: Int[np.ndarray, "flips"]
    rank: Int[np.ndarray, "flips"]
    entered: np.ndarray

    @classmethod
    def room(cls, pairs: int) -> Changed:
        """Allocate the columns of a table for the given number of pairs."""
        return cls._make(np.empty(pairs, kind) for kind in (np.int64, np.int64, np.int64, np.bool_))


def compared(before: NeighborRows, now: NeighborRows, room: int) -> Changed:
    """Return pairs whose decision differs between two frames. `room` is the buffer size."""
    while True:
        made = Changed.room(room)
        total = _compared(before, now, made)
        if total <= room:
            return Changed._make(column[:total] for column in made)
        room = total


@njit
def _compared(old, new, made):
    """Write pairs whose decision differs between two frames into the buffer. Return their total number."""
    atoms = old.first.shape[0]
    seen = np.zeros((atoms, 2), np.int32)
    total, room = 0, made.i.shape[0]
    for i in range(atoms):
        for k in range(old.first[i], old.first[i] + old.count[i]):
            seen[old.other[k], 0] += 1
        for k in range(new.first[i], new.first[i] + new.count[i]):
            seen[new.other[k], 1] += 1
        for side in range(2):
            first, count = (old.first[i], old.count[i]) if side == 0 else (new.first[i], new.count[i])
            for k in range(first, first + count):
                j = old.other[k] if side == 0 else new.other[k]
                before, now = seen[j, 0], seen[j, 1]
                seen[j, 0], seen[j, 1] = 0, 0
                for rank in range(min(before, now), max(before, now)):
                    if total < room:
                        made.i[total], made.j[total] = i, j
                        made.rank[total], made.entered[total] = rank, now > before
                    total += 1
    return total


def image_distances(
    placed: Placed,
    i: Int[np.ndarray, "pairs"],
    j: Int[np.ndarray, "pairs"],
    rank: Int[np.ndarray, "pairs"],
    directed: bool = False,
) -> Float[np.ndarray, "pairs"]:
    """Return the distance from atom i to an image of atom j. `rank` counts nearer images.

    If atom j has no such image, the distance is inf. A directed rule counts opposite images separately.
    """
    out = np.empty(len(i))
    rank = np.where(i == j, rank // 2, rank) if directed else rank
    _image_distances(placed.positions, placed.lattice, i, j, rank, out)
    return out


@njit
def _image_distances(x, lattice, i, j, rank, out):
    narrowest = min(lattice.widths[0], lattice.widths[1], lattice.widths[2])
    near, block = 0.2499 * narrowest * narrowest, 1024
    y = np.empty((3, block))
    for begin in range(0, i.shape[0], block):
        end = begin + block
        near_squares(x, i[begin:end], j[begin:end], lattice, y, out[begin:end])
    for k in range(i.shape[0]):
        # any other image is a lattice vector away, and none is shorter than the narrowest width
        if not (out[k] < near and rank[k] == 0 and i[k] != j[k]):
            out[k] = image_square(x, min(i[k], j[k]), max(i[k], j[k]), rank[k], lattice)
        out[k] = np.sqrt(out[k])


def ranks(i: Int[np.ndarray, "pairs"], j: Int[np.ndarray, "pairs"]) -> Int[np.ndarray, "pairs"]:
    """Return the numbers 0, 1, 2, ... of entries with equal (i, j)."""
    new = np.ones(len(i), bool)
    new[1:] = (i[1:] != i[:-1]) | (j[1:] != j[:-1])
    at = np.flatnonzero(new)
    return np.arange(len(i)) - np.repeat(at, np.diff(np.append(at, len(i))))
