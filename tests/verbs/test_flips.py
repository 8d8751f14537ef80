"""`mdnum flips` from a file to a folder: the ledger of a run, boxes and rules, files that break off."""

from __future__ import annotations

import copy
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import ase
import numpy as np
import pyarrow.parquet as pq
import pytest
from ase.io import iread, write
from trajectories import brute_force

import mdnum
from mdnum.errors import FolderError, InputError
from mdnum.store import RunFolder
from mdnum.verbs.flips import rules
from mdnum.verbs.flips_page import judge, page
from mdnum.verbs.flips_shared import FlipsView
from mdnum.verbs.frame import Outcome, finish


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


@pytest.fixture
def examined(tmp_path: Path):
    """Examines frames, or a file of this folder."""

    def examine(name: str, frames: list[ase.Atoms] | None = None, **options: Any) -> Outcome:
        if frames is not None:
            write(tmp_path / name, frames)
        count = len(list(tmp_path.glob("f*")))
        asked = {"cutoffs": [2.5], "report": False, "out": tmp_path / f"f{count}"}
        return mdnum.flips(f"{tmp_path}/{name}", **{**asked, **options})

    return examine


def codes(result: Outcome) -> set[str]:
    return {one.code for one in result.verdict.findings}


def inside(atoms: ase.Atoms, radius: float) -> set[tuple[int, int, int]]:
    """(i, j, rank) inside, from all images one by one; the nearest image has rank 0."""
    every = range(len(atoms))
    found = brute_force.everything(atoms.positions, np.array(atoms.cell), [True] * 3, every, every, radius)
    return set(brute_force.members(found, lambda i, j: radius))


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
    assert one["stride"]["motion"]["moved"] == pytest.approx(1, abs=0.01)
    assert result.summary["resolution"]["kind"] == "float64" and result.summary["status"] == "complete"


def test_a_run_and_its_trajectory_write_one_table(tmp_path: Path) -> None:
    run = mdnum.run(
        "argon/crystal-108", steps=60, save_every=1, out=tmp_path / "run", check=False, report=False
    )
    found = mdnum.flips(run.folder / "trajectory.traj", out=tmp_path / "f", report=False)
    mine, theirs = (pq.read_table(one.folder / "flips.parquet") for one in (run, found))
    # what the atoms are called is known of a trajectory alone
    named = ["atom_name_i", "atom_name_j"]
    assert theirs.column_names == [*mine.column_names, *named]
    theirs = theirs.drop_columns(named)
    assert mine.schema.equals(theirs.schema) and mine.num_rows == theirs.num_rows > 20
    for name in ("rule", "i", "j", "rank", "entered"):
        assert mine[name].equals(theirs[name]), name
    assert mine["step"].equals(theirs["frame"])
    # whether the program's mask or the positions decided it, in every row
    for table, word in ((mine, "program"), (theirs, "positions")):
        assert table["decided_by"].to_pylist() == [word] * table.num_rows
    unknown = [{name for name in one.column_names if one[name].null_count} for one in (mine, theirs)]
    jumps = {"radial_speed", "energy_jump", "force_jump"}
    assert unknown == [{"frame", "before", "margin_before"}, {"step", *jumps}]
    # a reader in numpy gets what is known
    for outcome, lacking in zip((run, found), unknown, strict=True):
        folder = RunFolder.open(outcome.folder)
        assert folder.read("flips").keys() - set(named) == set(mine.column_names) - lacking
        with pytest.raises(FolderError, match="missing values"):
            folder.read("flips", [*lacking])


def test_tables_agree_with_sets_worked_out_one_by_one(examined) -> None:
    frames = gas(side=5.0, atoms=8, frames=7)
    result = examined("gas.extxyz", frames, cutoffs=[3.1])
    sets = [inside(one, 3.1) for one in frames]
    folder = RunFolder.open(result.folder)
    members, flips, rows = folder.read("members"), folder.read("flips"), folder.read("frames")
    # the box is narrower than two cutoffs: images are there, and counted
    assert {rank for *_, rank in sets[0]} > {0} and result.summary["rules"][0]["images"]
    assert "IMAGES" in codes(result)
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
    rows = zip(*(stays[name] for name in ("i", "j", "rank", "begin", "end")), strict=True)
    there = {(*pair, n) for *pair, begin, end in rows for n in range(begin, end)}
    assert there == {(*pair, n) for n, one in enumerate(sets) for pair in one}


def test_several_rules_and_selections_at_once(examined) -> None:
    between: Any = {"between": ("element O", "element H"), "window": 3}
    result = examined("gas.extxyz", gas(), cutoffs=[1.5, 2.5], pairs=["O-H=2"], nearest=[3], **between)
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
    # what several rules have in common is told once
    titles = [one.code for one in result.verdict.findings]
    assert len(titles) == len(set(titles))
    # one rule is one ledger, whatever the others
    alone = examined("gas.extxyz", **between)
    mine = RunFolder.open(alone.folder).read("flips")
    for name in ("frame", "i", "j", "entered", "distance", "margin"):
        np.testing.assert_array_equal(mine[name], flips[name][flips["rule"] == 1])
    assert alone.summary["rules"][0] == told[1]
    # atoms on both sides: everybody counts its O, and is not counted by them
    mixed = examined("gas.extxyz", between=("all", "element O"))
    one = mixed.summary["rules"][0]
    inside_by = {row["first"] + row["second"]: row["inside"] / 30 for row in one["by_species"]}
    assert set(inside_by) == {"HO", "OO"}
    assert one["neighbors"]["mean"] == pytest.approx((inside_by["HO"] + 2 * inside_by["OO"]) / 24)


def test_the_page_holds_what_the_folder_holds(examined) -> None:
    result = examined("gas.extxyz", gas(), report=True, between=("element O", "element H"))
    text = (result.folder / "report.html").read_text(encoding="utf-8")
    for words in ("r &lt; 2.5 Å", "“element O” and “element H”", "O–H"):
        assert words in text
    assert {path.stem for path in (result.folder / "figures").iterdir()} >= {"rule0-pairs", "rule0-lifetimes"}
    assert result.verdict.tone != "error"
    finish(result.folder)
    assert (result.folder / "report.html").read_text(encoding="utf-8") == text
    # a planted hole in the ledger is found
    folder = RunFolder.open(result.folder)
    frames = dict(folder.read("frames"))
    frames["entered"] = frames["entered"] + (np.arange(len(frames["entered"])) == 9)
    holed = judge(FlipsView(folder, result.summary, {"frames": frames}))
    assert holed.findings[0].code == "EVENT_ALGEBRA" and holed.findings[0].values["first"] == 9


def test_a_ledger_in_parts_is_counted_as_whole(examined, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = examined("gas.extxyz", gas(5, frames=40))
    monkeypatch.setattr(sys.modules["mdnum.verbs.flips"], "_PART_ROWS", 100)
    parts = examined("gas.extxyz")
    assert whole.summary["rules"] == parts.summary["rules"]
    for table in ("contacts", "lifetimes", "busiest", "neighbors"):
        one, other = (RunFolder.open(result.folder).read(table) for result in (whole, parts))
        order, another = (np.lexsort([rows[name] for name in rows]) for rows in (one, other))
        for name in one:
            np.testing.assert_array_equal(one[name][order], other[name][another])
    stays = RunFolder.open(whole.folder).read("contacts")
    assert len(stays["i"]) == sum(whole.summary["rules"][0]["contacts"].values())


def test_what_came_before_an_unreadable_frame_is_kept(tmp_path: Path, examined) -> None:
    frames = gas(frames=20)
    write(tmp_path / "whole.extxyz", frames)
    text = (tmp_path / "whole.extxyz").read_text().splitlines(keepends=True)
    (tmp_path / "cut.extxyz").write_text("".join(text[: 12 * 26 + 9]))
    cut = examined("cut.extxyz")
    assert (cut.summary["status"], cut.summary["frames"], cut.summary["cut_short"]) == ("stopped", 12, True)
    assert "frame 12" in cut.summary["stopped"] and cut.verdict.findings[0].code == "STOPPED"
    sound = examined("whole.extxyz@:12")
    for name, values in RunFolder.open(cut.folder).read("flips").items():
        np.testing.assert_array_equal(values, RunFolder.open(sound.folder).read("flips")[name])
    # only a file that breaks off is said to break off
    text[7 * 26 + 5] = "O 1.0 nought 2.0\n"
    (tmp_path / "word.extxyz").write_text("".join(text))
    nan = gas(frames=20)
    nan[7].positions[5, 1] = np.nan
    for name, some, said in (("word.extxyz", None, "nought"), ("nan.traj", nan, "atom 5")):
        broken = examined(name, some)
        assert broken.summary["frames"] == 7 and not broken.summary["cut_short"]
        assert "frame 7" in broken.summary["stopped"] and said in broken.summary["stopped"]
        assert broken.verdict.findings[0].remedy != cut.verdict.findings[0].remedy
    # at the first frame there is nothing to keep, and no folder stays
    write(tmp_path / "bad.traj", nan[7:])
    with pytest.raises(InputError, match="atom 5"):
        mdnum.flips(tmp_path / "bad.traj", cutoffs=[2.5], out=tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_one_frame_no_flips_and_odd_times(examined) -> None:
    frames = gas()
    single = examined("one.extxyz", frames[4:5])
    assert single.summary["frames"] == 1 and single.summary["rules"][0]["flips"] == 0
    assert examined("gas.extxyz", frames, cutoffs=[1e-3]).summary["rules"][0]["flips"] == 0
    assert "TIME_GOES_BACK" in codes(examined("twice.extxyz", frames[:15] + frames[10:]))
    assert "MISSING_FRAMES" in codes(examined("missing.extxyz", frames[:10] + frames[12:]))


def test_a_coarse_file_is_one(examined) -> None:
    frames = gas(frames=60, atoms=40)
    for one in frames:
        one.positions = np.round(one.positions, 1)
    found = examined("coarse.extxyz", frames, cutoffs=[2.0, 2.5])
    assert found.summary["resolution"]["step"] == pytest.approx(0.1)
    one = found.summary["rules"][1]
    assert one["ambiguous"] > 0.1 * one["flips"] and one["grid"]["missed"] > 0.01
    (said,) = [one for one in found.verdict.findings if one.code == "UNDECIDABLE"]
    assert said.severity == "warning" and said.values["missed"] > 0.01
    for rule in ("r < 2 Å", "r < 2.5 Å"):
        assert said.text.count(f"{rule}:") == 1
    assert said.text.count("marked as ambiguous") == 1


@pytest.mark.parametrize(
    ("share", "told", "variant"),
    [
        ((0.2, 0.12, 0.33), "20 % of all flips (12 % to 33 %)", "to"),
        ((0.04, 0.02, 0.08), "4.0 % of all flips (2.0 % to 8.0 %)", None),
        ((0.01, 0.0, 0.03), "fewer than 3.0 % of", None),
        ((None, None, None), "No upper bound", "cannot be estimated"),
    ],
    ids=["many", "some", "few", "no bound"],
)
def test_what_is_lost_between_frames_is_a_range_and_a_finding_where_it_is_much(
    examined, share, told, variant
) -> None:
    result = examined("gas.extxyz", gas(frames=12))
    summary = copy.deepcopy(dict(result.summary))
    one = summary["rules"][0]
    parts = dict.fromkeys(("thinning", "persistence", "velocities", "flux"), (-1.4, 0.3))
    values = dict(zip(("lost", "low", "high"), share, strict=True))
    reason = "open" if share[0] is None else "estimate"
    seen = {"reason": reason, "doubled": 0.3, "fourth": 0.5, "rounded": 0.0}
    one["stride"]["between"] = {**seen, **values, "parts": parts}
    view = FlipsView(RunFolder.open(result.folder), summary)
    verdict = judge(view)
    titles = [one.title for one in verdict.findings if one.code == "BETWEEN_FRAMES"]
    assert len(titles) == (variant is not None) and all(variant in title for title in titles)
    assert ("12 % to 33 %" in verdict.headline) == (share[0] == 0.2)
    (section,) = [one for one in page(view, verdict).sections if one.title == "Between the frames"]
    rows = dict(section.parts[0].rows)
    assert told in rows["Lost between frames"]
    assert len([name for name in rows if name.startswith("Flips lost between")]) == 4


def test_a_damped_gas_says_what_its_frames_lose_from_the_file_alone(examined) -> None:
    """Every 10th step of a gas whose velocities are kicked; the truth is counted at all steps."""
    rng, side, step, keep = np.random.default_rng(0), 7.0, 0.02, np.exp(-0.08)
    v, x = np.empty((2, 801, 40, 3))
    v[0], x[0] = rng.normal(size=(40, 3)), rng.uniform(0, side, (40, 3))
    for n in range(800):
        v[n + 1] = keep * v[n] + np.sqrt(1 - keep**2) * rng.normal(size=(40, 3))
        x[n + 1] = x[n] + 0.5 * step * (v[n] + v[n + 1])
    frames = [ase.Atoms("Ar40", one, cell=[side] * 3, pbc=True) for one in x]
    every = examined("every.extxyz", frames, cutoffs=[2.0]).summary["rules"][0]["flips"]
    kept = examined("kept.extxyz", frames[::10], cutoffs=[2.0])
    one = kept.summary["rules"][0]
    found, truth = one["stride"]["between"], 1 - one["flips"] / every
    assert 0.05 < truth < 0.15 and 0.01 < found["low"] < truth < found["high"] < 0.25
    assert set(found["parts"]) == {"thinning", "persistence"}


def test_one_atom_and_steps(tmp_path: Path, examined) -> None:
    one = examined("one.extxyz", [ase.Atoms("Ar", [[0.12, 0.34, 0.56]], cell=[9.0] * 3, pbc=True)])
    assert one.page.about.startswith("1 atom, 1 frame")
    head = (
        "ITEM: NUMBER OF ATOMS\n2\nITEM: BOX BOUNDS pp pp pp\n0 20\n0 20\n0 20\nITEM: ATOMS id type x y z\n"
    )
    rows = (f"{head}1 1 1.5 1.5 1.5\n2 1 {4.3 - 0.3 * n} 1.5 1.5\n" for n in range(3))
    text = "".join(f"ITEM: TIMESTEP\n{20 * n}\n{row}" for n, row in enumerate(rows))
    (tmp_path / "l.lammpstrj").write_text(text)
    steps = examined("l.lammpstrj")
    assert steps.summary["rules"][0]["flips"] == 1 and steps.summary["time"] == "step"
    assert "20 steps apart" in steps.page.about


@pytest.mark.parametrize(
    ("pbc", "row"),
    [
        (False, "no box that repeats"),
        ([True, False, True], "6 × 6 × 6 Å, repeating along a and c"),
        (True, "6 × 6 × 6 Å, repeating along a, b and c"),
    ],
)
def test_a_file_without_a_box_or_with_half_of_one(examined, pbc: Any, row: str) -> None:
    frames = gas(frames=1)
    frames[0].pbc = pbc
    found = examined("a.traj", frames)
    assert ("READING" in codes(found)) == (pbc is not True)
    (section,) = [one for one in found.page.sections if one.title == "What was read"]
    assert dict(section.parts[0].rows)["Box"] == row


@pytest.mark.slow
def test_two_runs_that_differ_in_one_number(crystal: Path, tmp_path: Path) -> None:
    narrow: Any = {"overrides": {"precision.force": "float32"}, "check": False, "report": False}
    other = mdnum.run("argon/crystal-108", steps=400, save_every=1, out=tmp_path / "b", **narrow).folder
    found = mdnum.flips(crystal, other, out=tmp_path / "cmp")
    rule = found.summary["rules"][0]
    tables = (RunFolder.open(path).read("flips") for path in (crystal, other))
    a, b = (set(zip(flips["step"], flips["i"], flips["j"], strict=True)) for flips in tables)
    # both start alike: the sets differ first where one of them has a flip that the other has not
    frame = min(step for step, *_ in a ^ b)
    assert rule["first"]["frame"] == rule["certain"] == frame
    pairs = {(one["i"], one["j"]) for one in rule["first_pairs"]}
    assert pairs == {(i, j) for step, i, j in a ^ b if step == frame}
    for one in rule["first_pairs"]:
        inside = [name for name in "AB" if one[f"margin_{name.lower()}"] > 0]
        assert inside == [one["inside"]]
    assert found.summary["seed"] == 1 and 0 < rule["first"]["furthest_before"] < 1e-5
    assert "NO_CAUSE_FROM_FILES" in codes(found)
    apart = RunFolder.open(found.folder).read("apart")
    x = [np.array([one.positions for one in iread(p / "trajectory.traj", ":")]) for p in (crystal, other)]
    moved = np.linalg.norm(x[0] - x[1], axis=2)
    # one of the two may have been wrapped a step before the other
    np.testing.assert_allclose(apart["furthest"][:390], moved.max(1)[:390], atol=1e-15)


def test_words_become_rules() -> None:
    assert [one.name for one in rules([8.5], (), (12,), 30)] == [
        "r < 8.5, at most 30 neighbors",
        "12 nearest",
    ]
    (pairs,) = rules((), ["O-H=2.5, O-O = 3.5"])
    assert pairs == replace(pairs, radii={("O", "H"): 2.5, ("O", "O"): 3.5})
    for words in ("O-H", "O=2", "O-H=x", "O-H=-1", "O-H-O=2", "O-H=2,H-O=3", ""):
        with pytest.raises(InputError, match="--pairs"):
            rules((), [words])
    with pytest.raises(InputError, match="--cutoff"):
        rules((), (), (), 5)
    with pytest.raises(InputError, match="twice"):
        rules([2.0, 2.0])


def test_control_c_keeps_the_frames_that_were_examined(examined) -> None:
    def press(done: int, of: int, told: dict) -> None:
        if done == 7 and told["phase"] == "run":
            signal.raise_signal(signal.SIGINT)

    # of a shell's background job, SIGINT is ignored
    before = signal.getsignal(signal.SIGINT)
    result = examined("gas.extxyz", gas(), progress=press)
    assert result.summary["status"] == "stopped" and result.summary["frames"] == 7
    assert "INTERRUPTED" in codes(result)
    part = examined("gas.extxyz@:7")
    ours, theirs = (RunFolder.open(one.folder).read("flips") for one in (result, part))
    assert len(ours["frame"]) > 0
    for name, values in ours.items():
        np.testing.assert_array_equal(values, theirs[name])
    assert signal.getsignal(signal.SIGINT) is before, "control-C is what it was before"
