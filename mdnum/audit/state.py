"""What a calculator object remembers: one question has one answer, whatever was asked before."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit import probes
from mdnum.audit.alone import alone
from mdnum.audit.answer import Answer, Refusal, ask
from mdnum.audit.approaches import Asked, approaches
from mdnum.audit.base import TIME_UP, Part, Progress, Subject, TimeUp, meter_of
from mdnum.audit.digits import digits
from mdnum.audit.ledger import Again, not_repeatable
from mdnum.audit.noise import FEW, Noise, displaced, settled
from mdnum.audit.subject import CalculatorError, CalculatorSubject, only_trying
from mdnum.audit.threshold import Threshold
from mdnum.audit.written import written
from mdnum.references.findings import finding

#: How many times the noise one object may differ from another by: a list that was built elsewhere sums its
#: terms in another order.
_ALLOWED = 40.0
#: How often one structure is asked about again: by one object at once, by it with another structure between,
#: and by new objects.
_AT_ONCE, _BETWEEN, _NEW = 4, 2, 3
#: Å by which an atom is moved a little further each time.
_TINY = 10.0 ** np.arange(-9, -1)
#: An answer that should have changed by so many of its last digits, and has not at all, was kept.
_KEPT = 100.0
#: Å: what is kept within less is a matter of precision.
_HARMLESS = 1e-7


@dataclass
class State:
    """Repeated calls, and one object through structures that grow, shrink, move and strain, beside new ones.

    Args:
        thresholds: finds the cutoff, at which two atoms are brought together; see
            `mdnum.audit.thresholds.find_thresholds`.
        seed: of structures.
    """

    thresholds: Callable[[Subject], Sequence[Threshold]] | None = None
    name: str = "state"
    seed: int = 0
    structures: dict[str, Atoms] = field(default_factory=dict)

    def __call__(self, subject: Subject, progress: Progress | None = None) -> Part:
        """Ask it; see `Check`."""
        began = time.perf_counter()
        rng = np.random.default_rng(self.seed)
        atoms, noise = settled(subject.fresh(), rng, at_least=FEW)
        # two atoms first, which most calculators answer for quickly
        sequences: dict[str, list[Asked]] = {}
        nothing = self._approached(subject, sequences)
        sequences |= {
            "sizes": list(sizes(atoms, rng)),
            "a slow drift": list(drift(atoms, rng)),
            "two atoms head on": list(head_on(atoms)),
            "strain": list(strain(atoms)),
            "wrapping": list(wrapping(atoms, rng)),
        }
        sequences = {word: sequence for word, sequence in sequences.items() if sequence}
        total = sum(map(len, sequences.values()))
        done, rows = 0, []
        late: list[tuple[str, str]] = []
        for word, sequence in sequences.items():
            through = _Through(subject, sequence, noise, word)
            compared = len(rows)
            try:
                with meter_of(subject).limited():
                    for row in through():
                        rows.append(row)
                        if progress is not None:
                            progress(done + through.reached, total, {"phase": "state", "unit": "structures"})
            except TimeUp:
                left = sum(one.compared for one in sequence) - (len(rows) - compared)
                late.append((f"{left} questions of the sequence “{word}”", TIME_UP))
            done += len(sequence)
        if late and not rows:
            raise TimeUp
        repeats = _repeated(subject, atoms)
        tolerance = _tolerance(subject, atoms)
        lonely = alone(subject, atoms, noise)
        self.structures |= lonely.structures
        broken = [row for row in rows if row["remembers"] and row["broken"]]
        stale = [row for row in rows if row["remembers"] and not row["broken"]]
        if stale and not _again(subject, sequences, stale):
            # another object on the same way does not go astray: it is chance, and no memory
            worst = max(stale, key=lambda row: row["energy"])
            repeats |= {"by chance": len(stale), "energies": worst["energy"], "forces": worst["force"]}
            stale = []
        refused = [row for row in rows if row["refused"] and not row["remembers"]]
        return Part(
            name=self.name,
            title="Memory",
            says=_says(rows, stale, repeats),
            findings=[
                *_unsteady(repeats, subject.kT),
                *self._stale(stale),
                *_kept(tolerance, atoms),
                *_broken(broken),
                *self._not_finite(refused),
                *written(subject, atoms),
                *lonely.findings(),
            ],
            tables={
                "One object, asked again and again, beside new ones": [_row(row) for row in rows],
                "The same question again": [repeats],
                "Atoms alone": lonely.rows,
            },
            numbers={
                "structures": len(rows),
                "remembered": len(stale),
                "largest": max((row["energy"] for row in rows), default=0.0),
                "bit_identical": repeats["bit-identical"],
                "bit_identical_objects": repeats["bit-identical between objects"],
                "kept_within": tolerance,
            },
            skipped=[
                *nothing,
                *late,
                *((row["structure"], row["refused"].why) for row in refused),
                *lonely.skipped,
            ],
            seconds=time.perf_counter() - began,
            asked=len(rows),
            possible=sum(one.compared for sequence in sequences.values() for one in sequence),
        )

    def _approached(self, subject: Subject, sequences: dict[str, list[Asked]]) -> list[tuple[str, str]]:
        """Adds sequences of two atoms at the cutoff; what could not be, and why."""
        what = "two atoms at the cutoff"
        if self.thresholds is None:
            return [(what, "no cutoff was looked for")]
        try:
            found = list(self.thresholds(subject))
            with only_trying(subject):
                pairs = probes.pairs(subject)[0]
        except CalculatorError as error:
            return [(what, error.message)]
        for pair in pairs[:1]:
            radii = [one.radius for one in found if set(one.species) == set(pair.species)]
            if radii:
                sequences |= dict(approaches(pair, max(radii)))
                return []
        return [(what, "no cutoff was found")]

    def _stale(self, stale: list[dict[str, Any]]) -> Iterator[dict[str, str]]:
        if not stale:
            return
        worst = max(stale, key=lambda row: row["energy"])
        self.structures |= {"stale-before": worst["before"], "stale-after": worst["atoms"]}
        where = sorted({row["sequence"] for row in stale})
        if worst["refused"] is None:
            differs = (
                f"differs from a new one by {worst['energy']:.3g} eV and {worst['force']:.3g} eV/Å, where "
                f"rounding explains {worst['allowed']:.1g} eV"
            )
        else:
            differs = f"{worst['refused'].why}, while a new one answers"
        yield finding(
            "STALE_STATE",
            "error",
            "the answer depends on what the calculator was asked before",
            f"After the step “{worst['structure']}”, an object that had been in use {differs}. "
            f"{len(stale)} questions were answered so ({', '.join(where)}). The structures before and after "
            "are saved as stale-before and stale-after.",
            "Look for a neighbor list that is not rebuilt when the cell, the order or the number of atoms "
            "changes "
            "or when atoms have used up half the skin, and for a buffer whose tail keeps old entries.",
        )

    def _not_finite(self, refused: list[dict[str, Any]]) -> Iterator[dict[str, str]]:
        empty = [row for row in refused if row["refused"].not_finite]
        if not empty:
            return
        self.structures["not-finite"] = empty[0]["atoms"]
        yield finding(
            "NOT_FINITE",
            "error",
            "an answer is not a number",
            f"After the step “{empty[0]['structure']}” a new object {empty[0]['refused'].why}. The "
            "structure is "
            "saved as not-finite.",
            "Look for a division by a distance or a number of neighbors that can be 0.",
        )


def _broken(broken: list[dict[str, Any]]) -> Iterator[dict[str, str]]:
    if broken:
        first = broken[0]
        yield finding(
            "BROKEN_BY_FAILURE",
            "info",
            "an object that has failed once goes on failing",
            f"After a structure that it refused, and the step “{first['structure']}”, it "
            f"{first['refused'].why}, while a new one answers.",
            "Make a new calculator after an error.",
        )


def sizes(atoms: Atoms, rng: np.random.Generator) -> Iterator[Asked]:
    """More atoms, fewer atoms, more and fewer neighbors, other species' places, other periodicity."""
    yield Asked("the structure", atoms)
    larger = atoms.repeat(np.where(atoms.pbc, 2, 1)) if len(atoms) <= 64 and atoms.pbc.any() else None
    if larger is not None:
        yield Asked("the structure grew to its supercell", larger)
        yield Asked("it shrank back", atoms)
    if len(atoms) > 2:
        yield Asked("its last third was removed", atoms[: max(1, 2 * len(atoms) // 3)])
        yield Asked("all but two atoms were removed", atoms[:2])
        yield Asked("all atoms came back", atoms)
    yield Asked("all distances grew by half: fewer neighbors", _scaled(atoms, 1.5))
    yield Asked("they shrank again: more neighbors", atoms)
    yield Asked("all distances shrank by 6 %: more neighbors", _scaled(atoms, 0.94))
    yield Asked("they grew again: fewer neighbors", atoms)
    if len(atoms) > 1:
        order = rng.permutation(len(atoms))
        yield Asked("the atoms came in another order", atoms[order])
        yield Asked("they came in the first order", atoms)
    if atoms.pbc.any():
        cluster = atoms.copy()
        cluster.pbc = False
        yield Asked("the periods were switched off", cluster)
        yield Asked("they were switched on", atoms)
    if len(set(atoms.numbers)) > 1:
        swapped = atoms.copy()
        swapped.numbers = np.roll(atoms.numbers, 1)
        yield Asked("the species changed places", swapped)
        yield Asked("they changed back", atoms)


def drift(atoms: Atoms, rng: np.random.Generator) -> Iterator[Asked]:
    """All atoms move a little each time, in directions of their own: what uses up a skin slowly."""
    there = atoms
    heading = rng.standard_normal((len(atoms), 3))
    heading /= np.linalg.norm(heading, axis=1)[:, None]
    yield Asked("the structure", there)
    for number in range(12):
        # there and back, so that atoms do not run into one another
        there = displaced(there, (0.04 if number < 6 else -0.04) * heading)
        yield Asked(f"all atoms moved by 0.04 Å, {number + 1} times", there)


def head_on(atoms: Atoms) -> Iterator[Asked]:
    """One atom, then two, move toward another in steps: what a criterion without its half does not see."""
    if len(atoms) < 2:
        return
    yield Asked("the structure", atoms)
    distances = atoms.get_distances(0, range(1, len(atoms)), mic=bool(atoms.pbc.any()), vector=True)
    other = 1 + int(np.argmax(np.linalg.norm(distances, axis=1)))
    line = distances[other - 1] / np.linalg.norm(distances[other - 1])
    for moving, word in (((0,), "one atom"), ((0, other), "two atoms")):
        there = atoms
        for number in range(5):
            step = np.zeros((len(atoms), 3))
            for who in moving:
                step[who] = (0.09 if who == 0 else -0.09) * line
            there = displaced(there, step)
            yield Asked(f"{word} moved by 0.09 Å toward another, {number + 1} times", there)
        yield Asked("the structure", atoms)


def strain(atoms: Atoms) -> Iterator[Asked]:
    """The cell changes with the atoms, and without them."""
    if not atoms.pbc.any():
        return
    yield Asked("the structure", atoms)
    for scaled, word in ((True, "cell and atoms"), (False, "the cell alone")):
        there = atoms
        for number in range(4):
            there = there.copy()
            there.set_cell(there.cell.array * 0.985, scale_atoms=scaled)
            yield Asked(f"{word} shrank by 1.5 %, {number + 1} times", there)
        yield Asked("the structure", atoms)
    sheared = atoms.copy()
    sheared.set_cell(atoms.cell.array @ np.array([[1, 0, 0], [0.05, 1, 0], [0, 0, 1]]), scale_atoms=True)
    yield Asked("cell and atoms were sheared by 5 %", sheared)
    yield Asked("the structure", atoms)


def wrapping(atoms: Atoms, rng: np.random.Generator) -> Iterator[Asked]:
    """Atoms jump to other images between calls, as codes that wrap positions make them."""
    if not atoms.pbc.any():
        return
    there = atoms
    yield Asked("the structure", there)
    for number in range(4):
        boxes = rng.integers(-1, 2, (len(atoms), 3)) * atoms.pbc
        there = displaced(there, boxes @ atoms.cell.array + 0.02 * rng.uniform(-1, 1, (len(atoms), 3)))
        yield Asked(f"atoms moved a little and were put into other boxes, {number + 1} times", there)
    folded = there.copy()
    folded.wrap(eps=0)
    yield Asked("all atoms were wrapped", folded)


def _scaled(atoms: Atoms, factor: float) -> Atoms:
    there = atoms.copy()
    there.set_cell(factor * atoms.cell.array)
    there.positions = factor * atoms.positions
    return there


class _Through:
    """One object through a sequence; answers beside those of objects that have seen nothing.

    Args:
        subject: where objects come from.
        sequence: what is asked.
        noise: of the calculator.
        word: the sequence's name.
    """

    def __init__(self, subject: Subject, sequence: list[Asked], noise: Noise, word: str):
        self._subject, self._sequence, self._noise, self._word = subject, sequence, noise, word
        #: How far it has come.
        self.reached = 0

    def __call__(self) -> Iterator[dict[str, Any]]:
        """A row for each answer that is compared."""
        used = self._subject.fresh()
        if isinstance(used, CalculatorSubject):
            # what an object does after it has failed, and what it takes for unchanged, are questions here
            used.renews = used.forgets = False
        before: Atoms | None = None
        known: dict[int, Answer | Refusal] = {}
        size, failed = 0.0, False
        for place, asked in enumerate(self._sequence):
            old = ask(used, asked.atoms)
            was_broken, failed = failed, isinstance(old, Refusal)
            previous, before = before or asked.atoms, asked.atoms
            self.reached = place + 1
            if not asked.compared:
                continue
            # structures come again within a sequence, which keeps them, so their ids are theirs
            if id(asked.atoms) not in known:
                known[id(asked.atoms)] = ask(self._subject.fresh(), asked.atoms)
            new = known[id(asked.atoms)]
            # broken by a structure that every object refuses, which is another thing than a memory
            failed = failed and (isinstance(new, Refusal) or was_broken)
            row: dict[str, Any] = {
                "sequence": self._word, "structure": asked.what, "before": previous, "atoms": asked.atoms,
                "energy": 0.0, "force": 0.0, "allowed": 0.0, "remembers": False, "refused": None,
                "old": old, "new": new,
                "broken": was_broken and isinstance(old, Refusal),
            }  # fmt: skip
            if isinstance(new, Refusal):
                # what nobody can answer says nothing about memory
                yield row | {"refused": new}
            elif isinstance(old, Refusal):
                yield row | {"remembers": True, "energy": float("inf"), "force": float("inf"), "refused": old}
            else:
                size = size or abs(new.energy)
                share = max(1.0, abs(new.energy) / size) if size else 1.0
                yield row | _apart(old, new, self._noise, share)


def _apart(old: Answer, new: Answer, noise: Noise, share: float) -> dict[str, Any]:
    """What an object in use and a new one differ by, where the noise is `share` times what was measured."""
    allowed = _ALLOWED * noise.energy * share
    force = float(np.max(np.abs(old.forces - new.forces), initial=0.0))
    rounding = np.finfo(float).eps * max(1.0, float(np.max(np.abs(new.forces), initial=0.0)))
    change = abs(old.energy - new.energy)
    remembers = change > allowed or force > _ALLOWED * share * max(noise.force, rounding)
    return {"energy": change, "force": force, "allowed": allowed, "remembers": remembers}


def _again(subject: Subject, sequences: Mapping[str, list[Asked]], stale: list[dict[str, Any]]) -> bool:
    """Whether another object, on the way on which the worst difference showed, answers as that one did."""
    worst = max(stale, key=lambda row: row["energy"])
    used = subject.fresh()
    if isinstance(used, CalculatorSubject):
        used.renews = used.forgets = False
    answer: Answer | Refusal | None = None
    for asked in sequences[worst["sequence"]]:
        answer = ask(used, asked.atoms)
        if asked.atoms is worst["atoms"] and asked.what == worst["structure"]:
            break
    if isinstance(answer, Refusal) or isinstance(worst["old"], Refusal):
        return isinstance(answer, Refusal) and isinstance(worst["old"], Refusal)
    assert answer is not None
    new = ask(subject.fresh(), worst["atoms"])
    if isinstance(new, Refusal):
        return False
    # both must come again: what objects in use say, and what new ones do
    for found, before in ((answer, worst["old"]), (new, worst["new"])):
        force = float(np.max(np.abs(found.forces - before.forces), initial=0.0))
        if force > 0.5 * worst["force"] or abs(found.energy - before.energy) > 0.5 * worst["energy"]:
            return False
    return True


def _repeated(subject: Subject, atoms: Atoms) -> dict[str, Any]:
    """The same structure again: of one object, with another structure between, and of new objects."""
    used = subject.fresh()
    aside = displaced(atoms, np.full((len(atoms), 3), 0.011))
    within = []
    for number in range(_AT_ONCE + _BETWEEN):
        within.append((used.energy(atoms), used.forces(atoms)))
        if number >= _AT_ONCE:
            used.energy(aside)
        elif isinstance(used, CalculatorSubject):
            used.forget()
    objects = [within[0]]
    for _ in range(_NEW - 1):
        new = subject.fresh()
        objects.append((new.energy(atoms), new.forces(atoms)))
    everywhere = subject.ledger.new if isinstance(subject, CalculatorSubject) else Again()
    return {
        "bit-identical": _identical(within),
        "energies scatter by": float(np.ptp([energy for energy, _ in within])),
        "forces scatter by": float(np.max(np.ptp([force for _, force in within], axis=0), initial=0.0)),
        "bit-identical between objects": _identical(objects) and not everywhere.differ,
        "energies between objects": max(float(np.ptp([energy for energy, _ in objects])), everywhere.energy),
        "forces between objects": max(
            float(np.max(np.ptp([force for _, force in objects], axis=0), initial=0.0)), everywhere.force
        ),
        "typical force": float(np.sqrt(np.mean(within[0][1] ** 2))),
    }


def _identical(answers: list[tuple[float, np.ndarray]]) -> bool:
    first = answers[0]
    return all(energy == first[0] and force.tobytes() == first[1].tobytes() for energy, force in answers)


def _unsteady(repeats: Mapping[str, Any], kT: float) -> Iterator[dict[str, str]]:
    chance = repeats.get("by chance", 0)
    if repeats["bit-identical"] and repeats["bit-identical between objects"] and not chance:
        return
    within = not repeats["bit-identical"]
    who, how = (
        ("one object", "at once and later") if within else ("new objects", "each as its first question")
    )
    energy = max(repeats["energies scatter by"], repeats["energies between objects"])
    force = max(repeats["forces scatter by"], repeats["forces between objects"])
    said = (
        f"Asked about one structure, {who} ({how}) gave energies that scatter by {energy:.2g} eV and forces "
    )
    said += f"by {force:.2g} eV/Å, at a typical force of {repeats['typical force']:.2g} eV/Å."
    if chance:
        energy, force = max(energy, repeats["energies"]), max(force, repeats["forces"])
        said = (
            f"Answers of an object in use ({chance} of those compared) differ by up to {energy:.2g} eV and "
        )
        said += f"{force:.2g} eV/Å from those of new ones to the same structures, and do not when the same "
        said += f"questions are asked again; a typical force is {repeats['typical force']:.2g} eV/Å."
    yield not_repeatable(said, energy, force, repeats["typical force"], kT)


def _tolerance(subject: Subject, atoms: Atoms) -> float:
    """Å by which an atom, or an edge of the cell, can move while an answer stays to the last bit, or 0.

    Only where the answer ought to have changed by many of its last digits: what it changes by over the
    longest of the moves, in proportion.
    """
    # one coordinate, the largest: a tolerance may be one of all atoms together, or a share of a coordinate
    line = np.zeros((len(atoms), 3))
    line.flat[np.argmax(np.abs(atoms.positions))] = 1.0
    ways: list[tuple[np.ndarray, Callable[[float], Atoms]]] = [
        (_TINY, lambda place: displaced(atoms, place * line))
    ]
    if atoms.pbc.any():
        edge = float(np.max(atoms.cell.lengths()))

        def stretched(place: float) -> Atoms:
            there = atoms.copy()
            there.set_cell((1 + place / edge) * atoms.cell.array)
            return there

        ways.append((_TINY[::2], stretched))
    return max(_kept_within(subject, sizes, at) for sizes, at in ways)


def _kept_within(subject: Subject, sizes: np.ndarray, at: Callable[[float], Atoms]) -> float:
    """The longest of some moves in a row after which one object has given its last answer again."""
    used = subject.fresh()
    if isinstance(used, CalculatorSubject):
        used.forgets = False
    places = np.array([0.0, *np.cumsum(sizes)])
    answers = []
    for place in places:
        found = ask(used, at(place))
        if isinstance(found, Refusal):
            return 0.0
        answers.append(np.append(found.forces, found.energy))
    values = np.array(answers)
    rate = np.abs(values[-1] - values[0]) / places[-1]
    read = digits(values[:, :-1])
    # forces are the finer measure; the smallest of them may have lost its digits to others
    last = max(2.0**-read.bits * float(np.max(np.abs(values[0, :-1]), initial=0.0)), read.quantum)
    felt = float(np.max(rate[:-1], initial=0.0)) * sizes > _KEPT * last
    if read.bits <= 24:  # who answers in single precision may read positions so
        felt &= sizes > 4 * _grain(at(0.0))
    kept = [
        moved
        for moved, seen, before, after in zip(sizes, felt, values, values[1:], strict=False)
        if seen and (before == after).all()
    ]
    return float(max(kept, default=0.0))


def _grain(atoms: Atoms) -> float:
    """The last digit of the largest coordinate in single precision, Å."""
    return float(np.spacing(np.float32(np.max(np.abs(atoms.positions), initial=1.0))))


def _kept(tolerance: float, atoms: Atoms) -> Iterator[dict[str, str]]:
    if tolerance:
        yield finding(
            "KEPT_ANSWER",
            "error" if tolerance > max(_HARMLESS, _grain(atoms)) else "warning",
            "the answer to another structure is given again",
            f"An atom, or the cell, moved by up to {tolerance:.0e} Å, and the object gave the energy "
            "and forces that it had given before, to the last bit, where they ought to have changed by more "
            "than a hundred times that. Slow atoms, differences and relaxations see old forces. (Positions "
            f"that are rounded to single precision move in steps of {_grain(atoms):.1g} Å here.)",
            "Compare positions, cell, species and periods bit by bit before an answer is given again, not "
            "within a tolerance (np.allclose allows 1e-5 of a coordinate).",
        )


def _row(row: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "sequence": row["sequence"],
        "what happened": row["structure"],
        "energy differs by": row["energy"],
        "allowed": row["allowed"],
        "forces differ by": row["force"],
        "same": not row["remembers"],
    }


def _says(rows: list[dict[str, Any]], stale: list[dict[str, Any]], repeats: Mapping[str, Any]) -> str:
    if not repeats["bit-identical"]:
        tail = "Repeated calls are not bit-identical."
    elif not repeats["bit-identical between objects"]:
        tail = "Repeated calls are bit-identical, and those of new objects are not."
    else:
        tail = "Repeated calls are bit-identical."
    words = f"{len({row['sequence'] for row in rows})} sequences"
    if stale:
        sizes = [row["energy"] for row in stale if np.isfinite(row["energy"])]
        by = f"by up to {max(sizes):.3g} eV" if sizes else "by failing"
        return (
            f"{len(stale)} of {len(rows)} answers of an object in use differ from those of a new one, {by}: "
            f"the calculator remembers. {tail}"
        )
    if chance := repeats.get("by chance"):
        return (
            f"{chance} of {len(rows)} answers of an object in use differ from those of a new one by up to "
            f"{repeats['energies']:.3g} eV, and not when they are asked for again: by chance. {tail}"
        )
    return f"Objects in use answered {len(rows)} questions of {words} as new ones do. {tail}"
