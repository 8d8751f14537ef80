"""The campaign over files of other packages names each kind of mistake, planted here."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from programs import module_of

SCRIPT = Path(__file__).parents[2] / "scripts" / "campaigns" / "foreign_files.py"


@pytest.fixture
def script() -> Any:
    return module_of("scripts/campaigns/foreign_files.py")


@pytest.fixture
def folder(tmp_path) -> Path:
    frame = "3\nwords\nAr 0 0 0\nAr 2 0 0\nAr 0 2.6 {}\n"
    (tmp_path / "good.xyz").write_text("".join(frame.format(one) for one in (0, 1, 0)))
    (tmp_path / "part.xyz").write_text(frame.format(0) * 2 + "3\nwords\nAr 0 0")
    (tmp_path / "none.dcd").write_bytes(b"\x00nothing" * 9)
    return tmp_path


def test_what_is_read_in_part_and_refused_is_told_apart_and_the_exit_code_is_0(folder, tmp_path_factory):
    record = tmp_path_factory.mktemp("record") / "cases.jsonl"
    words = ["--packages", "", "--folders", str(folder), "--record", str(record)]
    done = subprocess.run([sys.executable, str(SCRIPT), *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = {
        (Path(case[0]).name, case[1]): case[3] for case in map(json.loads, record.read_text().splitlines())
    }
    assert found["good.xyz", "trajectory"] == found["good.xyz", "topology"] == "read"
    assert found["part.xyz", "trajectory"] == "part"
    assert {found["none.dcd", way] for way in ("trajectory", "topology", "structure")} == {"refused"}
    assert "| all | 9 |" in done.stdout


@pytest.mark.parametrize("outcome", ["TRACEBACK", "LITTER", "several lines"])
def test_a_mistake_is_named(script, folder, monkeypatch, outcome):
    def planted(words):
        if outcome == "TRACEBACK":
            raise OverflowError("too large")
        if outcome == "LITTER":
            path = Path(words[1])
            path.with_name(f".{path.name}_offsets.npz").write_text("")
            return 0
        print("mdnum: one\nmdnum: two", file=sys.stderr)
        return 2

    monkeypatch.setattr("mdnum.cli.main", planted)
    want = "LITTER" if outcome == "LITTER" else "TRACEBACK"
    assert script.examine(folder / "good.xyz", "trajectory", "whole")[0] == want


@pytest.mark.parametrize(("child", "outcome"), [("time.sleep(60)", "HANG"), ("os._exit(139)", "CRASH")])
def test_a_process_that_does_not_answer_is_ended_and_the_next_file_has_another(
    script, folder, tmp_path_factory, monkeypatch, child, outcome
):
    stub = tmp_path_factory.mktemp("stub") / "stub.py"
    stub.write_text(f"import os, sys, time\nsys.stdin.readline()\n{child}\n")
    monkeypatch.setattr(script, "__file__", str(stub))
    began = time.monotonic()
    found = list(script.campaign(sorted(folder.iterdir())[:2], ["trajectory"], ["whole"], 2.0))
    assert [case[3] for case in found] == [outcome] * 2 and time.monotonic() - began < 30
