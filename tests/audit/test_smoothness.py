"""Walks through whole surroundings, what they say in words, and ASE's own calculators."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from audit import laws
from audit.laws import R_CUT, Pairwise, law, subject

from mdnum.audit.environments import unexplained, walk_surroundings
from mdnum.audit.load import load_calculator
from mdnum.audit.routes import Route
from mdnum.audit.smoothness import Smoothness
from mdnum.audit.structures import default_structure
from mdnum.audit.subject import CalculatorSubject
from mdnum.audit.thresholds import find_thresholds, walk_pairs

COPPER = Path(__file__).parents[2] / "systems" / "copper" / "cu.eam.alloy"
#: J. Tersoff, Phys. Rev. B 38, 9902 (1988), in the order of LAMMPS
SILICON = "Si Si Si 3 1 0 1.0039e5 16.217 -0.59825 0.78734 1.1e-6 1.7322 471.18 2.85 0.15 2.4799 1830.8\n"


def cluster() -> laws.Atoms:
    """A dozen argon atoms, in places without symmetry."""
    rng = np.random.default_rng(4)
    places = rng.permutation(27)[:12]
    grid = np.stack(np.unravel_index(places, (3, 3, 3)), axis=1) * 3.6
    return laws.Atoms("Ar12", grid + rng.uniform(-0.4, 0.4, (12, 3)))


def codes(part) -> dict[str, str]:
    return {one["code"]: one["severity"] for one in part.findings}


def test_a_crossing_among_others_is_measured_to_the_last_bit():
    """Of a pair law, the jump among others is that of the two alone."""
    around = walk_surroundings(subject(lambda: Pairwise(laws.hard), cluster()))
    measured = [one for one in around.events if one.threshold is not None]
    assert measured
    for event in measured:
        assert event.jump.exact
        assert event.jump.high == np.nextafter(event.jump.low, np.inf)
        assert abs(event.jump.energy) == pytest.approx(abs(law(R_CUT)[0]), rel=1e-9)
        assert event.force == pytest.approx(abs(law(R_CUT)[1]), rel=1e-9)
    assert not unexplained(around.events)


def test_what_depends_on_three_is_found_where_two_show_nothing():
    """A constant for each angle with two short sides: invisible to two atoms, a jump for three."""
    asked = subject(lambda: laws.Angles(laws.soft), cluster())
    assert [one.radius for one in find_thresholds(asked)] == [pytest.approx(R_CUT, rel=0.01)]
    part = Smoothness(neighbors=8)(asked)
    assert codes(part)["JUMP_AMONG_MANY"] == "error"
    assert part.numbers["unexplained"] > 0


def test_crossings_on_a_route_are_those_of_a_fine_scan():
    """Roots of a quadratic against signs on a fine grid, images of a small skewed cell included."""
    rng = np.random.default_rng(7)
    cell = np.diag([7.0, 8.0, 9.0]) + np.tril(rng.uniform(-1, 1, (3, 3)), -1)
    atoms = laws.Atoms("Ar4", rng.uniform(0, 7, (4, 3)), cell=cell, pbc=(True, True, False))
    (threshold,) = find_thresholds(subject(lambda: Pairwise(laws.hard), cluster()))
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
    assert len(found) > 3
    assert np.allclose(found, sorted(expected), atol=1e-4)


def test_what_is_said_of_a_hard_cutoff():
    part = Smoothness(neighbors=8, routes=0)(subject(lambda: Pairwise(laws.hard), cluster()))
    assert codes(part) == {"ENERGY_JUMP": "error"}
    (found,) = part.findings
    assert repr(float(np.nextafter(R_CUT, 0.0))) in found["text"]
    assert "0.460947 meV" in found["text"]
    assert f"{abs(law(R_CUT)[0]) / laws.KT:.2g} kT" in found["text"]
    assert part.numbers["cutoffs"] == {"Ar-Ar": R_CUT}
    assert part.numbers["largest_energy_jump"] == pytest.approx(-law(R_CUT)[0], rel=1e-9)


@pytest.mark.slow
def test_what_is_said_of_a_shift_and_of_switches():
    said = {
        name: codes(Smoothness(neighbors=8, routes=0)(subject(lambda law=law: Pairwise(law), cluster())))
        for name, law in {
            "shifted": laws.shifted, "once": laws.switched(1), "twice": laws.switched(2),
        }.items()
    }  # fmt: skip
    assert said == {"shifted": {"FORCE_JUMP": "warning"}, "once": {"CURVATURE_JUMP": "info"}, "twice": {}}


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
def test_ases_own(
    words: str, expected: list[tuple[float, int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "silicon.tersoff").write_text(SILICON)
    monkeypatch.chdir(tmp_path)
    loaded = load_calculator(words)
    asked = CalculatorSubject(words, loaded.make, default_structure(loaded))
    (walk,) = walk_pairs(asked).walks
    found = [(one.radius, one.order) for one in walk.thresholds]
    assert [order for _, order in found] == [order for _, order in expected]
    assert [r for r, _ in found] == [pytest.approx(r, abs=2e-4) for r, _ in expected]
