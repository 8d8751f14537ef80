"""Check that results do not depend on previously evaluated structures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.base import AuditCheck, CalculatorError, CheckResult, Observed, Progress, Ways, finding
from mdnum.audit.noise import NoiseFloor, digits, displaced, settled
from mdnum.audit.sequences import SequenceStep, all_sequences, approaches
from mdnum.audit.structures import modified, pairs
from mdnum.audit.subject import Answered, CalculatorSubject, differences, largest, not_repeatable, rms
from mdnum.audit.thresholds import find_thresholds
from mdnum.units import ENERGY, FORCE, Measured

#: Number of repeated calls for one structure: by one object in succession, by it with another structure
#: between, and by new objects.
_AT_ONCE, _BETWEEN, _NEW = 4, 2, 3
_TINY = 10.0 ** np.arange(-9, -1)  # Å by which an atom is moved a little further each time
_KEPT = 100.0  # an answer that should have changed by so many of its last digits, and did not, was kept
_HARMLESS = 1e-7  # Å: what is kept within less is a matter of precision
_EPS = np.finfo(float).eps


class StateCheck(AuditCheck):
    """Do energy and forces depend on previously evaluated structures?

    The check compares used and new calculator objects for growing, shrinking, moving and strained structures.
    """

    name, title, order, basic, calls = "state", "Memory", 60, True, 500
    needed_to = ("run",)

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """Compare one calculator object for all structures with one object per structure."""
        rng = np.random.default_rng(self.seed)
        with subject.meter.limited():
            atoms, noise = settled(subject.fresh(), rng, brief=self.brief)
            if self.brief:
                return self._brief(subject, atoms, rng)
        # two atoms first, which most calculators answer for quickly
        approached, ways = _approached(subject)
        sequences = approached | all_sequences(atoms, rng)
        rows: list[Comparison] = []

        def asked(name: str) -> None:
            for row in _through(subject, sequences[name], noise, name):
                rows.append(row)

        def unanswered(name: str) -> str:
            left = sum(one.compared for one in sequences[name]) - sum(row.sequence == name for row in rows)
            return f"{left} questions of the sequence “{name}”"

        ways.each(subject, [*sequences], unanswered, asked, progress, self.name, unit="sequences")
        if not rows and (up := subject.meter.up):
            raise up
        repeats = _repeated(subject, atoms)
        tolerance, grain = _tolerance(subject, atoms), _grain(atoms)
        severity = "error" if tolerance > max(_HARMLESS, grain) else "warning"
        kept = [finding("KEPT_ANSWER", severity, tolerance=tolerance, grain=grain)] if tolerance else []
        stale = [row for row in rows if row.remembers and not row.broken]
        worst = max(stale, key=lambda row: row.energy, default=None)
        chance: dict[str, Any] = {"answers": 0}
        if worst and not _again(subject, sequences[worst.sequence], noise, worst):
            # another object on the same way does not go astray: it is chance, and no memory
            chance = {"answers": len(stale), "energy": worst.energy, "force": worst.force}
            stale = []
        finite = [row.energy for row in stale if np.isfinite(row.energy)]
        says = "none" if not worst else "chance" if not stale else "stale" if finite else "failing"
        values: dict[str, Any] = {
            "rows": len(rows), "stale": len(stale), "sequences": len({row.sequence for row in rows}),
            "answers": chance["answers"], "energy": max(finite, default=chance.get("energy", 0.0)),
            "least": Measured(min(row.allowed for row in rows), "energy") if rows else None,
            "most": Measured(max(row.allowed for row in rows), "energy") if rows else None,
        }  # fmt: skip
        numbers = {
            "structures": len(rows), "remembered": len(stale), "bit_identical": repeats["bit-identical"],
            "largest": max((row.energy for row in rows), default=0.0),
            "bit_identical_objects": repeats["bit-identical between objects"], "kept_within": tolerance,
        }  # fmt: skip
        return CheckResult(
            says=([f"state_{says}", _how(repeats)], values),
            findings=[
                *_unsteady(repeats, chance, subject.kT),
                *self._memory(stale),
                *kept,
                *self._failures(rows),
            ],
            tables={
                "One object, asked again and again, beside new ones": [row.row() for row in rows],
                "The same question again": [repeats],
            },
            numbers=numbers,
            limits={"remembered": (0, ("STALE_STATE",)), "kept_within": (0, ("KEPT_ANSWER",))},
            skipped=[
                *ways.skipped,
                *((row.what, row.why) for row in rows if row.refused and not row.remembers),
            ],
            asked=len(rows),
            possible=sum(one.compared for sequence in sequences.values() for one in sequence),
        )

    def _brief(self, subject: CalculatorSubject, atoms: Atoms, rng: np.random.Generator) -> CheckResult:
        """Run only the test that evaluates one structure repeatedly."""
        repeats = _repeated(subject, atoms, brief=True)
        return CheckResult(
            says=([_how(repeats)], {}),
            findings=list(_unsteady(repeats, {"answers": 0}, subject.kT)),
            tables={"The same question again": [repeats]},
            possible=1 + sum(map(len, all_sequences(atoms, rng).values())),
        )

    def _memory(self, stale: list[Comparison]) -> Iterator[Observed]:
        if stale:
            worst = max(stale, key=lambda row: row.energy)
            self.structures |= {"stale-before": worst.before, "stale-after": worst.atoms}
            yield finding(
                "STALE_STATE", "error", "refused" if worst.refused else None, step=worst.what,
                energy=Measured(worst.energy, "energy", worst.allowed), force=worst.force, why=worst.why,
                questions=len(stale), sequences=", ".join(sorted({row.sequence for row in stale})),
                tests=("repeat", "fresh"),
            )  # fmt: skip

    def _failures(self, rows: list[Comparison]) -> Iterator[Observed]:
        if row := next((row for row in rows if row.remembers and row.broken), None):
            yield finding("BROKEN_BY_FAILURE", "info", step=row.what, why=row.why)
        empty = (row for row in rows if row.refused and not row.remembers and row.refused.cause is None)
        if row := next(empty, None):
            self.structures["not-finite"] = row.atoms
            yield finding("NOT_FINITE", "error", step=row.what, why=row.why)


@dataclass
class Comparison:
    """Energy and forces of one structure, from a used and a new calculator object."""

    sequence: str  # in which it was asked
    what: str  # happened to the structure
    before: Atoms  # what the object had been asked about before
    atoms: Atoms
    old: Answered
    new: Answered
    broken: bool  # whether it had failed then, and fails since
    # energy, force: by which the answers differ, eV and eV/Å; infinite where the object in use fails alone
    energy: float = 0.0
    force: float = 0.0
    allowed: float = 0.0  # of the energy, eV
    remembers: bool = False  # whether they differ by more than noise

    @property
    def refused(self) -> CalculatorError | None:
        """Error of the new calculator object, or else of the used object, or None."""
        return next((one for one in (self.new, self.old) if isinstance(one, CalculatorError)), None)

    @property
    def why(self) -> str:
        return self.refused.message if self.refused else ""

    def row(self) -> dict[str, Any]:
        return {
            "sequence": self.sequence, "what happened": self.what,
            f"energy differs by ({ENERGY})": self.energy,
            "allowed": self.allowed, f"forces differ by ({FORCE})": self.force, "same": not self.remembers,
        }  # fmt: skip


def _approached(subject: CalculatorSubject) -> tuple[dict[str, list[SequenceStep]], Ways]:
    """Return sequences in which two atoms come within the cutoff, or why no sequence exists."""
    what = "two atoms at the cutoff"
    try:
        thresholds = find_thresholds(subject)
        with subject.trying():
            found = pairs(subject)[0]
    except CalculatorError as error:
        return {}, Ways([(what, error.message)])
    radii = [one.radius for one in thresholds if found and set(one.species) == set(found[0].species)]
    if not radii:
        return {}, Ways([(what, "no cutoff was found")])
    return dict(approaches(found[0], max(radii))), Ways()


def _through(
    subject: CalculatorSubject, sequence: list[SequenceStep], noise: NoiseFloor, name: str
) -> Iterator[Comparison]:
    """Compare a sequence of results of one calculator object with those of new objects."""
    used = subject.used()
    before: Atoms | None = None
    known: dict[int, Answered] = {}
    size, failed = 0.0, False
    for asked in sequence:
        old = used.try_both(asked.atoms)
        was_broken, failed = failed, isinstance(old, CalculatorError)
        previous, before = before or asked.atoms, asked.atoms
        if not asked.compared:
            continue
        # structures come again within a sequence, which keeps them, so their ids are theirs
        if id(asked.atoms) not in known:
            known[id(asked.atoms)] = subject.fresh().try_both(asked.atoms)
        new = known[id(asked.atoms)]
        # broken by a structure that every object refuses, which is another thing than a memory
        failed = failed and (isinstance(new, CalculatorError) or was_broken)
        broken = was_broken and isinstance(old, CalculatorError)
        row = Comparison(name, asked.what, previous, asked.atoms, old, new, broken)
        if isinstance(new, CalculatorError):
            pass  # what nobody can answer says nothing about memory
        elif isinstance(old, CalculatorError):
            row.remembers, row.energy, row.force = True, np.inf, np.inf
        else:
            size = size or abs(new[0])
            # a larger energy has more noise than was measured
            share = max(1.0, abs(new[0]) / size) if size else 1.0
            row.energy, row.force = differences(old, new)
            row.allowed = noise.allowed.energy * share
            force = share * noise.louder(NoiseFloor(0.0, _EPS * max(1.0, largest(new[1])))).allowed.force
            row.remembers = row.energy > row.allowed or row.force > force
        yield row


def _again(
    subject: CalculatorSubject, sequence: list[SequenceStep], noise: NoiseFloor, worst: Comparison
) -> bool:
    """Return whether another calculator object reproduces the largest difference found in a sequence."""
    end = next(k for k, one in enumerate(sequence) if (one.what, one.atoms) == (worst.what, worst.atoms))
    way = [step._replace(compared=place == end) for place, step in enumerate(sequence[: end + 1])]
    (again,) = _through(subject, way, noise, worst.sequence)
    if worst.refused or again.refused:
        return isinstance(worst.old, CalculatorError) and isinstance(again.old, CalculatorError)
    # both must come again: what objects in use answer, and what new ones do
    answers: list[tuple[Any, Any]] = [(again.old, worst.old), (again.new, worst.new)]
    changes = [differences(*two) for two in answers]
    return all(force <= 0.5 * worst.force and energy <= 0.5 * worst.energy for energy, force in changes)


def _how(repeats: Mapping[str, Any]) -> str:
    """Return the name of the text about repeated calls of a calculator."""
    if not repeats["bit-identical"]:
        return "state_not_repeated"
    return "state_repeated" if repeats["bit-identical between objects"] else "state_not_between"


def _repeated(subject: CalculatorSubject, atoms: Atoms, brief: bool = False) -> dict[str, Any]:
    """Evaluate a structure repeatedly: by the same and by new calculators."""
    used = subject.fresh()
    aside = displaced(atoms, np.full((len(atoms), 3), 0.011))
    at_once, between, new = (2, 1, 2) if brief else (_AT_ONCE, _BETWEEN, _NEW)

    def asked(one: CalculatorSubject) -> tuple[np.ndarray, np.ndarray]:
        # both energies, where there are two: a run logs the one that forces do not belong to
        return np.array([value for value in one.energies(atoms) if value is not None]), one.forces(atoms)

    within = []
    for number in range(at_once + between):
        within.append(asked(used))
        if number >= at_once:
            used.energy(aside)
        else:
            used.forget()
    objects = [within[0], *(asked(subject.fresh()) for _ in range(new - 1))]

    def spread(answers: list[tuple[np.ndarray, np.ndarray]]) -> tuple[bool, float, float]:
        (energies, forces), *others = answers
        same = all(
            one[0].tobytes() == energies.tobytes() and one[1].tobytes() == forces.tobytes() for one in others
        )
        energy, force = (np.max(np.ptp(values, axis=0), initial=0.0) for values in zip(*answers, strict=True))
        return same, float(energy), float(force)

    everywhere, one, several = subject.repeats.new, spread(within), spread(objects)
    return {
        "bit-identical": one[0],
        "energies scatter by": one[1],
        "forces scatter by": one[2],
        "bit-identical between objects": several[0] and not everywhere.differ,
        "energies between objects": max(several[1], everywhere.energy),
        "forces between objects": max(several[2], everywhere.force),
        "typical force": rms(within[0][1]),
    }


def _unsteady(repeats: Mapping[str, Any], chance: Mapping[str, Any], kT: float) -> Iterator[Observed]:
    within = not repeats["bit-identical"]
    if within or chance["answers"] or not repeats["bit-identical between objects"]:
        energy, force = (
            max(repeats[f"{what} scatter by"], repeats[f"{what} between objects"], chance.get(one, 0.0))
            for what, one in (("energies", "energy"), ("forces", "force"))
        )
        how = "chance" if chance["answers"] else "within" if within else "between"
        yield not_repeatable(how, energy, force, repeats["typical force"], kT, answers=chance["answers"])


def _tolerance(subject: CalculatorSubject, atoms: Atoms) -> float:
    """Return the longest move (Å) that leaves energy and forces unchanged, or 0.

    The move must be long enough to change several of the last digits. The expected changes are proportional
    to the length of the move.
    """
    # one coordinate, the largest: a tolerance may be one of all atoms together, or a share of a coordinate
    line = np.zeros((len(atoms), 3))
    line.flat[np.argmax(np.abs(atoms.positions))] = 1.0
    kept = _kept_within(subject, _TINY, lambda place: displaced(atoms, place * line))
    if not atoms.pbc.any():
        return kept
    edge = float(np.max(atoms.cell.lengths()))
    stretched = lambda place: modified(atoms, cell=(1 + place / edge) * atoms.cell.array)  # noqa: E731
    return max(kept, _kept_within(subject, _TINY[::2], stretched))


def _kept_within(subject: CalculatorSubject, sizes: np.ndarray, at: Callable[[float], Atoms]) -> float:
    """Return the longest move after which a calculator returns its previous result."""
    used = subject.fresh()
    used.forgets = False
    places = np.array([0.0, *np.cumsum(sizes)])
    answers = []
    for place in places:
        found = used.try_both(at(place))
        if isinstance(found, CalculatorError):
            return 0.0
        answers.append(np.append(found[1], found[0]))
    values = np.array(answers)
    rate = np.abs(values[-1] - values[0]) / places[-1]
    read = digits(values[:, :-1])
    # forces are the finer measure; the smallest of them may have lost its digits to others
    last = max(2.0**-read.bits * largest(values[0, :-1]), read.quantum)
    felt = float(np.max(rate[:-1], initial=0.0)) * sizes > _KEPT * last
    if read.bits <= 24:  # who answers in single precision may read positions so
        felt &= sizes > 4 * _grain(at(0.0))
    same = (values[1:] == values[:-1]).all(axis=1)
    return float(np.max(sizes[felt & same], initial=0.0))


def _grain(atoms: Atoms) -> float:
    """Return the spacing of single-precision numbers at the largest coordinate, Å."""
    return float(np.spacing(np.float32(np.max(np.abs(atoms.positions), initial=1.0))))
