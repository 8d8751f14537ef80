"""A run that was stopped goes on as if nothing had happened, bit for bit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ase import Atoms
from rollout.harness import (
    assert_ledger_is_complete,
    frames_of,
    go,
    liquid,
    run,
    tables_equal,
    write_system,
)

from mdnum.errors import FolderError, InputError, NumericalError
from mdnum.rollout.engine import Start, first_state
from mdnum.rollout.run import RunResult
from mdnum.store import RunFolder
from mdnum.systems import load
from mdnum.systems.build import build

# as many rows of a record as in test_ledger: the same program
STEPS = 120

CHILD = """
import os, signal, sys
from mdnum.store import RunFolder
from rollout.harness import run
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
    for name, but in (("series", ()), ("flips", ()), ("epochs", ("build_ms",)), ("ranges", ())):
        tables_equal(whole[1], other[1], name, but=but)
    a, b = whole[1].load_checkpoint(), other[1].load_checkpoint()
    for name in a:
        if isinstance(a[name], np.ndarray):
            assert a[name].tobytes() == b[name].tobytes(), name
    assert [x.tobytes() for x in frames_of(whole[1])] == [x.tobytes() for x in frames_of(other[1])]
    clocks = {"steps_per_second", "start_up_seconds", "wall_seconds", "seconds"}
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


def assert_goes_on(whole, subject, given, part, tmp_path, monkeypatch):
    """A run that was stopped goes on to the bit; with a part of its state as at the start it is another.

    Args:
        whole: what was never stopped, and its folder. given: the objects again, None for a file.
    """
    restore = Start.from_arrays

    def forgetful(arrays, simulation):
        start, first = restore(arrays, simulation), first_state(simulation).state
        return replace(start, state=start.state._replace(**{part: getattr(first, part)}))

    for folder, forget in (("run", False), ("other", True)):
        stopped_at(subject, tmp_path / folder, 60, monkeypatch)
        if forget:
            monkeypatch.setattr(Start, "from_arrays", forgetful)
        again = run(given, resume=tmp_path / folder), RunFolder.open(tmp_path / folder)
        if forget:
            with pytest.raises(AssertionError):
                assert_same(whole, again)
        else:
            assert_same(whole, again)


@pytest.mark.slow
def test_a_killed_run_resumes(path, whole, tmp_path):
    out = tmp_path / "run"
    code = CHILD.format(stop=60, path=str(path), out=str(out), steps=STEPS)
    here = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1] / "support")}
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
    with pytest.raises(FolderError, match="requested step 20"):
        run(None, resume=whole[1].path, steps=20)
    with pytest.raises(FolderError, match="already holds a run"):
        run(load(path), out=whole[1].path, steps=5)
    with pytest.raises(FolderError, match="does not exist"):
        run(None, resume=tmp_path / "nothing")
    for more in ({"save_every": 3}, {"overrides": {"neighbors.skin": 0.3}}):
        with pytest.raises(InputError, match="of its folder"):
            run(None, resume=whole[1].path, **more)
    with pytest.raises(InputError, match="of its folder"):
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


# --- a run that cannot go on says where and why, and keeps everything up to there -----------------------


@pytest.mark.parametrize("timestep", [0.05, 3.0, 1e9])
def test_a_step_that_is_far_too_long_blows_up_and_says_where(path, tmp_path, timestep):
    system = load(path, {"dynamics.timestep": timestep})
    with pytest.raises(NumericalError, match=r"step \d+") as caught:
        run(system, out=tmp_path / "run", steps=100, save_every=1)
    folder = RunFolder.open(tmp_path / "run")
    assert caught.value.folder == folder.path
    message, summary, series = str(caught.value), folder.summary, folder.read("series")
    assert "closest pair is" in message and "timestep" in message
    assert summary["status"] == "failed" and summary["error"] in message
    kept, frames = summary["steps"], frames_of(folder)
    assert kept < 100 and f"step {kept} " in message
    assert series["step"].tolist() == list(range(kept + 1))
    for name in ("potential", "kinetic", "total"):
        assert np.all(np.isfinite(series[name]))
    assert len(frames) == kept + 1
    # what came before is a complete ledger
    simulation = build(system)
    whole = RunResult(folder.path, summary, simulation, (frames[0], frames[-1]), simulation)
    assert_ledger_is_complete(whole, folder)
    with pytest.raises(FolderError):
        run(None, resume=folder.path)


def test_what_is_no_run_is_refused_before_anything_is_written(path, tmp_path):
    for bad in ({"steps": -1}, {"steps": 5, "save_every": -2}):
        with pytest.raises(InputError, match="negative"):
            run(load(path), out=tmp_path / "run", **bad)
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match="no system"):
        run(None)
    with pytest.raises(InputError, match="half the smallest perpendicular"):
        build(load(path, {"cutoff.radius": 2.4}))


@pytest.mark.parametrize("builder", ["host", "jax-md"])
def test_a_box_that_just_fits_is_evaluated(tmp_path, builder):
    """r_cut of exactly half the width."""
    atoms = Atoms("Ar2", positions=[[0.5, 1, 1], [2.0, 1, 1]], cell=[4.0] * 3, pbc=True, masses=[1, 1])
    path = write_system(tmp_path, atoms, cutoff={"radius": 2.0}, neighbors={"skin": 0.0, "builder": builder})
    assert build(load(path)).evaluate().energy == pytest.approx(4 * (1.5**-12 - 1.5**-6), rel=1e-13)


def test_progress_is_told_and_may_stop_a_run(path, tmp_path):
    told = []
    result, _ = go(tmp_path, path, 100, progress=lambda step, steps, info: told.append((step, steps, info)))
    assert told[0][2]["phase"] == "compile"
    steps = [step for step, _, info in told if info["phase"] == "run"]
    assert steps == sorted(steps) and steps[-1] == 100
    assert {total for _, total, _ in told} == {100}
    assert told[-1][2]["flips"] == result.summary["flips_entered"] + result.summary["flips_left"]
    assert told[-1][2]["rebuilds"] == result.summary["rebuilds"]
