"""The suite on real lists, in another process, from a library's own tests; and that nothing stops it."""

from __future__ import annotations

import importlib
import os
import pkgutil
import re
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import planted_lists
import pytest

from mdnum.errors import InputError
from mdnum.references.conformance import NeighborListConformance
from mdnum.references.conformance.case import AREAS, once, sequence
from mdnum.references.conformance.catalog import catalog, crowds, gas, lattice
from mdnum.references.conformance.judge import Failure
from mdnum.references.conformance.lists import Limits
from mdnum.references.conformance.loading import from_object, installed, known, load
from mdnum.references.conformance.motions import motions, movers
from mdnum.references.conformance.questions import PLACES, SHAPES, SIZES, drawn, questions
from mdnum.references.conformance.results import Failed
from mdnum.references.conformance.session import RemoteSession, Session
from mdnum.references.conformance.suite import Examiner, distinct, examine

_PLANTED = str(Path(planted_lists.__file__))


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


@pytest.mark.parametrize("package", ["mdnum.references", "mdnum.references.conformance"])
def test_what_is_exported_is_no_module(package: str):
    """Nor after every module of the package was imported, which puts modules in the places of their names."""
    home = importlib.import_module(package)
    for name in home.__all__:
        assert not isinstance(getattr(home, name), ModuleType), name
    modules = {found.name for found in pkgutil.iter_modules(home.__path__)}
    assert not modules & set(home.__all__)


def test_an_adopted_suite_fails_with_a_script():
    class Broken(NeighborListConformance):
        pairs = staticmethod(planted_lists.planted("half trimmed from full"))
        full = True

    with pytest.raises(pytest.fail.Exception, match=r"(?s)MISSING.*This reproduces the first.*import numpy"):
        Broken().test_neighbor_list("few")
    with pytest.raises(pytest.skip.Exception, match="no list"):
        NeighborListConformance().test_neighbor_list("few")
    with pytest.raises(pytest.skip.Exception, match="kept"):
        Broken().test_neighbor_list("motion")


@pytest.mark.parametrize("name", ["vesin-half", "scipy", "mdnum", "mdnum-verlet", "ase-primitive"])
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
    assert report.how.full == (name not in ("vesin-half", "scipy"))


def test_questions_are_what_they_were():
    """The same seed draws the same; every area has questions; names tell them apart."""
    assert [one.stills[0].positions.tobytes() for one in drawn(30, 3)] == [
        one.stills[0].positions.tobytes() for one in drawn(30, 3)
    ]
    assert drawn(5, 3)[4].stills[0].positions.tobytes() != drawn(5, 4)[4].stills[0].positions.tobytes()
    named = [*catalog(), *crowds(), *movers(), *motions()]
    assert {case.area for case in named} | {"large", "random"} == set(AREAS)
    assert len({case.name for case in named}) > 150
    kinds = "; ".join(case.name for case in drawn(300, 0))
    assert [word for word in (*SHAPES, *SIZES, *PLACES) if word not in kinds] == []


def test_limits_are_not_asked_and_are_counted():
    tested = replace(load("scipy"), limits=Limits(minimum_image=True, along_axes=True, wrapped=True, atoms=1))
    report = examine(tested, asked=catalog(), shrink=False)
    assert report.conforms
    assert sum(tally.refused for tally in report.areas.values()) <= 1
    assert report.areas["outside"].skipped > 15
    assert report.areas["few"].why["at least 1 atom"] == 2
    assert "cells along x, y and z only" in report.areas["boxes"].why


@pytest.mark.parametrize(
    ("limits", "case", "why"),
    [
        (Limits(all_axes=True), once("", "axes", gas(3, 4.0, 0), 4.0, (True, False, True)), "axis by axis"),
        (Limits(periodic=True), once("", "few", gas(3, 4.0, 0)), "no free atoms"),
        (Limits(free=True), once("", "few", gas(3, 4.0, 0), 4.0), "free atoms only"),
        (
            Limits(right_handed=True),
            once("", "boxes", gas(3, 4.0, 0), np.eye(3)[[1, 0, 2]] * 4),
            "left-handed",
        ),
        (
            Limits(lower_triangular=True),
            once("", "boxes", gas(3, 4.0, 0), np.triu(np.ones((3, 3))) * 4),
            "lower",
        ),
        (
            Limits(orthorhombic=True),
            once("", "boxes", gas(3, 4.0, 0), np.tril(np.ones((3, 3)))),
            "right angles",
        ),
        (Limits(whole_cell=True), once("", "few", gas(3, 4.0, 0)), "lacks a vector"),
        (Limits(most_atoms=2), once("", "few", gas(3, 4.0, 0), 4.0), "at most 2"),
        (Limits(least_cutoff=2.0), once("", "few", gas(3, 4.0, 0), 4.0), "no cutoff below 2"),
        (Limits(roomy=10.0), once("", "boxes", gas(3, 4.0, 0), 4.0), "cells"),
        (
            Limits(fixed_cell=True),
            sequence("", "strain", [(gas(3, 4.0, 0), edge * np.eye(3)) for edge in (4, 3.9)], 4.0),
            "box that changes",
        ),
    ],
)
def test_each_limit_refuses_what_it_says(limits: Limits, case, why: str):
    assert why in str(limits.refusal(case))
    assert (
        limits.refusal(once("", "few", gas(2, 2.0, 0) + 1.0, 4.0, r_cut=2.0)) is None
        or limits.free
        or limits.roomy
    )


def _plain(positions, cell, pbc, r_cut):
    rows = planted_lists.search(positions, cell, pbc, r_cut)
    return rows["i"], rows["j"]


def test_what_a_call_does_is_told_whatever_it_is():
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

    case = once("two", "few", [[0.0, 0, 0], [0.5, 0, 0]], 4.0)
    for function, code in ((raises, "RAISED"), (writes, "CHANGED_INPUT"), (forgets, "MALFORMED")):
        report = examine(from_object(function), asked=[case], shrink=False)
        assert [failed.code for failed in report.failed] == [code]
        assert not report.conforms
    report = examine(from_object(refuses), asked=[case], shrink=False)
    assert not report.failed and report.areas["few"].refused == 1
    assert not report.conforms  # it has answered nothing


_REFUSALS = """
import numpy as np

class Kept:
    def allocate(self, positions, cell, pbc, r_cut, skin):
        return self.update(positions, cell)
    def update(self, positions, cell):
        raise NotImplementedError("free atoms only")

def says_so(positions, cell, pbc, r_cut):
    raise ValueError("the cell is too small")

def says_so_after(positions, cell, pbc, r_cut):
    try:
        {}["cell"]
    except KeyError as error:
        raise RuntimeError("the cell is too small") from error

def compiled(positions, cell, pbc, r_cut):
    from pydantic_core import from_json
    return from_json("{")

class OfItsOwn(Exception):
    pass

def own_class(positions, cell, pbc, r_cut):
    raise OfItsOwn("the cell is too small")

def compiled_for_everybody(positions, cell, pbc, r_cut):
    import zlib
    return zlib.decompress(b"")

def least_of_none(positions, cell, pbc, r_cut):
    return min(np.zeros(0))

def shapes(positions, cell, pbc, r_cut):
    return np.zeros(2) + np.zeros(3)

def joined(positions, cell, pbc, r_cut):
    return np.stack([])

def looked_up(positions, cell, pbc, r_cut):
    return [][0]

def number(positions, cell, pbc, r_cut):
    return float("far")

def singular(positions, cell, pbc, r_cut):
    return np.linalg.inv(np.zeros((3, 3)))

def standard_library(positions, cell, pbc, r_cut):
    import statistics
    return statistics.mean([])

def says_nothing(positions, cell, pbc, r_cut):
    raise ValueError

def generated(positions, cell, pbc, r_cut):
    return sum(float(x) for x in ["far"])
"""


@pytest.mark.parametrize("name", re.findall(r"^(?:def|class) (\w+)[(:](?!Exc)", _REFUSALS, re.MULTILINE))
def test_only_an_exception_of_its_own_is_a_refusal(name: str, tmp_path: Path):
    (tmp_path / "refusals.py").write_text(_REFUSALS)
    case = once("two", "few", [[0.0, 0, 0], [0.5, 0, 0]], 4.0)
    (outcome,) = Session(load(f"{tmp_path / 'refusals.py'}:{name}")).ask(case)
    assert outcome.raised is not None
    meant = ("Kept", "says_so", "says_so_after", "compiled", "own_class")
    assert outcome.refused == (name in meant)


def test_an_adopted_list_that_refuses_everything_fails():
    def refuses(positions, cell, pbc, r_cut):
        raise ValueError("no")

    def refuses_free(positions, cell, pbc, r_cut):
        if not pbc.any():
            raise ValueError("free atoms cannot be done")
        return _plain(positions, cell, pbc, r_cut)

    class Refusing(NeighborListConformance):
        pairs = staticmethod(refuses)

        def asked(self, tested, area):
            return [once("two", area, [[0.0, 0, 0], [0.5, 0, 0]])]

    class RefusingFree(Refusing):
        pairs = staticmethod(refuses_free)

    with pytest.raises(pytest.fail.Exception, match="refuses whatever it is asked: ValueError: no"):
        Refusing().test_neighbor_list("few")
    with pytest.raises(pytest.skip.Exception, match="refused: ValueError: free atoms"):
        RefusingFree().test_neighbor_list("few")


def test_large_questions_are_asked_where_they_are_wanted_and_do_not_take_too_long(
    monkeypatch: pytest.MonkeyPatch,
):
    class Large(NeighborListConformance):
        pairs = staticmethod(_plain)
        large = True

    with pytest.raises(pytest.skip.Exception, match="set `large`"):
        TestAdopted().test_neighbor_list("large")
    for edge in ("SMALL_EDGE", "LARGE_EDGE"):
        monkeypatch.setattr(f"mdnum.references.conformance.questions.{edge}", 5)
    assert [case.atoms for case in Large().asked(from_object(_plain), "large")] == [123, 123]
    monkeypatch.setattr("mdnum.references.conformance.suite._PATIENCE", 0.0)
    tally = examine(from_object(_plain), asked=[lattice(5), lattice(5)], large=False).areas["large"]
    assert (tally.asked, tally.skipped) == (1, 1)
    assert "would take more than" in next(iter(tally.why))


def test_single_precision_is_found_out_and_ties_are_counted():
    def coarse(positions, cell, pbc, r_cut):
        i, j = np.triu_indices(len(positions), 1)
        apart = (positions[j] - positions[i]).astype(np.float32)
        apart -= np.where(pbc, np.rint(apart / np.diag(cell).astype(np.float32)), 0) * np.diag(cell).astype(
            np.float32
        )
        near = np.sqrt((apart**2).sum(axis=1)) < np.float32(r_cut)
        return i[near], j[near]

    tested = from_object(coarse).with_options(
        limits=Limits(minimum_image=True, along_axes=True, periodic=True)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        cases = [case for case in catalog() if "a hair inside" in case.name or case.area == "ties"]
        report = examine(tested, asked=cases, shrink=False)
    assert "float32" in report.found_out and report.single is not None
    assert not report.failed
    exact = from_object(planted_lists.planted(""))
    assert examine(exact, asked=[case for case in catalog() if case.area == "ties"]).ties[0] == 0


@pytest.mark.parametrize("kind", ["nothing", "squares"])
def test_what_is_wrong_otherwise_is_not_taken_for_single_precision(kind: str):
    def wrong(positions, cell, pbc, r_cut):
        rows = planted_lists.search(positions, cell, pbc, r_cut)
        if kind == "nothing":
            return [], []
        return rows["i"], rows["j"], rows["shift"], rows["distance"] ** 2

    cases = [case for case in catalog() if case.area in ("few", "outside", "ties") and case.atoms < 9]
    report = examine(from_object(wrong), asked=cases, shrink=False)
    assert "float32" not in report.found_out and report.single is None and report.failed


def test_what_fails_after_other_questions_alone_is_told_once():
    def failed(atoms: int, alone: bool) -> Failed:
        case = once(f"{atoms}", "few", gas(atoms, 4.0, 0), 4.0)
        return Failed(case, (Failure("MISSING", "a pair"),), alone, asked=case)

    kept = distinct([failed(9, False), failed(2, False), failed(1, False), failed(2, True), failed(7, True)])
    assert {(found.case.atoms, found.alone) for found in kept} == {(1, False), (2, True), (7, True)}


def test_a_process_that_crashes_or_hangs_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "sick.py").write_text(
        "import os, signal, sys, time\n"
        "def crashes(positions, cell, pbc, r_cut):\n"
        "    if len(positions) == 2:\n"
        "        print('a word on stdout'); print('bad alloc', file=sys.stderr, flush=True)\n"
        "        os.kill(os.getpid(), signal.SIGFPE)\n"
        "    return [], []\n"
        "def hangs(positions, cell, pbc, r_cut):\n"
        "    time.sleep(60)\n"
        "def leaves(positions, cell, pbc, r_cut):\n"
        "    os._exit(3)\n"
    )
    one_atom, two = (
        once("one", "few", [[0.0, 0, 0]], 4.0),
        once("two", "few", [[0.0, 0, 0], [0.5, 0, 0]], 4.0),
    )
    session = RemoteSession(load(f"{tmp_path / 'sick.py'}:crashes"))
    assert session.ask(one_atom)[0].answer is not None
    crashed = session.ask(two)[0].crashed
    assert crashed is not None and "SIGFPE" in crashed and crashed.endswith("bad alloc")
    # and a new process answers the next question
    assert session.ask(one_atom)[0].answer is not None
    session.close()
    report = examine(load(f"{tmp_path / 'sick.py'}:leaves"), asked=[two], apart=True, shrink=False)
    assert report.failed[0].code == "CRASHED" and "exit code 3" in report.failed[0].worst.text
    monkeypatch.setattr("mdnum.references.conformance.session.CALL", 0.5)
    began = time.perf_counter()
    session = RemoteSession(load(f"{tmp_path / 'sick.py'}:hangs"))
    assert session.ask(two)[0].late == "no answer within 0.5 s, in which it computed nothing"
    session.close()
    assert time.perf_counter() - began < 50


@pytest.mark.usefixtures("strangers_folder")
def test_another_process_gives_the_same_answers():
    tested = load(f"{_PLANTED}:search")
    case = once("a gas", "few", gas(30, 4.0, 1), 4.0)
    session = RemoteSession(tested)
    here, there = Session(tested).ask(case)[0].answer, session.ask(case)[0].answer
    session.close()
    assert here is not None and there is not None and here.same(there)


def test_an_object_that_is_kept_is_asked_anew_only_where_it_should_be():
    calls: list[str] = []

    class Counts(planted_lists.Kept):
        def allocate(self, *arguments):
            calls.append("allocate")
            return super().allocate(*arguments)

        def update(self, *arguments):
            calls.append("update")
            return super().update(*arguments)

    examiner = Examiner(from_object(Counts))
    calls.clear()
    start = gas(6, 6.0, 0)
    moving = sequence("moving", "motion", [start, start + 0.1, start + 0.2], 6.0)
    assert not examiner.failures(moving)
    assert calls == ["allocate", "update", "update"]
    calls.clear()
    growing = sequence("growing", "reuse", [start[:4], start, start], 6.0)
    assert not examiner.failures(growing)
    assert calls == ["allocate", "allocate", "update"]
    calls.clear()
    resized = replace(from_object(Counts), limits=Limits(fixed_atoms=False))
    Session(resized).ask(growing)
    assert calls == ["allocate", "update"]  # it raises at the second, as this one does


def test_lists_are_found_by_name_file_and_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert {"ase", "vesin", "scipy", "mdnum", "mdnum-verlet"} <= {one.name for one in installed()}
    assert len({one.name for one in known()}) == len(known())
    missing = next((one.name for one in known() if one.version is None), None)
    if missing is not None:
        with pytest.raises(InputError, match="not installed"):
            load(missing)
    for word, said in (
        ("vesim", "no list that is known"),
        ("nowhere.at.all:pairs", "cannot be imported"),
        (f"{tmp_path}/none.py:pairs", "no such file"),
        (f"{_PLANTED}:nothing", "has no 'nothing'"),
        (f"{_PLANTED}:SEARCH_DEFECTS", "neither a function"),
    ):
        with pytest.raises(InputError, match=said):
            load(word)
    (tmp_path / "lists_of_mine.py").write_text(
        "from planted_lists import search\ndef pairs(*a):\n    return search(*a)\npairs.full = True\n"
    )
    monkeypatch.chdir(tmp_path)
    found = load("lists_of_mine.py:pairs")
    assert found.full and not found.kept and found.word and "from lists_of_mine import pairs" in found.source
    assert load(f"{_PLANTED}:Kept").kept
    assert os.getcwd() == str(tmp_path)
