"""Simulations with reordered neighbor lists: in the order of a jax-md format, or at random.

Newton's third law holds exactly. The format of a list thus changes only the order of sums. A dense or sparse
list contains each pair twice. Each entry contributes half of the pair force. In a sparse list, entries in an
atom's own row form one sum, those in other rows a second sum. The two sums are added. A loop over atom labels
gives the same result if rows are sorted. In a dense list, entries in other rows are added one by one to the
sum over the atom's own row. An ordered-sparse list contains each pair of atoms once. Forces from atoms with
larger labels form one sum, those from smaller labels a second sum.

Source: jax_md.smap.pair_neighbor_list of jax-md 0.2.29, whose forces are reproduced bit for bit
(tests/forks/test_choices.py). If an atom has more than 32 slots, XLA adds them in blocks of 32. Such blocks
are not reproduced here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Int

from mdnum.md.neighbors import ListBuilder, PairTable, VerletList
from mdnum.numerics.sums import Halves, Reduction, Sequential, Twice
from mdnum.systems.simulation import Simulation

#: Order of the sum over neighbors for each list format.
_SUMS: Mapping[str, Reduction] = {"dense": Twice(), "sparse": Sequential(), "ordered-sparse": Halves()}


@dataclass(frozen=True)
class ReorderedSimulation(Simulation):
    """A simulation whose neighbor lists have a prescribed or random order of pairs."""

    order: str | int = 0  # a format, or the seed of a shuffle

    @classmethod
    def of(cls, simulation: Simulation, order: str | int) -> ReorderedSimulation:
        """Create a simulation with reordered neighbor lists. Sequential sums follow the new order."""
        same = _fields(Simulation, simulation)
        if isinstance(order, str) and simulation.reduction == Sequential():
            same["reduction"] = _SUMS[order]
        return cls(**same, order=order)

    @property
    def lists(self):
        """Properties that identify neighbor lists, including the order of pairs."""
        return (*super().lists, self.order)

    def verlet_list(self, skin: float | None = None) -> VerletList:
        """Create the Verlet list of the simulation, with pairs in the order of `order`."""
        made = super().verlet_list(skin)
        if isinstance(self.order, str):
            return FormattedList(**_fields(VerletList, made), format=self.order)
        made.builder = ShuffledBuilder(made.builder, self.order)
        return made


def _fields(kind: type, value: object) -> dict:
    return {one.name: getattr(value, one.name) for one in fields(kind)}


@dataclass
class FormattedList(VerletList):
    """A neighbor list in the order of a jax-md neighbor-list format."""

    # "dense" or "sparse" (by label), or "ordered-sparse" (later atoms in the first half of the slots, earlier
    # ones in the second, both by label)
    format: str = "sparse"
    half: int = 0  # slots of one half; grows with what it must hold

    def build(self, positions, cell) -> PairTable:
        """Build the table of atom pairs in the order of the jax-md format."""
        table = super().build(positions, cell)
        atoms = len(table.order)
        labels = np.append(table.order, atoms)[table.index]
        own = table.order[None, :]
        real = labels < atoms
        if self.format != "ordered-sparse":
            return replace(table, found=_first(table.index, labels, real, table.slots))
        parts = real & (labels > own), real & (labels < own)
        most = max(int(part.sum(axis=0).max(initial=0)) for part in parts)
        if most > self.half:
            self.half = self._rounded(self.slack * most)
        halves = [_first(table.index, labels, part, self.half) for part in parts]
        return replace(table, found=np.concatenate(halves))


def _first(
    index: Int[np.ndarray, "slots atoms"],
    labels: Int[np.ndarray, "slots atoms"],
    chosen: Bool[np.ndarray, "slots atoms"],
    slots: int,
) -> Int[np.ndarray, "kept atoms"]:
    """Return the selected neighbors of each atom, sorted by label. Padding fills the other slots."""
    atoms = index.shape[1]
    keys = np.where(chosen, labels, atoms)
    order = np.argsort(keys, axis=0, kind="stable")[:slots]
    found = np.where(
        np.take_along_axis(chosen, order, axis=0), np.take_along_axis(index, order, axis=0), atoms
    )
    padding = np.full((slots - len(found), atoms), atoms, index.dtype)
    return np.concatenate([found.astype(index.dtype), padding])


@dataclass(frozen=True)
class ShuffledBuilder:
    """A neighbor search that shuffles the neighbors of each atom independently."""

    inner: ListBuilder  # who searches
    seed: int  # of the shuffle; every list of a run is shuffled with it again

    @property
    def name(self) -> str:
        """Name of the neighbor search whose result is shuffled."""
        return self.inner.name

    def build(self, positions, cell, r_list, slots):
        """Build the table of atom pairs: shuffled neighbors of each atom, then padding."""
        table, order, most = self.inner.build(positions, cell, r_list, slots)
        table, atoms = np.asarray(table), table.shape[1]
        keys = np.random.default_rng(self.seed).random(table.shape)
        keys[table == atoms] = 2.0
        return np.take_along_axis(table, np.argsort(keys, axis=0, kind="stable"), axis=0), order, most
