"""Thresholds are found where they are, to the last bit, with the jumps that a closed form has there."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from audit import laws
from audit.laws import R_CUT, R_ON, law, pair_subject
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from mdnum.audit.checks.smoothness import place
from mdnum.audit.curve import Curve, bisect, find_jumps
from mdnum.audit.thresholds import STEP, find_thresholds, walk, walk_pairs

BEFORE = float(np.nextafter(R_CUT, 0.0))
AFTER = float(np.nextafter(R_CUT, 9.0))


@pytest.mark.parametrize(
    ("pair", "inside", "outside"), [(laws.hard, BEFORE, R_CUT), (laws.including, R_CUT, AFTER)]
)
def test_a_hard_cutoff_is_located_to_neighboring_doubles(pair, inside: float, outside: float):
    (found,) = find_thresholds(pair_subject(pair))
    assert (found.inside, found.outside, found.radius) == (inside, outside, outside)
    assert found.order == 0
    assert found.dies
    energy, force, curvature = law(inside)
    assert found.jumps[0] == pytest.approx(-energy, rel=1e-13)
    assert found.jumps[1] == pytest.approx(-force, rel=1e-13)
    assert found.jumps[2] == pytest.approx(-curvature, rel=1e-6)


def test_a_decision_on_squares_is_located_where_the_squares_differ():
    """The last double whose rounded square is below the rounded square of the cutoff."""
    (found,) = find_thresholds(pair_subject(laws.squared))
    limit = Fraction(R_CUT * R_CUT)
    assert Fraction(found.inside * found.inside) < limit <= Fraction(found.outside * found.outside)
    assert np.nextafter(found.inside, 9.0) == found.outside


def test_a_walk_of_few_calls_looks_at_what_stands_out_most():
    asked = pair_subject(laws.hard)
    (pair,) = (one.pair for one in walk_pairs(asked).walks)
    found = walk(asked, pair, calls=1)
    assert np.diff(found.distance)[-1] == pytest.approx(STEP, rel=0.05)
    assert [one.radius for one in found.thresholds] == [R_CUT] and found.calls < 1000


def test_orders_and_sizes_of_jumps():
    """Shifted, force-shifted, switched once and twice; an energy of the atoms' own hides none of them."""
    own = -1234.5
    (shifted,) = find_thresholds(pair_subject(laws.shifted, own=own))
    assert (shifted.order, shifted.radius) == (1, R_CUT)
    assert shifted.jumps[1] == pytest.approx(-law(R_CUT)[1], rel=1e-12)

    (force_shifted,) = find_thresholds(pair_subject(laws.force_shifted, own=own))
    assert force_shifted.order == 2
    assert force_shifted.radius == pytest.approx(R_CUT, abs=1e-9)
    assert force_shifted.jumps[2] == pytest.approx(-law(R_CUT)[2], rel=1e-5)

    onset, end = find_thresholds(pair_subject(laws.switched(1), own=own))
    assert (onset.order, end.order) == (2, 2)
    assert (onset.dies, end.dies) == (False, True)
    assert onset.radius == pytest.approx(R_ON, abs=2e-5)
    # E'' of e s is e s'' more than before the onset, and s'' is -6 / width² there and 6 / width² at the end
    bend = 6 / (R_CUT - R_ON) ** 2
    assert onset.jumps[2] == pytest.approx(-law(R_ON)[0] * bend, rel=1e-4)
    assert end.jumps[2] == pytest.approx(-law(R_CUT)[0] * bend, rel=1e-4)

    twice = find_thresholds(pair_subject(laws.switched(2), own=own))
    assert [(one.order, one.dies) for one in twice] == [(3, False), (3, True)]
    # the third derivative of the switch is -60 over the cube of its width at the onset
    assert twice[0].radius == pytest.approx(R_ON, abs=3e-6)
    assert twice[0].third == pytest.approx(-law(R_ON)[0] * 60 / (R_CUT - R_ON) ** 3, rel=1e-3)
    assert twice[1].radius == pytest.approx(R_CUT, abs=3e-6)


def test_knots_of_a_table_are_no_thresholds():
    """A cubic spline through the points of a law: its third derivative jumps at each of them."""
    places = np.linspace(2.0, 8.0, 20)
    spline = CubicSpline(places, [laws.soft(r)[0] for r in places])
    (walk,) = walk_pairs(pair_subject(lambda r: (float(spline(r)), -float(spline(r, 1))))).walks
    assert walk.knots > 6 and all(one.order != 3 or one.dies for one in walk.thresholds)


def _late(r: float) -> tuple[float, float]:
    """Switched off with two continuous derivatives, by a form that keeps its digits at the end."""
    if r >= R_CUT:
        return 0.0, 0.0
    energy, force, _ = law(r)
    width = R_CUT - R_ON
    left = min((R_CUT - r) / width, 1.0)
    on = left**3 * (10 - 15 * left + 6 * left**2)
    return energy * on, force * on + energy * 30 * left**2 * (1 - left) ** 2 / width


def test_a_smooth_end_that_is_known_to_the_last_bit_is_not_guessed_at():
    """Where the force goes with a power only in the limit, its continuation misses the end by 1e-5 Å."""
    onset, end = find_thresholds(pair_subject(_late))
    assert (onset.order, onset.dies) == (3, False)
    assert (end.inside, end.outside, end.radius, end.order) == (BEFORE, R_CUT, R_CUT, 3)
    assert place(end) == repr(R_CUT)


def test_smoother_ends_have_higher_orders():
    """(1 - r/R)^4: the fourth derivative is the first that jumps."""
    (end,) = find_thresholds(pair_subject(laws.soft))
    assert end.order == 4
    assert end.radius == pytest.approx(R_CUT, abs=1e-3)


def _zero_where_rounded(r: float) -> tuple[float, float]:
    """Switched off by a sine, and left out where the switch rounds to 0: a little before its end."""
    on = 0.5 * (1 - np.sin(np.pi * (r - 6.1) / 0.4)) if r > 5.9 else 1.0
    if r >= R_CUT or on == 0.0:
        return 0.0, 0.0
    energy, force, _ = law(r)
    slope = -0.5 * np.pi / 0.4 * np.cos(np.pi * (r - 6.1) / 0.4) if r > 5.9 else 0.0
    return float(energy * on), float(force * on - energy * slope)


def test_a_smooth_end_that_is_cut_where_it_rounds_to_nothing_is_no_jump_of_the_force():
    onset, end = find_thresholds(pair_subject(_zero_where_rounded))
    assert (onset.order, end.order, end.dies) == (2, 2, True)
    assert end.radius == pytest.approx(R_CUT, abs=1e-7)


def test_an_end_at_which_every_derivative_vanishes():
    """exp(a / (r - R)), as Stillinger and Weber end their law: it is gone before R, and with no power."""

    def law(r: float) -> tuple[float, float]:
        if r >= R_CUT:
            return 0.0, 0.0
        energy = -float(np.exp(2.0 / (r - R_CUT)))
        return energy, 2.0 * energy / (r - R_CUT) ** 2

    (end,) = find_thresholds(pair_subject(law))
    assert end.order == 6 and end.dies
    assert end.radius == pytest.approx(R_CUT, abs=5e-3)


def test_what_has_no_cutoff_has_no_threshold():
    (walk,) = walk_pairs(pair_subject(laws.endless)).walks
    assert walk.cutoff is None
    assert not walk.thresholds


def test_what_feels_nothing_has_no_threshold():
    (walk,) = walk_pairs(pair_subject(lambda r: (0.0, 0.0))).walks
    assert not walk.thresholds
    assert not walk.energy.any()


def rounded(pair):
    """Two atoms under a law whose answers have five decimals."""

    class Rounded(laws.Pairwise):
        def calculate(self, atoms=None, properties=None, system_changes=("positions",)):
            super().calculate(atoms, properties, system_changes)
            self.results = {name: np.round(value, 5) for name, value in self.results.items()}

    return laws.subject(lambda: Rounded(pair), laws.Atoms("Ar2", [(0, 0, 0), (4, 0, 0)]))


def test_rounding_to_decimals_is_not_taken_for_jumps():
    """Every answer is one of some steps of 1e-5; an end of a smooth law is still told."""

    (end,) = find_thresholds(rounded(laws.force_shifted))
    assert end.dies and end.order == 6 and end.jumps == (0.0, 0.0, 0.0)


@pytest.mark.slow
def test_a_jump_of_more_than_rounding_is_told_among_rounded_answers():
    (found,) = find_thresholds(rounded(laws.hard))
    assert (found.order, found.radius) == (0, R_CUT)
    assert found.jumps[0] == pytest.approx(-law(R_CUT)[0], abs=1e-5)


def test_float32_is_not_taken_for_jumps():
    """What rounds everything has a step at every representable float32; only the real one counts."""
    (found,) = find_thresholds(pair_subject(laws.shifted, single=True))
    assert found.order == 1
    assert found.radius == pytest.approx(R_CUT, abs=1e-6)
    assert found.jumps[1] == pytest.approx(-law(R_CUT)[1], rel=1e-4)


@given(place=st.floats(3.2, 5.9), size=st.floats(-5.5, -1.0).map(lambda power: 10.0**power))
@settings(max_examples=25)
def test_a_step_of_the_energy_is_found_however_steep_the_law(place: float, size: float):
    """On a wall of eV/Å; by what the force's work does not explain, long before the values stand out."""

    def pair(r: float) -> tuple[float, float]:
        energy, force = (100 * value for value in law(r)[:2])
        return (energy + size, force) if r < place else (energy, force)

    (found,), _ = find_jumps(Curve(pair), 2.8, 6.2, STEP)
    assert (found.low, found.high) == (np.nextafter(place, 0.0), place)
    assert found.order == 0
    assert found.energy == pytest.approx(-size, rel=1e-4)


@given(place=st.floats(3.2, 5.9), size=st.floats(-8.0, -2.0).map(lambda power: 10.0**power))
@settings(max_examples=25)
def test_a_step_of_the_force_is_found_wherever_it_is(place: float, size: float):
    def pair(r: float) -> tuple[float, float]:
        energy, force = laws.soft(r)
        return (energy + size * (place - r), force + size) if r < place else (energy, force)

    (found,), _ = find_jumps(Curve(pair), 2.8, 6.2, STEP)
    assert (found.low, found.high) == (np.nextafter(place, 0.0), place)
    assert found.order == 1
    assert found.force == pytest.approx(-size, rel=1e-4)


def test_smooth_curves_have_no_jumps():
    """Steep, wavy, large: what a scan cannot resolve well must not be called a jump."""

    def wall(x: float) -> tuple[float, float]:
        return float(x**-12), float(12 * x**-13)

    def wave(x: float) -> tuple[float, float]:
        return float(np.sin(9 * x)), float(-9 * np.cos(9 * x))

    def offset(x: float) -> tuple[float, float]:
        return float(1e5 + np.exp(-x * x)), float(2 * x * np.exp(-x * x))

    for curve in (wall, wave, offset):
        assert find_jumps(Curve(curve), 0.7, 4.0, 0.025) == ([], 0)


def test_two_steps_close_together_are_two():
    def steps(x: float) -> tuple[float, float]:
        return float((x > 1.3) + 0.5 * (x > 1.45)), 0.0

    jumps, _ = find_jumps(Curve(steps), 1.0, 2.0, 0.025)
    assert [(one.order, one.energy) for one in jumps] == [(0, 1.0), (0, 0.5)]


@given(st.floats(-1e3, 1e3))
def test_bisection_ends_at_neighboring_doubles(edge: float):
    low, high = bisect(lambda x: x <= edge, -2e3, 2e3)
    assert low == edge or (edge == 0 and low <= 0 <= high)
    assert high == np.nextafter(low, np.inf)
