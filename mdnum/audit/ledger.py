"""What all objects of a calculator have answered: a question that comes again has the answer it had."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from ase import Atoms
from jaxtyping import Float

#: Of two energies of one structure: differences of their difference that rounding explains, of doubles and of
#: numbers of single precision.
_ROUNDING, _ROUNDING_SINGLE = 1e-11, 1e-5

#: (which object, its how manieth question).
Question = tuple[int, int]


@dataclass
class Again:
    """Questions that were asked more than once, to the last bit of the structure.

    Attributes:
        times: answers that could be compared with an earlier one.
        differ: of them, those that are not the same to the last bit.
        energy: the largest difference, eV.
        force: the largest difference of all forces together (a norm, estimated from one projection), eV/Å.
    """

    times: int = 0
    differ: int = 0
    energy: float = 0.0
    force: float = 0.0


@dataclass
class Apart:
    """By how much the two energies of a calculator differ for one composition.

    Attributes:
        formula: of the composition.
        first: energy minus free energy where it was asked for first, eV.
        change: the largest change of it that rounding does not explain, eV; signed.
    """

    formula: str
    first: float
    change: float = 0.0


class Ledger:
    """Keeps of each question a few numbers, and compares where it comes again.

    Attributes:
        new: what new objects answered to the first question they were asked: nothing can be remembered there.
        apart: the difference of two energies by composition.
    """

    def __init__(self):
        self.new = Again()
        self.apart: dict[bytes, Apart] = {}
        self._known: dict[tuple[bytes, str], tuple[float, Question]] = {}
        self._projections: dict[int, Float[np.ndarray, "components"]] = {}

    def energy(self, atoms: Atoms, value: float, told: float | None, question: Question, new: bool) -> None:
        """Takes note of the energy that forces belong to, and of the one that a run is told."""
        self._again(atoms, "energy", value, question, new)
        if told is None:
            return
        apart = told - value
        key = np.sort(atoms.numbers).tobytes()
        if key not in self.apart:
            self.apart[key] = Apart(atoms.get_chemical_formula(), apart)
        kept = self.apart[key]
        single = float(np.float32(value)) == value and float(np.float32(told)) == told
        rounding = (_ROUNDING_SINGLE if single else _ROUNDING) * max(abs(value), abs(told))
        change = apart - kept.first
        if abs(change) > max(rounding, abs(kept.change)):
            kept.change = change

    def forces(
        self, atoms: Atoms, values: Float[np.ndarray, "atoms 3"], question: Question, new: bool
    ) -> None:
        """Takes note of forces."""
        if values.size not in self._projections:
            self._projections[values.size] = np.random.default_rng(values.size).standard_normal(values.size)
        along = float(np.sum(self._projections[values.size] * values.ravel()))
        self._again(atoms, "forces", along, question, new)

    def _again(self, atoms: Atoms, what: str, value: float, question: Question, new: bool) -> None:
        if not new:
            return
        bits = hashlib.blake2b(digest_size=16)
        for array in (atoms.positions, atoms.numbers, atoms.cell.array, atoms.pbc):
            bits.update(np.ascontiguousarray(array).tobytes())
            bits.update(b"|")
        key = bits.digest(), what
        before, asked = self._known.setdefault(key, (value, question))
        if asked == question:
            return
        self.new.times += 1
        if value != before:
            self.new.differ += 1
            size = abs(value - before)
            if what == "energy":
                self.new.energy = max(self.new.energy, size)
            else:
                self.new.force = max(self.new.force, size)
