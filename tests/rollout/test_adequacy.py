"""The fastest vibration and what lies beyond a cutoff, against closed forms and a whole matrix."""

import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms
from small_systems import KOB_ANDERSEN, LENNARD_JONES, crystal, make, mixture

import mdnum
from mdnum.rollout.adequacy import beyond_cutoff, fastest_period
from mdnum.systems import build

HARD = {"kind": "hard", "radius": 2.2}


@pytest.mark.parametrize("masses", [(1.0, 1.0), (1.0, 9.0)])
@pytest.mark.parametrize("cutoff", [HARD, {"kind": "switched", "radius": 2.2, "onset": 2.0}])
def test_two_atoms_vibrate_with_the_curvature_of_their_bond(masses, cutoff):
    """At the minimum 2^(1/6) sigma the curvature is 72 / 2^(1/3); away from it there is nothing else."""
    bond = 2 ** (1 / 6)
    atoms = Atoms("Ar2", [[0, 0, 0], [bond, 0, 0]], masses=masses)
    simulation = build(make(atoms, LENNARD_JONES, cutoff))
    reduced = masses[0] * masses[1] / sum(masses)
    expected = 2 * np.pi * (reduced / (72 / 2 ** (1 / 3))) ** 0.5
    assert fastest_period(simulation, simulation.positions) == pytest.approx(expected, rel=1e-3)
    apart = np.array([[0, 0, 0], [2.5, 0, 0]])
    assert fastest_period(simulation, apart) is None


def test_a_crystals_fastest_vibration_is_the_highest_of_its_whole_matrix_of_force_constants():
    """Of unequal masses, with a hard cutoff that pairs sit next to, in single precision as well."""
    atoms = mixture()[::3]
    atoms.set_masses(np.where(atoms.symbols == "P", 0.3, 2.0))
    periods = []
    for precision in ({}, {"state": "float32", "force": "float32", "decision": "float32"}):
        system = make(atoms, KOB_ANDERSEN, {"kind": "hard", "in_sigma": 2.4}, precision=precision)
        simulation = build(system)
        periods.append(fastest_period(simulation, simulation.positions))
    smooth = simulation.with_policy().with_cutoff("quintic")
    x, n = simulation.positions, simulation.atoms
    matrix, move = np.zeros((3 * n, 3 * n)), 1e-5
    for row in range(3 * n):
        moved = [x + sign * move * np.eye(1, 3 * n, row).reshape(n, 3) for sign in (1, -1)]
        matrix[row] = np.subtract(*(smooth.evaluate(one, stress=False).forces.ravel() for one in moved))
    weight = np.repeat(simulation.masses, 3) ** -0.5
    highest = np.linalg.eigvalsh(-(matrix + matrix.T) / (4 * move) * np.outer(weight, weight))[-1]
    assert periods == pytest.approx([2 * np.pi / highest**0.5] * 2, rel=0.03)


def test_what_lies_beyond_the_cutoff_is_the_textbooks_integral():
    """Of one Lennard-Jones species and of a mixture; none of a slab, and of a potential that ends inside."""
    radius = 2.2

    def textbook(sigma, epsilon, radius, density):
        third, ninth = (sigma / radius) ** 3, (sigma / radius) ** 9
        energy = 8 / 3 * np.pi * density * epsilon * sigma**3 * (ninth / 3 - third)
        pressure = 16 / 3 * np.pi * density**2 * epsilon * sigma**3 * (2 * ninth / 3 - third)
        return np.array([energy, pressure])

    atoms = crystal()
    density = len(atoms) / atoms.get_volume()
    found = beyond_cutoff(build(make(atoms, LENNARD_JONES, HARD)))
    assert list(found.values()) == pytest.approx(textbook(1, 1, radius, density), rel=1e-9)
    mixed = mixture()
    share = {name: np.mean(mixed.symbols == name) for name in ("Ni", "P")}
    expected = np.zeros(2)
    for pair, constants in KOB_ANDERSEN["pairs"].items():
        a, b = pair.split("-")
        counted = share[a] * share[b] * (1 if a == b else 2)
        expected += counted * textbook(constants["sigma"], constants["epsilon"], radius, density)
    found = beyond_cutoff(build(make(mixed, KOB_ANDERSEN, HARD)))
    assert list(found.values()) == pytest.approx(expected, rel=1e-9)
    atoms.pbc = (True, True, False)
    assert beyond_cutoff(build(make(atoms, LENNARD_JONES, HARD))) is None
    soft = {"kind": "soft-sphere", "sigma": 1.2, "epsilon": 1.0, "alpha": 2.5}
    assert beyond_cutoff(build(make(crystal(), soft, {"kind": "hard", "radius": 1.2}))) is None


@pytest.mark.parametrize("power", [1, 2, 3, 4, 6])
def test_what_does_not_fall_off_has_no_energy_beyond_the_cutoff(power):
    def falling(r, strength):
        return strength / r**power

    atoms, radius = crystal(), 2.2
    falls = mdnum.PairFunction(falling, strength=0.7)
    simulation = mdnum.simulation(
        atoms, falls, mdnum.Cut("hard", radius), units="lj", timestep=0.002, skin=0.1
    )
    found = beyond_cutoff(simulation)
    if power <= 3:
        assert found is None
    else:
        density = len(atoms) / atoms.get_volume()
        expected = 2 * np.pi * density * 0.7 * radius ** (3 - power) / (power - 3)
        assert found["energy"] == pytest.approx(expected, rel=1e-6)
        assert found["pressure"] == pytest.approx(density * power / 3 * expected, rel=1e-6)
    # of a screened one it is a number
    screened = mdnum.PairFunction(lambda r, strength: strength * jnp.exp(-r / 0.8) / r, strength=0.7)
    made = mdnum.simulation(atoms, screened, mdnum.Cut("hard", radius), units="lj", timestep=0.002, skin=0.1)
    exact = 2 * np.pi * len(atoms) / atoms.get_volume() * 0.7 * 0.8 * (radius + 0.8) * np.exp(-radius / 0.8)
    assert beyond_cutoff(made)["energy"] == pytest.approx(exact, rel=1e-6)
