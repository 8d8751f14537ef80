"""The flips of every shipped system, against an independent recomputation from its trajectory."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import broken_alternations
from rollout.harness import assert_ledger_is_complete, go

from mdnum.numerics import Ledger
from mdnum.systems import names

# steps of a short run that sees some flips; a pair of atoms moves little and is cheap
STEPS = {"pair/at-cutoff": 3000, "pair/leaving-well": 900, "argon/crystal-108": 60}
# bonds of Tersoff's silicon end at 3.0 Å, where a cold crystal has no atoms
WITHOUT_FLIPS = {"silicon/tersoff-512"}


def check(tmp_path, name, steps, **overrides):
    result, folder = go(tmp_path, name, steps, overrides or None, save_every=1)
    flips = assert_ledger_is_complete(result, folder)
    assert (flips == 0) == (name in WITHOUT_FLIPS)
    summary, series, table = result.summary, folder.read("series"), folder.read("flips")
    assert summary["status"] == "complete"
    assert summary["steps"] == steps == series["step"][-1]
    assert (summary["lost_pairs"], summary["count_mismatches"]) == (0, 0)
    assert summary["energy_budget_closes"]
    assert flips == summary["flips_entered"] + summary["flips_left"]
    # pairs inside = pairs inside at first + entered - left, at every step
    algebra = series["pairs"][0] + np.cumsum(series["entered"].astype(int) - series["left"])
    assert np.array_equal(series["pairs"], algebra)
    subject = np.stack([table["i"], table["j"]], axis=1)
    columns = (
        table["step"],
        subject,
        table["entered"],
        table["margin"],
        table["bound"],
        table["energy_jump"],
    )
    assert broken_alternations(Ledger("pair", *columns)) == 0


# one of each kind always; compiling all of them takes minutes
QUICK = {"argon/crystal-108", "argon/tilted-500", "pair/at-cutoff"}


#: Of the longer trajectories, those that every change is held against.
LONGER = ("argon/crystal-108", "argon/tilted-500")


@pytest.mark.jax_md
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in names("md")]
)
def test_flips_are_those_of_the_trajectory(tmp_path, name):
    check(tmp_path, name, STEPS.get(name, 12))


@pytest.mark.nightly
@pytest.mark.jax_md
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in LONGER else pytest.mark.nightly) for n in names("md")]
)
def test_flips_are_those_of_a_longer_trajectory_over_several_lists(tmp_path, name):
    check(tmp_path, name, STEPS.get(name, 100), **{"neighbors.skin": 0.15})


@pytest.mark.slow
@pytest.mark.jax_md
@pytest.mark.filterwarnings("ignore:scatter inputs")
@pytest.mark.parametrize(
    "name",
    [
        "argon/crystal-108",
        "argon/tilted-500",
        "pair/at-cutoff",
        pytest.param("binary/kob-andersen-1000", marks=pytest.mark.nightly),
    ],
)
def test_flips_found_over_the_lists_of_jax_md(tmp_path, name):
    check(tmp_path, name, STEPS.get(name, 40), **{"neighbors.builder": "jax-md", "neighbors.skin": 0.15})
