"""Forces, curl, digits: their errors are honest, and what is wrong is told from what is only imprecise."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from audit import planted, rivals
from audit.planted import Good, adding, asked, but, chain, codes, crystal, subject, through, values

import mdnum
from mdnum.audit.checks.curl import CurlCheck, Loop, agreed, around
from mdnum.audit.checks.forces import ForcesCheck, slope
from mdnum.audit.checks.invariance import InvarianceCheck
from mdnum.audit.noise import Digits, NoiseFloor, along_a_line, digits, precision, settled
from mdnum.audit.subject import CalculatorSubject
from mdnum.units import FORCE


def test_digits_are_read_off_the_numbers():
    numbers = np.random.default_rng(0).normal(size=50)
    assert digits(numbers) == Digits(None, 53)
    assert digits(np.round(numbers, 5)).decimals == 5
    assert digits(numbers.astype(np.float32)) == Digits(None, 24)
    assert digits(numbers.astype(np.float16)).bits == 11
    # the same few numbers again and again tell nothing
    assert digits(np.repeat([0.0, 1.0, -2.0, 0.5], 9)) == Digits(None, 53)


def test_answers_rounded_to_decimals_are_reported_as_such():
    make = through(energy=lambda e: round(e, 5), forces=lambda f: np.round(f, 4))
    told = values(asked("forces", make), "QUANTIZED")
    assert (told["energy_step"], told["forces_step"]) == pytest.approx((1e-5, 1e-4))
    assert told["variants"] == ["energy_step", "forces_decimals", "forces_step"]


@pytest.mark.parametrize(("which", "whose"), [("energy", "energies"), ("forces", "forces")])
def test_few_digits_of_energies_or_of_forces_alone_are_reported(which: str, whose: str):
    single = through(**{which: lambda value: np.float64(np.float32(value))})
    (told,) = precision(subject(single), chain(), NoiseFloor(1e-8, 1e-8))
    assert (told.code, told.values["format"], told.values["whose"]) == (
        "LOW_PRECISION",
        "single precision",
        whose,
    )


def test_forces_that_do_not_change_do_not_go_in_steps():
    """Half of the atoms in a field of their own feel a constant force, to the last bit."""

    def field(self, atoms, energy, forces):
        pull = -0.5 * (np.arange(len(atoms)) < 2)
        return energy - float(pull @ atoms.positions[:, 2]), forces + np.outer(pull, [0, 0, 1])

    make = planted.keeping(lambda self, atoms, i, j, vectors: (i > 1) & (j > 1), extra=field)
    assert "QUANTIZED" not in codes(asked("forces", make, Atoms("Ar6", positions=crystal().positions[:6])))


def test_an_energy_in_single_precision_is_reported_and_one_that_loses_kT_is_warned_of():
    near, far = (through(energy=lambda e, by=by: float(np.float32(e - by))) for by in (100.0, 1e5))
    assert codes(asked("forces", near)) == {"LOW_PRECISION": "info"}
    # which leaves nothing to test the forces with
    told = codes(asked("forces", far))
    assert set(told.values()) == {"warning"} and not {"FORCES_NOT_GRADIENT", "ENERGY_STEP"} & set(told)


#: Numbers that are rounded to decimals, before a factor as well, and to single precision.
ROUNDED = {
    **{f"energy to {n}": through(energy=lambda e, n=n: round(e, n)) for n in (2, 3, 6)},
    **{f"forces to {n}": through(forces=lambda f, n=n: np.round(f, n)) for n in (3, 4)},
    "energy in kcal/mol": through(energy=lambda e: round(23.06 * e, 6) * 0.0433641153107705),
    "far energy in single": through(energy=lambda e: float(np.float32(e - 10.0))),
    "energy that loses kT": through(energy=lambda e: float(np.float32(e - 1e5))),
}


@pytest.mark.parametrize("brief", [False, True], ids=["full", "brief"])
@pytest.mark.parametrize("atoms", [crystal(), chain(), rivals.liquid()], ids=["crystal", "chain", "liquid"])
@pytest.mark.parametrize("kind", ROUNDED)
def test_rounding_is_no_wrong_force(kind: str, atoms: Atoms, brief: bool):
    """Along some directions all steps of differences are flat, along others none is."""
    found = {}
    for check in (ForcesCheck(), CurlCheck()):
        check.brief = brief
        found |= codes(check(subject(ROUNDED[kind], atoms)))
    assert set(found) <= {"QUANTIZED", "LOW_PRECISION", "NOISE_FLOOR"}


@pytest.mark.parametrize("brief", [False, True], ids=["full", "brief"])
@pytest.mark.parametrize("places", [7, 9])
def test_a_wrong_force_is_found_under_rounding(places: int, brief: bool):
    def rounded(self, atoms, energy, forces):
        return round(energy, places), forces

    check = ForcesCheck()
    check.brief = brief
    found = codes(check(subject(but(planted.NoSwitchInForce, extra=rounded))))
    assert found["FORCES_NOT_GRADIENT"] == "error"


def test_directions_in_which_a_wrong_force_shows_are_counted_and_the_largest_error_is_named():
    """A force on one atom that is wrong along x and z shows in every direction that moves it along these."""
    off = np.array([0.1, 0.0, -0.02])
    result = asked("forces", through(forces=lambda f: f + np.outer(np.arange(len(f)) == 1, off)), chain())
    rows = result.tables["Derivative of the energy along a direction"]
    wrong = [row for row in rows if not row["agree"]]
    # three ways of all atoms, and what moves atom 1 along x and z, of four atoms along three axes
    assert [row["moved"].split(" (")[0] for row in wrong if row["moved"].startswith("atom")] == ["atom 1"] * 2
    assert (len(rows), len(wrong)) == (15, 5)
    (found, values) = result.numbers, result.says[1]
    assert (found["directions"], found["disagree"], values["clear"]) == (15, 5, 15)
    assert found["largest_difference"] == values["clear_gap"] == pytest.approx(0.1, rel=1e-6)
    assert found["largest_error"] == max(row["error"] for row in rows)
    assert result.says[0] == ["forces_wrong"] and found["could_not_tell"] == 0


def test_a_step_at_the_structure_is_told_from_a_wrong_force():
    pair = {r: Atoms("Ar2", positions=[[0, 0, 0], [r, 0, 0]]) for r in (planted.R_CUT, 3.0)}
    found, line = subject(planted.HardEdge), np.array([[0.0, 0, 0], [1.0, 0, 0]])
    forces, quiet = found.forces(pair[planted.R_CUT]), NoiseFloor(1e-17, 1e-17)
    # two directed pairs of half a hundredth each
    assert abs(slope(found, pair[planted.R_CUT], line, forces, quiet).jump) == pytest.approx(0.01, rel=1e-3)
    assert slope(found, pair[3.0], line, forces, quiet).jump == 0.0


@pytest.mark.parametrize("make", [Good, planted.Single])
def test_the_error_of_a_difference_covers_its_error(make):
    """Against the force of the exact calculator, in forty directions: within the error that was given."""
    atoms, rng = chain(), np.random.default_rng(4)
    tested, forces = subject(make, atoms), subject(Good, atoms).forces(atoms)
    noise = along_a_line(tested, atoms, rng)
    lines = rng.standard_normal((40, len(atoms), 3))
    lines /= np.linalg.norm(lines, axis=2).max(axis=1)[:, None, None]
    found = [slope(tested, atoms, line, forces, noise) for line in lines]
    assert sum(one.gap <= 3 * one.error for one in found) >= 38
    # and it is not covered by being large
    assert max(one.error for one in found) < (1e-4 if make is planted.Single else 1e-9)


class Quintic(CalculatorSubject):
    """One atom whose energy is 2 x + b x³ + c x⁵ along x."""

    def __init__(self, b: float, c: float):
        super().__init__("quintic", Good, Atoms("Ar"))
        self.b, self.c = b, c

    def energy(self, atoms: Atoms) -> float:
        x = float(atoms.positions[0, 0])
        return 2 * x + self.b * x**3 + self.c * x**5


@pytest.mark.parametrize(("b", "c"), [(50.0, 0.0), (0.0, 900.0), (-30.0, 400.0)])
def test_differences_are_extrapolated_to_the_fourth_order(b: float, c: float):
    """D(h) = 2 + b h² + c h⁴: of steps h and h/4 the square cancels, and c h⁴ / 16 is left, with a minus."""
    found, line = Quintic(b, c), np.array([[1.0, 0.0, 0.0]])
    # so loud that the longest steps are the best
    told = slope(found, Atoms("Ar"), line, np.array([[-2.0, 0.0, 0.0]]), NoiseFloor(1e-4, 0.0))
    longest, shortest = 0.064, 0.004
    assert told.step == pytest.approx(shortest, rel=1e-12) and told.agrees
    left = [c * step**4 / 16 for step in (longest, longest / 4)]
    assert told.difference == pytest.approx(2.0 - left[1], abs=1e-11)
    assert told.error == pytest.approx(abs(left[0] - left[1]) + 2 * 1e-4 / shortest, rel=1e-9)
    np.testing.assert_allclose(told.gaps[:2], [abs(b * h**2 + c * h**4) for h in (0.064, 0.016)], rtol=1e-8)


class Stairs(CalculatorSubject):
    """One atom whose energy is a smooth curve with steps; the force knows nothing of the steps."""

    def __init__(self, places, heights, wrong: float = 0.0):
        super().__init__("stairs", Good, Atoms("Ar"))
        self.places, self.heights, self.wrong = places, heights, wrong

    def energy(self, atoms: Atoms) -> float:
        x = float(atoms.positions[0, 0])
        return np.sin(1.0 + x) + float(np.sum(self.heights[self.places < x]))

    def forces(self, atoms: Atoms) -> np.ndarray:
        return np.array([[-np.cos(1.0 + float(atoms.positions[0, 0])) - self.wrong, 0.0, 0.0]])


@pytest.mark.parametrize("wrong", [0.0, 1e-8])
def test_steps_of_the_energy_by_chance_are_no_wrong_force(wrong: float):
    """Each of a few hundred lines crosses thirty flips; only a force that is wrong is called wrong."""
    rng, atoms, line = np.random.default_rng(5), Atoms("Ar"), np.array([[1.0, 0.0, 0.0]])
    told = 0
    for _ in range(300):
        places = np.sort(rng.choice([-1, 1], 30) * 10 ** rng.uniform(-4, -1, 30))
        found = Stairs(places, 3e-13 * rng.standard_normal(30), wrong)
        told += not slope(found, atoms, line, found.forces(atoms), NoiseFloor(1e-16, 1e-16)).agrees
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
    calls = count()
    stepped = through(energy=lambda e: e + 1e-6 * (4 <= next(calls) < 9))
    _, noise = settled(subject(stepped, crystal().repeat((2, 1, 1))), np.random.default_rng(0))
    assert noise.energy < 1e-13


def test_a_pair_that_is_left_out_now_and_then_drowns_the_forces():
    assert asked("forces", planted.drops(0.3)).says[0] == ["forces_drowned"]


@pytest.mark.parametrize(
    ("kind", "check"),
    [
        (planted.drops, "forces"),
        (planted.hits, "invariance"),
        pytest.param(planted.hits, "forces", marks=pytest.mark.nightly),
        pytest.param(planted.drops, "invariance", marks=pytest.mark.nightly),
    ],
)
def test_one_call_in_fifty_is_found_by_whatever_asks(kind, check: str, tmp_path):
    outcome = mdnum.audit_calculator(kind(0.02, 1), crystal(), checks=check, out=tmp_path / "a", report=False)
    assert {one.code: one.severity for one in outcome.verdict.findings}["NOT_REPEATABLE"] == "error"
    assert outcome.summary["safe_to_run"] == outcome.summary["safe_to_differentiate"] == "no"


@pytest.mark.parametrize("make", [Good, planted.HardEdge])
def test_what_is_asked_again_is_little_and_has_one_answer(make):
    found = subject(make)
    for check in (InvarianceCheck(), ForcesCheck()):
        check(found)
    assert not found.repeats.chance.differ and not found.repeats.findings(found.kT)
    share = 0 if make is Good else 0.1
    assert found.repeats.chance.times <= share * found.meter.calls


def test_a_direction_that_cannot_tell_is_no_comfort():
    """A rough energy, always the same for the same positions, beside forces that are smooth."""
    result = asked("forces", adding(lambda atoms, e, f: (e + 1e-3 * np.sin(1e9 * atoms.positions[3, 0]), f)))
    # atom 3 is moved along x, and with all others in three ways; chance may let one of them tell
    assert codes(result) == {"NOISE_FLOOR": "warning"}
    assert result.says[0] == ["forces_right", "forces_unclear"]
    assert result.says[1]["could_not_tell"] == result.numbers["could_not_tell"] > 1
    assert result.says[1]["clear_gap"] < 0.1 * result.numbers["rms_force"]


# -- curl -----------------------------------------------------------------------------------------


def test_the_curl_of_a_whirl_is_twice_its_rate():
    """An atom that turns in its plane: times the share that moves, for the center moves along by a sixth."""
    rows = asked("curl", planted.Whirl, chain()).tables["Work around closed loops"]
    planar = [row[f"curl ({FORCE}²)"] for row in rows if row["plane"].endswith("in xy")]
    np.testing.assert_allclose(planar, 2e-3 * 5 / 6, rtol=1e-6)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.nightly)])
def test_jumps_of_the_force_on_a_loop_are_no_curl(seed: int):
    """Hundreds of pairs pass a kink of the force within the loop: work around it is not the field's."""

    def kinked(self, distances):
        u, slope = Good.pair(self, distances)
        return u + 0.05 * (planted.R_CUT - distances), slope - 0.05

    check = CurlCheck()
    check.seed = seed
    atoms = bulk("Ar", "sc", a=planted.R_CUT).repeat((3, 3, 2))
    assert not check(subject(but(pair=kinked), atoms)).findings


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


# -- what noise explains ----------------------------------------------------------------------------


class Scattering(CalculatorSubject):
    """A smooth energy and force with noise of one size on either."""

    def __init__(self, seed: int, size: float):
        super().__init__("scatters", Good, crystal())
        self.rng, self.size = np.random.default_rng(seed), size

    def energy(self, atoms: Atoms) -> float:
        return float(np.cos(atoms.positions).sum()) + self.size * self.rng.standard_normal()

    def forces(self, atoms: Atoms) -> np.ndarray:
        return np.sin(atoms.positions) + self.size * self.rng.standard_normal((len(atoms), 3))


@pytest.mark.parametrize("size", [1e-9, 1e-5])
def test_equal_answers_that_scatter_are_hardly_ever_taken_for_different(size: float):
    """The floor is an estimate from few values, and far too small now and then: 60,000 comparisons."""
    rng, atoms = np.random.default_rng(8), crystal()
    above = lucky = 0
    for seed in range(600):
        floor = along_a_line(Scattering(seed, size), atoms, rng)
        changes = np.abs(size * np.sqrt(2) * rng.standard_normal(100))
        above += int((changes > floor.allowed.energy).sum())
        lucky += floor.energy < 0.2 * size
        # and it is no more than a margin: what is a hundred times the noise is seen
        assert floor.allowed.energy < 100 * size
    assert above == 0 and lucky <= 2


def test_a_floor_from_few_values_allows_for_more():
    known, few = (NoiseFloor(1e-9, 1e-9, freedom=freedom) for freedom in (np.inf, 1.8))
    assert known.allowed.energy == pytest.approx(40e-9)
    assert few.allowed.energy > 1e3 * few.energy and known.louder(few).freedom == 1.8
    # Student's distribution: how often a difference of two answers is above what they allow
    rng = np.random.default_rng(1)
    draws = rng.standard_normal((200_000, 4))
    estimates = np.sqrt(np.mean(draws[:, 1:] ** 2, axis=1))
    allowed = NoiseFloor(1.0, 1.0, freedom=3).allowed.energy * estimates
    assert np.mean(np.sqrt(2) * np.abs(draws[:, 0]) > allowed) < 3e-5
