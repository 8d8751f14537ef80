"""Frames that repeat earlier ones, bit for bit: named with their numbers, and left out on request."""

from __future__ import annotations

from pathlib import Path

import ase.io
import MDAnalysis
import numpy as np
import pytest
from ase import Atoms

import mdnum
from mdnum.store import RunFolder
from mdnum.trajectories import NeighborFlips
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.repeats import RepeatedFrames, digest
from mdnum.verbs.flips_compare import ComparisonView
from mdnum.verbs.flips_compare import judge as judge_both
from mdnum.verbs.flips_page import judge
from mdnum.verbs.flips_shared import FlipsView

DATA = Path(__file__).with_name("data")
SIDE = 9.0


def walk(frames: int, atoms: int = 20, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return list(rng.uniform(0, SIDE, (atoms, 3)) + np.cumsum(rng.normal(0, 0.2, (frames, atoms, 3)), axis=0))


def written(path: Path, positions, times=None) -> Path:
    """A file of these positions; traj and xtc have times where they are given."""
    if path.suffix == ".xtc":
        universe = MDAnalysis.Universe.empty(len(positions[0]), trajectory=True)
        universe.dimensions = [SIDE] * 3 + [90] * 3
        with MDAnalysis.Writer(str(path), len(positions[0])) as writer:
            for k, x in enumerate(positions):
                universe.atoms.positions = x
                universe.trajectory.ts.time = float(k if times is None else times[k])
                writer.write(universe)
        return path
    images = [Atoms(f"Ar{len(x)}", x, cell=[SIDE] * 3, pbc=True) for x in positions]
    for k, atoms in enumerate(images):
        if times is not None:
            atoms.info["time"] = float(times[k])
    ase.io.write(path, images)
    return path


def flips(path, out, **options):
    return mdnum.flips(path, **{"cutoffs": [4.0], "out": out, "report": False, **options}).summary


def named(summary) -> list[tuple[int, int, int, int]]:
    ends = ("first", "last", "of_first", "of_last")
    return [tuple(one[name] for name in ends) for one in summary["repeats"]["ranges"]]


def finding(summary):
    return next((one for one in summary["findings"] if one["code"] == "REPEATED_FRAMES"), None)


def test_a_restart_that_wrote_its_frames_again_is_named_and_can_be_left_out(tmp_path):
    path = DATA / "restart_overlap.extxyz"
    whole = mdnum.flips(path, cutoffs=[5.0], out=tmp_path / "a", report=False).summary
    assert whole["rules"][0]["flips"] == 125 and whole["frames"] == 21
    assert named(whole) == [(13, 16, 9, 12)]
    said = finding(whole)
    assert said["severity"] == "warning" and "13 to 16" in said["text"] and "9 to 12" in said["text"]
    left = mdnum.flips(path, cutoffs=[5.0], out=tmp_path / "b", report=False, drop_repeats=True).summary
    assert left["rules"][0]["flips"] == 101 and left["frames"] == 17
    assert finding(left)["severity"] == "info" and named(left) == named(whole)
    # those that are left keep their numbers
    table = RunFolder.open(tmp_path / "b").read("frames")
    assert table["number"].tolist() == [*range(13), *range(17, 21)]
    assert table["frame"].tolist() == list(range(17))


@pytest.mark.parametrize("kind", ["extxyz", "traj", "xtc"])
@pytest.mark.parametrize("timed", [True, False])
def test_overlaps_copies_and_standstills_of_any_file(tmp_path, kind, timed):
    run = walk(12)
    order = [0, 1, 2, 3, 4, 3, 4, 5, 6, 6, 6, 6, 7, 8, 2, 9, 10]
    # a restart repeats its times, a file that was joined its own
    path = written(tmp_path / f"run.{kind}", [run[k] for k in order], order if timed else None)
    clean = written(tmp_path / f"clean.{kind}", run[:11])
    found = flips(path, tmp_path / "a")
    assert named(found) == [(5, 6, 3, 4), (9, 11, 8, 8), (14, 14, 2, 2)]
    assert found["repeats"]["frames"] == 6 and [one["still"] for one in found["repeats"]["ranges"]] == [
        False, True, False,
    ]  # fmt: skip
    text = finding(found)["text"]
    for words in ("5 to 6 repeat frames 3 to 4", "frames 9 to 11 repeat frame 8", "frame 14 repeats frame 2"):
        assert words in text
    left, whole = flips(path, tmp_path / "b", drop_repeats=True), flips(clean, tmp_path / "c")
    assert left["rules"][0]["flips"] == whole["rules"][0]["flips"] != found["rules"][0]["flips"]
    if timed:
        assert found["backward"] and not left["backward"]
    # numbers are those of the file, whatever slice is read
    assert named(flips(f"{path}@4:", tmp_path / "d")) == [(6, 6, 4, 4), (9, 11, 8, 8)]
    assert named(flips(f"{path}@3::2", tmp_path / "e")) == [(5, 5, 3, 3), (11, 11, 9, 9)]


def test_what_stands_still_is_told_in_words_of_its_own(tmp_path):
    run = walk(60)
    # at its end, once among many frames, for long in the middle, and from the beginning on
    cases = {
        "end": (run[:5] + [run[5]] * 6, "info"), "once": ([*run[:30], run[29], *run[30:]], "info"),
        "middle": (run[:5] + [run[5]] * 6 + run[6:9], "warning"), "always": ([run[0]] * 5, "info"),
    }  # fmt: skip
    for name, (positions, severity) in cases.items():
        said = finding(flips(written(tmp_path / f"{name}.extxyz", positions), tmp_path / name))
        assert said["severity"] == severity, name
    assert finding(flips(written(tmp_path / "run.extxyz", run), tmp_path / "run")) is None


def test_a_position_a_box_or_a_bit_makes_another_frame():
    x = walk(1, atoms=3000)[0]
    box = Box(np.eye(3) * SIDE, np.ones(3, bool))
    known = digest(Frame(0, 0.0, x, box))
    assert known == digest(Frame(7, 3.0, x.copy(), box))
    for atom in (0, 1, 1499, 2999):
        other = x.copy()
        other[atom, 2] = np.nextafter(other[atom, 2], 9)
        assert digest(Frame(0, 0.0, other, box)) != known
    swapped = x.copy()
    swapped[[1, 2]] = swapped[[2, 1]]
    assert digest(Frame(0, 0.0, swapped, box)) != known
    assert digest(Frame(0, 0.0, x, Box(np.eye(3) * 9.5, np.ones(3, bool)))) != known
    assert digest(Frame(0, 0.0, x, Box(np.eye(3) * SIDE, np.array([True, True, False])))) != known


def test_memory_is_that_of_digests():
    repeats = RepeatedFrames(drop=True)
    frames = (Frame(k, 0.0, np.full((50_000, 3), float(k % 3)), Box()) for k in range(9))
    assert [one.index for one in repeats(frames)] == [0, 1, 2]
    assert all(len(one) == 16 for one in repeats._known) and len(repeats._known) == 3


def test_of_two_files_those_of_each_are_named_and_left_out(tmp_path):
    run = walk(10)
    a = written(tmp_path / "a.extxyz", run)
    b = written(tmp_path / "b.extxyz", [run[k] for k in (0, 1, 2, 3, 2, 3, 4, 5, 6, 7)])
    found = flips(a, tmp_path / "x", other=b)
    assert [len(one["ranges"]) for one in found["repeats"]] == [0, 1] and found["seed"] == 4
    assert "b.extxyz: 2 frames" in finding(found)["title"]
    left = flips(a, tmp_path / "y", other=b, drop_repeats=True)
    assert left["seed"] is None and left["frames"] == 8
    assert RunFolder.open(tmp_path / "y").read("apart")["number_b"].tolist() == [0, 1, 2, 3, 6, 7, 8, 9]


@pytest.mark.parametrize("parts", [1, 3])
def test_the_analysis_names_them(tmp_path, parts):
    run = walk(8)
    path = written(tmp_path / "run.xtc", [run[k] for k in (0, 1, 2, 1, 2, 3, 3, 4)])
    universe = MDAnalysis.Universe.empty(20, trajectory=True)
    universe.load_new(str(path))
    found = NeighborFlips(universe, 4.0).run(n_parts=parts).results.repeats
    assert [(one["first"], one["last"], one["of_first"]) for one in found] == [(3, 4, 1), (6, 6, 5)]


def test_a_folder_that_knew_none_of_it_is_still_judged(tmp_path):
    path = written(tmp_path / "run.xtc", walk(4))
    one, two = flips(path, tmp_path / "a"), flips(path, tmp_path / "b", other=path)
    for summary, judged, view, name in ((one, judge, FlipsView, "a"), (two, judge_both, ComparisonView, "b")):
        older = {
            key: value
            for key, value in summary.items()
            if key not in ("repeats", "alternative_box", "retyped")
        }
        found = judged(view(RunFolder.open(tmp_path / name), older))
        assert [one.code for one in found.findings] == [one["code"] for one in summary["findings"]]


@pytest.mark.parametrize("kind", ["xtc", "traj", "extxyz"])
def test_a_restart_that_rounds_otherwise_repeats_times_which_are_named_and_left_out(tmp_path, kind):
    run, rng = walk(16), np.random.default_rng(3)
    order = [*range(13), *range(9, 16)]
    jitter = [0.0 if n < 13 else 1e-3 * rng.normal(size=(20, 3)) for n in range(20)]
    path = written(
        tmp_path / f"run.{kind}",
        [run[k] + more for k, more in zip(order, jitter, strict=True)],
        [100.0 * k for k in order],
    )
    found = flips(path, tmp_path / "a")
    said = next(one for one in found["findings"] if one["code"] == "TIME_GOES_BACK")
    assert all(part in said["text"] for part in ("13 to 16", "9 to 12", "900 to 1,200 ps"))
    assert found["frames"] == 20 and not found["repeats"]["frames"] and not found["timed"]
    left = flips(path, tmp_path / "b", drop_repeats=True)
    said = next(one for one in left["findings"] if one["code"] == "TIME_GOES_BACK")
    assert said["severity"] == "info" and said["title"].startswith("4 frames")
    assert left["timed"] and left["interval"] == 100.0
    table = RunFolder.open(tmp_path / "b").read("frames")
    assert table["number"].tolist() == [*range(13), *range(17, 20)]


def test_times_that_go_back_without_being_there_before_are_named_and_constant_ones_are_left_alone(tmp_path):
    run = walk(8)
    path = written(tmp_path / "a.xtc", run, [0.0, 10, 20, 30, 15, 25, 35, 45])
    for drop in (True, False):
        found = flips(path, tmp_path / f"a{drop}", drop_repeats=drop)
        said = next(one for one in found["findings"] if one["code"] == "TIME_GOES_BACK")
        assert "frame 4" in said["text"] and "30 to 15 ps" in said["text"] and found["frames"] == 8
    path = written(tmp_path / "b.xtc", run, [0.0] * 8)
    assert flips(path, tmp_path / "b", drop_repeats=True)["frames"] == 8


@pytest.mark.parametrize("kind", ["traj", "extxyz"])
@pytest.mark.parametrize("atoms", [5, 1500])
def test_a_repeat_that_the_restart_wrapped_is_one(tmp_path, kind, atoms):
    run = walk(10, atoms)
    order = [*range(8), 5, 6, 7, 8, 9]
    positions = [run[k] % SIDE if n > 7 else run[k] + SIDE * (k % 3) for n, k in enumerate(order)]
    # 1,500 in this box are dense: few pairs will do
    near = {"cutoffs": [1.0]}
    assert named(flips(written(tmp_path / f"run.{kind}", positions), tmp_path / "a", **near)) == [
        (8, 10, 5, 7)
    ]
    # an atom elsewhere is motion
    positions[9][0, 1] += 1e-4
    found = flips(written(tmp_path / f"moved.{kind}", positions), tmp_path / "b", **near)
    assert named(found) == [(8, 8, 5, 5), (10, 10, 7, 7)]
