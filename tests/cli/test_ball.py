"""`mdnum ball`: what it passes on, prints and exits with; runs and demonstrations."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import Recorder, call, printed

from mdnum.cli.output import ProgressBar
from mdnum.errors import InputError
from mdnum.verbs import demos
from mdnum.verbs.demos import Claim, Demo, Plot, Region, Series, table


@pytest.fixture
def bounce(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Recorder:
    """`mdnum ball` in an empty folder with the run replaced by a recorder."""
    recorder = Recorder()
    monkeypatch.setattr("mdnum.verbs.ball.bounce", recorder)
    monkeypatch.chdir(tmp_path)
    return recorder


def test_ball_passes_on_what_was_asked(bounce: Recorder):
    call(
        "ball", "ball/drop", "-o", "here", "--steps", "20", "--set", "contact.k=2e4",
        "--against", "precision.state=float32", "--against", "contact.k=3e4", "--no-report",
    )  # fmt: skip
    ((system, options),) = bounce.calls
    assert system == "ball/drop" and isinstance(options.pop("progress"), ProgressBar)
    assert options == {
        "out": Path("here"), "steps": 20, "overrides": {"contact.k": "2e4"}, "report": False,
        "against": ["precision.state=float32", "contact.k=3e4"],
    }  # fmt: skip


@pytest.mark.parametrize(
    "words",
    [
        "x --set no-equals-sign", "x --steps 0", "--demo fork x", "--demo fork --set a=1",
        "--demo fork --against a=1", "--demo fork --steps 3", "--demo forc",
    ],
)  # fmt: skip
def test_mistakes_are_one_line_and_exit_2(bounce: Recorder, capsys, words: str):
    assert call("ball", *words.split()) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("mdnum: ") and err.count("\n") == 1 and bounce.calls == []
    if words.endswith("forc"):
        assert "Did you mean fork?" in err and all(name in err for name in demos.names())


def test_errors_of_a_run_are_one_line(bounce: Recorder, capsys: pytest.CaptureFixture[str]):
    bounce.error = InputError("alpha k = 2.5", remedy="Lower alpha")
    assert call("ball", "x") == 2
    assert capsys.readouterr().err == "mdnum: alpha k = 2.5. Lower alpha.\n"
    bounce.error = KeyboardInterrupt()
    assert call("ball", "x") == 130


def test_each_world_points_to_the_other(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("run", "ball/drop") == 2
    assert "Use `mdnum ball ball/drop`" in capsys.readouterr().err
    assert call("ball", "argon/crystal-108") == 2
    assert "Use `mdnum run argon/crystal-108`" in capsys.readouterr().err
    for check in ("energy", "pairs", "dynamics"):
        assert call("check", check, "ball/drop") == 2
        assert "is a ball" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_balls_and_demonstrations_are_listed_shown_and_checked(capsys: pytest.CaptureFixture[str]):
    assert call("ball") == 0
    out = capsys.readouterr().out
    assert "ball/zeno" in out and "argon" not in out and all(name in out for name in demos.names())
    assert call("ball", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in document["demos"]] == demos.names()
    assert {row["name"]: row["balls"] for row in document["systems"]}["ball/batch-on-the-boundary"] == 9
    assert call("systems", "show", "ball/drop", "--set", "contact.k=2e4", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["contact"]["k"], shown["precision"]["reduction"]) == (2e4, "sequential")
    assert call("systems", "check", "ball/batch-on-the-boundary") == 0
    assert capsys.readouterr().out == "ball/batch-on-the-boundary: fine, 9 balls\n"
    assert call("systems", "check", "ball/drop", "--set", "contact.kk=1") == 2


def make(ok: bool = True) -> Demo:
    """A demonstration of the smallest kind, with a number that needs its digits and a map."""
    cells = Region(np.array([1.0, 2.0]), np.array([1.0, 2.0]), np.array([[0, 1], [1, 1]]), ("calm", "wild"))
    line = Series("measured", np.arange(4.0), np.array([1.0, 2.0, np.nan, 4.0]), "points", "bad")
    return Demo(
        title="A title",
        question="Why?",
        result="It is -1.5 and no less.",
        answer="Because it is <b>bold</b>.",
        numbers={"large_first": 0.0009760856628, "runs": [1, 2]},
        checks=[Claim("it holds", 1.5, "1.5", ok)],
        tables=[table("rows", ("n", "x"), [(n, 1 + n * 1e-7) for n in range(30)])],
        plots=[Plot("line", "A line", "x", "y", (line,)), Plot("map", "A map", "x", "y", region=cells)],
        in_md="The same.",
        data={"history": np.array([1.0, np.nan])},
    )


@pytest.fixture
def demo(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Demo]:
    """Demonstrations that give what they are told to, in an empty folder."""
    given = {name: make() for name in demos.names()}
    monkeypatch.setattr(demos, "load", lambda name: SimpleNamespace(run=lambda: given[name]))
    monkeypatch.chdir(tmp_path)
    return given


def test_a_demonstration_for_people(demo: dict[str, Demo], capsys: pytest.CaptureFixture[str]):
    assert call("ball", "--demo", "fork", "-o", "page") == 0
    lines = printed(capsys)
    # the result comes first, and it is the headline
    assert lines[0] == demo["fork"].result.replace("-", "−")
    for line in ("Why?", "large first 0.0009760856628", "ok it holds 1.5 1.5", "1 1.0000001"):
        assert line in lines
    assert any("18 more" in line for line in lines)
    assert lines[-1] == "wrote page/report.html"
    page = Path("page/report.html").read_text(encoding="utf-8")
    first, rest = page.split('<figure id="figure-fork-line">')
    assert first.index('<p class="headline">It is −1.5') < first.index("passed") < first.index("Why?")
    assert "&lt;b&gt;" in rest and "large first" in rest and "<table" not in first
    assert "&lt;b&gt;" in page and f": {demo['fork'].in_md}" in page
    names = {path.name for path in Path("page").rglob("*")}
    assert {"fork-line.svg", "fork-map.svg", "curves.parquet", "summary.json"} <= names
    # the page is a function of the folder
    assert call("report", "page") == 0
    assert Path("page/report.html").read_text(encoding="utf-8") == page


def test_demonstrations_as_json_and_one_that_fails_its_check(
    demo: dict[str, Demo], capsys: pytest.CaptureFixture[str]
):
    assert call("ball", "--demo", "fork", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["name"], document["ok"], document["folder"]) == ("fork", True, "runs/demo-fork-1")
    assert document["numbers"]["large_first"] == 0.0009760856628
    assert document["data"] == {"history": [1.0, None]}
    assert document["tables"][0]["rows"][1] == [1, 1 + 1e-7]
    demo["fork"] = make(ok=False)
    assert call("ball", "--demo", "fork", "--no-report", "-o", "failed") == 1
    assert "failed it holds" in " ".join(capsys.readouterr().out.split())
    assert not list(Path("failed").rglob("report.html"))
    assert call("ball", "--demo", "all", "--no-report", "--json") == 1
    document = json.loads(capsys.readouterr().out)
    assert document["ok"] is False and [one["code"] for one in document["findings"]] == ["DEMO_FAILED"]
    assert [(one["name"], one["ok"]) for one in document["demos"]] == [
        (x, x != "fork") for x in demos.names()
    ]


def test_a_real_run_and_its_report(tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(tmp_path)
    code = call(
        "ball", "ball/batch-on-the-boundary", "--set", "variants={}",
        "--set", "gradient.of=[]", "--against", "precision.reduction=exact",
        "-o", "here", "--json",
    )  # fmt: skip
    assert code == 1, "decisions within rounding are a finding"
    document = json.loads(capsys.readouterr().out)
    assert document == {"folder": "here", **json.loads(Path("here/summary.json").read_text())}
    # the sum sits on its tolerance; that the balls then lie at 0 exactly is no matter of rounding
    assert (document["ambiguous_stops"], document["ambiguous_contacts"]) == (1, 0)
    assert [variant["fork"] for variant in document["variants"]] == [None]
    page = Path("here/report.html").read_text(encoding="utf-8")
    assert call("report", "here", "--json") == 0
    assert Path("here/report.html").read_text(encoding="utf-8") == page
    assert call("run", "--resume", "here") == 2
