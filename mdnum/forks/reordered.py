"""Simulations whose lists hold the same pairs in another order: of jax-md's formats, or shuffled.

A pair's force on one end is exactly minus that on the other, so a format changes nothing but an order. Dense
and sparse lists hold a pair from both ends and add half its force for each. A sparse list adds the halves of
an atom's own row in one sum, those of the rows that name it in another, and the two together; where rows are
sorted that is one loop by label. A dense list scatters the second half onto the sum of the first. An
ordered-sparse list holds each pair once: an atom's terms with later atoms are one sum, those with earlier
atoms another.

Source: jax_md.smap.pair_neighbor_list and the transpose of its gathers, whose forces have these orders bit
for bit (tests/forks/test_choices.py, jax-md 0.2.29). One thing more belongs to XLA: it adds an own row of
more than 32 slots in windows of 32, which is left out here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Int

from mdnum.md.neighbors import ListBuilder, PairTable, VerletList
from mdnum.numerics.sums import Halves, Reduction, Sequential, Twice
from mdnum.systems.simulation import Simulation

#: The sums that go with each format.
_SUMS: Mapping[str, Reduction] = {"dense": Twice(), "sparse": Sequential(), "ordered-sparse": Halves()}


@dataclass(frozen=True)
class ReorderedSimulation(Simulation):
    """A simulation whose lists hold their pairs in another order."""

    order: str | int = 0  # a format, or the seed of a shuffle

    @classmethod
    def of(cls, simulation: Simulation, order: str | int) -> ReorderedSimulation:
        """A simulation with such lists, and the sums that go with a format unless they have no order."""
        same = _fields(Simulation, simulation)
        if isinstance(order, str) and simulation.reduction == Sequential():
            same["reduction"] = _SUMS[order]
        return cls(**same, order=order)

    @property
    def lists(self):
        """Lists of another order are other lists."""
        return (*super().lists, self.order)

    def verlet_list(self, skin: float | None = None) -> VerletList:
        """As the simulation's own, in the other order."""
        made = super().verlet_list(skin)
        if isinstance(self.order, str):
            return FormattedList(**_fields(VerletList, made), format=self.order)
        made.builder = ShuffledBuilder(made.builder, self.order)
        return made


def _fields(kind: type, value: object) -> dict:
    return {one.name: getattr(value, one.name) for one in fields(kind)}


@dataclass
class FormattedList(VerletList):
    """A list whose slots are in the order in which a format adds."""

    # "dense" or "sparse" (by label), or "ordered-sparse" (later atoms in the first half of the slots, earlier
    # ones in the second, both by label)
    format: str = "sparse"
    half: int = 0  # slots of one half; grows with what it must hold

    def build(self, positions, cell) -> PairTable:
        """As the search found them, in another order."""
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
    """The chosen neighbors of each atom by label, then padding."""
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
    """A neighbor search whose rows are shuffled, each atom's in its own way."""

    inner: ListBuilder  # who searches
    seed: int  # of the shuffle; every list of a run is shuffled with it again

    @property
    def name(self) -> str:
        """The inner search's word."""
        return self.inner.name

    def build(self, positions, cell, r_list, slots):
        """The inner search's table with the neighbors of each atom in another order, padding at the end."""
        table, order, most = self.inner.build(positions, cell, r_list, slots)
        table, atoms = np.asarray(table), table.shape[1]
        keys = np.random.default_rng(self.seed).random(table.shape)
        keys[table == atoms] = 2.0
        return np.take_along_axis(table, np.argsort(keys, axis=0, kind="stable"), axis=0), order, most
