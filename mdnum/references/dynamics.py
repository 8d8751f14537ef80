"""`mdnum check dynamics`: a stretch of NVE against ASE's VelocityVerlet, step by step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from ase import Atoms
from ase.md.verlet import VelocityVerlet

from mdnum.references.ase_models import Reference, independent, reference
from mdnum.references.energy import narrowest
from mdnum.references.findings import finding, plain
from mdnum.references.trajectory import trajectory
from mdnum.systems import System, build, schema

AGREEMENT = {"float64": 1e-9, "float32": 1e-2, "float16": 1e-1, "bfloat16": 1e-1}
"""Largest deviation of a position after 100 steps, in units of r_cut.

Rounding starts near 1e-16 (6e-8) and chaos multiplies it, by e³ per LJ time in a liquid; five orders of
magnitude are left for that. A wrong force or time step shows at 1e-6 or more within ten steps.
"""

_SUDDEN = 100.0  # growth of the deviation within one step that chaos cannot do


@dataclass(frozen=True)
class DynamicsReport:
    """Two trajectories from one start.

    Attributes:
        system: name.
        reference: whose forces ASE's VelocityVerlet used.
        is_ase: whether those were a class of ASE.
        precision: narrowest float type of mdnum's run.
        steps: steps taken.
        position: largest deviation of a coordinate at each step (length), from step 0.
        velocity: largest deviation of a velocity component at each step (length per internal time).
        energy: deviation of the potential energy at each step.
        growth: factor by which the position deviation grew per step over the second half.
        sudden: first step at which it grew a hundredfold at once, which a decision at a cutoff can do and
            chaos cannot; None where it did not.
        r_cut: unit of the tolerance.
        findings: what to look at.
        ok: within tolerance at the last step.
    """

    system: str
    reference: str
    is_ase: bool
    precision: str
    steps: int
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    energy: tuple[float, ...]
    growth: float
    sudden: int | None
    r_cut: float
    findings: tuple[dict[str, str], ...]
    ok: bool

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return plain(self)

    def rows(self) -> list[dict[str, Any]]:
        """A row for about ten of the steps."""
        shown = np.unique(np.linspace(0, self.steps, 11).round().astype(int))
        return [
            {
                "step": int(step),
                "position, largest": self.position[step],
                "velocity, largest": self.velocity[step],
                "energy": self.energy[step],
            }
            for step in shown
        ]


def check_dynamics(system: System, steps: int = 100, *, judge: Reference | None = None) -> DynamicsReport:
    """Compare a rollout with ASE's velocity Verlet, from the same positions and velocities.

    A Langevin system is run without its bath. A hard cutoff has the forces of ASE's shifted one, so the
    trajectories must agree although the energies have different zeros.

    Args:
        system: what to run.
        steps: how many steps.
        judge: whose forces; default ASE's class, or plain numpy where ASE has none or needs minutes.
    """
    system = _without_bath(system)
    judge = _forces(system) if judge is None else judge
    simulation = build(system)
    narrow = system.spec.precision.state == "float32"
    start = simulation.positions.astype(np.float32).astype(np.float64) if narrow else simulation.positions
    atoms = Atoms(
        numbers=system.atoms.numbers,
        positions=start,
        cell=system.atoms.cell,
        pbc=system.atoms.pbc,
        masses=simulation.masses,
    )
    atoms.set_velocities(simulation.velocities)
    atoms.calc = judge.make()
    integrator = VelocityVerlet(atoms, timestep=system.spec.dynamics.timestep * system.units.time_factor)

    position, velocity, energy = [], [], []
    for step, (x, v, potential) in enumerate(trajectory(simulation, steps)):
        if step:
            integrator.run(1)
        position.append(float(np.abs(x - atoms.positions).max()))
        velocity.append(float(np.abs(v - atoms.get_velocities()).max()))
        energy.append(abs(potential - float(atoms.get_potential_energy())))
    precision = narrowest(system)
    tolerance = AGREEMENT[precision] * simulation.r_cut
    ok = len(position) == steps + 1 and position[-1] <= tolerance
    sudden = _sudden(position, floor=1e-13 * simulation.r_cut if not narrow else 1e-5 * simulation.r_cut)
    return DynamicsReport(
        system.name,
        judge.label,
        judge.is_ase,
        precision,
        steps,
        tuple(position),
        tuple(velocity),
        tuple(energy),
        _growth(position),
        sudden,
        simulation.r_cut,
        tuple(_findings(position, sudden, ok, tolerance, judge)),
        ok,
    )


def _without_bath(system: System) -> System:
    dynamics = system.spec.dynamics
    if isinstance(dynamics, schema.NVETable):
        return system
    shared = dynamics.model_dump(exclude={"kind", "friction"})
    return replace(system, spec=system.spec.model_copy(update={"dynamics": schema.NVETable(kind="nve", **shared)}))


def _forces(system: System) -> Reference:
    """ASE's class where a step takes it a tenth of a second; Tersoff and sums over species take more."""
    judge = reference(system)
    slow = system.spec.potential.kind == "tersoff" or len(system.species) > 1
    return independent(system) if slow and system.spec.potential.kind != "eam" else judge


def _sudden(position: list[float], floor: float) -> int | None:
    for step in range(2, len(position)):
        if position[step] > _SUDDEN * max(position[step - 1], floor):
            return step
    return None


def _growth(position: list[float]) -> float:
    """Factor per step, from a line through log(deviation) over the second half."""
    tail = np.array(position[len(position) // 2 :])
    if len(tail) < 3 or not (tail > 0).all():
        return 1.0
    return float(np.exp(np.polyfit(np.arange(len(tail)), np.log(tail), 1)[0]))


def _findings(
    position: list[float], sudden: int | None, ok: bool, tolerance: float, judge: Reference
) -> list[dict[str, str]]:
    found = []
    if not ok:
        at = f" It grew a hundredfold at once at step {sudden}." if sudden is not None else ""
        found.append(
            finding(
                "dynamics-differ",
                "error",
                "the trajectory differs from ASE's",
                f"After {len(position) - 1} steps a coordinate is off by {position[-1]:.1e}; "
                f"{tolerance:.1e} is expected from rounding at most.{at}",
                "See `mdnum check energy` for the forces; a sudden step points to a decision at a cutoff"
                if sudden is not None
                else "See `mdnum check energy` for the forces; if they agree it is the integrator",
            )
        )
    if not judge.is_ase:
        found.append(
            finding(
                "not-ase",
                "info",
                "ASE's integrator on forces in plain numpy",
                "ASE has no class for this potential and cutoff, or one that would take minutes.",
            )
        )
    return found
