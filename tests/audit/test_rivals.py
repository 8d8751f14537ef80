"""Mistakes that look alike get their own names, alone and two at once, and what is right gets none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from ase.build import bulk
from audit import planted, rivals
from audit.planted import codes

from mdnum.audit.base import AuditCheck, CheckResult, finding
from mdnum.audit.causes import heads
from mdnum.audit.checks import CHECKS
from mdnum.audit.checks.dynamics import DynamicsCheck
from mdnum.audit.checks.smoothness import SmoothnessCheck
from mdnum.audit.subject import CalculatorSubject
from mdnum.verbs.audit import answer_of

#: Without the nightly ones: one of each kind of mistake.
QUICK = (
    "Embedded in a crystal", "Potential as a slab", "cap by order of 9", "cap of 24, single keys",
    "last force", "last atom lost", "left-handed cells", "padded shares", "single sum",
    "pairs at random", "last force and a hard cutoff",
)  # fmt: skip


def audited(make: Any, atoms: Any, neighbors: int = 40) -> list[CheckResult]:
    """What all checks find, with a smaller crowd and a shorter run than theirs."""
    subject = CalculatorSubject("planted", make, atoms, kT=rivals.KT)
    results: list[CheckResult] = []
    for name in sorted(CHECKS, key=lambda name: CHECKS[name].order):
        check = DynamicsCheck(steps=60) if name == "dynamics" else CHECKS[name]()
        if isinstance(check, SmoothnessCheck):
            check.neighbors = neighbors
        results.append(answer_of(check, subject, lambda *_: None, results))
    return results


def listed(results: list[CheckResult]) -> list[str]:
    """Codes that are listed by themselves, without information."""
    found = [one for result in results for one in result.findings]
    above = heads([(one.code, one.severity) for one in found])
    return sorted({
        one.code for place, one in enumerate(found) if above[place] == place and one.severity != "info"
    })  # fmt: skip


def silent(results: list[CheckResult]) -> list[str]:
    """Figures above their limits that no finding of their check reports."""
    return [
        f"{result.name}: {name}"
        for result in results
        for name, (limit, reports) in result.limits.items()
        if not (result.numbers.get(name) or 0) <= limit and not set(reports) & set(codes(result))
    ]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in QUICK else [pytest.mark.nightly])
        for name in {**rivals.RIGHT, **rivals.WRONG}
    ],
)
def test_each_mistake_is_named(name: str):
    make, atoms, expected = {**rivals.RIGHT, **rivals.WRONG}[name]
    more = max(getattr(make, "most", 0), 0)
    results = audited(make, atoms, neighbors=max(40, more + 8))
    assert listed(results) == sorted(expected)
    assert not silent(results) and not any("ABOVE_LIMIT" in codes(result) for result in results)


@pytest.mark.nightly
@pytest.mark.parametrize("name", [name for name, one in vars(planted).items() if isinstance(one, type)])
def test_no_figure_is_above_its_limit_in_silence(name: str):
    make = getattr(planted, name)
    if not issubclass(make, (planted.Good, planted.Attached)):
        pytest.skip("no calculator")
    assert not silent(audited(make, planted.crystal(), neighbors=12))


def test_a_figure_above_its_limit_is_a_finding_by_itself():
    class Forgets(AuditCheck):
        name = title = "forgets"

        def ask(self, subject, progress):
            limits = {"jump": (1e-3, ("ENERGY_JUMP",)), "unknown": (1.0, ()), "small": (1.0, ())}
            numbers = {"jump": 0.7, "unknown": None, "small": 0.5, "other": 9.0}
            found = [finding("ENERGY_JUMP", "info")] if self.steps else []
            return CheckResult(([], {}), found, numbers=numbers, limits=limits)

    there = rivals.subject(rivals.Potential)
    (told,) = Forgets()(there).findings
    assert (told.code, told.severity, told.values["value"]) == ("ABOVE_LIMIT", "warning", 0.7)
    assert codes(Forgets(steps=1)(there)) == {"ENERGY_JUMP": "info"}


# -- values beside the names ------------------------------------------------------------------------


def told(results: list[CheckResult], code: str) -> dict[str, Any]:
    (found,) = [one for result in results for one in result.findings if one.code == code]
    return {**found.values, "variants": found.variants}


@pytest.mark.parametrize(
    ("mistake", "pattern", "places"),
    [
        (rivals.WrongForce, "last", "15"),
        (rivals.FirstForce, "first", "0"),
        (rivals.EighthForce, "every", "7, 15"),
        (rivals.FourthForce, "every", "1, 5, 9, 13"),
    ],
)
def test_a_force_that_is_wrong_by_its_place(mistake: type, pattern: str, places: str):
    """Named with the place, in the check of forces as in that of other ways to write a structure down."""
    make, atoms = rivals.planted(mistake), rivals.liquid().repeat((1, 2, 1))
    subject = rivals.subject(make, atoms)
    (one,) = [one for one in CHECKS["invariance"]()(subject).findings if one.code == "PLACE_IN_LIST"]
    assert one.variants == [f"forces_{pattern}", pattern] and one.values["places"] == places
    told = planted.values(CHECKS["forces"]()(subject), "FORCES_NOT_GRADIENT")
    assert told["variants"] == [f"place_{pattern}"] and told["places"] == places


def test_caps_are_counted_whatever_neighbors_are_sorted_by():
    for mistake, most in ((rivals.Nearest, 9), (rivals.SingleKeys, 24)):
        check = SmoothnessCheck()
        check.neighbors, check.routes = 30, 0
        result = check(rivals.subject(rivals.planted(mistake, most=most)))
        assert planted.values(result, "NEIGHBOR_CAP")["kept"] == most == result.numbers["neighbors_kept"]


def test_a_force_that_is_zero_to_the_last_bit_promises_nothing():
    """Of two atoms the second feels nothing; how small a step of its force would show is not known."""
    check = SmoothnessCheck()
    check.neighbors, check.routes = 8, 0
    result = check(rivals.subject(rivals.planted(rivals.WrongForce)))
    assert result.numbers["force_steps_seen"] is None and "smoothness_least" not in result.says[0]
    known = check(rivals.subject(rivals.Potential)).numbers["force_steps_seen"]
    assert 1e-16 < known < 1e-3


def test_an_order_that_matters_is_no_cap_where_its_number_does_not():
    """The force on the last atom of eight or more: from eight on, and with one of them far away as well."""

    class Last(rivals.WrongForce):
        where = staticmethod(lambda n: (np.arange(n) == n - 1) & (n > 7))

    check = SmoothnessCheck()
    check.neighbors, check.routes = 12, 0
    result = check(rivals.subject(rivals.planted(Last)))
    assert codes(result)["ORDER"] == "error" and "NEIGHBOR_CAP_BY_ORDER" not in codes(result)
    told = planted.values(result, "ORDER")
    assert told["energy"].value == 0.0 and told["force"] > 1e-4
    assert told["variants"] == ["crowd", "crowd_forces"]
    assert not {"smoothness_capped", "smoothness_crowded"} & set(result.says[0])


@pytest.mark.parametrize("copies", [(1, 1, 1), (1, 2, 2), pytest.param((2, 4, 4), marks=pytest.mark.nightly)])
@pytest.mark.parametrize("mistake", [rivals.SingleSum, rivals.SingleSumOf])
def test_a_sum_in_single_precision_has_one_answer_at_any_size(mistake: type, copies: tuple[int, ...]):
    atoms = rivals.liquid().repeat(copies)
    atoms.rattle(0.03, seed=5)
    subject = rivals.subject(rivals.planted(mistake, on=rivals.Switched), atoms)
    found = [CHECKS[name]()(subject) for name in ("invariance", "forces")]
    assert not found[0].findings and codes(found[1]) == {"LOW_PRECISION": "info"}
    assert planted.values(found[1], "LOW_PRECISION")["variants"][0].startswith("order")


def test_left_handed_vectors_are_no_mirror_image():
    """The mirror image of a structure has vectors of the same handedness as the structure."""
    from mdnum.audit.checks import invariance

    for atoms in (rivals.liquid(), rivals.slab(), bulk("Ar", "fcc", a=5.3), rivals.cluster()):
        ways = list(invariance.all_of(atoms, atoms, np.random.default_rng(0)))
        signs = {one.what: np.sign(np.linalg.det(one.atoms.cell)) for one in ways if one.code == "MIRROR"}
        assert set(signs.values()) == {np.sign(np.linalg.det(atoms.cell))}
        others = [one for one in ways if one.code in ("LEFT_HANDED", "LATTICE")]
        for one in others:
            same = np.sign(np.linalg.det(one.atoms.cell)) == np.sign(np.linalg.det(atoms.cell))
            assert same == (one.code == "LATTICE")


def test_wrong_forces_are_told_apart_by_their_curl():
    from mdnum.audit.conclusion import concluded

    expected = {
        rivals.TermMissing: ("another_energy", []),
        rivals.Scaled: ("another_energy", ["scaled"]),
        rivals.Predicted: ("no_energy", []),
    }
    for mistake, (more, variants) in expected.items():
        subject = rivals.subject(rivals.planted(mistake))
        results = [CHECKS[name]()(subject) for name in ("forces", "curl")]
        assert concluded(results) == {"FORCES_NOT_GRADIENT": more}
        assert planted.values(results[0], "FORCES_NOT_GRADIENT")["variants"] == variants
        # without the test that tells, nothing is said
        assert not concluded(results[:1])
