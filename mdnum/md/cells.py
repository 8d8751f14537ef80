"""A cell-list neighbor search on the host, compiled by numba: the fast builder of Verlet lists.

Bins are half a list radius wide, or wider; an axis with room for fewer than five has a single one, and every
atom meets every atom along it. Distances are those of the minimum image, so the caller refuses radii beyond
half the smallest perpendicular width.
"""

from __future__ import annotations

import numba
import numpy as np
from jaxtyping import Float, Int

from mdnum.md.cell import Cell

# a pair at the edge of the list must not be lost to rounding: the skin criterion assumes that every
# unlisted pair was at least r_list apart
_SAFETY = 1.0 + 1e-12


@numba.njit(cache=True, nogil=True)
def _bin_atoms(fractional, bins, bin_of, start, order):
    """Counting sort of atoms by bin; atoms keep their order within a bin."""
    n = fractional.shape[1]
    for i in range(n):
        b = 0
        for k in range(3):
            place = int(fractional[k, i] * bins[k])
            # rounding can put a fractional coordinate at 1, or a free coordinate at the far edge
            place = min(max(place, 0), bins[k] - 1)
            b = b * bins[k] + place
        bin_of[i] = b
        start[b + 1] += 1
    for b in range(start.shape[0] - 1):
        start[b + 1] += start[b]
    cursor = start[:-1].copy()
    for i in range(n):
        b = bin_of[i]
        order[cursor[b]] = i
        cursor[b] += 1


@numba.njit(cache=True, nogil=True)
def _segments(b0, b1, b2, bins, reach, periodic, start, matrix, first, last, shift):
    """Runs of bin-sorted atoms around one bin, with the lattice vector that brings each run near.

    Bins along the last axis follow one another in memory, so a run spans all that need the same vector.
    """
    found = 0
    for d0 in range(-reach[0], reach[0] + 1):
        c0 = b0 + d0
        n0 = 0
        if c0 < 0 or c0 >= bins[0]:
            if not periodic[0]:
                continue
            n0 = 1 if c0 >= bins[0] else -1
            c0 -= n0 * bins[0]
        for d1 in range(-reach[1], reach[1] + 1):
            c1 = b1 + d1
            n1 = 0
            if c1 < 0 or c1 >= bins[1]:
                if not periodic[1]:
                    continue
                n1 = 1 if c1 >= bins[1] else -1
                c1 -= n1 * bins[1]
            row = (c0 * bins[1] + c1) * bins[2]
            for n2 in range(-1, 2):
                if n2 != 0 and not periodic[2]:
                    continue
                low = max(b2 - reach[2], n2 * bins[2])
                high = min(b2 + reach[2], (n2 + 1) * bins[2] - 1)
                if low > high:
                    continue
                first[found] = start[row + low - n2 * bins[2]]
                last[found] = start[row + high - n2 * bins[2] + 1]
                for c in range(3):
                    shift[found, c] = n0 * matrix[0, c] + n1 * matrix[1, c] + n2 * matrix[2, c]
                found += 1
    return found


@numba.njit(cache=True, nogil=True)
def _gather(x, runs, first, last, shift, near):
    """Copy the atoms of all runs side by side, moved by their lattice vectors; returns how many."""
    count = 0
    for q in range(runs):
        for j in range(first[q], last[q]):
            for c in range(3):
                near[c, count] = x[c, j] + shift[q, c]
            near[3, count] = j
            count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _distances(near, count, xi, yi, zi, squares):
    """Squared distances to all candidates; a loop without branches, which vectorizes."""
    for k in range(count):
        dx, dy, dz = near[0, k] - xi, near[1, k] - yi, near[2, k] - zi
        squares[k] = dx * dx + dy * dy + dz * dz


@numba.njit(cache=True, nogil=True)
def _image_distances(near, count, xi, yi, zi, matrix, inverse, squares):
    """As `_distances`, where an axis has a single bin and the nearest image is looked for pair by pair."""
    for k in range(count):
        dx, dy, dz = near[0, k] - xi, near[1, k] - yi, near[2, k] - zi
        f = np.rint(dx * inverse[0, 0] + dy * inverse[1, 0] + dz * inverse[2, 0])
        g = np.rint(dx * inverse[0, 1] + dy * inverse[1, 1] + dz * inverse[2, 1])
        h = np.rint(dx * inverse[0, 2] + dy * inverse[1, 2] + dz * inverse[2, 2])
        dx -= f * matrix[0, 0] + g * matrix[1, 0] + h * matrix[2, 0]
        dy -= f * matrix[0, 1] + g * matrix[1, 1] + h * matrix[2, 1]
        dz -= f * matrix[0, 2] + g * matrix[1, 2] + h * matrix[2, 2]
        squares[k] = dx * dx + dy * dy + dz * dz


@numba.njit(cache=True, nogil=True)
def _fill(x, matrix, inverse, periodic, bins, reach, start, r2_list, table):
    """Neighbors of every (bin-sorted) atom; returns the largest number found, which may exceed the room.

    x is bin-sorted, (3, n), each coordinate in the box. table is (room, n); of an atom whose neighbors do not
    fit, those that do are written.
    """
    n = x.shape[1]
    room = table.shape[0]
    most = 0
    by_pair = False
    for k in range(3):
        by_pair = by_pair or (periodic[k] and reach[k] == 0)
    near, squares, chosen = np.empty((4, n + 1)), np.empty(n + 1), np.empty(n + 1, np.int32)
    first, last = np.empty(75, np.int64), np.empty(75, np.int64)
    shift = np.empty((75, 3))
    for b0 in range(bins[0]):
        for b1 in range(bins[1]):
            for b2 in range(bins[2]):
                here = (b0 * bins[1] + b1) * bins[2] + b2
                if start[here] == start[here + 1]:
                    continue
                runs = _segments(b0, b1, b2, bins, reach, periodic, start, matrix, first, last, shift)
                count = _gather(x, runs, first, last, shift, near)
                for i in range(start[here], start[here + 1]):
                    if by_pair:
                        _image_distances(near, count, x[0, i], x[1, i], x[2, i], matrix, inverse, squares)
                    else:
                        _distances(near, count, x[0, i], x[1, i], x[2, i], squares)
                    filled = 0
                    # no branch to mispredict: every candidate is written, and overwritten unless it is kept
                    for k in range(count):
                        j = np.int32(near[3, k])
                        chosen[filled] = j
                        filled += int((squares[k] <= r2_list) & (j != i))
                    most = max(most, filled)
                    # the slots of consecutive atoms share cache lines, so this is no slower than by rows
                    for k in range(min(filled, room)):
                        table[k, i] = chosen[k]
    return most


def _grid(cell: Cell, fractional_extent, r_list: float, atoms: int):
    """Number of bins and reach of the search along each axis."""
    bins = np.ones(3, np.int64)
    reach = np.zeros(3, np.int64)
    for k in range(3):
        width = fractional_extent[k]
        # with the safety: a pair at r_list must never be three bins of r_list/2 apart by rounding
        fine = int(2 * width / (r_list * _SAFETY))
        if fine >= 5:
            bins[k], reach[k] = fine, 2
        # fewer: one bin along this axis, every atom meets every atom once
    # empty bins cost a visit each: a dilute system gets no more bins than about two per atom
    while np.prod(bins.astype(float)) > max(27.0, 2.0 * atoms) and bins.max() > 5:
        bins[np.argmax(bins)] = max(5, int(bins[np.argmax(bins)] * 0.7))
    return bins, reach


def neighbor_table(
    positions: Float[np.ndarray, "atoms 3"], cell: Cell, r_list: float, room: int
) -> tuple[Int[np.ndarray, "room atoms"], Int[np.ndarray, "atoms"], int]:
    """All neighbors within r_list of every atom, in both directions, atoms sorted by bin.

    Args:
        positions: wrapped positions, length.
        cell: the box.
        r_list: list radius, length, at most half the smallest perpendicular width.
        room: slots per atom.

    Returns:
        table of sorted indices padded with the number of atoms; order, such that sorted atom k is atom
        order[k]; and the largest number of neighbors, which exceeds room when the table is incomplete.
    """
    atoms = len(positions)
    components = np.ascontiguousarray(positions.T, np.float64)
    inverse = np.asarray(cell.inverse, np.float64)
    fractional = inverse.T @ components
    extent = cell.widths.copy()
    for k in range(3):
        if cell.pbc[k]:
            # wrapping a tiny negative coordinate can round it to L itself: bring it to the bin it is put in
            outside = np.floor(fractional[k])
            if outside.any():
                fractional[k] -= outside
                components = components - np.outer(np.asarray(cell.matrix)[k], outside)
        else:
            # along a free axis the bins span the atoms; the direction is that of the axis itself,
            # orthogonal to the periodic ones where the lattice vectors are (else one bin)
            extent[k], fractional[k] = _free_axis(cell, components, k)
    bins, reach = _grid(cell, extent, r_list, atoms)
    start = np.zeros(int(np.prod(bins)) + 1, np.int64)
    order = np.empty(atoms, np.int64)
    _bin_atoms(fractional, bins, np.empty(atoms, np.int64), start, order)
    table = np.full((room, atoms), atoms, np.int32)
    most = _fill(
        np.ascontiguousarray(components[:, order]),
        np.asarray(cell.matrix, np.float64),
        inverse,
        np.array(cell.pbc),
        bins,
        reach,
        start,
        (r_list * _SAFETY) ** 2,
        table,
    )
    return table, order, int(most)


def _free_axis(cell: Cell, components, k: int):
    """Extent along a free axis, and the atoms' place in it from 0 to 1."""
    if not cell.orthorhombic and any(cell.pbc):
        return 0.0, np.zeros(components.shape[1])
    low, high = float(components[k].min()), float(components[k].max())
    extent = high - low
    if extent <= 0:
        return 0.0, np.zeros(components.shape[1])
    return extent, (components[k] - low) / extent
