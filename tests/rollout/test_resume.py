"""A run that was stopped goes on as if nothing had happened, bit for bit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rollout.harness import frames_of, go, liquid, tables_equal, write_system

from mdnum.errors import FolderError, InputError
from mdnum.rollout.run import run
from mdnum.store import RunFolder
from mdnum.systems import load

# as many rows of a record as in test_ledger: the same program
STEPS = 120

CHILD = """
import os, signal, sys
from mdnum.store import RunFolder
from mdnum.rollout.run import run
from mdnum.systems import load
RunFolder.checkpoint_due = lambda self: True
def progress(step, steps, info):
    if step >= {stop}:
        os.kill(os.getpid(), signal.SIGKILL)
run(load({path!r}), out={out!r}, steps={steps}, save_every=10, progress=progress)
"""


class Stop(Exception):
    pass


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_system(tmp_path_factory.mktemp("fluid"), liquid())


@pytest.fixture(scope="module")
def whole(path, tmp_path_factory):
    return go(tmp_path_factory.mktemp("whole"), path, STEPS, save_every=10)


def assert_same(whole, other):
    """Everything that a run leaves, but for clocks."""
    for name, but in (("series", ()), ("flips", ()), ("epochs", ("build_ms",))):
        tables_equal(whole[1], other[1], name, but=but)
    a, b = whole[1].load_checkpoint(), other[1].load_checkpoint()
    for name in a:
        if isinstance(a[name], np.ndarray):
            assert a[name].tobytes() == b[name].tobytes(), name
    assert [x.tobytes() for x in frames_of(whole[1])] == [x.tobytes() for x in frames_of(other[1])]
    clocks = {"steps_per_second", "start_up_seconds", "wall_seconds"}
    left, right = (
        {k: v for k, v in result.summary.items() if k not in clocks} for result in (whole[0], other[0])
    )
    assert left == right
    log, again = ((folder.path / "log.txt").read_text() for folder in (whole[1], other[1]))
    assert log == again


def stopped_at(system, out, stop, monkeypatch, **options):
    """A run that ends with an exception at the first report from step stop on."""
    monkeypatch.setattr(RunFolder, "checkpoint_due", lambda self: True)

    def progress(step, steps, info):
        if step >= stop:
            raise Stop

    options = options or {"out": out, "steps": STEPS, "save_every": 10}
    with pytest.raises(Stop):
        run(system, progress=progress, **options)


@pytest.mark.slow
def test_a_killed_run_resumes(path, whole, tmp_path):
    out = tmp_path / "run"
    code = CHILD.format(stop=60, path=str(path), out=str(out), steps=STEPS)
    here = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    killed = subprocess.run([sys.executable, "-c", code], env=here, capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    there = RunFolder.open(out)
    assert not there.summary and 0 < there.rows("series") < STEPS
    result = run(None, resume=out)
    assert result.summary["status"] == "complete"
    assert_same(whole, (result, RunFolder.open(out)))


def test_a_run_may_be_stopped_again_and_again(path, whole, tmp_path, monkeypatch):
    """Before its first step, at a checkpoint, between two, and at once after it was resumed."""
    out = tmp_path / "run"
    stopped_at(load(path), out, 0, monkeypatch)
    for stop in (10, 35, 70, 71, 110):
        stopped_at(None, None, stop, monkeypatch, resume=out)
    result = run(None, resume=out)
    assert_same(whole, (result, RunFolder.open(out)))


LANGEVIN = {"dynamics.kind": "langevin", "dynamics.friction": 1.0}
BLIND = {"neighbors.skin": 0.05, "neighbors.rebuild.every": 20, "neighbors.rebuild.check": False}


@pytest.mark.slow
@pytest.mark.parametrize("overrides", [LANGEVIN, BLIND])
def test_the_noise_of_a_thermostat_and_the_count_of_lost_pairs_go_on(path, tmp_path, monkeypatch, overrides):
    system = load(path, overrides)
    whole = go(tmp_path / "whole", system, STEPS, save_every=10)
    assert (whole[0].summary["lost_pairs"] > 0) == (overrides is BLIND)
    stopped_at(system, tmp_path / "run", 70, monkeypatch)
    result = run(None, resume=tmp_path / "run")
    assert_same(whole, (result, RunFolder.open(tmp_path / "run")))


@pytest.mark.parametrize("where", ["used up", "in use"])
def test_a_finished_run_may_be_continued(path, whole, tmp_path, where):
    start = next(start for start in whole[1].read("epochs")["start"].tolist() if start > 64)
    last = start - 1 if where == "used up" else start + 2
    go(tmp_path, path, last, save_every=10)
    result = run(None, resume=tmp_path / "run", steps=STEPS)
    folder = RunFolder.open(tmp_path / "run")
    tables_equal(whole[1], folder, "series")
    tables_equal(whole[1], folder, "flips")
    tables_equal(whole[1], folder, "epochs", but=("build_ms",))
    assert result.summary["rebuilds"] == whole[0].summary["rebuilds"]


def test_what_cannot_be_continued_is_refused(path, whole, tmp_path):
    with pytest.raises(FolderError, match="past step 20"):
        run(None, resume=whole[1].path, steps=20)
    with pytest.raises(FolderError, match="already holds a run"):
        run(load(path), out=whole[1].path, steps=5)
    with pytest.raises(FolderError, match="no such folder"):
        run(None, resume=tmp_path / "nothing")
    for more in ({"save_every": 3}, {"overrides": {"neighbors.skin": 0.3}}):
        with pytest.raises(InputError, match="keeps its own"):
            run(None, resume=whole[1].path, **more)
    with pytest.raises(InputError, match="keeps its own"):
        run("argon/crystal-108", resume=whole[1].path)
    # and nothing of the first one was touched
    assert RunFolder.open(whole[1].path).rows("series") == STEPS + 1


def test_resuming_a_finished_run_leaves_it_as_it_is(path, tmp_path):
    go(tmp_path, path, 70)
    folder = tmp_path / "run"
    before = {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}
    again = run(None, resume=folder)
    assert again.summary["steps"] == 70
    assert {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()} == before
