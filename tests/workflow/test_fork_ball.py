"""A comparison of two rollouts of a ball into its folder, and its page."""

from __future__ import annotations

import json
import re
import sys
import tomllib

import numpy as np
import pytest
from mdnum.forks.bounce import choices

import mdnum
from mdnum.errors import InputError
from mdnum.report import judge, write
from mdnum.store import RunFolder
from mdnum.systems import load
from mdnum.workflow import ForkResult

SYSTEM = """
about = "Three balls."
world = "ball"
[start]
height = [0.3, 0.301, 0.52]
[contact]
kind = "projection"
k = 0.5
[stop]
rule = "sum"
tol = 1e-3
[integrator]
kind = "semi-implicit-euler"
timestep = 0.01
steps = 120
[fork]
vary = "contact=earlier"
split = 0.002
"""
STEPS = 120


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("systems") / "three.toml"
    path.write_text(SYSTEM)
    return path


@pytest.fixture(scope="module")
def compared(file, tmp_path_factory) -> ForkResult:
    """What the system file asks for itself: its first contact a step earlier."""
    return mdnum.fork(file, out=tmp_path_factory.mktemp("forks") / "three")


def test_the_summary_says_what_was_followed(compared):
    made, summary = compared.fork, compared.summary
    assert made is not None and made.decision is not None
    assert summary["world"] == "fork" and summary["question"] == "ball-fork"
    assert (summary["system"], summary["balls"], summary["choice"]) == ("three", 3, "contact=earlier")
    assert summary["steps"] == STEPS and summary["timestep"] == 0.01 and summary["tolerance"] == 0.002
    assert (summary["seed"], summary["fork"]) == (made.dates.seed, made.dates.fork)
    assert summary["fork_time"] == pytest.approx(0.01 * made.dates.fork)
    assert summary["verdict"] == "cause" and summary["status"] == "complete"
    decision = summary["decision"]
    assert (decision["channel"], decision["step"]) == ("contact", summary["fork"])
    assert (decision["run"], decision["decided"]) == ("B", {"A": 0, "B": 1})
    # the ball was above the floor in both runs: the margin is minus one height
    assert decision["margins"]["A"] == decision["margins"]["B"] < 0
    assert not decision["ambiguous"] and decision["bounds"]["A"] > 0
    assert summary["splits"] == {"B": made.dates.split, "B|A": None, "A|B": None}
    assert summary["handed_largest"] == 0.0 and len(summary["table"]) == 8 and summary["repeated"] == []
    assert summary["cross_flips"] == summary["cross_contacts"] + summary["cross_stops"] > 0
    ball = decision["ball"]
    assert summary["headline"].startswith(
        f"The contact of ball {ball} at step {summary['fork']} is the cause"
    )
    assert json.loads((compared.folder / "summary.json").read_text()) == summary
    # the keys that both worlds have
    assert {
        "difference",
        "reasons",
        "nats",
        "count",
        "growth",
        "shares",
        "predicted_split",
        "findings",
    } <= set(summary)


def test_the_tables_hold_series_and_decisions(compared):
    folder, made = RunFolder.open(compared.folder), compared.fork
    table = folder.read("separation")
    assert table["step"].tolist() == list(range(STEPS + 1))
    for column, name in (("free", "B"), ("handed", "B|A"), ("back", "A|B"),
                         ("cross", "cross"), ("energy_b", "energy B")):  # fmt: skip
        np.testing.assert_array_equal(table[column], made.series[name])
    rows = folder.read("cross_flips")
    a, b = made.runs["A"], made.runs["B"]
    contact = rows["channel"].astype(str) == "contact"
    # against the two runs, decision by decision
    expected = {(int(row) + 1, int(ball)) for row, ball in np.argwhere(a.contact != b.contact)}
    found = set(zip(rows["step"][contact].tolist(), rows["ball"][contact].tolist(), strict=True))
    assert found == expected and len(found) == contact.sum()
    stops = np.flatnonzero(a.iterations != b.iterations)
    np.testing.assert_array_equal(rows["step"][~contact], stops + 1)
    np.testing.assert_array_equal(rows["a"][~contact], a.iterations[stops])
    np.testing.assert_array_equal(rows["b"][~contact], b.iterations[stops])
    assert set(rows["ball"][~contact]) <= {-1}
    around = folder.read("around")
    mine = around["run"].astype(str) == "B"
    one = compared.summary["decision"]["ball"]
    np.testing.assert_array_equal(around["y"][mine], b.y[around["step"][mine], one])
    assert bool(around["contact"][mine][around["step"][mine] == made.dates.fork][0])


def test_the_folder_is_a_system_that_loads_again(compared):
    again = load(compared.folder)
    assert again.name == "three" and again.balls == 3
    assert tomllib.loads((compared.folder / "system.toml").read_text())["fork"]["vary"] == "contact=earlier"
    assert RunFolder.open(compared.folder).provenance["system"] == "three"


def test_the_page_says_what_the_summary_does(compared):
    text = (compared.folder / "report.html").read_text(encoding="utf-8")
    words = " ".join(re.sub(r"<[^>]+>", " ", text).split())
    assert compared.summary["headline"] in words
    assert "Decisions that differ" in words and "Whose decisions, whose arithmetic" in words
    for name in ("separation", "around", "cross", "energy"):
        assert (compared.folder / "figures" / f"{name}.svg").exists(), name
    assert "http" not in re.sub(r"http://www.w3.org/[\w/]+", "", text)
    # written again, and judged alone, it says the same
    assert write(compared.folder).read_text(encoding="utf-8") == text
    judge(compared.folder)
    assert json.loads((compared.folder / "summary.json").read_text()) == compared.summary


def test_choices_are_screened_into_a_folder(file, tmp_path, monkeypatch):
    asked = {name: choices.BY_NAME[name] for name in ("order@alone", "contact=later", "stop=sum")}
    # the function of that name stands before its module
    monkeypatch.setattr(sys.modules["mdnum.forks.bounce.choices.screen"], "BY_NAME", asked)
    seen = []
    result = mdnum.fork(file, "all", out=tmp_path / "all", steps=60, progress=lambda *now: seen.append(now))
    summary = result.summary
    assert result.fork is None and summary["steps"] == 60 and summary["balls"] == 3
    assert [one["choice"] for one in summary["ranking"]] == ["contact=later", "order@alone"]
    assert summary["not_applicable"] == [{"choice": "stop=sum", "why": "the rule is sum already"}]
    assert summary["headline"].startswith("1 of 2 choices fork")
    assert (0, 3, {"phase": "order@alone (1 of 3)"}) in seen
    page = (result.folder / "report.html").read_text(encoding="utf-8")
    assert "holds" in page and "3 balls" in page and "atom" not in page


def test_a_rule_that_must_hold_and_does_not_is_a_finding(file, tmp_path, monkeypatch):
    planted = choices.ContactStep()
    monkeypatch.setattr(choices.ContactStep, "must_hold", True)
    monkeypatch.setattr("mdnum.forks.bounce.choices.parse", lambda text: planted)
    result = mdnum.fork(
        file, "stand-in", out=tmp_path / "here", repeats=0, report=False, counterfactual=False
    )
    assert [finding["code"] for finding in result.summary["findings"]] == ["MUST_HOLD_FORKED"]
    assert result.summary["verdict"] == "open" and result.summary["handed_until"] is None
    assert not (tmp_path / "here" / "report.html").exists()


def test_a_loaded_ball_is_as_good_as_its_name(file, tmp_path):
    with pytest.raises(InputError, match="overrides change a system"):
        mdnum.fork(load(file), "start", overrides={"contact.k": 0.4}, out=tmp_path / "x")
    with pytest.raises(InputError, match=r"nothing to vary.*contact=earlier"):
        mdnum.fork("ball/drop", out=tmp_path / "x")
    with pytest.raises(InputError, match="steps = 0"):
        mdnum.fork("ball/drop", "precision", steps=0, out=tmp_path / "x")
    assert not (tmp_path / "x").exists()
