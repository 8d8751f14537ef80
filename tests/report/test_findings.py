"""Each finding is found where it is planted, and only there."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from report.synthetic import make_run

from mdnum.errors import FolderError
from mdnum.report import analysis, findings
from mdnum.report.rules import CODES
from mdnum.report.run import load
from mdnum.store import RunFolder


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return load(make_run(tmp_path_factory.mktemp("runs") / "good", steps=150, candidates=800))


def codes(run, **changes):
    return [finding.code for finding in findings.judge(dataclasses.replace(run, **changes)).findings]


def summary(run, **changes):
    return {"summary": {**run.summary, **changes}}


def epochs(run, **changes):
    columns = {name: values.copy() for name, values in run.epochs.items()}
    for name, value in changes.items():
        columns[name][1] = value
    return {"epochs": columns}


def series(run, row, **changes):
    columns = {name: values.copy() for name, values in run.series.items()}
    for name, value in changes.items():
        columns[name][row] = value
    return {"series": columns}


def test_a_good_run(good):
    verdict = findings.judge(good)
    assert verdict.tone == "good"
    assert [finding.code for finding in verdict.findings] == ["HARD_CUTOFF"]
    # what its own note says is not hidden behind a good word
    assert verdict.findings[0].title in verdict.headline and "nothing" not in verdict.headline
    assert f"All {good.flips_total:,} flips are accounted for" in verdict.evidence[0]
    assert len(verdict.evidence) == 4


def test_every_planted_defect_is_found(good):
    table = {name: np.delete(values, 40) for name, values in RunFolder.open(good.path).read("flips").items()}
    flips = analysis.scan(table, len(good.series["step"]))
    kicks = 1e4 * good.series["energy_jump"]
    kicked = {"energy_jump": kicks + good.series["energy_jump"]}
    kicked |= {name: good.series[name] + np.cumsum(kicks) for name in ("total", "conserved")}
    planted = {
        "RUN_FAILED": summary(good, status="failed", error="a force is NaN"),
        "NOT_FINISHED": summary(good, status=None),
        "LOST_PAIRS": epochs(good, lost_pairs=3, lost_pair_steps=11, first_lost_step=25),
        "DANGEROUS_BUILDS": epochs(good, dangerous=True),
        "EVENT_ALGEBRA": series(good, 77, pairs=1),
        "LEDGER_INCOMPLETE": {"flips": flips},
        "BUDGET_OPEN": summary(good, energy_budget_closes=False),
        "TIE_AT_CUTOFF": series(good, 0, min_margin=0.0),
        "AMBIGUOUS_DECISIONS": summary(good, ambiguous=2),
        "DRIFT": {"series": {**good.series, "conserved": good.series["conserved"] + 5 * good.series["time"]}},
        "WANDER": {"series": {**good.series, **kicked}},
        "LISTS_DISAGREE": summary(good, count_mismatches=2),
        "ASE_DISAGREES": summary(good, ase={"ok": False, "energy_rel": 1e-3, "force_max": 0.1}),
        "ASE_NOT_COMPARED": summary(good, ase=None),
        "FORCE_JUMP": summary(good, cutoff={"kind": "shifted", "energy_jump": 0.0, "force_jump": 1e-4}),
        "HARD_CUTOFF": {},
    }
    assert set(planted) | {"CHATTER"} == CODES
    for code, changes in planted.items():
        expected = {code} if code == "FORCE_JUMP" else {code, "HARD_CUTOFF"}
        assert set(codes(good, **changes)) == expected, code


def test_lost_pairs_are_told_with_numbers_and_a_remedy(good):
    run = dataclasses.replace(
        good,
        system={**good.system, "neighbors": {"rebuild": {"check": False, "every": 20}}},
        **epochs(good, lost_pairs=3, lost_pair_steps=1108, first_lost_step=25),
    )
    verdict = findings.judge(run)
    assert verdict.tone == "error"
    assert verdict.headline == "Do not rely on this run: the neighbor list lost 3 pairs, from step 25 on."
    assert "1,108 pair-steps" in verdict.findings[0].text
    assert "rebuilt blindly every 20 steps" in verdict.findings[0].remedy
    assert not any("No pair was lost" in sentence for sentence in verdict.evidence)


def test_what_follows_from_lost_pairs_does_not_hide_them(good):
    changes = epochs(good, lost_pairs=3, lost_pair_steps=9, first_lost_step=25) | series(good, 77, pairs=1)
    changes |= summary(good, energy_budget_closes=False)
    verdict = findings.judge(dataclasses.replace(good, **changes))
    assert verdict.headline.endswith("lost 3 pairs, from step 25 on and 2 more errors below.")
    assert {finding.remedy for finding in verdict.findings[1:3]} == {
        "Lost pairs have no place in the ledger: mend the neighbor lists first."
    }


def test_a_flip_dropped_by_the_recorder_is_noticed(tmp_path):
    run = load(make_run(tmp_path / "run", steps=60, candidates=800, drop_flip=True))
    verdict = findings.judge(run)
    assert {"BUDGET_OPEN", "LEDGER_INCOMPLETE", "EVENT_ALGEBRA"} >= {
        finding.code for finding in verdict.findings if finding.severity == "error"
    }
    assert not analysis.algebra_holds(run.series)[30:].any()
    [opened] = [finding for finding in verdict.findings if finding.code == "BUDGET_OPEN"]
    assert "at step 30" in opened.text
    flip, move = findings.sharpness(run)
    assert move == pytest.approx(flip, rel=0.01)


def test_chatter_is_a_matter_of_the_cutoff(good):
    flips = {name: values[:40] for name, values in RunFolder.open(good.path).read("flips").items()}
    flips |= {
        "step": np.arange(1, 41),
        "i": np.full(40, 3),
        "j": np.full(40, 8),
        "entered": np.arange(40) % 2 == 0,
    }
    columns = {name: values.copy() for name, values in good.series.items()}
    for name, inside in (("entered", flips["entered"]), ("left", ~flips["entered"])):
        columns[name] = np.bincount(flips["step"][inside], minlength=len(columns["step"]))
    columns["pairs"] = 100 + np.cumsum(columns["entered"] - columns["left"])
    run = dataclasses.replace(good, flips=analysis.scan(flips, len(columns["step"])), series=columns)
    [hard] = [finding for finding in findings.judge(run).findings if finding.code == "CHATTER"]
    assert hard.severity == "warning"
    assert "pair 3–8 alone flips 40 times" in hard.text
    smooth = summary(run, cutoff={"kind": "quintic", "energy_jump": 0.0, "force_jump": 0.0})
    [finding] = findings.judge(dataclasses.replace(run, **smooth)).findings
    assert (finding.code, finding.severity) == ("CHATTER", "info")


def test_findings_are_stored_and_decided_anew(tmp_path):
    folder = make_run(tmp_path / "run", steps=60, candidates=200, summary={"ase": {"ok": False}})
    first = findings.record(folder)
    assert [finding.code for finding in first.findings] == ["ASE_DISAGREES", "HARD_CUTOFF"]
    stored = json.loads((folder.path / "summary.json").read_text())
    assert stored["verdict"] == first.text
    other = {
        "code": "FINDERS_DISAGREE",
        "severity": "warning",
        "title": "finders disagree",
        "text": "x",
        "remedy": None,
    }
    folder.write_summary({**stored, "ase": {"ok": True}, "findings": [*stored["findings"], other]})
    second = findings.record(folder)
    assert [finding.code for finding in second.findings] == ["FINDERS_DISAGREE", "HARD_CUTOFF"]
    assert second.headline.endswith("look at 1 point first: finders disagree.")


def test_a_killed_run_is_judged_up_to_its_checkpoint(tmp_path):
    run = load(make_run(tmp_path / "run", steps=60, candidates=200, finish=False))
    assert run.steps == 30
    verdict = findings.judge(run)
    assert verdict.headline.startswith("As far as it went")
    assert verdict.findings[0].code == "NOT_FINISHED"


def test_a_folder_without_a_step_is_refused(tmp_path):
    folder = RunFolder.create(tmp_path / "run")
    folder.write_system('units = "lj"')
    with pytest.raises(FolderError, match="holds no step of a run"):
        load(folder)
