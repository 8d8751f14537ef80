"""Mistakes that others reported, in a potential and structures that the audit was not written with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import ase.build
import numpy as np
import pytest
from ase import Atoms
from ase.calculators.calculator import Calculator, all_changes
from ase.neighborlist import neighbor_list

import mdnum


class Pair(Calculator):
    """A Lennard-Jones pair that a quintic switch ends at 6 Å."""

    implemented_properties = ["energy", "forces", "free_energy"]  # noqa: RUF012
    rc, ron, epsilon, sigma = 6.0, 4.8, 0.05, 2.4

    def pairs(self, atoms: Atoms) -> tuple[np.ndarray, ...]:
        return neighbor_list("ijdD", atoms, self.rc)

    def law(self, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = (self.sigma / r) ** 6
        u, du = 4 * self.epsilon * (q * q - q), 4 * self.epsilon * (-12 * q * q + 6 * q) / r
        x, width = np.clip((r - self.ron) / (self.rc - self.ron), 0, 1), self.rc - self.ron
        s, ds = 1 - x**3 * (10 - 15 * x + 6 * x * x), -30 * x * x * (1 - x) ** 2 / width
        return u * s, du * s + u * ds

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        i, _, d, D = self.pairs(self.atoms)
        u, du = self.law(d)
        forces = np.zeros((len(self.atoms), 3))
        np.add.at(forces, i, (du / d)[:, None] * D)
        self.results = {"energy": self.total(u / 2), "forces": self.pushed(forces)}
        self.results["free_energy"] = self.results["energy"]

    def total(self, energies: np.ndarray) -> float:
        return float(energies.sum())

    def pushed(self, forces: np.ndarray) -> np.ndarray:
        return forces


class FirstWithoutForce(Pair):
    def pushed(self, forces):
        return np.concatenate([np.zeros((1, 3)), forces[1:]])


class EveryEighthHalved(Pair):
    def pushed(self, forces):
        forces[::8] *= 0.5
        return forces


class HalfPrecisionForces(Pair):
    def pushed(self, forces):
        return forces.astype(np.float16).astype(float)


class OfAnotherEnergy(Pair):
    def pushed(self, forces):
        return 0.97 * forces


class Whirling(Pair):
    def pushed(self, forces):
        return forces + 0.01 * np.cross(forces, [0, 0, 1.0])


class SinglePrecisionSum(Pair):
    """From the last pair to the first, and not from the first to the last."""

    def total(self, energies):
        return float(np.cumsum(energies[::-1].astype(np.float32), dtype=np.float32)[-1])


class AllAxesOrNone(Pair):
    def pairs(self, atoms):
        atoms = atoms.copy()
        atoms.pbc = bool(atoms.pbc.all())
        return super().pairs(atoms)


class FirstAxisForAll(Pair):
    def pairs(self, atoms):
        atoms = atoms.copy()
        atoms.pbc = bool(atoms.pbc[0]) and atoms.cell.rank == 3
        return super().pairs(atoms)


class AnyCellRepeats(Pair):
    def pairs(self, atoms):
        atoms = atoms.copy()
        atoms.pbc = atoms.cell.rank == 3
        return super().pairs(atoms)


class ByObject(Pair):
    """Answers again without looking where it is given the same object."""

    seen: Any = None

    def get_property(self, name, atoms=None, allow_calculation=True):
        if self.seen is not None and atoms is self.seen and name in self.results:
            return self.results[name]
        self.seen = atoms
        return super().get_property(name, atoms, allow_calculation)


class OneBuffer(Pair):
    kept: dict[int, np.ndarray] = {}  # noqa: RUF012

    def pushed(self, forces):
        buffer = self.kept.setdefault(len(forces), forces)
        buffer[:] = forces
        return buffer

    def get_property(self, name, atoms=None, allow_calculation=True):
        # without the copy that ASE's own class makes
        super().get_property(name, atoms, allow_calculation)
        return self.results[name]


class Reseeding(Pair):
    def pushed(self, forces):
        np.random.seed(42)  # noqa: NPY002
        return forces


class OtherHand(Pair):
    """The third vector of a left-handed cell is turned round, the atoms are not."""

    def pairs(self, atoms):
        cell = atoms.cell.array.copy()
        if np.linalg.det(cell) < 0:
            fractions = np.linalg.solve(cell.T, atoms.positions.T).T
            atoms, cell[2] = atoms.copy(), -cell[2]
            atoms.set_cell(cell)
            atoms.positions = fractions @ cell
        return super().pairs(atoms)


def copper() -> Atoms:
    atoms = ase.build.bulk("Cu", cubic=True) * (3, 2, 2)
    atoms.rattle(0.05, seed=3)
    return atoms


def slab() -> Atoms:
    atoms = ase.build.fcc111("Al", (3, 3, 3), vacuum=7.0)
    atoms.rattle(0.05, seed=3)
    return atoms


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("kind", "checks", "named"),
    [
        (Pair, "forces,curl,caller,periodicity,invariance", set()),
        (FirstWithoutForce, "forces,invariance", {"FORCES_NOT_GRADIENT", "PLACE_IN_LIST"}),
        (EveryEighthHalved, "forces,invariance", {"FORCES_NOT_GRADIENT", "PLACE_IN_LIST"}),
        (HalfPrecisionForces, "forces", {"QUANTIZED", "LOW_PRECISION", "FORCES_LOW_PRECISION"}),
        (OfAnotherEnergy, "forces,curl", {"FORCES_NOT_GRADIENT"}),
        (Whirling, "forces,curl", {"FORCES_NOT_GRADIENT"}),
        (AllAxesOrNone, "periodicity", {"MIXED_PERIODICITY"}),
        (FirstAxisForAll, "periodicity", {"MIXED_PERIODICITY"}),
        (AnyCellRepeats, "periodicity,invariance", {"MIXED_PERIODICITY", "DUMMY_CELL"}),
        (ByObject, "caller", {"CHANGE_NOT_SEEN", "REUSED_BUFFER"}),
        (OneBuffer, "caller", {"REUSED_BUFFER"}),
        (Reseeding, "caller", {"RANDOM_SEEDED"}),
        (OtherHand, "invariance", {"LEFT_HANDED"}),
    ],
    ids=lambda one: one.__name__ if isinstance(one, type) else "",
)
@pytest.mark.parametrize("structure", [copper, slab], ids=["crystal", "slab"])
def test_a_mistake_is_named_in_other_systems(kind, checks, named, structure, tmp_path: Path):
    if structure is slab and "periodicity" not in checks:
        pytest.skip("of the crystal alone")
    outcome = mdnum.audit_calculator(
        kind, structure(), checks=checks.split(","), out=tmp_path / "audit", report=False
    )
    heads = {one.code for one in outcome.verdict.findings if not one.cause and one.severity != "info"}
    # named, and nothing beside it: all heads are among those that say what it is
    assert heads <= named and bool(heads) == bool(named), outcome.verdict.headline
    assert "NEIGHBOR_CAP_BY_ORDER" not in {one.code for one in outcome.verdict.findings}


@pytest.mark.nightly
@pytest.mark.parametrize("copies", [1, 5])
def test_a_sum_in_single_precision_has_one_answer_at_both_sizes(copies: int, tmp_path: Path):
    outcome = mdnum.audit_calculator(
        SinglePrecisionSum, copper() * (copies, 1, 1), checks=["forces", "invariance"],
        out=tmp_path / "audit", report=False,
    )  # fmt: skip
    codes = {one.code for one in outcome.verdict.findings}
    assert codes & {"LOW_PRECISION", "NOISE_FLOOR"} and not codes & {"FORCES_NOT_GRADIENT", "EXTENSIVE"}
    assert "error" not in {one.severity for one in outcome.verdict.findings}
