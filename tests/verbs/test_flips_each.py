"""Several trajectories, each on its own: the same as one by one, in this process or in workers."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import ase.io
import numpy as np
import pytest
from command_line import call

import mdnum

FILES = ("a.extxyz", "no.extxyz", "b.extxyz@1:", "a.extxyz")


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for name, frames in (("a", 4), ("b", 6)):
        places = [rng.uniform(0, 7, (9, 3)) * (1, 1.1, 1.2) for _ in range(frames)]
        images = [ase.Atoms("Ar9", x, cell=(7, 7.7, 8.4), pbc=True) for x in places]
        ase.io.write(f"{name}.extxyz", images)
    Path("no.extxyz").write_text("no trajectory")
    return tmp_path


def found(outcome: mdnum.Outcome) -> tuple[dict[str, Any], list[str]]:
    """What does not depend on when it was computed, and where."""
    times = ("seconds", "seconds_of_frames")
    told = {name: one for name, one in outcome.summary.items() if name not in times}
    return told, [
        repr(outcome.table(file.stem).to_pydict()) for file in sorted(outcome.path.glob("*.parquet"))
    ]


def test_each_file_is_examined_as_if_alone_and_an_error_leaves_the_others(folder):
    alone = [
        found(mdnum.flips(folder / one, cutoffs=3.0, report=False)) for one in ("a.extxyz", "b.extxyz@1:")
    ]
    with ThreadPoolExecutor(2) as pool:
        made = mdnum.flips_each(FILES, cutoffs=3.0, report=False, out="here", on=pool)
    first, error, second, again = made
    assert isinstance(error, mdnum.InputError) and "no.extxyz" in str(error)
    assert [found(one) for one in (first, second, again)] == [*alone, alone[0]]
    assert len(alone[0][1]) > 3 and alone[0] != alone[1]
    names = {one.name for one in Path("here").iterdir()}
    assert (
        names == {one.path.name for one in (first, second, again)} == {"flips-a-1", "flips-a-2", "flips-b-1"}
    )


def test_from_the_command_line_a_line_for_each(folder, capsys):
    assert call("flips", "--each", *FILES[:3], "--cutoff", "3", "-o", "here", "--no-report", "--json") == 1
    rows = json.loads(capsys.readouterr().out)["files"]
    assert [row["file"] for row in rows] == [*FILES[:3]]
    assert [row["frames"] for row in rows] == [4, None, 5] and "no.extxyz" in rows[1]["error"]
    assert rows[0]["flips"] == [len(mdnum.read(rows[0]["folder"]).table("flips"))] != [0]


def test_what_was_found_before_control_c_is_shown(folder, capsys, monkeypatch):
    def until_pressed(file, **options):
        one = mdnum.flips(file, **options)
        return replace(one, summary={**one.summary, "interrupted": file.name.startswith("b")})

    monkeypatch.setattr("mdnum.verbs.flips.flips", until_pressed)
    files = ("a.extxyz", "b.extxyz", "a.extxyz")
    assert call("flips", "--each", *files, "--cutoff", "3", "-o", "here", "--no-report", "--json") == 130
    assert [row["file"] for row in json.loads(capsys.readouterr().out)["files"]] == [*files[:2]]


@pytest.mark.parametrize("words", [("a", "b", "c"), ("a", "--workers", "2"), ("a", "--on", "tcp://x:1")])
def test_several_are_examined_only_with_each(words, capsys):
    assert call("flips", *words, "--cutoff", "3") == 2
    assert "--each" in capsys.readouterr().err


@pytest.mark.nightly
def test_in_two_processes_the_same(folder):
    one, _, other, _ = mdnum.flips_each(FILES, cutoffs=3.0, report=False, workers=2)
    for outcome, file in ((one, FILES[0]), (other, FILES[2])):
        assert found(outcome) == found(mdnum.flips(folder / file, cutoffs=3.0, report=False))
