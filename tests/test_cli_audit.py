"""`mdnum audit`, from the command line to the folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from ase.build import bulk
from ase.io import write
from command_line import call, printed

EMT = "ase.calculators.emt:EMT"


@pytest.fixture
def copper(tmp_path: Path, monkeypatch) -> Path:
    """A folder with a structure, which is where the person is."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "cu.extxyz", bulk("Cu", cubic=True))
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("ase.calculators.emt:ETM",), "Did you mean EMT?"),
        (("nowhere.py",), "no such file"),
        ((EMT, "--checks", "curls"), "Did you mean curl?"),
        ((EMT, "-s", "no.xyz"), "no.xyz"),
        ((f"{EMT}(open('x'))",), "not a literal"),
        ((EMT, "-s", "cu.extxyz", "--timestep", "0", "--checks", "dynamics"), "expected one above 0"),
    ],
)
def test_what_cannot_be_asked_is_refused_in_one_line(arguments, message, copper, capsys):
    assert call("audit", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_a_calculator_that_is_fine(copper, capsys):
    assert call("audit", EMT, "-s", "cu.extxyz", "--checks", "forces,curl") == 0
    lines = printed(capsys)
    assert lines[0] == f"{EMT}: 2 checks found nothing."
    assert lines[1] == f"{EMT}, Cu4, 4 atoms"
    assert lines[-1] == "wrote runs/audit-EMT-1/report.html"
    assert (copper / "runs/audit-EMT-1/report.html").exists()
    assert call("report", "runs/audit-EMT-1") == 0


def test_a_calculator_that_is_not(copper, capsys):
    (copper / "mine.py").write_text(
        "from ase.calculators.emt import EMT\n"
        "class Pushed(EMT):\n"
        "    def calculate(self, *words, **more):\n"
        "        super().calculate(*words, **more)\n"
        "        self.results['forces'] = self.results['forces'] + [0.1, 0.0, 0.0]\n"
        "calculator = Pushed()\n"
    )
    assert (
        call(
            "audit", "mine.py", "-s", "cu.extxyz", "--checks", "forces", "--no-report", "-o", "out", "--json"
        )
        == 1
    )
    told = json.loads(capsys.readouterr().out)
    assert {one["code"] for one in told["findings"]} == {"FORCES_NOT_GRADIENT", "NET_FORCE"}
    assert told["safe_to_run"] == told["safe_to_differentiate"] == "no"
    assert told["folder"] == "out" and not (copper / "out/report.html").exists()
    assert call("audit", "mine.py", "-s", "cu.extxyz", "--checks", "forces", "-o", "out") == 2
    assert "already holds a run" in capsys.readouterr().err
