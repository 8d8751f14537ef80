"""Two run folders: the dates read from them are those of the runs."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.forks import fork
from mdnum.forks.folders import compare_folders, twin
from mdnum.rollout.run import run

STEPS = 260


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("folders")

    def made(name, steps=STEPS, **overrides):
        run(
            overrides.pop("system", "argon/crystal-108"),
            out=root / name,
            steps=steps,
            overrides={key.replace("__", "."): value for key, value in overrides.items()},
        )
        return root / name

    return {
        "plain": made("plain"),
        "again": made("again"),
        "short": made("short", steps=100),
        "float32": made(
            "float32", precision__state="float32", precision__force="float32", precision__decision="float32"
        ),
        "two choices": made("two", precision__force="float32", neighbors__skin=0.5),
        "shifted": made("shifted", cutoff__kind="shifted"),
    }


def test_equal_runs_never_part(folders):
    found = compare_folders(folders["plain"], folders["again"])
    assert (found.seed, found.fork, found.steps) == (None, None, STEPS)
    assert found.differences == () and found.same_structure
    assert "should agree bit for bit" in found.reasons[0]
    assert compare_folders(folders["plain"], folders["short"]).steps == 100


def test_dates_are_those_of_the_runs_followed_again(folders):
    found = compare_folders(folders["plain"], folders["float32"])
    keys = [key for key, _, _ in found.differences]
    assert "precision.force" in keys
    again = fork(twin(folders["plain"], folders["float32"]), STEPS, split=10.0, repeats=0)
    assert found.seed == again.dates.seed == 0
    assert found.fork == again.dates.fork
    if found.fork is not None:
        assert again.decision is not None
        assert (found.decisions[0].i, found.decisions[0].j) == (again.decision.i, again.decision.j)
        assert found.decisions[0].margin == again.decision.margin


def test_more_than_one_difference_is_said(folders):
    found = compare_folders(folders["plain"], folders["two choices"])
    assert {"precision.force", "neighbors.skin"} <= {key for key, _, _ in found.differences}
    assert "2 choices" in found.reasons[0]


def test_other_models_are_refused_by_the_field_that_differs(folders):
    with pytest.raises(InputError, match=r"cutoff\.kind is hard in the first and shifted"):
        compare_folders(folders["plain"], folders["shifted"])


def test_a_planted_flip_is_found(folders, tmp_path):
    """One row taken out of a copy of a run's flips."""
    import shutil

    import pyarrow as pa
    import pyarrow.parquet as pq

    copy = tmp_path / "planted"
    shutil.copytree(folders["plain"], copy)
    table = pq.read_table(copy / "flips.parquet", partitioning=None)
    keep = np.ones(len(table), bool)
    keep[len(table) // 2] = False
    row = {name: table[name][len(table) // 2].as_py() for name in ("step", "i", "j")}
    pq.write_table(table.filter(pa.array(keep)), copy / "flips.parquet")
    found = compare_folders(folders["plain"], copy)
    assert found.fork == row["step"]
    assert [(flip.run, flip.i, flip.j) for flip in found.decisions] == [("A", row["i"], row["j"])]
