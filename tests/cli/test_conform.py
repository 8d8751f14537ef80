"""`mdnum conform`: a list of one's own, limits, mistakes, refusals, what is known of a list, and a kill."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from time import monotonic, sleep
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import planted_lists
import pytest
from command_line import call, printed

from mdnum.deadline import Deadline
from mdnum.references.conformance.case import once
from mdnum.references.conformance.judge import Report
from mdnum.references.conformance.lists import from_object
from mdnum.references.conformance.questions import plan
from mdnum.references.conformance.suite import examine
from mdnum.report.finding import Finding, Verdict
from mdnum.store import RunFolder
from mdnum.verbs.conform import judge, summary_of
from mdnum.verbs.frame import layout

_MINE = """
import numpy as np

def nearest_image(positions, cell, pbc, r_cut):
    i, j = np.triu_indices(len(positions), 1)
    apart = positions[j] - positions[i]
    if pbc.all():
        apart = apart - np.rint(apart @ np.linalg.inv(cell)) @ cell
    near = (apart**2).sum(axis=1) < r_cut**2
    return i[near], j[near]

def made(scale):
    return nearest_image

def without_pbc(positions, cell, r_cut):
    return [], []

def mask(positions, cell, pbc, r_cut):
    return np.zeros((len(positions), len(positions)), bool)

def returns_nothing(positions, cell, pbc, r_cut):
    nearest_image(positions, cell, pbc, r_cut)

def raises(positions, cell, pbc, r_cut):
    return positions.numpy()

def needs_a_package(positions, cell, pbc, r_cut):
    import nowhere_to_be_found.deeper

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


def test_limits_make_it_conform(mine: Path, capsys: pytest.CaptureFixture[str]):
    limits = "minimum-image,orthorhombic,all-axes"
    arguments = ("conform", "mine.py:nearest_image", "--cases", "4", "--no-large", "--limits", limits)
    assert call(*arguments, "--json", "--no-report", "-o", "out") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["conforms"] and not document["findings"] and document["wrong"] == 0
    assert sum(row["skipped"] for row in document["areas"]) > 20
    assert not (mine / "out" / "report.html").exists()


def test_names_are_listed(capsys: pytest.CaptureFixture[str]):
    assert call("conform") == 0
    assert {"vesin", "numpy", "jax-md-kept"} <= {line.split()[0] for line in printed(capsys) if line}
    assert call("conform", "--json") == 0
    rows = json.loads(capsys.readouterr().out)["lists"]
    assert {"list", "version", "lacks", "kept", "what"} == set(rows[0])
    for row in rows:
        assert (row["version"] is None) == (row["list"] in {one["list"] for one in rows if one["lacks"]})


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("nowhere:pairs",), "nowhere: cannot be imported"),
        (("vesim",), "Did you mean vesin?"),
        (("mine.py:zebra",), "It has nearest_image"),
        (("mine.py:nearest",), "Did you mean nearest_image?"),
        (("mine.py",), "Give mine.py:nearest_image"),
        (("empty.py:pairs",), "It has no function"),
        (("broken.py:pairs",), "(broken.py, line 1)"),
        (("mine.py:np",), "neither … with allocate and"),
        (("mine.py:without_pbc",), "without_pbc … (positions, cell, pbc, r_cut): too"),
        (("mine.py:Half",), "has no update"),
        (("mine.py:Sized",), "Sized(size) cannot be called … (): missing"),
        (("mine.py:Sized(1, 2)",), "could not be constructed: TypeError"),
        (("mine.py:Short",), ".update(positions) … (positions, cell): too"),
        (("mine.py:mask",), "ndarray of shape (3, 3), not (i, j)"),
        (("mine.py:returns_nothing",), "it returned None"),
        (("mine.py:needs_a_package",), "Run python3 -m pip install nowhere_to_be_found"),
        (("mine.py:raises",), "AttributeError: 'numpy.ndarray' object has no attribute 'numpy'"),
        (("mine.py:nearest_image", "--limits", "tilted"), "unknown limit 'tilted'"),
        (("mine.py:nearest_image", "--precision", "double"), "float64, float32"),
    ],
)
def test_mistakes_are_one_line(mine: Path, arguments, part: str, capsys: pytest.CaptureFixture[str]):
    assert call("conform", *arguments) == 2
    line = capsys.readouterr().err
    assert all(each in line for each in part.split(" … ")) and line.count("\n") == 1
    assert not (mine / "runs").exists()


def _verdict(found: Report) -> Verdict:
    names = [f"{n}.py" for n in range(len(found.failed))]
    folder = SimpleNamespace(path=Path("it"))
    return judge(cast(Any, SimpleNamespace(name="it", summary=summary_of(found, names, 0), folder=folder)))


def _judged(function, cases, **options) -> tuple[Verdict, dict[str, Finding]]:
    """Verdict on a function that was asked some cases, and its findings by code."""
    tested = from_object(function, "it").with_options(**options)
    verdict = _verdict(examine(tested, asked=cases, large=False))
    return verdict, {finding.code: finding for finding in verdict.findings}


_PLACES = [[0.0, 0, 0], [0.5, 0, 0]]
_TWO = once("two", "few", _PLACES, 4.0)
_THREE = once("three", "images", [[0.1, 0, 0], [0.5, 0, 0], [0.6, 0, 0]], 4.0)


def test_what_refuses_everything_is_not_called_safe():
    def refuses(positions, cell, pbc, r_cut):
        raise RuntimeError("boom")

    cases = [once("none", "few", []), once("two", "few", _PLACES), once("two", "images", _PLACES)]
    verdict, findings = _judged(refuses, cases)
    assert set(findings) == {"NOTHING_ANSWERED", "RAISED"} and verdict.tone == "error"
    assert "boom" in findings["NOTHING_ANSWERED"].text


def _leaves(positions, cell, pbc, r_cut):
    if len(positions) == 3:
        raise SystemExit(3)
    return ([0, 1], [1, 0]) if len(positions) == 2 else ([], [])


def _far(positions, cell, pbc, r_cut):
    if np.abs(positions).max(initial=0.0) > 1.0:
        raise IndexError("no such bin")
    return ([0, 1], [1, 0]) if len(positions) == 2 else ([], [])


@pytest.mark.parametrize(
    ("function", "code", "tone", "places"),
    [(_far, "RAISED", "warning", [[2.0, 0, 0]]), (_leaves, "CRASHED", "error", [*_PLACES, [5.0, 0, 0]])],
)
def test_no_answer_is_told_from_a_wrong_one(function, code: str, tone: str, places):
    """The headline is that of the worst below it, and its counts are those of the table."""
    cases = [once("two", "few", _PLACES), once("other", "outside", places)]
    verdict, findings = _judged(function, cases)
    assert set(findings) == {code} and verdict.tone == tone
    assert findings[code].values["cases"] == 1 and "1 of 2 test cases" in verdict.headline
    cases.append(once("four", "few", [*_PLACES, [0, 0.9, 0], [0, 0.95, 0]]))
    verdict, findings = _judged(function, cases)
    assert "2 of 3 test cases" in verdict.headline  # pairs of the four are missing, too


def test_what_fails_only_after_another_goes_below_it():
    """A list that is left broken by a question that it fails: one cause, one finding."""
    broken = []

    def breaks(positions, cell, pbc, r_cut):
        if len(positions) == 4:
            broken.append(True)
            return [0], [1]  # from one of its atoms only
        return ([0, 1, 1], [1, 0, 0]) if broken and len(positions) == 2 else ([0, 1], [1, 0])

    cases = [
        once("two", "few", _PLACES),
        once("four", "few", [*_PLACES, [5.0, 0, 0], [9.0, 0, 0]]),
        once("again", "outside", _PLACES),
    ]
    found = examine(from_object(breaks, "it"), asked=cases, large=False, shrink=False)
    assert sorted(failed.code for failed in found.failed) == ["DUPLICATE", "ONE_SIDED"]
    for alone in (False, True):
        found.failed = [replace(failed, alone=alone or failed.code == "ONE_SIDED") for failed in found.failed]
        causes = {finding.code: finding.cause for finding in _verdict(found).findings}
        assert causes == {"DUPLICATE": "" if alone else "ONE_SIDED", "ONE_SIDED": ""}


def test_time_that_is_up_is_reported():
    """How many of how many were asked; and what was not asked is not called right."""

    class TwoQuestions(Deadline):
        more = 3

        @property
        def passed(self) -> bool:
            self.more -= 1
            return self.more <= 0

    cases = [once(f"{n}", "few", _PLACES) for n in range(5)]
    found = examine(from_object(_leaves, "it"), asked=cases, deadline=TwoQuestions())
    assert (found.asked, found.left, found.questions) == (2, 3, 5)
    assert "2 of 5 test cases" in _verdict(found).headline


def test_one_mistake_has_one_script_and_names_all_areas():
    def leaves(positions, cell, pbc, r_cut):
        raise SystemExit(3)

    def nothing(positions, cell, pbc, r_cut):
        return [], []

    areas = ("few", "boxes", "ties")
    cases = [once(area, area, [*_PLACES, [n, 2.0, 3.0]], 4.0) for n, area in enumerate(areas)]
    _, findings = _judged(leaves, [*cases, once("free", "axes", _PLACES)])
    values = findings["CRASHED"].values
    assert (values["cases"], values["areas"]) == (4, "every area")
    assert findings["CRASHED"].remedy.startswith("Raise an exception")
    _, findings = _judged(
        nothing,
        [*cases, once("none", "axes", [[0.0, 0, 0]])],
        known={"MISSING": "It lists none.", "EXTRA": "It lists all."},
    )
    values = findings["MISSING"].values
    assert (values["cases"], values["areas"]) == (3, "few, boxes and ties")
    assert findings["MISSING"].text.endswith("It lists none.")  # what is known of a failure
    images = once("images", "images", _PLACES, 0.7)
    report = examine(from_object(nothing), asked=[*cases, images], large=False)
    assert [(failed.code, failed.case.atoms) for failed in report.failed] == [("MISSING", 2), ("MISSING", 1)]


class _Elsewhere:
    """A part of an answer that lies on another device."""

    def __array__(self, *_):
        raise TypeError("copy it to the host first")


@pytest.mark.parametrize("form", ["mapping", "tuple", "rows", "attributes"])
def test_buffers_that_are_returned_again_are_reported(form: str):
    buffer = np.zeros((2, 100), int)

    def filled(positions, cell, pbc, r_cut):
        rows = planted_lists.search(positions, cell, pbc, r_cut)
        count = len(rows["i"])
        buffer[0, :count], buffer[1, :count] = rows["i"], rows["j"]
        i, j = buffer[:, :count]
        return {
            "mapping": {"i": i, "j": j, "energy": _Elsewhere()},
            "tuple": (i, j),
            "rows": buffer[:, :count].T,
            "attributes": SimpleNamespace(i=i, j=j),
        }[form]

    _, findings = _judged(filled, [_TWO, _THREE])
    assert {code: finding.severity for code, finding in findings.items()} == {"ALIASED": "info"}
    assert findings["ALIASED"].values["case"] == "two"  # after what its conventions are found by
    assert _judged(planted_lists.planted(""), [_TWO, _THREE])[1] == {}


def _refusing(when):
    def refuses(positions, cell, pbc, r_cut):
        if when(positions, r_cut):
            raise ValueError(f"{len(positions)} atoms are too many.")
        rows = planted_lists.search(positions, cell, pbc, r_cut)
        return rows["i"], rows["j"]

    return refuses


def test_a_refusal_that_depends_on_what_it_should_not_is_a_finding():
    """The order of atoms, or what was asked before; not another unit of length, nor other images."""
    _, findings = _judged(_refusing(lambda x, _: len(x) > 1 and x[0, 0] < x[-1, 0]), [_TWO, _THREE])
    assert findings["UNEVEN_REFUSALS"].severity == "warning"
    how = findings["UNEVEN_REFUSALS"].values["how"]
    assert how.endswith("in reverse order") and "anew" not in how
    asked = []

    def second(x, _):
        asked.append(len(x))
        return len(asked) == 3  # the first finds out its conventions

    _, findings = _judged(_refusing(second), [_TWO, _THREE])
    assert "asked anew" in findings["UNEVEN_REFUSALS"].values["how"]
    outside = once("outside", "outside", [[0.25, 0, 0], [4.5, 0, 0]], 4.0, r_cut=4 / 3)
    _, findings = _judged(_refusing(lambda x, _: x.max() > 4.0), [_TWO, outside])
    assert set(findings) == {"REFUSES"}  # and nothing uneven
    assert "wrapped into the box" in findings["REFUSES"].values["also"]
    far = once("far", "few", 8 * _TWO.stills[0].positions, 40.0, r_cut=8.0)
    _, findings = _judged(_refusing(lambda _, r_cut: r_cut > 4.0), [_TWO, far])
    assert "lengths multiplied by 0.12" in findings["REFUSES"].values["also"]


_ENDS = """
import os, signal
from pathlib import Path

from mine import nearest_image

calls = 0

def drops_coincident(positions, cell, pbc, r_cut):
    global calls
    calls += 1
    if calls > 75 and Path("armed").exists():
        Path("armed").unlink()
        os.kill(os.getppid(), signal.SIGKILL)
    i, j = nearest_image(positions, cell, pbc, r_cut)
    apart = (positions[i] != positions[j]).any(axis=1)
    return i[apart], j[apart]
"""


def test_an_examination_that_is_killed_is_resumed(mine: Path, capsys: pytest.CaptureFixture[str]):
    """By SIGKILL: what was found is there, and its summary is that of one that was not stopped."""
    (mine / "ends.py").write_text(_ENDS)
    limits = "minimum-image,orthorhombic,all-axes"
    asked = f"conform ends.py:drops_coincident --cases 2 --no-large --no-report --limits {limits}".split()
    assert call(*asked, "-o", "whole") == 1
    (mine / "armed").touch()
    done = subprocess.run(
        [sys.executable, "-m", "mdnum", *asked, "-o", "killed"], capture_output=True, check=False
    )
    assert done.returncode == -9 and not (mine / "armed").exists()
    kept = json.loads((mine / "killed" / "answers.json").read_text())
    wrong = [result for result in kept["cases"].values() if result["failures"]]
    assert 20 < len(kept["cases"]) < 120 and wrong
    before = RunFolder.open("killed").summary
    assert before["status"] == "stopped" and before["left"] > 20
    assert call("report", "killed") == 0
    assert "mdnum conform --resume killed" in (mine / "killed" / "report.html").read_text()
    capsys.readouterr()
    assert call("conform", "mine", "--resume", "killed") == 2
    assert "LIST" in capsys.readouterr().err
    assert call("conform", "--resume", "killed", "--no-report") == 1
    whole, resumed = RunFolder.open("whole").summary, RunFolder.open("killed").summary
    assert {**whole, "seconds": 0} == {**resumed, "seconds": 0} and whole["status"] == "complete"
    for name in ("areas", "failures"):
        assert RunFolder.open("whole").table(name).equals(RunFolder.open("killed").table(name))
    scripts = sorted(path.name for path in (mine / "whole").glob("reproduce-*.py"))
    assert scripts and scripts == sorted(path.name for path in (mine / "killed").glob("reproduce-*.py"))
    # nothing is asked again of one that is whole
    assert call("conform", "--resume", "killed", "--no-report", "--time", "1e-6") == 1
    resumed = RunFolder.open("killed").summary
    assert (resumed["asked"], resumed["full"]) == (whole["asked"], whole["full"]) and not resumed["full"]


_ROUNDS = """
import numpy as np
from planted_lists import Kept, search

def rounds(positions, cell, pbc, r_cut, parts=("i", "j", "shift"), rounded=np.float32):
    rows = search(positions.astype(rounded).astype(float), cell, pbc, r_cut)
    return {name: rows[name] for name in parts}

def rounds_and_measures(positions, cell, pbc, r_cut):
    return rounds(positions, cell, pbc, r_cut, ("i", "j", "shift", "distance", "vector"))

def rounds_half(positions, cell, pbc, r_cut):
    rows = rounds(positions, cell, pbc, r_cut)
    once = rows["i"] < rows["j"]
    return rows["i"][once], rows["j"][once]

def declared(positions, cell, pbc, r_cut):
    return rounds_and_measures(positions, cell, pbc, r_cut)

declared.unit = 2.0**-24

def rounds_nothing(positions, cell, pbc, r_cut):
    return rounds(positions, cell, pbc, r_cut, ("i", "j", "shift", "distance"), float)

def rounds_too_much(positions, cell, pbc, r_cut):
    return rounds(positions, cell, pbc, r_cut, ("i", "j", "shift", "distance"), np.float16)

class KeptRounds(Kept):
    def allocate(self, positions, *rest):
        return super().allocate(positions.astype(np.float32).astype(float), *rest)

    def update(self, positions, cell):
        return super().update(positions.astype(np.float32).astype(float), cell)

    def _pairs(self, positions, cell):
        rows = super()._pairs(positions, cell)
        i, j, shift = rows["i"], rows["j"], rows["shift"]
        box = np.where(self.pbc[:, None], cell, 0.0)
        return i, j, shift, np.linalg.norm(positions[j] - positions[i] + shift @ box, axis=1)
"""


@pytest.mark.parametrize(
    ("name", "limits", "code"),
    [
        ("rounds", "", "warning"),
        ("rounds_and_measures", "", "warning"),
        ("rounds_half", "minimum-image", "warning"),
        pytest.param("KeptRounds", "all-axes,orthorhombic", "warning", marks=pytest.mark.nightly),
        # it says so; nothing is rounded; half precision is no single one
        ("declared", "", None),
        ("rounds_nothing", "", None),
        pytest.param("rounds_too_much", "", "error", marks=pytest.mark.nightly),
    ],
)
def test_a_list_that_rounds_positions_to_float32_is_a_warning(
    mine: Path, name: str, limits: str, code, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("mdnum.references.conformance.shrinking.TRIES", 5)  # failures need not be small
    if code == "error":  # nor many
        first = lambda *given, **named: plan(*given, **named)[:1]  # noqa: E731
        monkeypatch.setattr("mdnum.references.conformance.suite.plan", first)
    home = f"import sys\nsys.path.insert(0, {str(Path(planted_lists.__file__).parent)!r})\n"
    (mine / "rounds.py").write_text(home + _ROUNDS)
    asked = ["conform", f"rounds.py:{name}", "--cases", "6", "--no-large", "--no-report", "-o", "out"]
    # the random cases make no difference
    exit_code = call(*asked, *(["--limits", limits] if limits else []), "--time", "3")
    assert exit_code == (code is not None)
    found = {one["code"]: one for one in RunFolder.open("out").summary["findings"]}
    assert {one["severity"] for one in found.values()} == ({code} if code else set()), found
    if code == "warning":
        (finding,) = found.values()
        assert finding["code"] == "SINGLE_PRECISION"
        assert 1e-9 < finding["values"]["length"] < 2e-6 and 2**16 < finding["values"]["times"] <= 2**29


@pytest.mark.parametrize(
    ("name", "limits"),
    [("rounds", ()), ("rounds_half", ("minimum-image", "orthorhombic", "all-axes")), ("rounds", ("free",))],
)
def test_few_questions_show_that_positions_are_rounded(
    mine: Path, name: str, limits: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
):
    """Those that are asked before the others: whoever has a minute is warned, too."""
    first = lambda *given, **named: plan(*given, **named)[:1]  # noqa: E731
    monkeypatch.setattr("mdnum.references.conformance.suite.plan", first)
    home = f"import sys\nsys.path.insert(0, {str(Path(planted_lists.__file__).parent)!r})\n"
    (mine / "rounds.py").write_text(home + _ROUNDS)
    asked = ["conform", f"rounds.py:{name}", "--cases", "0", "--no-report", "-o", "out"]
    assert call(*asked, *(["--limits", ",".join(limits)] if limits else [])) == 1
    (finding,) = RunFolder.open("out").summary["findings"]
    assert (finding["code"], finding["severity"]) == ("SINGLE_PRECISION", "warning")


_HANGS = """
import ctypes, os, signal, time
from pathlib import Path

from mine import nearest_image

calls = dense = 0

def hangs(positions, cell, pbc, r_cut):
    if len(positions) == 24:
        Path("hangs").write_text(str(os.getpid()))
        while Path("python").exists():
            pass
        ctypes.PyDLL(None).sleep(1000)  # no other thread of Python runs meanwhile
    return nearest_image(positions, cell, pbc, r_cut)

def slow(positions, cell, pbc, r_cut):
    time.sleep(0.02)
    return nearest_image(positions, cell, pbc, r_cut)

def ends_at_the_12th(positions, cell, pbc, r_cut):
    global calls
    calls += 1
    if calls == 12:
        os.kill(os.getpid(), signal.SIGSEGV)
    return nearest_image(positions, cell, pbc, r_cut)

def ends_after_a_crowd(positions, cell, pbc, r_cut):
    global dense
    dense, after = len(positions) > 40, dense
    if after:
        os.abort()
    return nearest_image(positions, cell, pbc, r_cut)

def ends_by_chance(positions, cell, pbc, r_cut):
    global calls
    calls += 1
    if calls == 9 and Path("armed").exists():
        Path("armed").unlink()
        os.abort()
    return nearest_image(positions, cell, pbc, r_cut)

class EndsAtAnUpdate:
    def allocate(self, positions, cell, pbc, r_cut, skin):
        self.rest, self.updates = (pbc, r_cut), 0
        return self.update(positions, cell)

    def update(self, positions, cell):
        self.updates += 1
        if self.updates == 5 and len(positions) == 2 and self.along_x(positions):
            os.abort()
        return nearest_image(positions, cell, *self.rest)

    def along_x(self, positions):
        return (positions[0, 1:] == positions[1, 1:]).all()
"""
_LIMITED = ["--no-large", "--limits", "minimum-image,orthorhombic,all-axes"]


def _is_alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
@pytest.mark.parametrize(
    ("by", "how"),
    [
        (signal.SIGTERM, "foreign"),
        (signal.SIGINT, "python"),
        (signal.SIGKILL, "foreign"),
        *(
            pytest.param(*one, marks=pytest.mark.nightly)
            for one in ((signal.SIGTERM, "python"), (signal.SIGINT, "foreign"), (signal.SIGKILL, "python"))
        ),
    ],
)
def test_a_list_that_hangs_does_not_outlive_who_asks_it(mine: Path, by: signal.Signals, how: str):
    """And what it answered until then has a page, which can be written afterward where nothing else can."""
    (mine / "hangs.py").write_text(_HANGS)
    (mine / how).touch()
    command = [sys.executable, "-m", "mdnum", "conform", "hangs.py:hangs", *_LIMITED, "-o", "out"]
    asking = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        _wait_for(lambda: (mine / "hangs").exists() and (mine / "hangs").read_text())
        child = int((mine / "hangs").read_text())
        assert _is_alive(child)
        asking.send_signal(by)
        out, err = asking.communicate(timeout=60)
        _wait_for(lambda: not _is_alive(child))
    finally:
        asking.kill()
        with suppress(OSError, ValueError):
            os.kill(int((mine / "hangs").read_text()), signal.SIGKILL)
    assert asking.returncode == (-9 if by == signal.SIGKILL else 130), err
    page = mine / "out" / "report.html"
    assert page.exists() == (by != signal.SIGKILL)
    assert call("report", "out") == 0 and "Right" in page.read_text()
    summary = RunFolder.open("out").summary
    assert summary["status"] == "stopped" and summary["left"] > 100 and not summary["failures"]
    if by != signal.SIGKILL:
        assert (
            summary["asked"] >= 5
            and "continues the test" in summary["verdict"]
            and "right pairs" in " ".join(out.split())
        )
        assert "5 of " in out and "cube of 2.1 cutoffs" in summary["headline"]
    # of most areas nothing was asked; after a kill, what was saved last counts
    assert f"{summary['asked']} of " in summary["headline"]


def _wait_for(condition: Callable[[], Any]) -> None:
    began = monotonic()
    while not condition():
        assert monotonic() < began + 60
        sleep(0.05)


@pytest.mark.parametrize(
    ("name", "code", "status", "minutes"), [("hangs", 3, "undecided", 0.08), ("slow", 0, "partial", 0.1)]
)
def test_time_that_is_up_ends_it(mine: Path, name: str, code: int, status: str, minutes: float):
    """A call in progress, too; few questions about each area come first and are a verdict."""
    (mine / "hangs.py").write_text(_HANGS)
    asked = ("conform", f"hangs.py:{name}", *_LIMITED, "--cases", "4000", "--time", f"{minutes}", "-o", "out")
    began = monotonic()
    assert call(*asked) == code
    # a few seconds, the page, and what a busy machine adds; a call alone may take 45 s
    assert monotonic() - began < 40
    summary = RunFolder.open("out").summary
    assert summary["status"] == status and summary["left"] > 500
    assert ("ended during a call" in summary["headline"]) or name == "slow"
    assert (mine / "out" / "report.html").exists()
    areas = {row["area"]: row["asked"] + row["skipped"] for row in summary["areas"]}
    if status == "partial":
        assert {"few", "boxes", "axes", "images", "outside", "ties", "coincident", "crowded", "reuse"} <= set(
            areas
        )
        assert min(areas.values()) >= 5


@pytest.mark.parametrize(
    ("name", "calls", "reproduced"),
    [
        pytest.param("ends_at_the_12th", 11, True, marks=pytest.mark.nightly),
        pytest.param("ends_after_a_crowd", 1, True, marks=pytest.mark.nightly),
        ("EndsAtAnUpdate", 0, True),
        ("ends_by_chance", 0, False),
    ],
)
def test_a_script_is_run_before_it_is_named(
    mine: Path, name: str, calls: int, reproduced: bool, monkeypatch: pytest.MonkeyPatch
):
    """It makes the earlier calls that it needs; what shows nothing is said to show nothing."""
    # a few of each area: every crash begins another process
    first = lambda *given, **named: plan(*given, **named)[:1]  # noqa: E731
    monkeypatch.setattr("mdnum.references.conformance.suite.plan", first)
    # nor need it be as small as it can be: every try begins one, too
    monkeypatch.setattr("mdnum.references.conformance.shrinking.TRIES", 12)
    (mine / "hangs.py").write_text(_HANGS)
    (mine / "armed").touch()
    assert call("conform", f"hangs.py:{name}", *_LIMITED, "--cases", "0", "-o", "out") == 1
    summary = RunFolder.open("out").summary
    (failure,) = summary["failures"]
    assert (failure["code"], failure["earlier"], failure["reproduced"]) == ("CRASHED", calls, reproduced)
    (finding,) = (one for one in summary["findings"] if one["code"] == "CRASHED")
    assert failure["script"] in finding["text"]
    asked = sum(row["asked"] for row in summary["areas"])
    wrong = sum(row["failed"] for row in summary["areas"])
    # right, of how many, and how many crashed
    assert summary["headline"].startswith(f"hangs:{name} found ")
    counts = re.findall(r"\b\d+\b", summary["headline"].replace(f"hangs:{name}", ""))
    assert counts == [str(asked - wrong), str(asked), str(wrong)]
    script = mine / "out" / failure["script"]
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert (done.returncode < 0) == reproduced and ("the list is right" in done.stdout) == (not reproduced)
    if name == "EndsAtAnUpdate":
        assert failure["steps"] == 5


@pytest.mark.parametrize("text", ["", "[]", "3", "{}", '{"word": 1, "tested": 2, "options": 3}', "\0{"])
def test_answers_that_cannot_be_read_are_one_line(text: str, tmp_path, capsys):
    RunFolder.create(tmp_path, layout("conform")).close()
    (tmp_path / "answers.json").write_text(text)
    assert call("conform", "--resume", str(tmp_path)) == 2
    line = capsys.readouterr().err
    assert "answers.json" in line and line.count("\n") == 1
