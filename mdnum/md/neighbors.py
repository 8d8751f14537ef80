"""A cell-list neighbor search on the host, compiled by numba: the fast builder of Verlet lists.

Bins are half a list radius wide, or wider; an axis with room for fewer than five has a single one, and every
atom meets every atom along it. Distances are those of the minimum image, so the caller refuses radii beyond
half the smallest perpendicular width.
"""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol, runtime_checkable

import numba
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from mdnum.errors import CapacityError, InputError
from mdnum.md.cell import Cell, displacement, strain_loss
from mdnum.numerics import set_bits
from mdnum.registry import Registry

# atoms whose slots are written together: 16 of four bytes are a cache line
_TOGETHER = 16

# a pair at the edge of the list must not be lost to rounding: the skin criterion assumes that every
# unlisted pair was at least r_list apart
SAFETY = 1.0 + 1e-12

# along an axis, before a dilute system gets fewer: a radius may be many orders smaller than the box
_MOST_BINS = 1e9


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
def _columns(b0, b1, bins, reach, periodic, matrix, row, shift):
    """The columns of bins (along the third axis) around one, with the lattice vector that brings each near.

    Returns:
        how many, and the place of the one in the middle. row: the first bin of each.
    """
    found = middle = 0
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
            if d0 == 0 and d1 == 0:
                middle = found
            row[found] = (c0 * bins[1] + c1) * bins[2]
            for c in range(3):
                shift[found, c] = n0 * matrix[0, c] + n1 * matrix[1, c]
            found += 1
    return found, middle


@numba.njit(cache=True, nogil=True)
def _gather(x, start, row, shift, columns, middle, bins, reach, periodic, matrix, near, label, begin, home):
    """Copy the atoms of all columns, layer after layer, moved by their lattice vectors.

    What is near a bin are the layers around its own: one stretch, so that every atom is copied once for a
    whole column of bins.

    Returns:
        whether all fit. begin: where each layer begins, and the end; home: where its middle bin does.
    """
    count = 0
    layers = begin.shape[0] - 1
    for layer in range(layers):
        begin[layer] = count
        b2, n2 = layer - reach[2], 0
        if b2 < 0 or b2 >= bins[2]:
            if not periodic[2]:
                continue
            n2 = 1 if b2 >= bins[2] else -1
            b2 -= n2 * bins[2]
        for q in range(columns):
            first, last = start[row[q] + b2], start[row[q] + b2 + 1]
            if count + last - first > label.shape[0]:
                return False
            if q == middle:
                home[layer] = count
            x0 = shift[q, 0] + n2 * matrix[2, 0]
            x1 = shift[q, 1] + n2 * matrix[2, 1]
            x2 = shift[q, 2] + n2 * matrix[2, 2]
            for j in range(first, last):
                near[0, count], near[1, count], near[2, count] = x[0, j] + x0, x[1, j] + x1, x[2, j] + x2
                label[count] = j
                count += 1
    begin[layers] = count
    return True


# Each of the short loops below is a function of its own over whole slices: written into the loop over atoms,
# they are not vectorized, and a search takes twice as long.


@numba.njit(cache=True, nogil=True)
def _within(x, y, z, xi, yi, zi, r2_list, mask):
    """Which candidates are near."""
    for k in range(len(x)):
        dx, dy, dz = x[k] - xi, y[k] - yi, z[k] - zi
        mask[k] = dx * dx + dy * dy + dz * dz <= r2_list


@numba.njit(cache=True, nogil=True)
def _images_within(x, y, z, xi, yi, zi, matrix, inverse, r2_list, mask):
    """As `_within`, where an axis has a single bin and the nearest image is looked for pair by pair."""
    for k in range(len(x)):
        dx, dy, dz = x[k] - xi, y[k] - yi, z[k] - zi
        f = np.rint(dx * inverse[0, 0] + dy * inverse[1, 0] + dz * inverse[2, 0])
        g = np.rint(dx * inverse[0, 1] + dy * inverse[1, 1] + dz * inverse[2, 1])
        h = np.rint(dx * inverse[0, 2] + dy * inverse[1, 2] + dz * inverse[2, 2])
        dx -= f * matrix[0, 0] + g * matrix[1, 0] + h * matrix[2, 0]
        dy -= f * matrix[0, 1] + g * matrix[1, 1] + h * matrix[2, 1]
        dz -= f * matrix[0, 2] + g * matrix[1, 2] + h * matrix[2, 2]
        mask[k] = dx * dx + dy * dy + dz * dz <= r2_list


@numba.njit(cache=True, nogil=True)
def _compressed(mask, label, chosen):
    """Write the labels that the mask keeps, without a branch: over the one before unless that is kept."""
    filled = np.uint64(0)
    for k in range(len(label)):
        chosen[filled] = label[k]
        filled += mask[k]
    return np.int64(filled)


@numba.njit(cache=True, nogil=True)
def _padded(chosen, filled, padding, out):
    for k in range(len(out)):
        out[k] = chosen[k] if k < filled else padding


@numba.njit(cache=True, nogil=True)
def _transposed(rows, table, first, atoms):
    """The slots of consecutive atoms, which share cache lines: written together."""
    for k in range(table.shape[0]):
        for i in range(atoms):
            table[k, first + i] = rows[i, k]


@numba.njit(cache=True, nogil=True)
def _fill(x, matrix, inverse, periodic, bins, reach, start, r2_list, table):
    """Neighbors of every (bin-sorted) atom; returns the largest number found, which may exceed the room."""
    room, n = table.shape
    most = 0
    by_pair = False
    for k in range(3):
        by_pair = by_pair or (periodic[k] and reach[k] == 0)
    row, shift = np.empty(25, np.int64), np.empty((25, 3))
    layers = bins[2] + 2 * reach[2]
    begin, home = np.empty(layers + 1, np.int64), np.empty(layers, np.int64)
    capacity = 0
    near, label = np.empty((3, capacity)), np.empty(capacity, np.int32)
    mask, chosen = np.empty(capacity, np.uint8), np.empty(capacity, np.int32)
    rows = np.empty((_TOGETHER, room), np.int32)
    for b0 in range(bins[0]):
        for b1 in range(bins[1]):
            column = (b0 * bins[1] + b1) * bins[2]
            if start[column] == start[column + bins[2]]:
                continue
            columns, middle = _columns(b0, b1, bins, reach, periodic, matrix, row, shift)
            while not _gather(
                x, start, row, shift, columns, middle, bins, reach, periodic, matrix, near, label, begin, home
            ):
                capacity = 2 * capacity + 1024
                near, label = np.empty((3, capacity)), np.empty(capacity, np.int32)
                mask, chosen = np.empty(capacity, np.uint8), np.empty(max(capacity, room) + 1, np.int32)
            for b2 in range(bins[2]):
                here = column + b2
                low, high = begin[b2], begin[b2 + 2 * reach[2] + 1]
                px, py, pz = near[0, low:high], near[1, low:high], near[2, low:high]
                for i in range(start[here], start[here + 1]):
                    if by_pair:
                        _images_within(px, py, pz, x[0, i], x[1, i], x[2, i], matrix, inverse, r2_list, mask)
                    else:
                        _within(px, py, pz, x[0, i], x[1, i], x[2, i], r2_list, mask)
                    mask[home[b2 + reach[2]] - low + i - start[here]] = 0  # the atom itself
                    filled = _compressed(mask, label[low:high], chosen)
                    most = max(most, filled)
                    _padded(chosen, filled, n, rows[i % _TOGETHER])
                    first = i - i % _TOGETHER
                    if i - first == _TOGETHER - 1 or i == n - 1:
                        _transposed(rows, table, first, i - first + 1)
    return most


def grid(cell: Cell, fractional_extent, r_list: float, atoms: int):
    """Number of bins and reach of the search along each axis."""
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
            low, high = components[k].min(), components[k].max()
            extent[k] = free_extent(cell, low, high)
            fractional[k] = (components[k] - low) / (extent[k] or np.inf)
    bins, reach = grid(cell, extent, r_list, atoms)
    start = np.zeros(int(np.prod(bins)) + 1, np.int64)
    order = np.empty(atoms, np.int64)
    _bin_atoms(fractional, bins, np.empty(atoms, np.int64), start, order)
    table = _table(room, atoms)
    most = _fill(
        np.ascontiguousarray(components[:, order]),
        np.asarray(cell.matrix, np.float64),
        inverse,
        np.array(cell.pbc),
        bins,
        reach,
        start,
        (r_list * SAFETY) ** 2,
        table,
    )
    return table, order, int(most)


_used: list[np.ndarray] = []
_using = threading.Lock()


def _table(room: int, atoms: int) -> Int[np.ndarray, "room atoms"]:
    """Memory for a table, aligned so that a CPU backend needs no copy; again that of one nobody holds.

    Of a million atoms it is half a gigabyte, and memory that a process gets anew takes longer than a search.
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
    """What the bins along a free axis span, from the first to the last of the atoms; 0 where one bin has all.

    The direction is that of the axis itself, orthogonal to the periodic ones where the lattice vectors are.
    """
    return float(high - low) if cell.orthorhombic or not any(cell.pbc) else 0.0


# --- verlet skin lists: when they are rebuilt, how they are built, and what they hold -----------------

# decisions leave the force loop eight to a byte, so lists have a multiple of eight slots
SLOTS = 8


@dataclass(frozen=True)
class RebuildRule:
    """When a list is rebuilt, in the words of LAMMPS's neigh_modify.

    Attributes:
        skin: r_list - r_cut, length.
        every: a list may be rebuilt only at multiples of this many steps after its build.
        delay: and not before this many steps.
        check: rebuild only where an atom has moved by more than skin/2 (else blindly, whenever allowed).
    """

    skin: float
    every: int = 1
    delay: int = 0
    check: bool = True

    @property
    def first_allowed(self) -> int:
        """Age at which a list can first be rebuilt; a build there is `dangerous` in LAMMPS's sense,
        because an earlier one may have been due."""
        return max(self.every, self.delay)

    @property
    def safe(self) -> bool:
        """Whether a list is never used once its skin is spent."""
        return self.check and self.every == 1 and self.delay <= 1


@dataclass(frozen=True)
class PairTable:
    """The pairs of one list, both directions, as the force loop reads them.

    Attributes:
        found: neighbor of each slot and atom, in sorted labels, padded with the number of atoms,
            shape (slots, atoms); where the search left it, on the host or on a device.
        sorting: sorted atom k is atom sorting[k]; where the search left it.
        r_list: list radius, length.
        occupancy: largest number of neighbors of an atom.
        build_seconds: time the search took.
    """

    found: Int[np.ndarray | Array, "slots atoms"]
    sorting: Int[np.ndarray | Array, "atoms"]
    r_list: float
    occupancy: int
    build_seconds: float

    @cached_property
    def index(self) -> Int[np.ndarray, "slots atoms"]:
        """`found`, on the host."""
        return np.asarray(self.found)

    @cached_property
    def order(self) -> Int[np.ndarray, "atoms"]:
        """`sorting`, on the host."""
        return np.asarray(self.sorting)

    @property
    def slots(self) -> int:
        """Room per atom."""
        return self.found.shape[0]

    @cached_property
    def pairs(self) -> int:
        """Number of listed pairs, each counted once."""
        module = self.found.__array_namespace__()
        return int(module.count_nonzero(self.found < self.found.shape[1])) // 2

    def decided(
        self, bits: UInt8[np.ndarray, "words atoms"]
    ) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
        """Labels i < j of the pairs whose packed decision is yes, each once, in the order of the table."""
        slots, columns = set_bits(bits)
        i, j = self.order[columns], self.order[self.index[slots, columns]]
        keep = i < j
        return i[keep], j[keep]

    def unsorted(self) -> Int[np.ndarray, "atoms slots"]:
        """Neighbors in the user's labels, one row per atom, padded with the number of atoms."""
        atoms = self.index.shape[1]
        labels = np.append(self.order, atoms).astype(np.int32)
        out = np.empty((atoms, self.slots), np.int32)
        out[self.order] = labels[self.index].T
        return out


@runtime_checkable
class ListBuilder(Protocol):
    """A neighbor search that fills a pair table."""

    @property
    def name(self) -> str:
        """The word of system files."""
        ...

    def build(
        self, positions: Float[np.ndarray | Array, "atoms 3"], cell: Cell, r_list: float, slots: int
    ) -> tuple[Int[np.ndarray | Array, "slots atoms"], Int[np.ndarray | Array, "atoms"], int]:
        """Index table in sorted labels, order, and the largest neighbor count (above slots: incomplete)."""
        ...


@dataclass(frozen=True)
class HostBuilder:
    """mdnum's own cell list, compiled by numba, on the host."""

    name: str = "host"

    def build(self, positions, cell, r_list, slots):
        return neighbor_table(np.asarray(positions), cell, r_list, slots)


@dataclass(frozen=True)
class JaxMdBuilder:
    """jax-md's partition.neighbor_list, through the adaptor that keeps its traps shut."""

    name: str = "jax-md"

    def build(self, positions, cell, r_list, slots):
        from mdnum.md import jaxmd

        rows = np.asarray(jaxmd.dense_pairs(np.asarray(positions), cell.matrix, cell.pbc, r_list))
        atoms = len(positions)
        occupancy = int((rows < atoms).sum(1).max(initial=0))
        table = np.full((slots, atoms), atoms, np.int32)
        # jax-md pads at the end of a row; its order is kept, it is the order of the sum
        kept = min(slots, rows.shape[1])
        if occupancy <= slots:
            table[:kept] = rows[:, :kept].T
        return table, np.arange(atoms), occupancy


#: Every way to search for neighbors, by its name; a package adds one by an entry point of this group.
BUILDERS: Registry[ListBuilder] = Registry("list builder", "mdnum.builders")
BUILDERS.add("host", HostBuilder())
BUILDERS.add("jax-md", JaxMdBuilder())
BUILDERS.add("device", "mdnum.md.device_search:BUILDER")


def check_radius(cell: Cell, r_cut: float, skin: float) -> None:
    """Refuse a list radius that the minimum image cannot serve.

    Raises:
        InputError: r_cut + skin exceeds half the smallest perpendicular width of the box.
    """
    half = float(np.min(cell.widths)) / 2
    if r_cut + skin > half:
        wanted = f"r_cut + skin = {r_cut + skin:g} exceeds half the smallest perpendicular box width {half:g}"
        if r_cut < half:
            remedy = f"Use a skin of at most {half - r_cut:.4g}, or a larger box"
        else:
            remedy = f"Repeat the box (r_cut alone needs a width of {2 * r_cut:g}) or use a smaller cutoff"
        raise InputError(wanted, remedy=remedy, where="neighbors.skin")


@dataclass
class VerletList:
    """A list that grows its capacity when it must and remembers where it was built.

    Attributes:
        builder: the neighbor search.
        rule: when to rebuild.
        r_cut: largest interaction radius, length.
        slack: room kept beyond the largest occupancy seen, so that a denser moment does not recompile.
        guard: added to the list radius to cover the rounding of displacements in a narrow state, length.
        slots: room per atom; 0 lets the density decide.
    """

    builder: ListBuilder
    rule: RebuildRule
    r_cut: float
    slack: float = 1.04
    guard: float = 0.0
    slots: int = field(default=0)

    def build(self, positions: Float[np.ndarray | Array, "atoms 3"], cell: Cell) -> PairTable:
        """The pairs within r_cut + skin of wrapped positions; capacity grows until they fit.

        Raises:
            CapacityError: an atom would have every other atom as a neighbor and more.
        """
        r_list = self.r_cut + self.rule.skin
        atoms = len(positions)
        first = not self.slots
        if first:
            self.slots = self._guess(atoms, cell, r_list)
        begin = time.perf_counter()
        while True:
            index, order, most = self.builder.build(positions, cell, r_list + self.guard, self.slots)
            if most <= self.slots and first:
                # every size of table is compiled for: settle on one with room before the first use
                first, wanted = False, self._rounded(most * self.slack)
                if wanted > self.slots:
                    self.slots = wanted
                    continue
                index, self.slots = index[:wanted], wanted
            if most <= self.slots:
                return PairTable(index, order, r_list, most, time.perf_counter() - begin)
            if most >= atoms and atoms > 1:
                raise CapacityError(f"an atom has {most} neighbors among {atoms} atoms")
            self.slots = self._rounded(most * self.slack)

    def _guess(self, atoms: int, cell: Cell, r_list: float) -> int:
        volume = cell.volume
        if not np.isfinite(volume):
            return SLOTS
        # one that is too small costs another search; what is too much is cut off
        mean = atoms / volume * 4.0 / 3.0 * np.pi * r_list**3
        return self._rounded(min(1.25 * mean + 8, atoms))

    @staticmethod
    def _rounded(slots: float) -> int:
        return max(SLOTS, int(np.ceil(slots / SLOTS)) * SLOTS)

    def consumed(self, positions, cell: Cell, reference, reference_cell: Cell) -> float:
        """Share of the skin that motion and box strain have used since the build; above 1 is too late.

        Args:
            positions, cell: now; reference, reference_cell: at the build. Wrapped positions, length.
        """
        moved = displacement(cell, _carried(reference, reference_cell, cell), positions)
        largest = float(np.sqrt(np.max(sum(c * c for c in moved), initial=0.0)))
        loss = strain_loss(reference_cell, cell, self.r_cut + self.rule.skin)
        return (2 * largest + loss) / self.rule.skin if self.rule.skin > 0 else np.inf


def _carried(positions, old: Cell, new: Cell):
    """Where positions would be if they had only moved with the box."""
    if np.array_equal(old.matrix, new.matrix):
        return positions
    return np.asarray(positions) @ np.asarray(old.inverse) @ np.asarray(new.matrix)
