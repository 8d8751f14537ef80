"""Neighbor searches against the oracle, where each stops counting, and `mdnum check pairs`."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from itertools import product

import numpy as np
import oracles
import pytest
from small_systems import KOB_ANDERSEN, LENNARD_JONES, crystal, make, mixture

from mdnum.plain import plain
from mdnum.references.conformance.lists import PairList
from mdnum.references.conformance.peers import load
from mdnum.references.oracle import all_pairs, exactly_inside
from mdnum.references.pair_check import (
    Search,
    all_searches,
    borderline_pairs,
    check_pairs,
    compare_pairs,
    effective_cutoff,
    own_searches,
)
from mdnum.systems import build
from mdnum.verbs.check import pair_findings

HARD = {"kind": "hard", "radius": 2.5}
LIBRARIES = (
    "numpy-r2", "numpy", "ase", "ase-primitive", "vesin", "vesin-half", "mdanalysis", "mdanalysis-brute",
    "scipy",
)  # fmt: skip
#: compiled for each box; in the box of a system it is asked in the slow call
AT_NIGHT = (pytest.mark.nightly, pytest.mark.jax_md)
BOXES = {
    "orthorhombic": (np.diag([13.0, 14.0, 15.0]), (True, True, True)),
    "tilted": (np.array([[13.0, 0, 0], [4, 14, 0], [-3, 2, 15.0]]), (True, True, True)),
    "rotated": (np.array([[13.0, 3, 1], [4, 14, 2], [-3, 2, 15.0]]), (True, True, True)),
    "left-handed": (np.array([[13.0, 3, 1], [4, 14, 2], [-3, 2, -15.0]]), (True, True, True)),
    "slab": (np.diag([13.0, 14.0, 15.0]), (True, True, False)),
    "free": (np.zeros((3, 3)), (False, False, False)),
    "small": (np.diag([3.0, 4.0, 5.0]), (True, True, True)),
}


def search(function, package: str = "numpy", **options) -> Search:
    options = {"full": False, **options}
    return Search(PairList("planted", lambda: function, package=package, **options))


def codes(report) -> list[tuple[str, str]]:
    return [(finding.code, finding.severity) for finding in pair_findings(report)]


@pytest.mark.parametrize(
    ("name", "box"),
    [
        *product(LIBRARIES, BOXES),
        *(pytest.param("jax-md", box, marks=AT_NIGHT) for box in BOXES if box not in ("slab", "small")),
    ],
)
def test_finds_the_pairs_of_the_oracle(name: str, box: str):
    """As people call them: positions wrapped, boxes turned, where a library asks for it."""
    cell, pbc = BOXES[box][0], np.array(BOXES[box][1])
    r_cut, asked = 4.0, Search(load(name))
    positions = np.random.default_rng(1).uniform(-10, 20, (12 if box == "small" else 120, 3))
    if (why := asked.refusal(positions, cell, pbc, r_cut)) is not None:
        assert box in ("small", "slab", "tilted", "rotated", "left-handed"), why
        pytest.skip(why)
    i, j = asked.pairs(positions, cell, pbc, r_cut)
    assert (i <= j).all()
    expected = oracles.image_pairs if box == "small" else oracles.minimum_image_pairs
    found = Counter(zip(i.tolist(), j.tolist(), strict=True))
    assert found == Counter(expected(positions, cell, pbc, r_cut))


@pytest.mark.parametrize(
    ("name", "ulps", "comparison"),
    [
        ("numpy-r2", -1, "<"),
        ("ase", -1, "<"),
        ("ase-primitive", -1, "<"),
        ("vesin", -1, "<"),
        ("scipy", 0, "<="),
        ("mdanalysis", None, "<= in float32"),
        ("mdanalysis-brute", None, "<= in float32"),
    ],
)
def test_effective_cutoff(name: str, ulps: int | None, comparison: str):
    effective = effective_cutoff(Search(load(name)), 2.5, oriented=20)
    assert effective.comparison == comparison
    if ulps is None:
        # half a float32 step beyond 2.5, which is where rounding to float32 sends a double elsewhere
        assert 2.3e-8 < effective.last_counted / 2.5 - 1 < 4.8e-8 and "relative" in effective.stops
    else:
        assert effective.ulps == ulps


def _shifted(delta: float) -> Search:
    def shifted(positions, cell, pbc, r_cut):
        hit = [0] if np.linalg.norm(positions[1] - positions[0]) < r_cut + delta else []
        return np.array(hit, int), np.array(hit, int) + 1

    return search(shifted)


@pytest.mark.parametrize("ulps", [-5, -1, 0, 7])
def test_effective_cutoff_of_a_planted_offset(ulps: int):
    effective = effective_cutoff(_shifted(ulps * np.spacing(2.5)), 2.5, periodic=False, oriented=0)
    assert effective.ulps == ulps - 1
    assert effective_cutoff(_shifted(1.0), 2.5, oriented=0).comparison == "not a cutoff"


def test_borderline_pairs_are_on_both_sides():
    pairs = borderline_pairs(2.5, 50)
    inside = [exactly_inside(pair, np.zeros((3, 3)), 0, 1, (0, 0, 0), 2.5) for pair in pairs]
    assert 5 < sum(inside) < 45


def test_compare_counts_missing_extra_and_borderline():
    positions = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.5, 0, 0], [50.0, 0, 0]])
    truth = all_pairs(positions, np.zeros((3, 3)), np.zeros(3, bool), 1.5, reach=1.6)
    # 0-1 inside, 1-2 exactly at the cutoff, hence outside by "<"
    for i, j, counts in (
        ([0], [1], (0, 0, 0)),
        ([0, 1], [1, 2], (0, 0, 1)),
        ([], [], (1, 0, 0)),
        ([0, 0, 0], [1, 1, 3], (0, 2, 0)),
    ):
        assert compare_pairs(np.array(i, int), np.array(j, int), truth, 1.5, 1e-12) == counts


# most of its time is for the programs of jax-md; the golden of `mdnum check pairs` has them all in the gate
@pytest.mark.nightly
@pytest.mark.jax_md
def test_all_agree_on_a_rattled_crystal():
    system = make(crystal(), LENNARD_JONES, HARD)
    report = check_pairs(system, effective=False)
    assert report.ok and codes(report) == []
    assert {one.name for one in report.results} == {one.name for one in all_searches(build(system))}
    # an optional library that is not installed cannot be asked; mdnum's own and its dependencies can
    asked = [one for one in report.results if one.note != "not installed"]
    assert len(asked) >= 13
    assert {one.verdict for one in asked} == {"agrees"}
    assert {one.pairs for one in asked} == {report.pairs}
    json.dumps(plain(report))
    assert len(report.rows()) == len(report.results)


def test_a_radius_for_each_pair_of_species():
    system = make(mixture(), KOB_ANDERSEN, {"kind": "hard", "in_sigma": 2.5})
    report = check_pairs(
        system, searches=[*own_searches(build(system))[:2], Search(load("vesin"))], effective=False
    )
    assert {one.verdict for one in report.results} == {"agrees"}
    expected, symbols = 0, np.array(system.atoms.get_chemical_symbols())
    for a, b, sigma in (("Ni", "Ni", 1.0), ("Ni", "P", 0.8), ("P", "P", 0.88)):
        pairs = all_pairs(system.atoms.positions, np.array(system.atoms.cell), system.atoms.pbc, 2.5 * sigma)
        pairs = pairs.select(pairs.inside)
        ends = np.sort(np.stack([symbols[pairs.i], symbols[pairs.j]]), axis=0)
        expected += int(((ends[0] == a) & (ends[1] == b)).sum())
    assert report.pairs == expected


@pytest.mark.parametrize(
    ("compare", "counted"),
    [
        ("r2 <", 0),
        ("r <=", 1),
        pytest.param("r2 <=", 1, marks=pytest.mark.nightly),
        pytest.param("r <", 0, marks=pytest.mark.nightly),
    ],
)
def test_the_force_loop_follows_the_convention(compare: str, counted: int):
    """Two atoms exactly r_cut apart: in by <=, out by <, and the oracle decides the same."""
    atoms = crystal(3, rattle=0.0)[:2]
    atoms.positions = [[0.0, 0, 0], [2.5, 0, 0]]
    system = make(atoms, LENNARD_JONES, {**HARD, "compare": compare})
    own = [Search(replace(one.listed, affords=0.05)) for one in own_searches(build(system))[:2]]
    report = check_pairs(system, searches=own)
    assert [one.pairs for one in report.results] == [counted, counted]
    assert report.pairs == counted and report.decided_exactly == 1
    for one in report.results:
        assert one.effective is not None and one.effective.ulps == counted - 1
        assert one.effective.comparison == compare.split()[1]


def test_a_shell_at_the_cutoff_is_borderline_and_not_wrong():
    """scipy counts r == r_cut, the system does not: a convention, not an error."""
    atoms = crystal(4, rattle=0.0, lattice_constant=1.5)  # the second shell is exactly at 1.5
    system = make(atoms, LENNARD_JONES, {"kind": "hard", "radius": 1.5})
    report = check_pairs(system, searches=[Search(load("scipy")), Search(load("vesin"))])
    scipy, vesin = report.results
    assert scipy.verdict == "differs at the cutoff" and scipy.borderline == 3 * len(atoms)
    assert vesin.verdict == "agrees"
    assert report.decided_exactly == 3 * len(atoms)
    assert {code for code, _ in codes(report)} == {"PAIRS_AT_THE_CUTOFF", "PAIRS_AMBIGUOUS"}


@pytest.mark.parametrize(("package", "severity"), [("mdnum", "error"), ("numpy", "warning")])
def test_a_lost_pair_and_a_phantom_are_found(package: str, severity: str):
    vesin = Search(load("vesin-half"))

    def broken(positions, cell, pbc, r_cut):
        i, j = vesin.pairs(positions, cell, pbc, r_cut)
        order = np.lexsort((j, i))
        return np.append(i[order][:-3], [0, 0]), np.append(j[order][:-3], [1, 1])

    system = make(crystal(), LENNARD_JONES, HARD)
    report = check_pairs(system, searches=[search(broken, package)], effective=False)
    (result,) = report.results
    assert (result.missing, result.extra, result.verdict) == (3, 2, "differs")
    assert report.ok is (package != "mdnum")
    assert codes(report) == [("PAIRS_DIFFER", severity)]


def test_a_search_that_fails_is_a_result_and_a_failure_of_mdnum_is_not():
    def raises(positions, cell, pbc, r_cut):
        raise IndexError("index 6 is out of bounds")

    system, vesin = make(crystal(), LENNARD_JONES, HARD), Search(load("vesin"))
    report = check_pairs(system, searches=[search(raises), vesin], effective=False)
    assert [one.verdict for one in report.results] == ["failed", "agrees"]
    assert report.ok and codes(report) == [("SEARCH_FAILED", "warning")]
    assert "index 6" in report.rows()[0]["verdict"]
    with pytest.raises(IndexError, match="index 6"):
        check_pairs(system, searches=[search(raises, "mdnum")])


def test_searches_that_cannot_be_asked_have_a_reason():
    atoms = crystal()
    atoms.pbc = [True, True, False]
    ghost = search(lambda *_: None, "no-such-distribution")
    asked = [Search(load("mdanalysis")), ghost, Search(load("vesin"))]
    report = check_pairs(make(atoms, LENNARD_JONES, HARD), searches=asked, effective=False)
    limited, *others = [one.note for one in report.results]
    assert limited.endswith("axis by axis") and others == ["not installed", ""]
    assert [one.verdict for one in report.results] == ["not tested", "not tested", "agrees"]
    assert report.ok and codes(report) == []
