"""`mdnum conform` as a person calls it."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from command_line import call, printed

from mdnum.references.conformance.case import once
from mdnum.references.conformance.loading import from_object
from mdnum.references.conformance.suite import examine
from mdnum.report.conform.findings import judge
from mdnum.store import RunFolder
from mdnum.workflow.conform import _summary

_MINE = """
import numpy as np

def nearest_image(positions, cell, pbc, r_cut):
    i, j = np.triu_indices(len(positions), 1)
    apart = positions[j] - positions[i]
    if pbc.all():
        apart = apart - np.rint(apart @ np.linalg.inv(cell)) @ cell
    near = (apart**2).sum(axis=1) < r_cut**2
    return i[near], j[near]

def without_pbc(positions, cell, r_cut):
    return [], []

def mask(positions, cell, pbc, r_cut):
    return np.zeros((len(positions), len(positions)), bool)

def returns_nothing(positions, cell, pbc, r_cut):
    nearest_image(positions, cell, pbc, r_cut)

def raises(positions, cell, pbc, r_cut):
    return positions.numpy()

class Half:
    def allocate(self, positions, cell, pbc, r_cut, skin):
        return [], []

class Sized(Half):
    def __init__(self, size):
        self.size = size
    def update(self, positions, cell):
        return [], []

class Short(Half):
    def update(self, positions):
        return [], []
"""


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "mine.py").write_text(_MINE)
    (tmp_path / "empty.py").touch()
    (tmp_path / "broken.py").write_text("def pairs(:\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_list_of_ones_own(mine: Path, capsys: pytest.CaptureFixture[str]):
    """Findings, scripts that reproduce them in another process, a page, and the same page again."""
    assert call("conform", "mine.py:nearest_image", "--cases", "20", "--no-large") == 1
    lines = printed(capsys)
    assert lines[0].startswith("mine:nearest_image failed")
    assert any(line.startswith("error: pairs inside the cutoff are missing") for line in lines)
    folder = mine / "runs" / "conform-mine-nearest_image-1"
    page = (folder / "report.html").read_text()
    assert "reproduce-1-missing.py" in page and "<svg" in page and "cells narrower than two cutoffs" in page
    scripts = sorted(folder.glob("reproduce-*.py"))
    assert scripts
    done = subprocess.run([sys.executable, scripts[0]], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "the list is wrong" in done.stdout, done.stderr
    summary = RunFolder.open(folder).summary
    assert not summary["conforms"] and summary["full"] is False and summary["superset"] is False
    assert RunFolder.open(folder).world == "conform"
    areas = RunFolder.open(folder).read("areas")
    assert dict(zip(areas["area"], areas["failed"], strict=True))["images"] > 5
    assert list(RunFolder.open(folder).read("failures")["script"]) == [path.name for path in scripts]
    (folder / "report.html").unlink()
    assert call("report", str(folder)) == 0
    assert (folder / "report.html").read_text() == page


def test_limits_make_it_conform(mine: Path, capsys: pytest.CaptureFixture[str]):
    limits = "minimum-image,orthorhombic,all-axes"
    arguments = ("conform", "mine.py:nearest_image", "--cases", "10", "--no-large", "--limits", limits)
    assert call(*arguments, "--json", "--no-report", "-o", "out") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["conforms"] and not document["findings"] and document["wrong"] == 0
    assert sum(row["skipped"] for row in document["areas"]) > 20
    assert "gave the right pairs in all of" in document["headline"]
    assert not (mine / "out" / "report.html").exists()


def test_names_are_listed(capsys: pytest.CaptureFixture[str]):
    assert call("conform") == 0
    said = "\n".join(printed(capsys))
    assert "vesin" in said and "not installed" in said and "package.module:function" in said
    assert call("conform", "--json") == 0
    rows = json.loads(capsys.readouterr().out)["lists"]
    assert {"list", "version", "kept", "what"} == set(rows[0])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nowhere:pairs",), "cannot be imported"),
        (("vesim",), "no list that is known"),
        (("vesim",), "Did you mean vesin?"),
        (("mine.py:zebra",), "It has nearest_image"),
        (("mine.py:nearest",), "Did you mean nearest_image?"),
        (("mine.py",), "mine.py is a file, and not a function in it. Give mine.py:nearest_image"),
        (("empty.py:pairs",), "It has no function"),
        (("broken.py:pairs",), "(broken.py, line 1). Mend that line"),
        (("mine.py:np",), "neither a function nor an object with allocate and update"),
        (
            ("mine.py:without_pbc",),
            "(positions, cell, r_cut) cannot be called with (positions, cell, pbc, r_cut)",
        ),
        (("mine.py:Half",), "a class without update. A list that is kept needs allocate and update"),
        (("mine.py:Sized",), "Sized(size) cannot be called with ()"),
        (("mine.py:Short",), "update(self, positions) cannot be called with (positions, cell)"),
        (
            ("mine.py:mask",),
            "asked about a triple through a face, it returned ndarray of shape (3, 3), not (i, j)",
        ),
        (("mine.py:returns_nothing",), "it returned None. Give a function of (positions, cell, pbc, r_cut)"),
        (("mine.py:raises",), "it raised AttributeError: 'numpy.ndarray' object has no attribute 'numpy'"),
        (("mine.py:nearest_image", "--limits", "tilted"), "no limit is called 'tilted'"),
        (("mine.py:nearest_image", "--precision", "double"), "float64, float32"),
    ],
)
def test_mistakes_are_told(mine: Path, arguments, said: str, capsys: pytest.CaptureFixture[str]):
    assert call("conform", *arguments) == 2
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1
    assert not (mine / "runs").exists()


def _judged(function, cases):
    """Verdict on a function that was asked some cases."""
    found = examine(from_object(function, "it"), asked=cases, large=False)
    names = [f"{number}.py" for number in range(len(found.failed))]
    return judge(cast(Any, SimpleNamespace(name="it", summary=_summary(found, names, 0))))


def test_what_refuses_everything_is_not_called_safe():
    def refuses(positions, cell, pbc, r_cut):
        raise RuntimeError("boom")

    two = [[0.0, 0, 0], [0.5, 0, 0]]
    judged = _judged(refuses, [once("none", "few", []), once("two", "few", two), once("two", "images", two)])
    assert judged.headline == "it answered no question."
    codes = {one.code: one for one in judged.findings}
    assert set(codes) == {"NOTHING_ANSWERED", "RAISED"} and codes["NOTHING_ANSWERED"].severity == "error"
    assert "boom" in codes["NOTHING_ANSWERED"].text


def test_what_answers_rightly_or_not_at_all_is_told_as_that():
    def far(positions, cell, pbc, r_cut):
        if np.abs(positions).max(initial=0.0) > 1.0:
            raise IndexError("no such bin")
        return ([0, 1], [1, 0]) if len(positions) == 2 else ([], [])

    tested = [once("two", "few", [[0.0, 0, 0], [0.5, 0, 0]]), once("far", "outside", [[2.0, 0, 0]])]
    judged = _judged(far, tested)
    assert judged.headline == (
        "it raises an exception by accident in 1 of 2 cases; in the 1 that it answered, the pairs are right."
    )
    assert any(line == "Where it fails: outside (1 of 1)." for line in judged.evidence)


def test_what_ends_the_process_is_not_told_as_right():
    """The headline is that of the worst below it, and its counts are those of the table."""

    def leaves(positions, cell, pbc, r_cut):
        if len(positions) == 3:
            raise SystemExit(3)
        return ([0, 1], [1, 0]) if len(positions) == 2 else ([], [])

    two = [[0.0, 0, 0], [0.5, 0, 0]]
    cases = [once("two", "few", two), once("four", "few", [*two, [0, 5, 0], [0, 9, 0]])]
    cases.append(once("three", "outside", [*two, [5.0, 0, 0]]))
    judged = _judged(leaves, cases)
    assert judged.tone == "error"
    assert judged.headline == "it failed 2 of 3 cases."  # the pair of the four is missing, too
    judged = _judged(leaves, cases[::2])
    assert judged.tone == "error"
    assert judged.headline == (
        "it ends the process in 1 of 2 cases; in the 1 that it answered, the pairs are right."
    )


def test_what_fails_only_after_another_goes_below_it():
    """A list that is left broken by a question that it fails: one cause, one finding."""
    broken = []

    def breaks(positions, cell, pbc, r_cut):
        if len(positions) == 4:
            broken.append(True)
            return [0], [1]  # from one of its atoms only
        return ([0, 1, 1], [1, 0, 0]) if broken and len(positions) == 2 else ([0, 1], [1, 0])

    two = [[0.0, 0, 0], [0.5, 0, 0]]
    cases = [
        once("two", "few", two),
        once("four", "few", [*two, [5.0, 0, 0], [9.0, 0, 0]]),
        once("again", "outside", two),
    ]
    found = examine(from_object(breaks), asked=cases, large=False, shrink=False)
    assert sorted(failed.code for failed in found.failed) == ["DUPLICATE", "ONE_SIDED"]
    found.failed = [replace(failed, alone=failed.code == "ONE_SIDED") for failed in found.failed]
    summary = _summary(found, ["1.py", "2.py"], 0)
    judged = judge(cast(Any, SimpleNamespace(name="it", summary=summary)))
    (finding,) = judged.findings
    assert (
        finding.code == "ONE_SIDED"
        and "pairs are listed more than once (about outside; 2.py)" in finding.text
    )
    # by themselves they are two
    found.failed = [replace(failed, alone=True) for failed in found.failed]
    judged = judge(cast(Any, SimpleNamespace(name="it", summary=_summary(found, ["1.py", "2.py"], 0))))
    assert len(judged.findings) == 2


def test_time_that_is_up_is_told():
    """How many of how many were asked; and what was not asked is not called right."""

    class TwoQuestions:
        left = 3

        @property
        def passed(self) -> bool:
            self.left -= 1
            return self.left <= 0

    def right(positions, cell, pbc, r_cut):
        return ([0, 1], [1, 0]) if len(positions) == 2 else ([], [])

    two = [[0.0, 0, 0], [0.5, 0, 0]]
    cases = [once(f"{n}", "few", two) for n in range(5)]
    found = examine(from_object(right), asked=cases, deadline=cast(Any, TwoQuestions()))
    assert (found.asked, found.left, found.questions) == (2, 3, 5)
    judged = judge(cast(Any, SimpleNamespace(name="it", summary=_summary(found, [], 0))))
    assert judged.headline == "As far as asked (2 of 5 cases), it gave the right pairs in 2 cases."


_ENDS = """
import os, signal
from pathlib import Path

import numpy as np

calls = 0

def nearest_image(positions, cell, pbc, r_cut):
    global calls
    calls += 1
    if calls > 75 and Path("armed").exists():
        Path("armed").unlink()
        os.kill(os.getppid(), signal.SIGKILL)
    i, j = np.triu_indices(len(positions), 1)
    apart = positions[j] - positions[i]
    if pbc.all():
        apart = apart - np.rint(apart @ np.linalg.inv(cell)) @ cell
    near = (apart**2).sum(axis=1) < r_cut**2
    near &= apart.any(axis=1)
    return i[near], j[near]
"""


def test_an_examination_that_is_killed_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """By SIGKILL: what was found is there, and its summary is that of one that was not stopped."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ends.py").write_text(_ENDS)
    limits = "minimum-image,orthorhombic,all-axes"
    asked = (
        "conform",
        "ends.py:nearest_image",
        "--cases",
        "5",
        "--no-large",
        "--no-report",
        "--limits",
        limits,
    )
    assert call(*asked, "-o", "whole") == 1
    (tmp_path / "armed").touch()
    done = subprocess.run(
        [sys.executable, "-m", "mdnum", *asked, "-o", "killed"], capture_output=True, check=False
    )
    assert done.returncode == -9 and not (tmp_path / "armed").exists()
    kept = json.loads((tmp_path / "killed" / "answers.json").read_text())
    wrong = [one for one in kept["cases"].values() if one["failures"]]
    assert 20 < len(kept["cases"]) < 120 and wrong
    before = RunFolder.open("killed").summary
    assert before["status"] == "stopped" and before["left"] > 20
    assert call("report", "killed") == 0
    assert "As far as asked (" in (tmp_path / "killed" / "report.html").read_text()
    capsys.readouterr()
    assert call("conform", "mine", "--resume", "killed") == 2
    assert "so LIST cannot be given" in capsys.readouterr().err
    assert call("conform", "--resume", "killed", "--no-report") == 1
    whole, resumed = RunFolder.open("whole").summary, RunFolder.open("killed").summary
    assert {**whole, "seconds": 0} == {**resumed, "seconds": 0} and whole["status"] == "complete"
    for name in ("areas", "failures"):
        assert RunFolder.open("whole").table(name).equals(RunFolder.open("killed").table(name))
    scripts = sorted(path.name for path in (tmp_path / "whole").glob("reproduce-*.py"))
    assert scripts and scripts == sorted(path.name for path in (tmp_path / "killed").glob("reproduce-*.py"))
    # nothing is asked again of one that is whole
    assert call("conform", "--resume", "killed", "--no-report", "--time", "1e-6") == 1
    assert RunFolder.open("killed").summary["asked"] == whole["asked"]


@pytest.mark.parametrize("text", ["", "[]", "3", "{}", '{"list": 1, "tested": 2, "options": 3}', "\0{"])
def test_answers_that_cannot_be_read_are_told_in_a_line(text: str, tmp_path, capsys):
    (tmp_path / "answers.json").write_text(text)
    assert call("conform", "--resume", str(tmp_path)) == 2
    told = capsys.readouterr().err
    assert "answers.json" in told and told.count("\n") == 1


def test_one_mistake_has_one_script_and_names_all_areas():
    def leaves(positions, cell, pbc, r_cut):
        raise SystemExit(3)

    def nothing(positions, cell, pbc, r_cut):
        return [], []

    two = [[0.0, 0, 0], [0.5, 0, 0]]
    cases = [once(area, area, [*two, [n, 2.0, 3.0]], 4.0) for n, area in enumerate(("few", "boxes", "ties"))]
    judged = _judged(leaves, [*cases, once("free", "axes", two)])
    (crashed,) = (one for one in judged.findings if one.code == "CRASHED")
    assert crashed.text.startswith("In 4 cases, in every area. ")
    assert crashed.remedy.startswith("Raise an exception")
    judged = _judged(nothing, [*cases, once("none", "axes", [[0.0, 0, 0]])])
    (missing,) = (one for one in judged.findings if one.code == "MISSING")
    assert missing.text.startswith("In 3 cases, about few, boxes and ties. ")
    report = examine(from_object(nothing), asked=[*cases, once("images", "images", two, 0.7)], large=False)
    assert [(failed.code, failed.case.atoms) for failed in report.failed] == [("MISSING", 2), ("MISSING", 1)]
