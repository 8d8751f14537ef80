"""Verlet neighbor lists: rules for rebuilding, list builders, and listed pairs."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from mdnum.errors import CapacityError, InputError
from mdnum.md.cell import Cell, displacement, strain_loss
from mdnum.md.host_search import neighbor_table
from mdnum.numerics import set_bits
from mdnum.registry import Registry

# decisions leave the force loop eight to a byte, so lists have a multiple of eight slots
SLOTS = 8


@dataclass(frozen=True)
class RebuildRule:
    """Rule for rebuilding a neighbor list, with the parameters of LAMMPS's neigh_modify."""

    skin: float  # r_list - r_cut, length
    every: int = 1  # a list may be rebuilt only at multiples of this many steps after its build
    delay: int = 0  # and not before this many steps
    # rebuild only where an atom has moved by more than skin/2 (else blindly, whenever allowed)
    check: bool = True

    @property
    def first_allowed(self) -> int:
        """Smallest age, in steps, at which a neighbor list can be rebuilt.

        LAMMPS calls a rebuild at the smallest age dangerous, since the rebuild may be too late."""
        return max(self.every, self.delay)

    @property
    def safe(self) -> bool:
        """True if every list is rebuilt before atoms have moved too far."""
        return self.check and self.every == 1 and self.delay <= 1


@dataclass(frozen=True)
class PairTable:
    """Pairs of one neighbor list, in the memory layout of the force loop."""

    # neighbor of each slot and atom, in sorted labels, padded with the number of atoms, shape (slots, atoms);
    # where the search left it, on the host or on a device
    found: Int[np.ndarray | Array, "slots atoms"]
    sorting: Int[np.ndarray | Array, "atoms"]  # sorted atom k is atom sorting[k]; where the search left it
    r_list: float  # list radius, length
    occupancy: int  # largest number of neighbors of an atom
    build_seconds: float  # time the search took

    @cached_property
    def index(self) -> Int[np.ndarray, "slots atoms"]:
        """Host copy of the neighbor index table `found`."""
        return np.asarray(self.found)

    @cached_property
    def order(self) -> Int[np.ndarray, "atoms"]:
        """Host copy of `sorting`, the order of the sorted atoms."""
        return np.asarray(self.sorting)

    @cached_property
    def place(self) -> Int[np.ndarray, "atoms"]:
        """Index of each atom in the sorted order: the inverse of `order`."""
        place = np.empty_like(self.order)
        place[self.order] = np.arange(len(place))
        return place

    @property
    def slots(self) -> int:
        """Capacity of the table: number of neighbor slots per atom."""
        return self.found.shape[0]

    @cached_property
    def pairs(self) -> int:
        """Number of pairs in the list, each counted once."""
        module = self.found.__array_namespace__()
        return int(module.count_nonzero(self.found < self.found.shape[1])) // 2

    def decided(
        self, bits: UInt8[np.ndarray, "words atoms"]
    ) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
        """Return atoms i < j of the pairs inside the cutoff, in table order.

        For cutoff number c, c times the number of atoms is added to i.
        """
        slots, columns = set_bits(bits)
        channel, slots = np.divmod(slots, self.slots)
        i, j = self.order[columns], self.order[self.index[slots, columns]]
        keep = i < j
        return (i + channel * len(self.order))[keep], j[keep]

    def listed(self, channels: int = 1) -> tuple[Int[np.ndarray, "pairs"], ...]:
        """Return the indices of each pair among the sorted atoms, and i and j as in `decided`."""
        slots, first = np.nonzero(self.index < len(self.order))
        second = self.index[slots, first]
        i, j = self.order[first], self.order[second]
        once = i < j
        each = (np.tile(part[once], channels) for part in (first, second, i, j))
        first, second, i, j = each
        return first, second, i + np.repeat(np.arange(channels), once.sum()) * len(self.order), j

    def unsorted(self) -> Int[np.ndarray, "atoms slots"]:
        """Return each atom's neighbors in input order. Empty slots of a row contain the number of atoms."""
        atoms = self.index.shape[1]
        labels = np.append(self.order, atoms).astype(np.int32)
        out = np.empty((atoms, self.slots), np.int32)
        out[self.order] = labels[self.index].T
        return out


@runtime_checkable
class ListBuilder(Protocol):
    """Interface of neighbor searches that fill a pair table."""

    @property
    def name(self) -> str:
        """Name of the list builder in system files."""
        ...

    def build(
        self, positions: Float[np.ndarray | Array, "atoms 3"], cell: Cell, r_list: float, slots: int
    ) -> tuple[Int[np.ndarray | Array, "slots atoms"], Int[np.ndarray | Array, "atoms"], int]:
        """Return table, atom order and neighbor count. If the count exceeds `slots`, pairs are missing."""
        ...


@dataclass(frozen=True)
class HostBuilder:
    """List builder with mdnum's own cell list, compiled by numba."""

    name: str = "host"

    def build(self, positions, cell, r_list, slots):
        return neighbor_table(np.asarray(positions), cell, r_list, slots)


@dataclass(frozen=True)
class JaxMdBuilder:
    """List builder with jax-md's partition.neighbor_list and workarounds for its known problems."""

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


#: All neighbor searches by name; a package can add one by an entry point of this group.
BUILDERS: Registry[ListBuilder] = Registry("list builder", "mdnum.builders")
BUILDERS.add("host", HostBuilder())
BUILDERS.add("jax-md", JaxMdBuilder())
BUILDERS.add("device", "mdnum.md.device_search:BUILDER")


def check_radius(cell: Cell, r_cut: float, skin: float) -> None:
    """Raise an error if r_cut + skin is too large for the minimum-image convention.

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
    """Builder of Verlet lists. The builder adds neighbor slots when needed."""

    builder: ListBuilder  # the neighbor search
    rule: RebuildRule  # when to rebuild
    r_cut: float  # largest interaction radius, length
    # room kept beyond the largest occupancy seen, so that a denser moment does not recompile: of a liquid at
    # the start it grows by 7 % in 250 steps of 108,000 atoms, and eight slots too many cost 1 % of the forces
    slack: float = 1.08
    # added to the list radius to cover the rounding of displacements in a narrow state, length
    guard: float = 0.0
    slots: int = field(default=0)  # room per atom; 0 lets the density decide

    def build(self, positions: Float[np.ndarray | Array, "atoms 3"], cell: Cell) -> PairTable:
        """Return the pairs closer than r_cut + skin. Positions must be wrapped into the box.

        Raises:
            CapacityError: an atom would need more slots than there are other atoms.
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
                raise CapacityError(f"an atom has {most} neighbors, but there are only {atoms} atoms")
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
        """Return the fraction of the skin that is used up. Pairs may be missing if the fraction is above 1.

        Args:
            positions, cell: present state. reference, reference_cell: state when the list was built.
                Positions are wrapped, length.
        """
        carried = np.asarray(reference) @ reference_cell.deformation(cell)
        moved = displacement(cell, carried, positions)
        largest = float(np.sqrt(np.max(sum(c * c for c in moved), initial=0.0)))
        loss = strain_loss(reference_cell, cell, self.r_cut + self.rule.skin)
        return float(2 * largest + loss) / self.rule.skin if self.rule.skin > 0 else np.inf
