"""Check that the force on isolated atoms is zero, and that the energies of distant fragments add up."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.base import AuditCheck, CalculatorError, CheckResult, Observed, Progress, finding
from mdnum.audit.noise import NoiseFloor, settled
from mdnum.audit.structures import molecules, nearest_distance, whole
from mdnum.audit.subject import CalculatorSubject, largest
from mdnum.units import ENERGY, FORCE, LENGTH, Measured

#: Distance (Å) between two groups that cannot interact, and size of a cell that does not repeat around them:
#: some lists are slow for large empty cells.
_FAR, _BOX = 60.0, 75.0
_AWAY = f"{_FAR:g} {LENGTH}"
_ENERGY, _FORCE = f"energy ({ENERGY})", f"force ({FORCE})"  # columns
_CLUSTER = 12
_EPS = np.finfo(float).eps


class AloneCheck(AuditCheck):
    """Is the force on atoms without neighbors zero, and do the energies of distant fragments add up?

    Attributes:
        rows: results, a row for each structure that the calculator supports.
        refused: structures on which the calculator failed, with the reason.
        takes_atoms: whether the calculator supports structures other than whole molecules.
    """

    name, title, order, calls = "alone", "Atoms alone", 48, 240
    needed_to = ("run",)

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """Evaluate single atoms, and an atom far away from a cluster."""
        with subject.meter.limited():
            self.look(subject, *settled(subject.fresh(), np.random.default_rng(self.seed)))
        found = list(self.findings())
        known = Measured(self.floor.force, "energy/length"), Measured(self.floor.energy, "energy")
        return CheckResult(
            says=(
                [f"alone_{'wrong' if found else 'right' if self.rows else 'none'}"],
                {"parts": len(self.rows), "far": _FAR, "force": known[0], "energy": known[1]},
            ),
            findings=found,
            tables={"Atoms alone": self.rows},
            skipped=[(what, error.message) for what, error in self.refused],
            asked=max(len(self.rows), 1),
            possible=max(len(self.rows), 1),
        )

    def look(self, subject: CalculatorSubject, atoms: Atoms, noise: NoiseFloor) -> None:
        """Evaluate parts of a structure, or whole molecules, with new calculator objects."""
        self.rows: list[dict[str, Any]] = []
        self.floor = noise.allowed
        self.refused: list[tuple[str, CalculatorError]] = []
        single: dict[str, float] = {}

        def energy(
            what: str, there: Atoms, expected: float | None = None, lone: slice = slice(None), size: int = 1
        ) -> float | None:
            """Record the energy of a structure, and the net force on each isolated group."""
            answer = subject.fresh().try_both(there)
            if isinstance(answer, CalculatorError):
                self.refused.append((what, answer))
                if answer.cause is None:
                    self.structures["alone-failed"] = there
                return None
            force = largest(answer[1].reshape(-1, size, 3).sum(axis=1)[lone])
            expected = answer[0] if expected is None else expected
            allowed = noise.louder(NoiseFloor(_EPS * abs(expected), _EPS)).allowed
            self.floor = self.floor.louder(allowed)
            self.rows.append({
                "atoms": what, _ENERGY: answer[0], "expected": expected, _FORCE: force,
                "adds up": abs(answer[0] - expected) <= allowed.energy, "no force": force <= allowed.force,
            })  # fmt: skip
            return answer[0]

        def total(*parts: float | None) -> float | None:
            known = [part for part in parts if part is not None]
            return sum(known) if len(known) == len(parts) else None

        species = list(dict.fromkeys(atoms.symbols))
        for symbol in species:
            for where, periodic in (("", False), (" in a large periodic cell", True)):
                one = Atoms(symbol, positions=[[1.0, 2.0, 3.0]], cell=[2 * _FAR] * 3, pbc=periodic)
                alone = energy(f"one {symbol} atom{where}", one, single.get(symbol))
                if alone is not None:
                    single.setdefault(symbol, alone)
        first, last = species[0], species[-1]
        sides = total(single.get(first), single.get(last))
        energy(f"{first} and {last} {_AWAY} apart", _apart(_boxed(Atoms(first)), Atoms(last)), sides)
        if first != last and first in single:
            # who numbers species by what is there gives the last one other numbers without the first
            two = _boxed(Atoms([last] * 2, [[0, 0, 0], [nearest_distance(atoms), 0, 0]]))
            together = total(energy(f"two {last} atoms", two, lone=slice(0)), single[first])
            what = f"one {first} atom {_AWAY} from two {last} atoms"
            energy(what, _apart(two, Atoms(first)), together, slice(2, None))
        cluster = _boxed(atoms[: min(len(atoms), _CLUSTER)])
        near = subject.fresh().try_both(cluster)
        failed = isinstance(near, CalculatorError)
        # one that knows whole molecules alone takes nothing of which an atom is gone; one that fails on an
        # atom without neighbors may fail on the cluster, and takes the structure with a vacancy
        fewer = (atoms[:-1],) if failed else (cluster[:-1], atoms[:-1])
        self.takes_atoms = any(subject.fresh().answers(one) for one in fewer)
        if failed:
            self.refused.append((f"a cluster of {len(cluster)} atoms", near))
        elif self.takes_atoms:
            both, what = _apart(cluster, Atoms(first)), f"one {first} atom {_AWAY} from a cluster"
            energy(what, both, total(near[0], single.get(first)), slice(-1, None))
        else:
            one = _boxed(whole(atoms, molecules(atoms)[0]))
            name, size = one.get_chemical_formula(), len(one)
            # within a molecule there are forces, on it as a whole there is none
            alone = energy(f"one {name}", one, size=size)
            energy(f"two {name} {_AWAY} apart", _apart(one, one), total(alone, alone), size=size)

    def findings(self) -> Iterator[Observed]:
        """Yield findings about the energies and forces of isolated atoms."""
        for what, why in [one for one in self.refused if one[1].cause is None][:1]:
            yield finding("LONELY_NOT_FINITE", "error", what=what, why=why.message)
        for what, why in [one for one in self.refused if one[1].cause is not None and self.takes_atoms][:1]:
            yield finding("LONELY_FAILS", "warning", what=what, why=why.message)
        if pushed := [row for row in self.rows if not row["no force"]]:
            worst = max(pushed, key=lambda row: row[_FORCE])
            yield finding("LONELY_FORCE", "error", what=worst["atoms"], force=worst[_FORCE])
        if apart := [row for row in self.rows if not row["adds up"]]:
            worst = max(apart, key=lambda row: abs(row[_ENERGY] - row["expected"]))
            energies = f"{worst[_ENERGY]:.10g}", f"{worst['expected']:.10g}"
            values = {"what": worst["atoms"], "energy": energies[0], "expected": energies[1], "far": _FAR}
            yield finding("LONELY_ENERGY", "warning", **values)


def _boxed(part: Atoms) -> Atoms:
    """Return a fragment of the structure in a nonperiodic cell."""
    there = Atoms(part.numbers, part.positions - part.positions.min(axis=0) + [1.0, 2.0, 3.0])
    there.set_cell([_BOX + float(np.ptp(there.positions, axis=0).max())] * 3)
    return there


def _apart(part: Atoms, other: Atoms) -> Atoms:
    """Return a structure of two fragments that are farther apart than the cutoff."""
    there = other.copy()
    there.positions += [part.positions[:, 0].max() + _FAR - there.positions[:, 0].min(), 2.0, 3.0]
    return part + there
