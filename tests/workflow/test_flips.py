"""`mdnum flips` from a file to a folder: the ledger of a run, boxes and rules, and files that break off."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path

import ase
import numpy as np
import pytest
from ase.io import iread, write

import mdnum
from mdnum import report
from mdnum.errors import InputError
from mdnum.report.flips import findings, html
from mdnum.store import RunFolder
from mdnum.trajectories.contacts import contacts
from mdnum.trajectories.history import History
from mdnum.workflow import flips_numbers
from mdnum.workflow.flips_words import rules, species_cutoffs


@pytest.fixture(scope="module")
def crystal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that mdnum recorded itself, with every frame."""
    path = tmp_path_factory.mktemp("runs") / "crystal"
    return mdnum.run("argon/crystal-108", steps=400, save_every=1, out=path, check=False, report=False).folder


def gas(seed: int = 0, frames: int = 30, atoms: int = 24, side: float = 6.0) -> list[ase.Atoms]:
    """Atoms that fly straight through a small box, of two species."""
    rng = np.random.default_rng(seed)
    start, speed = rng.uniform(0, side, (atoms, 3)), rng.normal(0, 0.25, (atoms, 3))
    return [
        ase.Atoms("OH" * (atoms // 2), start + n * speed, cell=[side] * 3, pbc=True, info={"time": 0.5 * n})
        for n in range(frames)
    ]


def inside(atoms: ase.Atoms, radius: float, reach: int = 2) -> set[tuple[int, int, int]]:
    """(i, j, rank) inside, from all images one by one; the nearest image has rank 0."""
    cell, found = np.array(atoms.cell), set()
    shifts = [np.array((a, b, c)) @ cell for a in range(-reach, reach + 1) for b in range(-reach, reach + 1)
              for c in range(-reach, reach + 1)]  # fmt: skip
    # wrapped, so that so few images are enough
    x = atoms.get_positions(wrap=True)
    for i in range(len(x)):
        for j in range(i, len(x)):
            r = sorted(float(np.linalg.norm(x[j] + shift - x[i])) for shift in shifts)
            # an atom's own images come in pairs, of which one counts, after itself
            r = r[1::2] if i == j else r
            found |= {(i, j, rank) for rank, one in enumerate(r) if one < radius}
    return found


@pytest.mark.slow
def test_a_run_of_mdnum_gives_its_own_ledger_row_for_row(crystal: Path, tmp_path: Path) -> None:
    result = mdnum.flips(crystal / "trajectory.traj", out=tmp_path / "f", report=False)
    own, found = RunFolder.open(crystal).read("flips"), RunFolder.open(result.folder).read("flips")
    assert len(own["step"]) == len(found["frame"]) > 500
    for mine, theirs in (("step", "frame"), ("i", "i"), ("j", "j"), ("entered", "entered")):
        np.testing.assert_array_equal(own[mine], found[theirs])
    np.testing.assert_allclose(own["distance"], found["distance"], rtol=1e-14)
    series, frames = RunFolder.open(crystal).read("series"), RunFolder.open(result.folder).read("frames")
    np.testing.assert_array_equal(series["pairs"], frames["pairs"])
    one = result.summary["rules"][0]
    assert one["rule"] == "r < 1.5874" and one["flips"] == len(own["step"])
    assert result.summary["timed"] and result.summary["interval"] == pytest.approx(0.004)
    # the velocities that the run stored cross the cutoff as often as its own steps saw
    assert abs(one["flux"]["lost"]) < 4 * one["flux"]["error"] / one["flux"]["rate"]
    assert one["flux"]["moved"] == pytest.approx(1, abs=0.01)
    assert result.summary["resolution"]["kind"] == "float64" and result.summary["status"] == "complete"


def test_tables_agree_with_sets_worked_out_one_by_one(tmp_path: Path) -> None:
    frames = gas(side=5.0, atoms=8, frames=12)
    write(tmp_path / "gas.extxyz", frames)
    result = mdnum.flips(tmp_path / "gas.extxyz", cutoffs=[3.1], out=tmp_path / "f", report=False)
    sets = [inside(one, 3.1) for one in frames]
    folder = RunFolder.open(result.folder)
    members, flips, rows = folder.read("members"), folder.read("flips"), folder.read("frames")
    # the box is narrower than two cutoffs: images are there, and counted
    assert {rank for *_, rank in sets[0]} > {0} and result.summary["rules"][0]["images"]
    assert set(zip(members["i"], members["j"], members["rank"], strict=True)) == sets[0]
    for n in range(1, len(frames)):
        at = flips["frame"] == n
        told = zip(flips["i"][at], flips["j"][at], flips["rank"][at], flips["entered"][at], strict=True)
        assert set(told) == {(*pair, pair in sets[n]) for pair in sets[n] ^ sets[n - 1]}
        count = np.zeros(8, int)
        for i, j, _ in sets[n]:
            count[i] += 1
            count[j] += 1
        row = rows["frame"] == n
        assert (rows["fewest"][row], rows["most"][row]) == (count.min(), count.max())
        assert rows["neighbors"][row] == pytest.approx(count.mean())
    stays = folder.read("contacts")
    # every stay of every pair, as frames in the sets
    inside_frames = {
        (*pair, n)
        for *pair, begin, end in zip(
            stays["i"], stays["j"], stays["rank"], stays["begin"], stays["end"], strict=True
        )
        for n in range(begin, end)
    }
    assert inside_frames == {(*pair, n) for n, one in enumerate(sets) for pair in one}


def test_several_rules_and_selections_at_once(tmp_path: Path) -> None:
    write(tmp_path / "gas.extxyz", gas())
    result = mdnum.flips(
        tmp_path / "gas.extxyz", cutoffs=[1.5, 2.5], pairs=["O-H=2"], nearest=[3], out=tmp_path / "f",
        between=("element O", "element H"), window=3, report=False,
    )  # fmt: skip
    told = result.summary["rules"]
    assert [one["rule"] for one in told] == ["r < 1.5", "r < 2.5", "O-H < 2", "3 nearest"]
    assert [one["directed"] for one in told] == [False, False, False, True]
    for one in told[:3]:
        assert [(row["first"], row["second"]) for row in one["by_species"]] == [("O", "H")]
    # O looks for H: three each, always
    assert told[3]["pairs_first"] == told[3]["pairs_last"] == 36
    assert told[3]["entered"] == told[3]["left"] and told[3]["neighbors"]["fewest"] == 3
    flips = RunFolder.open(result.folder).read("flips")
    for number, one in enumerate(told):
        assert np.count_nonzero(flips["rule"] == number) == one["flips"]
        assert one["chatter"]["window"] == 3
    # one rule is one ledger, whatever the others
    alone = mdnum.flips(
        tmp_path / "gas.extxyz", cutoffs=[2.5], out=tmp_path / "g", report=False,
        between=("element O", "element H"), window=3,
    )  # fmt: skip
    mine = RunFolder.open(alone.folder).read("flips")
    for name in ("frame", "i", "j", "entered", "distance", "margin"):
        np.testing.assert_array_equal(mine[name], flips[name][flips["rule"] == 1])
    assert alone.summary["rules"][0] == told[1]
    # atoms on both sides: everybody counts its O, and is not counted by them
    mixed = mdnum.flips(
        tmp_path / "gas.extxyz", cutoffs=[2.5], between=("all", "element O"), out=tmp_path / "h", report=False
    )
    one = mixed.summary["rules"][0]
    inside_by = {row["first"] + row["second"]: row["inside"] / 30 for row in one["by_species"]}
    assert set(inside_by) == {"HO", "OO"}
    assert one["neighbors"]["mean"] == pytest.approx((inside_by["HO"] + 2 * inside_by["OO"]) / 24)


def test_the_page_says_what_the_folder_holds(tmp_path: Path) -> None:
    write(tmp_path / "gas.extxyz", gas())
    result = mdnum.flips(
        tmp_path / "gas.extxyz", cutoffs=[2.5], out=tmp_path / "f", between=("element O", "element H")
    )
    one = result.summary["rules"][0]
    text = (result.folder / "report.html").read_text(encoding="utf-8")
    for words in ("r &lt; 2.5 Å", "“element O” and “element H”", f"{one['flips']} flips of", "O–H"):
        assert words in text
    assert {path.stem for path in (result.folder / "figures").iterdir()} >= {"rule0-pairs", "rule0-lifetimes"}
    _, run = html.load(result.folder, "flips")
    assert findings.judge(run).tone != "error"
    # a planted hole in the ledger is found
    entered = run.tables["frames"]["entered"]
    holed = {**run.tables["frames"], "entered": entered + (np.arange(len(entered)) == 9)}
    run = replace(run, tables={**run.tables, "frames": holed})
    assert findings.judge(run).findings[0].code == "EVENT_ALGEBRA"


def test_a_ledger_in_parts_says_what_it_says_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "gas.extxyz", gas(5, frames=40))
    whole = mdnum.flips(tmp_path / "gas.extxyz", cutoffs=[2.5], out=tmp_path / "a", report=False)
    monkeypatch.setattr(flips_numbers, "_PART_ROWS", 100)
    parts = mdnum.flips(tmp_path / "gas.extxyz", cutoffs=[2.5], out=tmp_path / "b", report=False)
    assert whole.summary["rules"] == parts.summary["rules"]
    for table in ("contacts", "lifetimes", "busiest", "neighbors"):
        one, other = (RunFolder.open(result.folder).read(table) for result in (whole, parts))
        order, another = (np.lexsort([rows[name] for name in rows]) for rows in (one, other))
        for name in one:
            np.testing.assert_array_equal(one[name][order], other[name][another])
    folder = RunFolder.open(whole.folder)
    flips, members = folder.read("flips"), folder.read("members")
    pair = [flips[name] for name in ("i", "j", "rank")]
    first = [members[name] for name in ("i", "j", "rank")]
    stays = contacts(History.of_columns(flips["frame"], flips["entered"], pair, first, 40))
    assert len(stays) == sum(whole.summary["rules"][0]["contacts"].values())


def test_what_came_before_an_unreadable_frame_is_kept(tmp_path: Path) -> None:
    frames = gas(frames=20)
    write(tmp_path / "whole.extxyz", frames)
    text = (tmp_path / "whole.extxyz").read_text().splitlines(keepends=True)
    (tmp_path / "cut.extxyz").write_text("".join(text[: 12 * 26 + 9]))
    cut = mdnum.flips(tmp_path / "cut.extxyz", cutoffs=[2.5], out=tmp_path / "a", report=False)
    assert cut.summary["status"] == "stopped" and cut.summary["frames"] == 12
    assert "frame 12" in cut.summary["stopped"]
    assert cut.summary["findings"][0]["code"] == "STOPPED"
    sound = mdnum.flips(f"{tmp_path}/whole.extxyz@:12", cutoffs=[2.5], out=tmp_path / "b", report=False)
    for name, values in RunFolder.open(cut.folder).read("flips").items():
        np.testing.assert_array_equal(values, RunFolder.open(sound.folder).read("flips")[name])
    frames[7].positions[5, 1] = np.nan
    write(tmp_path / "nan.traj", frames)
    broken = mdnum.flips(tmp_path / "nan.traj", cutoffs=[2.5], out=tmp_path / "c", report=False)
    assert broken.summary["frames"] == 7
    assert "frame 7" in broken.summary["stopped"] and "atom 5" in broken.summary["stopped"]
    # at the first frame there is nothing to keep, and no folder stays
    write(tmp_path / "bad.traj", frames[7:])
    with pytest.raises(InputError, match="atom 5"):
        mdnum.flips(tmp_path / "bad.traj", cutoffs=[2.5], out=tmp_path / "d")


def test_one_frame_and_no_flips_are_said_in_words(tmp_path: Path) -> None:
    write(tmp_path / "gas.extxyz", gas())
    single = mdnum.flips(f"{tmp_path}/gas.extxyz@4", cutoffs=[2.5], out=tmp_path / "a", report=False)
    assert single.summary["frames"] == 1 and single.summary["rules"][0]["flips"] == 0
    assert "cannot hold a flip" in single.summary["headline"]
    still = mdnum.flips(tmp_path / "gas.extxyz", cutoffs=[1e-3], out=tmp_path / "b", report=False)
    assert "No pair entered or left" in still.summary["headline"]


def test_times_that_go_back_or_are_uneven_are_found(tmp_path: Path) -> None:
    frames = gas()
    write(tmp_path / "twice.extxyz", frames[:15] + frames[10:])
    found = mdnum.flips(tmp_path / "twice.extxyz", cutoffs=[2.5], out=tmp_path / "a", report=False)
    assert "TIME_GOES_BACK" in {one["code"] for one in found.summary["findings"]}
    write(tmp_path / "uneven.extxyz", frames[:10] + frames[12:])
    found = mdnum.flips(tmp_path / "uneven.extxyz", cutoffs=[2.5], out=tmp_path / "b", report=False)
    assert "UNEVEN_FRAMES" in {one["code"] for one in found.summary["findings"]}


def test_a_coarse_file_says_so(tmp_path: Path) -> None:
    frames = gas(frames=60, atoms=40)
    for one in frames:
        one.positions = np.round(one.positions, 1)
    write(tmp_path / "coarse.extxyz", frames)
    found = mdnum.flips(tmp_path / "coarse.extxyz", cutoffs=[2.5], out=tmp_path / "a", report=False)
    assert found.summary["resolution"]["step"] == pytest.approx(0.1)
    one = found.summary["rules"][0]
    assert one["ambiguous"] > 0.1 * one["flips"] and one["grid"]["missed"] > 0.01
    (said,) = [one for one in found.summary["findings"] if one["code"] == "UNDECIDABLE"]
    assert said["severity"] == "warning" and "% of the flips that happened are hidden" in said["text"]


@pytest.mark.slow
def test_two_runs_that_differ_in_one_number(crystal: Path, tmp_path: Path) -> None:
    other = mdnum.run(
        "argon/crystal-108", steps=400, save_every=1, out=tmp_path / "b", check=False, report=False,
        overrides={"precision.force": "float32"},
    ).folder  # fmt: skip
    found = mdnum.flips(crystal, other, out=tmp_path / "cmp")
    first = found.summary["first"]
    sets = []
    for path in (crystal, other):
        flips = RunFolder.open(path).read("flips")
        sets.append(set(zip(flips["step"], flips["i"], flips["j"], strict=True)))
    # both start alike: the sets differ first where one of them has a flip that the other has not
    frame = min(step for step, *_ in sets[0] ^ sets[1])
    assert first["frame"] == frame and found.summary["certain"] == frame
    pairs = {(one["i"], one["j"]) for one in found.summary["first_pairs"]}
    assert pairs == {(i, j) for step, i, j in sets[0] ^ sets[1] if step == frame}
    for one in found.summary["first_pairs"]:
        assert (one["margin_a"] > 0) == (one["inside"] == "A") and (one["margin_b"] > 0) == (
            one["inside"] == "B"
        )
    assert found.summary["seed"] == 1 and 0 < first["furthest_before"] < 1e-5
    text = (found.folder / "report.html").read_text(encoding="utf-8")
    assert "A flip that came first is no cause" in text
    apart = RunFolder.open(found.folder).read("apart")
    x = [np.array([a.positions for a in iread(p / "trajectory.traj", ":")]) for p in (crystal, other)]
    moved = np.linalg.norm(x[0] - x[1], axis=2)
    # one of the two may have been wrapped a step before the other
    np.testing.assert_allclose(apart["furthest"][:390], moved.max(1)[:390], atol=1e-15)
    html_again = report.write(found.folder)
    assert html_again.read_text(encoding="utf-8") == text


def test_a_file_and_itself(tmp_path: Path) -> None:
    write(tmp_path / "gas.extxyz", gas())
    write(tmp_path / "fewer.extxyz", [one[:20] for one in gas()])
    found = mdnum.flips(
        tmp_path / "gas.extxyz", tmp_path / "gas.extxyz", cutoffs=[2.5], out=tmp_path / "a", report=False
    )
    assert found.summary["first"] is None and found.summary["seed"] is None
    assert "same positions" in found.summary["headline"]
    shifted = mdnum.flips(
        f"{tmp_path}/gas.extxyz@:20", f"{tmp_path}/gas.extxyz@5:", cutoffs=[2.5], out=tmp_path / "b"
    )
    text = (shifted.folder / "report.html").read_text(encoding="utf-8")
    assert "A flip that came first is no cause" in text and "Sets differ at the first frame" in text
    assert shifted.summary["first"]["frame"] == 0
    codes = {one["code"] for one in shifted.summary["findings"]}
    assert {"OTHER_TIMES", "NO_CAUSE_FROM_FILES"} <= codes
    with pytest.raises(InputError, match="24 atoms and fewer"):
        mdnum.flips(tmp_path / "gas.extxyz", tmp_path / "fewer.extxyz", cutoffs=[2.5])


def test_words_become_rules() -> None:
    assert [one.name for one in rules([8.5], (), (12,), 30)] == [
        "r < 8.5, at most 30 neighbors",
        "12 nearest",
    ]
    assert species_cutoffs("O-H=2.5, O-O = 3.5") == {("O", "H"): 2.5, ("O", "O"): 3.5}
    for words in ("O-H", "O=2", "O-H=x", "O-H=-1", "O-H-O=2", "O-H=2,H-O=3", ""):
        with pytest.raises(InputError, match="--pairs"):
            species_cutoffs(words)
    with pytest.raises(InputError, match="--cutoff"):
        rules((), (), (), 5)
    with pytest.raises(InputError, match="twice"):
        rules([2.0, 2.0])


def test_control_c_keeps_the_frames_that_were_looked_at(tmp_path: Path) -> None:
    write(tmp_path / "gas.extxyz", gas())

    def press(done: int, of: int, told: dict) -> None:
        if done == 7 and told["phase"] == "run":
            signal.raise_signal(signal.SIGINT)

    result = mdnum.flips(tmp_path / "gas.extxyz", cutoffs=[2.5], out=tmp_path / "f", progress=press)
    assert result.summary["status"] == "stopped" and result.summary["frames"] == 7
    assert "INTERRUPTED" in [one["code"] for one in result.summary["findings"]]
    part = mdnum.flips(tmp_path / "gas.extxyz@:7", cutoffs=[2.5], out=tmp_path / "p", report=False)
    ours, theirs = (RunFolder.open(one.folder).read("flips") for one in (result, part))
    assert len(ours["frame"]) > 0
    for name, values in ours.items():
        np.testing.assert_array_equal(values, theirs[name])
    assert (result.folder / "report.html").exists() and report.write(result.folder).exists()
    # control-C is what it was before
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
