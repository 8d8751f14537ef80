"""Programs in processes of their own, into a folder: who agrees, what failed, and nothing on stdout."""

from __future__ import annotations

import json
import re
import stat
import subprocess
import sys

import numpy as np
import pytest

import mdnum
from mdnum.cli import main
from mdnum.forks import variants
from mdnum.forks.variants import Ran, Variant
from mdnum.store import RunFolder
from mdnum.systems import load

STEPS = 6
#: First step at which a program leaves the loop that the others are compared with, and how fast.
LEAVES = {"AVX": (3, 1e-15), "reversed": (2, 4e-15)}


def stand_in(variant: Variant, folder, k: int, steps: int):
    """A process that takes no time: its positions leave the start's from a given step on."""
    if variant.name == "SSE4.2":
        return Ran(variant, (), -1, None, float("nan"), 0.5, "took longer than 600 s"), None
    first, rate = LEAVES.get(variant.name, (STEPS + 1, 0.0))
    x = np.tile(load(folder / "system", world="md").atoms.positions.T, (steps, 1, 1))
    for step in range(first, steps + 1):
        x[step - 1, 0, 7] += rate * 2.0**step
    return Ran(variant, tuple(row.tobytes().hex()[:4096] for row in x), -1, None, 0.0, 0.5), x


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    out = tmp_path_factory.mktemp("processes") / "crystal"
    which = [variants.REFERENCE, Variant("again"), Variant("AVX"), Variant("reversed"), Variant("SSE4.2")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(variants, "_process", stand_in)
        return mdnum.fork_processes("argon/crystal-108", steps=STEPS, which=which, out=out)


def test_the_folder_holds_clusters_dates_and_separations(compared):
    folder = RunFolder.open(compared.folder)
    assert folder.world == "processes" and folder.summary == compared.summary
    table = folder.read("variants")
    assert table["variant"].tolist() == ["scan", "again", "AVX", "reversed", "SSE4.2"]
    assert table["cluster"].tolist() == [0, 0, 1, 2, -1] and table["seed"].tolist() == [-1, -1, 3, 2, -1]
    np.testing.assert_allclose(table["separation"][:4], [0, 0, 64e-15, 256e-15], rtol=0.05)
    apart = folder.read("variant_separations")
    mine = apart["separation"][apart["variant"] == "AVX"]
    assert len(mine) == STEPS and not mine[:2].any() and mine[2] == pytest.approx(8e-15, rel=0.2)
    summary = compared.summary
    assert summary["clusters"] == [["scan", "again"], ["AVX"], ["reversed"]]
    assert summary["headline"].startswith("4 programs of one system compute 3 different trajectories")
    assert "differ at step 2" in summary["headline"]


def test_a_program_that_failed_is_told_and_does_not_stop_the_others(compared):
    (finding,) = compared.summary["findings"]
    assert finding["code"] == "VARIANT_FAILED" and "600 s" in finding["text"]
    text = (compared.folder / "report.html").read_text(encoding="utf-8")
    words = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", text))
    assert "SSE4.2 failed" in words and "took longer than 600 s" in words
    assert "reversed" in words and words.count("last hash") == 4


def test_from_the_command_line(compared, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(variants, "_process", stand_in)
    with pytest.raises(SystemExit) as stopped:
        main(["fork", "argon/crystal-108", "--processes", "--steps", str(STEPS), "--json", "--no-report"])
    answer = json.loads(capsys.readouterr().out)
    assert stopped.value.code == 1 and answer["steps"] == STEPS
    assert len(answer["variants"]) == len(variants.VARIANTS)
    with pytest.raises(SystemExit):
        # the same question in other words
        main(["fork", "argon/crystal-108", "--vary", "processes", "--steps", str(STEPS), "--no-report"])
    said = capsys.readouterr().out
    assert re.search(r"reversed +step 2 +6 +2\.\d+e-13", said) and "(the reference)" in said
    assert re.search(r"- +SSE4\.2 +took longer than 600 s", said)


def test_what_a_process_says_stays_out_of_the_output(tmp_path, monkeypatch, capfd):
    talker = tmp_path / "python"
    talker.write_text('#!/bin/sh\necho spam\necho "  it broke " >&2\nexit 3\n')
    talker.chmod(talker.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(sys, "executable", str(talker))
    row, x = variants._process(variants.REFERENCE, tmp_path, 0, 3)
    assert x is None and row.failed == "it broke"
    assert capfd.readouterr().out == ""


def test_a_process_that_takes_too_long_is_a_row(tmp_path, monkeypatch):
    def never(command, timeout, **_):
        raise subprocess.TimeoutExpired(command, timeout)

    monkeypatch.setattr(subprocess, "run", never)
    row, x = variants._process(variants.REFERENCE, tmp_path, 0, 3)
    assert x is None and row.failed == f"took longer than {variants._TIMEOUT} s"
