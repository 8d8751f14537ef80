"""Precisions against exact arithmetic and programs against each other, into a folder: tables and verdict."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import mdnum
from mdnum.forks import processes
from mdnum.forks.exact.certify import MD_POLICIES
from mdnum.forks.exact.program import installed
from mdnum.forks.processes import Ran, Variant
from mdnum.store import RunFolder
from mdnum.systems import load
from mdnum.verbs.fork_certify import judge_certify
from mdnum.verbs.frame import View

STEPS = 240
#: Heights that sums and products of few digits reach: plain rationals follow it.
SMALL = {
    "contact.k": 512, "integrator.timestep": 0.015625, "start.height": 0.40625, "flight.gravity": 9.75,
}  # fmt: skip
FEW = {"bfloat16": {"state": "bfloat16", "arithmetic": "bfloat16", "decision": "bfloat16"}, "float64": {}}


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """The crystal whose shell lies at a hard cutoff, a little further than single precision keeps to it."""
    few = {name: MD_POLICIES[name] for name in ("float32", "float64")}
    out = tmp_path_factory.mktemp("certified") / "crystal"
    return mdnum.fork_certify("argon/crystal-108", steps=STEPS, policies=few, out=out)


# two precisions of a run, the exact one, and a second look at every decision
@pytest.mark.slow
@pytest.mark.skipif(not installed(), reason="needs python-flint")
def test_the_tables_hold_the_certificate(certified):
    folder = RunFolder.open(certified.folder)
    table, ranking = folder.read("policies"), certified.result.ranking
    assert table["policy"].tolist() == [row.name for row in ranking] == ["float64", "float32"]
    assert table["horizon"].tolist() == [-1 if row.horizon is None else row.horizon for row in ranking]
    assert 0 < table["horizon"][1] < STEPS and table["horizon"][0] == -1
    assert table["force"].tolist() == ["float64", "float32"]
    apart = folder.read("policy_separations")
    for row in ranking:
        np.testing.assert_array_equal(apart["separation"][apart["policy"] == row.name], row.separation)
    # seven digits and sixteen
    last = [apart["separation"][apart["policy"] == name][20] for name in ("float32", "float64")]
    assert last[0] > 1e4 * last[1] > 0
    ambiguous, numbers = folder.read("ambiguous"), certified.summary["ambiguous"]
    assert set(numbers) == {"float32", "float64"} and numbers["float32"]["total"] > 0
    for name, one in numbers.items():
        mine = ambiguous["policy"] == name
        assert one["total"] == np.count_nonzero(mine)
        assert one["horizon"] == (ambiguous["step"][mine].min() if one["total"] else None)
    assert np.all(np.abs(ambiguous["margin"]) <= ambiguous["bound"])
    # exact arithmetic decides by the sign of the exact margin
    np.testing.assert_array_equal(ambiguous["wrong"], ambiguous["inside"] != (ambiguous["exact"] > 0))
    figures = sorted(path.stem for path in (certified.folder / "figures").iterdir())
    assert figures == ["ranking", "separations"]


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    out = tmp_path_factory.mktemp("certified") / "ball"
    return mdnum.fork_certify("ball/drop", steps=80, policies=FEW, overrides=SMALL, out=out)


def test_a_ball_is_certified(ball, tmp_path):
    rows = {row["name"]: row for row in ball.summary["policies"]}
    assert ball.result.steps == 80 and rows["float64"]["horizon"] is None
    assert rows["bfloat16"]["horizon"] == ball.result.ranking[1].horizon > 0
    assert (rows["bfloat16"]["channel"], rows["bfloat16"]["subject"]) == ("contact", [0])
    assert rows["bfloat16"]["arithmetic"] == "bfloat16" and rows["bfloat16"]["accumulate"] == "float64"
    loaded = load("ball/drop", SMALL)
    again = mdnum.fork_certify(loaded, steps=80, policies=FEW, out=tmp_path / "x", report=False)
    assert again.summary["policies"] == ball.summary["policies"]


def test_who_leaves_first_is_the_headline(ball):
    def judged(*horizons, **more):
        rows = [{**row, "horizon": at} for row, at in zip(ball.summary["policies"], horizons, strict=True)]
        return judge_certify(View(RunFolder.open(ball.folder), {**ball.summary, "policies": rows, **more}))

    assert judged(None, None).tone == "good"
    some = judged(None, 40)
    assert some.tone == "info" and "bfloat16" in some.headline and "step 40" in some.headline
    assert judged(70, 40).headline.startswith("At no precision")
    wrong = {"float64": {"total": 1, "horizon": 5, "wrong": 9}}
    assert [one.code for one in judged(None, None, ambiguous=wrong).findings] == ["WRONG_DECISION"]


#: First step at which a program leaves the loop that the others are compared with, and how fast.
LEAVES, FEW_STEPS = {"AVX": (3, 1e-15), "reversed": (2, 4e-15)}, 6


def stand_in(variant: Variant, question, file):
    """A process that takes no time: its positions leave the start's from a given step on."""
    if variant.name == "SSE4.2":
        return Ran(variant, (), "took longer than 600 s", 0.5), None
    first, rate = LEAVES.get(variant.name, (FEW_STEPS + 1, 0.0))
    steps = question["steps"]
    x = np.tile(load(question["path"], world="md").atoms.positions.T, (steps, 1, 1))
    for step in range(first, steps + 1):
        x[step - 1, 0, 7] += rate * 2.0**step
    return Ran(variant, tuple(row.tobytes().hex()[:4096] for row in x), "", 0.5), x


def test_the_folder_holds_clusters_dates_and_separations(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "_ran", stand_in)
    names = ("again", "eager", "rollout", "AVX", "reversed", "SSE4.2")
    which = [processes.REFERENCE, *map(Variant, names)]
    compared = mdnum.fork_processes("argon/crystal-108", steps=FEW_STEPS, which=which, out=tmp_path / "x")
    folder, summary = RunFolder.open(compared.folder), compared.summary
    table = folder.read("variants")
    assert table["variant"].tolist() == ["scan", *names]
    assert table["cluster"].tolist() == [0, 0, 0, 0, 1, 2, -1]
    assert table["first_bit"].tolist() == [-1, -1, -1, -1, 3, 2, -1]
    np.testing.assert_allclose(table["separation"][:6], [0, 0, 0, 0, 64e-15, 256e-15], rtol=0.05)
    apart = folder.read("variant_separations")
    mine = apart["separation"][apart["variant"] == "AVX"]
    assert len(mine) == FEW_STEPS and not mine[:2].any() and mine[2] == pytest.approx(8e-15, rel=0.2)
    assert summary["clusters"] == [["scan", "again", "eager", "rollout"], ["AVX"], ["reversed"]]
    two = mdnum.fork_processes("argon/crystal-108", steps=FEW_STEPS, which=which[:2], out=tmp_path / "y")
    assert two.summary["clusters"] == [["scan", "again"]] and two.verdict.tone == "good"
    # a program that failed is named and does not stop the others
    (finding,) = compared.verdict.findings
    assert finding.code == "VARIANT_FAILED" and finding.values["failed"] == "took longer than 600 s"
    assert (compared.folder / "report.html").exists()
    (programs,) = (one for one in compared.page.sections if one.title == "Programs")
    rows = {row[1]: row for row in programs.parts[-1].rows}
    assert rows["reversed"][4:6] == (2, 6) and rows["SSE4.2"][2] == "took longer than 600 s"


@pytest.mark.parametrize(
    ("does", "failed"),
    [('echo spam\necho "  it broke " >&2\nexit 3', "it broke"), ("exec sleep 60", "took longer than 1 s")],
    ids=["fails", "hangs"],
)
def test_a_process_that_fails_or_takes_too_long_is_a_row(does, failed, tmp_path, monkeypatch, capfd):
    """With a script in place of Python; what it says stays out of the output."""
    script = tmp_path / "python"
    script.write_text(f"#!/bin/sh\n{does}\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    monkeypatch.setattr(processes, "_TIMEOUT", 1.0)
    row, x = processes._ran(processes.REFERENCE, {}, tmp_path / "0")
    assert x is None and row.failed == failed and capfd.readouterr().out == ""
