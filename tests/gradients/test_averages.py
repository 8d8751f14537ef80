"""Derivatives of averages: against numpy on the same states, and against integrals that no run enters."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ase import Atoms
from scipy.integrate import quad
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.gradients.averages import BoundaryTerm, Reweighting, frames
from mdnum.gradients.losses import MeanPotential, MeanPressure, MeanSquaredDisplacement
from mdnum.gradients.problem import Problem
from mdnum.gradients.tape import RunTape
from mdnum.md.integrators import KickDrift, Langevin, quantity
from mdnum.systems import build


def bath(temperature: float, timestep: float = 0.004) -> dict:
    """A Langevin thermostat."""
    return {"kind": "langevin", "timestep": timestep, "temperature": temperature, "friction": 1.0, "seed": 3}


def liquid(cutoff: dict):
    """108 atoms at the density of a liquid, hot."""
    atoms = crystal(lattice_constant=(4 / 0.8442) ** (1 / 3))
    return build(make(atoms, LENNARD_JONES, cutoff, dynamics=bath(1.44)))


def distances(x: np.ndarray, edge: float) -> np.ndarray:
    """Nearest images of all pairs in a cubic box."""
    d = x[:, :, None] - x[:, None, :]
    d -= edge * np.round(d / edge)
    return np.sqrt((d**2).sum(axis=0))[np.triu_indices(x.shape[1], 1)]


def lennard_jones(r):
    """In reduced units."""
    return 4 * (r**-12 - r**-6)


def quintic(r, onset, radius):
    """Lennard-Jones switched by 1 - 10 t³ + 15 t⁴ - 6 t⁵."""
    t = np.clip((r - onset) / (radius - onset), 0, 1)
    return lennard_jones(r) * (1 - 10 * t**3 + 15 * t**4 - 6 * t**5)


@pytest.mark.slow
def test_a_smooth_cutoff_has_no_boundary():
    simulation = liquid({"kind": "quintic", "radius": 2.2, "onset": 1.8})
    problem = Problem(simulation, MeanPotential(every=5), 40)
    found = BoundaryTerm()(problem, ("r_cut", "scale"))
    edge, h = float(simulation.cell.matrix[0][0]), 1e-5
    seen = [distances(x, edge) for x in frames(RunTape(simulation, problem.loss, 40), ()).x]

    def mean(radius, scale):
        return np.mean([quintic(r * scale, 1.8, radius).sum() for r in seen]) / simulation.atoms

    by_radius = (mean(2.2 + h, 1) - mean(2.2 - h, 1)) / (2 * h)
    by_scale = (mean(2.2, 1 + h) - mean(2.2, 1 - h)) / (2 * h)
    assert float(found.gradient["cutoff.radius"]) == pytest.approx(by_radius, rel=1e-7)
    assert float(found.gradient["box.scale"]) == pytest.approx(by_scale, rel=1e-7)
    assert found.details["boundary"] == {"cutoff.radius": 0.0, "box.scale": 0.0}


@pytest.mark.nightly
def test_hard_cutoffs_have_the_slopes_of_differences():
    """At the states of one run: pairs counted by numpy on either side of three radii."""
    simulation = liquid({"kind": "hard", "radius": 2.2})
    problem = Problem(simulation, MeanPotential(first=400, every=4), 4400)
    seen = frames(RunTape(simulation, problem.loss, problem.steps), ("cutoff.radius",))
    assert not np.any(seen.explicit["cutoff.radius"])
    edge = float(simulation.cell.matrix[0][0])
    found = [distances(x, edge) for x in seen.x]
    h = 0.03
    for radius in (1.5, 1.8, 2.2):
        other = liquid({"kind": "hard", "radius": radius})
        terms, details = BoundaryTerm().terms(other, seen, ("cutoff.radius",))
        near = [r[(r >= radius - h) & (r < radius + h)] for r in found]
        energies, width = lennard_jones(np.concatenate(near)), 2 * h * len(seen) * simulation.atoms
        slope, counting = energies.sum() / width, np.sqrt(np.square(energies).sum()) / width
        # another version of jax has another run, and so another sample of pairs near the radius
        error = details["error"]["cutoff.radius"]
        assert terms["cutoff.radius"].sum() == pytest.approx(slope, abs=2 * np.hypot(error, counting)), radius
        assert error < 0.03 * abs(slope)


def integral(edge: float, radius: float, sigma=1.0, epsilon=1.0, kT=1.0) -> float:
    """Mean energy of two atoms in a periodic box, half of it each, hard cutoff, by quadrature.

    Forces are those of the shifted energy, so states are met with its weight.
    """

    def u(r):
        return 4 * epsilon * ((sigma / r) ** 12 - (sigma / r) ** 6)

    def shell(r):
        return 4 * np.pi * r**2 * np.exp(-(u(r) - u(radius)) / kT)

    inside = quad(shell, 0.3, radius, limit=200)[0]
    energy = quad(lambda r: shell(r) * u(r), 0.3, radius, limit=200)[0]
    return energy / (inside + edge**3 - 4 / 3 * np.pi * radius**3) / 2


@pytest.fixture(scope="module")
def pair():
    """Two atoms with a hard cutoff and a thermostat, for a long time."""
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [1.2, 0, 0]], cell=[3.6] * 3, pbc=True, masses=[1.0, 1.0])
    cutoff = {"kind": "hard", "radius": 1.5}
    simulation = build(make(atoms, LENNARD_JONES, cutoff, dynamics=bath(1.0, 0.01), neighbors={"skin": 0.29}))
    return Problem(simulation, MeanPotential(every=5), 20_000)


@pytest.mark.nightly
def test_canonical_averages_have_the_derivatives_of_an_integral(pair):
    names = ("r_cut", "sigma", "epsilon", "temperature", "scale")
    found = Reweighting()(pair, names)
    at = {"edge": 3.6, "radius": 1.5, "sigma": 1.0, "epsilon": 1.0, "kT": 1.0}
    assert abs(found.value - integral(**at)) < 3 * found.details["standard error of the value"]
    words = {"radius": "cutoff.radius", "sigma": "potential.sigma", "epsilon": "potential.epsilon"}
    for word, name in (words | {"kT": "dynamics.temperature", "edge": "box.scale"}).items():
        h = 1e-4 * at[word]
        true = (integral(**at | {word: at[word] + h}) - integral(**at | {word: at[word] - h})) / (2 * h)
        # the box takes the distance between atoms with it, the integral's box does not: the same in the end
        true *= at["edge"] if word == "edge" else 1
        error = found.details["error"][name]
        assert abs(float(found.gradient[name]) - true) < 3 * error, name
        # attraction and repulsion nearly cancel in what sigma does
        assert name == "potential.sigma" or error < 0.5 * abs(true), name


def test_what_is_no_average_is_refused(pair):
    simulation = pair.simulation
    still = build(make(crystal(), LENNARD_JONES, {"kind": "hard", "radius": 2.2}))
    for method, problem, names, text in (
        (BoundaryTerm(), Problem(simulation, MeanSquaredDisplacement(), 9), ("r_cut",), "compares frames"),
        (BoundaryTerm(), pair, ("v0",), "nothing depends on initial.velocities"),
        (Reweighting(), Problem(still, MeanPressure(), 9), ("sigma",), "without a thermostat"),
        (Reweighting(), pair, ("friction",), "does not depend on dynamics.friction"),
    ):
        with pytest.raises(InputError, match=text):
            method(problem, names)


class OtherBath(KickDrift):
    """Langevin dynamics of another package, whose fields have names of their own."""

    name = "other-bath"
    friction: Any = quantity("rate")
    heat: Any = quantity("temperature")
    generator: Any = quantity("seed")

    def drift(self, x, v, masses, step, order):
        return Langevin(self.timestep, self.friction, self.heat, self.generator).drift(
            x, v, masses, step, order
        )


def test_any_noise_at_a_temperature_is_a_thermostat(pair):
    names, short = ("sigma", "temperature"), replace(pair, steps=400)
    bath = pair.simulation.integrator
    assert isinstance(bath, Langevin)
    other = OtherBath(bath.timestep, bath.friction, bath.kT, bath.key)
    made = replace(short, simulation=replace(short.simulation, integrator=other))
    own, theirs = (Reweighting()(one, names) for one in (short, made))
    assert own.value == theirs.value and own.gradient == theirs.gradient
    assert all(float(one) for one in own.gradient.values())
