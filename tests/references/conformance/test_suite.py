"""The suite on real lists, in another process, from a library's own tests; and that nothing stops it."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import planted_lists
import pytest

from mdnum.errors import InputError
from mdnum.references.conformance import NeighborListConformance, reproduction
from mdnum.references.conformance.case import AREAS, Case, Still, gas, once, sequence
from mdnum.references.conformance.judge import Failed, Failure
from mdnum.references.conformance.lists import ListLimits, from_object
from mdnum.references.conformance.motions import motions, movers
from mdnum.references.conformance.peers import installed, known, load
from mdnum.references.conformance.questions import (
    PLACES,
    SHAPES,
    SIZES,
    alike,
    catalog,
    crowds,
    drawn,
    lattice,
    questions,
)
from mdnum.references.conformance.session import RemoteSession, Session
from mdnum.references.conformance.suite import Examiner, distinct, examine

_PLANTED = str(Path(planted_lists.__file__))
_TWO = once("two", "few", [[0.0, 0, 0], [0.5, 0, 0]], 4.0)


class TestAdopted(NeighborListConformance):
    """How a library runs the suite in its own tests."""

    pairs = staticmethod(planted_lists.planted(""))
    cases = 20


class TestAdoptedKept(NeighborListConformance):
    pairs = planted_lists.kept("")
    cases = 5

    def asked(self, tested, area):
        # the rest is asked of the list above
        return super().asked(tested, area) if area in ("few", "strain", "rule") else []


def test_pairs_of_a_box_that_grew_are_no_phantoms():
    """What was listed through a face is further apart then than any skin, and nothing moved."""
    x, cell = [[0.5, 2, 2], [3.5, 2, 2]], np.eye(3)
    stills = (Still(x, 4 * cell), Still(x, 6 * cell))
    case = Case("grown", "strain", stills, (True, True, True), r_cut=1.25, skin=0.5)
    report = examine(from_object(planted_lists.kept("never again")), asked=[case], large=False)
    assert report.superset and report.asked == 1 and not report.failed


def test_an_adopted_suite_fails_with_a_script_and_skips_with_a_reason(monkeypatch: pytest.MonkeyPatch):
    class Broken(NeighborListConformance):
        pairs = staticmethod(planted_lists.planted("half trimmed from full"))
        full = True

    class Large(NeighborListConformance):
        pairs = staticmethod(_plain)
        large = True

    with pytest.raises(pytest.fail.Exception, match=r"(?s)MISSING.*reproduces.*import numpy"):
        Broken().test_neighbor_list("few")
    for suite, area, reason in (
        (NeighborListConformance(), "few", "no list"),
        (Broken(), "motion", "kept"),
        (TestAdopted(), "large", "set `large`"),
    ):
        with pytest.raises(pytest.skip.Exception, match=reason):
            suite.test_neighbor_list(area)
    for edge in ("SMALL_EDGE", "LARGE_EDGE"):
        monkeypatch.setattr(f"mdnum.references.conformance.questions.{edge}", 5)
    assert [case.atoms for case in Large().asked(from_object(_plain), "large")] == [123, 123]
    monkeypatch.setattr("mdnum.references.conformance.suite._PATIENCE", 0.0)
    tally = examine(from_object(_plain), asked=[lattice(5), lattice(5)], large=False).areas["large"]
    assert (tally.asked, tally.skipped) == (1, 1) and "more than" in next(iter(tally.why))


def test_an_adopted_list_that_refuses_everything_fails():
    def refuses(positions, cell, pbc, r_cut):
        if not (pbc.any() and refuses.periodic):
            raise ValueError("cannot be done")
        return _plain(positions, cell, pbc, r_cut)

    class Refusing(NeighborListConformance):
        pairs = staticmethod(refuses)

        def asked(self, tested, area):
            return [once("two", area, [[0.0, 0, 0], [0.5, 0, 0]])]

    for refuses.periodic, outcome, message in (
        (False, pytest.fail.Exception, "refuses .*: ValueError: cannot"),
        (True, pytest.skip.Exception, "refused: ValueError: cannot"),
    ):
        with pytest.raises(outcome, match=message):
            Refusing().test_neighbor_list("few")


@pytest.mark.parametrize("package", ["mdnum.references", "mdnum.references.conformance"])
def test_what_is_exported_is_no_module(package: str):
    """Nor after every module of the package was imported, which puts modules in the places of their names."""
    home = importlib.import_module(package)
    for name in home.__all__:
        assert not isinstance(getattr(home, name), ModuleType), name
    assert not {found.name for found in pkgutil.iter_modules(home.__path__)} & set(home.__all__)


@pytest.mark.parametrize("name", ["vesin-half", "scipy", "numpy", "mdnum-verlet", "ase-primitive"])
def test_a_list_that_people_use(name: str):
    """Named cases that are quick, and a few drawn at random."""
    tested = load(name)
    areas = ("few", "boxes", "axes", "outside", "ties", "coincident", "reuse", "wrapping")
    cases = [
        case
        for case in questions(tested, 10, 1)
        # far from the origin vesin takes seconds for some of these
        if case.area in areas and case.atoms < 60 and "thousand" not in case.name
    ]
    report = examine(tested, asked=cases, shrink=False)
    assert not report.failed, [(one.code, one.case.name, one.worst.text) for one in report.failed]
    assert report.asked > 50
    assert report.how.full == (name not in ("vesin-half", "scipy", "numpy"))


def test_questions_are_what_they_were():
    """The same seed draws the same; every area has questions; names tell them apart."""
    first, again, other = drawn(30, 3), drawn(30, 3), drawn(5, 4)
    assert all(a.equals(b) for a, b in zip(first, again, strict=True)) and not first[4].equals(other[4])
    named = [*catalog(), *crowds(), *movers(), *motions()]
    assert {case.area for case in named} | {"large", "random"} == set(AREAS)
    assert len({case.name for case in named}) > 150
    kinds = "; ".join(case.name for case in drawn(300, 0))
    assert [word for word in (*SHAPES, *SIZES, *PLACES) if word not in kinds] == []


def test_a_question_put_in_another_way_has_the_same_pairs():
    skewed = np.array([[5.0, 0, 0], [2.0, 5.0, 0], [-1.5, 1.0, 5.0]])
    start = gas(9, skewed, 4) + 7.0
    stills = [(start, skewed), (start + 0.2, skewed), (start + 0.4, 1.01 * skewed)]
    case = sequence("moving", "motion", stills, skewed, r_cut=2.3)
    right = np.sort(planted_lists.search(start + 0.4, 1.01 * skewed, (True,) * 3, 2.3)["distance"])
    ways = list(alike(case))
    assert [even for _, even, _ in ways] == [True, True, False, False, False]
    for words, _, other in ways:
        last = other.stills[-1]
        rows = planted_lists.search(last.positions, last.cell, other.pbc, other.r_cut)
        distance = np.sort(rows["distance"]) / other.r_cut
        assert np.allclose(distance, right / 2.3, rtol=1e-12, atol=0.0), words
        assert other.skin / other.r_cut == pytest.approx(case.skin / 2.3, rel=1e-15)


_GAS = once("", "few", gas(3, 4.0, 0), 4.0)
_FREE = once("", "few", gas(3, 4.0, 0))
_SLAB = once("", "axes", gas(3, 4.0, 0), 4.0, (True, False, True))
_SHRINKS = sequence("", "strain", [(gas(3, 4.0, 0), edge * np.eye(3)) for edge in (4, 3.9)], 4.0)


def _in(cell) -> object:
    return once("", "boxes", gas(3, 4.0, 0), np.array(cell, float))


@pytest.mark.parametrize(
    ("limits", "case", "why"),
    [
        (ListLimits(all_axes=True), _SLAB, "axis by axis"),
        (ListLimits(periodic=True), _FREE, "no free atoms"),
        (ListLimits(free=True), _GAS, "free atoms only"),
        (ListLimits(right_handed=True), _in(np.eye(3)[[1, 0, 2]] * 4), "left-handed"),
        (ListLimits(lower_triangular=True), _in(np.triu(np.ones((3, 3))) * 4), "lower"),
        (ListLimits(orthorhombic=True), _in(np.tril(np.ones((3, 3)))), "right angles"),
        (ListLimits(along_axes=True), _in(-4 * np.eye(3)), "along x, y and z"),
        (ListLimits(minimum_image=True), _in(1.9 * np.eye(3)), "minimum image"),
        (ListLimits(wrapped=True), once("", "outside", [[-1.0, 0, 0]], 4.0), "inside the box"),
        (ListLimits(whole_cell=True), _FREE, "lacks a vector"),
        (ListLimits(atoms=4), _GAS, "at least 4 atoms"),
        (ListLimits(most_atoms=2), _GAS, "at most 2"),
        (ListLimits(least_cutoff=2.0), _GAS, "no cutoff below 2"),
        (ListLimits(roomy=10.0), _GAS, "cells"),
        (ListLimits(fixed_cell=True), _SHRINKS, "box that changes"),
    ],
)
def test_each_limit_refuses_what_it_should(limits: ListLimits, case, why: str):
    assert why in str(limits.refusal(case))
    plain = once("", "few", gas(2, 2.0, 0) + 1.0, 4.0, r_cut=1.9 if limits.minimum_image else 2.0)
    assert limits.refusal(plain) is None or limits.free or limits.roomy or limits.atoms


def _plain(positions, cell, pbc, r_cut):
    rows = planted_lists.search(positions, cell, pbc, r_cut)
    return rows["i"], rows["j"]


def test_what_a_call_does_is_reported_whatever_it_is():
    def raises(positions, cell, pbc, r_cut):
        raise IndexError("index 4 is out of bounds")

    def refuses(positions, cell, pbc, r_cut):
        raise ValueError("cells below two cutoffs cannot be done")

    def writes(positions, cell, pbc, r_cut):
        found = _plain(positions, cell, pbc, r_cut)
        positions += 1.0
        return found

    def forgets(positions, cell, pbc, r_cut):
        return None

    codes = ((raises, ["RAISED"]), (writes, ["CHANGED_INPUT"]), (forgets, ["MALFORMED"]), (refuses, []))
    for function, expected in codes:
        report = examine(from_object(function), asked=[_TWO], shrink=False)
        assert [failed.code for failed in report.failed] == expected
        assert not report.conforms  # what refuses has answered nothing
        assert report.areas["few"].refused == (function is refuses)


_OWN = """
import statistics, zlib
import numpy as np
from pydantic_core import from_json

class OfItsOwn(Exception):
    pass

class Kept:
    def allocate(self, positions, cell, pbc, r_cut, skin):
        return self.update(positions, cell)
    def update(self, positions, cell):
        raise NotImplementedError("free atoms only")
"""
_REFUSES = {
    "says_so": 'raise ValueError("the cell is too small")',
    "says_so_after": 'try: {}["cell"]\n    except KeyError as error: raise RuntimeError("no") from error',
    "compiled": 'return from_json("{")',
    "own_class": 'raise OfItsOwn("the cell is too small")',
}
_FAILS = {
    "compiled_for_everybody": 'return zlib.decompress(b"")',
    "least_of_none": "return min(np.zeros(0))",
    "shapes": "return np.zeros(2) + np.zeros(3)",
    "joined": "return np.stack([])",
    "looked_up": "return [][0]",
    "number": 'return float("far")',
    "singular": "return np.linalg.inv(np.zeros((3, 3)))",
    "standard_library": "return statistics.mean([])",
    "says_nothing": "raise ValueError",
    "generated": 'return sum(float(x) for x in ["far"])',
}


@pytest.mark.parametrize("name", ["Kept", *_REFUSES, *_FAILS])
def test_only_an_exception_of_its_own_is_a_refusal(name: str, tmp_path: Path):
    bodies = {**_REFUSES, **_FAILS}
    lines = f"def {name}(positions, cell, pbc, r_cut):\n    {bodies[name]}\n" if name in bodies else ""
    (tmp_path / f"{name}_list.py").write_text(_OWN + lines)
    (outcome,) = Session(load(f"{tmp_path}/{name}_list.py:{name}")).ask(_TWO)
    assert outcome.answer is None and (outcome.failure is None or outcome.failure.code == "RAISED")
    assert (outcome.refused is not None) == (outcome.failure is None) == (name not in _FAILS)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (
            "no  cell\nat all\nException raised from f at a.cpp:3\nframe #0: f",
            "RuntimeError: no cell at all",
        ),
        (
            "It failed.\nTraceback of TorchScript (most recent call last):\n"
            '  File "a.py", line 3, in f\n    x = y\n        ~ <--- HERE\nRuntimeError: no atoms\n',
            "RuntimeError: It failed. RuntimeError: no atoms",
        ),
    ],
)
def test_an_exception_ends_where_its_frames_begin(message: str, words: str):
    def raises(positions, cell, pbc, r_cut):
        raise RuntimeError(message)

    (outcome,) = Session(from_object(raises)).ask(_TWO)
    assert outcome.refused == words


def test_words_that_end_a_string_do_not_end_the_script():
    def quotes(positions, cell, pbc, r_cut):
        raise KeyError('in """f""" of C:\\new\\u: "x"')

    tested = from_object(quotes)
    report = examine(tested, asked=[_TWO], shrink=False)
    lines = reproduction.script(tested, report.failed[0], report.how)
    assert "in '''f''' of C:/" in lines.partition("Found by")[0]
    compile(lines, "script", "exec")


def test_single_precision_is_found_out_and_ties_are_counted():
    def coarse(positions, cell, pbc, r_cut):
        i, j = np.triu_indices(len(positions), 1)
        apart, edges = (positions[j] - positions[i]).astype(np.float32), np.diag(cell).astype(np.float32)
        apart -= np.where(pbc, np.rint(apart / edges), 0) * edges
        near = np.sqrt((apart**2).sum(axis=1)) < np.float32(r_cut)
        return i[near], j[near]

    limits = ListLimits(minimum_image=True, along_axes=True, periodic=True)
    ties = [case for case in catalog() if case.area == "ties"]
    cases = [case for case in catalog() if "a hair inside" in case.name] + ties
    with np.errstate(divide="ignore", invalid="ignore"):
        report = examine(from_object(coarse).with_options(limits=limits), asked=cases, shrink=False)
    assert "float32" in report.found_out and report.single is not None
    assert not report.failed
    exact = examine(from_object(planted_lists.planted("")), asked=ties)
    assert exact.ties[0] == 0 < exact.ties[1]


@pytest.mark.parametrize("kind", ["nothing", "squares"])
def test_what_is_wrong_otherwise_is_not_taken_for_single_precision(kind: str):
    def wrong(positions, cell, pbc, r_cut):
        rows = planted_lists.search(positions, cell, pbc, r_cut)
        return ([], []) if kind == "nothing" else rows | {"distance": rows["distance"] ** 2}

    cases = [case for case in catalog() if case.area in ("few", "outside", "ties") and case.atoms < 9]
    report = examine(from_object(wrong), asked=cases, shrink=False)
    assert "float32" not in report.found_out and report.single is None and report.failed


def test_what_fails_only_after_other_questions_is_reported_once():
    def failed(atoms: int, alone: bool) -> Failed:
        case = once(f"{atoms}", "few", gas(atoms, 4.0, 0), 4.0)
        return Failed(case, (Failure("MISSING", "a pair"),), alone)

    kept = distinct([failed(9, False), failed(2, False), failed(1, False), failed(2, True), failed(7, True)])
    assert {(one.case.atoms, one.alone) for one in kept} == {(1, False), (2, True), (7, True)}


_SICK = """
import os, signal, sys, time

def sick(positions, cell, pbc, r_cut):
    began = time.process_time()
    if len(positions) == 2:
        print('a word on stdout'); print('bad alloc', file=sys.stderr, flush=True)
        os.kill(os.getpid(), signal.SIGFPE)
    # three of them spin; four compute for a while, and then wait
    while len(positions) == 3 or (len(positions) == 4 and time.process_time() < began + 0.2):
        pass
    time.sleep(0.6 * (len(positions) == 4))
    return [], []

def leaves(positions, cell, pbc, r_cut):
    os._exit(3)

class HangsLater:
    def allocate(self, positions, cell, pbc, r_cut, skin):
        return [], []
    def update(self, positions, cell):
        time.sleep(60)
"""


def test_a_process_that_crashes_or_hangs_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Time is what a list computes, not what the clock shows on a busy machine; and each step has its own."""
    (tmp_path / "sick.py").write_text(_SICK)

    def remote(name: str) -> RemoteSession:
        return RemoteSession(load(f"{tmp_path / 'sick.py'}:{name}"))

    session, one_atom = remote("sick"), once("one", "few", [[0.0, 0, 0]], 4.0)
    assert session.ask(one_atom)[0].answer is not None
    crashed = session.ask(_TWO)[0].failure
    assert crashed is not None and crashed.code == "CRASHED"
    assert "SIGFPE" in crashed.text and crashed.text.endswith("bad alloc")
    # and a new process answers the next question
    assert session.ask(one_atom)[0].answer is not None
    monkeypatch.setattr("mdnum.references.conformance.session.CALL", 0.5)
    assert session.ask(once("four", "few", gas(4, 4.0, 0), 4.0))[0].answer is not None
    late = session.ask(once("three", "few", gas(3, 4.0, 0), 4.0))[0].failure
    session.close()
    assert late is not None and late.code == "NO_ANSWER" and "of processor time" in late.text
    session, at = remote("HangsLater"), _TWO.stills[0].positions
    first, last = session.ask(sequence("still", "motion", [at, at], 4.0))
    session.close()
    assert first.answer is not None and last.failure is not None
    assert last.failure.code == "NO_ANSWER" and "computed nothing" in last.failure.text
    report = examine(load(f"{tmp_path / 'sick.py'}:leaves"), asked=[_TWO], apart=True, shrink=False)
    assert report.failed[0].code == "CRASHED" and "exit code 3" in report.failed[0].worst.text


@pytest.mark.usefixtures("strangers_folder")
def test_another_process_gives_the_same_answers():
    tested, case = load(f"{_PLANTED}:search"), once("a gas", "few", gas(30, 4.0, 1), 4.0)
    session = RemoteSession(tested)
    here, elsewhere = Session(tested).ask(case)[0].answer, session.ask(case)[0].answer
    session.close()
    assert here is not None and elsewhere is not None and here.same(elsewhere)


def test_an_object_that_is_kept_is_allocated_only_where_it_should_be():
    calls: list[str] = []

    class Counts(planted_lists.Kept):
        def allocate(self, *arguments):
            calls.append("allocate")
            return super().allocate(*arguments)

        def update(self, *arguments):
            calls.append("update")
            return super().update(*arguments)

    start = gas(6, 6.0, 0)
    moving = sequence("moving", "motion", [start, start + 0.1, start + 0.2], 6.0)
    growing = sequence("growing", "reuse", [start[:4], start, start], 6.0)
    examiner = Examiner(from_object(Counts))
    for case, expected in (
        (moving, ["allocate", "update", "update"]),
        (growing, ["allocate"] * 2 + ["update"]),
    ):
        calls.clear()
        assert not examiner.failures(case)
        assert calls == expected
    calls.clear()
    Session(replace(from_object(Counts), limits=ListLimits(fixed_atoms=False))).ask(growing)
    assert calls == ["allocate", "update"]  # it raises at the second, as this one does


def test_a_buffer_of_a_list_that_is_kept_is_reported():
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


def test_lists_are_found_by_name_file_and_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert {"ase", "vesin", "scipy", "mdnum", "mdnum-verlet"} <= {one.name for one in installed()}
    assert len({one.name for one in known()}) == len(known())
    for missing in (one for one in known() if one.lacks):
        with pytest.raises(InputError, match="not installed") as caught:
            load(missing.name)
        assert all(name in str(caught.value) for name in missing.lacks)
    (tmp_path / "lists_of_mine.py").write_text(
        "from planted_lists import search\ndef pairs(*a):\n    return search(*a)\npairs.full = True\n"
    )
    monkeypatch.chdir(tmp_path)
    found = load("lists_of_mine.py:pairs")
    assert found.full and not found.kept and found.word and "from lists_of_mine import pairs" in found.source
    assert load(f"{_PLANTED}:Kept").kept and load(f"{_PLANTED}:Kept('average motion')").kept


_VERSIONS = {"nvalchemi-toolkit-ops": "0.5.0", "torch": None, "vesin": None}


def test_all_packages_that_are_missing_are_named(monkeypatch: pytest.MonkeyPatch):
    """An adaptor may need more than the package that it is named after."""
    monkeypatch.setattr("mdnum.references.conformance.lists.version", _VERSIONS.get)
    for word, remedy in (("nvalchemi-ops", "pip install torch"), ("vesin", "pip install vesin")):
        with pytest.raises(InputError) as caught:
            load(word)
        assert (caught.value.remedy or "").endswith(remedy)
    monkeypatch.setattr("mdnum.references.conformance.lists.version", {}.get)
    with pytest.raises(InputError, match=r"nvalchemi-toolkit-ops and torch, .*not"):
        load("nvalchemi-ops")
    assert not installed()


class _Overflow(Exception):
    """As in nvalchemi-toolkit-ops 0.5: it names the capacity that would have been enough."""

    def __init__(self, most: int, needed: int):
        super().__init__(f"{needed} > {most}")
        self.num_neighbors = needed


class _Tensor(np.ndarray):
    def numpy(self):
        return np.asarray(self)


def _cell_list(positions, r_cut, cell, pbc, max_neighbors=16, return_neighbor_list=False):
    rows = planted_lists.search(np.array(positions), np.array(cell[0]), np.array(pbc[0]), r_cut)
    most = int(np.bincount(rows["i"], minlength=1).max())
    if most > max_neighbors:
        raise _Overflow(max_neighbors, most)
    return np.stack([rows["i"], rows["j"]]).view(_Tensor), None, rows["shift"].view(_Tensor)


@pytest.mark.parametrize("claims", [None, 1], ids=["what is needed", "one more at most"])
def test_the_capacity_of_an_adaptor_is_not_the_lists(monkeypatch: pytest.MonkeyPatch, claims: int | None):
    """A library whose buffers its caller sizes is given more when it asks for more."""

    def cell_list(*given, **named):
        try:
            return _cell_list(*given, **named)
        except _Overflow as error:
            error.num_neighbors = error.num_neighbors if claims is None else named["max_neighbors"] + claims
            raise

    neighbors = SimpleNamespace(cell_list=cell_list, NeighborOverflowError=_Overflow)
    for name, module in (
        ("torch", SimpleNamespace(as_tensor=np.asarray)),
        ("nvalchemiops", SimpleNamespace()),
        ("nvalchemiops.torch", SimpleNamespace()),
        ("nvalchemiops.torch.neighbors", neighbors),
    ):
        monkeypatch.setitem(sys.modules, name, module)
    tested = next(one for one in known() if one.name == "nvalchemi-ops")
    asked = [*crowds(), *(case for case in catalog() if case.area == "few")]
    report = examine(tested, asked=asked)
    assert report.conforms and not report.total("refused"), report.failed
    assert "NeighborOverflowError" in tested.source  # as in a script without mdnum


def test_a_package_outside_adds_a_list(monkeypatch: pytest.MonkeyPatch):
    """By an entry point: it is listed, found by its name and asked like any other."""
    from importlib.metadata import EntryPoint

    from mdnum import registry
    from mdnum.references.conformance.lists import LISTS

    point = EntryPoint("theirs", "planted_lists:search", LISTS.group)
    monkeypatch.setattr(registry, "_plugins", lambda group, path: (point,) if group == LISTS.group else ())
    theirs = next(one for one in known() if one.name == "theirs")
    assert theirs.description.startswith("(i, j, shift, distance, vector)")
    assert examine(theirs, asked=[_TWO], shrink=False).conforms
