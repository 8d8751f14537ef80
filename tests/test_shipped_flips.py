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
# one of each kind always; compiling all of them takes minutes
QUICK = {"argon/crystal-108", "argon/tilted-500", "pair/at-cutoff"}
# other sizes and shapes of the same kinds, and other many-body potentials
LIKE_OTHERS = {
    "argon/crystal-500",
    "argon/liquid-864",
    "pair/leaving-well",
    "silicon/tersoff-512",
    "copper/eam-500",
    "copper/eam-npt-500",
    "lj/liquid-npt-500",
}
SHORT = {"neighbors.skin": 0.15}
JAX_MD = {"neighbors.builder": "jax-md", **SHORT}
SLOW, NIGHTLY = pytest.mark.slow, pytest.mark.nightly


@pytest.mark.jax_md
@pytest.mark.filterwarnings("ignore:scatter inputs")
@pytest.mark.parametrize(
    ("name", "steps", "overrides"),
    [
        *(
            pytest.param(name, 12, {}, marks=NIGHTLY if name in LIKE_OTHERS else [SLOW] * (name not in QUICK))
            for name in names("md")
        ),
        # over several lists
        *(pytest.param(name, 100, SHORT, marks=NIGHTLY) for name in names("md")),
        pytest.param("argon/crystal-108", 40, JAX_MD, marks=SLOW),
        *(
            pytest.param(name, 40, JAX_MD, marks=NIGHTLY)
            for name in ("argon/tilted-500", "pair/at-cutoff", "binary/kob-andersen-1000")
        ),
    ],
)
def test_flips_are_those_of_the_trajectory(tmp_path, name, steps, overrides):
    steps = STEPS.get(name, steps)
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
    columns = (table[column] for column in ("entered", "margin", "bound", "energy_jump"))
    assert broken_alternations(Ledger("pair", table["step"], subject, *columns)) == 0
