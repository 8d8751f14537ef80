"""The page of a gradient: whole, self-contained, and true to the folder."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from report.synthetic_grad import NAMES, RATE, STEPS, WEIGHTS, summary, write
from report.test_html import Tags

from mdnum import report
from mdnum.cli.grad_print import print_rows
from mdnum.report.fork.question import load
from mdnum.report.grad import figures, findings, sections
from mdnum.report.grad.words import apart, resolved
from mdnum.store import RunFolder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = write(tmp_path_factory.mktemp("gradients") / "run")
    report.write(folder.path)
    return RunFolder.open(folder.path)


def judged(tmp_path, **changes):
    """Findings by code, of a folder with these entries."""
    _, run = load(write(tmp_path / "one", **changes), "grad", "grad")
    return {one.code: one for one in findings.judge(run).findings}


def test_one_whole_file_that_loads_nothing(folder):
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(page)
    assert tags.open == [] and tags.sources == []
    assert len(tags.ids) == len(set(tags.ids))
    names = sorted(path.stem for path in (folder.path / "figures").iterdir())
    assert names == ["growth", "ranked", "running", "state"]
    assert tags.seen.count("svg") == 2 * len(names)


def test_the_page_states_what_the_folder_holds(folder):
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))
    for words in (
        "argon/synthetic: gradient of msd", "After 500 steps, d msd / d epsilon = 4.000 σ²/ε",
        "10 % of that by potential.epsilon and 100 % of that by cutoff.radius",
        "3.90000 ± 0.20 2.5 % off truncation and noise", "norm 3.00000", "It grew 1.5 × 10²-fold.",
        "cutoff.radius 0 % +40.0 % +60.0 %",
        "--methods unrolled", "100 atoms, 500 steps of 0.01 τ",
    ):  # fmt: skip
        assert words in text, words


def test_a_flip_that_outweighs_the_others_is_named(folder):
    (found,) = folder.summary["findings"]
    assert found["code"] == "FEW_FLIPS" and found["severity"] == "info"
    assert "the pair 0–1 at step 1" in found["text"] and "adds 25 %" in found["text"]
    assert folder.summary["headline"].startswith("After 500 steps")


def test_growth_is_told_by_what_a_relative_change_does(folder):
    _, run = load(folder, "grad", "grad")
    plot = figures.growth(run)
    by = {series.label: series for series in plot.series}
    # the parameter's value times the derivative, from one step on
    np.testing.assert_allclose(by[NAMES[1]].y[-1], 2.5 * 2.0)
    np.testing.assert_allclose(by[NAMES[2]].y, 17.0 * np.exp(RATE * np.arange(1, STEPS + 1)))
    line = figures.state(run).series[1]
    np.testing.assert_allclose(line.y, np.exp(RATE * np.arange(STEPS + 1)), rtol=1e-9)
    ends = {series.label: series.y[-1] for series in figures.running(run).series}
    assert ends[NAMES[1]] == pytest.approx(WEIGHTS.sum() / 2.0)


def test_findings_follow_the_numbers(tmp_path):
    methods = summary()["methods"]
    plain = judged(tmp_path / "a", methods=methods[:1], reference="symmetric", comparisons=[], flips=None)
    assert (
        plain["MISSING_SALTATION"].severity == "warning"
        and "event-aware" in plain["MISSING_SALTATION"].remedy
    )
    # the only method finds nothing by the cutoff
    assert plain["NO_DEPENDENCE"].title.endswith("cutoff.radius")
    smooth = judged(tmp_path / "b", methods=methods[:1], reference="symmetric", force_jump=0.0, flips=None)
    assert "MISSING_SALTATION" not in smooth

    broken = {**methods[1], "gradient": {**methods[1]["gradient"], NAMES[0]: float("nan")}}
    assert judged(tmp_path / "c", methods=[broken])["NOT_FINITE"].severity == "error"

    row = {**summary()["comparisons"][0], "means": "unexplained"}
    assert "10 % off" in judged(tmp_path / "d", comparisons=[row])["UNEXPLAINED"].text

    details = {**methods[1]["details"], "grazing": 2, "weight left out": 0.5}
    left = judged(tmp_path / "e", methods=[{**methods[1], "details": details}])
    assert "16 % of the weight" in left["GRAZING"].text

    jumps = [{**one, "details": {**one["details"], "loss jumps": True}} for one in methods]
    assert "no slope" in judged(tmp_path / "h", methods=jumps)["LOSS_JUMPS"].text
    assert "LOSS_JUMPS" not in judged(tmp_path / "i", methods=methods)

    primal = {"first state": 3, "first decision": None, "says": "a bit differs from step 3 on"}
    departs = [{**methods[1], "details": {"primal": primal}}]
    assert judged(tmp_path / "j", methods=departs)["ANOTHER_PRIMAL"].severity == "info"
    departs[0]["details"]["primal"]["first decision"] = 40
    assert judged(tmp_path / "k", methods=departs)["ANOTHER_PRIMAL"].severity == "warning"

    trust = {"horizon": 300, "limited_by": "rounding", "tolerance": 0.01, "says": "Rounding limits it."}
    assert judged(tmp_path / "f", trust=trust)["BEYOND_TRUST"].severity == "warning"


TRUST = {
    "verdict": "limited", "horizon": 300, "limited_by": "near miss", "limits": [], "unknown": [],
    "tolerance": 0.01, "shadow": "", "says": "A pair nearly flipped.",
    "half": {NAMES[0]: 4.02, NAMES[1]: 0.9},
    "digits": {NAMES[0]: 2, NAMES[1]: 0},
    "near": {"turns": 9, "within": 1, "heaviest": [
        {"step": 77, "i": 3, "j": 5, "gap": 3e-5, "reach": 8e-5, "term": {NAMES[0]: 0.1, NAMES[1]: 1.9}},
    ]},
}  # fmt: skip


def headline(tmp_path, **changes):
    """The tone and the headline of a folder with these entries."""
    _, run = load(write(tmp_path / "one", **changes), "grad", "grad")
    found = findings.judge(run)
    return found.tone, found.headline


def test_trusted_is_said_where_all_of_it_was_looked_at_alone(tmp_path):
    tone, words = headline(tmp_path / "a", trust=TRUST)
    assert tone == "warning" and "not trusted beyond step 300: near miss" in words
    # the digits that half the time step leaves, and no more
    assert "epsilon = 4.0 σ²/ε" in words and "radius = 2 σ²/σ (no digit holds)" in words
    open_ = {**TRUST, "verdict": "undecided", "limited_by": "", "unknown": ["whether other starts agree"]}
    tone, words = headline(tmp_path / "b", trust=open_)
    assert tone == "warning" and "undecided, other starts not known" in words
    free = {**TRUST, "verdict": "trusted", "limited_by": ""}
    tone, words = headline(tmp_path / "c", trust=free)
    assert tone == "good" and words.endswith("; trusted.")
    # a folder from before the time step was looked at, and one that nobody asked
    old = {"horizon": 500, "limited_by": "", "tolerance": 0.01, "says": "Trusted over all 500 steps."}
    assert headline(tmp_path / "d", trust=old)[0] == "warning"
    tone, words = headline(tmp_path / "e")
    assert tone == "info" and "trust" not in words


def test_the_half_time_step_stands_beside_and_near_misses_below(tmp_path):
    folder = write(tmp_path / "run", trust=TRUST)
    report.write(folder.path)
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))
    assert "event-aware at half the time step" in text and " 4.0 0.9 " in text
    assert "3–5 77 3.0 × 10⁻⁵ 8.0 × 10⁻⁵ 0.10 1.9" in text.replace("\N{NO-BREAK SPACE}", " ")
    assert resolved(43517.0, 2) == "4.4 × 10⁴".replace(" ", "\N{NO-BREAK SPACE}")
    assert resolved(0.0444, 1) == "0.04" and resolved(-4.898, 0) == "−5" and resolved(22.06, 2) == "22"


def open_trust(*unseen: str, unknown: tuple[str, ...] = ()) -> dict[str, Any]:
    """Trust that is undecided: half the time step was not made, and these limits were not looked at."""
    limits = [{"what": what, "horizon": None, "reached": False, "says": "Not looked at."} for what in unseen]
    more = {"half": {}, "digits": {}, "near": None, "says": "Undecided."}
    unknown = unknown or unseen
    return {**TRUST, "verdict": "undecided", "limited_by": "", "limits": limits, "unknown": unknown, **more}


def test_two_digits_are_told_where_nobody_knows_how_many_hold(tmp_path, capsys):
    methods = [
        {**one, "gradient": {**one["gradient"], NAMES[0]: -0.0086653366}} for one in summary()["methods"]
    ]
    trust = open_trust("time step", "near miss")
    folder = write(tmp_path / "run", trust=trust, methods=methods)
    _, run = load(folder, "grad", "grad")
    assert "epsilon = −0.0087 σ²/ε (digits not known)" in findings.judge(run).headline
    print_rows(folder.summary)
    printed = " ".join(capsys.readouterr().out.split())
    assert "-0.0087 (digits not known)" in printed and "-0.00866" not in printed
    report.write(folder.path)
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    assert "digits not known" in page and "0.00866" not in page
    # of a question that is none about trust they are told in full
    plain = write(tmp_path / "plain", methods=methods)
    print_rows(plain.summary)
    assert "-0.0086653366" in capsys.readouterr().out


def test_what_is_undecided_says_what_to_do(tmp_path):
    def remedy(name, trust, *left):
        ways = {"left_out": [{"what": what, "why": "", "how": "x"} for what in left]}
        return judged(tmp_path / name, trust=trust, **ways)["UNDECIDED"].remedy

    both = ("time step", "near miss")
    assert remedy("a", open_trust(*both), "half the time step") == "Leave out --no-half-step."
    noisy = remedy("b", open_trust(*both, "standard error", unknown=both))
    assert "--set dynamics.kind=nve, or" in noisy and "--replicas 8" in noisy
    starts = remedy("c", open_trust("standard error", unknown=("whether other starts agree",)))
    assert starts == "Look at other starts with --replicas 8."
    assert "fewer parameters" in remedy("d", open_trust("near miss"))
    alone = {"reference": "symmetric", "methods": summary()["methods"][:1], "comparisons": []}
    found = judged(tmp_path / "e", trust=open_trust("near miss"), left_out=[], **alone)
    assert "add event-aware" in found["UNDECIDED"].remedy.lower()


def test_no_share_is_told_of_a_derivative_without_a_digit(tmp_path):
    folder = write(tmp_path / "run", trust={**TRUST, "digits": {NAMES[0]: 2, NAMES[1]: 0}})
    _, run = load(folder, "grad", "grad")
    told = findings.judge(run)
    few = next(one for one in told.findings if one.code == "FEW_FLIPS")
    assert "25 %" not in few.text and "No digit of it holds" in few.text and "0–1 at step 1" in few.text
    assert not any("100 %" in line for line in told.evidence)
    assert any("10 % of that by potential.epsilon" in line for line in told.evidence)
    rows = {row["name"]: row["parts"] for row in sections.shares(run)}
    assert rows[NAMES[1]] == ["–"] * 3 and rows[NAMES[0]][0] == "+90.0 %"


def test_a_ball_far_from_its_closed_form_is_told(tmp_path):
    told = {"exact": {"y0": 2.0}, "reference": "closed form", "contact_kind": "impact", "flips": None}
    told |= {"integrator": "semi-implicit-euler", "growth": None, "force_jump": None}
    row = {**summary()["comparisons"][0], "name": "y0", "method": "event-aware"}
    off = judged(tmp_path / "a", comparisons=[row], **told)["NOT_THE_MOTION"]
    assert off.severity == "warning" and "event-aware (y0 10 % off)" in off.text.lower()
    assert "event-located" in off.remedy
    near = judged(tmp_path / "b", comparisons=[{**row, "relative": 0.009}], **told)
    assert "NOT_THE_MOTION" not in near
    # relative to the first row, as its caption says
    assert apart({**row, "relative": 5.8}) == "580 % off"
    assert apart({**row, "relative": None, "size": 0.0}) == "where the other is 0"
