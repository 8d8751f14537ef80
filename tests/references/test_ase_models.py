"""ASE's classes with their conversions against the formulas in plain numpy, and those against differences."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.fd import calculate_numerical_forces, calculate_numerical_stress
from small_systems import make

from mdnum.references.ase_models import evaluate, independent, reference
from mdnum.references.independent import OnNeighborList, StillingerWeberModel, TersoffModel, pair_forms

CUTOFFS = ["hard", "shifted", "force-shifted", "switched", "quintic", "cosine"]
POTENTIALS = {
    "lennard-jones": {"sigma": 1.0, "epsilon": 1.0},
    "morse": {"depth": 1.3, "alpha": 5.0, "r0": 1.1},
    "soft-sphere": {"sigma": 2.6, "epsilon": 2.0, "alpha": 2.5},
}
WITH_A_CLASS = {
    ("lennard-jones", "hard"),
    ("lennard-jones", "shifted"),
    ("lennard-jones", "switched"),
    ("morse", "hard"),
    ("morse", "shifted"),
    ("morse", "quintic"),
}


def crystal(repeat: int = 3) -> Atoms:
    atoms = bulk("Ar", "fcc", a=1.7, cubic=True) * (repeat, repeat, repeat)
    atoms.rattle(0.05, seed=2)
    return atoms


@pytest.mark.parametrize("cutoff", CUTOFFS)
@pytest.mark.parametrize("kind", POTENTIALS)
def test_every_pair_potential_and_cutoff(kind: str, cutoff: str):
    atoms = crystal()
    system = make(atoms, {"kind": kind, **POTENTIALS[kind]}, {"kind": cutoff, "radius": 2.5})
    judge = reference(system)
    assert judge.is_ase == ((kind, cutoff) in WITH_A_CLASS)
    assert judge.is_ase == judge.label.startswith("ASE")
    theirs, mine = evaluate(judge.make(), atoms), evaluate(independent(system).make(), atoms)
    assert theirs["energy"] == pytest.approx(mine["energy"], rel=1e-13)
    np.testing.assert_allclose(
        theirs["forces"], mine["forces"], atol=1e-12 * np.abs(mine["forces"]).max() + 1e-13
    )
    np.testing.assert_allclose(theirs["stress"], mine["stress"], atol=1e-12 * np.abs(mine["stress"]).max())
    np.testing.assert_allclose(theirs["energies"].sum(), theirs["energy"], rtol=1e-13)


@pytest.mark.parametrize("cutoff", CUTOFFS)
@pytest.mark.parametrize("kind", POTENTIALS)
def test_slopes_are_derivatives(kind: str, cutoff: str):
    """The judge's own u' against central differences of its u."""
    system = make(
        crystal(2), {"kind": kind, **POTENTIALS[kind]}, {"kind": cutoff, "radius": 2.5, **_onset(cutoff)}
    )
    form = pair_forms(system.spec, ("Ar",))["Ar", "Ar"]
    r = np.linspace(0.95, 2.499, 200)
    step = 1e-6
    slope = (form(r + step)[0] - form(r - step)[0]) / (2 * step)
    np.testing.assert_allclose(form(r)[1], slope, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(
    ("cutoff", "energy", "slope"),
    [("hard", 1, 1), ("shifted", 0, 1), ("force-shifted", 0, 0), ("switched", 0, 0)],
)
def test_what_is_left_at_the_cutoff(cutoff: str, energy: int, slope: int):
    system = make(
        crystal(2), {"kind": "lennard-jones", **POTENTIALS["lennard-jones"]}, {"kind": cutoff, "radius": 2.5}
    )
    form = pair_forms(system.spec, ("Ar",))["Ar", "Ar"]
    bare, cut = form.bare(np.array([2.5])), form(np.array([2.5]))
    np.testing.assert_allclose(cut[0], energy * bare[0], atol=1e-16)
    np.testing.assert_allclose(cut[1], slope * bare[1], atol=1e-15)


def _onset(cutoff: str) -> dict:
    return {"onset": 2.0} if cutoff in ("switched", "quintic", "cosine") else {}


@pytest.mark.parametrize("cutoff", ["hard", "shifted", "switched"])
def test_mixtures_as_sums_over_species(cutoff: str):
    """Kob-Andersen: three sets of constants out of a class that has one."""
    atoms = crystal()
    atoms.symbols[:] = "Ni"
    atoms.symbols[::5] = "P"
    pairs = {
        "Ni-Ni": {"sigma": 1.0, "epsilon": 1.0},
        "P-Ni": {"sigma": 0.8, "epsilon": 1.5},
        "P-P": {"sigma": 0.88, "epsilon": 0.5},
    }
    system = make(atoms, {"kind": "lennard-jones", "pairs": pairs}, {"kind": cutoff, "in_sigma": 2.5})
    forms = pair_forms(system.spec, system.species)
    assert forms["Ni", "P"].r_cut == 2.0 == forms["P", "Ni"].r_cut
    judge = reference(system)
    assert judge.is_ase
    theirs, mine = evaluate(judge.make(), atoms), evaluate(independent(system).make(), atoms)
    assert theirs["energy"] == pytest.approx(mine["energy"], rel=1e-13)
    np.testing.assert_allclose(theirs["forces"], mine["forces"], atol=1e-12 * np.abs(mine["forces"]).max())


def test_the_conversion_matters():
    """Without it, hard and ASE differ by u(r_cut) a pair: far more than any tolerance here."""
    atoms = crystal()
    hard, shifted = (
        evaluate(
            reference(make(atoms, {"kind": "lennard-jones", **POTENTIALS["lennard-jones"]}, cutoff)).make(),
            atoms,
        )
        for cutoff in ({"kind": "hard", "radius": 2.5}, {"kind": "shifted", "radius": 2.5})
    )
    assert abs(hard["energy"] / shifted["energy"] - 1) > 0.05
    np.testing.assert_array_equal(hard["forces"], shifted["forces"])


def test_moving_atoms_reach_the_wrapped_calculator():
    atoms = crystal(2)
    system = make(
        atoms, {"kind": "lennard-jones", **POTENTIALS["lennard-jones"]}, {"kind": "hard", "radius": 1.6}
    )
    calculator = reference(system).make()
    first = evaluate(calculator, atoms)["energy"]
    atoms.positions[0] += 0.1
    assert evaluate(calculator, atoms)["energy"] != first
    assert evaluate(calculator, atoms)["energy"] == evaluate(reference(system).make(), atoms)["energy"]


def silicon(seed: int = 1) -> Atoms:
    atoms = bulk("Si", "diamond", a=5.43, cubic=True) * (2, 2, 2)
    atoms.rattle(0.15, seed=seed)
    return atoms


def test_tersoff_in_numpy_is_ase_tersoff():
    """Two implementations from one paper; jax-md's is the third."""
    system = make(silicon(), {"kind": "tersoff"}, units="metal")
    judge = reference(system)
    assert judge.label == "ASE Tersoff"
    theirs, mine = evaluate(judge.make(), system.atoms), evaluate(independent(system).make(), system.atoms)
    assert mine["energy"] == pytest.approx(theirs["energy"], rel=1e-14)
    np.testing.assert_allclose(
        mine["forces"], theirs["forces"], atol=1e-14 * 64 * np.abs(theirs["forces"]).max()
    )
    np.testing.assert_allclose(mine["stress"], theirs["stress"], atol=1e-14)


@pytest.mark.parametrize(
    ("model", "lattice_constant", "energy"),
    [(TersoffModel(), 5.432, -4.6297), (StillingerWeberModel(), 5.431, -4.3366)],
)
def test_cohesive_energies_of_the_papers(model, lattice_constant: float, energy: float):
    atoms = bulk("Si", "diamond", a=lattice_constant, cubic=True) * (2, 2, 2)
    found = evaluate(OnNeighborList(model), atoms)
    assert found["energy"] / len(atoms) == pytest.approx(energy, abs=5e-5)
    assert np.abs(found["forces"]).max() < 1e-12
    assert np.abs(found["stress"]).max() < 1e-4  # the lattice constant has four digits


@pytest.mark.parametrize("model", [TersoffModel(), TersoffModel(lambda3=0.0), StillingerWeberModel()])
def test_many_body_gradients_are_derivatives(model):
    atoms = silicon()
    atoms.calc = OnNeighborList(model)
    np.testing.assert_allclose(
        atoms.get_forces()[[0, 7]], calculate_numerical_forces(atoms, eps=1e-5, iatoms=[0, 7]), atol=2e-7
    )
    np.testing.assert_allclose(atoms.get_stress(), calculate_numerical_stress(atoms, eps=1e-5), atol=1e-8)
    np.testing.assert_allclose(atoms.get_potential_energies().sum(), atoms.get_potential_energy())


def test_tersoff_constants_are_those_of_ase():
    from ase.calculators.tersoff import TersoffParameters

    assert set(asdict(TersoffModel())) == set(TersoffParameters.__dataclass_fields__)
