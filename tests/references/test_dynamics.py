"""`mdnum check dynamics`: a rollout against ASE's velocity Verlet."""

from __future__ import annotations

import json

import numpy as np
import pytest
from small_systems import LENNARD_JONES, crystal, make

from mdnum.references.ase_models import reference
from mdnum.references.dynamics import _growth, _sudden, check_dynamics

HARD = {"kind": "hard", "radius": 2.2}


@pytest.mark.parametrize("cutoff", ["hard", "force-shifted"])
def test_a_hot_crystal_follows_ase(cutoff: str):
    report = check_dynamics(make(crystal(), LENNARD_JONES, {"kind": cutoff, "radius": 2.2}), steps=60)
    assert report.ok and len(report.position) == 61
    assert report.position[-1] <= 1e-12 and report.velocity[-1] <= 1e-11  # measured 4e-15 and 4e-14
    assert report.is_ase == (cutoff != "force-shifted")
    json.dumps(report.to_dict())
    assert report.rows()[-1]["step"] == 60


def test_langevin_is_checked_without_its_bath():
    bath = {"kind": "langevin", "timestep": 0.004, "temperature": 1.0, "friction": 1.0, "seed": 3}
    assert check_dynamics(make(crystal(), LENNARD_JONES, HARD, dynamics=bath), steps=20).ok


def test_float32_is_measured_as_such():
    single = {"state": "float32", "force": "float32", "decision": "float32", "accumulate": "float32"}
    report = check_dynamics(make(crystal(), LENNARD_JONES, HARD, precision=single), steps=20)
    assert report.ok and report.precision == "float32"
    assert 1e-8 < report.position[-1] < 1e-4


@pytest.mark.parametrize("change", [{"epsilon": 1.0 + 1e-5}, {"sigma": 1.0 + 1e-6}])
def test_wrong_forces_show(change: dict):
    system = make(crystal(), LENNARD_JONES, HARD)
    judge = reference(make(crystal(), {**LENNARD_JONES, **change}, HARD))
    report = check_dynamics(system, steps=30, judge=judge)
    assert not report.ok
    assert [(one["code"], one["severity"]) for one in report.findings] == [("dynamics-differ", "error")]
    assert "integrator" in report.findings[0]["remedy"]


def test_growth_and_sudden_steps():
    chaotic = [1e-16 * np.exp(0.05 * step) for step in range(100)]
    assert _growth(chaotic) == pytest.approx(np.exp(0.05))
    assert _sudden(chaotic, floor=1e-13) is None
    forked = [*chaotic[:50], *(1e-7 * np.exp(0.05 * step) for step in range(50))]
    assert _sudden(forked, floor=1e-13) == 50
