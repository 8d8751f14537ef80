"""Forces, curl, digits: their errors are honest, and what is wrong is told from what is only imprecise."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.emt import EMT
from audit import planted
from audit.planted import Good, but, chain, codes, crystal, subject, values

import mdnum
from mdnum.audit.checks.curl import CurlCheck, Loop, agreed, around
from mdnum.audit.checks.forces import ForcesCheck, slope
from mdnum.audit.checks.invariance import InvarianceCheck
from mdnum.audit.checks.smoothness import SmoothnessCheck
from mdnum.audit.checks.state import StateCheck
from mdnum.audit.noise import Digits, NoiseFloor, along_a_line, digits, precision, settled
from mdnum.audit.subject import CalculatorSubject


def through(**formats: Any) -> type[Any]:
    """Energy, or forces, through another format."""
    same = lambda value: value  # noqa: E731
    energy, forces = formats.get("energy", same), formats.get("forces", same)
    return but(extra=lambda self, atoms, e, f: (energy(e), forces(f)))


@pytest.mark.parametrize("check", [ForcesCheck, CurlCheck])
@pytest.mark.parametrize("atoms", [crystal(), chain()], ids=["crystal", "chain"])
@pytest.mark.parametrize("make", [Good, planted.Single])
def test_what_is_right_passes(check, make, atoms: Atoms):
    # single precision is reported, and is no mistake
    single = make is planted.Single and check is ForcesCheck
    assert codes(check()(subject(make, atoms))) == ({"LOW_PRECISION": "info"} if single else {})


@pytest.mark.parametrize("check", [ForcesCheck, CurlCheck])
def test_ases_emt_passes(check):
    assert not check()(subject(EMT, bulk("Cu"))).findings


def test_digits_are_read_off_the_numbers():
    numbers = np.random.default_rng(0).normal(size=50)
    assert digits(numbers) == Digits(None, 53)
    assert digits(np.round(numbers, 5)).decimals == 5
    assert digits(numbers.astype(np.float32)) == Digits(None, 24)
    assert digits(numbers.astype(np.float16)).bits == 11
    # the same few numbers again and again tell nothing
    assert digits(np.repeat([0.0, 1.0, -2.0, 0.5], 9)) == Digits(None, 53)


@pytest.mark.parametrize(
    ("make", "severity"),
    [
        (planted.HalfPrecision, "error"),
        (planted.HalfInOtherUnits, "error"),
        (planted.BrainFloat, "error"),
        (planted.Decimals, "error"),
        # no force comes from it, or none that matters
        (planted.HalfEnergy, "warning"),
        (but(planted.Decimals, places=7), "warning"),
    ],
)
def test_answers_that_go_in_steps_are_found_whatever_they_look_like(make, severity: str):
    result = ForcesCheck()(subject(make))
    assert codes(result) == {"QUANTIZED": severity}
    if getattr(make, "places", 0) == 7:
        assert values(result, "QUANTIZED")["forces_step"] == 1e-7


def test_answers_rounded_to_decimals_are_reported_as_such():
    make = through(energy=lambda e: round(e, 5), forces=lambda f: np.round(f, 4))
    told = values(ForcesCheck()(subject(make)), "QUANTIZED")
    assert (told["energy_step"], told["forces_step"]) == pytest.approx((1e-5, 1e-4))
    assert told["variants"] == ["energy_decimals", "energy_step", "forces_decimals", "forces_step"]


@pytest.mark.parametrize("which", ["energy", "forces"])
def test_few_digits_of_energies_or_of_forces_alone_are_reported(which: str):
    single = lambda value: np.float64(np.float32(value))  # noqa: E731
    (told,) = precision(subject(through(**{which: single})), chain(), NoiseFloor(1e-8, 1e-8))
    assert told.code == "LOW_PRECISION" and told.values["format"] == "single precision"
    assert told.values["whose"] == {"energy": "energies", "forces": "forces"}[which]


def test_forces_that_do_not_change_do_not_go_in_steps():
    """Half of the atoms in a field of their own feel a constant force, to the last bit."""

    class Field(Good):
        def extra(self, atoms, energy, forces):
            forces = forces.copy()
            forces[:2, 2] -= 0.5
            return energy + 0.5 * float(atoms.positions[:2, 2].sum()), forces

        def pairs(self, positions, shifts, atoms):
            i, j, vectors = super().pairs(positions, shifts, atoms)
            keep = (i > 1) & (j > 1)
            return i[keep], j[keep], vectors[keep]

    asked = subject(Field, Atoms("Ar6", positions=crystal().positions[:6]))
    assert "QUANTIZED" not in codes(ForcesCheck()(asked))


def test_an_energy_in_single_precision_is_reported_and_one_that_loses_kT_is_warned_of():
    near, far = (through(energy=lambda e, by=by: float(np.float32(e - by))) for by in (100.0, 1e5))
    assert codes(ForcesCheck()(subject(near))) == {"LOW_PRECISION": "info"}
    # which leaves nothing to test the forces with
    told = codes(ForcesCheck()(subject(far)))
    assert set(told.values()) == {"warning"} and not {"FORCES_NOT_GRADIENT", "ENERGY_STEP"} & set(told)


def test_a_derivative_left_out_of_the_force_is_found_and_does_no_work():
    """It is the derivative of another energy: conservative, and wrong."""
    assert codes(ForcesCheck()(subject(planted.NoSwitchInForce)))["FORCES_NOT_GRADIENT"] == "error"
    # a force along the line between two atoms that depends on their distance alone has an energy
    assert not CurlCheck()(subject(planted.NoSwitchInForce)).findings


def test_pairs_that_one_atom_counts_push_the_structure():
    assert codes(ForcesCheck()(subject(planted.OneSided)))["NET_FORCE"] == "error"


def test_a_whirl_is_found_by_all_three():
    asked = subject(planted.Whirl, chain())
    told = codes(ForcesCheck()(asked))
    assert told["FORCES_NOT_GRADIENT"] == told["NET_TORQUE"] == "error"
    result = CurlCheck()(asked)
    assert codes(result)["CURL"] == "error"
    # an atom that turns in the plane of the whirl: curl is twice its rate, times the share that moves, for
    # the center of six atoms moves along by a sixth
    rows = result.tables["Work around closed loops"]
    planar = [row["curl (eV/Å²)"] for row in rows if row["plane"].endswith("in xy")]
    np.testing.assert_allclose(planar, 2e-3 * 5 / 6, rtol=1e-6)


def test_a_step_at_the_structure_is_told_from_a_wrong_force():
    pair = {r: Atoms("Ar2", positions=[[0, 0, 0], [r, 0, 0]]) for r in (planted.R_CUT, 3.0)}
    asked, line = subject(planted.HardEdge), np.array([[0.0, 0, 0], [1.0, 0, 0]])
    forces, quiet = asked.forces(pair[planted.R_CUT]), NoiseFloor(1e-17, 1e-17)
    # two directed pairs of half a hundredth each
    assert abs(slope(asked, pair[planted.R_CUT], line, forces, quiet).jump) == pytest.approx(0.01, rel=1e-3)
    assert slope(asked, pair[3.0], line, forces, quiet).jump == 0.0


@pytest.mark.parametrize("make", [Good, planted.Single])
def test_the_error_of_a_difference_covers_its_error(make):
    """Against the force of the exact calculator, in forty directions: within the error that was given."""
    atoms, rng = chain(), np.random.default_rng(4)
    asked, forces = subject(make, atoms), subject(Good, atoms).forces(atoms)
    noise = along_a_line(asked, atoms, rng)
    lines = rng.standard_normal((40, len(atoms), 3))
    lines /= np.linalg.norm(lines, axis=2).max(axis=1)[:, None, None]
    found = [slope(asked, atoms, line, forces, noise) for line in lines]
    assert sum(one.gap <= 3 * one.error for one in found) >= 38
    # and it is not covered by being large
    assert max(one.error for one in found) < (1e-4 if make is planted.Single else 1e-9)


class Stairs(CalculatorSubject):
    """One atom whose energy is a smooth curve with steps; the force knows nothing of the steps."""

    def __init__(self, places, heights, wrong: float = 0.0):
        super().__init__("stairs", Good, Atoms("Ar"))
        self.places, self.heights, self.wrong = places, heights, wrong

    def energy(self, atoms: Atoms) -> float:
        x = float(atoms.positions[0, 0])
        return np.sin(1.0 + x) + float(np.sum(self.heights[self.places < x]))

    def forces(self, atoms: Atoms) -> np.ndarray:
        x = float(atoms.positions[0, 0])
        return np.array([[-np.cos(1.0 + x) - self.wrong, 0.0, 0.0]])


@pytest.mark.parametrize("wrong", [0.0, 1e-8])
def test_steps_of_the_energy_by_chance_are_no_wrong_force(wrong: float):
    """Each of a few hundred lines crosses thirty flips; only a force that is wrong is called wrong."""
    rng, atoms, line = np.random.default_rng(5), Atoms("Ar"), np.array([[1.0, 0.0, 0.0]])
    told = 0
    for _ in range(300):
        places = np.sort(rng.choice([-1, 1], 30) * 10 ** rng.uniform(-4, -1, 30))
        asked = Stairs(places, 3e-13 * rng.standard_normal(30), wrong)
        told += not slope(asked, atoms, line, asked.forces(atoms), NoiseFloor(1e-16, 1e-16)).agrees
    assert told == (300 if wrong else 0)


@pytest.mark.parametrize("size", [1e-15, 1e-9, 1e-5])
def test_noise_is_measured_within_a_factor(size: float):
    """What is planted is found, whatever the smooth part does."""
    rng = np.random.default_rng(2)
    shaken = through(energy=lambda e: e + size * rng.standard_normal())
    found = [along_a_line(subject(shaken, chain()), chain(), rng).energy for _ in range(12)]
    assert size / 2 < np.median(found) < 2 * size


def test_a_threshold_on_a_line_is_not_taken_for_noise():
    """Of the lines along which noise is measured the first crosses a step far below single precision."""
    asked = count()

    def extra(self, atoms, energy, forces):
        return energy + 1e-6 * (4 <= next(asked) < 9), forces

    _, noise = settled(subject(but(extra=extra), crystal().repeat((2, 1, 1))), np.random.default_rng(0))
    assert noise.energy < 1e-13


def seeded(kind: type[Good], share: float, seed: int = 7) -> type[Any]:
    return but(kind, share=share, rng=np.random.default_rng(seed))


def test_a_pair_that_is_left_out_now_and_then_is_found_first():
    forces, state = (check(subject(seeded(planted.Drops, 0.3))) for check in (ForcesCheck(), StateCheck()))
    assert codes(forces)["NOISE_FLOOR"] == codes(state)["NOT_REPEATABLE"] == "error"
    assert "STALE_STATE" not in codes(state) and forces.says[0] == ["forces_drowned"]


@pytest.mark.parametrize("kind", [planted.Drops, planted.Hits])
@pytest.mark.parametrize("check", ["forces", "invariance"])
def test_one_call_in_fifty_is_found_by_whatever_asks(kind, check: str, tmp_path):
    make = seeded(kind, 0.02, 1)
    asked = mdnum.audit_calculator(make, crystal(), checks=check, out=tmp_path / "a", report=False)
    told = {one.code: one.severity for one in asked.verdict.findings}
    assert told["NOT_REPEATABLE"] == "error"
    assert asked.verdict.headline.endswith("as it is: the same question has another answer each time.")
    if kind is planted.Hits:
        assert make.hits > 1


@pytest.mark.parametrize("make", [Good, planted.HardEdge, planted.Single, planted.OldPairs])
def test_what_is_asked_again_is_little_and_has_one_answer(make):
    asked = subject(make)
    for check in (InvarianceCheck(), ForcesCheck()):
        check(asked)
    assert not asked.repeats.chance.differ and not asked.repeats.findings(asked.kT)
    share = 0 if make in (Good, planted.Single) else 0.1
    assert asked.repeats.chance.times <= share * asked.meter.calls


def test_a_direction_that_cannot_tell_is_no_comfort():
    """A rough energy, always the same for the same positions, beside forces that are smooth."""
    rough = but(extra=lambda self, atoms, e, f: (e + 1e-3 * np.sin(1e9 * atoms.positions[3, 0]), f))
    result = ForcesCheck()(subject(rough))
    # atom 3 is moved along x, and with all others in three ways; chance may let one of them tell
    assert codes(result) == {"NOISE_FLOOR": "warning"}
    assert result.says[0] == ["forces_right", "forces_unclear"]
    assert result.says[1]["unclear"] == result.numbers["could_not_tell"] > 1
    assert result.says[1]["clear_gap"] < 0.1 * result.numbers["rms_force"]


def test_jumps_of_the_force_on_a_loop_are_no_curl():
    """Hundreds of pairs pass a kink of the force within the loop: work around it is not the field's."""

    class Kinked(Good):
        def pair(self, distances):
            u, slope = super().pair(distances)
            return u + 0.05 * (planted.R_CUT - distances), slope - 0.05

    atoms = bulk("Ar", "sc", a=planted.R_CUT).repeat((3, 3, 2))
    for seed in range(2):
        check = CurlCheck()
        check.seed = seed
        assert not check(subject(Kinked, atoms)).findings


def test_a_curl_that_another_radius_denies_is_none():
    """Small circles have one curl; a smaller error on one of them does not outvote the others."""
    lucky, other = Loop("", 0.03, 0, 1e-3, 1e-5, 1.0), Loop("", 0.003, 0, 1e-7, 5e-5, 1.0)
    assert not lucky.conservative and agreed([lucky, other]).conservative
    assert not agreed([lucky, replace(other, curl=1.01e-3)]).conservative
    # one that can tell nothing denies nothing
    assert not agreed([lucky, replace(other, error=1.0)]).conservative


def test_curl_of_a_known_field():
    """A linear force with a matrix that is not symmetric: work is its antisymmetric part times the area."""
    matrix = np.array([[-1.0, 0.3, 0.0], [-0.2, -2.0, 0.1], [0.0, 0.1, -3.0]])
    linear = but(answer=lambda self, atoms: (0.0, atoms.positions @ matrix.T))
    atoms = Atoms("Ar", positions=[[0.3, 0.1, -0.2]])
    u, v = np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]])
    found = around(subject(linear, atoms), atoms, u, v, 0.02, NoiseFloor(0.0, 1e-17))
    assert found.curl == pytest.approx(matrix[1, 0] - matrix[0, 1], rel=1e-12)
    assert found.work == pytest.approx(np.pi * 0.02**2 * found.curl, rel=1e-12)
    assert found.error < 1e-11 and not found.conservative


@pytest.mark.parametrize(
    ("make", "severity", "belong"),
    [
        (planted.TwoEnergies, None, ""),
        (planted.Entropy, "warning", "free"),
        (planted.OrderedEnergy, "error", "free"),
        (planted.SwappedEnergies, "warning", "energy"),
    ],
)
def test_two_energies_are_both_read(make, severity: str | None, belong: str):
    """And are one where they differ by a constant."""
    result = ForcesCheck()(subject(make))
    assert codes(result).get("TWO_ENERGIES") == severity
    assert ("FORCES_NOT_GRADIENT" in codes(result)) == (make is planted.SwappedEnergies)
    if severity:
        assert values(result, "TWO_ENERGIES")["variants"][0] == belong


def test_an_energy_that_alone_is_cut_is_seen():
    asked, check = subject(planted.CutEnergy), SmoothnessCheck()
    check.neighbors, check.routes = 8, 0
    assert not codes(check(asked))
    result = ForcesCheck()(asked)
    assert codes(result) == {"TWO_ENERGIES": "error"}
    assert "between Ar-Ar at 3.4 Å, by 0.01 eV" in values(result, "TWO_ENERGIES")["places"]
