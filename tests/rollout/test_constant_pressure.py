"""Runs under a barostat: lists, ledger, energy budget and what is compared at the end, in boxes of rows."""

from __future__ import annotations

from typing import Any

import ase.io
import numpy as np
import pytest
from rollout.harness import liquid

import mdnum
from mdnum.rollout.adequacy import fastest_period
from mdnum.rollout.engine import Engine
from mdnum.rollout.flips import PairRecorder, decided_pairs, true_pairs
from mdnum.store import RunFolder
from mdnum.systems.simulation import Simulation

STEPS = 100


def pressed(kind: str = "cell-rescaling", box: str = "full", **options: Any) -> Simulation:
    """A dense fluid of 108 atoms that is pressed together."""
    dynamics = {"relaxation": 0.1, "pressure_relaxation": 0.1, "box": box}
    if kind == "cell-rescaling":
        dynamics["compressibility"] = 0.05
    given = {"timestep": 0.004, "temperature": 1.0, "pressure": 6.0, "skin": 0.2, "seed": 3}
    cut = mdnum.Cut(options.pop("cutoff", "hard"), 2.0)
    return mdnum.simulation(
        liquid(), mdnum.LennardJones(1.0, 1.0), cut, units="lj", integrator=kind, dynamics=dynamics,
        name=kind, steps=STEPS, save_every=STEPS, **given | options,
    )  # fmt: skip


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["cell-rescaling", "mtk"])
@pytest.mark.parametrize("box", ["isotropic", "full"])
def test_a_list_that_is_kept_gives_the_run_of_one_rebuilt_at_every_step(kind, box):
    """The same keys; sums do not depend on their order."""
    runs = []
    for options in ({}, {"rebuild": (1, 0, False)}):
        simulation = pressed(kind, box, reduction="exact", **options)
        rows, builds, recorder = [], 0, PairRecorder(simulation)
        for segment in Engine(simulation, STEPS).segments():
            builds += segment.opens
            ledger = recorder.flips(segment)
            assert not recorder.missed
            for row in range(segment.rows):
                x, now = segment.unsorted("x", row), ledger.step == segment.first + row
                flips = [getattr(ledger, name)[now].tobytes() for name in ("i", "j", "margin", "by_box")]
                rows.append((x.tobytes(), segment.rows_of("cell")[row].tobytes(), flips))
                true = true_pairs(simulation.in_row(segment.cell_of(row)), x)
                assert np.array_equal(decided_pairs(simulation, segment, row), true)
        runs.append((rows, builds))
    assert runs[0][0] == runs[1][0]
    assert runs[1][1] == STEPS + 1 and 3 < runs[0][1] < STEPS / 3
    volumes = [np.linalg.det(np.frombuffer(cell).reshape(3, 3)) for _, cell, _ in runs[0][0]]
    assert volumes[-1] < 0.97 * volumes[0]


def test_heat_work_and_jumps_close_the_budget_and_the_end_is_compared_in_its_own_box(tmp_path):
    simulation: Any = pressed("mtk", "isotropic")
    made: Any = mdnum.run(simulation, out=tmp_path / "run", report=False)
    summary, series = made.summary, RunFolder.open(tmp_path / "run").read("series")
    owed = series["total"] - series["conserved"]
    assert summary["heat"] + summary["work"] == pytest.approx(owed[-1], rel=1e-9)
    # p dV, but for what the box still moves with
    pressed_out = 6.0 * (series["volume"][0] - series["volume"][-1])
    assert summary["work"] == pytest.approx(pressed_out, rel=0.02) and pressed_out > 10
    assert summary["energy_budget_closes"] and summary["lost_pairs"] == summary["count_mismatches"] == 0
    left = series["conserved"] - np.cumsum(series["energy_jump"])
    assert np.ptp(series["energy_jump"].cumsum()) > 20 * np.ptp(left) and np.ptp(left) < 0.01 * 108
    assert summary["ase"]["ok"]
    atoms: Any = ase.io.read(tmp_path / "run" / "trajectory.traj", index=-1)
    ends = fastest_period(pressed().with_cell(made.result.ended.cell), atoms.positions)
    starts = fastest_period(pressed(), pressed().positions)
    assert np.allclose(made.result.ended.cell.matrix, atoms.cell.array, atol=0, rtol=1e-15)
    assert summary["fastest_period"] == pytest.approx(min(starts, ends), rel=1e-6)
    # a run that has ended already is compared there too
    again: Any = mdnum.run(simulation, resume=tmp_path / "run", report=False)
    assert np.array_equal(again.result.ended.cell.matrix, made.result.ended.cell.matrix)
    assert again.summary["ase"]["ok"] and again.summary["fastest_period"] == summary["fastest_period"]
