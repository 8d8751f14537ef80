"""What a list does beside giving pairs: buffers handed out, refusals that hang on the telling, time used."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import planted_lists
import pytest

from mdnum.references.conformance import reproduction
from mdnum.references.conformance.case import once, sequence
from mdnum.references.conformance.catalog import gas
from mdnum.references.conformance.lists import Limits, PairList
from mdnum.references.conformance.loading import from_object, load
from mdnum.references.conformance.results import alike
from mdnum.references.conformance.session import RemoteSession, Session
from mdnum.references.conformance.suite import examine
from mdnum.report.conform.findings import judge
from mdnum.report.verdict import Finding
from mdnum.workflow.conform import _summary

_TWO = once("two", "few", [[0.0, 0, 0], [0.5, 0, 0]], 4.0)
_THREE = once("three", "images", [[0.1, 0, 0], [0.5, 0, 0], [0.6, 0, 0]], 4.0)


def _findings(tested: PairList, cases) -> dict[str, Finding]:
    found = examine(tested, asked=cases, large=False)
    names = [f"{number}.py" for number in range(len(found.failed))]
    run = cast(Any, SimpleNamespace(name="it", summary=_summary(found, names, 0)))
    return {finding.code: finding for finding in judge(run).findings}


class _Elsewhere:
    """A part of an answer that lies on another device."""

    def __array__(self, *_):
        raise TypeError("copy it to the host first")


@pytest.mark.parametrize("form", ["mapping", "tuple", "rows", "attributes"])
def test_buffers_that_are_handed_out_are_told(form: str):
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

    found = _findings(from_object(filled), [_TWO, _THREE])
    assert set(found) == {"ALIASED"} and found["ALIASED"].severity == "info"
    assert "seen when it was asked two" in found["ALIASED"].text  # after what its conventions are found by
    assert _findings(from_object(planted_lists.planted("")), [_TWO, _THREE]) == {}


def test_a_buffer_of_a_list_that_is_kept_is_told():
    class Filled(planted_lists.Kept):
        buffer = np.zeros((2, 1000), int)

        def _pairs(self, positions, cell):
            rows = super()._pairs(positions, cell)
            count = len(rows["i"])
            self.buffer[:, :count] = rows["i"], rows["j"]
            return self.buffer[0, :count], self.buffer[1, :count]

    start = gas(12, 4.0, 3)
    moving = sequence("moving", "motion", [start, start[::-1], start], 4.0)
    assert examine(from_object(Filled), asked=[moving], shrink=False).aliased == "moving"
    assert examine(from_object(planted_lists.Kept), asked=[moving], shrink=False).aliased is None


def _refusing(when):
    def refuses(positions, cell, pbc, r_cut):
        if when(positions, r_cut):
            raise ValueError(f"{len(positions)} atoms are too many.")
        rows = planted_lists.search(positions, cell, pbc, r_cut)
        return rows["i"], rows["j"]

    return from_object(refuses)


def test_a_refusal_that_hangs_on_the_order_of_atoms_is_told():
    found = _findings(_refusing(lambda x, _: len(x) > 1 and x[0, 0] < x[-1, 0]), [_TWO, _THREE])
    told = found["UNEVEN_REFUSALS"]
    assert told.severity == "warning"
    assert told.text == (
        "ValueError: 2 atoms are too many (two); but it answers the same with its atoms in reverse order."
    )


def test_a_refusal_that_hangs_on_what_was_asked_before_is_told():
    asked = []

    def second(x, _):
        asked.append(len(x))
        return len(asked) == 3  # the first finds out its conventions

    found = _findings(_refusing(second), [_TWO, _THREE])
    assert "but it answers the same when it is asked anew" in found["UNEVEN_REFUSALS"].text


def test_what_a_refusal_may_hang_on_is_told_with_it():
    outside = once("outside", "outside", [[0.25, 0, 0], [4.5, 0, 0]], 4.0, r_cut=4 / 3)
    found = _findings(_refusing(lambda x, _: x.max() > 4.0), [_TWO, outside])
    assert set(found) == {"REFUSES"}  # and nothing uneven
    assert found["REFUSES"].text.endswith(
        "about outside. Asked about outside: the same is answered with its atoms wrapped into the box."
    )
    far = once("far", "few", 8 * _TWO.stills[0].positions, 40.0, r_cut=8.0)
    found = _findings(_refusing(lambda _, r_cut: r_cut > 4.0), [_TWO, far])
    assert "the same is answered with all lengths multiplied by 0.12" in found["REFUSES"].text
    # what it does not claim to do is not asked here either
    limited = _refusing(lambda _, r_cut: r_cut > 4.0).with_options(limits=Limits(least_cutoff=4.0))
    assert examine(limited, asked=[far], shrink=True).refusals[0].answers == ()


def test_a_question_told_otherwise_has_the_same_pairs():
    skewed = np.array([[5.0, 0, 0], [2.0, 5.0, 0], [-1.5, 1.0, 5.0]])
    start = gas(9, skewed, 4) + 7.0
    stills = [(start, skewed), (start + 0.2, skewed), (start + 0.4, 1.01 * skewed)]
    case = sequence("moving", "motion", stills, skewed, r_cut=2.3)
    right = planted_lists.search(start + 0.4, 1.01 * skewed, (True,) * 3, 2.3)
    told = list(alike(case))
    assert [even for _, even, _ in told] == [True, True, False, False, False]
    for words, _, other in told:
        last = other.stills[-1]
        rows = planted_lists.search(last.positions, last.cell, other.pbc, other.r_cut)
        assert np.allclose(
            np.sort(rows["distance"]) / other.r_cut, np.sort(right["distance"]) / 2.3, rtol=1e-12, atol=0.0
        ), words
        assert other.skin / other.r_cut == pytest.approx(case.skin / 2.3, rel=1e-15)


def test_the_words_of_an_exception_end_where_its_frames_begin():
    def raises(positions, cell, pbc, r_cut):
        raise RuntimeError("no  cell\nto speak of\nException raised from f at a.cpp:3\nframe #0: f")

    def scripted(positions, cell, pbc, r_cut):
        raise RuntimeError(
            "Failed in the interpreter.\nTraceback of TorchScript (most recent call last):\n"
            '  File "a.py", line 3, in f\n    x = y\n        ~ <--- HERE\nRuntimeError: no atoms\n'
        )

    (outcome,) = Session(from_object(raises)).ask(_TWO)
    assert outcome.raised == "RuntimeError: no cell to speak of"
    (outcome,) = Session(from_object(scripted)).ask(_TWO)
    assert outcome.raised == "RuntimeError: Failed in the interpreter. RuntimeError: no atoms"


def test_words_that_end_a_string_do_not_end_the_script():
    def quotes(positions, cell, pbc, r_cut):
        raise KeyError('in """f""" of C:\\new\\u: "x"')

    tested = from_object(quotes)
    report = examine(tested, asked=[_TWO], shrink=False)
    lines = reproduction.script(tested, report.failed[0], report.how)
    assert "in '''f''' of C:/" in lines.partition("Found by")[0]
    compile(lines, "script", "exec")


_SLOW = """
import time

def spins(positions, cell, pbc, r_cut):
    while True:
        pass

def waits(positions, cell, pbc, r_cut):
    began = time.process_time()
    while time.process_time() < began + 0.3:
        pass
    time.sleep(0.7)
    return [], []

class HangsLater:
    def allocate(self, positions, cell, pbc, r_cut, skin):
        return [], []
    def update(self, positions, cell):
        time.sleep(60)
"""


def test_time_is_what_a_list_computes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Not what the clock says on a machine that does other things; and each step has its own."""
    (tmp_path / "slow.py").write_text(_SLOW)
    monkeypatch.setattr("mdnum.references.conformance.session.CALL", 0.6)

    def asked(name: str, case):
        session = RemoteSession(load(f"{tmp_path / 'slow.py'}:{name}"))
        outcomes = session.ask(case)
        session.close()
        return outcomes

    assert asked("spins", _TWO)[0].late == "no answer within 0.6 s of processor time"
    (outcome,) = asked("waits", _TWO)
    assert outcome.late is None and outcome.answer is not None
    at = _TWO.stills[0].positions
    first, second = asked("HangsLater", sequence("still", "motion", [at, at, at], 4.0))
    assert first.answer is not None and "computed nothing" in str(second.late)


def test_what_is_known_of_a_failure_is_told_with_it():
    def nothing(positions, cell, pbc, r_cut):
        return [], []

    tested = from_object(nothing).with_options(known={"MISSING": "It lists none.", "EXTRA": "It lists all."})
    found = _findings(tested, [_TWO])
    assert set(found) == {"MISSING"} and found["MISSING"].text.endswith("It lists none.")
