"""Forces, curl: their errors are honest, and what is wrong is told from what is only imprecise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.emt import EMT
from audit import planted
from audit.planted import chain, crystal, subject
from audit.test_invariance import codes

from mdnum.audit.curl import Curl, Loop, agreed, around
from mdnum.audit.digits import Digits, digits
from mdnum.audit.forces import Forces, slope
from mdnum.audit.noise import Noise, along_a_line


@pytest.mark.parametrize("check", [Forces, Curl])
@pytest.mark.parametrize("atoms", [crystal(), chain()], ids=["crystal", "chain"])
@pytest.mark.parametrize("make", [planted.Good, planted.Single])
def test_what_is_right_passes(check, make, atoms: Atoms):
    found = codes(check()(subject(make, atoms)))
    # single precision is told, and is no mistake
    assert found == ({"LOW_PRECISION": "info"} if make is planted.Single and check is Forces else {})


def test_digits_are_read_off_the_numbers():
    rng = np.random.default_rng(0)
    values = rng.normal(size=50)
    assert digits(values) == Digits(None, 53)
    assert digits(np.round(values, 5)).decimals == 5
    assert digits(values.astype(np.float32)) == Digits(None, 24)
    assert digits(values.astype(np.float16)).bits == 11
    # the same few numbers again and again tell nothing
    assert digits(np.repeat([0.0, 1.0, -2.0, 0.5], 9)) == Digits(None, 53)


def test_answers_rounded_to_decimals_are_told_as_such():
    class Rounded(planted.Good):
        def extra(self, atoms, energy, forces):
            return round(energy, 5), np.round(forces, 4)

    (found,) = [one for one in Forces()(subject(Rounded)).findings if one["code"] == "QUANTIZED"]
    assert "the energy, in steps of 1e-05 eV; forces to 4 decimals, in steps of 0.0001 eV/Å" in found["text"]


@pytest.mark.parametrize("check", [Forces, Curl])
def test_ases_emt_passes(check):
    assert not check()(subject(EMT, bulk("Cu"))).findings


def test_a_derivative_left_out_of_the_force_is_found_and_does_no_work():
    """It is the derivative of another energy: conservative, and wrong."""
    asked = subject(planted.NoSwitchInForce)
    assert codes(Forces()(asked))["FORCES_NOT_GRADIENT"] == "error"
    # a force along the line between two atoms that depends on their distance alone has an energy
    assert not Curl()(asked).findings


def test_pairs_that_one_atom_counts_push_the_structure():
    found = codes(Forces()(subject(planted.OneSided)))
    assert found["NET_FORCE"] == "error"


def test_a_whirl_is_found_by_all_three():
    asked = subject(planted.Whirl, chain())
    found = codes(Forces()(asked))
    assert found["FORCES_NOT_GRADIENT"] == found["NET_TORQUE"] == "error"
    part = Curl()(asked)
    assert codes(part)["CURL"] == "error"
    # an atom that turns in the plane of the whirl: curl is twice its rate, times the share that moves
    rows = part.tables["Work around closed loops"]
    planar = [row["curl (eV/Å²)"] for row in rows if row["plane"].endswith("in xy")]
    # the center of six atoms moves along by a sixth
    np.testing.assert_allclose(planar, 2e-3 * 5 / 6, rtol=1e-6)


def test_a_step_at_the_structure_is_told_from_a_wrong_force():
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [planted.R_CUT, 0, 0]])
    asked = subject(planted.HardEdge, atoms)
    line = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    found = slope(asked, atoms, line, asked.forces(atoms), Noise(1e-17, 1e-17))
    # two directed pairs of half a hundredth each
    assert abs(found.jump) == pytest.approx(0.01, rel=1e-3)
    part = Forces()
    asked.atoms = atoms
    smooth = slope(
        asked, Atoms("Ar2", positions=[[0, 0, 0], [3.0, 0, 0]]), line, asked.forces(atoms), Noise(0, 0)
    )
    assert smooth.jump == 0.0
    assert part.name == "forces"


@pytest.mark.parametrize("make", [planted.Good, planted.Single])
def test_the_error_of_a_difference_covers_its_error(make):
    """Against the force of the exact calculator, in forty directions: within the error that was told."""
    atoms = chain()
    asked, exact = subject(make, atoms), subject(planted.Good, atoms)
    rng = np.random.default_rng(4)
    noise = along_a_line(asked, atoms, rng)
    forces = exact.forces(atoms)
    covered, sizes = 0, []
    for _ in range(40):
        line = rng.standard_normal((len(atoms), 3))
        line /= np.max(np.linalg.norm(line, axis=1))
        found = slope(asked, atoms, line, forces, noise)
        covered += abs(found.difference - found.force) <= 3 * found.error
        sizes.append(found.error)
    assert covered >= 38
    # and it is not covered by being large
    assert max(sizes) < (1e-4 if make is planted.Single else 1e-9)


class Stairs:
    """One atom whose energy is a smooth curve with steps; the force knows nothing of the steps."""

    name, kT, atoms = "stairs", 0.025, Atoms("Ar")

    def fresh(self):
        return self

    def __init__(self, places, heights, wrong: float = 0.0):
        self.places, self.heights, self.wrong = places, heights, wrong

    def energy(self, atoms: Atoms) -> float:
        x = float(atoms.positions[0, 0])
        return np.sin(1.0 + x) + float(np.sum(self.heights[self.places < x]))

    def forces(self, atoms: Atoms) -> np.ndarray:
        x = float(atoms.positions[0, 0])
        return np.array([[-np.cos(1.0 + x) - self.wrong, 0.0, 0.0]])


@pytest.mark.parametrize("wrong", [0.0, 1e-8])
def test_steps_of_the_energy_by_chance_are_no_wrong_force(wrong: float):
    """Each of a few hundred lines crosses thirty flips; only a force that is wrong is told as wrong."""
    rng, atoms, line = np.random.default_rng(5), Atoms("Ar"), np.array([[1.0, 0.0, 0.0]])
    told = 0
    for _ in range(300):
        places = np.sort(rng.choice([-1, 1], 30) * 10 ** rng.uniform(-4, -1, 30))
        asked = Stairs(places, 3e-13 * rng.standard_normal(30), wrong)
        found = slope(asked, atoms, line, asked.forces(atoms), Noise(1e-16, 1e-16))
        told += not found.agrees
    assert told == (300 if wrong else 0)


@pytest.mark.parametrize("size", [1e-15, 1e-9, 1e-5])
def test_noise_is_measured_within_a_factor(size: float):
    """What is planted is found, whatever the smooth part does."""
    rng = np.random.default_rng(2)

    class Shaken(planted.Good):
        def extra(self, atoms, energy, forces):
            return energy + size * rng.standard_normal(), forces

    found = [along_a_line(subject(Shaken, chain()), chain(), rng).energy for _ in range(12)]
    assert size / 2 < np.median(found) < 2 * size


def test_jumps_of_the_force_on_a_loop_are_no_curl():
    """Hundreds of pairs pass a kink of the force within the loop: work around it is not the field's."""

    class Kinked(planted.Good):
        def pair(self, distances):
            u, slope = super().pair(distances)
            return u + 0.05 * (planted.R_CUT - distances), slope - 0.05

    atoms = bulk("Ar", "sc", a=planted.R_CUT).repeat((3, 3, 2))
    for seed in range(4):
        assert not Curl(seed=seed)(subject(Kinked, atoms)).findings


def test_a_curl_that_another_radius_denies_is_none():
    """Small circles have one curl; a smaller error on one of them does not outvote the others."""
    lucky, other = Loop("", 0.03, 0, 1e-3, 1e-5, 1.0), Loop("", 0.003, 0, 1e-7, 5e-5, 1.0)
    assert not lucky.conservative and agreed([lucky, other]).conservative
    same = replace(other, curl=1.01e-3)
    assert not agreed([lucky, same]).conservative
    # one that can tell nothing denies nothing
    assert not agreed([lucky, replace(other, error=1.0)]).conservative


def test_curl_of_a_known_field():
    """A linear force with a matrix that is not symmetric: work is its antisymmetric part times the area."""
    matrix = np.array([[-1.0, 0.3, 0.0], [-0.2, -2.0, 0.1], [0.0, 0.1, -3.0]])

    class Linear(planted.Good):
        def answer(self, atoms):
            return 0.0, atoms.positions @ matrix.T

    atoms = Atoms("Ar", positions=[[0.3, 0.1, -0.2]])
    u, v = np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]])
    found = around(subject(Linear, atoms), atoms, u, v, 0.02, Noise(0.0, 1e-17))
    assert found.curl == pytest.approx(matrix[1, 0] - matrix[0, 1], rel=1e-12)
    assert found.work == pytest.approx(np.pi * 0.02**2 * (matrix[1, 0] - matrix[0, 1]), rel=1e-12)
    assert found.error < 1e-11 and not found.conservative
