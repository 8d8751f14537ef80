"""`mdnum check pairs`: it agrees where it should, and says what is wrong where something is."""

from __future__ import annotations

import json

import numpy as np
import pytest
from small_systems import KOB_ANDERSEN, LENNARD_JONES, crystal, make, mixture

from mdnum.references.finders import PEERS, Finder
from mdnum.references.oracle import all_pairs
from mdnum.references.own import all_finders, own_finders
from mdnum.references.pairs import check_pairs

VESIN = next(finder for finder in PEERS if finder.name == "vesin")
SCIPY = next(finder for finder in PEERS if finder.name == "scipy cKDTree")
HARD = {"kind": "hard", "radius": 2.5}


@pytest.mark.jax_md
def test_all_agree_on_a_rattled_crystal():
    system = make(crystal(), LENNARD_JONES, HARD)
    report = check_pairs(system, effective=False)
    assert report.ok and not report.findings
    verdicts = {result.finder: result.verdict for result in report.results}
    assert set(verdicts) == {finder.name for finder in all_finders(system)}
    # an optional peer that is not installed cannot be asked; mdnum's own and its dependencies can
    asked = [result for result in report.results if "not installed" not in (result.note or "")]
    assert len(asked) >= 10
    assert {result.verdict for result in asked} == {"agrees"}
    assert {result.pairs for result in asked} == {report.pairs}
    json.dumps(report.to_dict())
    assert len(report.rows()) == len(report.results)


def test_a_radius_for_each_pair_of_species():
    system = make(mixture(), KOB_ANDERSEN, {"kind": "hard", "in_sigma": 2.5})
    own = [finder for finder in own_finders(system) if "jax-md" not in finder.name]
    report = check_pairs(system, searches=[*own, VESIN], effective=False)
    assert {result.verdict for result in report.results} == {"agrees"}
    expected = 0
    symbols = np.array(system.atoms.get_chemical_symbols())
    for a, b, sigma in (("Ni", "Ni", 1.0), ("Ni", "P", 0.8), ("P", "P", 0.88)):
        pairs = all_pairs(system.atoms.positions, np.array(system.atoms.cell), system.atoms.pbc, 2.5 * sigma)
        pairs = pairs.select(pairs.inside)
        ends = np.sort(np.stack([symbols[pairs.i], symbols[pairs.j]]), axis=0)
        expected += int(((ends[0] == a) & (ends[1] == b)).sum())
    assert report.pairs == expected


@pytest.mark.parametrize(("compare", "counted"), [("r2 <", 0), ("r2 <=", 1), ("r <", 0), ("r <=", 1)])
def test_the_force_loop_follows_the_convention(compare: str, counted: int):
    """Two atoms exactly r_cut apart: in by <=, out by <, and the oracle says the same."""
    atoms = crystal(3, rattle=0.0)[:2]
    atoms.positions = [[0.0, 0, 0], [2.5, 0, 0]]
    system = make(atoms, LENNARD_JONES, {**HARD, "compare": compare})
    own = [finder for finder in own_finders(system) if "jax-md" not in finder.name]
    report = check_pairs(system, searches=own)
    assert [result.pairs for result in report.results] == [counted, counted]
    assert report.pairs == counted and report.decided_exactly == 1
    assert [result.effective.ulps for result in report.results] == [counted - 1, counted - 1]
    assert [result.effective.comparison for result in report.results] == [compare.split()[1]] * 2


def test_a_shell_at_the_cutoff_is_borderline_and_not_wrong():
    """scipy counts r == r_cut, the system does not: a convention, not an error."""
    atoms = crystal(4, rattle=0.0, lattice_constant=1.5)  # the second shell is exactly at 1.5
    report = check_pairs(make(atoms, LENNARD_JONES, {"kind": "hard", "radius": 1.5}), searches=[SCIPY, VESIN])
    scipy, vesin = report.results
    assert scipy.verdict == "differs at the cutoff" and scipy.borderline == 3 * len(atoms)
    assert vesin.verdict == "agrees"
    assert report.decided_exactly == 3 * len(atoms)
    assert {one["code"] for one in report.findings} == {"pairs-at-the-cutoff", "pairs-ambiguous"}


@pytest.mark.parametrize(("ours", "severity"), [(True, "error"), (False, "warning")])
def test_a_lost_pair_and_a_phantom_are_found(ours: bool, severity: str):
    def broken(positions, cell, pbc, r_cut):
        i, j, distance = VESIN.search(positions, cell, pbc, r_cut)
        return np.append(i[3:], [0, 0]), np.append(j[3:], [1, 1]), np.append(distance[3:], [1.0, 1.0])

    atoms = crystal()
    report = check_pairs(
        make(atoms, LENNARD_JONES, HARD),
        searches=[Finder("broken", "vesin", broken, ours=ours)],
        effective=False,
    )
    (result,) = report.results
    assert (result.missing, result.extra, result.verdict) == (3, 2, "differs")
    assert report.ok is not ours
    assert [(one["code"], one["severity"]) for one in report.findings] == [("pairs-differ", severity)]


def test_a_search_that_fails_is_reported_and_the_rest_goes_on():
    def raises(positions, cell, pbc, r_cut):
        raise IndexError("index 6 is out of bounds")

    report = check_pairs(
        make(crystal(), LENNARD_JONES, HARD),
        searches=[Finder("raises", "vesin", raises), VESIN],
        effective=False,
    )
    assert [result.verdict for result in report.results] == ["failed", "agrees"]
    assert report.ok and report.findings[0]["severity"] == "warning"
    assert "index 6" in report.rows()[0]["verdict"]


def test_our_own_failures_are_not_results():
    def raises(positions, cell, pbc, r_cut):
        raise IndexError("a defect")

    with pytest.raises(IndexError, match="a defect"):
        check_pairs(
            make(crystal(), LENNARD_JONES, HARD), searches=[Finder("own", "mdnum", raises, ours=True)]
        )


def test_searches_that_cannot_be_asked_say_why():
    atoms = crystal()
    atoms.pbc = [True, True, False]
    asked = [finder for finder in PEERS if finder.name == "MDAnalysis nsgrid"]
    asked += [Finder("ghost", "no-such-distribution", VESIN.search), VESIN]
    report = check_pairs(make(atoms, LENNARD_JONES, HARD), searches=asked, effective=False)
    assert [result.note for result in report.results] == ["no periodicity per axis", "not installed", ""]
    assert [result.verdict for result in report.results] == ["not asked", "not asked", "agrees"]
    assert report.ok and not report.findings
