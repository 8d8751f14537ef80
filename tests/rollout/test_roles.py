"""Narrow floats, role by role: the run goes on, and its ledger is that of the program that ran."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracles import all_pairs
from rollout.harness import assert_ledger_is_complete, frames_of, go, liquid, write_system

ROLES = ("state", "force", "decision", "accumulate")
NARROW = {f"precision.{role}": "float32" for role in ROLES}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_system(tmp_path_factory.mktemp("fluid"), liquid())


def algebra_holds(folder):
    series = folder.read("series")
    left_and_entered = np.cumsum(series["entered"].astype(int) - series["left"])
    return np.array_equal(series["pairs"], series["pairs"][0] + left_and_entered)


def narrow_decisions(positions, box, threshold):
    """Pairs inside as float32 arithmetic has it, operation by operation."""
    x, box = positions.astype(np.float32), np.float32(box)
    i, j = np.triu_indices(len(x), 1)
    d = x[j] - x[i]
    d = d - np.rint(d * (np.float32(1) / box)).astype(np.float32) * box
    r2 = d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2]
    assert r2.dtype == np.float32
    return i, j, r2 < np.float32(threshold) * np.float32(threshold)


def test_everything_narrow(path, tmp_path):
    result, folder = go(tmp_path, path, 70, NARROW, save_every=1)
    summary, flips = result.summary, folder.read("flips")
    assert summary["status"] == "complete" and algebra_holds(folder)
    assert summary["lost_pairs"] == summary["count_mismatches"] == 0
    assert len(flips["step"]) > 100
    # one more bit of doubt for each bit of mantissa that went
    wide = replace(result.simulation.decider, dtype="float64", state="float64")
    # and some more, where the box or the threshold are no numbers of single precision
    assert 0.999 * 2.0**29 < flips["bound"][0] / wide.bounds[0] < 2.0**30
    frames, box = frames_of(folder), float(result.simulation.system.atoms.cell.array[0, 0])
    assert all(np.array_equal(x, x.astype(np.float32)) for x in frames)
    before, rows = None, []
    for step, positions in enumerate(frames):
        i, j, inside = narrow_decisions(positions, box, 2.0)
        if before is not None:
            changed = np.flatnonzero(inside != before)
            rows += [(step, int(i[k]), int(j[k]), bool(inside[k])) for k in changed]
        before = inside
    assert list(zip(*(flips[n].tolist() for n in ("step", "i", "j", "entered")), strict=True)) == rows


@pytest.mark.slow
def test_a_wide_decision_on_a_narrow_state_is_the_exact_one(path, tmp_path):
    result, folder = go(tmp_path, path, 70, {"precision.state": "float32"}, save_every=1)
    assert assert_ledger_is_complete(result, folder) > 100
    assert result.summary["energy_budget_closes"]


@pytest.mark.slow
@pytest.mark.parametrize("role", ROLES)
def test_one_narrow_role_at_a_time(path, tmp_path, role):
    result, folder = go(tmp_path / "n", path, 70, {f"precision.{role}": "float32"}, save_every=1)
    _, wide = go(tmp_path / "w", path, 70, save_every=1)
    assert result.summary["status"] == "complete" and algebra_holds(folder)
    assert result.summary["lost_pairs"] == result.summary["count_mismatches"] == 0
    energies = folder.read("series")["potential"], wide.read("series")["potential"]
    # a flip that comes a step later is one u(r_cut), 0.06, for a step
    assert np.allclose(*energies, rtol=0, atol=0.3)
    if role != "decision":
        # narrow arithmetic must show, or the role does nothing
        assert not np.array_equal(*energies)
    if role in ("force", "decision", "accumulate"):
        assert any(not np.array_equal(x, x.astype(np.float32)) for x in frames_of(folder))


def test_ambiguous_pairs_are_counted_where_a_shell_sits_at_the_cutoff(tmp_path):
    """A perfect crystal whose second shell is at r_cut but for rounding: each of those pairs is in doubt."""
    from ase.build import bulk

    # 1.7 has rounding in every coordinate
    atoms = bulk("Ar", "fcc", a=1.7, cubic=True) * (3, 3, 3)
    atoms.positions += 0.1234567
    path = write_system(
        tmp_path, atoms, cutoff={"radius": 1.7}, neighbors={"skin": 0.6}, dynamics={"temperature": 0.0}
    )
    result, folder = go(tmp_path, path, 70, save_every=1)
    series = folder.read("series")
    assert series["ambiguous"][0] == 108 * 6 // 2
    _, _, d = all_pairs(atoms.positions, atoms.cell.array, (True,) * 3)
    at_shell = np.abs((d**2).sum(axis=1) - 1.7**2) < 1e-9
    assert at_shell.sum() == 108 * 6 // 2
    assert series["min_margin"][0] <= result.simulation.decider.bounds[0]
    assert result.summary["ambiguous"] == series["ambiguous"].sum()
