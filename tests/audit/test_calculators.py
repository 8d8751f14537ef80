"""From words to a calculator, what happens when it fails, and how much it is asked."""

from __future__ import annotations

import time
from pathlib import Path

import ase.io
import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.calculator import Calculator, all_changes
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from audit import planted
from audit.planted import Good, chain, codes
from scipy.spatial import KDTree

from mdnum.audit.base import TIME_UP, TimeUp
from mdnum.audit.building import default_structure
from mdnum.audit.checks import CHECKS
from mdnum.audit.checks.alone import AloneCheck
from mdnum.audit.conclusion import in_order, needed_to
from mdnum.audit.noise import NoiseFloor
from mdnum.audit.record import load_calculator
from mdnum.audit.structures import read_structure
from mdnum.audit.subject import CalculatorError, CalculatorSubject, LoadedCalculator
from mdnum.audit.thresholds import walk_pairs
from mdnum.errors import InputError

NAMES = [
    "forces", "curl", "caller", "invariance", "periodicity", "alone", "smoothness", "state", "dynamics",
]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "stem", "parameters"),
    [
        ("ase.calculators.emt:EMT", "EMT", {}),
        ("ase.calculators.emt:EMT()", "EMT", {}),
        ("ase.calculators.lj:LennardJones(rc=8.5, smooth=True)", "LennardJones", {"rc": 8.5, "smooth": True}),
        # a file is run again for each calculator
        ("calculator = LennardJones(epsilon=WELL)\n", "calculator", {"epsilon": 0.25}),
        ("calc = LennardJones(epsilon=WELL)\n", "calc", {"epsilon": 0.25}),
        ("def make():\n    return LennardJones(epsilon=WELL)\n", "make", {"epsilon": 0.25}),
        ("mine = LennardJones(epsilon=WELL)\n", "other", {"epsilon": 0.25}),
    ],
)
def test_what_words_name_is_made_anew_each_time(words: str, stem: str, parameters: dict, tmp_path: Path):
    if words.endswith("\n"):
        (tmp_path / "neighbor.py").write_text("WELL = 0.25\n")
        text = "from ase.calculators.lj import LennardJones\nfrom neighbor import WELL\n"
        (tmp_path / f"{stem}.py").write_text(text + words)
        words = f"{tmp_path / stem}.py{':mine' if stem == 'other' else ''}"
    loaded = load_calculator(words)
    one, other = loaded.make(), loaded.make()
    assert isinstance(one, EMT | LennardJones) and one is not other and loaded.stem == stem
    assert {name: one.parameters[name] for name in parameters} == parameters


def test_a_system_brings_its_structure_and_temperature():
    loaded = load_calculator("argon/crystal-108")
    assert loaded.atoms is not None and len(loaded.atoms) == 108
    assert loaded.units.name == "lj" and loaded.kT == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "no calculator was given"),
        ("nonesuch.package:Thing", "No module named 'nonesuch'"),
        ("ase.calculators.emt:Emt", "Did you mean EMT"),
        ("ase.calculators.emt.EMT", "ase.calculators.emt:EMT"),
        ("ase.calculators.emt:EMT(a=open('x'))", "not a literal"),
        ("ase.calculators.lj:LennardJones(rc=-(-8.5))", "not a literal"),
        ("ase.calculators.emt:EMT(**{})", "cannot be used here"),
        ("ase.calculators.emt:EMT().results", "only a name"),
        ("ase.calculators.emt:EMT(", "the name of a function"),
        ("ase.calculators.lj:LennardJones(3)", "could not be constructed: TypeError"),
        ("ase.calculators.tersoff:Tersoff", "Class(argument=value)"),
        ("ase.build:molecule('H2O')", "expected an ASE calculator"),
        ("argon/crystl-108", "Did you mean argon/crystal-108"),
        ("none.py", "the file is missing"),
        ("{folder}/fails.py", "ZeroDivisionError"),
        ("{folder}/empty.py", "or calc or make"),
    ],
)
def test_a_mistake_says_what_to_write(words: str, message: str, tmp_path: Path):
    (tmp_path / "fails.py").write_text("1 / 0\n")
    (tmp_path / "empty.py").write_text("x = 1\n")
    with pytest.raises(InputError) as error:
        load_calculator(words.replace("{folder}", str(tmp_path)))
    assert message in str(error.value)


def test_a_class_of_the_file_is_suggested_and_not_what_it_imports(tmp_path: Path):
    file = tmp_path / "mine.py"
    imports = "from ase.calculators.calculator import Calculator\nfrom ase.build import bulk\n"
    file.write_text(f"{imports}class MyMorse(Calculator):\n    pass\n")
    with pytest.raises(InputError) as error:
        load_calculator(str(file))
    assert f"{file}:MyMorse" in str(error.value)
    assert not {"bulk", "Calculator", "Calculator,"} & {*str(error.value).split()}
    # a file that has nothing of its own
    file.write_text("from ase.calculators.emt import EMT\n")
    with pytest.raises(InputError) as error:
        load_calculator(str(file))
    assert f"{file}:EMT" in str(error.value)


class Counting(Calculator):
    """Counts how often it was asked, and can be made to fail."""

    implemented_properties = ["energy", "forces"]  # noqa: RUF012

    def __init__(self, energy: object = 1.0, forces: object = None, raises: Exception | None = None):
        super().__init__()
        self.asked, self.answer, self.pushes, self.raises = 0, energy, forces, raises

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.asked += 1
        if self.raises:
            raise self.raises
        assert isinstance(atoms, Atoms)
        forces = np.zeros((len(atoms), 3)) if self.pushes is None else np.asarray(self.pushes)
        self.results = {"energy": self.answer, "forces": forces}


def test_the_last_bit_of_a_coordinate_is_a_new_question():
    """ASE's cache takes coordinates within 1e-15 for the same, hundreds of doubles near 0."""
    atoms = Atoms("Ar2", [(0.0, 0, 0), (3.0, 0, 0)])
    asked = planted.subject(Counting, atoms)
    asked.both(atoms)
    assert asked.calculator.asked == 1
    atoms.positions[0, 0] = 1e-300
    asked.energy(atoms)
    assert asked.calculator.asked == 2
    asked.forget()
    asked.energy(atoms)
    assert asked.calculator.asked == 3


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({"energy": float("nan")}, "energy of nan"),
        ({"energy": [1.0, 2.0]}, "not one number"),
        ({"raises": ValueError("no such element")}, "ValueError.*no such element"),
        ({"forces": [[0.0, 0.0, 0.0], [0.0, np.inf, 0.0]]}, "on atom 1"),
        ({"forces": [[0.0, 0.0, 0.0]]}, r"shape \(1, 3\) for 2 atoms"),
    ],
)
def test_a_calculator_that_fails_leaves_the_structure_to_the_last_bit(answer, message, tmp_path: Path):
    rng = np.random.default_rng(0)
    atoms = Atoms("Ar2", rng.normal(size=(2, 3)), cell=rng.normal(size=(3, 3)), pbc=(True, False, True))
    asked = CalculatorSubject("planted", lambda: Counting(**answer), atoms, folder=tmp_path / "made")
    with pytest.raises(CalculatorError, match=message) as error:
        asked.both(atoms)
    assert error.value.structure == tmp_path / "made" / "failed-1.extxyz"
    saved = ase.io.read(error.value.structure)
    assert isinstance(saved, Atoms) and (saved.pbc == atoms.pbc).all()
    assert (saved.positions == atoms.positions).all() and (saved.cell.array == atoms.cell.array).all()
    with asked.trying(), pytest.raises(CalculatorError) as error:
        asked.both(atoms)
    assert error.value.structure is None


def test_default_structures():
    """A crystal at the calculator's own least energy with room for two cutoffs, and water for rigid water."""
    argon = default_structure(
        load_calculator("ase.calculators.lj:LennardJones(sigma=3.0, epsilon=0.01, rc=7)")
    )
    assert set(argon.symbols) == {"Ar"} and argon.cell.lengths().min() >= 14
    # fcc Lennard-Jones has its nearest neighbors at about 1.09 σ (1.0902 without a cutoff)
    distances = argon.get_all_distances(mic=True)
    assert np.median(np.sort(distances, axis=1)[:, 1:13]) == pytest.approx(1.09 * 3.0, rel=0.04)
    assert default_structure(load_calculator("ase.calculators.emt:EMT")).symbols[0] == "Cu"
    water = default_structure(load_calculator("ase.calculators.tip3p:TIP3P(rc=4.5)"))
    assert water.get_chemical_symbols()[:4] == ["O", "H", "H", "O"]
    for make in (planted.Attached, planted.ThroughAtoms):
        assert set(default_structure(LoadedCalculator("x", "x", make)).symbols) == {"Ar"}


def test_a_calculator_that_takes_long_is_asked_about_fewer_atoms(monkeypatch):
    """Its own work counts, and not the time that passes while other programs are at work."""
    worked, passed = [0.0], [0.0]

    class Slow(LennardJones):
        clock = worked

        def calculate(self, *words, **more):
            self.clock[0] += 0.4 if len(words[0]) > 40 else 0.0
            super().calculate(*words, **more)

    class Held(Slow):
        clock = passed

    monkeypatch.setattr(time, "process_time", lambda: worked[0])
    monkeypatch.setattr(time, "perf_counter", lambda: passed[0])
    quick, slow, held = (
        default_structure(LoadedCalculator("x", "x", lambda make=make: make(sigma=3.4, epsilon=0.01, rc=8.0)))
        for make in (LennardJones, Slow, Held)
    )
    assert len(slow) == 32 and len(quick) == len(held) > 100
    assert all(part in slow.info["origin"] for part in ("108 atoms", "0.4 s"))
    assert held.info["origin"] == quick.info["origin"]


@pytest.mark.parametrize(
    ("answer", "raises", "cutoff", "code"),
    [(float("nan"), None, 6.3, "LONELY_NOT_FINITE"), (0.0, ValueError("min()"), 3.4, "LONELY_FAILS")],
)
def test_who_fails_without_neighbors_gets_a_structure_and_a_finding(answer, raises, cutoff, code: str):
    """Two atoms that do not feel one another are asked about first, and are what these fail on."""

    class Lonely(Counting):
        def calculate(self, atoms=None, properties=None, system_changes=all_changes):
            assert isinstance(atoms, Atoms)
            nearest = KDTree(atoms.positions).query(atoms.positions, 2)[0][:, 1]
            self.answer, self.raises = (0.0, None) if (nearest < cutoff).all() else (answer, raises)
            super().calculate(atoms, properties, system_changes)

    atoms = default_structure(LoadedCalculator("lonely", "lonely", Lonely))
    assert cutoff < 6 or atoms.cell.lengths().min() > 2 * cutoff
    found = AloneCheck()
    found.look(planted.subject(Lonely, atoms), atoms, NoiseFloor(1e-12, 1e-12))
    assert code in codes(found.findings())


def test_who_never_answers_is_named_in_one_line_with_the_structure_saved():
    with pytest.raises(InputError, match="or for water") as error:
        default_structure(LoadedCalculator("never", "never", lambda: Counting(raises=ValueError("no"))))
    assert "--structure" in str(error.value.remedy)
    saved = ase.io.read(str(error.value).partition("saved in ")[2].partition(")")[0])
    assert isinstance(saved, Atoms) and set(saved.symbols) == {"O", "H"}


def test_structures_from_files(tmp_path: Path):
    ase.io.write(tmp_path / "three.extxyz", [bulk("Ar"), bulk("Cu"), bulk("Al")])
    assert read_structure(tmp_path / "three.extxyz").symbols[0] == "Al"
    assert read_structure(f"{tmp_path / 'three.extxyz'}@1").symbols[0] == "Cu"
    ase.io.write(tmp_path / "two.traj", [bulk("Ar"), bulk("Cu")])
    (tmp_path / "bad.extxyz").write_text("1\n\nAr 0 nan 0\n")
    for name, message in {
        "none.xyz": "does not exist", "bad.extxyz": "not finite",
        "three.extxyz@9": r"@9: .*no structure 9 .*3\)",
        "three.extxyz@-4": r"no structure -4 .*3\)",
        "two.traj@2": r"no structure 2 .*2\)",
    }.items():  # fmt: skip
        with pytest.raises(InputError, match=message):
            read_structure(tmp_path / name)


# -- how much is asked ----------------------------------------------------------------------------


class Looks:
    """A deadline that passes after so many looks at it."""

    def __init__(self, looks: int):
        self.looks = looks

    @property
    def passed(self) -> bool:
        self.looks -= 1
        return self.looks < 0


def three(looks: int | None = None):
    found = planted.subject(Good, Atoms("Ar3", positions=chain().positions[:3]))
    if looks is not None:
        found.meter.deadline = Looks(looks)  # pyright: ignore[reportAttributeAccessIssue]
    return found


def check(name: str):
    made = CHECKS[name](steps=16)
    if name == "smoothness":
        made.neighbors, made.routes = 8, 1
    return made


def test_checks_are_known_in_their_order():
    assert in_order(list(CHECKS)) == NAMES
    assert needed_to("run") == {
        "caller", "invariance", "periodicity", "alone", "forces", "state", "dynamics",
    }  # fmt: skip
    assert needed_to("differentiate") == {"smoothness", "forces", "curl"}
    assert all(CHECKS.description(name).endswith("?") for name in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_evidence_is_the_same_on_a_machine_a_million_times_slower(name: str, monkeypatch):
    quick = check(name)(three())
    clock = iter(range(0, 10**12, 10**6))
    monkeypatch.setattr("mdnum.audit.base.perf_counter", lambda: float(next(clock)))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    slow = check(name)(three())
    assert (slow.asked, slow.possible) == (quick.asked, quick.possible)
    assert slow.asked == slow.possible > 0
    assert (slow.says, slow.tables, slow.skipped) == (quick.says, quick.tables, quick.skipped)
    assert slow.seconds > 1e5 > quick.seconds


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("alone", "dynamics")])
def test_a_deadline_leaves_ways_unasked_and_says_which(name: str):
    asked = three({"forces": 100, "curl": 100, "state": 100, "caller": 62, "periodicity": 50}.get(name, 40))
    if name == "smoothness":
        asked.known["walks"] = walk_pairs(three())
    result = check(name)(asked)
    assert 0 < result.asked < result.possible
    assert any(why == TIME_UP for _, why in result.skipped)


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_found_by_a_check_for_which_there_was_no_time(name: str):
    asked = three(0)
    with pytest.raises(TimeUp):
        check(name)(asked)
    assert asked.meter.calls < 150
