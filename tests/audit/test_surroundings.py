"""Walks through surroundings and crowds, and what the check of smoothness makes of them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from ase import Atoms
from audit import laws
from audit.laws import R_CUT, law, subject
from audit.planted import codes, values

from mdnum.audit import structures, thresholds
from mdnum.audit.base import Ways, idle
from mdnum.audit.checks.smoothness import SmoothnessCheck
from mdnum.audit.structures import Pair
from mdnum.audit.subject import CalculatorSubject
from mdnum.audit.surroundings import Route, cluster, crowd, gap, walk_surroundings
from mdnum.audit.thresholds import PairWalks, find_thresholds, walk_pairs

NEIGHBORS = 12
PAIR = Pair(("Ar", "Ar"), Atoms("Ar"), Atoms("Ar"), 0.0, False, "Ar-Ar")


def dozen() -> Atoms:
    """A dozen argon atoms, in places without symmetry."""
    rng = np.random.default_rng(4)
    grid = np.stack(np.unravel_index(rng.permutation(27)[:12], (3, 3, 3)), axis=1) * 3.6
    return Atoms("Ar12", grid + rng.uniform(-0.4, 0.4, (12, 3)))


def grid(*shape: int) -> np.ndarray:
    return np.stack(np.unravel_index(np.arange(np.prod(shape)), shape), axis=1) * 3.6


@cache
def _walks(pair: laws.Law) -> PairWalks:
    return walk_pairs(subject(pair, dozen()))


def walked(asked: CalculatorSubject, pair: laws.Law) -> CalculatorSubject:
    """With what a walk of two of its atoms finds under the law of another test."""
    asked.known["walks"] = _walks(pair)
    return asked


def checked(asked: CalculatorSubject, routes: int = 0):
    check = SmoothnessCheck()
    check.neighbors, check.routes = 8, routes
    return check(asked)


def test_a_crossing_among_others_is_measured_to_the_last_bit():
    """Of a pair law, the jump among others is that of the two alone; more than were asked for are listed."""
    around = walk_surroundings(
        walked(subject(laws.hard, dozen()), laws.hard), idle, Ways(), crossings=2, routes=1
    )
    measured = [one for one in around.events if one.threshold is not None]
    assert len(measured) == around.measured == 2 and not around.unexplained
    for event in measured:
        assert event.jump.exact and event.jump.high == np.nextafter(event.jump.low, np.inf)
        assert abs(event.jump.energy) == pytest.approx(abs(law(R_CUT)[0]), rel=1e-9)
        assert event.force == pytest.approx(abs(law(R_CUT)[1]), rel=1e-9)


def test_crossings_beyond_the_number_that_is_measured_are_listed():
    asked, ways = walked(subject(laws.hard, Atoms("Ar8", grid(2, 2, 2))), laws.hard), Ways()
    around = walk_surroundings(asked, idle, ways, crossings=1, routes=0)
    assert (around.measured, ways.asked) == (1, ways.possible)
    assert ("1 more crossings", "1 were") in [(what[:16], why[:6]) for what, why in ways.skipped]


def test_what_depends_on_three_is_found_where_two_show_nothing():
    """A constant for each angle with two short sides: invisible to two atoms, a jump for three."""
    asked = subject(laws.soft, dozen(), side=4.05)
    assert [one.radius for one in find_thresholds(asked)] == [pytest.approx(R_CUT, rel=0.01)]
    result = checked(asked, routes=2)
    assert codes(result)["JUMP_AMONG_MANY"] == "error" and result.numbers["unexplained"] > 0


def test_crossings_on_a_route_are_those_of_a_fine_scan():
    """Roots of a quadratic against signs on a fine grid, images of a small skewed cell included."""
    rng = np.random.default_rng(7)
    cell = np.diag([7.0, 8.0, 9.0]) + np.tril(rng.uniform(-1, 1, (3, 3)), -1)
    atoms = Atoms("Ar4", rng.uniform(0, 7, (4, 3)), cell=cell, pbc=(True, True, False))
    (threshold,) = find_thresholds(laws.Bare(laws.hard))
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
    result = checked(walked(subject(laws.hard, dozen()), laws.hard))
    assert codes(result) == {"ENERGY_JUMP": "error"}
    told = values(result, "ENERGY_JUMP")
    assert told["inside"].value == float(np.nextafter(R_CUT, 0.0)) and told["variants"] == ["among"]
    assert told["energy"].value == pytest.approx(-law(R_CUT)[0], rel=1e-9)
    assert told["energy"].scale == laws.KT and told["at"].digits == repr(R_CUT)
    assert told["kT"] == pytest.approx(abs(law(R_CUT)[0]) / laws.KT, rel=1e-9)
    assert result.numbers["cutoffs"] == {"Ar-Ar": R_CUT}
    assert result.says[0][:3] == ["smoothness_walked", "smoothness_ends", "smoothness_jumps_energy"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        (laws.shifted, {"FORCE_JUMP": "warning"}),
        (laws.switched(1), {"CURVATURE_JUMP": "info"}),
        (laws.switched(2), {}),
    ],
)
def test_what_is_found_of_a_shift_and_of_switches(pair, expected: dict[str, str]):
    assert codes(checked(subject(pair, dozen()))) == expected


def test_pairs_that_were_not_walked_are_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(thresholds, "pairs", lambda subject: structures.pairs(subject, most=1))
    result = checked(subject(laws.soft, Atoms("ArKrArArKrArArKrArArKrAr", grid(3, 2, 2))))
    assert result.numbers["pairs_not_walked"] == ["Ar-Kr", "Kr-Kr"]
    assert (result.says[1]["pairs"], result.says[1]["of"]) == (1, 3)
    assert "smoothness_missing" in result.says[0]
    assert {"pair Ar-Kr", "pair Kr-Kr"} <= {what for what, _ in result.skipped}


# -- caps on neighbors are provoked ---------------------------------------------------------------


def crowded(most: int = NEIGHBORS, **options):
    asked = subject(laws.soft, **options)
    if not {"single", "places"} & set(options):  # two atoms show nothing of the rest
        walked(asked, laws.soft)
    (found,) = crowd(asked, idle, Ways(), most)
    return found


@pytest.mark.parametrize("options", [{}, {"single": True}, {"keep": 10**6, "places": 5}])
def test_nothing_is_dropped_by_what_drops_nothing(options: dict[str, object]):
    found = crowded(**options)
    assert (found.kept, found.order.start, found.neighbors, found.energy) == (None, None, NEIGHBORS, 0.0)


@pytest.mark.parametrize("kept", [5, 9])
def test_a_choice_of_the_nearest_is_found(kept: int):
    found = crowded(keep=kept)
    # energies are equal at the tie; half a pair force moves over from one neighbor to the other, and turns
    # its direction on the center
    assert (found.kept, found.energy, found.order.start, found.by_number) == (kept, 0.0, None, True)
    half = 0.5 * laws.soft(found.distance)[1]
    atoms, _ = cluster(PAIR, R_CUT, NEIGHBORS)
    turned = np.linalg.norm(gap(atoms) - atoms.positions[kept] / found.distance)
    assert found.force == pytest.approx(half * max(turned, 1.0), rel=1e-6)


@pytest.mark.slow
def test_a_choice_of_the_nearest_is_found_beyond_rounding():
    assert crowded(keep=5, places=5).kept == 5


def test_a_cap_by_the_order_of_the_atoms_is_found():
    found = crowded(keep=7, by="first")
    assert found.order.start == 8 and found.order.energy > 1e-3 and found.order.by_number


def test_a_crowd_that_is_not_supported_is_made_smaller():
    class Few(laws.Pairwise):
        def calculate(self, atoms=None, *args, **kwargs):
            if atoms is not None and len(atoms) > 6 and not atoms.pbc.any():
                raise ValueError("too many atoms")
            super().calculate(atoms, *args, **kwargs)

    asked = CalculatorSubject("few", lambda: Few(laws.soft), Atoms("Ar8", grid(2, 2, 2)), kT=laws.KT)
    (found,) = crowd(walked(asked, laws.soft), idle, Ways(), 8)
    assert found.neighbors == 4 and found.kept is None


def test_a_crowd_has_no_ties_and_is_inside_the_cutoff():
    atoms, distances = cluster(PAIR, R_CUT, 160)
    assert np.allclose(np.linalg.norm(atoms.positions[1:] - atoms.positions[0], axis=1), distances)
    assert (np.diff(distances) > 1e-4).all() and distances.max() < R_CUT
    apart = atoms.get_all_distances()
    assert apart[~np.eye(161, dtype=bool)].min() > 0.2 * R_CUT / 160 ** (1 / 3)
