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

#: kinds of search
INSIDE, BAND, DIRECTED = 0, 1, 2
#: repeats of a box along one direction within the cutoff
MOST_IMAGES = 500
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


@numba.njit(cache=True, nogil=True, inline="always")
def exact_square(x, home, i, j, n0, n1, n2, vectors):
    """The number that decides on a pair found with n added to the wrapped coordinates of j; i < j."""
    return square_of(
        x, i, j, n0 + home[i, 0] - home[j, 0], n1 + home[i, 1] - home[j, 1], n2 + home[i, 2] - home[j, 2], vectors
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def lattice_code(n0, n1, n2):
    """Three whole numbers of at most `MOST_IMAGES` as one."""
    return ((n0 + 512) << 20) + ((n1 + 512) << 10) + (n2 + 512)


@numba.njit(cache=True, nogil=True)
def lattice_vector(code):
    """The three whole numbers of `lattice_code`."""
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
def _most(bins, reach, start):
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


@numba.njit(cache=True, nogil=True)
def _half(sorted_x, vectors, free, bins, reach, start, order, kind, species, low, high, largest,
          tally, i_out, j_out, i_open, j_open, code_open, value_open):  # fmt: skip
    """All pairs of one set of atoms, each met once: from a bin, half of the bins around are looked at."""
    written, left = 0, 0
    room, runs = _most(bins, reach, start)
    near, squares = np.empty((3, room)), np.empty(room)
    atom, chosen, run = np.empty(room, np.int32), np.empty(room, np.int32), np.empty(room, np.int32)
    codes = np.zeros(runs, np.int32)
    for b0 in range(bins[0]):
        for b1 in range(bins[1]):
            for b2 in range(bins[2]):
                here = (b0 * bins[1] + b1) * bins[2] + b2
                own = start[here + 1] - start[here]
                if own == 0:
                    continue
                found, kinds = 0, 0
                for d0 in range(0, reach[0] + 1):
                    for d1 in range(-reach[1] if d0 > 0 else 0, reach[1] + 1):
                        # the bin itself comes first, then those after it
                        d2 = -reach[2] if d0 > 0 or d1 > 0 else 0
                        last = reach[2] if d0 > 0 or d1 > 0 else 0
                        while d2 <= reach[2]:
                            n0, n1, n2, first_bin, last_bin, d2 = _run(d0, d1, d2, b0, b1, b2, bins, last)
                            last = reach[2]
                            begin, more = start[first_bin], start[last_bin + 1] - start[first_bin]
                            if more == 0:
                                continue
                            codes[kinds] = lattice_code(n0 * free[0], n1 * free[1], n2 * free[2])
                            s0 = n0 * vectors[0, 0] + n1 * vectors[1, 0] + n2 * vectors[2, 0]
                            s1 = n0 * vectors[0, 1] + n1 * vectors[1, 1] + n2 * vectors[2, 1]
                            s2 = n0 * vectors[0, 2] + n1 * vectors[1, 2] + n2 * vectors[2, 2]
                            for q in range(more):
                                near[0, found + q] = sorted_x[0, begin + q] + s0
                                near[1, found + q] = sorted_x[1, begin + q] + s1
                                near[2, found + q] = sorted_x[2, begin + q] + s2
                                atom[found + q] = begin + q
                                run[found + q] = kinds
                            found += more
                            kinds += 1
                for q in range(own):
                    x0, x1, x2 = near[0, q], near[1, q], near[2, q]
                    for k in range(q + 1, found):
                        y0, y1, y2 = near[0, k] - x0, near[1, k] - x1, near[2, k] - x2
                        squares[k] = y0 * y0 + y1 * y1 + y2 * y2
                    kept = 0
                    # no branch to mispredict: every candidate is written, and overwritten unless it is kept
                    for k in range(q + 1, found):
                        chosen[kept] = k
                        kept += int(squares[k] <= largest)
                    i = order[start[here] + q]
                    si = species[i]
                    for m in range(kept):
                        k = chosen[m]
                        j = order[atom[k]]
                        sj = species[j]
                        if squares[k] > high[si, sj] or i == j:
                            continue
                        if squares[k] < low[si, sj] and kind != DIRECTED:
                            if kind == INSIDE:
                                if written < i_out.shape[0]:
                                    i_out[written], j_out[written] = min(i, j), max(i, j)
                            written += 1
                        else:
                            if left < i_open.shape[0]:
                                i_open[left], j_open[left], code_open[left] = i, j, codes[run[k]]
                                value_open[left] = squares[k]
                            left += 1
    tally[0], tally[1] = written, left


@numba.njit(cache=True, nogil=True)
def _between(wrapped, sorted_x, vectors, free, bins, reach, center_start, center_order, start, order,
             both, kind, species, low, high, largest, tally, i_out, j_out, i_open, j_open, code_open, value_open):  # fmt: skip
    """Everything around each center; two atoms that are on both sides are met twice and count once."""
    written, left = 0, 0
    room, runs = _most(bins, reach, start)
    near, squares = np.empty((3, room)), np.empty(room)
    atom, chosen, run = np.empty(room, np.int32), np.empty(room, np.int32), np.empty(room, np.int32)
    codes = np.zeros(runs, np.int32)
    for b0 in range(bins[0]):
        for b1 in range(bins[1]):
            for b2 in range(bins[2]):
                here = (b0 * bins[1] + b1) * bins[2] + b2
                if center_start[here] == center_start[here + 1]:
                    continue
                found, kinds = 0, 0
                for d0 in range(-reach[0], reach[0] + 1):
                    for d1 in range(-reach[1], reach[1] + 1):
                        d2 = -reach[2]
                        while d2 <= reach[2]:
                            n0, n1, n2, first_bin, last_bin, d2 = _run(d0, d1, d2, b0, b1, b2, bins, reach[2])
                            begin, more = start[first_bin], start[last_bin + 1] - start[first_bin]
                            if more == 0:
                                continue
                            codes[kinds] = lattice_code(n0 * free[0], n1 * free[1], n2 * free[2])
                            s0 = n0 * vectors[0, 0] + n1 * vectors[1, 0] + n2 * vectors[2, 0]
                            s1 = n0 * vectors[0, 1] + n1 * vectors[1, 1] + n2 * vectors[2, 1]
                            s2 = n0 * vectors[0, 2] + n1 * vectors[1, 2] + n2 * vectors[2, 2]
                            for q in range(more):
                                near[0, found + q] = sorted_x[0, begin + q] + s0
                                near[1, found + q] = sorted_x[1, begin + q] + s1
                                near[2, found + q] = sorted_x[2, begin + q] + s2
                                atom[found + q] = order[begin + q]
                                run[found + q] = kinds
                            found += more
                            kinds += 1
                for q in range(center_start[here], center_start[here + 1]):
                    i = center_order[q]
                    x0, x1, x2 = wrapped[i, 0], wrapped[i, 1], wrapped[i, 2]
                    for k in range(found):
                        y0, y1, y2 = near[0, k] - x0, near[1, k] - x1, near[2, k] - x2
                        squares[k] = y0 * y0 + y1 * y1 + y2 * y2
                    kept = 0
                    for k in range(found):
                        chosen[kept] = k
                        kept += int(squares[k] <= largest)
                    si = species[i]
                    twice = both[i] and kind != DIRECTED
                    for m in range(kept):
                        k = chosen[m]
                        j = atom[k]
                        sj = species[j]
                        if squares[k] > high[si, sj] or i == j or (twice and both[j] and j < i):
                            continue
                        if squares[k] < low[si, sj] and kind != DIRECTED:
                            if kind == INSIDE:
                                if written < i_out.shape[0]:
                                    i_out[written], j_out[written] = min(i, j), max(i, j)
                            written += 1
                        else:
                            if left < i_open.shape[0]:
                                i_open[left], j_open[left], code_open[left] = i, j, codes[run[k]]
                                value_open[left] = squares[k]
                            left += 1
    tally[0], tally[1] = written, left


@numba.njit(cache=True, nogil=True)
def _settle(
    x, home, vectors, kind, species, square, radius, bound, narrow, guard, i_in, j_in, code, tally, i_out, j_out, value
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
        value: `BAND`: margin, length, with the sign of the decision, at most the real one; `DIRECTED`: squared distance.
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
            either side; no direction may repeat so soon that a pair has two images there. `DIRECTED`: for each
            center everything within radius + band.
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
    _place(
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
    start, order = _sorted_by_bin(bin_of, sides.others, total)
    sorted_x = np.ascontiguousarray(wrapped[order].T)
    _check_size(lattice, int(sides.centers.sum()), len(order), largest)
    allowed = radii >= 0
    low = np.where(allowed, np.maximum(radii - band, 0.0) ** 2, np.inf)
    high = np.where(allowed, (radii + band) ** 2, -1.0)
    free = lattice.periodic.astype(np.int64)
    half = sides.centers is sides.others and kind != DIRECTED
    if not half:
        center_start, center_order = _sorted_by_bin(bin_of, sides.centers, total)
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
            _half(sorted_x, lattice.vectors, *everything, start, order, *written)
        else:
            _between(
                wrapped, sorted_x, lattice.vectors, *everything,
                center_start, center_order, start, order, both, *written,
            )  # fmt: skip
        count, left = int(tally[0]), int(tally[1])
        # what is open may come to be inside
        if left <= doubtful and (kind != INSIDE or count + left <= sure):
            break
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
