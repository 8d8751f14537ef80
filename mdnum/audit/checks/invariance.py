"""Check whether energy and forces depend on how a structure is represented."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from ase import Atoms
from jaxtyping import Float, Int

from mdnum.audit.base import AuditCheck, CalculatorError, CheckResult, Observed, Progress, Ways, finding
from mdnum.audit.noise import NoiseFloor, along_a_line, displaced, measured, settled, under_jitter
from mdnum.audit.places import wrong_places
from mdnum.audit.structures import group, modified, nearest_distance
from mdnum.audit.subject import CalculatorSubject, Forces, differences, largest, rms
from mdnum.units import ENERGY, FORCE, LENGTH, Measured

#: If two representations of a structure differ by more than their tolerance but less than this multiple of
#: it, the noise is measured again.
_NEARLY = 30.0
_SMALL = 1e-3  # of kT, and of the root mean square force: a difference below is one of precision
#: Among the representations, those that every calculator must support; others may fail for a calculator
#: limited to rectangular cells, or to molecules in a given order of atoms.
_MUST_ANSWER = ("TRANSLATION", "IMAGES", "FACES", "CELL_ULP", "EXTENSIVE")
_REPORTS = ("PLACE_IN_LIST", "TOPOLOGY_BY_ORDER", "WHOLE_MOLECULES")  # findings beside the codes of ways

#: Tiny nonzero coordinates: a displacement that caused an error of 5 eV in some code, one that is lost when
#: it is added to the length of a cell, and half an ulp of 1.
_TINY = (1e-52, 1e-17, 2.0**-53)


#: Distinguishing tests that a representation makes implicitly: mirror images with vectors of the same
#: handedness, and a position in the list found by exchanging atoms in two orders, each evaluated by a new
#: object.
_SEPARATE = {
    "LEFT_HANDED": ("determinant",), "MIRROR": ("determinant",), "PLACE_IN_LIST": ("repeat", "place"),
}  # fmt: skip


@dataclass(frozen=True)
class Same:
    """Another representation of a structure, for example with other images of its atoms."""

    what: str  # how it differs
    code: str  # of the finding when the calculator gives it another answer
    atoms: Atoms  # the other way
    order: Int[np.ndarray, "same"]  # atom of the structure that each of its atoms is
    copies: int = 1  # how many times the structure it holds
    # a rotation or reflection R, new positions being R x
    turn: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    rounding: float = 0.0  # Å by which writing it down moved an atom, at most
    before: Atoms | None = None  # compare with this instead of the structure itself


def _same(code: str, base: Atoms, what: str, there: Atoms, factor: float = 1.0, **more) -> Same:
    """Return a representation of a structure in which the atoms keep their order."""
    return Same(what, code, there, np.arange(len(there)), **{"rounding": factor * ulp(there, base), **more})


@dataclass(frozen=True)
class _Difference:
    """Actual and allowed differences between two representations of one structure."""

    same: Same
    energy: float
    force: float
    allowed: NoiseFloor

    @property
    def agrees(self) -> bool:
        return self.energy <= self.allowed.energy and self.force <= self.allowed.force

    @property
    def excess(self) -> float:
        return self.energy / self.allowed.energy + self.force / self.allowed.force

    def row(self) -> dict[str, Any]:
        return {
            "the structure": self.same.what, f"energy differs by ({ENERGY})": self.energy,
            "allowed": self.allowed.energy, f"forces differ by ({FORCE})": self.force,
            "allowed for forces": self.allowed.force, "same": self.agrees,
        }  # fmt: skip


class InvarianceCheck(AuditCheck):
    """Do energy and forces of a structure depend on its representation?

    The calculator's noise is allowed, and so are differences that rounding of the coordinates can cause. Both
    differences are measured. A transformation that the calculator does not support is skipped. If two
    representations differ in energy or forces, `structures` contains both.
    """

    name, title, order, calls = "invariance", "Invariance", 40, 450
    needed_to = ("run",)

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """Evaluate energy and forces for many representations of one structure."""
        rng = np.random.default_rng(self.seed)
        judge = _Judge(subject, rng)
        same = _in_turns(self.ways(judge.atoms, subject.atoms, rng))
        refused: list[tuple[Same, CalculatorError]] = []
        ways = Ways()

        def failed(one: Same, error: CalculatorError) -> None:
            if one.code == "NARROW_CELL" and error.cause is not None:
                ways.skip(one.what, error.message)
                # a calculator that takes four atoms in a wide cell only is safe
                if subject.fresh().answers(one.atoms):
                    values = {"what": one.what, "why": error.message}
                    judge.notes.append(finding("NARROW_CELL_REFUSED", "info", **values))
            else:
                refused.append((one, error))

        found = ways.each(
            subject, same, lambda one: one.what, judge, progress, self.name, required=True, failed=failed
        )
        differences = list(found.values())
        wrong = [one for one in differences if not one.agrees]
        worst = max(wrong or differences, key=lambda one: one.energy, default=None)
        numbers = {
            "ways": len(differences), "told_apart": len(wrong), "refused": len(refused),
            "noise_energy": judge.noise.energy, "noise_force": judge.noise.force,
            "largest": max((one.energy for one in differences), default=0.0),
            "largest_force": max((one.force for one in differences), default=0.0),
        }  # fmt: skip
        values = {"energy": worst.energy, "worst": worst.same.what} if worst else {}
        values |= numbers | {"force": max((one.force for one in wrong), default=0.0)}
        says = "invariance_wrong" if wrong else "invariance_right" if differences else "invariance_none"
        return CheckResult(
            says=([says, "invariance_refused"] if refused else [says], values),
            findings=[*_refusals(refused), *self._findings(differences, judge, refused)],
            tables={"The same structure, written down otherwise": [one.row() for one in differences]},
            numbers=numbers,
            limits={"told_apart": (0, (*_REPORTS, *(one.code for one in same)))},
            skipped=[*((one.what, error.message) for one, error in refused), *ways.skipped],
            asked=ways.asked,
            possible=ways.possible,
        )

    def ways(self, atoms: Atoms, given: Atoms, rng: np.random.Generator) -> Iterator[Same]:
        """Yield other representations of a structure, for example translated or with reordered atoms."""
        return all_of(atoms, given, rng)

    def _findings(
        self, differences: list[_Difference], judge: _Judge, refused: list[tuple[Same, CalculatorError]]
    ) -> Iterator[Observed]:
        wrong: dict[str, list[_Difference]] = {}
        for one in differences:
            if not one.agrees:
                wrong.setdefault(one.same.code, []).append(one)
        if "ORDER" in wrong or any(same.code == "ORDER" for same, _ in refused):
            wrong = self._without_topology(wrong, judge)
        variants: tuple[str, ...] = ()
        more: dict[str, Any] = {}
        if "ORDER" in wrong and (places := wrong_places(judge.subject, judge.atoms, judge.noise.allowed)):
            wrong["PLACE_IN_LIST"] = wrong.pop("ORDER")
            forces = () if places.energy else (f"forces_{places.pattern}",)
            variants, more = (*forces, places.pattern), places.values
        yield from judge.notes
        for code, cases in wrong.items():
            worst = max(cases, key=lambda one: one.excess)
            slug = code.lower().replace("_", "-")
            before = judge.before(worst.same)
            self.structures |= {f"{slug}-before": before, f"{slug}-after": worst.same.atoms}
            kT = worst.energy / judge.subject.kT if judge.subject.kT else 0.0
            # forces that differ by what matters to a trajectory rather than by a lower precision
            force = rms(judge.reference(before, worst.same.rounding)[1]) + 1e-300
            large = kT > _SMALL or worst.force > _SMALL * force
            yield finding(
                code,
                # of a narrow cell, the structure itself is answered for as it should be
                "error" if large and code != "NARROW_CELL" else "warning",
                *(variants if code == "PLACE_IN_LIST" else ()),
                energy=Measured(worst.energy, "energy", worst.allowed.energy, judge.subject.kT),
                force=Measured(worst.force, "energy/length", worst.allowed.force, force),
                what=worst.same.what, kT=kT, differ=len(cases), slug=slug,
                tried=sum(one.same.code == worst.same.code for one in differences),
                tests=_SEPARATE.get(code, ()), **more if code == "PLACE_IN_LIST" else {},
            )  # fmt: skip

    def _without_topology(
        self, wrong: dict[str, list[_Difference]], judge: _Judge
    ) -> dict[str, list[_Difference]]:
        """Omit differences caused by reordering atoms if the atom order defines the molecules."""
        rng = np.random.default_rng(self.seed + 1)
        grouped = by_molecule(judge.atoms, rng)
        try:
            if grouped is None or not judge(grouped[0]).agrees:
                return wrong
        except CalculatorError:
            return wrong
        worst = max(wrong.get("ORDER", []), key=lambda one: one.energy, default=None)
        values: dict[str, Any] = {"what": grouped[0].what}
        if worst:
            values |= {"single": worst.same.what, "energy": worst.energy, "force": worst.force}
        severity, variant = ("warning", "silent") if worst else ("info", None)
        judge.notes.append(finding("TOPOLOGY_BY_ORDER", severity, variant, **values))
        kept = {code: cases for code, cases in wrong.items() if code != "ORDER"}
        if "IMAGES" not in kept or not judge(grouped[1]).agrees:
            return kept
        worst = max(kept["IMAGES"], key=lambda one: one.energy)
        values = {"what": worst.same.what, "energy": worst.energy}
        judge.notes.append(finding("WHOLE_MOLECULES", "warning", **values))
        # an atom on a face is cut from its molecule as well
        return {code: cases for code, cases in kept.items() if code not in ("IMAGES", "FACES")}


class _Judge:
    """Compares representations of a structure. Allowed differences depend on the rounding of coordinates."""

    def __init__(self, subject: CalculatorSubject, rng: np.random.Generator):
        self.subject, self.worker, self._rng = subject, subject.fresh(), rng
        self.atoms, self.noise = settled(self.worker, rng, at_least=1)
        self.notes: list[Observed] = []
        # by structures, which are kept so that their ids are theirs
        self._known: dict[tuple[int, int], tuple[Atoms, float, Forces, NoiseFloor]] = {}

    def before(self, same: Same) -> Atoms:
        return self.atoms if same.before is None else same.before

    def __call__(self, same: Same) -> _Difference:
        base = self.before(same)
        reference = self.reference(base, same.rounding)
        found, answer = self._compared(self.worker, same, *reference)
        if not found.agrees:
            # another object, which has seen nothing else: what it remembers is another question
            found, _ = self._compared(self.subject.fresh(), same, *reference)
            if not found.agrees and found.excess < _NEARLY:
                # noise may be larger in the other way of writing it down, that of a longer sum above all
                noise = found.allowed
                for there, copies in ((base, 1), (same.atoms, same.copies)):
                    other = self.subject.fresh()
                    line = measured(other, there, self._rng).allowed
                    noise = noise.louder(replace(line, energy=line.energy / copies))
                found = replace(found, allowed=noise)
            # who stands alone may have answered so by chance, and is asked again
            if found.agrees:
                self.worker.again(same.atoms, *answer)
            else:
                (self.worker if base is self.atoms else self.subject.fresh()).again(base, *reference[:2])
        return found

    def _compared(
        self, worker: CalculatorSubject, same: Same, energy: float, forces: Forces, allowed: NoiseFloor
    ) -> tuple[_Difference, tuple[float, Forces]]:
        answer = worker.both(same.atoms)
        here = answer[0] / same.copies, answer[1]
        return _Difference(
            same, *differences((energy, forces[same.order] @ same.turn.T), here), allowed
        ), answer

    def reference(self, base: Atoms, rounding: float) -> tuple[float, Forces, NoiseFloor]:
        """Return a structure's energy and forces, and the allowed differences."""
        power = int(np.ceil(np.log2(rounding))) if rounding > 0 else -9999
        key = id(base), power
        if key not in self._known:
            worker = self.subject.fresh() if base is not self.atoms else self.worker
            if base is self.subject.atoms:
                # it may stand on a threshold, where any noise that is measured is the step in question
                allowed = self.reference(self.atoms, rounding)[2]
            else:
                noise = self.noise
                if base is not self.atoms:
                    noise = noise.louder(along_a_line(worker, base, self._rng))
                if rounding:
                    noise = noise.louder(under_jitter(worker, base, 2.0**power, self._rng))
                allowed = noise.allowed
            self._known[key] = base, *worker.both(base), allowed
        return self._known[key][1:]


def _refusals(refused: list[tuple[Same, CalculatorError]]) -> Iterator[Observed]:
    """Yield findings about nonfinite results, and about exceptions for valid structures."""
    empty = [one for one in refused if one[1].cause is None]
    raised = [one for one in refused if one[1].cause is not None and one[0].code in _MUST_ANSWER]
    for code, cases in (("NOT_FINITE", empty), ("FAILS", raised)):
        if not cases:
            continue
        same, error = cases[0]
        values = {"what": same.what, "why": error.message, "ways": len(cases)}
        values["file"] = error.structure.name if error.structure else ""
        yield finding(code, "error", "rewritten", "saved" if error.structure else None, **values)


def _in_turns(ways: Iterable[Same]) -> list[Same]:
    """Order representations so that every kind is tested once before any is tested twice."""
    seen: dict[str, int] = {}
    turns = []
    for same in ways:
        seen[same.code] = seen.get(same.code, -1) + 1
        turns.append((seen[same.code], same))
    return [same for _, same in sorted(turns, key=lambda one: one[0])]


# -- other ways to write down the same structure ---------------------------------------------------


def all_of(atoms: Atoms, given: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """Yield all representations that are possible for a structure.

    Args:
        atoms: a structure in which no distance is exactly at a threshold.
        given: the structure as the user gave it, in which distances may be exactly at a threshold.
    """
    yield from translated(atoms, rng)
    yield from imaged(atoms, rng)
    yield from on_a_face(atoms, rng)
    yield from permuted(atoms, rng)
    yield from by_an_ulp(atoms, given)
    yield from repeated(atoms)
    yield from narrow(atoms, rng)
    yield from skewed(atoms)
    yield from turned(atoms, rng)
    yield from without_periods(atoms)


def translated(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """Yield structures with all atoms translated together, by lattice or arbitrary vectors."""
    same = partial(_same, "TRANSLATION", atoms)
    if atoms.pbc.any():
        for count, words in ((1, "one lattice vector"), (-3, "three lattice vectors back")):
            by = count * atoms.cell.array[atoms.pbc].sum(axis=0)
            yield same(f"all atoms moved by {words} along each periodic axis", displaced(atoms, by))
        for _ in range(2):
            what = "all atoms moved by fractions of the lattice vectors"
            there = displaced(atoms, (rng.uniform(0, 1, 3) * atoms.pbc) @ atoms.cell)
            yield same(what, there)
            yield _same("IMAGES", there, f"{what} and wrapped", _wrapped(there))
    free = ~atoms.pbc
    if free.any():
        axes = "the free axes" if atoms.pbc.any() else "x, y, z"
        for length in (7.3, -250.0):
            there = displaced(atoms, length * _outward(atoms, free))
            yield same(f"all atoms moved by {length:g} {LENGTH} along {axes}", there)


def imaged(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """Yield structures with each atom in an arbitrary periodic image."""
    if not atoms.pbc.any():
        return
    same = partial(_same, "IMAGES", atoms)
    yield same("atoms wrapped into the cell", _wrapped(atoms))
    for most in (1, 3, 20):
        boxes = rng.integers(-most, most + 1, (len(atoms), 3)) * atoms.pbc
        there = displaced(atoms, boxes @ atoms.cell.array)
        yield same(f"each atom moved by lattice vectors of its own, up to {most} of them", there)


def on_a_face(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """Yield structures with one atom on a cell face, just outside, or on the opposite face."""
    if not atoms.pbc.any():
        return
    axes, cell = np.flatnonzero(atoms.pbc), atoms.cell.array
    corner = cell[axes].sum(axis=0)
    for who in dict.fromkeys((0, int(rng.integers(len(atoms))))):
        base = displaced(atoms, -atoms.positions[who])

        def placed(where: str, position: object, extra: float = 0.0, base: Atoms = base, who: int = who):
            there = base.copy()
            there.positions[who] = position
            return _same("FACES", atoms, f"atom {who} {where}", there, rounding=ulp(base, atoms) + extra)

        zero = np.zeros(3)
        yield placed("at 0", zero)
        yield placed("at L on every periodic axis", corner)
        for axis in axes:
            yield placed(f"at L along {'abc'[axis]}", cell[axis])
        yield placed("one ulp short of L", np.nextafter(corner, 0.0))
        for tiny in _TINY:
            yield placed(f"at {-tiny:.0e} {LENGTH}", np.where(atoms.pbc, -tiny, zero), extra=tiny)
        yield placed("at -0", np.where(atoms.pbc, -0.0, zero))


def permuted(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """Yield structures with the atoms in a different order."""
    if len(atoms) < 2:
        return
    for _ in range(2):
        order = rng.permutation(len(atoms))
        yield Same("atoms in another order", "ORDER", atoms[order], order)
    order = np.arange(len(atoms))[::-1].copy()
    yield Same("atoms in reverse order", "ORDER", atoms[order], order)
    # with another species at the head of the list: some number species as they meet them
    for number in list(dict.fromkeys(atoms.numbers))[1:3]:
        order = np.argsort(atoms.numbers != number, kind="stable")
        yield Same(f"atoms of {Atoms([number]).symbols[0]} first", "ORDER", atoms[order], order)


def by_molecule(atoms: Atoms, rng: np.random.Generator) -> tuple[Same, Same] | None:
    """Return structures with molecules reordered or in other images. None if there are no molecules."""
    size = group(atoms)
    if size is None:
        return None
    count = len(atoms) // size
    order = (rng.permutation(count)[:, None] * size + np.arange(size)).ravel()
    boxes = rng.integers(-2, 3, (count, 3)) * atoms.pbc
    there = displaced(atoms, np.repeat(boxes, size, axis=0) @ atoms.cell.array)
    return (
        Same(f"molecules of {size} atoms in another order", "ORDER", atoms[order], order),
        _same("IMAGES", atoms, f"molecules of {size} atoms moved by lattice vectors of their own", there),
    )


def by_an_ulp(atoms: Atoms, given: Atoms) -> Iterator[Same]:
    """Yield structures with the same positions, and a cell changed by a rounding error."""
    if not atoms.pbc.any():
        return
    for what, base in (("", atoms), (", of the structure as it was given", given)):
        cell = base.cell.array
        rounding = 2 * float(np.spacing(np.max(np.abs(cell))))
        for toward, word in ((np.inf, "larger"), (0.0, "smaller")):
            # away from zero, whatever the sign, and zeros stay zeros
            there = modified(
                base, cell=np.where(cell == 0, cell, np.nextafter(cell, np.copysign(toward, cell)))
            )
            yield _same("CELL_ULP", base, f"cell one ulp {word}{what}", there, rounding=rounding, before=base)


def repeated(atoms: Atoms) -> Iterator[Same]:
    """Yield supercells of the structure."""
    wanted = [tuple(2 if n == axis else 1 for n in range(3)) for axis in np.flatnonzero(atoms.pbc)]
    if len(wanted) > 1 and len(atoms) <= 64:
        wanted.append(tuple(2 if repeats else 1 for repeats in atoms.pbc))
    for counts in wanted:
        there = atoms.repeat(counts)
        copies = len(there) // len(atoms)
        order = np.tile(np.arange(len(atoms)), copies)
        what = f"{' x '.join(map(str, counts))} supercell"
        yield Same(what, "EXTENSIVE", there, order, copies=copies, rounding=ulp(there, atoms))


def narrow(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """Yield a supercell of a dense four-atom cell.

    In cells at least two cutoffs wide, no atom interacts with two images of another atom. The four-atom cell
    contains one species, or equal numbers of two species. Structures with more than two species are not
    tested.
    """
    species = list(dict.fromkeys(atoms.symbols))
    nearest = nearest_distance(atoms)
    if not atoms.pbc.all() or len(species) > 2 or nearest == 0.0:
        return
    edge = nearest * np.sqrt(2.0)
    places = edge * np.array([[0, 0, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]])
    # wider by the most that two atoms may approach, so that none is nearer than in the structure
    places = 1.1 * places + 0.02 * nearest * rng.uniform(-1, 1, (4, 3))
    few = Atoms((4 * species)[:4], places, cell=[1.1 * edge] * 3, pbc=True)
    there, order = few.repeat(3), np.tile(np.arange(4), 27)
    what = f"a cell of four atoms, {1.1 * edge:.3g} {LENGTH} wide, repeated three times along each axis"
    yield Same(what, "NARROW_CELL", there, order, copies=27, rounding=ulp(there, few), before=few)


def skewed(atoms: Atoms) -> Iterator[Same]:
    """Yield the same crystal lattice with other lattice vectors, some of them left-handed."""
    if not atoms.pbc.all():
        return
    for what, matrix in (
        ("b replaced by a + b", [[1, 0, 0], [1, 1, 0], [0, 0, 1]]),
        ("c replaced by c - a + b", [[1, 0, 0], [0, 1, 0], [-1, 1, 1]]),
        ("a, b, c replaced by b, c, a", [[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
        ("a and b exchanged", [[0, 1, 0], [1, 0, 0], [0, 0, 1]]),
        ("c replaced by -c", [[1, 0, 0], [0, 1, 0], [0, 0, -1]]),
    ):
        there = modified(atoms, cell=np.array(matrix) @ atoms.cell.array)
        code = "LATTICE" if np.linalg.det(matrix) > 0 else "LEFT_HANDED"
        yield _same(code, atoms, f"the same lattice, {what}", there)


def turned(atoms: Atoms, rng: np.random.Generator) -> Iterator[Same]:
    """Yield the structure and its cell mirrored, rotated, or with permuted axes."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    anyhow = q * np.sign(np.diag(r))
    anyhow *= np.sign(np.linalg.det(anyhow))
    cyclic = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    for what, code, turn in (
        ("structure and cell rotated", "ROTATION", anyhow),
        ("x, y, z exchanged in a cycle", "ROTATION", cyclic),
        ("structure and cell mirrored", "MIRROR", np.diag([-1.0, 1.0, 1.0])),
    ):
        cell = atoms.cell.array @ turn.T
        if np.linalg.det(turn) < 0:
            # the same lattice by vectors that are not left-handed for it, which is another question
            cell[np.argmax(np.abs(cell[:, 0]))] *= -1
        there = modified(atoms, cell=cell, positions=atoms.positions @ turn.T)
        yield _same(code, atoms, what, there, factor=4, turn=turn)


def without_periods(atoms: Atoms) -> Iterator[Same]:
    """Yield a cluster in several nonperiodic cells. All cells must give the same energy and forces."""
    base = modified(atoms, cell=np.zeros((3, 3)), pbc=False)
    span = np.ptp(base.positions, axis=0).max() + 30.0
    for what, cell in (
        ("a large one", np.diag([span] * 3)),
        ("one shorter than the cluster", np.diag([2.0, 3.0, 4.0])),
        ("a skewed one", np.array([[5.0, 0.0, 0.0], [4.0, 3.0, 0.0], [1.0, 2.0, 6.0]])),
    ):
        what = f"without periods, in {what}"
        yield _same("DUMMY_CELL", base, what, modified(base, cell=cell), rounding=0.0, before=base)


def _wrapped(atoms: Atoms) -> Atoms:
    there = atoms.copy()
    there.wrap(eps=0)
    return there


def _outward(atoms: Atoms, free: np.ndarray) -> np.ndarray:
    """Return a unit vector that is perpendicular to all periodic axes."""
    if free.all():
        return np.array([1.0, -0.7, 0.4]) / np.linalg.norm([1.0, -0.7, 0.4])
    if not atoms.cell.array[~free].any():
        return np.eye(3)[free][0]
    # perpendicular to the lattice vectors that repeat
    _, _, basis = np.linalg.svd(atoms.cell.array[~free])
    return basis[-1]


def ulp(*structures: Atoms) -> float:
    """Return the unit in the last place (Å) of the largest coordinate or cell entry."""
    parts = (part for one in structures for part in (one.positions, one.cell.array))
    return float(np.spacing(max(map(largest, parts))))
