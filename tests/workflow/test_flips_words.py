"""What a ledger of flips says in words: velocities, where a file stopped, units and plurals."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import ase
import numpy as np
import pytest
from ase.io import write

import mdnum
from mdnum import report
from mdnum.cli import flips_print
from mdnum.errors import FolderError
from mdnum.report.flips import findings, html, limits, sections
from mdnum.report.flips.words import box_words
from mdnum.report.fork.question import Question
from mdnum.report.words import percent


def gas(frames: int = 12, atoms: int = 24, side: float = 6.0) -> list[ase.Atoms]:
    rng = np.random.default_rng(0)
    start, speed = rng.uniform(0, side, (atoms, 3)), rng.normal(0, 0.25, (atoms, 3))
    return [
        ase.Atoms(f"Ar{atoms}", start + n * speed, cell=[side] * 3, pbc=True, info={"time": 0.5 * n})
        for n in range(frames)
    ]


@pytest.fixture(scope="module")
def looked(tmp_path_factory: pytest.TempPathFactory) -> Question:
    """A folder whose file has far more than a handful of flips."""
    path = tmp_path_factory.mktemp("words")
    write(path / "gas.extxyz", gas())
    result = mdnum.flips(path / "gas.extxyz", cutoffs=[2.5], out=path / "f", report=False)
    return html.load(result.folder, "flips")[1]


def said(looked: Question, crossed: int, rate: float, error: float) -> tuple[str, str, set[str]]:
    """(headline, row on velocities, codes) with such a flux beside 10 crossings a time in the file."""
    summary = copy.deepcopy(dict(looked.summary))
    one = summary["rules"][0]
    one["stride"]["lost"] = 0.0
    one["flux"] = {
        "rate": rate, "error": error, "seen": 10.0, "crossed": crossed, "frames": 4, "moved": 1.0,
        "lost": 1 - 10.0 / rate,
    }  # fmt: skip
    run = Question(looked.path, summary, looked.system_toml, looked.provenance, looked.tables)
    (row,) = [words for name, words in sections.rule(run, 0)["between"] if "velocities" in name]
    judged = findings.judge(run)
    return judged.headline, row, {one.code for one in judged.findings}


def test_headline_row_and_finding_agree_on_what_velocities_show(looked: Question) -> None:
    headline, row, codes = said(looked, 200, 100.0, 7.0)
    assert "by the velocities, 10 times as many happened" in headline
    assert "FLUX" in codes and f"{percent(0.9)} not in the file" in row
    # ten crossings, and a rate within its scatter, show nothing
    for crossed, rate, error, words in (
        (10, 100.0, 32.0, "too few"),
        (25, 13.0, 2.6, "no more than by chance"),
    ):
        headline, row, codes = said(looked, crossed, rate, error)
        assert "velocities" not in headline and "happened" not in headline
        assert "FLUX" not in codes and words in row and "not in the file" not in row
    assert "none is missing" in said(looked, 100, 9.0, 0.9)[1]
    assert limits.by_velocities({"flux": None}) is None


def test_only_a_file_that_breaks_off_is_said_to_break_off(tmp_path: Path) -> None:
    def remedy(name: str, frames: list[ase.Atoms], keep: float = 1.0) -> str:
        write(tmp_path / name, frames)
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(whole[: int(keep * len(whole))])
        out = tmp_path / f"f-{name}"
        summary = mdnum.flips(tmp_path / name, cutoffs=[2.5], out=out, report=False).summary
        assert summary["status"] == "stopped"
        (one,) = [one for one in summary["findings"] if one["code"] == "STOPPED"]
        return one["remedy"]

    killed = "a run that was killed"
    assert killed in remedy("cut.extxyz", gas(), keep=0.9)
    lost, boxless, fewer = gas(), gas(), gas()
    lost[7].positions[3, 1] = np.nan
    boxless[7].pbc = False
    fewer[7] = fewer[7][:-1]
    for name, frames in (("nan", lost), ("box", boxless), ("atoms", fewer)):
        told = remedy(f"{name}.extxyz", frames)
        assert killed not in told and "that frame" in told
    # whole, with a word in the middle that is no number
    write(tmp_path / "word.extxyz", gas())
    lines = (tmp_path / "word.extxyz").read_text().splitlines(keepends=True)
    lines[7 * 26 + 5] = "Ar 1.0 nought 2.0\n"
    (tmp_path / "word.extxyz").write_text("".join(lines))
    found = mdnum.flips(tmp_path / "word.extxyz", cutoffs=[2.5], out=tmp_path / "w", report=False).summary
    assert found["frames"] == 7 and "nought" in found["stopped"] and not found["cut_short"]


def test_what_several_rules_have_in_common_is_said_once(tmp_path: Path) -> None:
    frames = gas(30)
    for one in frames:
        one.positions = np.round(one.positions, 2)
    write(tmp_path / "a.extxyz", frames)
    found = mdnum.flips(tmp_path / "a.extxyz", cutoffs=[2.0, 2.5], out=tmp_path / "f", report=False)
    (one,) = [one for one in found.summary["findings"] if one["code"] == "UNDECIDABLE"]
    sentences = [part.strip(". ") for part in one["text"].replace("\n", ". ").split(". ")]
    assert len(sentences) == len(set(sentences)), one["text"]
    for rule in ("r < 2 Å", "r < 2.5 Å"):
        assert one["text"].count(f"{rule}:") == 1
    assert one["text"].count("may have been on its other side") == 1


def test_one_atom_one_frame_and_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def printed(result: Any, show: Any = flips_print.print_rows) -> str:
        show(result.summary)
        return capsys.readouterr().out

    write(tmp_path / "one.extxyz", ase.Atoms("Ar", [[0.12, 0.34, 0.56]], cell=[9.0] * 3, pbc=True))
    one = mdnum.flips(tmp_path / "one.extxyz", cutoffs=[2.5], out=tmp_path / "a", report=False)
    assert "1 atom, 1 frame" in printed(one)
    two = (tmp_path / "one.extxyz", tmp_path / "one.extxyz")
    both = mdnum.flips(*two, cutoffs=[2.5], out=tmp_path / "b", report=False)
    assert "1 atom\n" in printed(both, flips_print.print_comparison)
    rows = []
    for n in range(3):
        rows += ["ITEM: TIMESTEP", str(20 * n), "ITEM: NUMBER OF ATOMS", "2", "ITEM: BOX BOUNDS pp pp pp"]
        rows += ["0 20"] * 3 + [
            "ITEM: ATOMS id type x y z",
            "1 1 1.5 1.5 1.5",
            f"2 1 {4.3 - 0.3 * n} 1.5 1.5",
        ]
    (tmp_path / "l.lammpstrj").write_text("\n".join(rows) + "\n")
    steps = mdnum.flips(tmp_path / "l.lammpstrj", cutoffs=[2.5], out=tmp_path / "c")
    assert steps.summary["rules"][0]["flips"] == 1 and steps.summary["time"] == "step"
    page = (steps.folder / "report.html").read_text(encoding="utf-8")
    assert "20 steps apart" in page and "20 step " not in page and "20 steps apart" in printed(steps)
    assert "by 1 pair" in page and "by 1 pairs" not in page


def test_a_folder_of_another_version_is_refused_in_a_line_or_works(tmp_path: Path) -> None:
    write(tmp_path / "a.traj", gas())
    found = mdnum.flips(tmp_path / "a.traj", cutoffs=[2.5], out=tmp_path / "f", report=False)
    path = found.folder / "summary.json"
    summary = json.loads(path.read_text(encoding="utf-8"))
    # what was not looked for yet
    later = ("velocities_odd", "cut_short", "leaps", "interrupted")
    old = {name: value for name, value in summary.items() if name not in later}
    old["rules"] = [{name: value for name, value in one.items() if name != "grid"} for one in old["rules"]]
    # an older mdnum wrote no manifest
    (path.parent / "manifest.json").unlink()
    path.write_text(json.dumps(old))
    report.write(found.folder)
    # what a page is about
    old["rules"] = [{name: value for name, value in one.items() if name != "stride"} for one in old["rules"]]
    path.write_text(json.dumps({name: value for name, value in old.items() if name != "has_times"}))
    with pytest.raises(FolderError, match="lacks has_times, stride") as caught:
        report.write(found.folder)
    assert f"mdnum flips {tmp_path / 'a.traj'}" in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_without_a_box_or_with_half_of_one_says_so(tmp_path: Path) -> None:
    for name, pbc, note, row in (
        ("none", False, "no pair is looked for through a boundary", "no box that repeats"),
        ("half", [True, False, True], "repeats along a and c only", "6 × 6 × 6 Å, repeating along a and c"),
        ("whole", True, "", "6 × 6 × 6 Å, repeating along a, b and c"),
    ):
        frames = gas(1)
        frames[0].pbc = pbc
        write(tmp_path / f"{name}.traj", frames)
        out = tmp_path / name
        found = mdnum.flips(tmp_path / f"{name}.traj", cutoffs=[2.5], out=out, report=False)
        notes = [one["text"] for one in found.summary["findings"] if one["code"] == "READING"]
        assert note in " ".join(notes) and bool(note) == bool(notes)
        _, run = html.load(found.folder, "flips")
        assert box_words(run, found.summary["box"]) == row
