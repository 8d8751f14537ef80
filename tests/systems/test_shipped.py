"""The shipped systems: all there, each what its name and description promise."""

from __future__ import annotations

import numpy as np
import pytest
from ase.neighborlist import neighbor_list

from mdnum import systems
from mdnum.md.cell import Cell
from mdnum.systems import load
from mdnum.systems.ball import remarks


# which there are, and how large they are, is a record of `mdnum systems list`
@pytest.mark.parametrize("name", systems.names("ball"))
def test_each_ball_loads_with_variants_and_a_gradient_to_show(name: str):
    system = load(name)
    assert system.name == name and len(system.spec.about) > 100
    assert system.variants and system.spec.gradient.of and len(system.spec.gradient.methods) > 1
    assert not list(remarks(system.spec))


@pytest.mark.parametrize("name", systems.names("md"))
def test_each_loads_fits_its_box_and_has_the_temperature_of_its_file(name: str):
    system = load(name)
    assert system.name == name and len(system.spec.about) > 40 and system.spec.dynamics.steps >= 1000
    assert (
        system.r_cut + system.spec.skin <= Cell.create(system.atoms.cell, system.atoms.pbc).widths.min() / 2
    )
    temperature = system.spec.dynamics.temperature
    if not system.atoms.has("momenta") or temperature == 0:
        # drawn from the seed at the start of a run, or a pair with speeds of its own
        assert not system.atoms.has("momenta") or len(system.atoms) == 2
        return
    masses = system.atoms.get_masses()
    kinetic = (masses[:, None] * system.atoms.get_velocities() ** 2).sum()
    assert np.abs(masses @ system.atoms.get_velocities()).max() < 1e-10 * np.sqrt(kinetic)
    assert kinetic / (3 * (len(masses) - 1) * system.units.k_B) == pytest.approx(temperature, rel=1e-10)


@pytest.mark.parametrize(
    ("name", "shell", "neighbors", "width"),
    [("argon/crystal-500", 5, 24, 0.4), ("argon/crystal-108", 2, 6, 0.15)],
)
def test_a_shell_of_the_crystal_sits_at_its_cutoff(name: str, shell: int, neighbors: int, width: float):
    system = load(name)
    r, d = system.r_cut, neighbor_list("d", system.atoms, system.r_cut + width)
    assert (d >= r - width).sum() / len(system.atoms) == pytest.approx(neighbors, abs=0.5)
    lattice_constant = (4 / (len(system.atoms) / system.atoms.get_volume())) ** (1 / 3)
    assert r == pytest.approx(lattice_constant * np.sqrt(shell / 2), rel=1e-14)
    # thermal motion puts some of the shell on either side
    inside = ((d >= r - width) & (d < r)).sum() / len(system.atoms)
    assert 0.2 * neighbors < inside < 0.8 * neighbors


def test_the_tilted_box_has_no_right_angle_and_rahmans_liquid_his_density():
    assert np.abs(load("argon/tilted-500").atoms.cell.angles() - 90).min() > 2
    atoms = load("argon/liquid-864").atoms
    # 1.374 g/cm³, in amu and Å: the number Rahman gives for the box of 10.229 sigma
    assert atoms.get_masses().sum() * 1.66053907 / atoms.get_volume() == pytest.approx(1.374, rel=0.02)


@pytest.mark.parametrize(
    "name", ["argon/liquid-864", "argon/langevin-500", "binary/kob-andersen-1000", "lj/liquid-npt-500"]
)
def test_liquids_are_liquid(name: str):
    # a crystal's structure factor at its lattice vectors is of the order of the number of atoms
    atoms = load(name).atoms
    scaled = atoms.get_scaled_positions()
    largest = 0.0
    for h in np.ndindex(21, 21, 21):
        if any(h):
            largest = max(largest, abs(np.exp(2j * np.pi * scaled @ np.array(h)).sum()) ** 2 / len(atoms))
    assert largest < 0.1 * len(atoms)


def test_the_particle_leaves_its_well_with_the_slope_of_the_description():
    system = load("pair/leaving-well")
    masses = system.atoms.get_masses()
    reduced = masses.prod() / masses.sum()
    r0 = system.atoms.get_distance(0, 1)
    v0 = float(np.linalg.norm(system.atoms.get_velocities()[1] - system.atoms.get_velocities()[0]))
    assert (reduced, v0) == (1.0, 1.0)

    def energy(r: float) -> float:
        return 4 * (r**-12 - r**-6)

    slope = 4 * (6 * r0**-7 - 12 * r0**-13)
    speed = np.sqrt(v0**2 + 2 * (energy(r0) - energy(system.r_cut)))
    assert r0 < system.r_cut
    assert slope / speed == pytest.approx(0.411400, abs=1e-6)
    assert speed * system.spec.dynamics.steps * system.spec.dynamics.timestep > system.r_cut - r0
