"""Atoms without a neighbor feel no force, and energies of parts far apart add up."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import numpy as np
from ase import Atoms

from mdnum.audit.base import AuditCheck, CalculatorError, CheckResult, Observed, Progress, finding
from mdnum.audit.noise import FEW, NoiseFloor, displaced, settled
from mdnum.audit.structures import molecules, nearest_distance, whole
from mdnum.audit.subject import CalculatorSubject, Forces, largest

#: Å between two parts that cannot feel one another, and a cell that does not repeat around them: some lists
#: take long over an empty one.
_FAR, _BOX = 60.0, 75.0
_CLUSTER = 12
_EPS = np.finfo(float).eps


class AloneCheck(AuditCheck):
    """Do atoms without neighbors feel nothing, and do energies of parts far apart add up?"""

    name, title, order, calls = "alone", "Atoms alone", 48, 240
    needed_to = ("run",)

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """Single atoms, and an atom far from a cluster."""
        with subject.meter.limited():
            atoms, noise = settled(subject.fresh(), np.random.default_rng(self.seed), at_least=FEW)
            alone = Alone(subject, atoms, noise)
        self.structures |= alone.structures
        found = list(alone.findings())
        values = {"parts": len(alone.rows), "far": _FAR}
        return CheckResult(
            says=([f"alone_{'wrong' if found else 'right' if alone.rows else 'none'}"], values),
            findings=found,
            tables={"Atoms alone": alone.rows},
            skipped=[(what, error.message) for what, error in alone.refused],
            asked=max(len(alone.rows), 1),
            possible=max(len(alone.rows), 1),
        )


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
        species = list(dict.fromkeys(atoms.symbols))
        single: dict[str, float] = {}
        for symbol, periodic in product(species, (False, True)):
            one = Atoms(symbol, positions=[[1.0, 2.0, 3.0]], cell=[2 * _FAR] * 3, pbc=periodic)
            what = f"one {symbol} atom{' in a large periodic cell' if periodic else ''}"
            energy = self._ask(what, one, single.get(symbol))
            if energy is not None:
                single.setdefault(symbol, energy)
        two = (species[0], species[-1])
        pair = Atoms(two, positions=[[1.0, 2.0, 3.0], [1.0 + _FAR, 2.0, 3.0]], cell=[_BOX] * 3)
        expected = single[two[0]] + single[two[1]] if set(two) <= set(single) else None
        self._ask(f"{two[0]} and {two[1]} {_FAR:g} Å apart", pair, expected)
        if two[0] != two[1] and two[0] in single:
            # who numbers species by what is there gives the last one other numbers without the first
            near = 1.0 + nearest_distance(atoms)
            both = Atoms([two[1]] * 2, positions=[[1.0, 2.0, 3.0], [near, 2.0, 3.0]], cell=[_BOX] * 3)
            energy = self._ask(f"two {two[1]} atoms", both, None, lambda forces: forces[:0])
            far = Atoms(two[0], positions=[[near + _FAR, 2.0, 3.0]], cell=[_BOX] * 3) + both
            expected = None if energy is None else energy + single[two[0]]
            self._ask(f"a {two[0]} atom {_FAR:g} Å from two {two[1]} atoms", far, expected, lambda f: f[:1])
        cluster = atoms[: min(len(atoms), _CLUSTER)]
        cluster.pbc = False
        cluster.positions += 1.0 - cluster.positions.min(axis=0)
        cluster.set_cell([_BOX + float(np.ptp(cluster.positions, axis=0).max())] * 3)
        near = subject.fresh().try_both(cluster)
        failed = isinstance(near, CalculatorError)
        # one that knows whole molecules alone takes nothing of which an atom is gone; one that fails on an
        # atom without neighbors may fail on the cluster, and takes the structure with a vacancy
        fewer = (atoms[:-1],) if failed else (cluster[:-1], atoms[:-1])
        self.takes_atoms = any(subject.fresh().answers(one) for one in fewer)
        if failed:
            self.refused.append((f"a cluster of {len(cluster)} atoms", near))
        elif self.takes_atoms:
            symbol = str(atoms.symbols[0])
            far = cluster + Atoms(symbol, positions=[cluster.positions.max(axis=0) + _FAR])
            expected = near[0] + single[symbol] if symbol in single else None
            what = f"a {symbol} atom {_FAR:g} Å from a cluster"
            self._ask(what, far, expected, lambda forces: forces[-1:])
        else:
            one = whole(atoms, molecules(atoms)[0])
            one.positions += [1.0, 2.0, 3.0]
            one.set_cell([_BOX] * 3)
            both, formula = one + displaced(one, np.array([_FAR, 0.0, 0.0])), one.get_chemical_formula()
            # within a molecule there are forces, on it as a whole there is none
            felt = lambda forces: forces.reshape(-1, len(one), 3).sum(axis=1)  # noqa: E731
            energy = self._ask(f"one {formula}", one, None, felt)
            self._ask(f"two {formula} {_FAR:g} Å apart", both, energy and 2 * energy, felt)

    def _ask(
        self,
        what: str,
        atoms: Atoms,
        expected: float | None,
        felt: Callable[[Forces], np.ndarray] = np.asarray,
    ) -> float | None:
        """The energy of a structure, of which note is taken; without an expected one, only of its force."""
        answer = self._subject.fresh().try_both(atoms)
        if isinstance(answer, CalculatorError):
            self.refused.append((what, answer))
            if answer.cause is None:
                self.structures["alone-failed"] = atoms
            return None
        energy, force = answer[0], largest(felt(answer[1]))
        expected = energy if expected is None else expected
        allowed = self._noise.louder(NoiseFloor(_EPS * abs(expected), _EPS)).allowed
        self.rows.append({
            "atoms": what, "energy (eV)": energy, "expected": expected, "force (eV/Å)": force,
            "adds up": abs(energy - expected) <= allowed.energy,
            "no force": force <= allowed.force,
        })  # fmt: skip
        return energy

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
