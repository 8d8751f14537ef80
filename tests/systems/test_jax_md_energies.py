"""jax-md's potentials of many bodies as energy functions, against code that shares nothing with them."""

from __future__ import annotations

import io
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from ase.build import bulk
from ase.calculators.eam import EAM
from ase.geometry import get_distances
from scipy.interpolate import CubicSpline

import mdnum
from mdnum.md import jaxmd, tetrahedral
from mdnum.md.jaxmd import scalar
from mdnum.references.independent import OnNeighborList, StillingerWeberModel
from mdnum.systems.load import shipped_folder

pytestmark = [pytest.mark.nightly, pytest.mark.jax_md]
TERSOFF = {
    "mTf": 3.0, "gamma": 1.0, "lam3": 1.7322, "cTf": 1.0039e5, "dTf": 16.218, "hTf": -0.59826, "nTf": 0.78734,
    "beta": 1.0999e-6, "lam2": 1.7322, "B": 471.18, "R": 2.85, "D": 0.15, "lam1": 2.4799, "A": 1830.8,
}  # fmt: skip
TABLE = shipped_folder() / "copper/cu.eam.alloy"


def crystal(symbol: str, lattice: str, a: float, repeat: int = 2):
    atoms = bulk(symbol, lattice, a=a, cubic=True) * repeat
    atoms.rattle(0.1, seed=4)
    return atoms


def through_the_door(make, atoms, r_cut: float, alone: bool = False, **more: Any):
    side = atoms.cell.lengths()[0]
    space = jaxmd.upstream().space.periodic_general(jnp.eye(3) * side, fractional_coordinates=False)[0]
    with jaxmd.standard_promotion():
        made = make(space, scalar(side), fractional_coordinates=False, dr_threshold=scalar(0.3), **more)
    given = mdnum.energy_function(made[1] if alone else made, r_cut)
    return mdnum.simulation(atoms, given, timestep=0.001, skin=0.3)


def test_stillinger_weber_has_the_numbers_of_numpy():
    atoms, names = crystal("Si", "diamond", 5.431), ("sigma", "A", "B", "lam", "gamma", "epsilon", "cutoff")
    values = (2.0951, 7.049556277, 0.6022245584, 21.0, 1.2, 2.1683, 3.77118)
    given = {name: scalar(value) for name, value in zip(names, values, strict=True)}
    made = jaxmd.upstream().energy.stillinger_weber_neighbor_list
    one = through_the_door(made, atoms, 3.77118, **given)
    atoms.calc = OnNeighborList(StillingerWeberModel(tetrahedral.named("stillinger-weber")))
    found = one.evaluate()
    # jax-md rounds a constant to float32
    assert found.energy == pytest.approx(atoms.get_potential_energy(), rel=1e-8)
    np.testing.assert_allclose(found.forces, atoms.get_forces(), rtol=0, atol=1e-6)
    assert one.model.smoothness.order >= 0


def test_tersoff_has_the_numbers_of_mdnums_own():
    atoms, made = crystal("Si", "diamond", 5.431), jaxmd.upstream().energy.tersoff_neighbor_list
    found = through_the_door(made, atoms, 3.0, params=[TERSOFF]).evaluate()
    own = mdnum.simulation(atoms, tetrahedral.named("tersoff"), timestep=0.001, skin=0.3).evaluate()
    # jax-md rounds the constants to float32
    assert found.energy == pytest.approx(own.energy, rel=1e-7)
    np.testing.assert_allclose(found.forces, own.forces, rtol=0, atol=1e-6)


def tables(end: float) -> tuple[str, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The shipped file for jax-md, its tables truncated; embedding, density and pair tables, distances."""
    eam = EAM(potential=str(TABLE))
    r, rho = np.arange(eam.nr) * eam.dr, np.arange(eam.nrho) * eam.drho
    kept = r <= end
    embedded, density = eam.embedded_energy[0](rho), eam.electron_density[0](r)[kept]
    pair = np.append(eam.phi[0, 0](r[1]), eam.phi[0, 0](r[1:]))[kept]
    numbers = [*embedded, *density, *(pair * r[kept])]
    sizes = f"{eam.nrho} {eam.drho!r} {kept.sum()} {eam.dr!r} {end}"
    head = ["setfl", "", "", "1 Cu", sizes, "29 63.546 3.615 fcc"]
    return "\n".join([*head, *(f"{one:.17g}" for one in numbers), ""]), rho, embedded, density, pair


@pytest.mark.parametrize(("end", "alone"), [(5.5, False), (3.7, True)])
def test_an_eam_table_has_the_numbers_of_splines_wherever_it_ends(end: float, alone: bool):
    text, rho, embedded, density, pair = tables(end)
    atoms, energy = crystal("Cu", "fcc", 3.615, 4), jaxmd.upstream().energy
    # a little shorter than the table: the list decides
    r_cut = end - 0.05
    with jaxmd.standard_promotion():
        charge, embedding, pairwise, _ = energy.load_lammps_eam_parameters(io.StringIO(text))
    one = through_the_door(
        energy.eam_neighbor_list, atoms, r_cut, alone, charge_fn=charge, embedding_fn=embedding,
        pairwise_fn=pairwise, cutoff=scalar(end),
    )  # fmt: skip
    r = get_distances(atoms.positions, cell=atoms.cell, pbc=True)[1]
    inside, step = (r > 0) & (r < r_cut), EAM(potential=str(TABLE)).dr
    at = np.arange(len(density)) * step
    listed = [np.where(inside, CubicSpline(at, table)(r), 0.0) for table in (density, pair)]
    # jax-md's own list has each atom as its own neighbor, and counts its density
    of_itself = 0.0 if alone else density[0]
    charges = listed[0].sum(axis=1) + of_itself
    expected = np.sum(CubicSpline(rho, embedded)(charges)) + 0.5 * np.sum(listed[1])
    # jax-md rounds tables to float32
    assert one.evaluate().energy == pytest.approx(expected, rel=1e-5)
    notes = dict(one.model.notes)
    assert ("COUNTS_ITSELF" in notes) == (not alone)
    if end < 4:
        assert "ENERGY_JUMPS" in notes and one.imposable and np.isnan(one.model.smoothness.energy_jump)
