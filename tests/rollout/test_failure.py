"""A run that cannot go on: it says where and why, and keeps everything up to there."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from rollout.harness import assert_ledger_is_complete, frames_of, go, liquid, write_system

from mdnum.errors import FolderError, InputError, NumericalError
from mdnum.rollout.run import RunResult, run
from mdnum.store import RunFolder
from mdnum.systems import load
from mdnum.systems.build import build


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_system(tmp_path_factory.mktemp("fluid"), liquid())


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
    assert_ledger_is_complete(RunResult(folder.path, summary, build(system), (frames[0], frames[-1])), folder)
    with pytest.raises(FolderError):
        run(None, resume=folder.path)


def test_what_is_no_run_is_refused_before_anything_is_written(path, tmp_path):
    for bad in ({"steps": -1}, {"steps": 5, "save_every": -2}):
        with pytest.raises(InputError, match="negative"):
            run(load(path), out=tmp_path / "run", **bad)
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match="no system"):
        run(None)


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
