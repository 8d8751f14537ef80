"""Each study runs from its command line with small settings and leaves its table."""

from __future__ import annotations

import importlib
import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
WHERE = {path.stem: path for path in SCRIPTS.glob("*/[a-z]*.py")}
STUDIES = sorted(
    name for name, path in WHERE.items() if "\nHow to read it." in path.read_text(encoding="utf-8")
)

# every one compiles; and dtypes are not strict, as a user calls it
pytestmark = [pytest.mark.slow, pytest.mark.jax_md]


def study(name: str, *words: str, cwd: Path, code: int = 0) -> str:
    """What a script prints to stdout; it is run elsewhere, as a user would."""
    done = subprocess.run(
        [sys.executable, str(WHERE[name]), *words],
        cwd=cwd,
        # a worker of the tests has a terminal 80 columns wide; a table in a file has not
        env={name: value for name, value in os.environ.items() if name != "COLUMNS"} | {"MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == code, done.stderr
    return done.stdout if code == 0 else done.stderr


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """What a script prints, run in this process: jax and mdnum are not imported again for it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COLUMNS", raising=False)

    def run(name: str, *words: str, code: int = 0) -> str:
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *words])
        # as Python does for a script; a module beside a script of another folder may have the same name
        monkeypatch.syspath_prepend(str(WHERE[name].parent))
        for other in {path.stem for path in SCRIPTS.glob("*/_*.py")} & sys.modules.keys():
            monkeypatch.delitem(sys.modules, other)
        ended: object = 0
        try:
            runpy.run_path(str(WHERE[name]), run_name="__main__")
        except SystemExit as done:
            ended = done.code or 0
        out, err = capsys.readouterr()
        assert ended == code, err
        return err if code else out

    return run


def row(table: str, *first: str) -> list[str]:
    """The cells of the only line whose first cells are these."""
    lines = [re.split(r"\s{2,}", line.strip()) for line in table.splitlines()]
    (found,) = [cells for cells in lines if cells[: len(first)] == list(first)]
    return found


def rows(table: str, columns: str, *firsts: str | tuple[str, ...]) -> list[dict[str, str]]:
    """The lines that begin with these cells, by the names of their columns."""
    found = [row(table, *((first,) if isinstance(first, str) else first)) for first in firsts]
    return [dict(zip(columns.split(), cells, strict=False)) for cells in found]


@pytest.mark.parametrize("name", STUDIES)
def test_help_says_the_question_and_how_to_read_the_answer(name: str, here) -> None:
    text = here(name, "--help")
    assert "?" in text.split("\n\n")[1]
    assert "How to read it." in text


@pytest.mark.nightly
def test_trusted_gradients_of_a_listed_network_are_those_of_differences(tmp_path: Path) -> None:
    words = ["--only", "the same, listed", "--seeds", "2"]
    *_, last = study("learned_gradients", *words, "--store", "starts", cwd=tmp_path).strip().splitlines()
    starts, derivatives, without, trusted, false = (int(cell) for cell in last.split("|")[2:7])
    assert (starts, derivatives, without, false) == (2, 4, 0, 0) and trusted >= 3


@pytest.mark.nightly
def test_the_benchmark_measures_what_it_names(tmp_path: Path) -> None:
    made = json.loads(study("benchmark", "--quick", "--turns", "1", "--json", cwd=tmp_path))
    speeds = {one["code"]: one for one in made["speeds"]}
    assert {"mdnum, recorded", "mdnum, unrecorded", "jax-md loop"} <= set(speeds)
    assert all(one["steps_per_second"] > 0 and one["cpu_ms_per_step"] > 0 for one in speeds.values())
    assert {one["atoms"] for one in speeds.values()} == {500}
    steps = [one["step"] for one in made["memory"]]
    assert len(steps) == 4
    assert steps == sorted(set(steps))
    assert all(one["flips"] > 0 for one in made["memory"])
    assert set(made["list_builds_ms"]["500"]) == {"mdnum host", "vesin", "jax-md update"}
    assert made["start_up"]["cpu_seconds"] > 0


@pytest.mark.nightly
def test_no_table_and_no_row_of_positions_leaves_an_accelerator(tmp_path: Path) -> None:
    words = ["--sizes", "256", "500", "--steps", "60", "--json"]
    made = json.loads(study("accelerator", *words, cwd=tmp_path))["sizes"]
    for one in made:
        # the numbers of a stretch's steps come with it: seven of 128 steps, read once
        numbers = 9_000 * (one["stretches"] + 1)
        assert one["to_host"] <= 2 * 112 * one["flips"] + 8 * one["atoms"] * one["lists"] + numbers
        assert one["to_host"] >= 112 * one["flips"] and one["flips"] > one["steps"] > 50 and one["lists"] > 2
    # what goes there does not grow with the system
    assert all(one["to_device"] <= 500 * (one["lists"] + one["stretches"] + 1) for one in made)


@pytest.mark.nightly
def test_the_benchmark_of_flips_measures_what_it_names(tmp_path: Path) -> None:
    made = json.loads(study("flips_benchmark", "--quick", "--json", cwd=tmp_path))
    speeds = {(one["frames"], one["code"]): one for one in made["speeds"]}
    for frames in ("every step", "every 100th step"):
        ours, merged = (speeds[frames, code] for code in ("mdnum", "vesin, sorted merge"))
        # the same pairs, found by two searches that share nothing
        assert ours["flips"] == merged["flips"] > 0
        assert ours["cpu_ms"] > 0 and speeds[frames, "MDAnalysis, sets"]["count"] == 4
    taken = {(one["what"], one["frames"]): one["cpu_seconds"] for one in made["file"]}
    # a command begins with what reading alone does not need, whatever the machine is busy with
    assert all(taken["command", frames] > taken["reading", frames] > 0 for frames in (60, 240))
    assert len(made["memory"]) == 4
    assert {one["atoms"] for one in made["many"]} == {1000}


@pytest.mark.nightly
def test_balls_are_timed_against_their_own_recorded_run(tmp_path: Path) -> None:
    words = ["--balls", "50", "--steps", "40", "--turns", "1"]
    printed = study("ball_benchmark", *words, cwd=tmp_path)
    for world in ("spring", "located impacts", "projection"):
        assert float(row(printed, world)[4]) > 0


@pytest.mark.nightly
def test_the_cost_of_a_comparison_is_a_ratio(tmp_path: Path) -> None:
    words = ["--quick", "--no-answers", "--json"]
    made = json.loads(study("fork_benchmark", *words, cwd=tmp_path))
    (one,) = made["ratios"]
    assert one["system"] == "argon/crystal-108" and one["atoms"] == 108
    # three runs; on a busy machine a clock can say anything
    assert 1 < one["cpu_ratio"] < 30
    assert one["triple_compile"] > 0


@pytest.mark.nightly
def test_fewer_decimals_lose_flips(tmp_path: Path) -> None:
    table = study("flips_of_a_trajectory", "--steps", "200", "--decimals", "3", "2", cwd=tmp_path)
    (fine, fine_made_up), (coarse, coarse_made_up) = (
        [float(cell.rstrip("%")) for cell in row(table, decimals)[2:]] for decimals in ("3", "2")
    )
    assert 0 < fine < coarse and 0 < fine_made_up < coarse_made_up


@pytest.mark.nightly
def test_runs_that_locate_crossings_have_the_derivative_of_the_motion(monkeypatch) -> None:
    """A pair that leaves its well through a hard cutoff: its last speed follows from its energy."""
    monkeypatch.syspath_prepend(str(SCRIPTS / "campaigns"))
    located = importlib.import_module("_located")
    x = np.array([[5.0, 5, 5], [6.8, 5, 5]])
    v = np.array([[-0.5, 0, 0], [0.5, 0, 0]])

    def u(r: float) -> float:
        return 4 * (r**-12 - r**-6)

    def speed(radius: float) -> float:
        made = located.losses(
            x, v, np.full(2, 2.0), np.full(3, 20.0), 1.0, 1.0, radius, False, 0.002, 1000, 4
        )
        # the mean over the two atoms of v(0) · v(t), each half as fast as they part
        return 4 * made[located.LOSSES.index("vacf")]

    right = np.sqrt(1 + 2 * u(1.8) - 2 * u(2.5))
    assert speed(2.5) == pytest.approx(right, rel=1e-5)
    slope = (speed(2.5 + 1e-6) - speed(2.5 - 1e-6)) / 2e-6
    steep = 24 * (2.5**-7 - 2 * 2.5**-13)
    assert slope == pytest.approx(-steep / right, rel=1e-4)
