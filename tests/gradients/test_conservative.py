"""Forward over reverse for any energy, against the closed forms of pairs and against differences."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from ase.build import bulk
from gradient_problems import everything
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError
from mdnum.gradients.forces import EnergyFunction, with_potential
from mdnum.gradients.parameters import names, value
from mdnum.gradients.problem import Problem
from mdnum.gradients.recorded import EventAware, Forward, Symmetric
from mdnum.gradients.unrolled import Unrolled
from mdnum.md.jaxmd import neighbor_vectors
from mdnum.systems import build

ONSET, RADIUS = 1.8, 2.2


def lennard_jones(parameters, positions, neighbor, cell):
    """A switched Lennard-Jones energy, written by somebody who knows nothing of this package."""
    d = neighbor_vectors(positions, neighbor.idx, cell, (True, True, True))
    real = neighbor.idx < positions.shape[0]
    r = jnp.sqrt(jnp.where(real, jnp.sum(d * d, axis=-1), 1.0))
    s6 = (parameters["size"] / r) ** 6
    t = jnp.clip((r - ONSET) / (RADIUS - ONSET), 0.0, 1.0)
    smooth = 1 - 10 * t**3 + 15 * t**4 - 6 * t**5
    inside = real & (r < RADIUS)
    return 0.5 * jnp.sum(jnp.where(inside, 4 * parameters["depths"][0] * (s6 * s6 - s6) * smooth, 0.0))


@pytest.fixture(scope="module")
def both():
    """One system with the package's own pair potential, and with the same energy as a function."""
    pairs = build(make(crystal(), LENNARD_JONES, {"kind": "quintic", "radius": RADIUS, "onset": ONSET}))
    parameters = {"size": jnp.asarray(1.0), "depths": jnp.asarray([1.0])}
    function = with_potential(pairs, EnergyFunction(parameters, lennard_jones, RADIUS))
    return [Problem(one, everything(one.atoms), 40) for one in (pairs, function)]


@pytest.mark.slow
def test_any_energy_has_the_derivatives_of_the_closed_forms(both):
    of_pairs, of_function = both
    assert "potential.parameters.size" in names(of_function.simulation)
    shared = ("timestep", "temperature", "scale", "x0", "v0")
    theirs = Symmetric()(of_pairs, ("sigma", "epsilon", *shared))
    ours = Symmetric()(of_function, ("size", "potential.parameters.depths", *shared))
    assert ours.value == pytest.approx(theirs.value, rel=1e-9)
    expected = dict(theirs.gradient)
    expected["potential.parameters.size"] = expected.pop("potential.sigma")
    expected["potential.parameters.depths"] = expected.pop("potential.epsilon").reshape(1)
    assert expected.keys() == ours.gradient.keys()
    for name, one in expected.items():
        # two programs, that have grown apart by rounding for 40 steps
        assert np.max(np.abs(ours.gradient[name] - one)) <= 1e-9 * np.max(np.abs(one)), name


@pytest.mark.slow
def test_tangents_of_any_energy_agree_with_its_reverse_pass(both):
    by_numbers = [name for name in names(both[1].simulation) if not name.startswith("initial.")]
    ours, theirs = Forward()(both[1], by_numbers), Symmetric()(both[1], by_numbers)
    for name, one in theirs.gradient.items():
        assert ours.gradient[name] == pytest.approx(one, rel=1e-9), name


def test_flips_of_any_energy_are_refused(both):
    with pytest.raises(InputError, match="pair potentials"):
        EventAware()(both[1], ("x0",))


@pytest.fixture(scope="module")
def silicon():
    atoms = bulk("Si", cubic=True) * (2, 2, 2)
    atoms.rattle(0.05, seed=1)
    dynamics = {"kind": "nve", "timestep": 0.001, "temperature": 600.0, "seed": 1}
    system = make(
        atoms, {"kind": "stillinger-weber"}, units="metal", dynamics=dynamics, neighbors={"skin": 0.2}
    )
    simulation = build(system)
    return Problem(simulation, everything(simulation.atoms), 12)


@pytest.mark.slow
def test_silicon_has_the_derivatives_of_differences_and_of_jax(silicon):
    found = Symmetric()(silicon, names(silicon.simulation))
    by_jax = Unrolled()(silicon, names(silicon.simulation))
    for name, one in found.gradient.items():
        assert np.max(np.abs(by_jax.gradient[name] - one)) <= 1e-9 * np.max(np.abs(one)), name
    # constants are compiled in, so that each value is another program
    for name in ("potential.sigma", "box.scale"):
        here = float(value(silicon.simulation, name))
        low, high = (silicon.value({name: here * (1 + q)}) for q in (-1e-5, 1e-5))
        assert float(found.gradient[name]) == pytest.approx((high - low) / (2e-5 * here), rel=1e-5), name
