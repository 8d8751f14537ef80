"""An audit from a calculator to a folder: answers, evidence, and a page made from the folder alone."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from ase import Atoms
from ase.io import read
from ase.io import write as write_structure
from audit import planted
from command_line import call

import mdnum
from mdnum.audit.base import Part
from mdnum.audit.causes import heads
from mdnum.audit.load import Loaded
from mdnum.audit.verdict import judge
from mdnum.cli.audit_print import by_cause, print_rows
from mdnum.errors import InputError
from mdnum.references.findings import finding
from mdnum.report import write
from mdnum.store import RunFolder
from mdnum.units import LJ, METAL
from mdnum.workflow import audit_record
from mdnum.workflow.audit import _in_units
from mdnum.workflow.fork_question import Log

QUICK = "invariance,forces"


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return mdnum.audit_calculator(
        planted.Good, planted.crystal(), temperature=120, steps=40, out=tmp_path_factory.mktemp("good") / "a"
    )


@pytest.fixture(scope="module")
def bad(tmp_path_factory):
    return mdnum.audit_calculator(
        planted.OneImage, planted.crystal(), checks=QUICK, out=tmp_path_factory.mktemp("bad") / "a"
    )


@pytest.mark.slow
def test_what_is_right_is_safe(good):
    summary = good.summary
    assert summary["safe_to_run"] == summary["safe_to_differentiate"] == "yes"
    assert "6 checks found nothing" in summary["headline"]
    assert not [one for one in good.findings if one["severity"] != "info"]
    assert set(good.parts) == {"smoothness", "invariance", "forces", "curl", "state", "dynamics"}
    assert summary["kT"] == pytest.approx(120 * 8.617333e-5, rel=1e-6)


@pytest.mark.slow
def test_the_folder_has_what_the_page_is_made_of(good):
    folder = RunFolder.open(good.folder)
    assert folder.world == "audit" and folder.summary == good.summary
    energies = folder.read("energies")
    mine = energies["run"] == "run"
    assert mine.sum() == 41 and (~mine).sum() == 81
    np.testing.assert_allclose(energies["total"], energies["potential"] + energies["kinetic"], rtol=1e-12)
    named = {curve["name"] for part in good.summary["parts"] for curve in part["curves"]}
    assert set(folder.read("curves")["curve"]) == named
    before = (good.folder / "report.html").read_text()
    write(good.folder)
    assert (good.folder / "report.html").read_text() == before
    for title in ("Smoothness", "Invariance", "Forces", "Curl", "Memory", "Dynamics"):
        assert f"<h2>{title}</h2>" in before
    assert "reproduce.py" not in before and not (good.folder / audit_record.SCRIPT).exists()


def test_a_mistake_is_evidence_that_others_can_see(bad, tmp_path):
    """Both ways of writing the structure down are saved to the last bit, with a script beside them."""
    assert bad.summary["safe_to_run"] == "no" and bad.summary["headline"].startswith("Neither run nor")
    saved = [
        read(bad.folder / audit_record.STRUCTURES / f"images-{when}.extxyz") for when in ("before", "after")
    ]
    energies = []
    for atoms in saved:
        assert isinstance(atoms, Atoms)
        atoms.calc = planted.OneImage()
        energies.append(atoms.get_potential_energy())
    told = next(one for one in bad.findings if one["code"] == "IMAGES")
    assert f"{abs(energies[1] - energies[0]):.3g} eV" in told["text"]
    assert "images-before" in told["text"]
    assert "reproduce.py" in (bad.folder / "report.html").read_text()


def test_the_script_shows_it_without_mdnum(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "from ase.calculators.emt import EMT\n"
        "class Late(EMT):\n"
        "    def calculate(self, *words, **more):\n"
        "        super().calculate(*words, **more)\n"
        "        up = float(self.atoms.positions[0, 2])\n"
        "        self.results['energy'] += up\n"
        "        self.results['free_energy'] += up\n"
        "def make():\n"
        "    return Late()\n"
    )
    copper = Atoms(
        "Cu4", positions=[[0, 0, 0], [1.8, 1.8, 0], [1.8, 0, 1.8], [0, 1.8, 1.8]], cell=[3.6] * 3, pbc=True
    )
    result = mdnum.audit_calculator(str(file), copper, checks="invariance", out=tmp_path / "a", report=False)
    assert {"TRANSLATION", "FACES"} <= {one["code"] for one in result.findings}
    script = (result.folder / audit_record.SCRIPT).read_text()
    assert "mdnum" not in script
    done = subprocess.run(
        [sys.executable, audit_record.SCRIPT], cwd=result.folder, capture_output=True, text=True, check=True
    )
    assert "translation: " in done.stdout and "differ by " in done.stdout


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("ase.calculators.emt:EMT", "return ase.calculators.emt.EMT()"),
        ("ase.calculators.lj:LennardJones(rc=3.0)", "return ase.calculators.lj.LennardJones(rc=3.0)"),
        ("argon/crystal-108", "return mdnum.MdnumCalculator('argon/crystal-108')"),
    ],
)
def test_a_script_makes_the_calculator_that_was_named(words, line):
    assert line in audit_record.script(words, ["images"])
    compile(audit_record.script(words, ["images"]), "script", "exec")


def test_a_calculator_that_fails_is_a_finding_with_its_structure(tmp_path):
    class Dies(planted.Good):
        def answer(self, atoms):
            raise RuntimeError("out of table")

    result = mdnum.audit_calculator(Dies, planted.crystal(), checks="forces,curl", out=tmp_path / "a")
    assert {one["code"] for one in result.findings} == {"CALCULATOR_FAILED"}
    assert result.summary["safe_to_run"] == "no"
    assert list((tmp_path / "a" / "structures").glob("failed-*.extxyz"))
    assert "out of table" in (tmp_path / "a" / "report.html").read_text()


def test_nan_is_a_finding_with_its_structure(tmp_path):
    class Nan(planted.Good):
        def extra(self, atoms, energy, forces):
            return energy, forces * np.nan

    result = mdnum.audit_calculator(Nan, planted.crystal(), checks="forces", out=tmp_path / "a", report=False)
    assert "CALCULATOR_FAILED" in {one["code"] for one in result.findings}
    assert "nan" in result.findings[0]["text"]
    assert not (tmp_path / "a" / "report.html").exists()


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"checks": "smoothnes"}, "Did you mean smoothness"),
        ({"checks": ","}, "no check is named"),
        ({"structure": Atoms()}, "without atoms"),
        ({"calculator": 7}, "that is a int"),
        ({"timestep": -1.0, "checks": "dynamics"}, "expected one above 0"),
        ({"structure": "nowhere.xyz"}, "nowhere.xyz"),
    ],
)
def test_what_cannot_be_asked_is_refused(asked, message, tmp_path):
    words = {"calculator": planted.Good, "structure": planted.crystal()} | asked
    with pytest.raises(InputError, match=message):
        mdnum.audit_calculator(**words, out=tmp_path / "a")


REST = ("invariance", "forces", "curl", "state", "dynamics")


def part(name: str, *found: tuple[str, str]) -> Part:
    return Part(
        name, name, f"{name}.", [finding(code, severity, code.lower(), "") for code, severity in found]
    )


@pytest.mark.parametrize(
    ("parts", "run", "differentiate", "words"),
    [
        ([part("forces")], "not asked", "not asked", "x: 1 check found nothing."),
        (
            [part("smoothness", ("FORCE_JUMP", "warning")), *map(part, REST)],
            "yes", "with care", "x is safe to run, and to be differentiated with care: force_jump.",
        ),
        ([part("curl", ("CURL", "error"))], "no", "no", "Neither run nor differentiate x as it is: curl."),
        (
            [*map(part, ("smoothness", "forces", "curl")), part("dynamics", ("DRIFT", "warning"))],
            "with care", "yes", "x is to be run with care, and safe to differentiate: drift.",
        ),
        (
            [part("state", *((f"A{n}", "warning") for n in range(5)))],
            "with care", "with care", "Use x with care, to run and to differentiate: a0; a1; and 3 more "
            "findings.",
        ),
    ],
)  # fmt: skip
def test_findings_add_up_to_two_answers(parts, run, differentiate, words):
    judged = judge("x", parts)
    assert (judged.run, judged.differentiate, judged.headline) == (run, differentiate, words)


def test_what_is_largely_unasked_is_not_safe():
    parts = [part(name) for name in ("smoothness", *REST)]
    few = replace(parts[1], asked=11, possible=52)
    judged = judge("x", [parts[0], few, *parts[2:]])
    assert (judged.run, judged.differentiate) == ("as far as asked", "yes")
    assert "11 of 52 ways of invariance" in judged.headline and "safe to run" not in judged.headline
    # nearly all of its ways is enough, nothing at all is not
    nearly = replace(parts[1], asked=50, possible=52)
    assert judge("x", [parts[0], nearly, *parts[2:]]).run == "yes"
    nothing = judge("x", [], ["smoothness", *REST])
    assert nothing.run == nothing.differentiate == "not asked" and "safe" not in nothing.headline
    assert judge("x", parts[1:2], ["smoothness", *REST]).differentiate == "not asked"
    # nothing is safe as long as a check that it needs has not begun
    judged = judge("x", [few, *parts[:1]], ["smoothness", *REST])
    assert (judged.run, judged.differentiate) == ("not asked", "not asked")
    assert judged.headline == (
        "x: nothing can be said yet (11 of 52 ways of invariance, 1 of 1 ways of smoothness asked; "
        "forces, curl, state, dynamics not asked)."
    )
    judged = judge("x", [few, *parts[:1], *parts[2:4]], ["smoothness", *REST])
    assert (judged.run, judged.differentiate) == ("not asked", "yes")
    assert "safe to differentiate" in judged.headline and "run" not in judged.headline
    # what was found stands, and so does what it does not rest on
    judged = judge("x", [part("curl", ("CURL", "warning")), few])
    assert judged.run == "with care" and "11 of 52" in judged.headline


def named(*codes: str) -> list[tuple[str, str]]:
    return [(code, "error") for code in codes]


@pytest.mark.parametrize(
    ("found", "above"),
    [
        # images missing along one axis
        (named("JUMP_AMONG_MANY", "IMAGES", "FACES", "ROTATION", "TRANSLATION", "EXTENSIVE"), [1] * 6),
        # neighbors dropped by their place in a list
        (named("NEIGHBOR_CAP_BY_ORDER", "ORDER", "EXTENSIVE", "CURL", "NOT_CONSERVED"), [0] * 5),
        # two that have nothing to do with one another, and one that is found twice
        (named("STALE_STATE", "CURL", "STALE_DYNAMICS", "CURL"), [0, 1, 0, 1]),
        # answers that differ each time explain what differs, those that differ in a last bit do not
        (named("IMAGES", "NOT_REPEATABLE"), [1, 1]),
        ([("IMAGES", "warning"), ("NOT_REPEATABLE", "warning")], [0, 1]),
        # a warning explains no error, and information nothing
        ([("NARROW_CELL", "warning"), ("EXTENSIVE", "error")], [1, 1]),
        ([("STALE_STATE", "info"), ("STALE_DYNAMICS", "info")], [0, 1]),
    ],
)
def test_what_fails_after_another_goes_below_it(found, above):
    assert heads(found) == above


def test_one_mistake_is_one_finding_with_others_below_it(tmp_path, capsys):
    class NoImagesAlongZ(planted.Good):
        def shifts(self, atoms):
            shifts = super().shifts(atoms)
            return shifts[np.abs(shifts[:, 2]) < 1e-9]

    result = mdnum.audit_calculator(
        NoImagesAlongZ, planted.crystal(), checks="invariance", out=tmp_path / "a"
    )
    (cause,) = result.summary["causes"]
    assert cause["code"] == "IMAGES" and {"FACES", "TRANSLATION", "EXTENSIVE"} <= set(cause["below"])
    assert len(result.findings) == 1 + len(cause["below"]) > 5
    assert result.summary["headline"].endswith("the answer depends on which image of an atom is given.")
    page = (tmp_path / "a" / "report.html").read_text()
    assert page.count('<article class="finding') == 1
    assert page.index("<code>IMAGES</code>") < page.index("What may follow from it")
    assert page.index("What may follow from it") < page.index("<code>FACES</code>")
    (shown,) = by_cause(result.summary)["findings"]
    assert all(one["title"] in shown["text"] for one in result.findings if one["code"] != "IMAGES")


def without_times(summary):
    parts = [{key: value for key, value in one.items() if key != "seconds"} for one in summary["parts"]]
    return {key: value for key, value in summary.items() if key != "seconds"} | {"parts": parts}


KILLED = """
import os, signal
from ase.calculators.lj import LennardJones
class Killed(LennardJones):
    def calculate(self, *words, **more):
        super().calculate(*words, **more)
        with open("calls", "a") as file:
            file.write(".")
        if os.path.exists("kill") and os.path.getsize("calls") == int(open("kill").read()):
            os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_audit_is_resumed_and_ends_as_one_that_was_not(tmp_path, monkeypatch, capsys):
    """Killed for good in the second check: the first is in the folder, on its page, and not asked again."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(KILLED)
    write_structure("argon.extxyz", Atoms("Ar3", planted.chain().positions[:3]))
    words = ["audit", "mine.py:Killed", "-s", "argon.extxyz", "--checks", "invariance,forces", "-o"]
    asked = []
    monkeypatch.setattr(Log, "__call__", lambda self, step, steps, info: asked.append(info["phase"]))
    assert call(*words, "whole") == 0
    expected = json.loads((tmp_path / "whole/summary.json").read_text())
    calls = (tmp_path / "calls").stat().st_size
    (tmp_path / "calls").unlink()
    (tmp_path / "kill").write_text(str(calls - 20))
    # -P: nothing beside the person is imported by accident
    done = subprocess.run([sys.executable, "-P", "-m", "mdnum", *words, "cut", "--no-report"], check=False)
    assert done.returncode == -signal.SIGKILL
    (tmp_path / "kill").unlink()
    summary = json.loads((tmp_path / "cut/summary.json").read_text())
    assert [one["name"] for one in summary["parts"]] == ["invariance"]
    assert summary["status"] == "unfinished"
    assert summary["headline"].startswith("Not finished: forces comes next.")
    assert call("report", "cut") == 0
    assert "forces not asked" in (tmp_path / "cut/report.html").read_text()
    asked.clear()
    capsys.readouterr()
    assert call("audit", "--resume", "cut") == 0
    assert set(asked) == {"forces"}
    resumed = json.loads((tmp_path / "cut/summary.json").read_text())
    assert without_times(resumed) == without_times(expected)
    one, other = (RunFolder.open(name).table("curves") for name in ("cut", "whole"))
    assert one.equals(other)
    # nothing is left
    asked.clear()
    assert call("audit", "--resume", "cut") == 0 and not asked
    for more in (("-o", "x"), ("--checks", "curl"), ("mine.py:Other",)):
        assert call("audit", "--resume", "cut", *more) == 2


def test_a_deadline_ends_an_audit_and_the_rest_is_resumed(tmp_path, monkeypatch):
    class Spent:
        looks = 150

        def __init__(self, minutes=None):
            self.limited = minutes is not None

        @property
        def passed(self):
            Spent.looks -= self.limited
            return self.limited and Spent.looks < 0

    monkeypatch.setattr("mdnum.deadline.Deadline", Spent)
    atoms, checks = planted.chain(), "invariance,forces,curl"
    whole = mdnum.audit_calculator(planted.Good, atoms, checks=checks, out=tmp_path / "whole", report=False)
    cut = mdnum.audit_calculator(planted.Good, atoms, checks=checks, time=1.0, out=tmp_path / "cut")
    assert cut.summary["status"] == "unfinished"
    ways = cut.summary["parts"][-1]
    assert ways["name"] == "forces" and 0 < ways["asked"] < ways["possible"] == 15
    assert f"{ways['asked']} of 15 ways of forces, curl not asked" in cut.summary["headline"]
    assert {"what": "the check of curl", "why": "the time was up", "part": "curl"} in cut.summary["left_out"]
    assert f"{ways['asked']} of 15 ways asked" in (tmp_path / "cut/report.html").read_text()
    # asked again, and not as far: nothing that was known is lost
    Spent.looks = 3
    less = mdnum.audit_calculator(planted.Good, time=1.0, resume=tmp_path / "cut", report=False)
    assert less.summary["headline"] == cut.summary["headline"]
    with pytest.raises(InputError, match="has no name"):
        mdnum.audit_calculator(resume=tmp_path / "cut")
    done = mdnum.audit_calculator(planted.Good, resume=tmp_path / "cut", report=False)
    assert without_times(done.summary) == without_times(whole.summary)
    assert done.parts["forces"].says == whole.parts["forces"].says
    with pytest.raises(InputError, match="--time"):
        monkeypatch.undo()
        mdnum.audit_calculator(planted.Good, atoms, time=0.0, out=tmp_path / "none")


#: Units that a calculator without dimensions has none of; kT and file names are no units.
DIMENSIONS = re.compile(r"(?<![\w./])(m?eV|Å|fs|ps|K)(?![\w.]\w|\w)")


def test_an_audit_in_reduced_units_names_no_others(tmp_path, monkeypatch, capsys):
    """Headline, findings, tables, labels of figures, the script beside the page, and the terminal."""

    class Wrong(planted.OneImage, planted.HardEdge):
        def extra(self, atoms, energy, forces):
            return energy, forces + 0.1

    loaded = Loaded("reduced", "reduced", Wrong, units=LJ, kT=0.1)
    monkeypatch.setattr("mdnum.audit.load.load_calculator", lambda words: loaded)
    atoms = planted.crystal()
    atoms.info["origin"] = "8 atoms, nearest distance 2.76 Å"
    checks = "invariance,forces,curl,state,dynamics"
    result = mdnum.audit_calculator("reduced", atoms, checks=checks, steps=16, out=tmp_path / "a")
    codes = {one["code"] for one in result.findings}
    assert {"IMAGES", "FORCES_NOT_GRADIENT", "NET_FORCE", "ENERGY_JUMP", "NOT_CONSERVED"} & codes
    print_rows(by_cause(result.summary))
    page = (tmp_path / "a/report.html").read_text()
    assert "<svg" in page and "mε/atom/τ" in page and "ε/σ" in page and "reproduce.py" in page
    seen = re.sub(r"<(style|script)\b.*?</\1>|<(?!!--)[^>]*>", " ", page, flags=re.DOTALL)
    for text in (seen, (tmp_path / "a/summary.json").read_text(), capsys.readouterr().out):
        assert not [text[one.start() - 40 : one.end() + 20] for one in DIMENSIONS.finditer(text)]


def test_units_are_replaced_and_names_of_files_are_not():
    rows = {"Table": [{"curl (eV/Å²)": 1.0, "plane": "x"}]}
    said = Part("curl", "Curl", "0.1 eV/Å", [finding("CURL", "error", "t", "1 meV", "r")], rows)
    said = replace(said, skipped=[("a cell 1.6 Å wide", "eV.py in SteveV failed at 3 eV.")])
    found = _in_units(said, LJ)
    assert found.says == "0.1 ε/σ" and found.findings[0]["text"] == "1 mε"
    assert found.skipped[0] == ("a cell 1.6 σ wide", "eV.py in SteveV failed at 3 ε.")
    assert found.tables["Table"][0] == {"curl (ε/σ²)": 1.0, "plane": "x"}
    assert _in_units(said, METAL) is said


def test_a_summary_is_json_whatever_was_not_finite(bad):
    text = (bad.folder / "summary.json").read_text()
    json.loads(text, parse_constant=lambda word: pytest.fail(word))
