"""Two run folders: the dates read from them are those of the runs."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rollout.harness import run

from mdnum.errors import FolderError, InputError
from mdnum.forks import fork
from mdnum.forks.folders import compare_folders, twin_of
from mdnum.store import RunFolder
from mdnum.store import files as manifest
from mdnum.verbs.frame import layout

STEPS = 260


def copied(folder: Path, to: Path) -> Path:
    """A copy that may be edited: its manifest, which would tell, lists no file."""
    shutil.copytree(folder, to)
    manifest.save(to, manifest.Manifest(RunFolder.open(folder).layout))
    return to


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

    plain = made("plain")

    def edited(name, *words):
        copy = copied(plain, root / name)
        text = (copy / "system.toml").read_text()
        for old, new in words:
            assert old in text
            text = text.replace(old, new)
        (copy / "system.toml").write_text(text)
        return copy

    return {
        "plain": plain,
        "again": made("again"),
        "short": made("short", steps=100),
        "float32": made(
            "float32", precision__state="float32", precision__force="float32", precision__decision="float32"
        ),
        # the tables are not read for what these are asked
        "ulp": edited("ulp", ("epsilon = 1.0", "epsilon = 1.0000000000000002")),
        "warm": edited(
            "warm",
            ('velocities = "file"', 'velocities = "drawn"'),
            ("temperature = 0.02", "temperature = 0.3"),
        ),
        "two": edited("two", ('force = "float64"', 'force = "float32"'), ("skin = 0.3", "skin = 0.5")),
        "shifted": edited("shifted", ('kind = "hard"', 'kind = "shifted"')),
    }


def test_equal_runs_never_part(folders):
    found = compare_folders(folders["plain"], folders["again"])
    assert (found.first_bit, found.fork, found.steps) == (None, None, STEPS)
    assert found.differences == () and found.same_structure
    assert found.causes == () and (found.world, found.channel) == ("md", "")
    assert compare_folders(folders["plain"], folders["short"]).steps == 100


def test_dates_are_those_of_the_runs_followed_again(folders):
    found = compare_folders(folders["plain"], folders["float32"])
    again = fork(twin_of(found), STEPS, split=10.0, repeats=0, counterfactual=False)
    assert found.first_bit == again.dates.first_bit == 0
    assert found.fork == again.dates.fork
    if found.fork is not None:
        assert again.decision is not None
        assert found.decisions[0].subject == again.decision.subject
        assert found.decisions[0].margin == again.decision.margin


@pytest.mark.parametrize(
    ("name", "keys", "causes"),
    [
        ("shifted", {"cutoff.kind"}, {"cutoff.kind"}),
        ("ulp", {"potential.epsilon"}, {"potential.epsilon"}),
        ("two", {"precision.force", "neighbors.skin"}, {"neighbors.skin", "precision"}),
        # three roles of one dtype are one choice
        ("float32", {"precision.state", "precision.force", "precision.decision"}, {"precision"}),
        (
            "warm",
            {"dynamics.temperature", "structure.velocities", "start: velocities"},
            {"dynamics.temperature", "structure.velocities", "start"},
        ),
    ],
)
def test_choices_numbers_and_starts_are_differences_and_no_other_systems(folders, name, keys, causes):
    found = compare_folders(folders["plain"], folders[name])
    assert {key for key, _, _ in found.differences} == keys and set(found.causes) == causes
    assert found.same_structure == ("start" not in causes)
    assert found.same_structure or found.first_bit == 0


def test_other_systems_are_refused_by_what_differs(folders, tmp_path):
    other = tmp_path / "other"
    copied(folders["plain"], other)
    system = (other / "system.toml").read_text()
    (other / "system.toml").write_text(system.replace('"lennard-jones"', '"soft-sphere"'))
    with pytest.raises(InputError, match=r"potential\.kind .*lennard-jones .*soft-sphere"):
        compare_folders(folders["plain"], other)
    (other / "system.toml").write_text(system)
    structure = (other / "structure.extxyz").read_text()
    for wrong, message in (
        (structure.replace("Ar ", "Ne ", 1), "species"),
        (structure.replace("4.762203155904598", "4.862203155904598"), "boxes differ"),
        (structure.replace("T T T", "T T F"), "periodic directions"),
    ):
        (other / "structure.extxyz").write_text(wrong)
        with pytest.raises(InputError, match=message):
            compare_folders(folders["plain"], other)
    (other / "structure.extxyz").write_text(structure.replace("0.01800456587341473", "0.01800456587341474"))
    assert compare_folders(folders["plain"], other).differences[0][0] == "start: positions"


def test_fork_folders_are_told_from_runs(folders, tmp_path):
    answered = tmp_path / "answered"
    RunFolder.create(answered, layout("map")).close()
    for pair in ((folders["plain"], answered), (answered, folders["plain"])):
        with pytest.raises(InputError, match=r"answered: .*fork.*expected a run.*`mdnum run`"):
            compare_folders(*pair)
    (answered / "manifest.json").rename(answered / "summary.json")
    with pytest.raises(FolderError, match=r"manifest\.json: is missing"):
        compare_folders(folders["plain"], answered)


def test_a_planted_flip_is_found(folders, tmp_path):
    """One row taken out of a copy of a run's flips."""
    copy = tmp_path / "planted"
    copied(folders["plain"], copy)
    table = pq.ParquetFile(copy / "flips.parquet").read()
    keep = np.ones(len(table), bool)
    keep[len(table) // 2] = False
    row = {name: table[name][len(table) // 2].as_py() for name in ("step", "i", "j")}
    pq.write_table(table.filter(pa.array(keep)), copy / "flips.parquet")
    found = compare_folders(folders["plain"], copy)
    assert found.fork == row["step"]
    assert [(flip.run, flip.subject) for flip in found.decisions] == [("A", (row["i"], row["j"]))]
