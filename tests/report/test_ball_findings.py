"""Each finding on a ball is found where it is planted, and only there."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from report.synthetic_ball import made, make_ball, variant

from mdnum import report
from mdnum.errors import FolderError
from mdnum.report.ball import findings
from mdnum.report.ball.rules import CODES, differs
from mdnum.report.ball.run import load


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return load(make_ball(tmp_path_factory.mktemp("runs") / "good"))


def found(run, **changes):
    changed = dataclasses.replace(run, **changes)
    return {finding.code: finding for finding in findings.judge(changed).findings}


def summary(run, **changes):
    return {"summary": {**run.summary, **changes}}


def test_a_good_run(good):
    verdict = findings.judge(good)
    assert verdict.tone == "good" and verdict.findings == ()
    assert verdict.headline == "The record is complete, and none of the checks found anything."
    flips = good.rows["contacts"]
    assert flips > 10
    assert f"All {flips} contact flips are accounted for" in verdict.evidence[0]
    assert verdict.evidence[1].startswith("All ") and verdict.evidence[1].endswith(" ended by tolerance.")
    assert "No decision lay within rounding" in verdict.evidence[2]


FORK = {"seed": 3, "fork": 30, "channel": "contact", "ball": 2, "margin": 1e-17, "margin_there": -2e-17}


def planted(run):
    unrolled = run.summary["gradient"][0]
    series = {name: values.copy() for name, values in run.series.items()}
    series["contacts"][-40:] = 3
    series["entered"][-40] = 3 - run.series["contacts"][-41]
    series["entered"][-39:] = series["left"][-40:] = 0
    resting = {
        "series": series,
        "rows": {**run.rows, "contacts": int((series["entered"] + series["left"]).sum())},
    }
    none = made("implicit", "Of the fixed point.", {"k": 0.0, "y0": 0.75}, {"k": False})
    return {
        "NOT_FINITE": summary(run, not_finite=17, status="failed"),
        "NOT_FINISHED": summary(run, status=None),
        "LEDGER_INCOMPLETE": {"rows": {**run.rows, "contacts": run.rows["contacts"] - 1}},
        "SOLVER_CAP": summary(run, ended={"tolerance": 10, "cap": 2}),
        "AMBIGUOUS_CONTACTS": summary(run, ambiguous=3, ambiguous_contacts=3),
        "AMBIGUOUS_STOPS": summary(run, ambiguous=1, ambiguous_stops=1),
        "LOSS_INDEPENDENT": summary(run, gradient=[unrolled, {**none, "gradient": {"y0": 0.75}}]),
        "ZERO_GRADIENT": summary(run, gradient=[made("unrolled", "", {"k": 0.0})]),
        "GRADIENT_NOT_FINITE": summary(run, gradient=[made("unrolled", "", {"k": None})]),
        "METHODS_DISAGREE": summary(
            run, gradient=[unrolled, made("event-aware", "Of the motion.", {"k": -2.5e-5, "y0": 0.43})]
        ),
        "OFF_CLOSED_FORM": summary(run, exact={"gradient": {"y0": 0.43}}),
        "FORKED": summary(run, variants=[variant("low", **FORK, gradient={"k": -1.0, "y0": 0.75})]),
        "ITERATIONS_DIFFER": summary(run, variants=[variant("low", iterations_differ=4)]),
        "RESTING": resting,
    }


def test_every_planted_defect_is_found_and_nothing_else(good):
    plants = planted(good)
    assert set(plants) == CODES
    for code, changes in plants.items():
        assert set(found(good, **changes)) == {code}, code


def test_a_missing_flip_is_told(tmp_path):
    run = load(make_ball(tmp_path / "run", drop_flip=True))
    verdict = findings.judge(run)
    assert verdict.tone == "error" and verdict.findings[0].code == "LEDGER_INCOMPLETE"
    assert f"the table has {run.rows['contacts']}" in verdict.findings[0].text
    assert "accounted for" not in verdict.text


def test_a_solver_that_met_its_cap_says_how_often_and_where_first(tmp_path):
    run = load(make_ball(tmp_path / "run", max_iter=20))
    finding = found(run)["SOLVER_CAP"]
    capped = np.flatnonzero(run.series["reason"].astype(str) == "cap")
    assert finding.title == f"the solver gave up {len(capped)} times"
    assert f"first at step {run.series['step'][capped[0]]}" in finding.text and "(40)" in finding.text


def test_a_gradient_that_is_zero_because_nothing_depends_is_told_apart(good):
    unrolled = good.summary["gradient"][0]
    fragile = variant("fragile", depends={"k": False, "y0": True}, gradient={"k": 0.0, "y0": 0.75})
    finding = found(good, **summary(good, gradient=[unrolled], variants=[fragile]))["LOSS_INDEPENDENT"]
    assert finding.title == "the loss does not depend on k in variant fragile"
    assert "no operation that ran carries the parameter" in finding.text
    implicit = made("implicit", "", {"k": 0.0}, {"k": False})
    finding = found(good, **summary(good, gradient=[implicit]))["LOSS_INDEPENDENT"]
    assert finding.title == "the loss does not depend on k"
    assert "the fixed point" in finding.text and "no operation" not in finding.text
    zero = found(good, **summary(good, gradient=[made("unrolled", "", {"k": 0.0})]))
    assert "though k was used" in zero["ZERO_GRADIENT"].text


def test_methods_that_disagree_are_told_with_what_each_says_and_who_is_right(good):
    exact = {"gradient": {"y0": 0.4266}}
    gradient = [
        made("unrolled", "Decisions are held.", {"y0": 0.0}),
        made("event-aware", "Impact times move along.", {"y0": 0.42661}),
    ]
    finding = found(good, **summary(good, gradient=gradient, exact=exact))["METHODS_DISAGREE"]
    assert finding.title == "methods disagree on dloss/dy0"
    assert "unrolled 0, event-aware 0.427, closed form 0.427" in finding.text
    assert (
        "Decisions are held." in finding.text
        and "The closed form sides with event-aware on y0." in finding.text
    )


def test_a_fork_names_its_decision(good):
    changes = summary(good, variants=[variant("low", **FORK, separation_end=0.1)])
    finding = found(good, **changes)["FORKED"]
    assert finding.severity == "info"
    assert finding.text == (
        "low: the contact decision of ball 2 at step 30 differs first (margin 1.0\u00a0×\u00a010⁻¹⁷ against "
        "−2.0\u00a0×\u00a010⁻¹⁷); the bits part at step 3, the heights are 0.10 m apart at the end."
    )
    moved = summary(good, variants=[variant("low", **FORK, gradient={"k": -2.5e-5, "y0": -0.75})])
    assert found(good, **moved)["FORKED"].severity == "warning"
    # another integrator is another program: that it forks is no surprise
    other = variant("verlet", **FORK, gradient={"y0": -0.75}, changes={"integrator.kind": "velocity-verlet"})
    assert found(good, **summary(good, variants=[other]))["FORKED"].severity == "info"


def test_what_agrees_with_the_closed_form_is_evidence(good):
    exact = {"gradient": {"y0": 0.7501}, "height_error": 2e-14, "height_error_largest": 3e-14}
    verdict = findings.judge(dataclasses.replace(good, **summary(good, exact=exact)))
    assert verdict.findings == ()
    assert "off by 2.0\u00a0×\u00a010⁻¹⁴ m at the end and by 3.0\u00a0×\u00a010⁻¹⁴ m at most." in verdict.text
    assert "The derivative along y0 meets the closed form’s: unrolled and implicit." in verdict.text


def test_differs():
    assert not differs(1.0, 1.005) and differs(1.0, 1.02) and differs(0.0, 1e-30) and differs(None, 1.0)
    assert not differs(0.0, 0.0) and not differs(None, None) and differs(1.0, -1.0)


def test_findings_of_others_are_kept_and_own_ones_are_decided_anew(tmp_path):
    kept = {"code": "STIFF", "severity": "warning", "title": "h √k is 1.95", "text": "Near 2.", "remedy": ""}
    stale = {"code": "SOLVER_CAP", "severity": "warning", "title": "x", "text": "x", "remedy": ""}
    folder = make_ball(tmp_path / "run", summary={"findings": [kept, stale]})
    report.judge(folder)
    written = json.loads((folder.path / "summary.json").read_text(encoding="utf-8"))
    assert [finding["code"] for finding in written["findings"]] == ["STIFF"]
    assert written["verdict"].startswith("The record is complete; look at 1 point first: h √k is 1.95.")
    report.judge(folder)
    assert json.loads((folder.path / "summary.json").read_text(encoding="utf-8")) == written


def test_a_folder_without_a_step_is_refused(tmp_path):
    folder = make_ball(tmp_path / "run")
    (folder.path / "steps.parquet").unlink()
    with pytest.raises(FolderError, match=r"steps\.parquet: is missing"):
        load(folder.path)
    # where nothing says that there were steps
    (folder.path / "manifest.json").unlink()
    with pytest.raises(FolderError, match="holds no step"):
        load(folder.path)
