"""What all objects of a calculator have answered: a question that comes again has the answer it had."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.references.findings import finding

#: Of two energies of one structure: differences of their difference that rounding explains, of doubles and of
#: numbers of single precision.
_ROUNDING, _ROUNDING_SINGLE = 1e-11, 1e-5

#: Of the root mean square force, of kT, and of the energy itself, which may be one of single precision:
#: answers to one question that differ by more are no rounding.
_LARGE, _LARGE_ENERGY, _LARGE_SHARE = 1e-4, 1e-3, 1e-6
#: Answers that stick out are asked for again, in one audit no more often than this.
_MOST_AGAIN = 100

#: (which object, its how manieth question).
Question = tuple[int, int]
#: Energy, eV, and forces, eV/Å; None where they were not asked for.
Told = tuple[float, Float[np.ndarray, "atoms 3"] | None]


@dataclass
class Again:
    """Questions that were asked more than once, to the last bit of the structure.

    Attributes:
        times: answers that could be compared with an earlier one.
        differ: of them, those that are not the same to the last bit.
        energy: the largest difference, eV.
        force: the largest difference of all forces together (a norm, estimated from one projection), eV/Å.
        typical: root mean square force where forces were compared last, eV/Å.
    """

    times: int = 0
    differ: int = 0
    energy: float = 0.0
    force: float = 0.0
    typical: float = 0.0


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
        chance: answers that stuck out, asked for again of the same object; of those that differ, the ones
            that rounding does not explain, and the largest difference of a force component.
        apart: the difference of two energies by composition.
    """

    def __init__(self):
        self.new, self.chance = Again(), Again()
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
        if new:
            self.new.typical = _typical(values)
        self._again(atoms, "forces", along, question, new)

    @property
    def asks_again(self) -> bool:
        """Whether one more answer that sticks out is to be asked for again: few are, and one is enough."""
        return self.chance.times < _MOST_AGAIN and not self.chance.differ

    def note(self, before: Told, now: Told) -> None:
        """Takes note of two answers of one object to one question, where the one before stood alone."""
        chance = self.chance
        chance.differ += 1
        chance.energy = max(chance.energy, abs(now[0] - before[0]))
        if before[1] is not None and now[1] is not None:
            chance.force = max(chance.force, float(np.max(np.abs(now[1] - before[1]), initial=0.0)))
            chance.typical = _typical(now[1])

    def findings(self, kT: float) -> list[dict[str, str]]:
        """That one question has two answers, where that has come up and is no rounding.

        Args:
            kT: energy that a difference is compared with, eV.
        """
        for seen, who in (
            (self.chance, "one object, which was asked again where an answer stuck out,"),
            (self.new, "new objects (each as its first question)"),
        ):
            if not seen.differ:
                continue
            forces = f" and forces by {seen.force:.2g} eV/Å, at a typical force of {seen.typical:.2g} eV/Å"
            told = not_repeatable(
                f"To {seen.differ} of {seen.times} questions {who} gave another answer than before: energies "
                f"differ by up to {seen.energy:.2g} eV{forces if seen.force else ''}.",
                seen.energy,
                seen.force,
                seen.typical,
                kT,
            )
            # what differs in a last bit is told where repeats are the question
            if told["severity"] == "error":
                return [told]
        return []

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


def differ(before: Told, now: Told, kT: float) -> bool:
    """Whether two answers to one question differ by more than any rounding.

    Args:
        before: energy and forces.
        now: the same of another answer.
        kT: energy that a difference is compared with, eV.
    """
    force = 0.0
    if before[1] is not None and now[1] is not None:
        force = float(np.max(np.abs(now[1] - before[1]), initial=0.0))
    return no_rounding(abs(now[0] - before[0]), before[0], force, before[1], kT)


def no_rounding(
    change: float, energy: float, force: float, forces: Float[np.ndarray, "..."] | None, kT: float
) -> bool:
    """Whether answers that ought to be one differ by more than any rounding.

    Args:
        change: of the energy, eV.
        energy: eV.
        force: change of a force component, eV/Å.
        forces: eV/Å; None where forces are not looked at.
        kT: eV.
    """
    return change > max(_LARGE_ENERGY * kT, _LARGE_SHARE * abs(energy)) or (
        forces is not None and force > _LARGE * _typical(forces)
    )


def not_repeatable(said: str, energy: float, force: float, typical: float, kT: float) -> dict[str, str]:
    """The finding that one question has two answers, an error where they differ by no rounding.

    Args:
        said: what was asked, and by how much answers differ.
        energy: of them, eV.
        force: of them, eV/Å.
        typical: root mean square force, eV/Å.
        kT: eV.
    """
    large = force > _LARGE * typical or energy > _LARGE_ENERGY * kT
    return finding(
        "NOT_REPEATABLE",
        "error" if large else "warning",
        "the same question has another answer each time"
        if large
        else "the same question has not the same answer to the last bit",
        said
        + (
            " That is no rounding: no other number here is worth more than this."
            if large
            else " Two runs of one input will part, as all that differ in a last bit do."
        ),
        "Look for memory that is read before it is written, for what is drawn at random, and for threads "
        "that write to one place."
        if large
        else "Look for sums in the order of threads or of atomic additions, and for a list kept from the "
        "call before.",
    )


def _typical(forces: Float[np.ndarray, "..."]) -> float:
    return float(np.sqrt(np.mean(forces**2))) if forces.size else 0.0
