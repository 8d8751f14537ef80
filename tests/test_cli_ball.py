"""`mdnum ball`: what it passes on, prints and exits with; runs and demonstrations."""

from __future__ import annotations

import json
import types
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import call

import mdnum.workflow
from mdnum.ball import demos
from mdnum.ball.demos import Check, Demo, Table
from mdnum.cli.progress import ProgressBar
from mdnum.errors import InputError

SUMMARY: dict[str, Any] = {
    "world": "ball",
    "system": "ball/drop",
    "balls": 1,
    "steps": 2000,
    "flips_entered": 2,
    "flips_left": 1,
    "first_contact": 453,
    "iterations_total": 30,
    "ended": {"tolerance": 3, "cap": 1},
    "ambiguous": 0,
    "loss": 0.5,
    "exact": {"height_error": 1.25e-5},
    "gradient": [
        {"method": "unrolled", "says": "Of what ran.", "gradient": {"k": 0.0, "y0": 2.5},
         "depends": {"k": False, "y0": True}, "refused": False},
        {"method": "randomized", "says": "Of an average.", "gradient": {"k": 0.0, "y0": 2.25},
         "depends": {"k": False, "y0": True}, "refused": False,
         "details": {"standard_error": {"k": 0.0, "y0": 0.125}}},
        {"method": "implicit", "says": "No fixed point here.", "gradient": {}, "refused": True},
    ],
    "variants": [
        {"name": "float32", "seed": 0, "fork": 7, "channel": "contact", "ball": 0, "margin": 1e-17,
         "margin_there": -2e-17, "separation_end": np.float64(0.25), "loss": 0.25,
         "gradient": {"k": 1.5, "y0": 3.5}, "depends": {"k": True, "y0": True}},
        {"name": "same", "seed": None, "fork": None, "channel": None, "ball": None, "margin": None,
         "margin_there": None, "separation_end": 0.0, "loss": 0.5, "gradient": {"k": 0.0, "y0": 2.5},
         "depends": {"k": False, "y0": True}},
    ],
    "findings": [],
    "verdict": "Nothing to worry about.",
    "status": "complete",
}  # fmt: skip


@dataclass
class Recorder:
    summary: dict[str, Any] = field(default_factory=lambda: dict(SUMMARY))
    error: BaseException | None = None
    calls: list[tuple[Any, dict[str, Any]]] = field(default_factory=list)

    def __call__(self, system: Any, **options: Any) -> Any:
        self.calls.append((system, options))
        if self.error is not None:
            raise self.error
        options["progress"](1, 10, {"phase": "run"})
        return types.SimpleNamespace(folder=options["out"], summary=self.summary)


@pytest.fixture
def bounce(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Recorder:
    """`mdnum ball` in an empty folder with the run replaced by a recorder."""
    recorder = Recorder()
    monkeypatch.setattr(mdnum.workflow, "bounce", recorder)
    monkeypatch.chdir(tmp_path)
    return recorder


def test_ball_passes_on_what_was_asked(bounce: Recorder):
    code = call(
        "ball", "ball/drop", "-o", "here", "--steps", "20", "--set", "contact.k=2e4",
        "--against", "precision.state=float32", "--against", "contact.k=3e4", "--no-report",
    )  # fmt: skip
    assert code == 0
    ((system, options),) = bounce.calls
    assert system == "ball/drop"
    assert isinstance(options.pop("progress"), ProgressBar)
    assert options == {
        "out": Path("here"),
        "steps": 20,
        "overrides": {"contact.k": "2e4"},
        "against": ["precision.state=float32", "contact.k=3e4"],
        "report": False,
    }


def test_ball_prints_what_a_person_wants_to_know(bounce: Recorder, capsys: pytest.CaptureFixture[str]):
    assert call("ball", "ball/drop") == 0
    out = capsys.readouterr().out
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert lines[0] == "Nothing to worry about."
    assert "system ball/drop, 1 ball, 2,000 steps" in lines
    assert "contacts 2 entered, 1 left" in lines
    assert "solver 30 iterations; ended by: 3 tolerance, 1 cap" in lines
    assert "against the closed form height at the end off by 1.25e-05 m" in lines
    assert "unrolled 0 (does not depend) 2.5 Of what ran." in lines
    assert "randomized 0 (does not depend) 2.25 ± 0.12 Of an average." in lines
    assert "implicit - - No fixed point here." in lines
    assert "float32 0 7 contact, ball 0 1e-17 and -2e-17 0.25 0.25 1.5 3.5" in lines
    assert "same - - none differs - 0 0.5 0 (does not depend) 2.5" in lines
    assert lines[-1] == "wrote runs/ball-drop-1"


def test_a_bare_run_prints_too(bounce: Recorder, capsys: pytest.CaptureFixture[str]):
    bare = {"exact": None, "gradient": [], "variants": [], "ended": {}, "first_contact": None}
    bounce.summary = SUMMARY | bare
    assert call("ball", "ball/drop") == 0
    out = capsys.readouterr().out
    assert "nothing solved" in out
    bounce.summary |= {"integrator": "event-located", "ended": {"rest": 4}}
    assert call("ball", "ball/drop") == 0
    assert "30 located; at rest for 4 steps" in capsys.readouterr().out
    assert "closed form" not in out
    assert "variant" not in out


def test_ball_as_json_is_one_document(bounce: Recorder, capsys: pytest.CaptureFixture[str]):
    assert call("ball", "ball/drop", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["folder"] == "runs/ball-drop-1"
    assert document["variants"][0]["separation_end"] == 0.25
    assert {name: document[name] for name in ("ended", "gradient")} == {
        name: SUMMARY[name] for name in ("ended", "gradient")
    }


def test_findings_and_status_decide_the_exit_code(bounce: Recorder):
    for severity, expected in (("info", 0), ("warning", 1), ("error", 1)):
        bounce.summary["findings"] = [{"code": "X", "severity": severity, "title": "t", "text": ""}]
        assert call("ball", "ball/drop") == expected
    bounce.summary |= {"findings": [], "status": "failed"}
    assert call("ball", "ball/drop") == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["ball", "x", "--set", "no-equals-sign"],
        ["ball", "x", "--steps", "0"],
        ["ball", "--demo", "fork", "x"],
        ["ball", "--demo", "fork", "--set", "a=1"],
        ["ball", "--demo", "fork", "--against", "a=1"],
        ["ball", "--demo", "fork", "--steps", "3"],
        ["ball", "--demo", "forc"],
    ],
)
def test_mistakes_are_one_line_and_exit_2(
    bounce: Recorder, capsys: pytest.CaptureFixture[str], arguments: list[str]
):
    assert call(*arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("mdnum: ")
    assert err.count("\n") == 1
    assert bounce.calls == []
    assert call(*arguments, "--json") == 2
    assert json.loads(capsys.readouterr().out)["error"]["exit_code"] == 2


def test_errors_of_a_run_are_one_line(bounce: Recorder, capsys: pytest.CaptureFixture[str]):
    bounce.error = InputError("alpha k = 2.5", remedy="Make it smaller")
    assert call("ball", "x") == 2
    assert capsys.readouterr().err == "mdnum: alpha k = 2.5. Make it smaller.\n"
    bounce.error = KeyboardInterrupt()
    assert call("ball", "x") == 130
    assert capsys.readouterr().err == "mdnum: stopped.\n"


def test_an_unknown_demonstration_lists_them(capsys: pytest.CaptureFixture[str]):
    assert call("ball", "--demo", "forc") == 2
    err = capsys.readouterr().err
    assert "Did you mean fork?" in err
    assert all(name in err for name in demos.NAMES)


def test_each_world_points_to_the_other(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("run", "ball/drop") == 2
    assert "Use `mdnum ball ball/drop`" in capsys.readouterr().err
    assert call("ball", "argon/crystal-108") == 2
    assert "Use `mdnum run argon/crystal-108`" in capsys.readouterr().err
    for check in ("energy", "pairs", "dynamics"):
        assert call("check", check, "ball/drop") == 2
        assert "this system is a ball" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_ball_alone_lists_systems_and_demonstrations(capsys: pytest.CaptureFixture[str]):
    assert call("ball") == 0
    out = capsys.readouterr().out
    assert "ball/zeno" in out
    assert "argon" not in out
    assert all(name in out for name in demos.NAMES)
    assert call("ball", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in document["demos"]] == list(demos.NAMES)
    assert all(row["about"] for row in document["demos"])
    assert {row["name"]: row["balls"] for row in document["systems"]}["ball/batch-on-the-boundary"] == 9


def test_systems_of_both_worlds_are_listed_shown_and_checked(capsys: pytest.CaptureFixture[str]):
    assert call("systems", "list", "--json") == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["systems"]}
    assert rows["ball/drop"]["balls"] == 1
    assert rows["argon/crystal-108"]["atoms"] == 108
    assert call("systems", "show", "ball/drop", "--set", "contact.k=2e4", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["contact"]["k"], shown["precision"]["reduction"]) == (2e4, "sequential")
    assert call("systems", "check", "ball/batch-on-the-boundary") == 0
    assert capsys.readouterr().out == "ball/batch-on-the-boundary: fine, 9 balls\n"
    assert call("systems", "check", "ball/drop", "--set", "contact.kk=1") == 2


DEMO = Demo(
    name="sum-order",
    title="A title",
    question="Why?",
    answer="Because.",
    numbers={"large_first": 0.0009760856628, "ball_runs": [1, 2]},
    checks=[Check("it holds", 1.5, "1.5", True)],
    tables=[Table("rows", ("n", "square"), tuple((n, n * n) for n in range(30)))],
    in_md="The same.",
    data={"history": np.array([1.0, np.nan])},
)


@pytest.fixture
def demo(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Demo]:
    """Demonstrations that give what they are told, in an empty folder."""
    given = {name: replace(DEMO, name=name) for name in demos.NAMES}
    monkeypatch.setattr(demos, "find", lambda name: lambda: given[name])
    monkeypatch.chdir(tmp_path)
    return given


def test_a_demonstration_for_people(demo: dict[str, Demo], capsys: pytest.CaptureFixture[str]):
    assert call("ball", "--demo", "fork", "-o", "page") == 0
    out = capsys.readouterr().out
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert lines[:3] == ["fork: A title", "Why?", "Because."]
    assert "large first 0.0009760856628" in lines
    assert "ok it holds 1.5 1.5" in lines
    assert "19 361" in lines
    assert "20 400" not in lines
    assert "10 more rows are in the report" in lines
    assert "In molecular dynamics: The same." in lines
    assert lines[-1] == "wrote page/report.html"
    assert "<html" in Path("page/report.html").read_text(encoding="utf-8")


def test_a_demonstration_that_fails_its_check_exits_1(
    demo: dict[str, Demo], capsys: pytest.CaptureFixture[str]
):
    demo["fork"] = replace(DEMO, name="fork", checks=[Check("it holds", 2.5, "1.5", False)])
    assert call("ball", "--demo", "fork", "--no-report") == 1
    assert "failed  it holds" in capsys.readouterr().out
    assert not Path("runs").exists()
    assert call("ball", "--demo", "all", "--no-report", "--json") == 1
    document = json.loads(capsys.readouterr().out)
    assert document["ok"] is False
    assert [one["name"] for one in document["demos"] if not one["ok"]] == ["fork"]


def test_a_demonstration_as_json(demo: dict[str, Demo], capsys: pytest.CaptureFixture[str]):
    assert call("ball", "--demo", "fork", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["name"] == "fork"
    assert document["numbers"]["large_first"] == 0.0009760856628
    assert document["data"] == {"history": [1.0, None]}
    assert document["report"] == "runs/demo-fork-1/report.html"
    assert call("ball", "--demo", "all", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in document["demos"]] == list(demos.NAMES)
    assert document["report"] == "runs/demo-all-1/report.html"


def test_a_real_run_and_its_report(tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(tmp_path)
    code = call(
        "ball", "ball/batch-on-the-boundary", "--set", "variants={}",
        "--set", 'gradient.methods=["unrolled"]', "--against", "precision.reduction=exact",
        "-o", "here", "--json",
    )  # fmt: skip
    assert code == 1, "decisions within rounding are a finding"
    document = json.loads(capsys.readouterr().out)
    assert document == {"folder": "here", **json.loads(Path("here/summary.json").read_text())}
    assert document["iterations_total"] == 1
    # the sum sits on its tolerance; that the balls then lie at 0 exactly is no matter of rounding
    assert (document["ambiguous_stops"], document["ambiguous_contacts"]) == (1, 0)
    assert document["gradient"][0]["gradient"]["k"] == pytest.approx(-8.198e-8, rel=1e-3)
    (variant,) = document["variants"]
    assert variant["fork"] is None
    assert "<html" in Path("here/report.html").read_text(encoding="utf-8")
    Path("here/report.html").unlink()
    assert call("report", "here", "--json") == 0
    assert json.loads(capsys.readouterr().out)["report"] == "here/report.html"
    assert "<html" in Path("here/report.html").read_text(encoding="utf-8")
    assert call("run", "--resume", "here") == 2
    assert "nothing to resume" in capsys.readouterr().err
