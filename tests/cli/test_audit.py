"""`mdnum audit`, from the command line to the folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from ase.build import bulk
from ase.io import write
from command_line import call, printed

from mdnum.store import RunFolder
from mdnum.store.files import write_text
from mdnum.verbs.frame import layout

EMT = "ase.calculators.emt:EMT"


@pytest.fixture
def copper(tmp_path: Path, monkeypatch) -> Path:
    """A folder with a file of two structures, which is where the person is; the last is asked about."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "cu.extxyz", [bulk("Cu", cubic=True).repeat((2, 1, 1)), bulk("Cu", cubic=True)])
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere.py",), "the file is missing"),
        ((EMT, "--checks", "curls"), "Did you mean curl?"),
        ((EMT, "-s", "no.xyz"), "no.xyz"),
        ((EMT, "-s", "cu.extxyz@7"), "cu.extxyz@7"),
        ((EMT, "-s", "cu.extxyz@:"), "tests only one"),
        ((EMT, "-s", "cu.extxyz", "--timestep", "0", "--checks", "dynamics"), "expected a value above 0"),
    ],
)
def test_what_cannot_be_asked_is_named_in_one_line(arguments, message, copper, capsys):
    assert call("audit", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_a_calculator_that_is_not_fine(copper, capsys):
    (copper / "mine.py").write_text(
        "from ase.calculators.emt import EMT\n"
        "class Pushed(EMT):\n"
        "    def calculate(self, *words, **more):\n"
        "        super().calculate(*words, **more)\n"
        "        self.results['forces'] = self.results['forces'] + [0.1, 0.0, 0.0]\n"
        "calculator = Pushed()\n"
    )
    assert call("audit", "mine.py", "-s", "cu.extxyz", "--checks", "forces", "--no-report", "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert {one["code"] for one in told["findings"]} == {"FORCES_NOT_GRADIENT", "NET_FORCE"}
    assert told["safe_to_run"] == told["safe_to_differentiate"] == "no"
    assert (told["folder"], told["atoms"]) == ("runs/audit-mine-1", 4)
    assert not (copper / told["folder"] / "report.html").exists()


@pytest.mark.parametrize(
    ("kind", "kept", "remedy"),
    [
        ("conform", "answers.json", "Resume it with `mdnum conform --resume conform`"),
        ("md", "checkpoint.npz", "Resume it with `mdnum run --resume md`"),
        ("grad", "gradients.npz", "Start a new `mdnum audit`"),
    ],
)
def test_what_is_no_audit_names_the_verb_that_resumes_it(kind, kept, remedy, copper, capsys):
    folder = RunFolder.create(copper / kind, layout(kind))
    folder.checkpoint({"step": 1}, force=True) if kind == "md" else write_text(folder.path / kept, "{}")
    folder.close()
    assert call("audit", "--resume", kind) == 2
    line = capsys.readouterr().err
    assert line.startswith(f"mdnum: {kind}: ") and line.endswith(f" {remedy}.\n") and line.count("\n") == 1
    assert "no `mdnum audit` to resume" in line


def test_control_c_keeps_what_was_found(copper, capsys, monkeypatch):
    from mdnum.audit.checks.curl import CurlCheck

    def pressed(self, subject, progress):
        raise KeyboardInterrupt

    monkeypatch.setattr(CurlCheck, "ask", pressed)
    arguments = ("audit", EMT, "-s", "cu.extxyz", "-o", "out", "--checks")
    assert call(*arguments, "forces,curl,state") == 130
    lines = printed(capsys)
    left = ("1 of 15 ways of forces", "curl not tested", "state not tested")
    # a headline is folded where it is piped
    said = " ".join(lines)
    assert f"the check curl. {EMT} on Cu4: " in said and all(part in said for part in left)
    assert any("mdnum audit --resume out" in line for line in lines)
    summary = json.loads((copper / "out/summary.json").read_text())
    assert {"what": "the check of state", "why": "stopped", "part": "state"} in summary["left_out"]
    assert summary["status"] == "stopped" and [part["name"] for part in summary["parts"]] == ["forces"]
    assert "the check curl" in (copper / "out/report.html").read_text()
    # nothing was found yet
    assert call("audit", EMT, "-s", "cu.extxyz", "-o", "other", "--checks", "curl") == 130
    assert "`mdnum audit --resume other`" in capsys.readouterr().err
    assert not (copper / "other/summary.json").exists()


LOOPS = """
from ase.calculators.lj import LennardJones

calls = [0]

class Loops(LennardJones):
    def calculate(self, *words, **more):
        calls[0] += 1
        while calls[0] > {after}:
            try:
                pass
            except BaseException:
                pass
        super().calculate(*words, **more)

def make():
    return Loops(sigma=3.4, epsilon=0.01, rc=5.0)
"""


@pytest.mark.parametrize("given", [(), ("-s", "ar.extxyz")], ids=["built", "given"])
@pytest.mark.parametrize("after", [0, 11])
def test_a_call_that_never_ends_is_interrupted_after_the_deadline(given, after, copper, monkeypatch):
    """While the structure is built, or when it is asked about: a folder, a page and exit code 3."""
    monkeypatch.setattr("mdnum.deadline.interrupting.__wrapped__.__defaults__", (0.5,))
    (copper / "loops.py").write_text(LOOPS.format(after=after))
    write(copper / "ar.extxyz", bulk("Ar", cubic=True).repeat(2))
    assert call("audit", "loops.py", *given, "--time", "0.01", "-o", "a") == 3
    summary = json.loads((copper / "a" / "summary.json").read_text())
    assert summary["status"] == "undecided" and (copper / "a" / "report.html").exists()
    assert "safe" not in summary["headline"]
