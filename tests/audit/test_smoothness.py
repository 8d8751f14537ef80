"""Walks through surroundings and crowds, how small a step is found, and ASE's own calculators."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from audit import laws
from audit.laws import R_CUT, Capped, Pairwise, law, subject
from audit.planted import codes, values

from mdnum.audit import structures, thresholds
from mdnum.audit.checks.smoothness import SmoothnessCheck, reach, summary
from mdnum.audit.curve import Curve, find_jumps, smallest_steps
from mdnum.audit.record import load_calculator
from mdnum.audit.structures import Pair, default_structure
from mdnum.audit.subject import CalculatorSubject
from mdnum.audit.surroundings import EnvironmentWalks, Route, cluster, crowd, gap, walk_surroundings
from mdnum.audit.thresholds import STEP, PairWalk, find_thresholds, walk, walk_pairs

COPPER = Path(__file__).parents[2] / "systems" / "copper" / "cu.eam.alloy"
#: J. Tersoff, Phys. Rev. B 38, 9902 (1988), in the order of LAMMPS
SILICON = "Si Si Si 3 1 0 1.0039e5 16.217 -0.59825 0.78734 1.1e-6 1.7322 471.18 2.85 0.15 2.4799 1830.8\n"
NEIGHBORS = 24
PAIR = Pair(("Ar", "Ar"), laws.Atoms("Ar"), laws.Atoms("Ar"), 0.0, False, "Ar-Ar")


def idle(done: int, total: int, info: dict) -> None:
    """A progress that nobody watches."""


def dozen() -> laws.Atoms:
    """A dozen argon atoms, in places without symmetry."""
    rng = np.random.default_rng(4)
    grid = np.stack(np.unravel_index(rng.permutation(27)[:12], (3, 3, 3)), axis=1) * 3.6
    return laws.Atoms("Ar12", grid + rng.uniform(-0.4, 0.4, (12, 3)))


def grid(*shape: int) -> np.ndarray:
    return np.stack(np.unravel_index(np.arange(np.prod(shape)), shape), axis=1) * 3.6


def checked(asked: CalculatorSubject, routes: int = 0):
    check = SmoothnessCheck()
    check.neighbors, check.routes = 8, routes
    return check(asked)


class Bare(CalculatorSubject):
    """Two atoms under a law, asked without ASE's calculators in between."""

    def __init__(self, pair):
        super().__init__("bare", Pairwise, laws.Atoms("Ar2", [(0, 0, 0), (4, 0, 0)]), kT=laws.KT)
        self.pair = pair

    def energy(self, atoms) -> float:
        return self.pair(float(atoms.positions[1, 0]))[0]

    def forces(self, atoms) -> np.ndarray:
        force = self.pair(float(atoms.positions[1, 0]))[1]
        return np.array([[-force, 0.0, 0.0], [force, 0.0, 0.0]])


def walked(asked: CalculatorSubject) -> PairWalk:
    (found,) = walk_pairs(asked).walks
    return found


def test_a_crossing_among_others_is_measured_to_the_last_bit():
    """Of a pair law, the jump among others is that of the two alone."""
    around = walk_surroundings(subject(lambda: Pairwise(laws.hard), dozen()), idle)
    measured = [one for one in around.events if one.threshold is not None]
    assert measured and not around.unexplained
    for event in measured:
        assert event.jump.exact and event.jump.high == np.nextafter(event.jump.low, np.inf)
        assert abs(event.jump.energy) == pytest.approx(abs(law(R_CUT)[0]), rel=1e-9)
        assert event.force == pytest.approx(abs(law(R_CUT)[1]), rel=1e-9)


def test_crossings_beyond_the_number_that_is_measured_are_listed():
    asked = subject(lambda: Pairwise(laws.hard), laws.Atoms("Ar8", grid(2, 2, 2)))
    around = walk_surroundings(asked, idle, crossings=1, routes=0)
    assert (around.measured, around.asked) == (1, around.possible)
    assert ("1 more crossings of known thresholds", "1 were measured") in around.skipped


def test_what_depends_on_three_is_found_where_two_show_nothing():
    """A constant for each angle with two short sides: invisible to two atoms, a jump for three."""
    asked = subject(lambda: laws.Angles(laws.soft), dozen())
    assert [one.radius for one in find_thresholds(asked)] == [pytest.approx(R_CUT, rel=0.01)]
    result = checked(asked, routes=2)
    assert codes(result)["JUMP_AMONG_MANY"] == "error" and result.numbers["unexplained"] > 0


def test_crossings_on_a_route_are_those_of_a_fine_scan():
    """Roots of a quadratic against signs on a fine grid, images of a small skewed cell included."""
    rng = np.random.default_rng(7)
    cell = np.diag([7.0, 8.0, 9.0]) + np.tril(rng.uniform(-1, 1, (3, 3)), -1)
    atoms = laws.Atoms("Ar4", rng.uniform(0, 7, (4, 3)), cell=cell, pbc=(True, True, False))
    (threshold,) = find_thresholds(laws.pair_subject(laws.hard))
    direction = rng.normal(size=3)
    route = Route("", atoms, np.array([1]), 1, direction / np.linalg.norm(direction))
    found = [one.at for one in route.crossings([threshold], -1.5, 1.5)]
    places = np.linspace(-1.5, 1.5, 60001)
    lead = atoms.positions[1] + places[:, None] * route.direction
    expected = []
    for other in (0, 2, 3):
        for a in range(-4, 5):
            for b in range(-4, 5):
                image = atoms.positions[other] + a * cell[0] + b * cell[1]
                outside = np.linalg.norm(lead - image, axis=1) > threshold.radius
                expected += list(places[1:][outside[1:] != outside[:-1]])
    assert len(found) > 3 and np.allclose(found, sorted(expected), atol=1e-4)


def test_what_is_found_of_a_hard_cutoff():
    result = checked(subject(lambda: Pairwise(laws.hard), dozen()))
    assert codes(result) == {"ENERGY_JUMP": "error"}
    told = values(result, "ENERGY_JUMP")
    assert told["inside"] == repr(float(np.nextafter(R_CUT, 0.0))) and told["variants"] == ["among"]
    assert told["energy"] == pytest.approx(-1e3 * law(R_CUT)[0], rel=1e-9)
    assert told["kT"] == pytest.approx(abs(law(R_CUT)[0]) / laws.KT, rel=1e-9)
    assert result.numbers["cutoffs"] == {"Ar-Ar": R_CUT}
    assert result.says[0][:3] == ["smoothness_walked", "smoothness_ends", "smoothness_jumps_energy"]


@pytest.mark.slow
def test_what_is_found_of_a_shift_and_of_switches():
    found = [
        codes(checked(subject(lambda law=law: Pairwise(law), dozen())))
        for law in (laws.shifted, laws.switched(1), laws.switched(2))
    ]
    assert found == [{"FORCE_JUMP": "warning"}, {"CURVATURE_JUMP": "info"}, {}]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        # (distance, order) of each threshold of two, from the calculators' own documentation and source
        ("ase.calculators.lj:LennardJones(sigma=3.4, epsilon=0.01, rc=8.5)", [(8.5, 1)]),
        (
            "ase.calculators.lj:LennardJones(sigma=3.4, epsilon=0.01, rc=8.5, ro=6.0, smooth=True)",
            [(6.0, 2), (8.5, 2)],
        ),
        ("ase.calculators.morse:MorsePotential(epsilon=0.5, r0=2.6)", [(1.9 * 2.6, 3), (2.7 * 2.6, 3)]),
        ("ase.calculators.tip3p:TIP3P(rc=5.5, width=1.0)", [(4.5, 2), (5.5, 2)]),
        ("ase.calculators.tip4p:TIP4P(rc=5.5, width=1.0)", [(4.5, 2), (5.5, 2)]),
        ("ase.calculators.emt:EMT", [(5.8768, 0)]),
        (f"ase.calculators.eam:EAM(potential={str(COPPER)!r})", [(5.50679, 1)]),
        ("ase.calculators.tersoff:Tersoff.from_lammps('silicon.tersoff')", [(2.7, 2), (3.0, 2)]),
    ],
    ids=["lj", "lj smooth", "morse", "tip3p", "tip4p", "emt", "eam", "tersoff"],
)
def test_ases_own(words: str, expected, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "silicon.tersoff").write_text(SILICON)
    monkeypatch.chdir(tmp_path)
    loaded = load_calculator(words)
    found = walked(CalculatorSubject(words, loaded.make, default_structure(loaded))).thresholds
    assert [one.order for one in found] == [order for _, order in expected]
    assert [one.radius for one in found] == [pytest.approx(r, abs=2e-4) for r, _ in expected]


# -- how small a step of the force is found -------------------------------------------------------


def metal(r: float) -> tuple[float, float]:
    """A Lennard-Jones wall as steep as a metal's."""
    s = (2.3 / r) ** 6
    return 1.6 * (s * s - s), 9.6 * (2 * s * s - s) / r


def morse(r: float) -> tuple[float, float]:
    e = float(np.exp(-1.4 * (r - 2.8)))
    return 0.35 * (e * e - 2 * e), 0.98 * (e * e - e)


def buckingham(r: float) -> tuple[float, float]:
    wall = 1000 * float(np.exp(-r / 0.3))
    return wall - 30 / r**6, wall / 0.3 - 180 / r**7


def stepped(pair, place: float, size: float):
    """A law with a force that is larger before a place, and an energy to it."""

    def of(r: float) -> tuple[float, float]:
        energy, force = pair(r)
        return (energy + size * (place - r), force + size) if r < place else (energy, force)

    return of


@pytest.mark.parametrize(
    ("pair", "low", "place", "size"),
    [
        (laws.endless, 2.6, 2.9123, 1e-6),
        (metal, 1.95, 2.4567, 1e-4),
        (metal, 1.95, 2.8911, 1e-5),
        (metal, 1.95, 3.2468, 1e-6),
        (morse, 1.6, 2.0357, 1e-5),
        (morse, 1.6, 3.1415, 1e-6),
        (buckingham, 1.5, 2.3579, 1e-6),
    ],
)
def test_a_small_step_of_the_force_is_found_on_a_wall(pair, low: float, place: float, size: float):
    (found,), _ = find_jumps(Curve(stepped(pair, place, size)), low, 5.0, STEP)
    assert (found.low, found.high, found.order) == (np.nextafter(place, 0.0), place, 1)
    assert found.force == pytest.approx(-size, rel=1e-3)


@pytest.mark.parametrize("pair", [metal, morse, buckingham])
def test_the_smallest_step_that_is_promised_is_found(pair):
    places, steps = smallest_steps(Curve(pair), 1.8, 5.0, STEP)
    for place in np.random.default_rng(11).uniform(places[0], places[-1], 4):
        size = float(np.interp(place, places, steps))
        (found,), _ = find_jumps(Curve(stepped(pair, place, size)), 1.8, 5.0, STEP)
        assert (found.low, found.order) == (np.nextafter(place, 0.0), 1)


def test_the_smallest_step_is_reported():
    asked = Bare(laws.soft)
    low, high, half, everywhere = walked(asked).steps or (0,) * 4
    assert low < 1.5 and high == pytest.approx(R_CUT - 0.35, abs=0.1) and 0 < half <= everywhere < 1e-6
    names, told = summary(walk_pairs(asked), EnvironmentWalks((), 0, (), ()), (), asked.kT)
    assert names[-2:] == ["smoothness_least", "smoothness_least_but"] and told["beside"] == 0.35
    assert everywhere <= told["everywhere"] < 2 * everywhere + 1e-7


def test_pairs_that_were_not_walked_are_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(thresholds, "pairs", lambda subject: structures.pairs(subject, most=1))
    mixed = laws.Atoms("ArKrArArKrArArKrArArKrAr", grid(3, 2, 2))
    result = checked(subject(lambda: Pairwise(laws.soft), mixed))
    assert result.numbers["pairs_not_walked"] == ["Ar-Kr", "Kr-Kr"]
    assert (result.says[1]["pairs"], result.says[1]["of"]) == (1, 3)
    assert "smoothness_missing" in result.says[0]
    assert {"pair Ar-Kr", "pair Kr-Kr"} <= {what for what, _ in result.skipped}


def test_a_table_with_corners_has_more_kinks_than_are_measured():
    """Straight lines between points: the force jumps at each of them."""
    places = np.linspace(0.2, R_CUT, 46)
    energies = np.array([laws.soft(r)[0] for r in places])

    def table(r: float) -> tuple[float, float]:
        if r >= R_CUT:
            return 0.0, 0.0
        k = min(max(int(np.searchsorted(places, r, side="right")) - 1, 0), 44)
        force = -(energies[k + 1] - energies[k]) / (places[k + 1] - places[k])
        return float(energies[k] - force * (r - places[k])), float(force)

    found = walked(Bare(table))
    assert found.left_out > 0 and codes(reach(found, laws.KT)) == {"MANY_KINKS": "info"}
    corners = np.array([one.radius for one in found.thresholds])
    assert len(corners) > 12 and np.abs(corners[:, None] - places).min(axis=1).max() < 1e-9


@pytest.mark.parametrize(("onset", "steep"), [(4.4, True), (3.6, False)])
def test_a_switch_over_a_short_way_is_steep(onset: float, steep: bool, monkeypatch: pytest.MonkeyPatch):
    """Over 0.2 Å its curvature is eight times that of the well; over 1 Å it is less than that."""
    end = 4.6
    monkeypatch.setattr(laws, "R_ON", onset)
    monkeypatch.setattr(laws, "R_CUT", end)
    # the second derivative of the switch is 5.77 at most, over its width squared
    expected = 5.77 * abs(law(onset + 0.25 * (end - onset))[0]) / (end - onset) ** 2
    assert (expected > 5 * law(2 ** (1 / 6) * laws.SIGMA)[2]) == steep
    found = codes(reach(walked(Bare(laws.switched(2))), laws.KT))
    assert found == ({"STEEP_SWITCH": "warning"} if steep else {})


def test_rounding_of_forces_within_a_particle_is_no_interaction():
    """Atoms with companions, whose forces on one another add up to a last bit wherever they are."""

    class Residue(Pairwise):
        def calculate(self, *args, **kwargs):
            super().calculate(*args, **kwargs)
            self.results["forces"][-1, 0] += 2e-17

    first, second = (structures.trio("Ar", 3.1234, side) for side in (-1.0, 1.0))
    pair = Pair(("Ar", "Ar"), first, second, 0.0, False, "Ar3-Ar3")
    found = walk(subject(lambda: Residue(laws.soft), first + second), pair)
    assert found.cutoff == pytest.approx(R_CUT, rel=1e-2) and not codes(reach(found, laws.KT))


def dispersion(end: float, charge: float = 0.0):
    """Damped, and cut at a distance; beside charges that never end."""

    def law(r: float) -> tuple[float, float]:
        energy, force = (charge / r, charge / r**2) if charge else (0.0, 0.0)
        if r < end:
            energy, force = energy - 60 / (r**6 + 1e3), force - 360 * r**5 / (r**6 + 1e3) ** 2
        return energy, force

    return law


@pytest.mark.parametrize(("end", "charge"), [(20.0, 1.44), (31.75, 0.0), (44.4, 0.0)])
def test_a_cutoff_is_found_where_the_scan_has_long_ended(end: float, charge: float):
    walk = walked(laws.pair_subject(dispersion(end, charge)))
    (found,) = walk.thresholds
    assert (found.radius, found.order, found.dies) == (end, 0, not charge)
    assert found.jumps[0] == pytest.approx(60 / (end**6 + 1e3), rel=1e-6)
    assert walk.cutoff == (None if charge else end)
    assert bool(codes(reach(walk, laws.KT))) == bool(charge)


def test_no_more_is_claimed_than_was_searched():
    walk = walked(laws.pair_subject(laws.endless))
    (told,), further = reach(walk, laws.KT), walk.further
    assert told.variants == ["falls"] and further is not None and not walk.thresholds
    # 4 ε (σ/r)⁶ is left at the farthest, for the power of the distance is 6
    left = 4 * laws.EPSILON * (laws.SIGMA / further.reached) ** 6
    assert told.values["left"] == pytest.approx(1e3 * left, rel=1e-2) and left < 1e-7 * laws.KT
    # what is lost in rounding has no end there
    walk = walked(laws.pair_subject(lambda r: (float(np.exp(-r)) - 1e3, float(np.exp(-r)))))
    assert walk.cutoff is None or walk.cutoff < 30


# -- caps on neighbors are provoked ---------------------------------------------------------------


def crowded(make, most: int = NEIGHBORS, atoms: laws.Atoms | None = None):
    (found,) = crowd(subject(make, atoms), idle, [], most)
    return found


class Rounded(Capped):
    """Returns answers of five decimals."""

    def calculate(self, *args, **kwargs):
        super().calculate(*args, **kwargs)
        self.results = {name: np.round(value, 5) for name, value in self.results.items()}


@pytest.mark.parametrize(
    "make",
    [
        lambda: Pairwise(laws.soft),
        lambda: Pairwise(laws.soft, single=True),
        lambda: Rounded(10**6, "nearest"),
    ],
    ids=["double", "single", "rounded"],
)
def test_nothing_is_dropped_by_what_drops_nothing(make):
    found = crowded(make)
    assert (found.kept, found.order_from, found.neighbors, found.energy) == (None, None, NEIGHBORS, 0.0)


@pytest.mark.parametrize("most", [5, 16])
def test_a_choice_of_the_nearest_is_found(most: int):
    found = crowded(lambda: Capped(most, "nearest"))
    # energies are equal at the tie; half a pair force moves over from one neighbor to the other, and turns
    # its direction on the center
    assert (found.kept, found.energy, found.order_from) == (most, 0.0, None)
    half = 0.5 * laws.soft(found.distance)[1]
    atoms, _ = cluster(PAIR, R_CUT, NEIGHBORS)
    turned = np.linalg.norm(gap(atoms) - atoms.positions[most] / found.distance)
    assert found.force == pytest.approx(half * max(turned, 1.0), rel=1e-6)


@pytest.mark.slow
def test_a_choice_of_the_nearest_is_found_beyond_rounding():
    assert crowded(lambda: Rounded(5, "nearest")).kept == 5


def test_a_cap_by_the_order_of_the_atoms_is_found():
    found = crowded(lambda: Capped(12, "first"))
    assert found.order_from == 13 and found.order_energy > 1e-3


def test_a_crowd_that_is_not_supported_is_made_smaller():
    class Few(Pairwise):
        def calculate(self, atoms=None, *args, **kwargs):
            if atoms is not None and len(atoms) > 6 and not atoms.pbc.any():
                raise ValueError("too many atoms")
            super().calculate(atoms, *args, **kwargs)

    found = crowded(lambda: Few(laws.soft), 8, laws.Atoms("Ar8", grid(2, 2, 2)))
    assert found.neighbors == 4 and found.kept is None


def test_a_crowd_has_no_ties_and_is_inside_the_cutoff():
    atoms, distances = cluster(PAIR, R_CUT, 160)
    assert np.allclose(np.linalg.norm(atoms.positions[1:] - atoms.positions[0], axis=1), distances)
    assert (np.diff(distances) > 1e-4).all() and distances.max() < R_CUT
    apart = atoms.get_all_distances()
    assert apart[~np.eye(161, dtype=bool)].min() > 0.2 * R_CUT / 160 ** (1 / 3)
