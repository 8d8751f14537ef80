"""Two finished runs followed again: the steps at which their tables differ, and what no table holds."""

from __future__ import annotations

import json

import pytest
from command_line import call, printed

import mdnum

NARROW = {f"precision.{role}": "float32" for role in ("force", "decision", "accumulate")}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    root = tmp_path_factory.mktemp("runs")
    for name, overrides in (("a", {}), ("b", NARROW)):
        mdnum.run(
            "argon/crystal-108", steps=900, out=root / name, overrides=overrides, check=False, report=False
        )
    return root


@pytest.mark.slow
def test_the_replay_parts_where_the_stored_runs_do_and_says_why(runs):
    made = mdnum.fork_folders(
        runs / "a", runs / "b", split=2e-3, repeats=0, back=False, lyapunov=False, out=runs / "fork"
    )
    summary = json.loads((runs / "fork" / "summary.json").read_text())
    assert summary["stored"]["fork"] == summary["fork"] == made.fork.dates.fork
    assert summary["replayed"] == "the decisions part where the stored ones do"
    # what the two folders cannot say
    assert summary["fork"] < summary["split"] <= summary["stored"]["steps"] == 900
    assert summary["verdict"] in ("cause", "open")
    assert {key for key, _, _ in summary["differences"]} >= set(NARROW)
    assert (runs / "fork" / "report.html").stat().st_size > 10_000


@pytest.mark.slow
def test_on_the_command_line(runs, capsys):
    words = ("--replay", "--steps", "60", "--repeats", "0", "--no-back", "--no-lyapunov", "--no-report")
    assert call("fork", str(runs / "a"), str(runs / "b"), *words, "-o", str(runs / "short")) == 0
    lines = printed(capsys)
    assert lines[0] == "differences" and "replay: the decisions part where the stored ones do" in lines
    assert not (runs / "short" / "report.html").exists()
