"""How a list is called: buffers, exceptions and the time it takes; and questions put in other ways."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import planted_lists
import pytest

from mdnum.references.conformance import reproduction
from mdnum.references.conformance.case import once, sequence
from mdnum.references.conformance.catalog import gas
from mdnum.references.conformance.loading import from_object, load
from mdnum.references.conformance.results import alike
from mdnum.references.conformance.session import RemoteSession, Session
from mdnum.references.conformance.suite import examine

_TWO = once("two", "few", [[0.0, 0, 0], [0.5, 0, 0]], 4.0)


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
