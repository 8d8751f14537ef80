"""A run in whole numbers says how well it keeps its energy, beside float64."""

from __future__ import annotations

import numpy as np
import pytest

import mdnum
from mdnum.store import RunFolder

STEPS = 60
SMOOTH = {"cutoff.kind": "quintic"}


@pytest.mark.slow
def test_energy_is_set_beside_that_of_float64(tmp_path):
    whole, floats = tmp_path / "whole", tmp_path / "floats"
    overrides = {**SMOOTH, "precision.state": "lattice"}
    run = mdnum.run("argon/crystal-108", out=whole, steps=STEPS, overrides=overrides, report=False)
    mdnum.run("argon/crystal-108", out=floats, steps=STEPS, overrides=SMOOTH, check=False, report=False)
    told = run.summary["lattice"]
    assert told["energy_steps"] == STEPS
    for key, folder in (("energy_std", whole), ("energy_std_float64", floats)):
        energy = np.asarray(RunFolder.open(folder).read("series")["total"])
        assert len(energy) == STEPS + 1
        # the starts differ by the changed edges of the box
        assert told[key] == pytest.approx(np.std(energy) / 108, rel=1e-4)
