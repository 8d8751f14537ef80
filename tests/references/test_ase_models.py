"""ASE's classes with their conversions against the formulas in plain numpy, and those against differences."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.fd import calculate_numerical_forces, calculate_numerical_stress
from small_systems import KOB_ANDERSEN, make

from mdnum.md.tetrahedral import named
from mdnum.references.adapted import evaluate
from mdnum.references.ase_models import independent, reference
from mdnum.references.independent import OnNeighborList, StillingerWeberModel, TersoffModel, pair_forms
from mdnum.systems.build import model_of

CUTOFFS = ["hard", "shifted", "force-shifted", "switched", "quintic", "cosine"]
POTENTIALS = {
    "lennard-jones": {"kind": "lennard-jones", "sigma": 1.0, "epsilon": 1.0},
    "morse": {"kind": "morse", "depth": 1.3, "alpha": 5.0, "r0": 1.1},
    "soft-sphere": {"kind": "soft-sphere", "sigma": 2.6, "epsilon": 2.0, "alpha": 2.5},
}
LJ = POTENTIALS["lennard-jones"]
WITH_A_CLASS = {
    *(("lennard-jones", cutoff) for cutoff in ("hard", "shifted", "switched")),
    *(("morse", cutoff) for cutoff in ("hard", "shifted", "quintic")),
}


def crystal(repeat: int = 3) -> Atoms:
    atoms = bulk("Ar", "fcc", a=1.7, cubic=True) * (repeat, repeat, repeat)
    atoms.rattle(0.05, seed=2)
    return atoms


def silicon() -> Atoms:
    atoms = bulk("Si", "diamond", a=5.43, cubic=True) * (2, 2, 2)
    atoms.rattle(0.15, seed=1)
    return atoms


def agree(system) -> None:
    """ASE's class, where there is one, and plain numpy."""
    judges = reference(system), independent(system)
    theirs, mine = (evaluate(judge.make(), system.atoms) for judge in judges)
    assert theirs["energy"] == pytest.approx(mine["energy"], rel=1e-13)
    for name in ("forces", "stress"):
        tolerance = 1e-12 * np.abs(mine[name]).max() + 1e-13
        np.testing.assert_allclose(theirs[name], mine[name], atol=tolerance)
    np.testing.assert_allclose(theirs["energies"].sum(), theirs["energy"], rtol=1e-13)


def forms_of(system):
    model = model_of(system.spec, system.atoms, system.folder)
    return pair_forms(model, system.species, system.spec.cutoff.compare)


@pytest.mark.parametrize("cutoff", CUTOFFS)
@pytest.mark.parametrize("kind", POTENTIALS)
def test_every_pair_potential_and_cutoff(kind: str, cutoff: str):
    """Two implementations agree; and the judge's own u' is the derivative of its u (by differences)."""
    system = make(crystal(), POTENTIALS[kind], {"kind": cutoff, "radius": 2.5})
    judge = reference(system)
    assert judge.is_ase == ((kind, cutoff) in WITH_A_CLASS) == judge.label.startswith("ASE")
    agree(system)
    onset = {"onset": 2.0} if cutoff in ("switched", "quintic", "cosine") else {}
    system = make(crystal(2), POTENTIALS[kind], {"kind": cutoff, "radius": 2.5, **onset})
    form, step = forms_of(system)["Ar", "Ar"], 1e-6
    r = np.linspace(0.95, 2.499, 200)
    slope = (form(r + step)[0] - form(r - step)[0]) / (2 * step)
    np.testing.assert_allclose(form(r)[1], slope, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("cutoff", ["hard", "shifted", "switched"])
def test_mixtures_as_sums_over_species(cutoff: str):
    """Kob-Andersen: three sets of constants out of a class that has one."""
    atoms = crystal()
    atoms.symbols[:] = "Ni"
    atoms.symbols[::5] = "P"
    system = make(atoms, KOB_ANDERSEN, {"kind": cutoff, "in_sigma": 2.5})
    forms = forms_of(system)
    assert forms["Ni", "P"].r_cut == 2.0 == forms["P", "Ni"].r_cut
    assert reference(system).is_ase
    agree(system)


def test_the_conversion_matters_and_moving_atoms_reach_the_wrapped_calculator():
    """Without it, hard and ASE differ by u(r_cut) a pair: far more than any tolerance here."""
    atoms = crystal()
    cutoffs = ({"kind": kind, "radius": 2.5} for kind in ("hard", "shifted"))
    hard, shifted = (reference(make(atoms, LJ, cutoff)).make() for cutoff in cutoffs)
    first, other = evaluate(hard, atoms), evaluate(shifted, atoms)
    assert abs(first["energy"] / other["energy"] - 1) > 0.05
    np.testing.assert_array_equal(first["forces"], other["forces"])
    atoms.positions[0] += 0.1
    fresh = reference(make(atoms, LJ, {"kind": "hard", "radius": 2.5})).make()
    assert first["energy"] != evaluate(hard, atoms)["energy"] == evaluate(fresh, atoms)["energy"]


def test_tersoff_in_numpy_is_ase_tersoff():
    """Two implementations from one paper; jax-md's is the third."""
    system = make(silicon(), {"kind": "tersoff"}, units="metal")
    assert reference(system).label == "ASE Tersoff"
    agree(system)


@pytest.mark.parametrize(
    ("model", "lattice_constant", "energy"),
    [
        (TersoffModel(named("tersoff")), 5.432, -4.6297),
        (StillingerWeberModel(named("stillinger-weber")), 5.431, -4.3366),
    ],
)
def test_cohesive_energies_of_the_papers(model, lattice_constant: float, energy: float):
    atoms = bulk("Si", "diamond", a=lattice_constant, cubic=True) * (2, 2, 2)
    found = evaluate(OnNeighborList(model), atoms)
    assert found["energy"] / len(atoms) == pytest.approx(energy, abs=5e-5)
    assert np.abs(found["forces"]).max() < 1e-12
    assert np.abs(found["stress"]).max() < 1e-4  # the lattice constant has four digits


@pytest.mark.parametrize(
    "model",
    [
        TersoffModel(named("tersoff")),
        TersoffModel(named("tersoff", "Si-1989")),
        StillingerWeberModel(named("stillinger-weber")),
    ],
)
def test_many_body_gradients_are_derivatives(model):
    atoms = silicon()
    atoms.calc = OnNeighborList(model)
    numerical = calculate_numerical_forces(atoms, eps=1e-5, iatoms=[0, 7])
    np.testing.assert_allclose(atoms.get_forces()[[0, 7]], numerical, atol=2e-7)
    np.testing.assert_allclose(atoms.get_stress(), calculate_numerical_stress(atoms, eps=1e-5), atol=1e-8)
    np.testing.assert_allclose(atoms.get_potential_energies().sum(), atoms.get_potential_energy())
