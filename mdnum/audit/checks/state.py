"""What a calculator object remembers: one question has one answer, whatever was asked before."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.base import TIME_UP, CheckResult, Observed, Progress, TimeUp, finding
from mdnum.audit.check import AuditCheck
from mdnum.audit.noise import FEW, NoiseFloor, digits, displaced, settled
from mdnum.audit.pairs import molecules, pairs, whole
from mdnum.audit.sequences import SequenceStep, all_sequences, approaches
from mdnum.audit.subject import CalculatorError, CalculatorSubject, Forces, not_repeatable, only_trying, rms
from mdnum.audit.thresholds import find_thresholds

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
#: Å between two parts that cannot feel one another, and a cell that does not repeat around them: some lists
#: take long over an empty one.
_FAR, _BOX = 60.0, 75.0
_CLUSTER = 12

#: Energy and forces, or why there are none.
Answered = tuple[float, Forces] | CalculatorError


class StateCheck(AuditCheck):
    """Does an answer depend on what the calculator object was asked before?

    Repeated calls, and one object through structures that grow, shrink, move and strain, beside new ones.
    """

    name, title, order = "state", "Memory", 50
    needed_to = ("run",)
    seed = 0

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """One object, asked again and again, beside new ones."""
        rng = np.random.default_rng(self.seed)
        atoms, noise = settled(subject.fresh(), rng, at_least=FEW)
        # two atoms first, which most calculators answer for quickly
        approached, skipped = _approached(subject)
        sequences = approached | all_sequences(atoms, rng)
        total, done = sum(map(len, sequences.values())), 0
        rows: list[dict[str, Any]] = []
        for word, sequence in sequences.items():
            compared = len(rows)
            try:
                with subject.meter.limited():
                    for reached, row in _through(subject, sequence, noise, word):
                        rows.append(row)
                        progress(done + reached, total, {"phase": "state", "unit": "structures"})
            except TimeUp:
                left = sum(one.compared for one in sequence) - (len(rows) - compared)
                skipped.append((f"{left} questions of the sequence “{word}”", TIME_UP))
            done += len(sequence)
        if not rows and any(why == TIME_UP for _, why in skipped):
            raise TimeUp
        repeats = _repeated(subject, atoms)
        tolerance = _tolerance(subject, atoms)
        alone = Alone(subject, atoms, noise)
        self.structures |= alone.structures
        broken = [row for row in rows if row["remembers"] and row["broken"]]
        stale = [row for row in rows if row["remembers"] and not row["broken"]]
        chance: dict[str, Any] = {}
        if stale and not _again(subject, sequences, stale):
            # another object on the same way does not go astray: it is chance, and no memory
            worst = max(stale, key=lambda row: row["energy"])
            chance = {"answers": len(stale), "energy": worst["energy"], "force": worst["force"]}
            stale = []
        refused = [row for row in rows if row["refused"] and not row["remembers"]]
        identical = repeats["bit-identical"], repeats["bit-identical between objects"]
        largest = [row["energy"] for row in stale if np.isfinite(row["energy"])]
        says = "failing" if stale and not largest else "stale" if stale else "chance" if chance else "none"
        how = "not_repeated" if not identical[0] else "repeated" if identical[1] else "not_between"
        values: dict[str, Any] = {
            "rows": len(rows), "stale": len(stale), "sequences": len({row["sequence"] for row in rows}),
            "answers": chance.get("answers", 0), "energy": max(largest, default=chance.get("energy", 0.0)),
        }  # fmt: skip
        return CheckResult(
            says=([f"state_{says}", f"state_{how}"], values),
            findings=[
                *_unsteady(repeats, chance, subject.kT),
                *self._stale(stale),
                *_kept(tolerance, atoms),
                *_broken(broken),
                *self._not_finite(refused),
                *_changed_input(subject, atoms),
                *alone.findings(),
            ],
            tables={
                "One object, asked again and again, beside new ones": [_row(row) for row in rows],
                "The same question again": [repeats],
                "Atoms alone": alone.rows,
            },
            numbers={
                "structures": len(rows),
                "remembered": len(stale),
                "largest": max((row["energy"] for row in rows), default=0.0),
                "bit_identical": identical[0],
                "bit_identical_objects": identical[1],
                "kept_within": tolerance,
            },
            skipped=[
                *skipped,
                *((row["structure"], row["refused"].message) for row in refused),
                *((what, error.message) for what, error in alone.refused),
            ],
            asked=len(rows),
            possible=sum(one.compared for sequence in sequences.values() for one in sequence),
        )

    def _stale(self, stale: list[dict[str, Any]]) -> Iterator[Observed]:
        if stale:
            worst = max(stale, key=lambda row: row["energy"])
            self.structures |= {"stale-before": worst["before"], "stale-after": worst["atoms"]}
            yield finding(
                "STALE_STATE",
                "error",
                "refused" if worst["refused"] else None,
                step=worst["structure"],
                energy=worst["energy"],
                force=worst["force"],
                allowed=worst["allowed"],
                why=worst["refused"].message if worst["refused"] else "",
                questions=len(stale),
                sequences=", ".join(sorted({row["sequence"] for row in stale})),
            )

    def _not_finite(self, refused: list[dict[str, Any]]) -> Iterator[Observed]:
        empty = [row for row in refused if row["refused"].cause is None]
        if empty:
            self.structures["not-finite"] = empty[0]["atoms"]
            why = empty[0]["refused"].message
            yield finding("NOT_FINITE", "error", step=empty[0]["structure"], why=why)


def _approached(subject: CalculatorSubject) -> tuple[dict[str, list[SequenceStep]], list[tuple[str, str]]]:
    """Sequences of two atoms at the cutoff; what could not be, and why."""
    what = "two atoms at the cutoff"
    try:
        thresholds = find_thresholds(subject)
        with only_trying(subject):
            found = pairs(subject)[0]
    except CalculatorError as error:
        return {}, [(what, error.message)]
    for pair in found[:1]:
        radii = [one.radius for one in thresholds if set(one.species) == set(pair.species)]
        if radii:
            return dict(approaches(pair, max(radii))), []
    return {}, [(what, "no cutoff was found")]


def _through(
    subject: CalculatorSubject, sequence: list[SequenceStep], noise: NoiseFloor, word: str
) -> Iterator[tuple[int, dict[str, Any]]]:
    """One object through a sequence: a row for each answer, compared with that of a new object."""
    used = subject.used()
    before: Atoms | None = None
    known: dict[int, Answered] = {}
    size, failed = 0.0, False
    for place, asked in enumerate(sequence):
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
        row: dict[str, Any] = {
            "sequence": word, "structure": asked.what, "before": previous, "atoms": asked.atoms,
            "energy": 0.0, "force": 0.0, "allowed": 0.0, "remembers": False, "refused": None,
            "old": old, "new": new, "broken": was_broken and isinstance(old, CalculatorError),
        }  # fmt: skip
        if isinstance(new, CalculatorError):
            row["refused"] = new  # what nobody can answer says nothing about memory
        elif isinstance(old, CalculatorError):
            row |= {"remembers": True, "energy": float("inf"), "force": float("inf"), "refused": old}
        else:
            size = size or abs(new[0])
            # a larger energy has more noise than was measured
            share = max(1.0, abs(new[0]) / size) if size else 1.0
            energy, force = _differences(old, new)
            rounding = np.finfo(float).eps * max(1.0, float(np.max(np.abs(new[1]), initial=0.0)))
            allowed = _ALLOWED * noise.energy * share
            remembers = energy > allowed or force > _ALLOWED * share * max(noise.force, rounding)
            row |= {"energy": energy, "force": force, "allowed": allowed, "remembers": remembers}
        yield place + 1, row


def _differences(one: tuple[float, Forces], other: tuple[float, Forces]) -> tuple[float, float]:
    return abs(one[0] - other[0]), float(np.max(np.abs(one[1] - other[1]), initial=0.0))


def _again(
    subject: CalculatorSubject, sequences: Mapping[str, list[SequenceStep]], stale: list[dict[str, Any]]
) -> bool:
    """Whether another object, on the way on which the worst difference showed, answers as that one did."""
    worst = max(stale, key=lambda row: row["energy"])
    used = subject.used()
    answer: Answered | None = None
    for asked in sequences[worst["sequence"]]:
        answer = used.try_both(asked.atoms)
        if asked.atoms is worst["atoms"] and asked.what == worst["structure"]:
            break
    if isinstance(answer, CalculatorError) or isinstance(worst["old"], CalculatorError):
        return isinstance(answer, CalculatorError) and isinstance(worst["old"], CalculatorError)
    new = subject.fresh().try_both(worst["atoms"])
    if isinstance(new, CalculatorError):
        return False
    assert answer is not None
    # both must come again: what objects in use answer, and what new ones do
    for now, before in ((answer, worst["old"]), (new, worst["new"])):
        energy, force = _differences(now, before)
        if force > 0.5 * worst["force"] or energy > 0.5 * worst["energy"]:
            return False
    return True


def _repeated(subject: CalculatorSubject, atoms: Atoms) -> dict[str, Any]:
    """The same structure again: of one object, with another structure between, and of new objects."""
    used = subject.fresh()
    aside = displaced(atoms, np.full((len(atoms), 3), 0.011))
    within = []
    for number in range(_AT_ONCE + _BETWEEN):
        within.append((used.energy(atoms), used.forces(atoms)))
        if number >= _AT_ONCE:
            used.energy(aside)
        else:
            used.forget()
    objects = [within[0]]
    for _ in range(_NEW - 1):
        new = subject.fresh()
        objects.append((new.energy(atoms), new.forces(atoms)))

    def spread(answers: list[tuple[float, Forces]]) -> tuple[bool, float, float]:
        (energy, forces), *others = answers
        same = all(one[0] == energy and one[1].tobytes() == forces.tobytes() for one in others)
        force = np.max(np.ptp([one[1] for one in answers], axis=0), initial=0.0)
        return same, float(np.ptp([one[0] for one in answers])), float(force)

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
    if not within and repeats["bit-identical between objects"] and not chance:
        return
    energy = max(
        repeats["energies scatter by"], repeats["energies between objects"], chance.get("energy", 0.0)
    )
    force = max(repeats["forces scatter by"], repeats["forces between objects"], chance.get("force", 0.0))
    how = "chance" if chance else "within" if within else "between"
    yield not_repeatable(how, energy, force, repeats["typical force"], kT, answers=chance.get("answers", 0))


def _tolerance(subject: CalculatorSubject, atoms: Atoms) -> float:
    """Å by which an atom, or an edge of the cell, can move while an answer stays to the last bit, or 0.

    Only where the answer ought to have changed by many of its last digits: what it changes by over the
    longest of the moves, in proportion.
    """
    # one coordinate, the largest: a tolerance may be one of all atoms together, or a share of a coordinate
    line = np.zeros((len(atoms), 3))
    line.flat[np.argmax(np.abs(atoms.positions))] = 1.0
    kept = _kept_within(subject, _TINY, lambda place: displaced(atoms, place * line))
    if not atoms.pbc.any():
        return kept
    edge = float(np.max(atoms.cell.lengths()))

    def stretched(place: float) -> Atoms:
        there = atoms.copy()
        there.set_cell((1 + place / edge) * atoms.cell.array)
        return there

    return max(kept, _kept_within(subject, _TINY[::2], stretched))


def _kept_within(subject: CalculatorSubject, sizes: np.ndarray, at: Callable[[float], Atoms]) -> float:
    """The longest of some moves in a row after which one object has given its last answer again."""
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


def _kept(tolerance: float, atoms: Atoms) -> Iterator[Observed]:
    if tolerance:
        severity = "error" if tolerance > max(_HARMLESS, _grain(atoms)) else "warning"
        yield finding("KEPT_ANSWER", severity, tolerance=tolerance, grain=_grain(atoms))


def _broken(broken: list[dict[str, Any]]) -> Iterator[Observed]:
    if broken:
        step, why = broken[0]["structure"], broken[0]["refused"].message
        yield finding("BROKEN_BY_FAILURE", "info", step=step, why=why)


def _changed_input(subject: CalculatorSubject, atoms: Atoms) -> Iterator[Observed]:
    """What the calculator does to the atoms that it is handed, and not a copy of; many wrap them."""
    outside = displaced(atoms, np.tile((atoms.pbc * 1.0) @ atoms.cell.array, (len(atoms), 1)))
    for there, what in ((atoms, "the structure"), (outside, "the structure one cell further")):
        other = subject.fresh()
        try:
            with only_trying(other):
                changed = other.writes(there)
        except CalculatorError:
            continue  # reported elsewhere
        if changed:
            yield finding("CHANGED_INPUT", "error", what=what, changed=" and ".join(changed))
            return


def _row(row: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "sequence": row["sequence"],
        "what happened": row["structure"],
        "energy differs by (eV)": row["energy"],
        "allowed": row["allowed"],
        "forces differ by (eV/Å)": row["force"],
        "same": not row["remembers"],
    }


class Alone:
    """Atoms without a neighbor: they feel no force, and energies of parts far apart add up.

    Single atoms, two atoms far apart, and a cluster with an atom far away; molecules for calculators that
    take nothing less.

    Args:
        subject: a new object is made for each question.
        atoms: species, and the cluster.
        noise: of the calculator.

    Attributes:
        rows: a row for each structure that was answered for.
        refused: what was not, and why.
        takes_atoms: whether the calculator answers for anything that is no whole molecule.
        structures: on which it failed, by name.
    """

    def __init__(self, subject: CalculatorSubject, atoms: Atoms, noise: NoiseFloor):
        self.rows: list[dict[str, Any]] = []
        self.refused: list[tuple[str, CalculatorError]] = []
        self.structures: dict[str, Atoms] = {}
        self._subject, self._noise = subject, noise
        ask = lambda there: subject.fresh().try_both(there)  # noqa: E731
        species = list(dict.fromkeys(atoms.symbols))
        single: dict[str, float] = {}
        for symbol in species:
            for periodic in (False, True):
                one = Atoms(symbol, positions=[[1.0, 2.0, 3.0]], cell=[2 * _FAR] * 3, pbc=periodic)
                answer = ask(one)
                if not isinstance(answer, CalculatorError):
                    single.setdefault(symbol, answer[0])
                what = f"one {symbol} atom{' in a large periodic cell' if periodic else ''}"
                self._add(what, answer, single.get(symbol), one)
        two = (species[0], species[-1])
        pair = Atoms(two, positions=[[1.0, 2.0, 3.0], [1.0 + _FAR, 2.0, 3.0]], cell=[_BOX] * 3)
        expected = single[two[0]] + single[two[1]] if set(two) <= set(single) else None
        self._add(f"{two[0]} and {two[1]} {_FAR:g} Å apart", ask(pair), expected, pair)
        cluster = atoms[: min(len(atoms), _CLUSTER)]
        cluster.pbc = False
        cluster.positions += 1.0 - cluster.positions.min(axis=0)
        cluster.set_cell([_BOX + float(np.ptp(cluster.positions, axis=0).max())] * 3)
        near = ask(cluster)
        failed = isinstance(near, CalculatorError)
        # one that knows whole molecules alone takes nothing of which an atom is gone; one that fails on an
        # atom without neighbors may fail on the cluster, and takes the structure with a vacancy
        fewer = (atoms[:-1],) if failed else (cluster[:-1], atoms[:-1])
        self.takes_atoms = any(not isinstance(ask(one), CalculatorError) for one in fewer)
        if failed:
            self.refused.append((f"a cluster of {len(cluster)} atoms", near))
        elif not self.takes_atoms:
            self._molecules(atoms)
        else:
            symbol = str(atoms.symbols[0])
            far = cluster + Atoms(symbol, positions=[cluster.positions.max(axis=0) + _FAR])
            both = ask(far)
            if not isinstance(both, CalculatorError):
                both = both[0], both[1][-1:]
            expected = near[0] + single[symbol] if symbol in single else None
            self._add(f"a {symbol} atom {_FAR:g} Å from a cluster", both, expected, far)

    def _molecules(self, atoms: Atoms) -> None:
        """One molecule alone, and two far apart."""
        one = whole(atoms, molecules(atoms)[0])
        one.positions += [1.0, 2.0, 3.0]
        one.set_cell([_BOX] * 3)
        other = one.copy()
        other.positions[:, 0] += _FAR
        formula, energy = one.get_chemical_formula(), None
        for what, there in ((f"one {formula}", one), (f"two {formula} {_FAR:g} Å apart", one + other)):
            answer = self._subject.fresh().try_both(there)
            if not isinstance(answer, CalculatorError):
                # within a molecule there are forces, on it as a whole there is none
                answer = answer[0], answer[1].reshape(-1, len(one), 3).sum(axis=1)
                energy = answer[0] if energy is None else energy
            self._add(what, answer, None if energy is None else energy * len(there) / len(one), there)

    def _add(self, what: str, answer: Answered, expected: float | None, atoms: Atoms) -> None:
        """Takes note of an answer; without an expected energy, only of its force."""
        if isinstance(answer, CalculatorError):
            self.refused.append((what, answer))
            if answer.cause is None:
                self.structures["alone-failed"] = atoms
            return
        force, eps = float(np.max(np.abs(answer[1]), initial=0.0)), np.finfo(float).eps
        expected = answer[0] if expected is None else expected
        allowed = _ALLOWED * max(self._noise.energy, eps * abs(expected))
        self.rows.append(
            {
                "atoms": what,
                "energy (eV)": answer[0],
                "expected": expected,
                "force (eV/Å)": force,
                "adds up": abs(answer[0] - expected) <= allowed,
                "no force": force <= _ALLOWED * max(self._noise.force, eps),
            }
        )

    def findings(self) -> Iterator[Observed]:
        """What is wrong with atoms alone."""
        for what, why in [one for one in self.refused if one[1].cause is None][:1]:
            yield finding("LONELY_NOT_FINITE", "error", what=what, why=why.message)
        for what, why in [one for one in self.refused if one[1].cause is not None and self.takes_atoms][:1]:
            yield finding("LONELY_FAILS", "warning", what=what, why=why.message)
        if pushed := [row for row in self.rows if not row["no force"]]:
            worst = max(pushed, key=lambda row: row["force (eV/Å)"])
            yield finding("LONELY_FORCE", "error", what=worst["atoms"], force=worst["force (eV/Å)"])
        if apart := [row for row in self.rows if not row["adds up"]]:
            worst = max(apart, key=lambda row: abs(row["energy (eV)"] - row["expected"]))
            energies = f"{worst['energy (eV)']:.10g}", f"{worst['expected']:.10g}"
            values = {"what": worst["atoms"], "energy": energies[0], "expected": energies[1], "far": _FAR}
            yield finding("LONELY_ENERGY", "warning", **values)
