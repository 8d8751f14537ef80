"""`mdnum fork` and its sub-commands: what they pass on, print and exit with."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command_line import call, printed

import mdnum
from mdnum.cli.output import ProgressBar
from mdnum.errors import InputError
from mdnum.forks.choices import shipped
from mdnum.forks.exact import program
from mdnum.report.finding import conclude
from mdnum.report.section import Key, Page, Section, Table
from mdnum.verbs.fork_map import interval


class Recorder:
    """In place of a verb: it records what it is asked, and answers."""

    def __init__(self):
        self.calls: list[tuple[Any, ...]] = []
        self.error: BaseException | None = None
        self.answer: dict[str, Any] = {"status": "complete"}

    def __call__(self, *asked: Any, **options: Any) -> Any:
        self.calls.append((*asked, options))
        if self.error is not None:
            raise self.error
        options["progress"](1, 10, {"phase": "run", "separation": 1e-9})
        page = Page(
            "x", "about it", [Key("Fork", "step 4")], [Section("S", [Table(("a",), [(1,)])], terminal=True)]
        )
        verdict = conclude([], headline="The answer.")
        seen = {"summary": self.answer, "verdict": verdict, "findings": verdict.findings, "page": page}
        return SimpleNamespace(folder=Path("runs/x"), reused=False, **seen)


@pytest.fixture
def verb(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Recorder:
    """The questions of `mdnum fork` in an empty folder, replaced by a recorder."""
    recorder = Recorder()
    for name in mdnum.__all__:
        if name.startswith("fork") and name != "forks":
            module = sys.modules[getattr(mdnum, name).__module__]
            monkeypatch.setattr(module, name, recorder)
    monkeypatch.chdir(tmp_path)
    return recorder


@pytest.mark.parametrize("words", [(), ("vary",)])
def test_a_system_is_varied(verb: Recorder, words):
    code = call(
        "fork", *words, "argon/crystal-108", "--vary", "reduction=exact", "--steps", "20", "--split", "0.1",
        "--repeats", "4", "--set", "cutoff.kind=switched", "--no-counterfactual", "--no-back",
        "--no-lyapunov", "--minimal", "--pin", "3-75:600..700", "-o", "here", "--no-report",
    )  # fmt: skip
    assert code == 0
    ((system, options),) = verb.calls
    assert (system, options.pop("vary")) == ("argon/crystal-108", "reduction=exact")
    assert isinstance(options.pop("progress"), ProgressBar)
    assert options == {
        "steps": 20, "split": 0.1, "repeats": 4, "counterfactual": False, "back": False, "lyapunov": False,
        "minimal": True, "pin": "3-75:600..700", "out": Path("here"),
        "overrides": {"cutoff.kind": "switched"}, "report": False,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("words", "asked", "further"),
    [
        (("ball/drop",), ("ball/drop",), {}),
        (("screen", "x", "--steps", "5"), ("x",), {"steps": 5}),
        (
            ("map", "x", "sigma=3.4:3.41", "--most", "3"),
            ("x", "sigma", 3.4, 3.41),
            {"most": 3},
        ),
        (("certify", "x", "--set", "a=1"), ("x",), {"overrides": {"a": "1"}}),
        (("forecast", "x", "1e-6"), ("x", 1e-6), {}),
        (("processes", "x", "--no-report"), ("x",), {"report": False}),
        (("benign", "x", "skin"), ("x", "skin"), {}),
        (("compare", "a", "b"), (Path("a"), Path("b")), {}),
    ],
)
def test_each_question_is_a_sub_command(verb: Recorder, capsys, words, asked, further):
    assert call("fork", *words) == 0
    ((*seen, options),) = verb.calls
    options.pop("progress")
    assert tuple(seen) == asked and options == further
    assert printed(capsys) == ["The answer.", "about it", "Fork step 4", "S", "a", "1", "wrote runs/x"]
    assert call("fork", *words, "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"folder": "runs/x", "status": "complete"}


def test_mistakes_exit_2(verb: Recorder, capsys):
    verb.error = InputError("no choice 'x'")
    assert call("fork", "argon/crystal-108", "--vary", "x", "--json") == 2
    assert json.loads(capsys.readouterr().out)["error"]["message"] == "no choice 'x'"
    for words in (("x", "--vary", "x", "--steps", "0"), ("certify",), ("screen", "x", "--split", "0.1"),
                  ("certify", "x", "--minimal"), ("a", "b"), ("map", "x"), ("x", "--most", "3")):  # fmt: skip
        assert call("fork", *words) == 2
        assert capsys.readouterr().err.count("\n") == 1
    verb.error = KeyboardInterrupt()
    assert call("fork", "argon/crystal-108") == 130
    verb.error, verb.answer = None, {"status": "failed"}
    assert call("fork", "argon/crystal-108") == 1


def test_without_a_system_the_choices_are_listed(verb: Recorder, capsys):
    assert call("fork") == 0
    lines = printed(capsys)
    assert any(line.startswith("precision ") for line in lines)
    assert any(line.startswith("translate=lattice must hold ") for line in lines)
    for words in ((), ("choices",)):
        assert call("fork", *words, "--json") == 0
        document = json.loads(capsys.readouterr().out)
        for key, world in (("choices", "md"), ("ball_choices", "ball")):
            assert [one["name"] for one in document[key]] == list(shipped(world))
        held = {one["name"] for one in document["ball_choices"] if one["must_hold"]}
        assert held == {"order@exact", "order@alone"}
    assert call("fork", "--help") == 0 and "certify" in capsys.readouterr().out
    assert verb.calls == []


def test_an_interval_is_a_key_and_two_numbers():
    assert interval("potential.sigma=3.40:3.41") == ("potential.sigma", 3.40, 3.41)
    assert interval(" r_cut = 1e0 : 2.5") == ("r_cut", 1.0, 2.5)
    for text in ("sigma", "sigma=3", "sigma=a:b", "=1:2", "sigma=1:2:3"):
        with pytest.raises(InputError, match="KEY=LOW:HIGH"):
            interval(text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("argon/crystal-108", "--vary", "vmap"), "mdnum fork processes"),
        (("argon/crystal-108", "--vary", "presicion"), "Did you mean precision"),
        (("argon/crystal-108", "--vary", "zzz"), "precision, reduction,"),
        (("ball/drop", "--vary", "zzz"), " reduction, order, stop, max_iter, contact,"),
        (("argon/crystal-108", "--along", "sigma=1:2"), "No such option: --along"),
        (("forecast", "argon/crystal-108", "0"), "expected a length above 0"),
        (("forecast", "ball/drop", "1e-6"), "mdnum ball records"),
        (("processes", "ball/drop"), "mdnum ball --demo determinism"),
        (("benign", "ball/drop", "start"), "Ensembles of runs"),
        (("map", "argon/crystal-108", "sigma"), "KEY=LOW:HIGH"),
        (("map", "argon/crystal-108", "sigma=2:1"), "interval 2.0:1.0"),
        (("map", "ball/drop", "k=2:1"), "interval 2.0:1.0"),
        (("processes", "silicon/tersoff-512"), "many-body"),
        (("certify", "silicon/tersoff-512", "--steps", "2"), "one pair potential"),
        (("certify", "ball/zeno"), "exact arithmetic"),
        (("ball/drop", "--vary", "start", "--minimal"), "contact=STEP:BALL"),
    ],
)
def test_what_cannot_be_asked_is_refused_in_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("fork", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    # and leaves no folder behind
    assert not list(tmp_path.iterdir())


def test_what_is_missing_is_named_with_its_extra(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(program, "installed", lambda: False)
    assert call("fork", "certify", "argon/crystal-108", "--steps", "2", "--set", "cutoff.radius=1.5") == 2
    assert "mdnum[exact]" in capsys.readouterr().err


def test_two_paths_are_sent_to_the_verb_that_compares_them(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    assert call("fork", "a.traj", "b.traj") == 2
    assert "mdnum flips a.traj b.traj" in capsys.readouterr().err
    folders = [str(tmp_path / name) for name in ("a", "b")]
    for one in folders:
        Path(one).mkdir()
    assert call("fork", *folders) == 2
    assert f"mdnum fork compare {folders[0]} {folders[1]}" in capsys.readouterr().err
