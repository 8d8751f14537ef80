"""Cell-list neighbor search on the host, compiled by numba, for building Verlet lists.

Bins are at least half as wide as the list radius. An axis that is too short for five bins has a single bin.
Distances are minimum-image distances. The radius must not exceed half the smallest perpendicular width.
"""

from __future__ import annotations

import sys
import threading

import numpy as np
from jaxtyping import Float, Int

from mdnum.compiled import njit
from mdnum.md.cell import Cell
from mdnum.provenance import cores
from mdnum.vectors import EIGHT, kept, moved, turned

# atoms whose slots are written together: 16 of four bytes are a cache line
_TOGETHER = 16

# a pair at the edge of the list must not be lost to rounding: the skin criterion assumes that every
# unlisted pair was at least r_list apart
SAFETY = 1.0 + 1e-12

# atoms of a thread's share, about: fewer are found sooner than a thread begins
_SHARED = 2000

# along an axis, before a dilute system gets fewer: a radius may be many orders smaller than the box
_MOST_BINS = 1e9


@njit
def _bin_atoms(fractional, bins, bin_of, start, order):
    """Sort atoms by bin. Atoms of a bin keep their order."""
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


@njit
def _layered(x, start, bins):
    """Sort atoms into layers along the third axis. Bins are contiguous along the second axis.

    Returns:
        positions, labels, start of each bin and end of the last bin.
    """
    n = x.shape[1]
    layered, label = np.empty((3, n + EIGHT)), np.empty(n + EIGHT, np.int32)
    begin = np.empty_like(start)
    count = place = 0
    for b0 in range(bins[0]):
        for b2 in range(bins[2]):
            for b1 in range(bins[1]):
                begin[place] = count
                place += 1
                here = (b0 * bins[1] + b1) * bins[2] + b2
                for j in range(start[here], start[here + 1]):
                    layered[0, count], layered[1, count], layered[2, count] = x[0, j], x[1, j], x[2, j]
                    label[count] = j
                    count += 1
    begin[place] = count
    return layered, label, begin


@njit
def _runs(b0, b1, box, run, shift):
    """Find the bins near a column of bins in a layer, and their lattice vectors.

    Returns:
        number of ranges, and the range that contains the column. run: index along the first axis, first and
            last index along the second.
    """
    bins, reach, periodic, matrix = box
    found = middle = 0
    for d0 in range(-reach[0], reach[0] + 1):
        c0 = b0 + d0
        n0 = 0
        if c0 < 0 or c0 >= bins[0]:
            if not periodic[0]:
                continue
            n0 = 1 if c0 >= bins[0] else -1
            c0 -= n0 * bins[0]
        for n1 in range(-1, 2):
            low = max(b1 - reach[1] - n1 * bins[1], 0)
            high = min(b1 + reach[1] - n1 * bins[1], bins[1] - 1)
            if low > high or (n1 != 0 and not periodic[1]):
                continue
            if d0 == 0 and n1 == 0:
                middle = found
            run[found, 0], run[found, 1], run[found, 2] = c0, low, high
            for c in range(3):
                shift[found, c] = n0 * matrix[0, c] + n1 * matrix[1, c]
            found += 1
    return found, middle


@njit
def _gather(layered, b1, run, shift, found, box, near, label, begin, home):
    """Copy the atoms near a column of bins, shifted to their nearby images.

    The neighborhood of a bin consists of contiguous layers around its own layer. Every atom is therefore
    copied only once for a whole column of bins.

    Returns:
        whether the capacity sufficed. begin: start of each layer, and the end; home: start of its middle bin.
    """
    (x, own, start), (runs, middle), (bins, reach, periodic, matrix) = layered, found, box
    count, apart, wide = 0, x.shape[1], near.shape[1]
    layers = begin.shape[0] - 1
    for layer in range(layers):
        begin[layer] = count
        b2, n2 = layer - reach[2], 0
        if b2 < 0 or b2 >= bins[2]:
            if not periodic[2]:
                continue
            n2 = 1 if b2 >= bins[2] else -1
            b2 -= n2 * bins[2]
        for q in range(runs):
            row = (run[q, 0] * bins[2] + b2) * bins[1]
            first, last = start[row + run[q, 1]], start[row + run[q, 2] + 1]
            if count + last - first > wide - EIGHT:
                return False
            if q == middle:
                home[layer] = count + start[row + b1] - first
            x0 = shift[q, 0] + n2 * matrix[2, 0]
            x1 = shift[q, 1] + n2 * matrix[2, 1]
            x2 = shift[q, 2] + n2 * matrix[2, 2]
            # eight at a time: what is behind the last is written over
            for j in range(first, last, EIGHT):
                at = count + j - first
                moved(x, j, x0, near, at)
                moved(x, apart + j, x1, near, wide + at)
                moved(x, 2 * apart + j, x2, near, 2 * wide + at)
                moved(own, j, np.int32(0), label, at)
            count += last - first
    begin[layers] = count
    return True


# Each of the short loops below is a function of its own over whole slices: written into the loop over atoms,
# they are not vectorized, and a search takes twice as long.


@njit
def _within(x, y, z, xi, yi, zi, r2_list, mask):
    """Mark the candidates within the list radius of an atom."""
    for k in range(len(x)):
        dx, dy, dz = x[k] - xi, y[k] - yi, z[k] - zi
        mask[k] = dx * dx + dy * dy + dz * dz <= r2_list


@njit
def _images_within(x, y, z, xi, yi, zi, matrix, inverse, r2_list, mask):
    """Mark the candidates within the list radius, in a box with a single bin along an axis."""
    for k in range(len(x)):
        dx, dy, dz = x[k] - xi, y[k] - yi, z[k] - zi
        f = np.rint(dx * inverse[0, 0] + dy * inverse[1, 0] + dz * inverse[2, 0])
        g = np.rint(dx * inverse[0, 1] + dy * inverse[1, 1] + dz * inverse[2, 1])
        h = np.rint(dx * inverse[0, 2] + dy * inverse[1, 2] + dz * inverse[2, 2])
        dx -= f * matrix[0, 0] + g * matrix[1, 0] + h * matrix[2, 0]
        dy -= f * matrix[0, 1] + g * matrix[1, 1] + h * matrix[2, 1]
        dz -= f * matrix[0, 2] + g * matrix[1, 2] + h * matrix[2, 2]
        mask[k] = dx * dx + dy * dy + dz * dz <= r2_list


@njit
def _compressed(mask, label, first, atoms, out, place):
    """Write the labels of the marked atoms. Return the number of labels."""
    filled = place
    for k in range(0, atoms, EIGHT):
        filled = kept(mask, k, label, first + k, out, filled)
    return filled - place


@njit
def _transposed(rows, table, first, begin, end):
    """Copy the neighbors of many consecutive atoms to the table at once."""
    room, n = table.shape
    if end - begin == _TOGETHER and room % EIGHT == 0:
        for k in range(0, room, EIGHT):
            for i in range(0, _TOGETHER, EIGHT):
                turned(rows, i * rows.shape[1] + k, rows.shape[1], table, k * n + first + i, n)
        return
    for k in range(room):
        for i in range(begin, end):
            table[k, first + i] = rows[i, k]


@njit
def _fill(x, layered, box, inverse, start, r2_list, table, columns):
    """Write the neighbors of all atoms in a range of columns of bins.

    Returns:
        the largest number of neighbors, which may exceed the capacity.
    """
    bins, reach, periodic, matrix = box
    room, n = table.shape
    most, begun, done = 0, start[columns[0] * bins[2]], start[columns[1] * bins[2]]
    by_pair = False
    for k in range(3):
        by_pair = by_pair or (periodic[k] and reach[k] == 0)
    run, shift = np.empty((15, 3), np.int64), np.empty((15, 3))
    layers = bins[2] + 2 * reach[2]
    begin, home = np.empty(layers + 1, np.int64), np.empty(layers, np.int64)
    capacity = 0
    near, label, mask = np.empty((3, EIGHT)), np.empty(EIGHT, np.int32), np.empty(EIGHT, np.uint8)
    rows = np.empty((_TOGETHER, room + _TOGETHER), np.int32)
    for column in range(columns[0] * bins[2], columns[1] * bins[2], bins[2]):
        b0, b1 = column // bins[2] // bins[1], column // bins[2] % bins[1]
        if start[column] == start[column + bins[2]]:
            continue
        found = _runs(b0, b1, box, run, shift)
        while not _gather(layered, b1, run, shift, found, box, near, label, begin, home):
            capacity = 2 * capacity + 1024
            near, label = np.empty((3, capacity + EIGHT)), np.empty(capacity + EIGHT, np.int32)
            mask = np.empty(capacity + EIGHT, np.uint8)
            # rows a cache line further than a power of two apart: those share their places in a cache
            narrow, rows = rows, np.empty((_TOGETHER, max(capacity, room) + _TOGETHER), np.int32)
            for k in range(_TOGETHER):
                for i in range(room):
                    rows[k, i] = narrow[k, i]
        for b2 in range(bins[2]):
            here = column + b2
            low, high = begin[b2], begin[b2 + 2 * reach[2] + 1]
            px, py, pz = near[0, low:high], near[1, low:high], near[2, low:high]
            mask[high - low : high - low + EIGHT] = 0
            for i in range(start[here], start[here + 1]):
                if by_pair:
                    _images_within(px, py, pz, x[0, i], x[1, i], x[2, i], matrix, inverse, r2_list, mask)
                else:
                    _within(px, py, pz, x[0, i], x[1, i], x[2, i], r2_list, mask)
                mask[home[b2 + reach[2]] - low + i - start[here]] = 0  # the atom itself
                row = i % _TOGETHER
                filled = _compressed(mask, label, low, high - low, rows, row * rows.shape[1])
                most = max(most, filled)
                rows[row, filled:room] = n
                first = i - row
                if row == _TOGETHER - 1 or i == done - 1:
                    _transposed(rows, table, first, max(begun - first, 0), row + 1)
    return most


def grid(cell: Cell, fractional_extent, r_list: float, atoms: int):
    """Return the number of bins along each axis, and the search range in bins."""
    bins = np.ones(3, np.int64)
    reach = np.zeros(3, np.int64)
    for k in range(3):
        width = fractional_extent[k]
        # with the safety: a pair at r_list must never be three bins of r_list/2 apart by rounding
        fine = int(min(2 * width / (r_list * SAFETY), _MOST_BINS))
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
    """Find all neighbors within r_list of every atom, in both directions.

    Args:
        positions: wrapped positions, length.
        cell: the box.
        r_list: list radius, length, at most half the smallest perpendicular width.
        room: number of slots per atom.

    Returns:
        table of sorted indices, padded with the number of atoms; order (sorted atom k is atom order[k]); and
            the largest number of neighbors, which exceeds room if the table is incomplete.
    """
    atoms = len(positions)
    components = np.ascontiguousarray(positions.T, np.float64)
    inverse = np.asarray(cell.inverse, np.float64)
    # not as a product of matrices: BLAS's threads look for more work long after it, on the cores of the loop
    fractional = np.zeros_like(components)
    for c, k in zip(*np.nonzero(inverse), strict=True):
        fractional[k] += components[c] * inverse[c, k]
    extent = cell.widths.copy()
    for k in range(3):
        if cell.pbc[k]:
            # wrapping a tiny negative coordinate can round it to L itself: bring it to the bin it is put in
            outside = np.floor(fractional[k])
            if outside.any():
                fractional[k] -= outside
                components = components - np.outer(np.asarray(cell.matrix)[k], outside)
        else:
            low, high = components[k].min(), components[k].max()
            extent[k] = free_extent(cell, low, high)
            fractional[k] = (components[k] - low) / (extent[k] or np.inf)
    bins, reach = grid(cell, extent, r_list, atoms)
    start = np.zeros(int(np.prod(bins)) + 1, np.int64)
    order = np.empty(atoms, np.int64)
    _bin_atoms(fractional, bins, np.empty(atoms, np.int64), start, order)
    table = _table(room, atoms)
    # not by an index, which takes seven times as long across rows
    x = np.take(components, order, axis=1)
    matrix, periodic = np.asarray(cell.matrix, np.float64), np.array(cell.pbc)
    layered = _layered(x, start, bins)
    # shared among threads by atoms; columns of bins are whole
    parts = max(1, min(cores(), atoms // _SHARED))
    ends = np.searchsorted(start[:: bins[2]], np.linspace(0, atoms, parts + 1)[1:-1])
    edges = [0, *ends.tolist(), int(bins[0] * bins[1])]
    most, failed = [0] * parts, []

    def fill(part: int) -> None:
        columns = edges[part], edges[part + 1]
        box, r2_list = (bins, reach, periodic, matrix), (r_list * SAFETY) ** 2
        try:
            most[part] = _fill(x, layered, box, inverse, start, r2_list, table, columns)
        except BaseException as error:
            # a thread's would end with the thread, and leave a part of the table as it was
            failed.append(error)

    helpers = [threading.Thread(target=fill, args=(part,)) for part in range(1, parts)]
    for helper in helpers:
        helper.start()
    fill(0)
    for helper in helpers:
        helper.join()
    if failed:
        raise failed[0]
    return table, order, max(most)


_used: list[np.ndarray] = []
_using = threading.Lock()


def _table(room: int, atoms: int) -> Int[np.ndarray, "room atoms"]:
    """Return memory for a table of neighbors that XLA on a CPU uses without a copy.

    The allocation of a table for a million atoms (half a gigabyte) takes longer than a search.
    """
    size = 4 * room * atoms + 64
    with _using:
        # references: the list's and the argument's
        free = [k for k in range(len(_used)) if sys.getrefcount(_used[k]) == 2]
        fitting = [k for k in free if _used[k].nbytes == size]
        memory = _used[fitting[0]] if fitting else np.empty(size, np.uint8)
        _used[:] = [held for k, held in enumerate(_used) if k not in free] + [memory]
        first = -memory.ctypes.data % 64
        return memory[first : first + size - 64].view(np.int32).reshape(room, atoms)


def free_extent(cell: Cell, low: float, high: float) -> float:
    """Return the extent of the atoms along a nonperiodic axis. The extent is 0 in a tilted box."""
    return float(high - low) if cell.orthorhombic or not any(cell.pbc) else 0.0
