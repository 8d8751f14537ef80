"""Whether energy and forces depend on how a structure is written down."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit import transformations
from mdnum.audit.base import TIME_UP, CheckResult, Observed, Progress, TimeUp, finding
from mdnum.audit.check import AuditCheck, ask_each
from mdnum.audit.noise import NoiseFloor, along_a_line, settled, under_jitter
from mdnum.audit.subject import CalculatorError, CalculatorSubject, Forces, rms
from mdnum.audit.transformations import Same

#: How many times the measured noise a difference may be: the largest of some hundred forces is seen, noise is
#: a standard deviation, and another order of summation scatters more than moving along a line.
_ALLOWED = 40.0
#: Of kT for the whole structure, and of the root mean square force: a difference below is one of precision.
_SMALL = 1e-3
#: Of other ways to write a structure down, those that a calculator for any cell has to take: it may know
#: rectangular cells alone, or molecules by the order of their atoms.
_MUST_ANSWER = ("TRANSLATION", "IMAGES", "FACES", "CELL_ULP", "EXTENSIVE")


@dataclass(frozen=True)
class _Difference:
    """What two ways of writing down one structure differ by, and may differ by."""

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
            "the structure": self.same.what,
            "energy differs by (eV)": self.energy,
            "allowed": self.allowed.energy,
            "forces differ by (eV/Å)": self.force,
            "allowed for forces": self.allowed.force,
            "same": self.agrees,
        }


class InvarianceCheck(AuditCheck):
    """Do energy and forces of one structure depend on how it is written down?

    What may differ is measured: noise of the calculator along a line, and the largest change under random
    moves of the size of the rounding of coordinates. A transformation that the calculator does not support
    is left out. `structures` holds both ways of writing down wherever their answers differ.
    """

    name, title, order = "invariance", "Invariance", 10
    needed_to = ("run",)
    seed = 0

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """One structure, written down in many ways."""
        rng = np.random.default_rng(self.seed)
        judge = _Judge(subject, rng)
        same = _in_turns(transformations.all_of(judge.atoms, subject.atoms, rng))
        refused: list[tuple[Same, CalculatorError]] = []
        late: list[tuple[str, str]] = []

        def failed(place: int, error: CalculatorError) -> None:
            if same[place].code == "NARROW_CELL" and error.cause is not None:
                late.append((same[place].what, error.message))
                # a calculator that takes four atoms in a wide cell only is safe
                if not isinstance(subject.fresh().try_both(same[place].atoms), CalculatorError):
                    values = {"what": same[place].what, "why": error.message}
                    judge.notes.append(finding("NARROW_CELL_REFUSED", "info", **values))
            else:
                refused.append((same[place], error))

        ways = [(one.what, lambda one=one: judge(one)) for one in same]
        found = ask_each(subject, ways, progress, self.name, late, failed=failed)
        unasked = sum(why == TIME_UP for _, why in late)
        if unasked == len(ways):
            raise TimeUp
        differences = list(found.values())
        wrong = [one for one in differences if not one.agrees]
        worst = max(wrong or differences, key=lambda one: one.energy, default=None)
        values: dict[str, Any] = {
            "ways": len(differences), "wrong": len(wrong), "refused": len(refused),
            "noise": judge.noise.energy, "energy": worst.energy if worst else 0.0,
            "worst": worst.same.what if worst else "",
            "force": max((one.force for one in wrong), default=0.0),
        }  # fmt: skip
        says = "invariance_wrong" if wrong else "invariance_right" if differences else "invariance_none"
        return CheckResult(
            says=([says, "invariance_refused"] if refused else [says], values),
            findings=[*_refusals(refused), *self._findings(differences, judge, refused)],
            tables={"The same structure, written down otherwise": [one.row() for one in differences]},
            numbers={
                "ways": len(differences),
                "told_apart": len(wrong),
                "refused": len(refused),
                "noise_energy": judge.noise.energy,
                "noise_force": judge.noise.force,
                "largest": max((one.energy for one in differences), default=0.0),
                "largest_force": max((one.force for one in differences), default=0.0),
            },
            skipped=[*((one.what, error.message) for one, error in refused), *late],
            asked=len(ways) - unasked,
            possible=len(ways),
        )

    def _findings(
        self, differences: list[_Difference], judge: _Judge, refused: list[tuple[Same, CalculatorError]]
    ) -> Iterator[Observed]:
        wrong: dict[str, list[_Difference]] = {}
        for one in differences:
            if not one.agrees:
                wrong.setdefault(one.same.code, []).append(one)
        if "ORDER" in wrong or any(same.code == "ORDER" for same, _ in refused):
            wrong = self._without_topology(wrong, judge)
        yield from judge.notes
        for code, group in wrong.items():
            worst = max(group, key=lambda one: one.excess)
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
                what=worst.same.what,
                energy=worst.energy,
                kT=kT,
                allowed=worst.allowed.energy,
                force=worst.force,
                allowed_force=worst.allowed.force,
                differ=len(group),
                tried=sum(one.same.code == code for one in differences),
                slug=slug,
            )

    def _without_topology(
        self, wrong: dict[str, list[_Difference]], judge: _Judge
    ) -> dict[str, list[_Difference]]:
        """Differences without those that belong to what the calculator is: a topology made from the order."""
        rng = np.random.default_rng(self.seed + 1)
        grouped = transformations.by_molecule(judge.atoms, rng)
        try:
            if grouped is None or not judge(grouped).agrees:
                return wrong
        except CalculatorError:
            return wrong
        worst = max(wrong.get("ORDER", []), key=lambda one: one.energy, default=None)
        values: dict[str, Any] = {"what": grouped.what}
        if worst:
            values |= {"single": worst.same.what, "energy": worst.energy, "force": worst.force}
        severity, variant = ("warning", "silent") if worst else ("info", None)
        judge.notes.append(finding("TOPOLOGY_BY_ORDER", severity, variant, **values))
        kept = {code: group for code, group in wrong.items() if code != "ORDER"}
        whole = transformations.images_by_molecule(judge.atoms, rng)
        if "IMAGES" not in kept or whole is None or not judge(whole).agrees:
            return kept
        worst = max(kept["IMAGES"], key=lambda one: one.energy)
        values = {"what": worst.same.what, "energy": worst.energy}
        judge.notes.append(finding("WHOLE_MOLECULES", "warning", **values))
        # an atom on a face is cut from its molecule as well
        return {code: group for code, group in kept.items() if code not in ("IMAGES", "FACES")}


class _Judge:
    """Compares, and measures once for each size of rounding what a comparison may give."""

    def __init__(self, subject: CalculatorSubject, rng: np.random.Generator):
        self.subject, self.worker, self._rng = subject, subject.fresh(), rng
        self.atoms, self.noise = settled(self.worker, rng)
        self.notes: list[Observed] = []
        self._known: dict[tuple[int, int], tuple[float, Forces, NoiseFloor]] = {}
        self._bases: list[Atoms] = [self.atoms]

    def before(self, same: Same) -> Atoms:
        return self.atoms if same.before is None else same.before

    def __call__(self, same: Same) -> _Difference:
        base = self.before(same)
        reference = self.reference(base, same.rounding)
        found, answer = self._compared(self.worker, same, *reference)
        if not found.agrees:
            # another object, which has seen nothing else: what it remembers is another question
            found, _ = self._compared(self.subject.fresh(), same, *reference)
            # who stands alone may have answered so by chance, and is asked again
            if found.agrees:
                self.worker.again(same.atoms, *answer)
            else:
                (self.worker if base is self.atoms else self.subject.fresh()).again(base, *reference[:2])
        return found

    def _compared(
        self, worker: CalculatorSubject, same: Same, energy: float, forces: Forces, allowed: NoiseFloor
    ) -> tuple[_Difference, tuple[float, Forces]]:
        answer = worker.energy(same.atoms), worker.forces(same.atoms)
        force = float(np.max(np.abs(answer[1] - forces[same.order] @ same.turn.T), initial=0.0))
        return _Difference(same, abs(answer[0] / same.copies - energy), force, allowed), answer

    def reference(self, base: Atoms, rounding: float) -> tuple[float, Forces, NoiseFloor]:
        """Energy and forces of a structure, and what rounding of this size makes of them."""
        if not any(base is one for one in self._bases):
            self._bases.append(base)
        power = int(np.ceil(np.log2(rounding))) if rounding > 0 else -9999
        key = (next(n for n, one in enumerate(self._bases) if one is base), power)
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
                allowed = NoiseFloor(_ALLOWED * noise.energy, _ALLOWED * noise.force)
            self._known[key] = worker.energy(base), worker.forces(base), allowed
        return self._known[key]


def _refusals(refused: list[tuple[Same, CalculatorError]]) -> Iterator[Observed]:
    """Ways of writing the structure down that nobody may fail on, and answers that are not numbers."""
    groups: dict[str, list[tuple[Same, CalculatorError]]] = {}
    for same, error in refused:
        if error.cause is None:
            groups.setdefault("NOT_FINITE", []).append((same, error))
        elif same.code in _MUST_ANSWER:
            groups.setdefault("FAILS", []).append((same, error))
    for code, group in groups.items():
        same, error = group[0]
        values = {"what": same.what, "why": error.message, "ways": len(group)}
        values["file"] = error.structure.name if error.structure else ""
        yield finding(code, "error", "rewritten", "saved" if error.structure else None, **values)


def _in_turns(ways: Iterable[Same]) -> list[Same]:
    """One of each kind, then another of each: a slow calculator is asked all kinds of questions."""
    seen: dict[str, int] = {}
    turns = []
    for same in ways:
        seen[same.code] = seen.get(same.code, -1) + 1
        turns.append((seen[same.code], same))
    return [same for _, same in sorted(turns, key=lambda one: one[0])]
