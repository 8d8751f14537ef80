"""A short run at constant energy with ASE's velocity Verlet; molecules of rigid models keep their shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator, all_changes
from ase.md.velocitydistribution import MaxwellBoltzmannDistribution, Stationary
from ase.md.verlet import VelocityVerlet
from jaxtyping import Float, Int

from mdnum.audit.noise import direction, displaced
from mdnum.audit.subject import CalculatorSubject
from mdnum.audit.transformations import group

#: Steps in the period of the fastest vibration.
_STEPS_A_PERIOD = 40
#: Å that the fastest atom of a thermal run may cover in a step.
_FURTHEST = 0.06
_POWER_ITERATIONS = 10
#: Kinetic over initial kinetic energy from which a run has blown up.
_BLOWN_UP = 1e3
#: Of the thermal force of the stiffest spring: below, atoms are in their places.
_RELAXED = 0.2
_MOST_SWEEPS = 500
#: Relative to a squared length, and of a momentum to the largest.
_TOLERANCE = 1e-13


class _Bridge(Calculator):
    """The calculator under audit as an ASE calculator, so that a failure saves its structure."""

    implemented_properties = ["energy", "forces"]  # noqa: RUF012

    def __init__(self, subject: CalculatorSubject):
        super().__init__()
        self.subject = subject

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        super().calculate(atoms, properties or ["energy"], system_changes)
        there = cast(Atoms, self.atoms)
        self.results = {"energy": self.subject.energy(there), "forces": self.subject.forces(there)}


@dataclass(frozen=True)
class NveRun:
    """A run at constant energy.

    Attributes:
        timestep: internal time (length * sqrt(mass / energy)).
        potential, kinetic: of every step, eV.
        positions: never wrapped, Å.
        forces: of the calculator, without those of constraints, eV/Å.
        blown_up: whether it was stopped because the atoms flew apart.
    """

    timestep: float
    potential: Float[np.ndarray, "steps"]
    kinetic: Float[np.ndarray, "steps"]
    positions: Float[np.ndarray, "steps atoms 3"]
    forces: Float[np.ndarray, "steps atoms 3"]
    blown_up: bool

    @property
    def total(self) -> Float[np.ndarray, "steps"]:
        """Energy of every step, eV."""
        return self.potential + self.kinetic

    @property
    def time(self) -> Float[np.ndarray, "steps"]:
        """Internal time of every step."""
        return self.timestep * np.arange(len(self.potential))


def prepared(
    subject: CalculatorSubject,
    atoms: Atoms,
    held: RigidGroups | None,
    period: float,
    rng: np.random.Generator,
) -> Atoms:
    """A structure with thermal velocities, held together where it must be.

    Args:
        held: molecules that keep their shape.
        period: of the fastest vibration, internal time.
        rng: draws the velocities.
    """
    from ase import units

    # atoms at rest in their places take half of the kinetic energy into vibrations
    thermal = np.sqrt(subject.kT * float(np.mean(atoms.get_masses()))) * 2 * np.pi / period
    relaxed = float(np.sqrt(np.mean(subject.forces(atoms) ** 2))) < _RELAXED * thermal
    there = atoms.copy()
    if held is not None:
        there.set_constraint(held)
    kelvin = (2.0 if relaxed else 1.0) * subject.kT / units.kB
    MaxwellBoltzmannDistribution(there, temperature_K=kelvin, rng=rng)
    if len(there) > 1:
        Stationary(there)
    return there


def fitting_timestep(
    subject: CalculatorSubject, atoms: Atoms, rng: np.random.Generator
) -> tuple[float, float]:
    """A time step for a structure, internal time, and the period of its fastest vibration (inf for none).

    Args:
        subject: asked for some twenty forces.
        rng: starts the search for the fastest vibration.
    """
    roots = np.sqrt(atoms.get_masses())[:, None]
    mode = direction(len(atoms), rng)
    mode /= np.linalg.norm(mode)
    square = 0.0
    for _ in range(_POWER_ITERATIONS):
        # mass-weighted second derivative along the mode, by a central difference of forces
        step = mode / roots
        size = 1e-3 / np.max(np.abs(step))
        back, forth = (subject.forces(displaced(atoms, sign * size * step)) for sign in (-1, 1))
        answer = (back - forth) / (2 * size * roots)
        square = float(np.linalg.norm(answer))
        if square == 0.0:
            break
        mode = answer / square
    period = 2 * np.pi / np.sqrt(square) if square > 0 else float("inf")
    fastest = 4 * np.sqrt(subject.kT / float(np.min(atoms.get_masses())))
    return min(period / _STEPS_A_PERIOD, _FURTHEST / fastest if fastest else float("inf")), period


def run(
    subject: CalculatorSubject,
    start: Atoms,
    timestep: float,
    steps: int,
    each: Callable[[int], None] = lambda step: None,
) -> tuple[NveRun, Atoms]:
    """Run at constant energy with one calculator object.

    Args:
        start: with velocities and constraints; left as it is.
        timestep: internal time.
        each: called with the step reached.

    Returns:
        the run, and the structure with velocities at its end.
    """
    atoms = start.copy()
    atoms.set_constraint(start.constraints)
    atoms.calc = _Bridge(subject)
    dynamics = VelocityVerlet(atoms, timestep=timestep)
    rows: list[tuple[Any, ...]] = []
    limit = _BLOWN_UP * (atoms.get_kinetic_energy() + len(atoms) * subject.kT)
    blown_up = False
    for step in range(steps + 1):
        if step:
            dynamics.step()
        kinetic = atoms.get_kinetic_energy()
        forces = atoms.get_forces(apply_constraint=False)
        rows.append((atoms.get_potential_energy(), kinetic, atoms.get_positions(), forces))
        each(step)
        if kinetic > limit:
            blown_up = True
            break
    potential, kinetics, positions, forces = (
        np.array(column, np.float64) for column in zip(*rows, strict=True)
    )
    atoms.calc = None
    return NveRun(timestep, potential, kinetics, positions, forces, blown_up), atoms


def at(like: Atoms, positions: Float[np.ndarray, "atoms 3"]) -> Atoms:
    """The structure with its atoms somewhere else."""
    there = like.copy()
    there.set_constraint()
    there.positions = positions
    return there


@dataclass
class RigidGroups:
    """Distances within equal groups of atoms stay what they are: an ASE constraint.

    As ASE's FixBondLengths, which takes one bond at a time in Python; here one bond of every group at once,
    a hundred times faster for water.

    Attributes:
        first, second: atoms of each bond, a row for each bond of a group.
        lengths: Å.

    Source:
        H. C. Andersen, Rattle: a velocity version of the Shake algorithm, J. Comput. Phys. 52, 24 (1983).
    """

    first: Int[np.ndarray, "bonds groups"]
    second: Int[np.ndarray, "bonds groups"]
    lengths: Float[np.ndarray, "bonds groups"]

    def get_removed_dof(self, atoms: Atoms) -> int:
        """Degrees of freedom that are gone."""
        return int(self.first.size)

    def adjust_positions(self, atoms: Atoms, new: Float[np.ndarray, "atoms 3"]) -> None:
        """Move atoms along their bonds until all lengths are right."""
        old, share = atoms.positions, 1 / atoms.get_masses()
        for _ in range(_MOST_SWEEPS):
            worst = 0.0
            for i, j, length in zip(self.first, self.second, self.lengths, strict=True):
                before, now = old[i] - old[j], new[i] - new[j]
                off = np.sum(now**2, axis=1) - length**2
                pull = off / (2 * (share[i] + share[j]) * np.sum(before * now, axis=1))
                new[i] -= (pull * share[i])[:, None] * before
                new[j] += (pull * share[j])[:, None] * before
                worst = max(worst, float(np.max(np.abs(off) / length**2)))
            if worst < _TOLERANCE:
                return

    def adjust_momenta(self, atoms: Atoms, momenta: Float[np.ndarray, "atoms 3"]) -> None:
        """Take out what would stretch a bond."""
        share = 1 / atoms.get_masses()
        size = float(np.max(np.abs(momenta), initial=0.0)) * float(np.max(share))
        for _ in range(_MOST_SWEEPS):
            worst = 0.0
            for i, j in zip(self.first, self.second, strict=True):
                bond = atoms.positions[i] - atoms.positions[j]
                apart = momenta[i] * share[i][:, None] - momenta[j] * share[j][:, None]
                along = np.sum(apart * bond, axis=1)
                pull = along / ((share[i] + share[j]) * np.sum(bond**2, axis=1))
                momenta[i] -= pull[:, None] * bond
                momenta[j] += pull[:, None] * bond
                worst = max(worst, float(np.max(np.abs(along) / np.linalg.norm(bond, axis=1))))
            if worst <= _TOLERANCE * size:
                return

    def adjust_forces(self, atoms: Atoms, forces: Float[np.ndarray, "atoms 3"]) -> None:
        """Nothing: a run adjusts momenta instead."""

    def todict(self) -> dict[str, Any]:
        """As ASE's own constraints describe themselves."""
        return {"name": "RigidGroups", "kwargs": {}}


def rigid_bonds(atoms: Atoms) -> Int[np.ndarray, "groups bonds 2"]:
    """All pairs within the groups of atoms that the order of species repeats: water in rigid models."""
    size = group(atoms)
    if size is None:
        return np.zeros((0, 0, 2), np.int64)
    first, second = np.triu_indices(size, 1)
    starts = np.arange(0, len(atoms), size)[:, None]
    return np.stack([starts + first, starts + second], axis=2)


def rigid(atoms: Atoms) -> RigidGroups | None:
    """The constraint that holds the groups of a structure; None where species do not repeat in groups."""
    bonds = rigid_bonds(atoms)
    if not bonds.size:
        return None
    first, second = bonds[:, :, 0].T, bonds[:, :, 1].T
    lengths = np.linalg.norm(atoms.positions[first] - atoms.positions[second], axis=2)
    return RigidGroups(first, second, lengths)
