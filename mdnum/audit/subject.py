"""Wrapper of an ASE calculator that returns up-to-date results or raises an error."""

from __future__ import annotations

import copy
import hashlib
import itertools
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import CalculatorError, Meter, Observed, finding
from mdnum.store.files import write_text
from mdnum.systems.structures import to_extxyz
from mdnum.units import METAL, Units

_MOST_SAVED = 20  # a calculator that fails is asked hundreds of times; this many structures are kept
_ROOM_TEMPERATURE = 300 * METAL.k_B  # eV
#: Tolerances relative to the root mean square force, to kT, and to the energy itself (which may be in single
#: precision): results of identical calls that differ by more do not differ by rounding.
_LARGE, _LARGE_ENERGY, _LARGE_SHARE = 1e-4, 1e-3, 1e-6
_MOST_AGAIN = 100  # answers that stick out are asked for again, in one audit no more often than this
_PLAIN = (str, int, float, list, tuple, dict, np.ndarray)  # info with the same repr in a copy

_objects = itertools.count()
Forces = Float[np.ndarray, "atoms 3"]
EnergyForces = tuple[float, Forces | None]  # energy, eV, and forces, eV/Å; None where they were not asked for
Answered = tuple[float, Forces] | CalculatorError  # energy and forces, or why there are none


@dataclass
class RepeatCounts:
    """Statistics of repeated evaluations of structures that are identical to the last bit."""

    times: int = 0  # answers that could be compared with an earlier one
    differ: int = 0  # of them, those that are not the same to the last bit
    energy: float = 0.0  # the largest difference, eV
    # the largest difference of all forces together (a norm, estimated from one projection), eV/Å
    force: float = 0.0
    typical: float = 0.0  # root mean square force where forces were compared last, eV/Å


class Repeats:
    """Energies and forces of evaluated structures, to compare repeated evaluations.

    Attributes:
        new: statistics of the first results of new calculator objects, which remember no other structure.
        chance: statistics of suspicious results that were recomputed with the same object: the number that
            differ by more than rounding, and the largest difference of a force component.
    """

    def __init__(self):
        self.new, self.chance = RepeatCounts(), RepeatCounts()
        self._known: dict[tuple[bytes, str], tuple[float, int]] = {}

    def compare(self, atoms: Atoms, which: int, what: Literal["energy", "force"], value: float) -> None:
        """Compare the result of a calculator object with that of an earlier object."""
        before, first = self._known.setdefault((_question(atoms), what), (value, which))
        self.new.times += first != which
        if first != which and value != before:
            self.new.differ += 1
            setattr(self.new, what, max(abs(value - before), getattr(self.new, what)))

    def findings(self, kT: float) -> list[Observed]:
        """Return a finding if repeated evaluations differ by more than rounding errors."""
        for seen, who in ((self.chance, "same"), (self.new, "new")):
            if seen.differ:
                told = not_repeatable(
                    f"{who}_object", seen.energy, seen.force, seen.typical, kT,
                    differ=seen.differ, times=seen.times,
                )  # fmt: skip
                # what differs in a last bit is told where repeats are the question
                return [told] if told.severity == "error" else []
        return []


def no_rounding(change: float, force: float, answer: EnergyForces, kT: float) -> bool:
    """Return whether a change of energy (eV) or force (eV/Å) exceeds rounding errors."""
    energy, forces = answer
    return change > max(_LARGE_ENERGY * kT, _LARGE_SHARE * abs(energy)) or (
        forces is not None and force > _LARGE * rms(forces)
    )


def differences(one: EnergyForces, other: EnergyForces) -> tuple[float, float]:
    """Return the difference of two energies, and the largest difference of force components (0 if none)."""
    forces = None if one[1] is None or other[1] is None else other[1] - one[1]
    return abs(other[0] - one[0]), 0.0 if forces is None else largest(forces)


def not_repeatable(
    how: str, energy: float, force: float, typical: float, kT: float, **values: Any
) -> Observed:
    """Report that two evaluations of one structure differ. Rounding differences are only a warning.

    Args:
        how: how the difference was discovered, as the name of a text variant.
        energy, force: differences of the evaluations, eV and eV/Å; typical: root mean square force, eV/Å.
    """
    values |= {"energy": energy, "force": force, "typical": typical}
    if force > _LARGE * typical or energy > _LARGE_ENERGY * kT:
        return finding("NOT_REPEATABLE", "error", how, tests=("repeat",), **values)
    return finding("NOT_BIT_IDENTICAL", "warning", how, **values)


@dataclass(frozen=True)
class LoadedCalculator:
    """A calculator that was loaded by its name."""

    name: str  # what the person wrote
    stem: str  # a short word for a folder's name
    make: Callable[[], Any]  # makes a calculator object that remembers nothing of another
    atoms: Atoms | None = None  # the structure that comes with it (a system of mdnum has one), or None
    kT: float | None = None  # energy of its temperature where it has one, eV; None otherwise
    # of its lengths and energies: those of ASE, or reduced ones for some systems of mdnum
    units: Units = METAL


class CalculatorSubject:
    """An ASE calculator and the structure for which it is audited.

    ASE returns its cached energy after moves below 1e-15 Å. CalculatorSubject clears the cache after any
    change of the structure. If the input did not change, cached results are used. The method `forget` forces
    a new calculation. The calculator is attached to the atoms, as in a run. A `CalculatorError` is raised if
    the calculator fails or returns nan. The structure is then saved.

    Args:
        name: the calculator as the user named it.
        make: creates a calculator object without any memory.
        atoms: the structure; its constraints are removed, since constraints change forces but not energies.
        kT: thermal energy with which energy jumps are compared, eV; 300 K by default.
        folder: folder for saving structures on which the calculator fails; a new temporary folder if None.
        units: units of length and energy; "eV" and "Å" below are ε and σ for a calculator in reduced units.

    Attributes:
        known: results about the calculator and its structure that all checks and objects share.
        repeats: comparison of repeated evaluations by all objects.
        meter: counts the calls of all objects of the calculator.
        forgets: whether the cache is cleared if a bit has changed and the calculator detects no change.
        renews: whether a new object is created after an exception, since some become unusable afterwards.
        copies: whether a copy of the atoms is evaluated instead of the given object.
        saving: whether structures on which the calculator fails are saved.
    """

    def __init__(
        self,
        name: str,
        make: Callable[[], Any],
        atoms: Atoms,
        *,
        kT: float = _ROOM_TEMPERATURE,
        folder: str | Path | None = None,
        units: Units = METAL,
    ):
        self.name, self.atoms, self.kT, self.units = name, _bare(atoms), kT, units
        self.folder = None if folder is None else Path(folder)
        self.known: dict[Any, Any] = {}
        self.repeats, self.meter = Repeats(), Meter()
        self.forgets = self.renews = self.saving = self.copies = True
        self._make = make
        self._calculator: Any = None
        self._last: bytes | None = None
        self._saved = 0
        # which object it is, and how many structures it has been asked about
        self._object, self._seen = 0, 0

    @property
    def calculator(self) -> Any:
        """The current calculator object; it is created at first use."""
        if self._calculator is None:
            self._calculator = self._make()
            self._object, self._seen = next(_objects), 0
        return self._calculator

    def fresh(self) -> CalculatorSubject:
        """Return a copy of the subject with a new calculator object."""
        other = copy.copy(self)
        other.forgets = other.renews = other.copies = True
        other._calculator = other._last = None
        return other

    def used(self) -> CalculatorSubject:
        """Return a copy of the subject that does not clear the calculator's cache."""
        other = self.fresh()
        other.forgets = other.renews = False
        return other

    def forget(self) -> None:
        """Clear the calculator's cache, so that the next evaluation is a new calculation."""
        reset = getattr(self.calculator, "reset", None)
        if callable(reset):
            reset()
        elif isinstance(getattr(self.calculator, "results", None), dict):
            self.calculator.results = {}
        self._last = None
        self._seen += 1

    def energy(self, atoms: Atoms) -> float:
        """Return the potential energy (eV) that is consistent with the forces."""
        return self.energies(atoms)[0]

    def energies(self, atoms: Atoms) -> tuple[float, float | None]:
        """Return (energy consistent with the forces, energy written to the log), eV.

        In ASE, the energies are `free_energy` and `energy`. The logged energy is None if only one energy
        exists.
        """
        asked = self._ask(atoms)
        both = self._answer(lambda: self._energies(asked), asked, "energy")
        energy, other = (value if value is None else self._number(value, asked) for value in both)
        assert energy is not None
        if self._seen == 1:
            self.repeats.compare(asked, self._object, "energy", energy)
        return energy, other

    def forces(self, atoms: Atoms) -> Forces:
        """Return the forces (eV/Å). Raise an error if the shape of the array is wrong."""
        asked = self._ask(atoms)
        forces = np.array(self._answer(asked.get_forces, asked, "forces"), dtype=np.float64)
        if forces.shape != (len(asked), 3):
            raise self._failed(asked, f"gave forces of shape {forces.shape} for {len(asked)} atoms")
        bad = ~np.isfinite(forces).all(axis=1)
        if bad.any():
            first = int(np.argmax(bad))
            raise self._failed(
                asked, f"gave a force of {forces[first].tolist()} on atom {first} ({asked.symbols[first]})"
            )
        if self._seen == 1:
            self.repeats.new.typical = rms(forces)
            along = float(np.sum(_projection(forces.size) * forces.ravel()))
            self.repeats.compare(asked, self._object, "force", along)
        return forces

    def both(self, atoms: Atoms) -> tuple[float, Forces]:
        """Return energy (eV) and forces (eV/Å) of a structure."""
        return self.energy(atoms), self.forces(atoms)

    def try_both(self, atoms: Atoms) -> Answered:
        """Return energy and forces, or the calculator's error. In either case, no structure is saved."""
        try:
            with self.trying():
                return self.both(atoms)
        except CalculatorError as error:
            return error

    def answers(self, atoms: Atoms) -> bool:
        """Return whether the calculator returns energy and forces for a structure."""
        return not isinstance(self.try_both(atoms), CalculatorError)

    @contextmanager
    def trying(self) -> Iterator[None]:
        """Within the `with` block, do not save structures on which the calculator fails."""
        before, self.saving = self.saving, False
        try:
            yield
        finally:
            self.saving = before

    def again(self, atoms: Atoms, energy: float | None = None, forces: Forces | None = None) -> bool:
        """Evaluate a structure again, and count any difference in `repeats`.

        A difference is random only if the second result agrees with a new calculator object. If the results
        of the two objects differ, earlier evaluations may be the reason.

        Args:
            energy: the earlier energy, eV; the energy or the forces are required.
            forces: the earlier forces, eV/Å.

        Returns:
            Whether the two results differ randomly by more than rounding.
        """
        chance = self.repeats.chance
        if chance.times >= _MOST_AGAIN or chance.differ:
            return False  # few are asked again, and one is enough
        self.forget()
        now = self.energy(atoms), None if forces is None else self.forces(atoms)
        before = now[0] if energy is None else energy, forces
        chance.times += 1
        if not no_rounding(*differences(before, now), before, self.kT):
            return False
        fresh = self.fresh()
        new = fresh.energy(atoms), None if forces is None else fresh.forces(atoms)
        if no_rounding(*differences(now, new), now, self.kT):
            return False
        change, force = differences(before, now)
        chance.differ += 1
        chance.energy, chance.force = max(chance.energy, change), max(chance.force, force)
        if now[1] is not None:
            chance.typical = rms(now[1])
        return True

    def _ask(self, atoms: Atoms) -> Atoms:
        asked = _bare(atoms) if self.copies else atoms
        now = _question(asked)
        same = now == self._last
        if not same:
            if self.forgets and self._nearly(asked):
                self.forget()
            self.meter.count()
        calculator = self.calculator
        self._seen += not same or self._seen == 0
        self._last = now
        self._answer(lambda: setattr(asked, "calc", calculator), asked, "an answer")
        return asked

    def _nearly(self, atoms: Atoms) -> bool:
        """Return whether ASE ignores a small change of a structure."""
        check = getattr(self.calculator, "check_state", None)
        if not callable(check):
            return False
        try:
            return not check(atoms)
        except Exception:  # a calculator's own test for changes; what it cannot answer is a change
            return False

    def _energies(self, atoms: Atoms) -> tuple[Any, Any]:
        if "free_energy" not in (getattr(self.calculator, "implemented_properties", None) or ()):
            return atoms.get_potential_energy(), None
        from ase.calculators.calculator import PropertyNotImplementedError

        try:
            consistent = atoms.get_potential_energy(force_consistent=True)
        except (PropertyNotImplementedError, TypeError):  # named, and then not given
            return atoms.get_potential_energy(), None
        try:
            return consistent, atoms.get_potential_energy()
        except PropertyNotImplementedError:
            return consistent, None

    def _number(self, value: Any, atoms: Atoms) -> float:
        try:
            energy = float(np.asarray(value, dtype=np.float64).reshape(()))
        except (TypeError, ValueError):
            raise self._failed(atoms, f"gave {value!r} as an energy, not one number") from None
        if not np.isfinite(energy):
            raise self._failed(atoms, f"gave an energy of {energy}")
        return energy

    def _answer(self, question: Callable[[], Any], atoms: Atoms, what: str) -> Any:
        try:
            # a calculator that divides by zero shows it in its answer, which is checked
            with np.errstate(all="ignore"):
                return question()
        except Exception as error:  # whatever a calculator raises means the same here
            self._last = None
            if self.renews:
                self._calculator = None
            detail = " ".join(str(error).split())[:300] or "no more detail"
            raise self._failed(
                atoms, f"raised {type(error).__name__} when asked for {what}: {detail}", error
            ) from error

    def _failed(self, atoms: Atoms, message: str, cause: BaseException | None = None) -> CalculatorError:
        saved = self._save(atoms)
        return CalculatorError(
            f"{message} ({len(atoms)} atoms, {atoms.get_chemical_formula()})",
            remedy=f"The structure is in {saved}" if saved else None,
            where=self.name,
            structure=saved,
            cause=cause,
        )

    def _save(self, atoms: Atoms) -> Path | None:
        if not self.saving or self._saved >= _MOST_SAVED:
            return None
        if self.folder is None:
            self.folder = Path(tempfile.mkdtemp(prefix="mdnum-audit-"))
        self.folder.mkdir(parents=True, exist_ok=True)
        self._saved += 1
        while (path := self.folder / f"failed-{self._saved}.extxyz").exists():
            self._saved += 1
        write_text(path, exact_extxyz(atoms))
        return path


def exact_extxyz(atoms: Atoms) -> str:
    """Return a structure as unrounded text: symbols, positions, initial charges and magnetic moments."""
    return to_extxyz(atoms, ("initial_charges", "initial_magmoms"))


@cache
def _projection(size: int) -> np.ndarray:
    return np.random.default_rng(size).standard_normal(size)


def largest(values: np.ndarray) -> float:
    """Return the largest absolute value in an array; 0 for an empty array."""
    return float(np.max(np.abs(values), initial=0.0))


def rms(forces: np.ndarray) -> float:
    """Root mean square of the force components."""
    return float(np.sqrt(np.mean(forces**2))) if forces.size else 0.0


def bits(atoms: Atoms) -> tuple[np.ndarray, ...]:
    """Return independent copies of a structure's positions, atomic numbers, cell and periodicity."""
    return atoms.positions.copy(), atoms.numbers.copy(), np.array(atoms.cell), atoms.pbc.copy()


def _question(atoms: Atoms) -> bytes:
    """Return a hash of the calculator's input: structure, charges, tags and info."""
    parts = {**atoms.arrays, "cell": np.asarray(atoms.cell), "pbc": atoms.pbc}
    info = {key: value for key, value in atoms.info.items() if isinstance(value, _PLAIN)}
    text = b"|".join(name.encode() + parts[name].tobytes() for name in sorted(parts))
    return hashlib.blake2b(text + repr(info).encode(), digest_size=16).digest()


def _bare(atoms: Atoms) -> Atoms:
    """Return a copy of a structure in float64 without calculator and constraints."""
    copy = atoms.copy()
    copy.calc = None
    copy.set_constraint()
    return copy
