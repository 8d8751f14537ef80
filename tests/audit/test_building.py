"""Which structure a calculator is given that came without one, and how much is asked to build it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ase.build import bulk
from ase.calculators.eam import EAM
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from audit import planted
from audit.planted import Good

import mdnum
from mdnum.audit.base import TIME_UP
from mdnum.audit.building import BUILDING_CALLS, default_structure, meant_for
from mdnum.audit.subject import CalculatorSubject, LoadedCalculator, largest
from mdnum.verbs import frame

TABLE = Path(__file__).parents[2] / "systems" / "copper" / "cu.eam.alloy"


class Counted(LennardJones):
    """Counts its calls, all objects together."""

    calls = 0

    def calculate(self, *words, **more):
        type(self).calls += 1
        super().calculate(*words, **more)


def counted(base: type = Counted, **attributes) -> type:
    return type("Named", (base,), {"calls": 0, **attributes})


def loaded(kind, name: str = "calculator", **words) -> LoadedCalculator:
    return LoadedCalculator(name, "x", lambda: kind(**words))


SILICON = {"sigma": 2.1, "epsilon": 0.5, "rc": 5.0}


@pytest.mark.parametrize(
    ("attributes", "first"),
    [
        ({"elements": ["Si"]}, "Si"),
        ({"species": ("Ge", "Si")}, "Ge"),
        ({"parameters": {("W", "W", "W"): 1.0}}, "W"),
        ({"parameters": {"cutoff": 4.0, "atom_types": {"Al": 1, "Mg": 2}}}, "Al"),
        ({"atomic_numbers": np.array([26, 6])}, "Fe"),
        ({"model": type("Model", (), {"atomic_numbers": [79]})()}, "Au"),
        ({"models": [type("Model", (), {"elements": ["Pt"]})()]}, "Pt"),
        ({"z_table": type("Table", (), {"zs": [22, 8]})()}, "Ti"),
        # many are meant for many: the usual ones first
        ({"elements": ["H", "He", "Li", "Be", "B", "Cu", "Si"]}, "Cu"),
        ({"__doc__": "Stillinger-Weber silicon."}, "Si"),
        # letters that name parameters are no elements, nor are words of English
        ({"parameters": {"A": 7.0, "B": 0.6, "p": 4}, "__doc__": "As one may lead it."}, None),
    ],
)
def test_a_calculator_is_asked_about_an_element_that_it_names(attributes, first):
    kind = type("Any", (), attributes)
    assert next(iter(meant_for(kind(), "any")), None) == first


def test_the_name_and_the_text_of_a_file_are_read(tmp_path):
    for text, expected in (
        ('KNOWN = {"Si": 1.0}\n', ["Si"]),
        ("# argon, or krypton\n", ["Ar", "Kr"]),
        ("# nothing\n", []),
    ):
        (tmp_path / "pot.py").write_text(text)
        assert meant_for(object(), f"{tmp_path}/pot.py:Class(a=1)") == expected
    assert meant_for(object(), "some.package:Own(file='Cu_u3.eam')") == ["Cu"]


@pytest.mark.parametrize("kind", ["InPlace", "Tags", "CoModel", "In", "Gold"])
def test_the_name_of_a_class_or_function_is_no_element(kind, tmp_path):
    (tmp_path / "pot.py").write_text(f"class {kind}: pass\n" if kind != "Gold" else "")
    for words in (kind, f"pot.py:{kind}", f"a.package:{kind}(a=1)", f"{tmp_path}/pot.py:{kind}()"):
        assert meant_for(object(), words) == []
    assert meant_for(object(), f"a.package:{kind}(file='Si.tersoff')") == ["Si"]
    assert meant_for(object(), f"{tmp_path}/Si_a.py:{kind}") == ["Si"]


@pytest.mark.parametrize(("sigma", "elements"), [(0.8, []), (0.7, ["Na"]), (1.0, ["Cs", "Ar"])])
def test_a_structure_is_built_in_which_atoms_feel_each_other(sigma, elements):
    """One that acts below 1.3 Å alone: another spacing, or a smaller element, than that of most crystals."""
    kind = counted(elements=elements)
    structure = default_structure(loaded(kind, sigma=sigma, epsilon=0.5, rc=1.25 * sigma))
    subject = CalculatorSubject("x", lambda: kind(sigma=sigma, epsilon=0.5, rc=1.25 * sigma), structure)
    assert largest(subject.forces(structure)) > 1e-3 and kind.calls <= BUILDING_CALLS


class Alone(Good):
    """Its energy is that of its atoms."""

    def answer(self, atoms):
        return -1.5 * len(atoms), np.zeros((len(atoms), 3))


@pytest.mark.parametrize(
    ("kind", "atoms"), [(Alone, None), (Good, 1), pytest.param(Good, 4, marks=pytest.mark.nightly)]
)
def test_where_no_atom_feels_another_nothing_is_cleared(tmp_path, kind, atoms):
    """One in which no atom ever does, and a gas too thin for one that interacts."""
    gas = bulk("Ar", "fcc", a=3.9, cubic=True)
    gas.set_cell(gas.cell.array * 8, scale_atoms=True)
    wanted = ["forces", "curl", "state", "alone", "dynamics"]
    outcome = mdnum.audit_calculator(
        kind, atoms and gas[:atoms], checks=wanted, out=tmp_path / "a", steps=20, report=False
    )
    assert outcome.summary["status"] == frame.UNDECIDED
    assert all(one["numbers"]["nothing_felt"] for one in outcome.summary["parts"] if one["name"] == "forces")
    assert "safe" not in outcome.verdict.headline and "found no problems" not in outcome.verdict.headline


def test_silicon_for_a_silicon_potential():
    structure = default_structure(loaded(counted(__doc__="Silicon."), **SILICON))
    assert set(structure.symbols) == {"Si"} and "diamond" in structure.info["origin"]
    assert not structure.info["guessed"]


def test_two_elements_where_a_calculator_tells_them_apart():
    """One that knows a second element has both in its structure, whichever numbers it gives them."""
    assert set(default_structure(loaded(EMT)).symbols) == {"Cu", "Ni"}
    argon = default_structure(loaded(LennardJones, sigma=3.4, epsilon=0.01))
    assert set(argon.symbols) == {"Ar"} and argon.info["guessed"]
    assert set(default_structure(loaded(EAM, potential=str(TABLE))).symbols) == {"Cu"}
    mixed = default_structure(loaded(planted.ByAppearance))
    counts = [int(np.sum(mixed.symbols == one)) for one in ("Ar", "Kr")]
    assert counts[0] == counts[1] == len(mixed) / 2
    assert planted.codes(planted.asked("invariance", planted.ByAppearance, mixed[:32]))["ORDER"] == "error"


def test_a_named_second_element_is_taken_first():
    kind = type("Two", (planted.ByAppearance,), {"elements": ["Cu", "Zr"]})
    assert set(default_structure(loaded(kind)).symbols) == {"Cu", "Zr"}


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (Counted, {"sigma": 3.4, "epsilon": 0.01, "rc": 8.5}),
        (Counted, {}),
        (Counted, SILICON),
        (Counted, {"sigma": 9.0, "epsilon": 0.01, "rc": 20.0}),
    ],
)
def test_building_ends_within_its_calls(kind, words):
    made = counted(kind)
    default_structure(loaded(made, **words))
    assert made.calls <= 100 < BUILDING_CALLS


def test_what_is_known_when_the_calls_are_spent_has_to_do(monkeypatch):
    """After each number of calls there is a structure; from some on it is one that was answered for."""
    for most in (0, 1, 5, 20, 45):
        monkeypatch.setattr("mdnum.audit.building.BUILDING_CALLS", most)
        made = counted()
        structure = default_structure(loaded(made, sigma=3.4, epsilon=0.01, rc=8.5))
        assert made.calls <= most and len(structure) >= 32
        assert " used up" in structure.info["origin"]


def test_a_calculation_of_many_atoms_is_not_begun_where_one_of_few_takes_long(monkeypatch):
    """Time goes with the third power of the number of atoms: none is asked about that takes minutes."""
    asked, worked = [], [0.0]

    class Cubic(LennardJones):
        def calculate(self, atoms=None, *words, **more):
            asked.append(len(atoms))
            worked[0] += 0.14 * (len(atoms) / 32) ** 3
            super().calculate(atoms, *words, **more)

    monkeypatch.setattr("time.process_time", lambda: worked[0])
    structure = default_structure(loaded(Cubic, sigma=3.4, epsilon=0.01, rc=15.0))
    assert len(structure) == 32 and max(asked) <= 108


def test_the_deadline_ends_building_and_the_audit_says_that_there_is_no_verdict(monkeypatch, tmp_path):
    """A quarter of the time for a structure; a folder with a page, whatever had been answered."""

    class Passed:
        left = 0.0

        def __init__(self, minutes=None):
            self.passed = minutes is not None

    monkeypatch.setattr("mdnum.deadline.Deadline", Passed)
    outcome = mdnum.audit_calculator(Good, time=1.0, out=tmp_path / "a")
    assert outcome.summary["status"] == frame.UNDECIDED and (tmp_path / "a" / "report.html").exists()
    assert TIME_UP in outcome.summary["structure"]


def test_the_first_line_names_the_structure(tmp_path):
    outcome = mdnum.audit_calculator(Good, planted.chain(), checks="caller", out=tmp_path / "a", report=False)
    assert outcome.summary["headline"].startswith("Good on Ar4Kr2")
    assert all(part in outcome.summary["headline"] for part in ("stress", "other than Ar and Kr", "forces"))
