"""An audit from a calculator to a folder: answers, evidence, and a page made from the folder alone."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.lj import LennardJones
from ase.io import read
from ase.io import write as write_structure
from audit import planted
from audit.planted import but
from command_line import call
from other_package import install

import mdnum
from mdnum.audit import checks
from mdnum.audit.base import TIME_UP, CheckResult, Meter, finding
from mdnum.audit.causes import heads
from mdnum.audit.conclusion import answers, in_order
from mdnum.audit.record import STRUCTURES, AuditState, encoded, script
from mdnum.audit.subject import LoadedCalculator
from mdnum.errors import InputError
from mdnum.plain import plain
from mdnum.report.words import listed
from mdnum.store import RunFolder
from mdnum.units import LJ, Measured
from mdnum.verbs import frame
from mdnum.verbs.audit import KINDS, TEXTS, AuditView

QUICK = "invariance,forces"
CHECKS = in_order(list(checks.CHECKS))


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    out = tmp_path_factory.mktemp("good") / "a"
    return mdnum.audit_calculator(planted.Good, planted.crystal(), temperature=120, steps=40, out=out)


@pytest.fixture(scope="module")
def bad(tmp_path_factory):
    out = tmp_path_factory.mktemp("bad") / "a"
    return mdnum.audit_calculator(planted.OneImage, planted.crystal(), checks=QUICK, out=out)


def codes(outcome) -> set[str]:
    return {one.code for one in outcome.verdict.findings}


@pytest.mark.slow
def test_what_is_right_is_safe_and_in_the_folder(good):
    summary = good.summary
    assert summary["safe_to_run"] == summary["safe_to_differentiate"] == "yes"
    assert "9 checks found no problems" in summary["headline"] and good.verdict.tone == "good"
    assert list(good.result) == CHECKS and summary["kT"] == pytest.approx(120 * 8.617333e-5, rel=1e-6)
    folder = RunFolder.open(good.folder)
    assert folder.kind == "audit" and folder.summary == plain(summary)
    energies = folder.read("energies")
    mine = energies["run"] == "run"
    assert mine.sum() == 41 and (~mine).sum() == 81
    np.testing.assert_allclose(energies["total"], energies["potential"] + energies["kinetic"], rtol=1e-12)
    charts = {f"{one.name}-{n}" for one in good.result.values() for n, _ in enumerate(one.charts, 1)}
    assert set(folder.read("curves")["curve"]) == charts
    before = (good.folder / "report.html").read_text()
    frame.finish(good.folder)
    assert (good.folder / "report.html").read_text() == before
    titles = [section.title for section in good.page.sections]
    assert {"Smoothness", "Invariance", "Forces", "Curl", "Memory", "Dynamics"} <= set(titles)
    assert "Reproduce" not in titles and not (good.folder / "reproduce.py").exists()


def lennard_jones():
    """Switched off smoothly, and with room for 79 neighbors of each atom."""
    return LennardJones(sigma=3.405, epsilon=0.0103, rc=8.5, ro=7.0, smooth=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "make",
    [
        planted.Good,
        pytest.param(planted.ByAppearance, marks=pytest.mark.nightly),
        pytest.param(lennard_jones, marks=pytest.mark.nightly),
    ],
)
def test_calls_that_a_check_does_not_need_are_for_those_after_it(make, tmp_path):
    """Clean small potentials are asked everything, within the sum of the limits."""
    calls = []

    def counted():
        made = make()
        calculate = made.calculate
        made.calculate = lambda *words, **more: (calls.append(1), calculate(*words, **more))
        return made

    atoms = bulk("Ar", cubic=True).repeat(2) if make is lennard_jones else None
    outcome = mdnum.audit_calculator(counted, atoms, out=tmp_path / "a", report=False)
    assert all(one["asked"] == one["possible"] for one in outcome.summary["parts"])
    assert "as far as tested" not in outcome.summary["headline"] and len(calls) <= 12_000


def test_a_check_leaves_the_calls_that_it_does_not_make():
    meter = Meter()
    asked = planted.subject(planted.Good)
    asked.meter = meter
    checks.CHECKS["alone"]()(asked)
    spare = checks.CHECKS["alone"].calls - meter.calls
    assert meter.spare == spare > 0
    before = meter.calls
    checks.CHECKS["curl"]()(asked)
    assert meter.most == before + checks.CHECKS["curl"].calls + spare


def test_a_mistake_is_evidence_that_others_can_see(bad):
    """Both ways of writing the structure down are saved to the last bit, with a script beside them."""
    assert bad.summary["safe_to_run"] == "no" and "safe neither to run" in bad.summary["headline"]
    energies = []
    for when in ("before", "after"):
        atoms = read(bad.folder / STRUCTURES / f"images-{when}.extxyz")
        assert isinstance(atoms, Atoms)
        atoms.calc = planted.OneImage()
        energies.append(atoms.get_potential_energy())
    told = next(one for one in bad.verdict.findings if one.code == "IMAGES")
    assert told.values["energy"].value == pytest.approx(abs(energies[1] - energies[0]), rel=1e-6)
    assert told.values["slug"] == "images" and "images-before" in told.text
    assert "Reproduce" in [section.title for section in bad.page.sections]
    json.loads((bad.folder / "summary.json").read_text(), parse_constant=pytest.fail)


def test_the_script_shows_it_without_mdnum(tmp_path):
    (tmp_path / "mine.py").write_text(
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
    places = [[0, 0, 0], [1.8, 1.8, 0], [1.8, 0, 1.8], [0, 1.8, 1.8]]
    copper = Atoms("Cu4", positions=places, cell=[3.6] * 3, pbc=True)
    words = str(tmp_path / "mine.py")
    outcome = mdnum.audit_calculator(words, copper, checks="invariance", out=tmp_path / "a", report=False)
    assert {"TRANSLATION", "FACES"} <= codes(outcome)
    assert "mdnum" not in (outcome.folder / "reproduce.py").read_text()
    command = [sys.executable, "reproduce.py"]
    done = subprocess.run(command, cwd=outcome.folder, capture_output=True, text=True, check=True)
    assert "translation: " in done.stdout and "differ by " in done.stdout


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("ase.calculators.emt:EMT", "return ase.calculators.emt.EMT()"),
        ("ase.calculators.lj:LennardJones(rc=3.0)", "return ase.calculators.lj.LennardJones(rc=3.0)"),
        ("argon/crystal-108", "return mdnum.MdnumCalculator('argon/crystal-108')"),
        ("mine.py:Own(a=1)", "return made['Own'](a=1)"),
    ],
)
def test_a_script_makes_the_calculator_that_was_named(words, line):
    assert line in script(words, ["images"])
    compile(script(words, ["images"]), "script", "exec")


def _raise(self, atoms):
    raise RuntimeError("out of table")


@pytest.mark.parametrize(
    ("make", "why"),
    [(but(answer=_raise), "out of table"), (but(extra=lambda self, atoms, e, f: (e, f * np.nan)), "nan")],
    ids=["raises", "nan"],
)
def test_a_calculator_that_fails_is_a_finding_with_its_structure(make, why, tmp_path):
    outcome = mdnum.audit_calculator(make, planted.crystal(), checks="forces,curl", out=tmp_path / "a")
    assert codes(outcome) == {"CALCULATOR_FAILED"} and outcome.summary["safe_to_run"] == "no"
    assert why in outcome.verdict.findings[0].values["why"]
    assert list((tmp_path / "a" / "structures").glob("failed-*.extxyz"))
    assert outcome.result["forces"].says[0] == ["failed"]


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"checks": ","}, "was selected"),
        ({"structure": Atoms()}, "has no atoms"),
        ({"calculator": 7}, "type int"),
        ({"time": 0.0}, "--time"),
    ],
)
def test_what_cannot_be_asked_is_named(asked, message, tmp_path):
    words = {"calculator": planted.Good, "structure": planted.crystal()} | asked
    with pytest.raises(InputError, match=message):
        mdnum.audit_calculator(**words, out=tmp_path / "a")


REST = ("invariance", "forces", "curl", "state", "dynamics", "caller", "periodicity", "alone")


def part(name: str, *found: tuple[str, str], asked: int = 1, possible: int = 1) -> CheckResult:
    findings = [finding(code, severity, title=code.lower()) for code, severity in found]  # type: ignore[arg-type]
    return CheckResult(([], {}), findings, name=name, title=name, asked=asked, possible=possible)


def judged(parts: list[CheckResult], wanted: list[str] | None = None) -> tuple[str, str, str]:
    names = wanted or [one.name for one in parts]
    state = AuditState("x", True, encoded(Atoms("Ar")), 1.0, "metal", names, None, None, None, parts)
    told = answers(parts, names)
    headline = KINDS["audit"].judge(AuditView(cast(Any, None), {}, given=state)).headline
    return told["run"], told["differentiate"], headline


NO, CARE = (TEXTS(f"same_{answer}", name="x on Ar") for answer in ("no", "with_care"))


@pytest.mark.parametrize(
    ("parts", "answer", "headline"),
    [
        ([part("forces")], "not tested", TEXTS("found_nothing", head="x on Ar", checks=1)),
        ([part("smoothness", ("A", "warning")), *map(part, REST)], "with care", f"{CARE}: a."),
        ([part("curl", ("B", "error"))], "no", f"{NO}: b."),
        (
            [part("state", *((f"A{n}", "warning") for n in range(5)))], "with care",
            f"{CARE}: a0; a1; and 3 more findings.",
        ),
    ],
)  # fmt: skip
def test_findings_add_up_to_two_answers(parts, answer, headline):
    found, others = judged(parts), [one for one in CHECKS if one not in {two.name for two in parts}]
    unasked = TEXTS("unasked", elements="Ar")
    if others:
        unasked = TEXTS("unasked_checks", elements="Ar", checks=listed(others))
        assert all(name in unasked for name in others)
    assert found == (answer, answer, f"{headline} {unasked}")
    assert headline.count("x on Ar") == 1 and "stress" in unasked and "Ar" in unasked


def test_checks_that_were_not_selected_are_named_and_a_measured_number_is_not_nothing():
    every = [part(name) for name in CHECKS]
    headline = judged(every)[2]
    assert f" {len(CHECKS)} checks" in headline and "stress" in headline
    assert not [name for name in CHECKS if name in headline]
    headline = judged([part("forces", ("A", "info")), *every[1:-1]])[2]
    assert f" {len(CHECKS) - 1} checks" in headline
    assert [name for name in CHECKS if name in headline] == [list(CHECKS)[-1]] == ["dynamics"]


@pytest.mark.slow
def test_no_bound_is_below_the_largest_error(good):
    """A difference may be smaller than its error by chance, and promises no more than the error."""
    _, values = good.result["forces"].says
    assert values["clear_bound"] == max(values["clear_gap"], values["clear_error"])
    values = {**values, "clear_gap": 3e-4, "clear_error": 0.002, "clear_bound": 0.002}
    assert "to within 0.002 eV" in TEXTS("forces_right", **values)


def test_what_is_largely_unasked_is_not_safe():
    parts, every = [part(name) for name in ("smoothness", *REST)], ["smoothness", *REST]
    few = part("invariance", asked=11, possible=52)
    run, differentiate, headline = judged([parts[0], few, *parts[2:]])
    assert (run, differentiate) == ("as far as tested", "yes")
    assert "11 of 52" in headline and "invariance" in headline and "safe to run" not in headline
    # nearly all of its ways is enough, nothing at all is not
    assert judged([parts[0], part("invariance", asked=50, possible=52), *parts[2:]])[0] == "yes"
    run, differentiate, headline = judged([], every)
    assert run == differentiate == "not tested" and "safe" not in headline
    # nothing is safe as long as a check that it needs has not begun
    run, differentiate, headline = judged([few, *parts[:1]], every)
    assert run == differentiate == "not tested"
    assert headline.startswith("x on Ar: ") and "11 of 52" in headline
    run, differentiate, headline = judged([few, *parts[:1], *parts[2:4]], every)
    assert (run, differentiate) == ("not tested", "yes") and "safe to differentiate" in headline
    # codes that do not bear on a question
    told = answers([part("smoothness", ("FORCE_JUMP", "warning")), *map(part, REST)], every)
    assert (told["run"], told["differentiate"]) == ("yes", "with care")
    told = answers([*parts[:-1], part("dynamics", ("DRIFT", "warning"))], every)
    assert (told["run"], told["differentiate"]) == ("with care", "yes")


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
        ([("IMAGES", "warning"), ("NOT_BIT_IDENTICAL", "warning")], [0, 1]),
        # a warning explains no error, and information nothing
        ([("NARROW_CELL", "warning"), ("EXTENSIVE", "error")], [1, 1]),
        ([("STALE_STATE", "info"), ("STALE_DYNAMICS", "info")], [0, 1]),
    ],
)
def test_what_fails_after_another_goes_below_it(found, above):
    assert heads(found) == above


def test_one_mistake_is_one_finding_with_others_below_it(tmp_path):
    def shifts(self, atoms):
        found = planted.Good.shifts(self, atoms)
        return found[np.abs(found[:, 2]) < 1e-9]

    outcome = mdnum.audit_calculator(
        but(shifts=shifts), planted.crystal(), checks="invariance", out=tmp_path / "a"
    )
    (cause,) = outcome.summary["causes"]
    assert cause["code"] == "IMAGES" and {"FACES", "TRANSLATION", "EXTENSIVE"} <= set(cause["below"])
    (head,) = [one for one in outcome.verdict.findings if not one.cause]
    assert head.code == "IMAGES" and len(outcome.verdict.findings) == 1 + len(cause["below"]) > 5
    assert f": {head.title}." in outcome.summary["headline"]
    assert (tmp_path / "a" / "report.html").read_text().count('<article class="finding') == 1


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
    note = lambda step, steps, info: asked.append(info["phase"])  # noqa: E731
    monkeypatch.setattr(frame, "logged", lambda folder, progress: note)
    assert call(*words, "whole", "--no-report") == 0
    expected = json.loads((tmp_path / "whole/summary.json").read_text())
    calls = (tmp_path / "calls").stat().st_size
    (tmp_path / "calls").unlink()
    (tmp_path / "kill").write_text(str(calls - 20))
    # -P: nothing beside the person is imported by accident
    done = subprocess.run([sys.executable, "-P", "-m", "mdnum", *words, "cut", "--no-report"], check=False)
    assert done.returncode == -signal.SIGKILL
    (tmp_path / "kill").unlink()
    summary = json.loads((tmp_path / "cut/summary.json").read_text())
    assert [one["name"] for one in summary["parts"]] == ["forces"]
    assert summary["status"] == "unfinished"
    assert "invariance" in summary["headline"]
    assert call("report", "cut") == 0
    assert "invariance not tested" in (tmp_path / "cut/report.html").read_text()
    asked.clear()
    capsys.readouterr()
    assert call("audit", "--resume", "cut", "--no-report") == 0 and set(asked) == {"invariance"}
    resumed = json.loads((tmp_path / "cut/summary.json").read_text())
    assert without_times(resumed) == without_times(expected)
    one, other = (RunFolder.open(name).table("curves") for name in ("cut", "whole"))
    assert one.equals(other)
    # nothing is left
    asked.clear()
    assert call("audit", "--resume", "cut", "--no-report") == 0 and not asked
    assert RunFolder.open("cut").table("curves").equals(other)
    for more in (("-o", "x"), ("--checks", "curl"), ("mine.py:Other",)):
        assert call("audit", "--resume", "cut", *more) == 2


def test_a_deadline_ends_an_audit_and_the_rest_is_resumed(tmp_path, monkeypatch):
    class Spent:
        looks, left = 600, 1e6

        def __init__(self, minutes=None):
            self.limited = minutes is not None

        @property
        def passed(self):
            Spent.looks -= self.limited
            return self.limited and Spent.looks < 0

    monkeypatch.setattr("mdnum.deadline.Deadline", Spent)
    atoms, checks = planted.chain(), "invariance,forces,curl"
    ask = mdnum.audit_calculator
    whole = ask(planted.Good, atoms, checks=checks, out=tmp_path / "whole", report=False)
    cut = ask(planted.Good, atoms, checks=checks, time=1.0, out=tmp_path / "cut", report=False)
    assert cut.summary["status"] == frame.PARTIAL
    ways = {one["name"]: one for one in cut.summary["parts"]}["curl"]
    assert 1 < ways["asked"] < ways["possible"] == 11
    assert f"{ways['asked']} of 11" in cut.summary["headline"] and "invariance" in cut.summary["headline"]
    left = {"what": "the check of invariance", "why": TIME_UP, "part": "invariance"}
    assert left in cut.summary["left_out"]
    # asked again, and not as far: nothing that was known is lost
    Spent.looks = 3
    less = ask(planted.Good, time=1.0, resume=tmp_path / "cut", report=False)
    assert less.summary["headline"] == cut.summary["headline"]
    with pytest.raises(InputError, match="a Python object"):
        ask(resume=tmp_path / "cut")
    done = ask(planted.Good, resume=tmp_path / "cut", report=False)
    assert without_times(done.summary) == without_times(whole.summary)
    assert plain(done.result["curl"].says) == plain(whole.result["curl"].says)


#: Units that a calculator without dimensions has none of; kT and file names are no units.
DIMENSIONS = re.compile(r"(?<![\w./])(m?eV|Å|fs|ps|K)(?![\w.]\w|\w)")


def test_an_audit_in_reduced_units_names_no_others(tmp_path, monkeypatch):
    """Headline, findings, tables, labels of figures, and the script beside the page."""

    class Wrong(planted.OneImage, planted.HardEdge):
        def extra(self, atoms, energy, forces):
            return energy, forces + 0.1

    loaded = LoadedCalculator("reduced", "reduced", Wrong, units=LJ, kT=0.1)
    monkeypatch.setattr("mdnum.audit.record.load_calculator", lambda words: loaded)
    monkeypatch.setattr("mdnum.audit.checks.dynamics.find_thresholds", lambda subject: [])
    atoms = planted.crystal()
    checks = "forces,curl,dynamics"
    outcome = mdnum.audit_calculator("reduced", atoms, checks=checks, steps=16, out=tmp_path / "a")
    assert {"FORCES_NOT_GRADIENT", "NET_FORCE"} <= codes(outcome)
    page = (tmp_path / "a/report.html").read_text()
    assert "<svg" in page and "mε/atom/τ" in page and "ε/σ" in page
    seen = re.sub(r"<(style|script)\b.*?</\1>|<(?!!--)[^>]*>", " ", page, flags=re.DOTALL)
    for text in (seen, (tmp_path / "a/summary.json").read_text()):
        assert not [text[one.start() - 40 : one.end() + 20] for one in DIMENSIONS.finditer(text)]
    assert "ε/σ" in seen and "{units" not in page


@pytest.mark.parametrize(("system", "unit"), [("metal", "eV"), ("lj", "ε")])
def test_numbers_have_the_units_of_the_calculator_and_words_stay_what_they_are(
    system, unit, tmp_path, monkeypatch
):
    """Whatever a check of another package says about eV.py in SteveV is not touched."""
    module = (
        "from mdnum.audit.base import AuditCheck, Chart, CheckResult, finding\n"
        "from mdnum.units import ENERGY, LENGTH, Measured\n"
        "class Odd(AuditCheck):\n"
        '    """Measures in the unit of the calculator."""\n'
        '    name, title = "odd", "Odd"\n'
        "    def ask(self, subject, progress):\n"
        "        rows = [{f'at ({LENGTH})': 1.0, 'where': 'eV.py in SteveV failed at 3 Å {x}'}]\n"
        "        size = Measured(0.25, 'energy/length', 1e-3, 2.0)\n"
        "        told = [finding('NET_FORCE', 'error', size=size),\n"
        "                finding('ODD', 'warning', title='odd', text=f'It is 7 {ENERGY} in SteveV.')]\n"
        "        chart = Chart('t', f'r ({LENGTH})', f'u ({ENERGY})', [0.0, 1.0], {'u': [1.0, 2.0]})\n"
        "        return CheckResult(([], {}), told, {'Rows': rows}, [chart])\n"
    )
    monkeypatch.syspath_prepend(
        install(
            tmp_path / "site", "odd-units", {"in_units": module}, {"mdnum.checks": {"odd": "in_units:Odd"}}
        )
    )
    asked = {"metal": (planted.Good, planted.crystal()), "lj": ("argon/crystal-108",)}
    outcome = mdnum.audit_calculator(*asked[system], checks="odd", out=tmp_path / "a")
    length = {"eV": "Å", "ε": "σ"}[unit]
    force, odd = outcome.verdict.findings
    assert f"0.250 {unit}/{length}" in force.text and odd.text == f"It is 7 {unit} in SteveV."
    assert force.values["size"] == Measured(0.25, f"{unit}/{length}", 1e-3, 2.0)
    stored = json.loads((tmp_path / "a/summary.json").read_text())
    (part,) = stored["parts"]
    assert part["tables"] == {"Rows": [{f"at ({length})": 1.0, "where": "eV.py in SteveV failed at 3 Å {x}"}]}
    by_code = {one["code"]: one for one in stored["findings"]}
    assert by_code["NET_FORCE"]["values"]["size"] == {
        "value": 0.25, "unit": f"{unit}/{length}", "floor": 1e-3, "scale": 2.0,
    }  # fmt: skip
    # what is read again says the same
    again = frame.finish(tmp_path / "a")
    assert again.verdict == outcome.verdict and again.summary["parts"] == outcome.summary["parts"]
    page = (tmp_path / "a/report.html").read_text()
    assert f"r ({length})" in page and "{units" not in page


def test_another_package_adds_a_check(tmp_path, monkeypatch):
    """One file: the check, its codes and its sentences; the command line knows it by its entry point."""
    module = (
        "from mdnum.audit.base import AuditCheck, CheckResult, finding\n"
        "class Odd(AuditCheck):\n"
        '    """Has the structure an even number of atoms?"""\n'
        '    name, title = "odd", "Odd"\n'
        "    def ask(self, subject, progress):\n"
        "        told = finding('ODD', 'warning', title='odd', text='Seven.', remedy='Add one.')\n"
        "        return CheckResult(([], {}), [told] if len(subject.atoms) % 2 else [])\n"
    )
    monkeypatch.syspath_prepend(
        install(tmp_path / "site", "odd-atoms", {"odd": module}, {"mdnum.checks": {"odd": "odd:Odd"}})
    )
    atoms = planted.crystal()[:7]
    outcome = mdnum.audit_calculator(planted.Good, atoms, checks="odd", out=tmp_path / "a", report=False)
    (told,) = outcome.verdict.findings
    assert (told.code, told.severity, told.title, told.section) == (
        "ODD", "warning", "odd", "Odd",
    )  # fmt: skip
    assert replace(told, values={}).remedy == "Add one."
