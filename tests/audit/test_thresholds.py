"""Thresholds are found where they are, to the last bit, with the jumps that a closed form has there."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from audit import laws
from audit.laws import R_CUT, R_ON, Bare, law, stepped, subject
from audit.planted import codes
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from mdnum.audit.building import default_structure
from mdnum.audit.checks.smoothness import figures, place, reach
from mdnum.audit.curve import Curve, bisect, find_jumps, smallest_steps
from mdnum.audit.record import load_calculator
from mdnum.audit.structures import Pair, trio
from mdnum.audit.subject import CalculatorSubject
from mdnum.audit.surroundings import EnvironmentWalks
from mdnum.audit.thresholds import STEP, PairWalk, find_thresholds, walk, walk_pairs

BEFORE = float(np.nextafter(R_CUT, 0.0))
AFTER = float(np.nextafter(R_CUT, 9.0))
COPPER = Path(__file__).parents[2] / "systems" / "copper" / "cu.eam.alloy"
#: J. Tersoff, Phys. Rev. B 38, 9902 (1988), in the order of LAMMPS
SILICON = "Si Si Si 3 1 0 1.0039e5 16.217 -0.59825 0.78734 1.1e-6 1.7322 471.18 2.85 0.15 2.4799 1830.8\n"


def walked(asked: CalculatorSubject) -> PairWalk:
    (found,) = walk_pairs(asked).walks
    return found


@pytest.mark.parametrize(
    ("pair", "inside", "outside"), [(laws.hard, BEFORE, R_CUT), (laws.including, R_CUT, AFTER)]
)
def test_a_hard_cutoff_is_located_to_neighboring_doubles(pair, inside: float, outside: float):
    (found,) = find_thresholds(Bare(pair))
    assert (found.inside, found.outside, found.radius) == (inside, outside, outside)
    assert (found.order, found.dies) == (0, True)
    energy, force, curvature = law(inside)
    assert found.jumps[:2] == pytest.approx((-energy, -force), rel=1e-13)
    assert found.jumps[2] == pytest.approx(-curvature, rel=1e-6)


def test_a_decision_on_squares_is_located_where_the_squares_differ():
    """The last double whose rounded square is below the rounded square of the cutoff."""
    (found,) = find_thresholds(Bare(laws.squared))
    limit = Fraction(R_CUT * R_CUT)
    assert Fraction(found.inside * found.inside) < limit <= Fraction(found.outside * found.outside)
    assert np.nextafter(found.inside, 9.0) == found.outside


def test_a_walk_of_few_calls_looks_at_what_stands_out_most():
    asked = Bare(laws.hard)
    found = walk(asked, walked(asked).pair, calls=1)
    assert np.diff(found.distance)[-1] == pytest.approx(STEP, rel=0.05)
    assert [one.radius for one in found.thresholds] == [R_CUT] and found.calls < 1000


def test_orders_and_sizes_of_jumps():
    """Shifted, force-shifted, switched once and twice; an energy of the atoms' own hides none of them."""
    own = -1234.5
    (shifted,) = find_thresholds(Bare(laws.shifted, own))
    assert (shifted.order, shifted.radius) == (1, R_CUT)
    assert shifted.jumps[1] == pytest.approx(-law(R_CUT)[1], rel=1e-12)

    (force_shifted,) = find_thresholds(Bare(laws.force_shifted, own))
    assert force_shifted.order == 2
    assert force_shifted.radius == pytest.approx(R_CUT, abs=1e-9)
    assert force_shifted.jumps[2] == pytest.approx(-law(R_CUT)[2], rel=1e-5)

    onset, end = find_thresholds(Bare(laws.switched(1), own))
    assert (onset.order, end.order, onset.dies, end.dies) == (2, 2, False, True)
    assert onset.radius == pytest.approx(R_ON, abs=2e-5)
    # E'' of e s is e s'' more than before the onset, and s'' is -6 / width² there and 6 / width² at the end
    bend = 6 / (R_CUT - R_ON) ** 2
    assert onset.jumps[2] == pytest.approx(-law(R_ON)[0] * bend, rel=1e-4)
    assert end.jumps[2] == pytest.approx(-law(R_CUT)[0] * bend, rel=1e-4)

    onset, end = find_thresholds(Bare(laws.switched(2), own))
    assert (onset.order, end.order, onset.dies, end.dies) == (3, 3, False, True)
    # the third derivative of the switch is -60 over the cube of its width at the onset
    assert (onset.radius, end.radius) == pytest.approx((R_ON, R_CUT), abs=3e-6)
    assert onset.third == pytest.approx(-law(R_ON)[0] * 60 / (R_CUT - R_ON) ** 3, rel=1e-3)


def test_knots_of_a_table_are_no_thresholds():
    """A cubic spline through the points of a law: its third derivative jumps at each of them."""
    places = np.linspace(2.0, 8.0, 20)
    spline = CubicSpline(places, [laws.soft(r)[0] for r in places])
    found = walked(Bare(lambda r: (float(spline(r)), -float(spline(r, 1)))))
    assert found.knots > 6 and all(one.order != 3 or one.dies for one in found.thresholds)


def late(r: float) -> tuple[float, float]:
    """Switched off with two continuous derivatives, by a form that keeps its digits at the end."""
    if r >= R_CUT:
        return 0.0, 0.0
    energy, force, _ = law(r)
    width = R_CUT - R_ON
    left = min((R_CUT - r) / width, 1.0)
    on = left**3 * (10 - 15 * left + 6 * left**2)
    return energy * on, force * on + energy * 30 * left**2 * (1 - left) ** 2 / width


def zero_where_rounded(r: float) -> tuple[float, float]:
    """Switched off by a sine, and left out where the switch rounds to 0: a little before its end."""
    on = 0.5 * (1 - np.sin(np.pi * (r - 6.1) / 0.4)) if r > 5.9 else 1.0
    if r >= R_CUT or on == 0.0:
        return 0.0, 0.0
    energy, force, _ = law(r)
    slope = -0.5 * np.pi / 0.4 * np.cos(np.pi * (r - 6.1) / 0.4) if r > 5.9 else 0.0
    return float(energy * on), float(force * on - energy * slope)


def vanishing(r: float) -> tuple[float, float]:
    """exp(a / (r - R)), as Stillinger and Weber end their law: it is gone before R, and with no power."""
    energy = -float(np.exp(2.0 / (r - R_CUT))) if r < R_CUT else 0.0
    return energy, 2.0 * energy / (r - R_CUT) ** 2 if energy else 0.0


@pytest.mark.parametrize(
    ("pair", "orders", "within"),
    [
        # where the force goes with a power only in the limit, its continuation misses the end by 1e-5 Å
        (late, [3, 3], 0.0),
        # (1 - r/R)^4: the fourth derivative is the first that jumps
        (laws.soft, [4], 1e-3),
        # cut where it rounds to nothing, which is no jump of the force
        (zero_where_rounded, [2, 2], 1e-7),
        (vanishing, [6], 5e-3),
        (laws.endless, [], 0.0),
        (lambda r: (0.0, 0.0), [], 0.0),
    ],
    ids=["late", "soft", "rounded to 0", "vanishing", "endless", "nothing"],
)
def test_ends(pair, orders: list[int], within: float):
    found = walked(Bare(pair))
    assert [one.order for one in found.thresholds] == orders
    assert [one.dies for one in found.thresholds] == [k + 1 == len(orders) for k in range(len(orders))]
    if not orders:
        assert found.cutoff is None and (pair is laws.endless or not found.energy.any())
        return
    end = found.thresholds[-1]
    assert end.radius == pytest.approx(R_CUT, abs=within, rel=0.0)
    if pair is late:
        assert (end.inside, end.outside, place(end).digits) == (BEFORE, R_CUT, repr(R_CUT))


def two(pair, **options) -> CalculatorSubject:
    return subject(pair, Atoms("Ar2", [(0, 0, 0), (4, 0, 0)]), **options)


def test_rounding_to_decimals_is_not_taken_for_jumps():
    """Every answer is one of some steps of 1e-5; an end of a smooth law is still told."""
    (end,) = find_thresholds(two(laws.force_shifted, places=5))
    assert end.dies and end.order == 6 and end.jumps == (0.0, 0.0, 0.0)


@pytest.mark.slow
def test_a_jump_of_more_than_rounding_is_told_among_rounded_answers():
    (found,) = find_thresholds(two(laws.hard, places=5))
    assert (found.order, found.radius) == (0, R_CUT)
    assert found.jumps[0] == pytest.approx(-law(R_CUT)[0], abs=1e-5)


def test_float32_is_not_taken_for_jumps():
    """What rounds everything has a step at every representable float32; only the real one counts."""
    (found,) = find_thresholds(two(laws.shifted, single=True))
    assert found.order == 1
    assert found.radius == pytest.approx(R_CUT, abs=1e-6)
    assert found.jumps[1] == pytest.approx(-law(R_CUT)[1], rel=1e-4)


#: Words, a structure with its species where the one by default takes long to find, and (distance, order) of
#: each threshold of two, from the calculators' own documentation and source.
ASES_OWN = {
    "lj": ("lj:LennardJones(sigma=3.4, epsilon=0.01, rc=8.5)", "Ar", [(8.5, 1)]),
    "lj smooth": (
        "lj:LennardJones(sigma=3.4, epsilon=0.01, rc=8.5, ro=6.0, smooth=True)", "Ar", [(6.0, 2), (8.5, 2)],
    ),
    "morse": ("morse:MorsePotential(epsilon=0.5, r0=2.6)", "Ar", [(1.9 * 2.6, 3), (2.7 * 2.6, 3)]),
    "tip3p": ("tip3p:TIP3P(rc=5.5, width=1.0)", None, [(4.5, 2), (5.5, 2)]),
    "tip4p": ("tip4p:TIP4P(rc=5.5, width=1.0)", None, [(4.5, 2), (5.5, 2)]),
    "emt": ("emt:EMT", "Cu", [(5.8768, 0)]),
    "eam": (f"eam:EAM(potential={str(COPPER)!r})", "Cu", [(5.50679, 1)]),
    "tersoff": ("tersoff:Tersoff.from_lammps('silicon.tersoff')", "Si", [(2.7, 2), (3.0, 2)]),
}  # fmt: skip
#: Every night: long ones, and those of which another in the gate has the kind.
AT_NIGHT = ("tip4p", "eam", "tersoff", "lj", "morse")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] * (name in AT_NIGHT)) for name in ASES_OWN]
)
def test_ases_own(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "silicon.tersoff").write_text(SILICON)
    monkeypatch.chdir(tmp_path)
    words, atoms, expected = ASES_OWN[name]
    loaded = load_calculator(f"ase.calculators.{words}")
    structure = bulk(atoms) if atoms else default_structure(loaded)
    found = walked(CalculatorSubject(words, loaded.make, structure)).thresholds
    assert [one.order for one in found] == [order for _, order in expected]
    assert [one.radius for one in found] == [pytest.approx(r, abs=2e-4) for r, _ in expected]


# -- curves ---------------------------------------------------------------------------------------


def wall(r: float) -> tuple[float, float]:
    energy, force, _ = law(r)
    return 100 * energy, 100 * force


def raised(pair, place: float, size: float):
    """A law with an energy that is larger before a place."""
    return lambda r: (pair(r)[0] + size * (r < place), pair(r)[1])


@pytest.mark.parametrize(("change", "pair", "row"), [(raised, wall, 0), (stepped, laws.soft, 1)])
@given(place=st.floats(3.2, 5.9), power=st.floats(0.0, 1.0))
@settings(max_examples=10)
def test_a_step_is_found_wherever_it_is(change, pair, row: int, place: float, power: float):
    """On a wall of eV/Å; by what the force's work does not explain, long before the values stand out."""
    size = 10.0 ** (-5.5 + 4.5 * power if row == 0 else -8.0 + 6.0 * power)
    (found,), _ = find_jumps(Curve(change(pair, place, size)), 2.8, 6.2, STEP)
    assert (found.low, found.high, found.order) == (np.nextafter(place, 0.0), place, row)
    assert (found.energy, found.force)[row] == pytest.approx(-size, rel=1e-4)


@pytest.mark.parametrize(
    "curve",
    [
        lambda x: (float(x**-12), float(12 * x**-13)),
        lambda x: (float(np.sin(9 * x)), float(-9 * np.cos(9 * x))),
        lambda x: (float(1e5 + np.exp(-x * x)), float(2 * x * np.exp(-x * x))),
    ],
    ids=["steep", "wavy", "large"],
)
def test_smooth_curves_have_no_jumps(curve):
    """What a scan cannot resolve well must not be called a jump."""
    assert find_jumps(Curve(curve), 0.7, 4.0, 0.025) == ([], 0)


def test_two_steps_close_together_are_two():
    steps = Curve(lambda x: (float((x > 1.3) + 0.5 * (x > 1.45)), 0.0))
    jumps, _ = find_jumps(steps, 1.0, 2.0, 0.025)
    assert [(one.order, one.energy) for one in jumps] == [(0, 1.0), (0, 0.5)]


@given(st.floats(-1e3, 1e3))
def test_bisection_ends_at_neighboring_doubles(edge: float):
    low, high = bisect(lambda x: x <= edge, -2e3, 2e3)
    assert low == edge or (edge == 0 and low <= 0 <= high)
    assert high == np.nextafter(low, np.inf)


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
    """As is the smallest one that is promised, which is no larger there, wherever it is."""
    places, steps = smallest_steps(Curve(pair), low, 5.0, STEP)
    assert np.interp(place, places, steps) <= size
    drawn = np.random.default_rng(11).uniform(places[0], places[-1], 2)
    for at, by in ((place, size), *zip(drawn, np.interp(drawn, places, steps), strict=True)):
        (found,), _ = find_jumps(Curve(stepped(pair, at, by)), low, 5.0, STEP)
        assert (found.low, found.high, found.order) == (np.nextafter(at, 0.0), at, 1)
        assert at != place or found.force == pytest.approx(-size, rel=1e-3)


def test_the_smallest_step_is_reported():
    asked = Bare(laws.soft)
    low, high, half, everywhere = walked(asked).steps or (0,) * 4
    assert low < 1.5 and high == pytest.approx(R_CUT - 0.35, abs=0.1) and 0 < half <= everywhere < 1e-6
    (names, told), _ = figures(walk_pairs(asked), EnvironmentWalks((), 0, ()), (), asked.kT)
    assert names[-2:] == ["smoothness_least", "smoothness_least_but"] and told["beside"] == 0.35
    assert everywhere <= told["everywhere"] < 2 * everywhere + 1e-7


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

    class Residue(laws.Pairwise):
        def calculate(self, *args, **kwargs):
            super().calculate(*args, **kwargs)
            self.results["forces"][-1, 0] += 2e-17

    first, second = (trio("Ar", 3.1234, side) for side in (-1.0, 1.0))
    pair = Pair(("Ar", "Ar"), first, second, 0.0, False, "Ar3-Ar3")
    asked = CalculatorSubject("planted", lambda: Residue(laws.soft), first + second, kT=laws.KT)
    found = walk(asked, pair)
    assert found.cutoff == pytest.approx(R_CUT, rel=1e-2) and not codes(reach(found, laws.KT))


# -- past the scan --------------------------------------------------------------------------------


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
    found = walked(Bare(dispersion(end, charge)))
    (threshold,) = found.thresholds
    assert (threshold.radius, threshold.order, threshold.dies) == (end, 0, not charge)
    assert threshold.jumps[0] == pytest.approx(60 / (end**6 + 1e3), rel=1e-6)
    assert found.cutoff == (None if charge else end)
    assert bool(codes(reach(found, laws.KT))) == bool(charge)


def test_no_more_is_claimed_than_was_searched():
    found = walked(Bare(laws.endless))
    (told,), further = reach(found, laws.KT), found.further
    assert told.variants == ["falls"] and further is not None and not found.thresholds
    # 4 ε (σ/r)⁶ is left at the farthest, for the power of the distance is 6
    left = 4 * laws.EPSILON * (laws.SIGMA / further.reached) ** 6
    assert told.values["left"].value == pytest.approx(left, rel=1e-2) and left < 1e-7 * laws.KT
    # what is lost in rounding has no end there
    found = walked(Bare(lambda r: (float(np.exp(-r)) - 1e3, float(np.exp(-r)))))
    assert found.cutoff is None or found.cutoff < 30
