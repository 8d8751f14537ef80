"""Narrow floats, role by role: the run goes on, and its ledger is that of the program that ran."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from ase.build import bulk
from oracles import all_pairs
from rollout.harness import assert_ledger_is_complete, frames_of, go, liquid, write_system

from mdnum.rollout.engine import Engine
from mdnum.rollout.flips import PairRecorder
from mdnum.systems import load
from mdnum.systems.build import build

ARGON = {"sigma": 1.0, "epsilon": 1.0}
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
    frames, box = frames_of(folder), float(result.simulation.origin.system.atoms.cell.array[0, 0])
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


@pytest.fixture(scope="module")
def wide(path, tmp_path_factory):
    return go(tmp_path_factory.mktemp("wide"), path, 70, save_every=1)[1]


@pytest.mark.slow
@pytest.mark.parametrize("role", ROLES)
def test_one_narrow_role_at_a_time(path, tmp_path, wide, role):
    result, folder = go(tmp_path, path, 70, {f"precision.{role}": "float32"}, save_every=1)
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
    """A perfect crystal whose second shell is inside the cutoff of its large atoms by less than their bound;
    the first shell of its small ones is outside theirs by more than their bound, which is a smaller one."""
    # 1.7 has rounding in every coordinate
    atoms = bulk("Ar", "fcc", a=1.7, cubic=True) * (3, 3, 3)
    atoms.positions += 0.1234567
    atoms.symbols[:31] = "Ne"
    shells = {"Ar-Ar": 1.7**2, "Ne-Ne": 1.7**2 / 2}
    shares = {"Ar-Ar": 0.85, "Ne-Ne": -3.0}

    def written(bounds):
        """The system with its cutoffs so far from the shells as a multiple of their bounds."""
        radii = {kind: float(np.sqrt(r2 + shares[kind] * bounds[kind])) for kind, r2 in shells.items()}
        return write_system(
            tmp_path, atoms, cutoff={"radius": 1.5, "pairs": radii}, neighbors={"skin": 0.4},
            dynamics={"temperature": 0.0}, precision={"decision": "float32"},
            potential={"kind": "lennard-jones", "pairs": dict.fromkeys((*shells, "Ar-Ne"), ARGON)},
        )  # fmt: skip

    first = build(load(written(dict.fromkeys(shells, 0.0))))
    species, decider = first.symbols, first.decider
    of_type = dict(zip(itertools.combinations_with_replacement(species, 2), decider.bounds, strict=True))
    bounds = {kind: of_type[tuple(kind.split("-"))] for kind in shells}
    assert bounds["Ar-Ar"] > 1.4 * bounds["Ne-Ne"]
    simulation = build(load(written(bounds)))
    (segment,) = Engine(simulation, 0).segments()
    i, j, d = all_pairs(atoms.positions, atoms.cell.array, (True,) * 3)
    at_shell = np.abs((d**2).sum(axis=1) - 1.7**2) < 1e-9
    large = np.array(atoms.symbols) == "Ar"
    doubtful = PairRecorder(simulation).doubtful(segment)
    expected = at_shell & large[i] & large[j]
    assert np.array_equal(np.stack([doubtful.i, doubtful.j]), np.stack([i, j])[:, expected])
    assert PairRecorder(simulation).ambiguous(segment).tolist() == [expected.sum()] and expected.sum() > 100
    assert bounds["Ne-Ne"] < segment.rows_of("nearest")[0] < bounds["Ar-Ar"]
