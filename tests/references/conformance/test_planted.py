"""Every mechanism that neighbor lists have been seen to fail by is planted in one, and found."""

from __future__ import annotations

import runpy
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import planted_lists
import pytest

from mdnum.references.conformance.case import Case, Still
from mdnum.references.conformance.judge import Report, Truth, truth
from mdnum.references.conformance.lists import from_object
from mdnum.references.conformance.motions import motions
from mdnum.references.conformance.questions import LARGE_EDGE, SMALL_EDGE, catalog, drawn, lattice, questions
from mdnum.references.conformance.reproduction import script
from mdnum.references.conformance.suite import Examiner, examine

SUPPORT = Path(planted_lists.__file__).parent
# what needs more atoms than the small questions have
_LARGE = {"rows beyond 4096": SMALL_EDGE, "32-bit keys": LARGE_EDGE}
# some are the same mistake as another to whoever sees the pairs alone
_CODES = {
    "shifts of wrapped positions": "SHIFTS",
    "wraps free axes": "EXTRA",
    "one side in float32": "ONE_SIDED",
    "two bins counted twice": "DUPLICATE",
    "zero distance twice": "DUPLICATE",
    "tail not cut": "RANGE",
    "keeps itself": "SELF",
    "padding handed out": "RANGE",
    "real indices": "MALFORMED",
    "unequal lengths": "MALFORMED",
    "squared distances": "DISTANCES",
    "distances of neighbors": "DISTANCES",
    "vectors turned": "VECTORS",
}


#: Questions that are asked of several lists, by their identity.
_known: dict[int, Case] = {}


@cache
def _questions(kept: bool, padding: float | None = None, rule: bool = False) -> tuple[Case, ...]:
    """What every list of a kind is asked, or against its rebuild rule alone."""
    right = from_object((planted_lists.kept if kept else planted_lists.planted)(""))
    asked = tuple(motions(padding) if rule else questions(right, 40, 0, padding))
    _known.update((id(case), case) for case in asked)
    return asked


@cache
def _true_pairs(question: int, step: int, **options) -> Truth:
    return truth(_known[question], step, **options)


@pytest.fixture(autouse=True)
def true_pairs_once(monkeypatch: pytest.MonkeyPatch):
    """The pairs of a question are the same whoever is asked: they are found once."""

    def found(case: Case, step: int, **options) -> Truth:
        known = id(case) in _known
        return _true_pairs(id(case), step, **options) if known else truth(case, step, **options)

    monkeypatch.setattr("mdnum.references.conformance.suite.truth", found)


def _made(defect: str):
    return (planted_lists.planted if defect in planted_lists.SEARCH_DEFECTS else planted_lists.kept)(defect)


def _examined(made, rule: bool = False, **options) -> Report:
    """Asked what there is, scaled to the padding that it was seen to have."""
    tested = from_object(made, "planted", source="")
    examiner = Examiner(tested, reuse=not rule)
    asked = _questions(tested.kept, examiner.report.padding, rule)
    return examine(tested, **{"asked": asked, "shrink": False} | options, examiner=examiner, large=False)


@pytest.mark.parametrize("make", [planted_lists.planted, planted_lists.kept], ids=["made anew", "kept"])
def test_the_list_that_is_right_passes(make):
    report = _examined(make(""))
    assert report.conforms, [(one.code, one.case.name, one.worst.text) for one in report.failed]
    assert report.how.full and report.how.sign == 1 and report.single is None and report.keeps_order
    assert report.superset == (make is planted_lists.kept)


@pytest.mark.parametrize(
    "defect", [*sorted(set(planted_lists.SEARCH_DEFECTS) - set(_LARGE)), *planted_lists.KEPT_DEFECTS]
)
def test_a_mistake_is_found_out(defect: str):
    report = _examined(_made(defect), stop=True)
    assert report.failed, f"{defect} passed {report.asked} cases"
    if defect in _CODES:
        codes = [failure.code for failure in report.failed[0].failures]
        assert _CODES[defect] in codes, report.failed[0].worst.text


_RULE_DEFECTS = planted_lists.RULE_DEFECTS | planted_lists.CROWD_RULE_DEFECTS


@pytest.mark.parametrize("defect", _RULE_DEFECTS)
def test_a_rule_that_lets_pairs_through_is_found_out(defect: str):
    """Ten of these passed all scripts of motion that there were, which move atoms along x or at random."""
    report = _examined(planted_lists.ruled(_RULE_DEFECTS[defect]), rule=True, stop=True)
    assert [failed.code for failed in report.failed] == ["MISSING"], f"{report.calls} calls"


def test_a_rule_that_counts_three_quarters_of_the_strain_is_found_out():
    """A bound of r_cut (1 - s) in place of (r_cut + skin) (1 - s), of the smallest stretch s of the box."""
    report = _examined(planted_lists.kept("strain of the cutoff"), rule=True, stop=True)
    assert [failed.code for failed in report.failed] == ["MISSING"], f"{report.calls} calls"


@pytest.mark.parametrize("skinless", [False, True])
@pytest.mark.parametrize("defect", ["", *planted_lists.UPDATE_DEFECTS])
def test_several_images_of_a_pair_are_asked_of_a_list_in_use(defect: str, skinless: bool):
    """Boxes below one cutoff: what is right when it is built and wrong once it is updated."""
    report = _examined(planted_lists.updated(defect, skinless), stop=bool(defect))
    failed = [(one.code, one.case.name, one.worst.text) for one in report.failed]
    assert bool(failed) == bool(defect), failed or f"{report.asked} cases"
    assert all(one.case.steps > 1 and one.worst.step for one in report.failed)
    if defect == "own images twice":
        assert report.failed[0].code == "DUPLICATE"


@pytest.mark.parametrize("own", [0.1, pytest.param(0.5, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    ("defect", "way"),
    [
        ("each axis by itself", "shown"),
        ("twice the mean of a few", "said"),
        ("a sample of nine in ten", "shown"),
        # few atoms that are ignored are found only where the padding is known
        ("each axis by itself", "neither"),
        ("twice the mean of a few", "neither"),
    ],
)
def test_a_padding_of_its_own_hides_no_rule(defect: str, way: str, own: float):
    """Whatever skin it is given; where it neither shows nor says it, from one that was tried."""
    test = planted_lists.RULE_DEFECTS[defect]
    made = planted_lists.ruled(test, own, filtered=way != "shown", says=way == "said")
    report = _examined(made, rule=True, stop=True)
    assert [failed.code for failed in report.failed] == ["MISSING"], f"{report.calls} calls"
    assert report.stated == (way == "said")
    assert (report.padding is None) == (way == "neither")
    assert report.padding is None or abs(report.padding * 0.3 / own - 1) < 0.01


@pytest.mark.parametrize(
    ("rule", "own", "filtered", "says"),
    [
        ("the two furthest by the skin", None, True, False),
        ("the sum of magnitudes", 0.8, False, False),
        ("beside a common drift", 0.1, False, True),
        ("always", 0.5, True, False),
        *(
            pytest.param(rule, None, False, False, marks=pytest.mark.nightly)
            for rule in ("an atom by half of the skin", "at any motion")
        ),
    ],
)
def test_a_rule_that_loses_nothing_raises_no_alarm(rule: str, own: float | None, filtered: bool, says: bool):
    made = planted_lists.ruled(planted_lists.RULES[rule], own, filtered, says)
    report = _examined(made, rule=True)
    assert not report.failed, [(one.case.name, one.worst.text) for one in report.failed]
    assert report.motions > 250 and report.calls > 500


def test_a_lost_pair_is_followed_as_far_in_as_it_is_lost():
    """Each axis by itself loses pairs along a diagonal until 3^(1/2) of the skin are used up, or 2^(1/2)."""
    made = planted_lists.ruled(planted_lists.RULE_DEFECTS["each axis by itself"])
    report = _examined(made, rule=True, stop=True, shrink=True)
    (failed,) = report.failed
    assert (failed.case.atoms, failed.case.steps) == (2, 2)
    far, near = (np.linalg.norm(np.subtract(*still.positions)) for still in failed.case.stills)
    assert far > 1.3 and 0.77 < near < 0.9


def test_rows_beyond_4096_are_found_lost():
    report = _examined(_made("rows beyond 4096"), asked=[lattice(SMALL_EDGE)])
    assert report.failed[0].code == "MISSING"


@pytest.mark.nightly
def test_keys_that_overflow_are_found_at_100_000_atoms():
    """Where the square of the number of atoms is more than 32 bits hold."""
    assert _examined(_made("32-bit keys"), asked=[lattice(LARGE_EDGE)]).failed


@pytest.mark.parametrize(
    ("defect", "area", "atoms", "steps"),
    [
        ("half stencil", "boxes", 2, 1),
        ("32 neighbors", "crowded", 35, 1),
        ("box not looked at", "strain", 2, 2),
        ("stale tail", "reuse", 3, 2),
        ("reference overwritten", "motion", 2, 4),
        *(
            pytest.param(*more, marks=pytest.mark.nightly)
            for more in (
                ("drops atoms outside", "outside", 2, 1),
                ("images undercounted", "images", 2, 1),
                ("the caller's array", "motion", 2, 2),
                ("whole skin", "motion", 2, 2),
                ("skin of the first", "reuse", 2, 3),
                ("tail of a growing count lost", "motion", 2, 2),
            )
        ),
    ],
)
def test_failures_shrink_and_are_reproduced_without_mdnum(
    defect, area, atoms, steps, tmp_path: Path, monkeypatch, capsys
):
    """The smallest case fails in a script that cannot import mdnum, which the right list passes."""
    tested = from_object(_made(defect), "planted").with_options(full=True)
    asked = [case for case in _questions(tested.kept) if case.area == area]
    report = examine(tested, asked=asked, shrink=True)
    failed = report.failed[0]
    assert failed.alone
    assert failed.case.atoms <= atoms and failed.case.steps <= steps, failed.case
    for name in [name for name in sys.modules if name.partition(".")[0] == "mdnum"]:
        monkeypatch.setitem(sys.modules, name, None)
    for planted, wanted in ((defect, 1), ("", 0)):
        kind = "kept" if tested.kept else "planted"
        source = f"from planted_lists import {kind}\nlist_under_test = {kind}({planted!r})\n"
        tested = replace(tested, source=source, call="list_under_test")
        path = tmp_path / f"reproduce-{wanted}.py"
        path.write_text(script(tested, failed, report.how, report.superset))
        assert "mdnum" not in path.read_text().partition('"""')[2].partition('"""')[2]
        code, said = _run(path, capsys)
        assert (code, f"the list is {'wrong' if wanted else 'right'}" in said) == (wanted, True), said
    if defect == "half stencil":  # a process of its own has the same to say
        blocked = f"import sys, runpy; sys.modules['mdnum'] = None; sys.path.insert(0, {str(SUPPORT)!r}); "
        run = f"{blocked}runpy.run_path({str(path)!r}, run_name='__main__')"
        done = subprocess.run([sys.executable, "-c", run], capture_output=True, text=True, check=False)
        assert done.returncode == 0 and "the list is right" in done.stdout, done.stderr


def _run(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[object, str]:
    """A script's exit code, and what it prints."""
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(path), run_name="__main__")
    return ended.value.code or 0, capsys.readouterr().out


_SPOILED = {
    "VECTORS": "rows | {'vector': -rows['vector'] * (rows['i'] > 0)[:, None]}",
    "vectors of whoever": "{name: rows[name] for name in 'ij'} | {'vector': 2 * rows['vector']}",
    "DISTANCES": "rows | {'distance': rows['distance'] ** 2}",
    "distances without shifts": "rows['i'], rows['j'], rows['distance'] ** 2",
    "real indices": "rows | {'i': rows['i'] * 1.0}",
    "lengths": "rows | {'j': rows['j'][1:]}",
    "half a lattice vector": "rows | {'shift': rows['shift'] + 0.5}",
    "nothing": "None",
    "a generator": "(row for row in zip(rows['i'], rows['j']))",
    "a matrix": "np.ones((len(x), len(x)), int)",
    "an object": "object()",
    "no j": "{'i': rows['i']}",
    "pairs as lists": "np.column_stack([rows['i'], rows['j']]).tolist()",
    "alias of another": "{'senders': rows['i'], 'receivers': rows['j'][::-1]}",
    "exit": "sys.exit(0)",
}


@pytest.mark.parametrize("spoiled", _SPOILED)
def test_what_is_told_is_reproduced_whatever_is_returned(spoiled: str, capsys: pytest.CaptureFixture[str]):
    """The script exits with 1 and says that the list is wrong, without an exception of its own."""
    codes = {"VECTORS": "VECTORS", "DISTANCES": "DISTANCES", "distances without shifts": "DISTANCES",
             "vectors of whoever": "DISTANCES", "exit": "CRASHED", "alias of another": "MISSING"}  # fmt: skip
    case = next(one for one in catalog() if one.area == "boxes" and one.atoms > 5)
    for body, wanted in ((_SPOILED[spoiled], 1), ("rows", 0), ("list(zip(rows['i'], rows['j']))", 0)):
        source = (
            "import sys\nimport numpy as np\nfrom planted_lists import search\n"
            f"def spoiled(*given):\n    x, rows = given[0], search(*given)\n    return {body}\n"
        )
        made: dict = {}
        exec(source, made)
        if wanted:
            tested = from_object(made["spoiled"], "spoiled", source).with_options(full=True)
            report = examine(tested, asked=[case], shrink=False)
            failed = report.failed[0]
            assert failed.code == codes.get(spoiled, "MALFORMED"), failed.worst.text
        lines = script(replace(tested, source=source), failed, report.how, report.superset)
        with pytest.raises(SystemExit) as ended:
            exec(compile(lines, "reproduction", "exec"), {"__name__": "__main__"})
        said = capsys.readouterr().out + str(ended.value.code)
        assert bool(ended.value.code) == bool(wanted), said
        assert ("the list is wrong" if wanted else "the list is right") in said


@pytest.mark.nightly
def test_10_000_clean_cases_raise_no_alarm():
    """Half of them drawn; the other half the same atoms in another order and elsewhere, which rounds anew."""
    asked = [case for seed in range(20) for case in drawn(250, seed)]
    rng = np.random.default_rng(0)
    for case in asked[:]:
        (still,) = case.stills
        order = rng.permutation(len(still.positions))
        moved = still.positions[order] + rng.normal(size=3) * case.r_cut
        asked.append(replace(case, stills=(Still(moved, still.cell),)))
    report = examine(from_object(planted_lists.planted(""), "right"), asked=asked, shrink=False)
    assert report.asked == 10_000
    assert report.conforms, [(one.code, one.case.name, one.worst.text) for one in report.failed]
