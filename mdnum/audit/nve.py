"""A short run at constant energy with ASE's velocity Verlet, and the work its forces did on the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator, all_changes
from ase.md.velocitydistribution import MaxwellBoltzmannDistribution, Stationary
from ase.md.verlet import VelocityVerlet
from jaxtyping import Float

from mdnum.audit.base import Subject
from mdnum.audit.noise import direction, displaced
from mdnum.audit.rigid import RigidGroups

#: Steps in the period of the fastest vibration.
_STEPS_A_PERIOD = 40
#: Å that the fastest atom of a thermal run may cover in a step.
_FURTHEST = 0.06
_POWER_ITERATIONS = 10
#: Kinetic over initial kinetic energy from which a run has blown up.
_BLOWN_UP = 1e3
#: Of the thermal force of the stiffest spring: below, atoms are in their places.
_RELAXED = 0.2


class _Bridge(Calculator):
    """The calculator under audit as an ASE calculator, so that a failure saves its structure."""

    implemented_properties = ["energy", "forces"]  # noqa: RUF012

    def __init__(self, subject: Subject):
        super().__init__()
        self.subject = subject

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        super().calculate(atoms, properties or ["energy"], system_changes)
        there = cast(Atoms, self.atoms)
        self.results = {"energy": self.subject.energy(there), "forces": self.subject.forces(there)}


@dataclass(frozen=True)
class Run:
    """What a run was like.

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
    subject: Subject,
    atoms: Atoms,
    held: RigidGroups | None,
    period: float,
    rng: np.random.Generator,
) -> Atoms:
    """A structure with thermal velocities, held together where it must be.

    Args:
        subject: for its kT, and its forces.
        atoms: left as it is.
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


def fitting_timestep(subject: Subject, atoms: Atoms, rng: np.random.Generator) -> tuple[float, float]:
    """A time step for a structure, internal time, and the period of its fastest vibration (inf for none).

    Args:
        subject: asked for some twenty forces.
        atoms: where.
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
        change = subject.forces(displaced(atoms, -size * step)) - subject.forces(
            displaced(atoms, size * step)
        )
        answer = change / (2 * size * roots)
        square = float(np.linalg.norm(answer))
        if square == 0.0:
            break
        mode = answer / square
    period = 2 * np.pi / np.sqrt(square) if square > 0 else float("inf")
    fastest = 4 * np.sqrt(subject.kT / float(np.min(atoms.get_masses())))
    return min(period / _STEPS_A_PERIOD, _FURTHEST / fastest if fastest else float("inf")), period


def run(
    subject: Subject,
    start: Atoms,
    timestep: float,
    steps: int,
    each: Callable[[int], None] | None = None,
) -> tuple[Run, Atoms]:
    """Run at constant energy with one calculator object.

    Args:
        subject: asked at every step.
        start: with velocities and constraints; left as it is.
        timestep: internal time.
        steps: how many.
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
        rows.append(
            (
                atoms.get_potential_energy(), kinetic, atoms.get_positions(),
                atoms.get_forces(apply_constraint=False),
            )
        )  # fmt: skip
        if each is not None:
            each(step)
        if kinetic > limit:
            blown_up = True
            break
    potential, kinetics, positions, forces = (
        np.array(column, np.float64) for column in zip(*rows, strict=True)
    )
    atoms.calc = None
    return Run(timestep, potential, kinetics, positions, forces, blown_up), atoms


def at(like: Atoms, positions: Float[np.ndarray, "atoms 3"]) -> Atoms:
    """The structure with its atoms somewhere else."""
    there = like.copy()
    there.set_constraint()
    there.positions = positions
    return there
