"""`mdnum fork` of a ball from the command line."""

from __future__ import annotations

import json

import pyarrow.parquet as pq
import pytest
from command_line import call, printed
from mdnum.forks.bounce import certify, choices


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--along", "spring=1:2"), "'spring' is no number that can be turned"),
        (("--along", "k=2:1"), "nothing between 2.0 and 1.0"),
        (("--vary", "precision", "--benign"), "is a ball. A ball has no ensemble"),
        (("--forecast", "1e-6"), "the margin that `mdnum ball` records"),
        (("--processes",), "is a ball. Whether a ball's bits"),
        (("--vary", "start", "--minimal"), "contact=STEP:BALL"),
        (("--vary", "start", "--no-back"), "--no-back is an option for molecular dynamics, and ball/drop"),
        (("--vary", "skin"), "no choice 'skin' of a ball"),
        (("--vary", "reduction=exact"), "its steps solve nothing"),
        (("--vary", "start", "--steps", "0"), "--steps"),
        (("--vary", "start", "--split", "-1"), "split = -1"),
        (("--vary", "start", "--certify"), "different questions"),
        ((), "nothing to vary"),
    ],
)
def test_what_cannot_be_asked_of_a_ball_is_refused_in_one_line(
    arguments, message, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert call("fork", "ball/drop", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_unknown_choice_names_the_nearest_of_a_ball(capsys):
    assert call("fork", "ball/drop", "--vary", "contakt=earlier", "--json") == 2
    remedy = json.loads(capsys.readouterr().out)["error"]["remedy"]
    assert remedy.startswith("Did you mean contact=earlier") and remedy.endswith("`mdnum fork` lists all")


def test_a_fork_of_a_ball_is_printed_and_told_as_json(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked = ("fork", "ball/stiff", "--vary", "contact=earlier", "--steps", "300", "--repeats", "4", "-o")
    assert call(*asked, "here", "--no-report") == 0
    lines = printed(capsys)
    assert lines[0].startswith("The ")
    at = next(line for line in lines if line.startswith("fork step"))
    assert "first decision differs" in at
    assert any(line.startswith("decision contact in B only, ball 0") for line in lines)
    assert any(line.startswith("margin in A -") and "not ambiguous" in line for line in lines)
    assert "A its own is A" in " ".join(lines)
    assert lines[-1] == "wrote here"
    assert call(*asked, "there", "--no-report", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["folder"] == "there" and document["decision"]["decided"] == {"A": 0, "B": 1}
    assert f"step {document['fork']:,}," in at


def test_two_finished_runs_of_a_ball(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ("--no-report", "--steps", "480", "--set", "gradient.of=[]", "--set", "variants={}")
    for name, more in (("a", ()), ("b", ("--set", "start.height=1.01")), ("c", ())):
        assert call("ball", "ball/drop", *small, *more, "-o", name) == 0
    capsys.readouterr()
    assert call("fork", "a", "b", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["differences"] == [["start.height", 1.0, 1.01]] and found["seed"] == 0
    ledgers = [pq.read_table(tmp_path / name / "contacts.parquet").to_pydict() for name in "ab"]
    # the lower ball touches first
    assert found["fork"] == ledgers[0]["step"][0] < ledgers[1]["step"][0] and found["channel"] == "contact"
    (flip,) = found["decisions"]
    assert (flip["run"], flip["ball"], flip["entered"]) == ("A", 0, True)
    assert flip["margin"] == ledgers[0]["margin"][0]
    assert call("fork", "a", "c") == 0
    lines = printed(capsys)
    assert lines[0] == "No stored number differs in 480 steps." and "fork none in 480" in lines


def test_the_exact_history_of_a_ball(capsys, monkeypatch):
    asked = ("float64", "bfloat16", "decision in float32")
    monkeypatch.setattr(certify, "POLICIES", {name: certify.POLICIES[name] for name in asked})
    small = (
        "--set",
        "contact.k=512",
        "--set",
        "integrator.timestep=0.015625",
        "--set",
        "start.height=0.40625",
    )
    gravity = ("--set", "flight.gravity=9.75")
    assert call("fork", "ball/drop", "--certify", "--steps", "80", *small, *gravity, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    found = {row["policy"]: row["horizon"] for row in document["ranking"]}
    # sixteen bits leave where plain rationals say that they do
    assert found["bfloat16"] == 66 and found["float64"] is None and found["decision in float32"] is None
    assert [row["policy"] for row in document["ranking"]] == ["float64", "decision in float32", "bfloat16"]
    assert any("Leave the exact history: bfloat16 at step 66" in said for said in document["says"])
    assert call("fork", "ball/zeno", "--certify") == 2
    assert "more than sums and products" in capsys.readouterr().err


def test_choices_of_both_worlds_are_listed(capsys):
    assert call("fork", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in document["ball_choices"]] == choices.names()
    assert {one["name"] for one in document["ball_choices"] if one["must_hold"]} == {
        "order@exact",
        "order@alone",
    }
