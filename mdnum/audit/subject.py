"""An ASE calculator as the checks see it: numbers or a clear error, never an answer from a cache."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import Meter
from mdnum.audit.ledger import Ledger, differ
from mdnum.errors import MdnumError
from mdnum.store.atomic import write_text
from mdnum.units import METAL, Units

#: A calculator that fails is asked hundreds of times; this many structures are kept.
_MOST_SAVED = 20

_objects = itertools.count()

_ROOM_TEMPERATURE = 0.025852
"""k_B times 300 K, eV."""


class CalculatorError(MdnumError):
    """The calculator raised, or answered with a number that is not finite.

    Args:
        structure: the file that holds what it was asked about; None where enough have been saved.
        cause: what it raised, None where it answered.
    """

    def __init__(
        self,
        message: str,
        *,
        remedy: str | None = None,
        where: str | None = None,
        structure: Path | None = None,
        cause: BaseException | None = None,
    ):
        super().__init__(message, remedy=remedy, where=where)
        self.structure = structure
        self.cause = cause


class CalculatorSubject:
    """A calculator and the structure it is asked about.

    ASE answers from its cache where no coordinate moved by more than 1e-15 Å, which is several
    representable distances near an atom at the origin: where the bits differ, the cache is dropped first.
    Bits that do not differ are answered from the cache, so that energy and forces cost one calculation;
    `forget` makes the next question a calculation. The calculator is attached to the atoms that it is asked
    about, as in a run: some answer in no other way.

    Args:
        name: what the person called it.
        make: makes a calculator object that remembers nothing.
        atoms: the structure; constraints are left out, since they change forces and not energies.
        kT: energy that a jump is compared with, eV; that of 300 K.
        folder: where structures are saved on which the calculator fails; a new temporary one if None.
        units: what lengths and energies are in; "eV" and "Å" below are ε and σ for a calculator in reduced
            units.
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
        self.units = units
        #: What checks have worked out about the calculator and its structure; new objects know it too.
        self.known: dict[Any, Any] = {}
        #: What was answered to each question, by all objects of this audit.
        self.ledger = Ledger()
        #: Drop what a calculator's own test for changes calls unchanged, where a bit has changed.
        self.forgets = True
        self.name = name
        self.atoms = _bare(atoms)
        self.kT = kT
        self.folder = None if folder is None else Path(folder)
        #: Counts the calls of all objects of the calculator.
        self.meter = Meter()
        self.saving = True
        #: Make a new object after one that raised: some are of no use afterwards.
        self.renews = True
        self._make = make
        self._calculator: Any = None
        self._last: tuple[np.ndarray, ...] | None = None
        self._saved = 0
        #: Which object it is, and how many structures it has been asked about.
        self._object, self._seen = 0, 0

    @property
    def calculator(self) -> Any:
        """The calculator object, made when first used."""
        if self._calculator is None:
            self._calculator = self._make()
            self._object, self._seen = next(_objects), 0
        return self._calculator

    def fresh(self) -> CalculatorSubject:
        """The same with a calculator object of its own, which remembers nothing."""
        other = CalculatorSubject(
            self.name, self._make, self.atoms, kT=self.kT, folder=self.folder, units=self.units
        )
        other._saved, other.saving, other.known = self._saved, self.saving, self.known
        other.meter, other.ledger = self.meter, self.ledger
        return other

    def about(self, atoms: Atoms) -> CalculatorSubject:
        """The same calculator object asked about another structure."""
        other = self.fresh()
        other.atoms, other._calculator, other._last = _bare(atoms), self.calculator, self._last
        other.known, other._object, other._seen = {}, self._object, self._seen
        return other

    def forget(self) -> None:
        """Make the next question a calculation, whatever ASE has kept."""
        reset = getattr(self.calculator, "reset", None)
        if callable(reset):
            reset()
        elif isinstance(getattr(self.calculator, "results", None), dict):
            self.calculator.results = {}
        self._last = None
        self._seen += 1

    def energy(self, atoms: Atoms) -> float:
        """Potential energy in eV: the one the forces belong to where the calculator knows two.

        Raises:
            CalculatorError: the calculator raised, or answered with nan; the structure has been saved.
        """
        return self.energies(atoms)[0]

    def energies(self, atoms: Atoms) -> tuple[float, float | None]:
        """(the energy that forces belong to, the one that a run is told), eV.

        ASE calls the first `free_energy` and the second `energy`; None where the calculator knows one alone.

        Raises:
            CalculatorError: as for `energy`.
        """
        asked = self._ask(atoms)
        both = self._answer(lambda: self._energies(asked), asked, "energy")
        energy, told = (value if value is None else self._number(value, asked) for value in both)
        assert energy is not None
        self.ledger.energy(asked, energy, told, *self._asked_as())
        return energy, told

    def _asked_as(self) -> tuple[tuple[int, int], bool]:
        """(what tells this question from others, whether it is the first that this object was asked)."""
        return (self._object, self._seen), self._seen == 1

    def _number(self, value: Any, atoms: Atoms) -> float:
        try:
            energy = float(np.asarray(value, dtype=np.float64).reshape(()))
        except (TypeError, ValueError):
            raise self._failed(atoms, f"gave {value!r} as an energy, not one number") from None
        if not np.isfinite(energy):
            raise self._failed(atoms, f"gave an energy of {energy}")
        return energy

    def forces(self, atoms: Atoms) -> Float[np.ndarray, "atoms 3"]:
        """Forces in eV/Å.

        Raises:
            CalculatorError: as for `energy`, or forces of another shape than the positions.
        """
        asked = self._ask(atoms)
        value = self._answer(lambda: asked.get_forces(), asked, "forces")
        forces = np.array(value, dtype=np.float64)
        if forces.shape != (len(asked), 3):
            raise self._failed(asked, f"gave forces of shape {forces.shape} for {len(asked)} atoms")
        bad = ~np.isfinite(forces).all(axis=1)
        if bad.any():
            first = int(np.argmax(bad))
            raise self._failed(
                asked, f"gave a force of {forces[first].tolist()} on atom {first} ({asked.symbols[first]})"
            )
        self.ledger.forces(asked, forces, *self._asked_as())
        return forces

    def again(
        self, atoms: Atoms, energy: float | None = None, forces: Float[np.ndarray, "atoms 3"] | None = None
    ) -> bool:
        """Asks this object a question that it has answered, of which the ledger takes note.

        Only an answer that stands alone is one of chance: where the object that is asked again answers
        otherwise than a new one does, what it has seen since may be why.

        Args:
            atoms: as they were asked about.
            energy: that was answered, eV; at least one of both.
            forces: that were answered, eV/Å.

        Returns:
            Whether the answer is another one by more than rounding.

        Raises:
            CalculatorError: as for `energy`.
        """
        if not self.ledger.asks_again:
            return False
        self.forget()
        told = self.energy(atoms), None if forces is None else self.forces(atoms)
        before = told[0] if energy is None else energy, forces
        self.ledger.chance.times += 1
        if not differ(before, told, self.kT):
            return False
        new = self.fresh()
        if differ(told, (new.energy(atoms), None if forces is None else new.forces(atoms)), self.kT):
            return False
        self.ledger.note(before, told)
        return True

    def writes(self, atoms: Atoms) -> list[str]:
        """Which of positions, numbers, cell and periods differ in the atoms after the calculator had them.

        Raises:
            CalculatorError: as for `energy`.
        """
        self.forget()
        asked = self._ask(atoms)
        self._answer(lambda: self._energies(asked), asked, "energy")
        self._answer(lambda: asked.get_forces(), asked, "forces")
        words = ("positions", "numbers", "cell", "periods")
        return [
            word
            for word, before, after in zip(words, _bits(atoms), _bits(asked), strict=True)
            if before.tobytes() != after.tobytes()
        ]

    def _ask(self, atoms: Atoms) -> Atoms:
        asked = _bare(atoms)
        bits = _bits(asked)
        same = self._last is not None and all(
            a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in zip(bits, self._last, strict=True)
        )
        if not same:
            if self.forgets and self._nearly(asked):
                self.forget()
            self.meter.count()
        calculator = self.calculator
        self._seen += not same or self._seen == 0
        self._last = bits
        self._answer(lambda: setattr(asked, "calc", calculator), asked, "an answer")
        return asked

    def _nearly(self, atoms: Atoms) -> bool:
        """Whether ASE would take these atoms for the ones before, although a bit differs."""
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

    def _answer(self, question: Callable[[], Any], atoms: Atoms, what: str) -> Any:
        try:
            # a calculator that divides by zero has said so in its answer, which is looked at
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


@contextmanager
def only_trying(subject: object) -> Iterator[None]:
    """Failures are expected here (does it take two atoms without a cell?): no structure is saved."""
    before = getattr(subject, "saving", None)
    if before is None:  # another implementation, which may save as it likes
        yield
        return
    subject.saving = False  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        subject.saving = before  # pyright: ignore[reportAttributeAccessIssue]


def exact_extxyz(atoms: Atoms) -> str:
    """A structure as extended XYZ without losing a bit (ASE's own writer keeps eight decimals).

    Args:
        atoms: any; of its arrays, symbols, positions, initial charges and initial magnetic moments are kept.
    """
    columns, rows = ["species:S:1", "pos:R:3"], [[symbol] for symbol in atoms.get_chemical_symbols()]
    for row, position in zip(rows, atoms.positions, strict=True):
        row.extend(repr(float(x)) for x in position)
    for name in ("initial_charges", "initial_magmoms"):
        values = atoms.arrays.get(name)
        if values is not None:
            flat = np.asarray(values, dtype=np.float64).reshape(len(atoms), -1)
            columns.append(f"{name}:R:{flat.shape[1]}")
            for row, more in zip(rows, flat, strict=True):
                row.extend(repr(float(x)) for x in more)
    lattice = " ".join(repr(float(x)) for x in np.asarray(atoms.cell).ravel())
    periodic = " ".join("T" if yes else "F" for yes in atoms.pbc)
    cell = f'Lattice="{lattice}" ' if np.asarray(atoms.cell).any() else ""
    head = f'{cell}Properties={":".join(columns)} pbc="{periodic}"'
    return "\n".join([str(len(atoms)), head, *(" ".join(row) for row in rows)]) + "\n"


def _bits(atoms: Atoms) -> tuple[np.ndarray, ...]:
    return atoms.positions.copy(), atoms.numbers.copy(), np.array(atoms.cell), atoms.pbc.copy()


def _bare(atoms: Atoms) -> Atoms:
    """A copy with no calculator and no constraints, in float64."""
    copy = atoms.copy()
    copy.calc = None
    copy.set_constraint()
    return copy
