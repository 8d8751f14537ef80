"""Whether energy and forces depend on how a structure is written down."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit import transformations
from mdnum.audit.answer import Refusal, ask
from mdnum.audit.base import TIME_UP, Part, Progress, Subject, TimeUp, again, meter_of
from mdnum.audit.noise import Noise, along_a_line, louder, settled, under_jitter
from mdnum.audit.subject import CalculatorError
from mdnum.audit.transformations import Same
from mdnum.references.findings import finding

#: How many times the measured noise a difference may be: the largest of some hundred forces is seen, noise is
#: a standard deviation, and another order of summation scatters more than moving along a line.
_ALLOWED = 40.0
#: Of kT for the whole structure: a difference below is one of precision rather than of physics.
_SMALL = 1e-3

#: What it means that two ways of writing down one structure differ, and what to do: title, remedy.
_MEANING: Mapping[str, tuple[str, str]] = {
    "TRANSLATION": (
        "the answer depends on where the structure stands",
        "Use differences of positions only, and wrap them the same way everywhere.",
    ),
    "IMAGES": (
        "the answer depends on which image of an atom is given",
        "Wrap positions inside the calculator before pairs are searched, or search with shifts for atoms "
        "that are any number of boxes away.",
    ),
    "FACES": (
        "an atom on a face of the cell is treated otherwise than its image",
        "Look at how positions are wrapped: -tiny modulo L rounds to L itself, which is no cell of the "
        "search.",
    ),
    "ORDER": (
        "the answer depends on the order of the atoms",
        "Look for a limit on the number of neighbors (max_num_neighbors), which keeps those that come first, "
        "and for parameters that species get in the order in which they appear.",
    ),
    "CELL_ULP": (
        "the last bit of the cell changes the answer",
        "A pair is found or lost by rounding in the search or in a decision: compute both ends of a pair by "
        "the same arithmetic, and make the potential smooth at its cutoff.",
    ),
    "EXTENSIVE": (
        "a supercell is not the sum of its parts",
        "Look at cells shorter than two cutoffs: more images than the nearest one must be searched.",
    ),
    "NARROW_CELL": (
        "a cell narrower than two cutoffs is wrong",
        "Search as many images as the cutoff reaches, or refuse cells narrower than two cutoffs.",
    ),
    "LATTICE": (
        "the answer depends on the choice of lattice vectors",
        "Search images by the distance between planes of the cell, not by the length of its vectors.",
    ),
    "ROTATION": (
        "the answer depends on the orientation of the structure",
        "Where the model is not meant to be equivariant only approximately, look for a step that singles "
        "out an "
        "axis (a cell forced to be upper triangular, a grid).",
    ),
    "MIRROR": (
        "the answer tells a structure from its mirror image",
        "Where this is not meant, look at signs of cross products and of dihedral angles.",
    ),
    "DUMMY_CELL": (
        "a cell that does not repeat changes the answer",
        "Respect the periodicity of each axis: do not wrap along an axis that does not repeat, and do not "
        "take the cell's length for the extent of the search.",
    ),
}


#: Of other ways to write a structure down, those that a calculator for any cell has to take: it may know
#: rectangular cells alone, or molecules by the order of their atoms.
_MUST_ANSWER = ("TRANSLATION", "IMAGES", "FACES", "CELL_ULP", "EXTENSIVE")


@dataclass(frozen=True)
class _Difference:
    """What two ways of writing down one structure differ by, and may differ by."""

    same: Same
    energy: float
    force: float
    allowed_energy: float
    allowed_force: float
    jump_kT: float

    @property
    def agrees(self) -> bool:
        return self.energy <= self.allowed_energy and self.force <= self.allowed_force

    def row(self) -> dict[str, Any]:
        return {
            "the structure": self.same.what,
            "energy differs by": self.energy,
            "allowed": self.allowed_energy,
            "forces differ by": self.force,
            "allowed for forces": self.allowed_force,
            "same": self.agrees,
        }


@dataclass
class Invariance:
    """Energy and forces of one structure, written down in many ways.

    What may differ is measured: noise of the calculator along a line, and the largest change under random
    moves of the size of the rounding of coordinates. A transformation that the calculator refuses is told
    as left out. After a call, `structures` holds both ways of writing down wherever they were told apart.

    Args:
        seed: of shifts, orders and rotations.
    """

    name: str = "invariance"
    seed: int = 0
    structures: dict[str, Atoms] = field(default_factory=dict)

    def __call__(self, subject: Subject, progress: Progress | None = None) -> Part:
        """Ask it; see `Check`."""
        began = time.perf_counter()
        rng = np.random.default_rng(self.seed)
        worker = subject.fresh()
        atoms, noise = settled(worker, rng)
        differences: list[_Difference] = []
        refused: list[tuple[Same, CalculatorError]] = []
        ways = _in_turns(transformations.all_of(atoms, subject.atoms, rng))
        late: list[tuple[str, str]] = []
        judged = _Judge(subject, worker, atoms, noise, rng)
        for done, same in enumerate(ways):
            if progress is not None:
                progress(done, len(ways), {"phase": "invariance", "unit": "structures"})
            try:
                with meter_of(worker).limited():
                    differences.append(judged(same))
            except TimeUp:
                late.append((same.what, TIME_UP))
            except CalculatorError as error:
                if same.code == "NARROW_CELL" and error.cause is not None:
                    late.append((same.what, error.message))
                    judged.narrow_refused(same, error)
                else:
                    refused.append((same, error))
        if len(late) == len(ways) and late[0][1] == TIME_UP:
            raise TimeUp
        found = [*_refusals(refused), *self._findings(differences, judged, refused)]
        wrong = [one for one in differences if not one.agrees]
        return Part(
            name=self.name,
            title="Invariance",
            says=_says(differences, wrong, noise, len(refused)),
            findings=found,
            tables={"The same structure, written down otherwise": [one.row() for one in differences]},
            numbers={
                "ways": len(differences),
                "told_apart": len(wrong),
                "refused": len(refused),
                "noise_energy": noise.energy,
                "noise_force": noise.force,
                "largest": max((one.energy for one in differences), default=0.0),
                "largest_force": max((one.force for one in differences), default=0.0),
            },
            skipped=[*((same.what, error.message) for same, error in refused), *late],
            seconds=time.perf_counter() - began,
            asked=len(ways) - sum(why == TIME_UP for _, why in late),
            possible=len(ways),
        )

    def _findings(
        self, differences: list[_Difference], judged: _Judge, refused: list[tuple[Same, CalculatorError]]
    ) -> Iterator[dict[str, str]]:
        wrong: dict[str, list[_Difference]] = {}
        for one in differences:
            if not one.agrees:
                wrong.setdefault(one.same.code, []).append(one)
        wrong = self._explained(wrong, judged, refused)
        yield from judged.notes
        for code, group in wrong.items():
            worst = max(
                group, key=lambda one: one.energy / one.allowed_energy + one.force / one.allowed_force
            )
            title, remedy = _MEANING[code]
            tried = sum(one.same.code == code for one in differences)
            slug = code.lower().replace("_", "-")
            self.structures[f"{slug}-before"] = judged.before(worst.same)
            self.structures[f"{slug}-after"] = worst.same.atoms
            severity = "error" if worst.jump_kT > _SMALL or _large(worst, judged) else "warning"
            if code == "NARROW_CELL":
                severity = "warning"  # the structure itself is answered for as it should be
            yield finding(
                code,
                severity,
                title,
                f"With {worst.same.what} the energy differs by {worst.energy:.3g} eV ({worst.jump_kT:.2g} "
                "kT, "
                f"where rounding explains {worst.allowed_energy:.1g} eV) and a force by {worst.force:.3g} "
                "eV/Å "
                f"(rounding: {worst.allowed_force:.1g}). {len(group)} of {tried} such structures differ. "
                f"Both are saved as {slug}-before and {slug}-after.",
                remedy,
            )

    def _explained(
        self, wrong: dict[str, list[_Difference]], judged: _Judge, refused: list[tuple[Same, CalculatorError]]
    ) -> dict[str, list[_Difference]]:
        """Differences without those that belong to what the calculator is: a topology made from the order."""
        no_order = "ORDER" in wrong or any(same.code == "ORDER" for same, _ in refused)
        if not no_order:
            return wrong
        rng = np.random.default_rng(self.seed + 1)
        grouped = transformations.by_molecule(judged.atoms, rng)
        if grouped is None:
            return wrong
        try:
            if not judged(grouped).agrees:
                return wrong
        except CalculatorError:
            return wrong
        silent = wrong.get("ORDER", [])
        answered = ""
        if silent:
            worst = max(silent, key=lambda one: one.energy)
            answered = (
                f" Single atoms in another order are not refused: with {worst.same.what} the energy differs "
                f"by {worst.energy:.3g} eV and a force by {worst.force:.3g} eV/Å, without a word."
            )
        judged.notes.append(
            finding(
                "TOPOLOGY_BY_ORDER",
                "warning" if silent else "info",
                "molecules are told by the order of the atoms",
                f"{grouped.what[0].upper()}{grouped.what[1:]} change nothing, single atoms may not be moved."
                + answered,
                "Keep the atoms of a molecule together when a structure is written or sorted.",
            )
        )
        kept = {code: group for code, group in wrong.items() if code != "ORDER"}
        whole = transformations.images_by_molecule(judged.atoms, rng)
        if "IMAGES" not in kept or whole is None or not judged(whole).agrees:
            return kept
        worst = max(kept["IMAGES"], key=lambda one: one.energy)
        judged.notes.append(
            finding(
                "WHOLE_MOLECULES",
                "warning",
                "a molecule cut by a face of the cell has another energy",
                f"With {worst.same.what} the energy differs by {worst.energy:.3g} eV; when whole molecules "
                "are moved, by nothing.",
                "Make molecules whole before the calculator sees them: a wrapped trajectory is wrong for it.",
            )
        )
        # an atom on a face is cut from its molecule as well
        return {code: group for code, group in kept.items() if code not in ("IMAGES", "FACES")}


class _Judge:
    """Compares, and measures once for each size of rounding what a comparison may give."""

    def __init__(
        self, subject: Subject, worker: Subject, atoms: Atoms, noise: Noise, rng: np.random.Generator
    ):
        self.subject, self.worker, self.atoms, self.noise = subject, worker, atoms, noise
        self.notes: list[dict[str, str]] = []
        self._rng = rng
        self._known: dict[tuple[int, int], tuple[float, Any, Noise]] = {}
        self._bases: list[Atoms] = [atoms]
        self._answer: tuple[float, Any] = (0.0, None)

    def before(self, same: Same) -> Atoms:
        return self.atoms if same.before is None else same.before

    def __call__(self, same: Same) -> _Difference:
        base = self.before(same)
        energy, forces, allowed = self._reference(base, same.rounding)
        found = self._compared(self.worker, same, energy, forces, allowed)
        if not found.agrees:
            # another object, which has seen nothing else: what it remembers is another question
            other = self.subject.fresh()
            first, found = self._answer, self._compared(other, same, energy, forces, allowed)
            # who stands alone may have answered so by chance, and is asked again
            if found.agrees:
                again(self.worker, same.atoms, *first)
            else:
                again(self.worker if base is self.atoms else self.subject.fresh(), base, energy, forces)
        return found

    def narrow_refused(self, same: Same, error: CalculatorError) -> None:
        """Takes note of a calculator that takes four atoms in a wide cell only, which is safe."""
        if isinstance(ask(self.subject.fresh(), same.atoms), Refusal):
            return
        self.notes.append(
            finding(
                "NARROW_CELL_REFUSED",
                "info",
                "narrow cells are refused",
                f"Of {same.what}, the small one is not answered for: it {error.message}.",
                "Nothing to do: repeat a structure before it is asked about.",
            )
        )

    def _compared(
        self, worker: Subject, same: Same, energy: float, forces: Any, allowed: Noise
    ) -> _Difference:
        self._answer = worker.energy(same.atoms), worker.forces(same.atoms)
        expected = forces[same.order] @ same.turn.T
        force = float(np.max(np.abs(self._answer[1] - expected), initial=0.0))
        change = abs(self._answer[0] / same.copies - energy)
        return _Difference(
            same,
            change,
            force,
            allowed.energy,
            allowed.force,
            change / self.subject.kT if self.subject.kT else 0.0,
        )

    def _reference(self, base: Atoms, rounding: float) -> tuple[float, Any, Noise]:
        """Energy and forces of a structure, and what rounding of this size makes of them."""
        if not any(base is one for one in self._bases):
            self._bases.append(base)
        key = (next(n for n, one in enumerate(self._bases) if one is base), _power(rounding))
        if key not in self._known:
            worker = self.subject.fresh() if base is not self.atoms else self.worker
            if base is self.subject.atoms:
                # it may stand on a threshold, where any noise that is measured is the step that is looked for
                allowed = self._reference(self.atoms, rounding)[2]
            else:
                noise = self.noise
                if base is not self.atoms:
                    noise = louder(noise, along_a_line(worker, base, self._rng))
                if rounding:
                    noise = louder(noise, under_jitter(worker, base, 2.0 ** key[1], self._rng))
                allowed = Noise(_ALLOWED * noise.energy, _ALLOWED * noise.force)
            self._known[key] = worker.energy(base), worker.forces(base), allowed
        return self._known[key]


def _refusals(refused: list[tuple[Same, CalculatorError]]) -> Iterator[dict[str, str]]:
    """Ways of writing the structure down that nobody may fail on, and answers that are not numbers."""
    groups: dict[str, list[tuple[Same, CalculatorError]]] = {}
    for same, error in refused:
        if error.cause is None:
            groups.setdefault("NOT_FINITE", []).append((same, error))
        elif same.code in _MUST_ANSWER:
            groups.setdefault("FAILS", []).append((same, error))
    for code, group in groups.items():
        same, error = group[0]
        saved = f" The structure is saved as {error.structure.name}." if error.structure else ""
        yield finding(
            code,
            "error",
            "an answer is not a number"
            if code == "NOT_FINITE"
            else "the calculator fails on the structure when it is written down otherwise",
            f"With {same.what} it {error.message}. {len(group)} ways of writing the structure down end "
            f"so.{saved}",
            "Look at coordinates outside the cell and at its faces, and at distances of 0.",
        )


def _in_turns(ways: Iterable[Same]) -> list[Same]:
    """One of each kind, then another of each: a slow calculator is asked all kinds of questions."""
    seen: dict[str, int] = {}
    turns = []
    for same in ways:
        seen[same.code] = seen.get(same.code, -1) + 1
        turns.append((seen[same.code], same))
    return [same for _, same in sorted(turns, key=lambda one: one[0])]


def _power(size: float) -> int:
    return int(np.ceil(np.log2(size))) if size > 0 else -9999


def _large(one: _Difference, judged: _Judge) -> bool:
    """Whether forces differ by what matters to a trajectory rather than by a lower precision."""
    _, forces, _ = judged._reference(judged.before(one.same), one.same.rounding)
    return one.force > 1e-3 * float(np.sqrt(np.mean(forces**2)) + 1e-300)


def _says(differences: list[_Difference], wrong: list[_Difference], noise: Noise, refused: int) -> str:
    tail = f" {refused} were refused by the calculator." if refused else ""
    if not differences:
        return f"No other way of writing the structure down could be evaluated.{tail}"
    if wrong:
        worst = max(wrong, key=lambda one: one.energy)
        return (
            f"{len(wrong)} of {len(differences)} ways of writing the same structure down give another "
            f"answer, by up to {worst.energy:.3g} eV ({worst.same.what}) and "
            f"{max(one.force for one in wrong):.3g} eV/Å.{tail}"
        )
    return (
        f"{len(differences)} ways of writing the same structure down give the same answer, to within "
        f"{max(one.energy for one in differences):.1g} eV (noise of the energy: {noise.energy:.1g} eV).{tail}"
    )
