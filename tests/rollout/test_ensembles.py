"""Thermostats and barostats against ASE's, step by step, and against loops written from the papers."""

from __future__ import annotations

from typing import Any

import ase.build
import numpy as np
import pytest
from ase.md.nose_hoover_chain import MTKNPT, IsotropicMTKNPT, NoseHooverChainNVT
from ase.units import kB

import mdnum
from mdnum.references.calculator import MdnumCalculator
from mdnum.rollout.engine import Engine, unwrapped

ARGON = mdnum.LennardJones(sigma=3.405, epsilon=0.0103235)
CUT = mdnum.Cut("quintic", 6.0)
TAU: dict[str, Any] = {"relaxation": 0.1}
BOX = TAU | {"pressure_relaxation": 0.3}
SOFT = BOX | {"compressibility": 2.0}
#: Each integrator, with its numbers.
KINDS = {
    "nose-hoover": ("nose-hoover", TAU),
    "csvr": ("csvr", TAU),
    "mtk": ("mtk", BOX),
    "mtk full": ("mtk", BOX | {"box": "full"}),
    "cell-rescaling": ("cell-rescaling", SOFT),
    "cell-rescaling full": ("cell-rescaling", SOFT | {"box": "full"}),
}


def fluid(repeat: int = 3, seed: int = 1, tilt: float = 0.0):
    """108 argon atoms, some of them moving."""
    atoms = ase.build.bulk("Ar", "fcc", a=5.4, cubic=True).repeat(repeat)
    atoms.set_cell(atoms.cell.array @ (np.eye(3) + tilt * np.eye(3, k=1)), scale_atoms=True)
    random = np.random.default_rng(seed)
    atoms.positions += 0.1 * random.standard_normal(atoms.positions.shape)
    spread = np.sqrt(kB * 90 * atoms.get_masses())[:, None]
    atoms.set_momenta(spread * random.standard_normal((len(atoms), 3)))
    return atoms


def held(kind: str, atoms=None, timestep: float = 0.004, **options: Any) -> mdnum.Simulation:
    """The fluid under one of `KINDS`, from objects."""
    name, numbers = KINDS[kind]
    pressure = {"pressure": 0.01} if "pressure_relaxation" in numbers else {}
    given = {"temperature": 90.0, "seed": 3, "skin": 0.6, "dynamics": numbers} | pressure | options
    atoms = fluid() if atoms is None else atoms
    return mdnum.simulation(atoms, ARGON, CUT, timestep=timestep, integrator=name, **given)


def rows(simulation: mdnum.Simulation, steps: int) -> dict[str, np.ndarray]:
    """Numbers of each step, with positions as if the box had no faces."""
    made: dict[str, list[Any]] = {}
    for segment in Engine(simulation, steps).segments():
        for row in range(segment.rows):
            matrix = np.asarray(segment.cell_of(row).matrix)
            x = unwrapped(matrix, segment.unsorted("x", row), segment.unsorted("images", row))
            values = {"x": x, "v": segment.unsorted("v", row), "box": matrix}
            for name in ("potential", "kinetic", "heat", "work", "virial"):
                values[name] = float(segment.rows_of(name)[row])
            for name, value in values.items():
                made.setdefault(name, []).append(value)
    out = {name: np.array(values) for name, values in made.items()}
    return out | {"conserved": out["potential"] + out["kinetic"] - out["heat"] - out["work"]}


def by_ase(kind: str, simulation: mdnum.Simulation, atoms, steps: int):
    """The same in ASE, with the degrees of freedom that its box has and the same inertia of its chain."""
    units, own = simulation.units, simulation.integrator
    atoms.calc = MdnumCalculator(potential=ARGON, cutoff=CUT)
    given: dict[str, Any] = {"timestep": float(own.timestep), "temperature_K": 90.0}
    given["tdamp"] = 0.1 * units.time_factor
    if kind == "nose-hoover":
        dynamics: Any = NoseHooverChainNVT(atoms, **given)
    else:
        given |= {"pressure_au": 0.01 / units.pressure_factor, "pdamp": 0.3 * units.time_factor}
        dynamics = (MTKNPT if "full" in kind else IsotropicMTKNPT)(atoms, **given)
        own_box = 6 if "full" in kind else 1
        dynamics._barostat._cell_dof = own_box
        dynamics._barostat._R[0] = own_box * kB * 90.0 * given["pdamp"] ** 2
    for step in range(steps + 1):
        if step:
            dynamics.step()
        v = atoms.get_velocities()
        yield atoms.positions, v, atoms.cell.array, dynamics.get_conserved_energy()


@pytest.mark.parametrize("kind", ["nose-hoover", "mtk", "mtk full"])
def test_each_step_is_that_of_ase(kind):
    """With a total momentum and 3 N degrees of freedom, as ASE counts them."""
    atoms = fluid(tilt=0.05 * (kind == "mtk full"))
    simulation = held(kind, atoms, remove_drift=False)
    made = rows(simulation, 50)
    for step, (x, v, box, conserved) in enumerate(by_ase(kind, simulation, atoms, 50)):
        away = made["x"][step] - made["x"][0] @ np.linalg.solve(made["box"][0], made["box"][step])
        theirs = x - fluid(tilt=0.05 * (kind == "mtk full")).positions @ np.linalg.solve(made["box"][0], box)
        assert np.abs(away - theirs).max() < 1e-9, step
        assert np.abs(made["v"][step] - v).max() < 1e-11 and np.abs(made["box"][step] - box).max() < 1e-9
        ours = made["conserved"][step] - made["conserved"][0]
        first = conserved if step == 0 else first
        assert ours == pytest.approx(conserved - first, abs=1e-9), step
    if kind != "nose-hoover":
        assert np.abs(made["box"][-1] - made["box"][0]).max() > 0.01
