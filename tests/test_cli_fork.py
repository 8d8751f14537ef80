"""`mdnum fork`: what it passes on, prints and exits with."""

from __future__ import annotations

import json
import types
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from command_line import call, printed

import mdnum.workflow
from mdnum.cli.progress import ProgressBar
from mdnum.errors import InputError
from mdnum.forks import choices

SUMMARY: dict[str, Any] = {
    "world": "fork", "system": "argon/crystal-108", "choice": "precision",
    "difference": "float32, not float64",
    "atoms": 108, "steps": 3839, "seed": 1, "seed_time": 0.004, "fork": 625, "fork_time": 2.5, "split": 1806,
    "split_time": 7.224, "tolerance": 0.0635, "verdict": "cause",
    "reasons": ["free, the runs split at step 1806", "and it does not grow"],
    "headline": "The flip at step 625 is the cause.",
    "decision": {
        "i": 3, "j": 75, "run": "A", "entered": False, "step": 625, "space": "r2", "margin": -5.3e-7,
        "bound": 2.1e-14, "ambiguous": False, "margins": {"A": -5.3e-7, "B": 2.4e-7},
        "bounds": {"A": 2.1e-14, "B": 1.1e-5}, "ambiguous_in": ["B"], "separation_before": 3.33e-7,
        "protected": 0.5, "also": 2,
    },
    "growth_rate": 0.0121, "growth_rate_time": 3.03, "r_squared": 0.673, "predicted_split": None,
    "splits": {"B": 1806, "B|A": None, "A|B": 2400}, "cross_flips": 16114,
    "repeated": [{"free": 1475, "handed": 1480}],
    "table": [
        {"arithmetic": x, "decisions": y, "from": z, "same": x == y == z, "split": split, "until": 3839}
        for x, y, z, split in (
            ("A", "A", "A", None), ("B", "B", "A", 1806), ("B", "A", "A", None), ("A", "B", "A", 1790),
            ("A", "A", "B", 1806), ("B", "B", "B", None), ("B", "A", "B", 1811), ("A", "B", "B", 2400),
        )
    ],
    "shares": [
        {"what": "decisions", "reference": "A", "steps": 2033, "at_least": True, "nats": 24.6},
        {"what": "decisions", "reference": "B", "steps": 594, "at_least": False, "nats": 7.19},
        {"what": "arithmetic", "reference": "A", "steps": -16, "at_least": False, "nats": None},
    ],
    "certified_horizon": {"A": 3839, "B": -1}, "ambiguous": {"A": 0, "B": 431},
    "ambiguous_steps": {"A": 0, "B": 390}, "lists_complete": {"A": True, "B": False},
    "protected_until": 302, "shadow": "A", "shadow_horizon": 624,
    "lyapunov": {
        "rate": 0.0119, "error": 0.0004, "rate_time": 2.98, "steps": 2000, "ratio": 1.02, "ulp": 8.9e-16,
        "ulp_split": 2700,
    },
    "lyapunov_reason": None,
    "minimal": {
        "pairs": [{"i": 3, "j": 75, "differs": [[625, 640], [700, None]]}], "proven": True,
        "fork_alone": True, "candidates": 4000, "tests": 1, "horizon": 2258, "reason": "it alone does it",
    },
    "pinned": {
        "pin": "fork", "pairs": [[3, 75]], "first": 625, "last": 639, "split": None, "free": 1806,
        "until": 3839, "largest": 2.3e-6, "reason": None,
    },
    "findings": [], "status": "complete",
}  # fmt: skip


@dataclass
class Recorder:
    summary: dict[str, Any] = field(default_factory=lambda: dict(SUMMARY))
    error: BaseException | None = None
    calls: list[tuple[Any, ...]] = field(default_factory=list)

    def __call__(self, system: Any, vary: str, **options: Any) -> Any:
        self.calls.append((system, vary, options))
        if self.error is not None:
            raise self.error
        options["progress"](1, 10, {"phase": "run", "separation": 1e-9})
        return types.SimpleNamespace(folder=options["out"] or Path("runs/x"), summary=self.summary)


@pytest.fixture
def compare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Recorder:
    """`mdnum fork` in an empty folder with the comparison replaced by a recorder."""
    recorder = Recorder()
    monkeypatch.setattr(mdnum.workflow, "fork", recorder)
    monkeypatch.chdir(tmp_path)
    return recorder


def test_fork_passes_on_what_was_asked(compare: Recorder):
    code = call(
        "fork", "argon/crystal-108", "--vary", "reduction=exact", "--steps", "20", "--split", "0.1",
        "--repeats", "4", "--set", "cutoff.kind=switched", "--no-counterfactual", "--no-back",
        "--no-lyapunov", "--minimal", "--pin", "3-75:600..700", "-o", "here", "--no-report",
    )  # fmt: skip
    assert code == 0
    ((system, vary, options),) = compare.calls
    assert (system, vary) == ("argon/crystal-108", "reduction=exact")
    assert isinstance(options.pop("progress"), ProgressBar)
    assert options == {
        "steps": 20, "split": 0.1, "repeats": 4, "counterfactual": False, "back": False, "lyapunov": False,
        "minimal": True, "pin": "3-75:600..700", "out": Path("here"),
        "overrides": {"cutoff.kind": "switched"}, "report": False,
    }  # fmt: skip


def test_the_verdict_comes_first_then_dates_and_decision(compare: Recorder, capsys):
    assert call("fork", "argon/crystal-108", "--vary", "precision") == 0
    lines = printed(capsys)
    assert lines[:3] == [
        "The flip at step 625 is the cause.", "free, the runs split at step 1806", "and it does not grow",
    ]  # fmt: skip
    for line in (
        "system argon/crystal-108, 108 atoms, 3,839 steps",
        "differs in float32, not float64",
        "seed step 1, time 0.004 (first bit differs)",
        "fork step 625, time 2.5 (first decision differs)",
        "split step 1,806, time 7.224 (further apart than 0.0635)",
        "deciding pair 3–75 left in A only, with 2 more at this step",
        "margin in A -5.3e-07 in r²; rounding bound 2.1e-14: not ambiguous",
        "margin in B 2.4e-07 in r²; rounding bound 1.1e-05: ambiguous",
        "apart the step before 3.33e-07; the margin is 0.5 of it",
        "growth 0.0121 a step, 3.03 a unit of time, r² 0.673",
        "flips in one run only 16,114",
        "A its own is A 1,806", "B its own 1,806 is B", "B A's > 3,839 1,811", "A B's 1,790 2,400",
        "B, start perturbed its own 1,475 to 1,475", "B, start perturbed A's 1,480 to 1,480",
        "decisions > 2,033 steps, > 24.6 e-foldings 594 steps, 7.19 e-foldings", "arithmetic -16 steps",
        "certified in A up to step 3,839: no decision is ambiguous",
        "certified in B not even at the start; 431 ambiguous decisions at 390 steps; "
        "of listed pairs only, a rule of rebuilds that is not safe may miss some",
        "protected up to step 302: every pair is further from its cutoff than twice the separation",
        "shadow horizon step 624: B decides as the wider program, A, up to there",
        "Lyapunov exponent 0.0119 ± 0.0004 a step, 2.98 a unit of time, from 2,000 steps of A; "
        "the runs part 1.02 times as fast",
        "an ulp of the start (8.9e-16) splits them about step 2,700",
        "taken back 3–75 as A decided it at steps 625 to 639: no split by step 3,839, 2.3e-06 apart at most "
        "(free: 1,806)",
        "minimal cause: it alone does it (1 run, 4,000 candidates)",
        "3–75 steps 625 to 639, and 1 time more",
    ):  # fmt: skip
        assert line in lines, line
    assert lines[-1] == "wrote runs/x"


def test_a_horizon_too_short_is_no_failure(compare: Recorder, capsys):
    compare.summary = SUMMARY | {
        "split": None, "split_time": None, "predicted_split": 5200, "verdict": "open", "repeated": [],
        "splits": {"B": None}, "table": SUMMARY["table"][:2], "shares": [],
        "lyapunov": None, "lyapunov_reason": "a many-body potential",
        "minimal": {"pairs": None, "tests": 0, "reason": "the runs did not split"},
        "findings": [{"code": "HORIZON_SHORT", "severity": "info", "title": "short", "text": "0.02 apart."}],
    }  # fmt: skip
    assert call("fork", "argon/crystal-108", "--vary", "precision") == 0
    lines = printed(capsys)
    assert "split none in 3,839 steps (further apart than 0.0635)" in lines
    assert "predicted split about step 5,200" in lines
    assert "info: short" in lines and "0.02 apart." in lines
    assert not any(line.startswith(("splits,", "without the difference")) for line in lines)
    assert "Lyapunov exponent none: a many-body potential" in lines
    assert "minimal cause: none; the runs did not split" in lines


def test_runs_that_do_not_fork_print_too(compare: Recorder, capsys):
    nothing = dict.fromkeys(("seed", "fork", "split", "decision", "growth_rate", "predicted_split"))
    compare.summary = SUMMARY | nothing | {"verdict": "same", "splits": {"B": None}, "repeated": []}
    assert call("fork", "argon/crystal-108", "--vary", "translate=lattice") == 0
    assert "seed none in 3,839 steps (first bit differs)" in printed(capsys)


@pytest.mark.parametrize(
    "changed",
    [
        {"findings": [{"code": "MUST_HOLD_FORKED", "severity": "error", "title": "it forked"}]},
        {"status": "failed"},
    ],
)
def test_a_broken_promise_or_a_failed_run_exits_1(compare: Recorder, changed):
    compare.summary = SUMMARY | changed
    assert call("fork", "argon/crystal-108", "--vary", "order@exact") == 1


def test_json_is_the_summary_with_its_folder(compare: Recorder, capsys):
    assert call("fork", "argon/crystal-108", "--vary", "precision", "-o", "here", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"folder": "here", **SUMMARY}


def test_a_ranking(compare: Recorder, capsys):
    one = {
        "choice": "precision",
        "difference": "float32",
        "seed": 1,
        "fork": 303,
        "split": None,
        "failed": "",
    }
    two = {"choice": "order@exact", "difference": "shuffled", "seed": None, "fork": None, "split": None}
    compare.summary = {
        "world": "fork", "headline": "1 of 2 choices fork.", "steps": 1000,
        "ranking": [one, two | {"must_hold": True}], "not_applicable": [{"choice": "noise", "why": "nve"}],
        "findings": [], "status": "complete",
    }  # fmt: skip
    assert call("fork", "argon/crystal-108", "--vary", "all") == 0
    lines = printed(capsys)
    assert "precision 1 303 none float32" in lines
    assert "order@exact none none none must hold shuffled" in lines
    assert "noise nve" in lines


def test_mistakes_exit_2(compare: Recorder, capsys):
    compare.error = InputError("no choice 'x'")
    assert call("fork", "argon/crystal-108", "--vary", "x", "--json") == 2
    assert json.loads(capsys.readouterr().out)["error"]["message"] == "no choice 'x'"
    assert call("fork", "argon/crystal-108", "--vary", "x", "--steps", "0") == 2
    assert call("fork", "argon/crystal-108", "--minimal", "--along", "cutoff.radius=1.4:1.5") == 2
    assert "--minimal is asked of two runs" in capsys.readouterr().err
    compare.error = KeyboardInterrupt()
    assert call("fork", "argon/crystal-108", "--vary", "precision") == 130


def test_without_a_choice_they_are_listed(compare: Recorder, capsys):
    assert call("fork") == 0
    lines = printed(capsys)
    assert any(line.startswith("precision ") for line in lines)
    assert any(line.startswith("translate=lattice must hold ") for line in lines)
    assert call("fork", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in document["choices"]] == choices.names()
    assert compare.calls == []
    # the system's own file may say what to vary
    assert call("fork", "argon/crystal-108") == 0
    ((system, vary, _),) = compare.calls
    assert (system, vary) == ("argon/crystal-108", None)


def test_a_real_comparison(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = call(
        "fork", "pair/at-cutoff", "--vary", "start", "--steps", "30", "--no-counterfactual", "--repeats", "0",
        "-o", "here", "--json",
    )  # fmt: skip
    assert code == 0
    document = json.loads(capsys.readouterr().out)
    assert document == {"folder": "here", **json.loads(Path("here/summary.json").read_text())}
    assert call("report", "here") == 0
    assert "wrote here/report.html" in capsys.readouterr().out
