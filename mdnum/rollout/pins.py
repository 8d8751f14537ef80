"""Decisions of single pairs that a run is told, while it makes all others itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int, UInt8

from mdnum.md.verlet import PairTable


@dataclass(frozen=True)
class Pin:
    """What a run is told about one pair.

    Attributes:
        i, j: the pair, i < j.
        first, last: steps at which it is told.
        changes: steps at which what it is told changes, ascending.
        inside: what it is told before the first of them.
    """

    i: int
    j: int
    first: int
    last: int
    changes: tuple[int, ...] = ()
    inside: bool = False

    def at(self, steps: Int[np.ndarray, "steps"]) -> Bool[np.ndarray, "steps"]:
        """What it is told at given steps."""
        turned = np.searchsorted(np.asarray(self.changes, np.int64), steps, side="right")
        return (turned % 2 == 1) ^ self.inside


@dataclass(frozen=True)
class Pins:
    """The pairs whose decisions a run is told."""

    pins: Sequence[Pin]

    def rows(
        self, table: PairTable, first: int, count: int
    ) -> tuple[UInt8[np.ndarray, "rows words atoms"], UInt8[np.ndarray, "rows words atoms"]]:
        """Packed decisions and where they hold, for consecutive steps of one list.

        A pair that the list does not hold is too far away to be inside, and cannot be told to be.

        Args:
            table: the list.
            first: step of the first row.
            count: number of rows.
        """
        atoms = len(table.order)
        shape = (count, table.slots // 8, atoms)
        told, where = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        place = np.argsort(table.order)
        steps = np.arange(first, first + count)
        index = table.index.reshape(-1, atoms)
        for pin in self.pins:
            held = (steps >= pin.first) & (steps <= pin.last)
            if not held.any():
                continue
            inside = pin.at(steps)
            for atom, other in ((pin.i, pin.j), (pin.j, pin.i)):
                column = place[atom]
                for slot in np.flatnonzero(index[:, column] == place[other]):
                    bit = np.uint8(1 << (slot % 8))
                    where[held, slot // 8, column] |= bit
                    told[held & inside, slot // 8, column] |= bit
        return told, where
