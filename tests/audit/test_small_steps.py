"""How small a step of the force is found, what is said of it, and of pairs that were not walked."""

from __future__ import annotations

import numpy as np
import pytest
from audit import laws, planted
from audit.laws import R_CUT, Pairwise, law, subject

from mdnum.audit import environments, probes, provoke, thresholds
from mdnum.audit.crowd_words import reach, units_of
from mdnum.audit.curve import Curve
from mdnum.audit.digits import precision
from mdnum.audit.environments import Surroundings
from mdnum.audit.jumps import find_jumps, smallest_steps
from mdnum.audit.noise import Noise, settled
from mdnum.audit.smoothness import Smoothness
from mdnum.audit.smoothness_words import summary
from mdnum.audit.subject import CalculatorSubject
from mdnum.audit.thresholds import STEP, walk, walk_pairs


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


class Bare:
    """Two atoms under a law, asked without ASE's calculators in between."""

    name, kT = "bare", laws.KT
    atoms = laws.Atoms("Ar2", [(0, 0, 0), (4, 0, 0)])

    def __init__(self, pair):
        self.pair = pair

    def energy(self, atoms) -> float:
        return self.pair(float(atoms.positions[1, 0]))[0]

    def forces(self, atoms) -> np.ndarray:
        force = self.pair(float(atoms.positions[1, 0]))[1]
        return np.array([[-force, 0.0, 0.0], [force, 0.0, 0.0]])

    def fresh(self) -> Bare:
        return self


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
def test_what_is_told_of_the_smallest_step_is_so(pair):
    """One as large as is told is found, wherever it is."""
    places, steps = smallest_steps(Curve(pair), 1.8, 5.0, STEP)
    rng = np.random.default_rng(11)
    for place in rng.uniform(places[0], places[-1], 4):
        size = float(np.interp(place, places, steps))
        (found,), _ = find_jumps(Curve(stepped(pair, place, size)), 1.8, 5.0, STEP)
        assert (found.low, found.order) == (np.nextafter(place, 0.0), 1)


def test_the_smallest_step_is_told():
    asked = Bare(laws.soft)
    walks = walk_pairs(asked)
    (walk,) = walks.walks
    assert walk.steps is not None
    low, high, half, everywhere = walk.steps
    assert low < 1.5 and high == pytest.approx(R_CUT - 0.35, abs=0.1) and 0 < half <= everywhere < 1e-6
    nothing = Surroundings((), 0, (), 0, (), 2)
    says = summary(walks, nothing, (), asked.kT, units_of(asked))
    assert "A step of the force above" in says and "0.35 Å beside a threshold" in says


def test_pairs_that_were_not_walked_are_named(monkeypatch: pytest.MonkeyPatch):
    found = thresholds.pairs
    monkeypatch.setattr(thresholds, "pairs", lambda subject: found(subject, most=1))
    grid = np.stack(np.unravel_index(np.arange(12), (3, 2, 2)), axis=1) * 3.6
    mixed = laws.Atoms("ArKrArArKrArArKrArArKrAr", grid)
    part = Smoothness(neighbors=8, routes=0)(subject(lambda: Pairwise(laws.soft), mixed))
    assert part.numbers["pairs_not_walked"] == ["Ar-Kr", "Kr-Kr"]
    assert "Walking 1 of 3 pairs of species" in part.says and "Not walked: Ar-Kr, Kr-Kr." in part.says
    assert {"pair Ar-Kr", "pair Kr-Kr"} <= {what for what, _ in part.skipped}


def codes(walk, asked) -> dict[str, str]:
    return {one["code"]: one["severity"] for one in reach(walk, units_of(asked), asked.kT)}


def test_a_table_with_corners_has_more_kinks_than_are_looked_at():
    """Straight lines between points: the force jumps at each of them."""
    places = np.linspace(0.2, R_CUT, 46)
    energies = np.array([laws.soft(r)[0] for r in places])

    def table(r: float) -> tuple[float, float]:
        if r >= R_CUT:
            return 0.0, 0.0
        k = min(max(int(np.searchsorted(places, r, side="right")) - 1, 0), 44)
        force = -(energies[k + 1] - energies[k]) / (places[k + 1] - places[k])
        return float(energies[k] - force * (r - places[k])), float(force)

    asked = Bare(table)
    (walk,) = walk_pairs(asked).walks
    assert walk.left_out > 0 and codes(walk, asked) == {"MANY_KINKS": "info"}
    corners = np.array([one.radius for one in walk.thresholds])
    assert len(corners) > 12 and np.abs(corners[:, None] - places).min(axis=1).max() < 1e-9


@pytest.mark.parametrize(("onset", "steep"), [(4.4, True), (3.6, False)])
def test_a_switch_over_a_short_way_is_steep(onset: float, steep: bool, monkeypatch: pytest.MonkeyPatch):
    """Over 0.2 Å its curvature is eight times that of the well; over 1 Å it is less than that."""
    end = 4.6
    monkeypatch.setattr(laws, "R_ON", onset)
    monkeypatch.setattr(laws, "R_CUT", end)
    asked = Bare(laws.switched(2))
    (walk,) = walk_pairs(asked).walks
    # the second derivative of the switch is 5.77 at most, over its width squared
    expected = 5.77 * abs(law(onset + 0.25 * (end - onset))[0]) / (end - onset) ** 2
    well = law(2 ** (1 / 6) * laws.SIGMA)[2]
    assert (expected > 5 * well) == steep
    assert codes(walk, asked) == ({"STEEP_SWITCH": "warning"} if steep else {})


def test_a_crowd_that_is_refused_is_made_smaller():
    class Few(Pairwise):
        def calculate(self, atoms=None, properties=None, system_changes=("positions",)):
            if atoms is not None and len(atoms) > 6 and not atoms.pbc.any():
                raise ValueError("too many atoms")
            super().calculate(atoms, properties, system_changes)

    grid = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1) * 3.6
    (found,) = provoke.crowd(subject(lambda: Few(laws.soft), laws.Atoms("Ar8", grid)), most=8)
    assert found.neighbors == 4 and found.kept is None


def test_rounding_of_forces_within_a_particle_is_no_interaction():
    """Atoms with companions, whose forces on one another add up to a last bit wherever they are."""
    first, second = (probes._trio("Ar", 3.1234, side) for side in (-1.0, 1.0))
    pair = probes.Pair(("Ar", "Ar"), first, second, 0.0, False, "Ar3-Ar3")
    asked = subject(lambda: Residue(laws.soft), first + second)
    walked = walk(asked, pair)
    assert walked.cutoff == pytest.approx(R_CUT, rel=1e-2)
    assert not codes(walked, asked)


class Residue(Pairwise):
    """What is left of a sum in another order."""

    def calculate(self, atoms=None, properties=None, system_changes=("positions",)):
        super().calculate(atoms, properties, system_changes)
        self.results["forces"][-1, 0] += 2e-17


def test_crossings_beyond_the_number_that_is_measured_are_told():
    grid = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1) * 3.6
    asked = CalculatorSubject("planted", lambda: Pairwise(laws.hard), laws.Atoms("Ar8", grid), kT=laws.KT)
    around = environments.walk_surroundings(asked, crossings=1, routes=0)
    assert (around.measured, around.asked) == (1, around.possible)
    assert ("1 more crossings of known thresholds", "1 were measured") in around.skipped


class OnFirstLine(Pairwise):
    """A hard cutoff: of the lines along which noise is measured, the first crosses it."""

    asked = 0

    def calculate(self, atoms=None, properties=None, system_changes=("positions",)):
        super().calculate(atoms, properties, system_changes)
        type(self).asked += 1
        if 4 < type(self).asked <= 9:
            self.results["energy"] += 1e-6


def test_a_threshold_on_a_line_is_not_taken_for_noise():
    """Its step is far below single precision, which a double that is used in full does not have."""
    grid = np.stack(np.unravel_index(np.arange(12), (3, 2, 2)), axis=1) * 3.6
    OnFirstLine.asked = 0
    _, noise = settled(
        subject(lambda: OnFirstLine(laws.soft), laws.Atoms("Ar12", grid)), np.random.default_rng(0)
    )
    assert noise.energy < 1e-13


class Narrow(planted.Good):
    """Energies, or forces, through another format."""

    energies = forces = staticmethod(lambda value: value)

    def extra(self, atoms, energy, forces):
        return self.energies(energy), self.forces(forces)


def through_single(value):
    return np.float64(np.float32(value))


@pytest.mark.parametrize(
    ("which", "rounding", "code", "words"),
    [
        ("energies", through_single, "LOW_PRECISION", "All energies are numbers of single precision"),
        ("forces", through_single, "LOW_PRECISION", "All forces are numbers of single precision"),
        (
            "energies",
            lambda value: np.round(value, 5),
            "QUANTIZED",
            "the energy to 5 decimals, in steps of 1e-05 eV",
        ),
    ],
    ids=["energies single", "forces single", "energies rounded"],
)
def test_few_digits_of_energies_or_of_forces_alone_are_told(which, rounding, code, words):
    class Some(Narrow):
        pass

    setattr(Some, which, staticmethod(rounding))
    (found,) = precision(planted.subject(Some), planted.chain(), Noise(1e-8, 1e-8))
    assert found["code"] == code and words in found["text"]
