"""Atoms that drift away along free axes: what rounds where they are is told, however far from the start."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from ase import Atoms
from rollout.harness import frames_of, go, run, tables_equal, write_system

from mdnum.forks import Twin, fork
from mdnum.forks.certified import certified, certified_horizon, protection
from mdnum.rollout.program import MdProgram
from mdnum.store import RunFolder
from mdnum.systems.build import build
from mdnum.systems.load import load

RADIUS, STEPS = 2.3, 800
NARROW = {"precision.decision": "float32"}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Two atoms that leave together, as good as free, while their distance creeps across the cutoff."""
    atoms = Atoms("Ar2", positions=[[0.017, 0.031, 0.0], [0.017, 2.33101, 0.0]], masses=[1.0, 1.0])
    atoms.set_velocities([[5.0, 5.65, 0.0], [5.0, 5.6499995, 0.0]])
    return write_system(
        tmp_path_factory.mktemp("pair"),
        atoms,
        potential={"kind": "lennard-jones", "sigma": 1.0, "epsilon": 1e-12},
        cutoff={"radius": RADIUS},
        neighbors={"skin": 60.0},
        dynamics={"timestep": 0.05, "steps": STEPS, "remove_drift": False},
    )


@pytest.fixture(scope="module")
def whole(path, tmp_path_factory) -> RunFolder:
    return go(tmp_path_factory.mktemp("whole"), path, STEPS, NARROW, save_every=1)[1]


def squares(folder: RunFolder) -> list[Fraction]:
    """Squared distances of the saved positions, without rounding."""
    frames = [[[Fraction(float(c)) for c in atom] for atom in x] for x in frames_of(folder)]
    return [sum(((b - a) ** 2 for a, b in zip(*x, strict=True)), start=Fraction(0)) for x in frames]


def test_decisions_that_exact_arithmetic_makes_otherwise_are_counted_as_ambiguous(whole):
    series, flips = whole.read("series"), whole.read("flips")
    threshold = Fraction(RADIUS * RADIUS)
    exact = squares(whole)
    wrong = np.flatnonzero((series["pairs"] == 1) != np.array([square < threshold for square in exact]))
    assert len(wrong) > 100, "a decision that goes wrong is what this is about"
    assert (series["ambiguous"][wrong] == 1).all()
    rows = zip(*(flips[name].tolist() for name in ("step", "margin", "bound")), strict=True)
    assert all(abs(Fraction(margin) - (threshold - exact[step])) <= bound for step, margin, bound in rows)
    # what doubt there is grows with the way, and the summary has the most of it
    assert (np.diff(flips["bound"]) >= 0).all() and flips["bound"][-1] > 2 * flips["bound"][0]
    assert whole.summary["cutoff"]["bound"] >= flips["bound"].max()
    assert whole.summary["ambiguous"] == series["ambiguous"].sum()


def test_a_resumed_run_has_the_same_bounds(path, whole, tmp_path):
    result, _ = go(tmp_path, path, 600, NARROW, save_every=1)
    folder = RunFolder.open(run(None, resume=result.folder, steps=STEPS).folder)
    for table in ("series", "flips"):
        tables_equal(folder, whole, table)
    assert folder.summary["cutoff"] == whole.summary["cutoff"]


def test_horizons_end_before_the_first_decision_that_rounding_made(path, whole):
    narrow, wide = build(load(path, NARROW)), build(load(path))
    found = certified_horizon(narrow, STEPS)
    series = whole.read("series")
    assert found.total == series["ambiguous"].sum()
    first = int(np.flatnonzero(series["ambiguous"])[0])
    assert found.horizon == first and found.wrong is not None
    assert max(one.bound for one in found.decisions) <= whole.summary["cutoff"]["bound"]
    dates = fork(
        Twin(MdProgram(wide), MdProgram(narrow), "decisions in float32"), STEPS, counterfactual=False
    )
    assert dates.decision is not None and dates.decision.ambiguous
    assert certified(dates).horizon["B"].step == first - 1
    assert certified(dates).horizon["A"].decisions == 0
    twice = fork(Twin(MdProgram(narrow), MdProgram(narrow), "nothing"), STEPS, counterfactual=False)
    _, needed = protection(twice)
    assert needed[-1] > 10 * needed[0] > 0 and (np.diff(needed) >= 0).all()


@pytest.mark.parametrize("state", [pytest.param("float32", marks=pytest.mark.slow), "lattice"])
def test_a_state_that_is_not_narrowed_decides_exactly(path, tmp_path, state):
    _, folder = go(tmp_path, path, 200, {"precision.state": state}, save_every=1)
    series = folder.read("series")
    inside = np.array([square < Fraction(RADIUS * RADIUS) for square in squares(folder)])
    wrong = (series["pairs"] == 1) != inside
    assert not (wrong & (series["ambiguous"] == 0)).any()
    assert state != "lattice" or not (wrong.any() or series["ambiguous"].any())
