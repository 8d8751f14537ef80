"""The command line parses, calls and prints: exit codes, one JSON document, one line an error."""

from __future__ import annotations

import inspect
import io
import json
import re
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from command_line import Recorder, call, printed

import mdnum
from mdnum import bounce, conform, fork_map, verbs
from mdnum.cli import main, output
from mdnum.cli.commands import app
from mdnum.errors import InputError, NumericalError
from mdnum.plain import beside, plain
from mdnum.report.finding import Finding
from mdnum.store import RunFolder
from mdnum.store.files import default_folder
from mdnum.verbs import VERBS, declared
from mdnum.verbs.fork_pair import PairQuestion
from mdnum.verbs.frame import Keep, layout
from mdnum.verbs.progress import ProgressBar, describe

SUMMARY: dict[str, Any] = {
    "flips_entered": 1_234, "steps_per_second": np.float64(512.0), "findings": [], "status": "complete",
    "ase": {"energy_rel": 1e-16, "force_max": float("nan"), "stress_max": None, "ok": True},
}  # fmt: skip


@pytest.fixture
def rollout(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Recorder:
    """`mdnum run` in an empty folder with the rollout replaced by a recorder."""
    recorder = Recorder(dict(SUMMARY))
    monkeypatch.setattr("mdnum.verbs.run.run", recorder)
    monkeypatch.chdir(tmp_path)
    return recorder


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line on stderr about a mistake, which is one JSON document where one was asked for."""
    assert call(*arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("mdnum: ") and err.count("\n") == 1
    assert call(*arguments, "--json") == 2
    assert json.loads(capsys.readouterr().out)["error"]["exit_code"] == 2
    return err


def test_run_passes_on_what_was_asked(rollout: Recorder):
    code = call(
        "run", "argon/crystal-108", "-o", "here", "--steps", "200", "--save-every", "5",
        "--set", "cutoff.kind=switched", "--set", "dynamics.seed = 3", "--no-check", "--no-report",
    )  # fmt: skip
    ((system, options),) = rollout.calls
    assert code == 0 and system == "argon/crystal-108" and isinstance(options.pop("progress"), ProgressBar)
    assert options == {
        "out": Path("here"), "steps": 200, "save_every": 5, "check": False, "report": False,
        "overrides": {"cutoff.kind": "switched", "dynamics.seed": "3"},
    }  # fmt: skip


def test_run_prints_what_a_person_wants_to_know(rollout: Recorder, capsys: pytest.CaptureFixture[str]):
    assert call("run", "argon/crystal-108") == 0
    lines = printed(capsys)
    assert lines[:3] == ["2,464 flips, none ambiguous.", "108 atoms", "Flips 2,464 1,234 entered, 1,230 left"]
    assert lines[3:7] == ["Lists", "Sound.", "name pairs", "a 0"]
    # a table is cut, what stands on the page alone is left out
    assert "and 18 more" in lines[-2] and not any("Details" in line for line in lines)
    assert lines[-1] == "wrote runs/argon-crystal-108-1"
    # as JSON it is one document
    assert call("run", "argon/crystal-108", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["flips_entered"], document["steps_per_second"]) == (1_234, 512.0)
    assert document["ase"]["force_max"] is None, "JSON has no NaN"
    assert document["folder"] == "runs/argon-crystal-108-1"


@pytest.mark.parametrize(("severity", "expected"), [("info", 0), ("warning", 1), ("error", 1)])
def test_findings_decide_the_exit_code(rollout: Recorder, capsys, severity: str, expected: int):
    finding = {"code": "x", "severity": severity, "title": "A title", "text": "Seen.", "remedy": "Do this."}
    rollout.summary = {**SUMMARY, "findings": [finding]}
    assert call("run", "argon/crystal-108") == expected
    lines = printed(capsys)
    assert f"{severity}: A title [x]" in lines and "Do this." in lines
    # a run that did not end is one, too
    rollout.summary = {**SUMMARY, "status": "stopped"}
    assert call("run", "argon/crystal-108") == 1


@pytest.mark.parametrize(
    ("status", "severity", "expected"),
    [
        ("partial", "info", 0), ("undecided", "info", 3),
        # what was found before the time was up is found
        ("partial", "warning", 1), ("undecided", "error", 1),
    ],
)  # fmt: skip
def test_time_that_is_up_before_a_verdict_is_neither_fine_nor_a_finding(
    rollout: Recorder, capsys, status: str, severity: str, expected: int
):
    finding = {"code": "x", "severity": severity, "title": "A title", "text": "Seen."}
    rollout.summary = {**SUMMARY, "findings": [finding], "status": status}
    assert call("run", "argon/crystal-108") == expected
    assert call("run", "argon/crystal-108", "--json") == expected
    # somebody who pressed control-C knows that it was not finished
    rollout.summary = {**SUMMARY, "status": status, "interrupted": True}
    assert call("run", "argon/crystal-108") == 130
    assert call("--help") == 0 and "--time" in capsys.readouterr().out


def test_resume_needs_only_the_folder(rollout: Recorder):
    assert call("run", "--resume", "runs/x-1") == 0
    ((system, options),) = rollout.calls
    options.pop("progress")
    # nothing is passed on that was not given
    assert system is None and options == {"resume": Path("runs/x-1")}


@pytest.mark.parametrize(
    "words",
    [
        "run", "run x --set no-equals-sign", "run x --set a=1 --set a=2", "run x --steps 0",
        "run x --steps many", "run x --no-such-option", "run --resume a -o b", "run --resume a --set a=1",
        "no-such-verb", "check energy", "report", "report nowhere",
    ],
)  # fmt: skip
def test_mistakes_are_one_line_and_exit_2(rollout: Recorder, capsys, words: str):
    refused(capsys, *words.split())
    assert not rollout.calls


def interrupted_as_it_returns() -> SystemError:
    """What control-C becomes where it meets a compiled function as that returns."""
    error = SystemError("returned a result with an exception set")
    error.__cause__ = KeyboardInterrupt()
    return error


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (InputError("r_cut + skin is 9.5 Å", remedy="Shrink it", where="a.toml"), 2),
        (NumericalError("potential energy is NaN", where="step 12"), 2),
        (OSError(28, "No space left on device", "runs/x-1/series.parquet"), 2),
        (KeyboardInterrupt(), 130),
        (interrupted_as_it_returns(), 130),
    ],
)
def test_errors_of_a_run_are_one_line(rollout: Recorder, capsys, error: BaseException, expected: int):
    rollout.error = error
    assert call("run", "x", "--json") == expected
    out, err = capsys.readouterr()
    assert err.startswith("mdnum: ") and err.count("\n") == 1
    document = json.loads(out)["error"]
    if isinstance(error, InputError):
        assert document == {
            "type": "InputError", "message": "r_cut + skin is 9.5 Å", "where": "a.toml",
            "remedy": "Shrink it", "exit_code": 2,
        }  # fmt: skip
    if isinstance(error, OSError):
        assert "No space left" in err and "series.parquet" in err


def test_a_bug_keeps_its_traceback(rollout: Recorder):
    for kind in (RuntimeError, SystemError):
        rollout.error = kind("a defect of mdnum")
        with pytest.raises(kind, match="a defect"):
            main(["run", "x"])


def test_a_run_that_is_stopped_names_the_folder_that_it_chose(tmp_path: Path, monkeypatch, capsys):
    def stopped(system: str, **options: Any) -> None:
        folder = RunFolder.create(default_folder(system), layout("md"))
        folder.checkpoint({}, force=True)
        options["progress"](3, 10, {"phase": "run", "folder": folder.path})
        options["progress"](0, 0, {"phase": "report"})
        folder.close()
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mdnum.verbs.run.run", stopped)
    assert call("run", "argon/crystal-108") == 130
    assert "Continue it with `mdnum run --resume runs/argon-crystal-108-1`" in capsys.readouterr().err


def test_default_folders_count_up(tmp_path: Path):
    assert default_folder("argon/liquid-864", tmp_path).name == "argon-liquid-864-1"
    for name in ("argon-liquid-864-9", "argon-liquid-864-x", "argon-liquid-8"):
        (tmp_path / name).mkdir()
    assert default_folder("argon/liquid-864", tmp_path).name == "argon-liquid-864-10"
    assert default_folder("some where/my liquid.toml", tmp_path).name == "my-liquid-1"


def test_version_and_help(capsys: pytest.CaptureFixture[str]):
    assert call("--version") == 0
    assert capsys.readouterr().out.startswith("mdnum 0.")
    assert call("--help") == 0
    out = capsys.readouterr().out
    assert all(verb in out for verb in ("run", "systems", "check", "report", "doctor"))
    assert call() == 2
    assert "Usage: mdnum" in capsys.readouterr().out


def test_help_lists_every_verb_below_a_question(capsys: pytest.CaptureFixture[str]):
    expected: dict[str, list[str]] = {}
    for name in (name for name in VERBS if " " not in name):
        text = declared(name)
        expected.setdefault(text.get("command", text.get("group"))["heading"], []).append(name)
    assert 4 <= len(expected) <= 7 and sum(map(len, expected.values())) == 12
    call("--help")
    listed: dict[str, list[str]] = {}
    for block in capsys.readouterr().out.split("\n\n"):
        heading, *rows = block.splitlines()
        if heading in expected:
            listed[heading] = [row.split()[0] for row in rows if row[2:3] != " "]
    assert listed == expected


@pytest.mark.parametrize(
    ("words", "offered", "others"),
    [
        ("", {"run", "fork", "doctor"}, {"vary"}),
        ("fork ", {"vary", "compare", "argon/crystal-108"}, {"--vary"}),
        ("fork --v", {"--vary"}, set()),
        ("fork argon/crystal-108 --v", {"--vary"}, set()),
        ("fork a b ", set(), {"vary"}),
        ("ball ball/d", {"ball/drop"}, {"ball/zeno"}),
        ("systems copy pair/", {"pair/at-cutoff", "pair/leaving-well"}, {"ball/drop"}),
    ],
)
def test_a_shell_completes(words: str, offered: set[str], others: set[str], monkeypatch, capsys):
    monkeypatch.setenv("_MDNUM_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", f"mdnum {words}")
    monkeypatch.setenv("COMP_CWORD", str(words.count(" ") + 1))
    assert call() == 0
    out, err = capsys.readouterr()
    completed = set(out.split())
    assert err == "" and offered <= completed and not others & completed


@pytest.mark.parametrize(("no_color", "expected"), [("", True), ("1", False)])
def test_no_color_is_respected(
    no_color: str, expected: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """In tables and findings, and in what typer prints by itself; bold and dim are no colors."""
    settings = {"NO_COLOR": no_color, "FORCE_COLOR": "1", "TERM": "xterm-256color", "HOME": str(tmp_path)}
    # by which typer's own tests name a shell
    for name, value in {**settings, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}.items():
        monkeypatch.setenv(name, value)
    printed_by: list[Callable[[], Any]] = [
        lambda: output.print_findings([Finding("X", "warning", "title", "text")]),
        lambda: output.print_table("", ("status",), [["ok"], ["unsafe"]]),
        lambda: call("--install-completion", "bash"),
    ]
    for prints in printed_by:
        monkeypatch.setattr(sys, "stdout", terminal := _Terminal())
        prints()
        colored = re.search(r"\x1b\[(\d+;)*(3[0-8]|4[0-8]|9[0-7])[;m]", terminal.getvalue())
        assert terminal.getvalue() and bool(colored) == expected


def commands(group: Any) -> Iterator[Any]:
    """The commands below a group of the command line."""
    for name in group.list_commands(None):
        found = group.get_command(None, name)
        yield from commands(found) if hasattr(found, "list_commands") else [found]


def test_every_option_says_what_it_is():
    found = list(commands(typer.main.get_command(app)))
    assert len(found) > 20
    for one in found:
        assert one.help and all(parameter.help for parameter in one.params), one.name


def test_every_option_is_a_parameter_of_what_is_called():
    """A name that is misspelled in a text file would be an option that no function takes."""
    passed_on = {*Keep.__annotations__, *PairQuestion.__annotations__}
    examined = 0
    for entry in VERBS:
        text = declared(entry)
        shared = beside(verbs.__file__)["shared"] | declared(entry.split()[0]).get("shared", {})
        for said in [*text.get("commands", {}).values(), *filter(None, [text.get("command")])]:
            parts = [said, *(shared[one] for one in said.get("shares", ()))]
            options = {name.removeprefix("no_") for part in parts for name in part.get("options", ())}
            called = inspect.unwrap(getattr(VERBS[entry], said["calls"]))
            if getattr(called, "__name__", "") == "command":
                # which passes on what it does not need
                options -= {*inspect.signature(called).parameters, "demo"}
                called = inspect.unwrap({
                    "ball": bounce, "conform": conform, "flips": mdnum.flips, "fork map": fork_map,
                    "sweep": mdnum.sweep,
                }[entry])  # fmt: skip
            parameters = inspect.signature(called).parameters
            more = passed_on if any(one.kind is one.VAR_KEYWORD for one in parameters.values()) else set()
            assert options - {"settings", "potential"} <= {*parameters, *more}, (entry, said["help"])
            examined += len(options)
    assert examined > 100


@pytest.mark.usefixtures("strangers_folder")
def test_python_m_mdnum_is_mdnum_and_runs_no_file_of_the_current_folder():
    done = subprocess.run([sys.executable, "-m", "mdnum", "run"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("mdnum: no system was")


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


INFO = {"phase": "run", "steps_per_second": 10.0, "flips": 1_500, "rebuilds": 2}


def test_progress_appears_at_a_terminal_after_a_while_and_not_of_a_short_run():
    before = threading.active_count()
    for delay, shown in ((0.2, True), (60.0, False)):
        stream = _Terminal()
        with ProgressBar(stream, delay=delay) as progress:
            progress(100, 1_000, INFO)
            assert stream.getvalue() == ""
            until = time.monotonic() + 20
            while shown and "100 of 1,000 steps" not in stream.getvalue() and time.monotonic() < until:
                time.sleep(0.01)
        assert ("100 of 1,000 steps" in stream.getvalue()) == shown
        assert threading.active_count() == before


def test_progress_is_a_line_now_and_then_where_it_is_piped():
    pipe, short = io.StringIO(), io.StringIO()
    with ProgressBar(pipe, pause=0.2) as progress, ProgressBar(short, pause=60.0) as other:
        progress(100, 1_000, INFO)
        other(100, 1_000, INFO)
        until = time.monotonic() + 20
        while pipe.getvalue().count("\n") < 2 and time.monotonic() < until:
            time.sleep(0.01)
    lines = pipe.getvalue().splitlines()
    assert len(lines) >= 2 and all("100 of 1,000 steps" in line for line in lines)
    assert short.getvalue() == ""
    line = describe(100, 1_000, INFO)
    assert line == "100 of 1,000 steps  10 steps/s  1,500 flips  2 rebuilds  ETA 00:01:30"


def test_plain_makes_json_of_what_a_run_holds():
    document = {
        "a": np.float64("inf"), "b": np.arange(3), "c": Path("x"), "d": (True, None), "e": np.bool_(True)
    }  # fmt: skip
    assert plain(document) == {"a": None, "b": [0, 1, 2], "c": "x", "d": [True, None], "e": True}
    with pytest.raises(TypeError, match=r"object .*plain data"):
        plain(object())


@pytest.fixture
def crystal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A system file of one's own."""
    monkeypatch.chdir(tmp_path)
    assert call("systems", "copy", "argon/crystal-108", "mine") == 0
    return "mine/crystal-108.toml"


def test_help_says_when_a_check_exits_with_1(capsys: pytest.CaptureFixture[str]):
    assert call("systems", "check", "--help") == 0
    assert "exit code is 1" in " ".join(capsys.readouterr().out.split())
    assert call("flips", "--help") == 0
    text = declared("flips")["command"]["options"]["drop_repeats"]["help"]
    assert f"--drop-repeats {text}" in " ".join(capsys.readouterr().out.split())


def test_systems_are_shown_checked_and_copied(crystal: str, capsys: pytest.CaptureFixture[str]):
    capsys.readouterr()
    assert call("systems", "show", crystal, "--set", "cutoff.kind=shifted") == 0
    shown = tomllib.loads(capsys.readouterr().out)
    assert shown["cutoff"]["kind"] == "shifted"
    assert shown["precision"]["decision"] == "float64", "defaults are filled in"
    assert call("systems", "show", crystal, "--set", "cutoff.kind=shifted", "--json") == 0
    head = {"schema": "mdnum/systems-show/1", "kind": "systems-show"}
    assert json.loads(capsys.readouterr().out) == head | shown
    refused(capsys, "systems", "check", crystal, "--set", "cutoff.radius=12")
    assert "radius" in refused(capsys, "systems", "check", crystal, "--set", "cutoff.radus=8")
    refused(capsys, "systems", "check", "nowhere.toml")
    refused(capsys, "run", "--resume", "nowhere")
    refused(capsys, "systems", "copy", "argon/crystal-108", "mine")  # nothing is overwritten


def test_check_prints_every_record_and_exits_by_agreement(
    crystal: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    import mdnum.references.energy_check as checks

    @dataclass
    class Report:
        ok: bool
        frames: tuple[()] = ()
        is_ase: bool = True
        precision: str = "float64"

        def rows(self) -> list[dict[str, Any]]:
            return [{"frame": "first", "energy": 1.25}, {"frame": "last", "energy": 2.5, "note": None}]

    asked = []
    for ok in (True, False):
        monkeypatch.setattr(
            checks, "check_energy", lambda system, ok=ok, **how: asked.append(system) or Report(ok)
        )
        expected = 0 if ok else 1
        assert call("check", "energy", crystal, "--set", "cutoff.kind=shifted") == expected
        out = capsys.readouterr().out
        assert all(word in out for word in ("first", "last", "1.25", "2.5", "ε/σ"))
        assert call("check", "energy", crystal, "--json") == expected
        assert json.loads(capsys.readouterr().out)["ok"] is ok
    assert asked[0].cutoff.name == "shifted"


def test_few_records_with_many_parts_stand_side_by_side(capsys: pytest.CaptureFixture[str]):
    output.print_records("t", [{f"part {n}": n for n in range(9)}])
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["part", "8", "8"] in lines


def test_doctor_exits_by_its_verdict(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    import mdnum.doctor

    for status, expected in (("ok", 0), ("info", 0), ("unsafe", 1)):
        row = mdnum.doctor.DoctorRow("jax version", status, "seen", None if status == "ok" else "do this")
        monkeypatch.setattr(mdnum.doctor, "diagnose", lambda row=row: mdnum.doctor.Diagnosis((row,), 0.5))
        assert call("doctor") == expected
        out = capsys.readouterr().out
        assert ("UNSAFE" in out) is (expected == 1)
        assert call("doctor", "--json") == expected
        assert json.loads(capsys.readouterr().out)["rows"][0]["status"] == status


def test_a_number_that_is_none_is_named_in_plain_words(capsys: pytest.CaptureFixture[str]):
    for words, said in (
        (("run", "argon/crystal-108", "--steps", "ten"), "--steps ten: expected a whole number"),
        (("flips", "x.xyz", "--cutoff", "far"), "--cutoff far: expected a number"),
    ):
        line = refused(capsys, *words)
        assert said in line and "Input should" not in line


def test_prose_is_as_wide_as_people_read_where_it_is_piped(rollout: Recorder, capsys):
    rollout.summary = {"findings": [
        {"code": "LONG", "severity": "info", "title": "x", "text": "word " * 80, "remedy": "act " * 80}
    ]}  # fmt: skip
    call("run", "argon/crystal-108")
    lines = capsys.readouterr().out.splitlines()
    wrapped = [line for line in lines if line.startswith(("  word", "  act"))]
    assert (
        len(wrapped) > 8 and max(map(len, lines)) <= 100 and not any(line.endswith(" ") for line in wrapped)
    )
