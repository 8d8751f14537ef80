"""mdnum as an ASE calculator, used by ASE's own tools."""

from __future__ import annotations

import numpy as np
import pytest
from ase.build import bulk
from ase.calculators.fd import calculate_numerical_stress
from ase.cluster import Icosahedron
from ase.eos import EquationOfState
from ase.filters import FrechetCellFilter
from ase.optimize import BFGS, FIRE
from small_systems import LENNARD_JONES, crystal, make

from mdnum.errors import InputError, NumericalError
from mdnum.references import MdnumCalculator
from mdnum.references.adapted import evaluate
from mdnum.references.ase_models import reference
from mdnum.systems import build

SWITCHED = {"kind": "switched", "radius": 2.2, "onset": 1.8}
#: Of the lattice, near that of zero stress: lists of one length serve all tests.
NEAR = 1.57
WIDE = {"kind": "hard", "radius": 50.0}


def argon(cutoff=SWITCHED) -> MdnumCalculator:
    return MdnumCalculator(potential=LENNARD_JONES, cutoff=cutoff, units="lj")


def test_energy_forces_and_stress_are_those_of_ase_and_of_strain():
    atoms = crystal(lattice_constant=NEAR)
    tilt = np.array([[0, 0, 0], [0.2, 0, 0], [0.1, -0.15, 0]])
    atoms.set_cell(np.array(atoms.cell) + tilt, scale_atoms=True)
    atoms.calc = argon()
    theirs = evaluate(reference(make(atoms, LENNARD_JONES, SWITCHED)).make(), atoms)
    assert atoms.get_potential_energy() == pytest.approx(theirs["energy"], rel=1e-14)
    assert atoms.get_potential_energy(force_consistent=True) == atoms.get_potential_energy()
    np.testing.assert_allclose(atoms.get_forces(), theirs["forces"], atol=1e-12)
    np.testing.assert_allclose(atoms.get_stress(voigt=False), theirs["stress"], atol=1e-13)
    np.testing.assert_allclose(atoms.get_potential_energies(), theirs["energies"], atol=1e-13)
    np.testing.assert_allclose(atoms.get_stress(), calculate_numerical_stress(atoms, eps=1e-6), atol=1e-8)


def test_lj13_relaxes_to_its_icosahedron():
    """The best known 13-atom cluster has energy -44.326801 (Cambridge Cluster Database); it has no stress."""
    atoms = Icosahedron("Ar", 2, latticeconstant=1.6)
    atoms.rattle(0.05, seed=4)
    atoms.calc = argon(WIDE)
    assert FIRE(atoms, logfile=None).run(fmax=1e-6, steps=800)
    assert atoms.get_potential_energy() == pytest.approx(-44.326801, abs=1e-6)
    with pytest.raises(Exception, match="stress"):
        atoms.get_stress()


def test_a_cell_relaxes_to_zero_stress():
    atoms = crystal(rattle=0.0, lattice_constant=NEAR)
    atoms.calc = argon()
    # reduced units are not the eV and Å that ASE's first guess of the stiffness is made for
    both = FrechetCellFilter(atoms, exp_cell_factor=28.0)
    assert BFGS(both, logfile=None, alpha=200.0).run(fmax=1e-5, steps=20)
    assert np.abs(atoms.get_stress()).max() < 1e-5
    # and the equation of state has its minimum there
    relaxed, cell, volumes, energies = atoms.get_volume(), np.array(atoms.cell), [], []
    for scale in np.linspace(0.995, 1.005, 5):
        atoms.set_cell(cell * scale, scale_atoms=True)
        volumes.append(atoms.get_volume())
        energies.append(atoms.get_potential_energy())
    assert EquationOfState(volumes, energies).fit()[0] == pytest.approx(relaxed, rel=1e-4)


def test_it_follows_atoms_cell_periodicity_and_species():
    """One calculator, changed atoms: always the numbers of a fresh one."""
    shared, atoms, energies = argon(), crystal(lattice_constant=NEAR), []

    rng = np.random.default_rng(0)

    def moved(by: float):
        atoms.positions += by * rng.normal(size=atoms.positions.shape)

    def strained(by: float):
        atoms.set_cell(np.array(atoms.cell) * by, scale_atoms=True)

    changes = (
        lambda: None,
        lambda: moved(0.005),
        # further than a list lasts, as in a run, and as a cell is relaxed
        *(lambda: moved(0.06) for _ in range(3)),
        lambda: strained(1.01),
        lambda: strained(1.05),
        lambda: atoms.set_pbc([True, True, False]),
        lambda: atoms.pop(5),
    )
    for change in changes:
        change()
        atoms.calc = shared
        energies.append(atoms.get_potential_energy())
        atoms.calc = argon()
        assert energies[-1] == atoms.get_potential_energy()
    assert len(set(energies)) == len(energies)
    assert shared.simulation.structure is not atoms


def test_a_shipped_system_by_name_and_with_overrides():
    atoms = crystal(rattle=0.0, lattice_constant=5.8)
    atoms.calc = MdnumCalculator("argon/liquid-864", overrides={"cutoff.kind": "switched"})
    energy = atoms.get_potential_energy()
    judge = reference(atoms.calc.simulation).make()
    assert energy == pytest.approx(evaluate(judge, atoms)["energy"], rel=1e-14)
    kinds = [made.parameters["cutoff"]["kind"] for made in (atoms.calc, MdnumCalculator("argon/liquid-864"))]
    assert kinds == ["switched", "hard"]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "a system or a potential"),
        ({"system": "argon/liquid-864", "potential": LENNARD_JONES}, "a system or a potential"),
        ({"potential": {"kind": "lennard-jones", "sigma": -1.0, "epsilon": 1.0}, "cutoff": WIDE}, "sigma"),
        ({"potential": LENNARD_JONES}, "cutoff"),
        (
            {"system": make(crystal(), LENNARD_JONES, SWITCHED), "overrides": {"cutoff.kind": "hard"}},
            "loaded",
        ),
    ],
)
def test_what_cannot_be_calculated_is_an_error(keys: dict, message: str):
    with pytest.raises(InputError, match=message):
        MdnumCalculator(**keys)
    atoms = bulk("Ar", "fcc", a=1.7, cubic=True)
    atoms.calc = argon()
    with pytest.raises(InputError, match="half the smallest perpendicular"):
        atoms.get_potential_energy()


def test_what_is_no_configuration_is_refused_and_never_answered():
    """Numbers that are not finite, two atoms at one place, and elements with another's constants."""
    atoms = crystal(lattice_constant=NEAR)
    for spoiled in (np.nan, np.inf):
        atoms.calc = argon()
        atoms.positions[3, 1], kept = spoiled, atoms.positions[3, 1]
        with pytest.raises(InputError, match="atom 3 is"):
            atoms.get_potential_energy()
        atoms.positions[3, 1] = kept
    atoms.positions[7] = atoms.positions[3]
    with pytest.raises(NumericalError, match="closest pair is 3-7 at 0"):
        atoms.get_forces()
    for element in ("C", "Ge"):
        for system in ("silicon/tersoff-512", "silicon/stillinger-weber-512"):
            other = bulk(element, "diamond", a=5.43, cubic=True) * (2, 2, 2)
            other.calc = MdnumCalculator(system)
            with pytest.raises(InputError, match=f"contains {element}, .*Si"):
                other.get_potential_energy()


def test_what_it_has_is_advertised_and_other_keywords_are_refused():
    many_body = MdnumCalculator("silicon/stillinger-weber-512")
    assert "energies" in argon().implemented_properties and "energies" not in many_body.implemented_properties
    assert many_body.parameters["potential"]["kind"] == "stillinger-weber"
    assert argon().parameters["cutoff"]["onset"] == SWITCHED["onset"]
    with pytest.raises(TypeError, match="override"):
        MdnumCalculator("argon/liquid-864", override={"cutoff.kind": "switched"})
    with pytest.raises(TypeError, match="overrides"):
        argon().set(overrides={"cutoff.kind": "switched"})
    # a slab has a stress in its plane, as ASE's own calculators give it
    slab = crystal(lattice_constant=NEAR)
    slab.center(vacuum=3.0, axis=2)
    slab.pbc = (True, True, False)
    slab.calc = argon()
    theirs = evaluate(reference(make(slab, LENNARD_JONES, SWITCHED)).make(), slab)
    ours, volume = slab.get_stress(voigt=False), slab.get_volume()
    assert theirs["stress"] is None and np.abs(ours[:2, :2]).max() > 0.01
    for axis in (0, 1):
        energies = []
        for sign in (1, -1):
            strained = slab.copy()
            cell = np.array(slab.cell)
            cell[axis] *= 1 + sign * 1e-6
            strained.set_cell(cell, scale_atoms=True)
            strained.calc = argon()
            energies.append(strained.get_potential_energy())
        assert ours[axis, axis] == pytest.approx((energies[0] - energies[1]) / 2e-6 / volume, abs=1e-6)


def test_a_simulation_is_evaluated_at_other_places_of_its_own_atoms():
    system = make(crystal(lattice_constant=NEAR), LENNARD_JONES, SWITCHED, neighbors={"skin": 0.1})
    atoms = system.atoms.copy()
    atoms.rattle(0.03, seed=1)
    atoms.calc = MdnumCalculator(build(system))
    energy = atoms.get_potential_energy()
    atoms.calc = argon()
    assert energy == pytest.approx(atoms.get_potential_energy(), rel=1e-13)
    # and other atoms of its species, but none of another
    atoms.pop(3)
    fewer = []
    for calculator in (MdnumCalculator(build(system)), argon()):
        atoms.calc = calculator
        fewer.append(atoms.get_potential_energy())
    assert fewer[0] == pytest.approx(fewer[1], rel=1e-13) and fewer[0] != energy
    atoms.symbols[0] = "Ne"
    atoms.calc = MdnumCalculator(build(system))
    with pytest.raises(InputError, match=r"Ne.*Ar"):
        atoms.get_potential_energy()
