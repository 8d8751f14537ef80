"""Files that are not what they should be: refused in a line, or read up to where they go wrong."""

from __future__ import annotations

import bz2
import gzip
import json
import re
import shutil
import warnings
from pathlib import Path
from typing import Any

import MDAnalysis
import numpy as np
import pytest
from ase import Atoms
from hypothesis import given, settings
from hypothesis import strategies as st
from MDAnalysisTests import datafiles
from trajectories.files import checked, images, read, text_of, universe_of, written

import mdnum
from mdnum.errors import InputError
from mdnum.trajectories import NeighborFlips
from mdnum.trajectories.binary import XtcFile
from mdnum.trajectories.frame import FrameError, UnreadableFrame
from mdnum.trajectories.mdanalysis_source import netcdf_of
from mdnum.trajectories.readers import open_trajectory
from mdnum.trajectories.selection import select
from mdnum.trajectories.trajectory import Trajectory

warnings.filterwarnings("ignore", module="MDAnalysis")


def ends(trajectory, frame: int, said: str = "") -> list:
    """The frames of a trajectory that cannot be read from this one on."""
    opened = trajectory if isinstance(trajectory, Trajectory) else open_trajectory(trajectory)
    frames, error = read(opened)
    assert isinstance(error, UnreadableFrame), error
    assert error.frame == len(frames) == frame and f"frame {frame}" in str(error)
    assert re.search(said, str(error)), error
    return frames


def refuse(said: str, *asked, **options) -> None:
    with pytest.raises(InputError, match=said) as caught:
        list(open_trajectory(*asked, **options).frames())
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A water box of 50 molecules: 12 frames that MDAnalysis wrote."""
    folder = tmp_path_factory.mktemp("small")
    universe = universe_of(datafiles.GRO, datafiles.XTC)
    group = universe.select_atoms("resname SOL")[:200]
    group.write(folder / "small.gro")
    for kind in ("xtc", "trr", "dcd"):
        with MDAnalysis.Writer(str(folder / f"small.{kind}"), len(group)) as writer:
            for number in (*range(6), *range(6)):
                _ = universe.trajectory[number]
                writer.write(group)
    return folder


# ---- what is no trajectory


@pytest.mark.parametrize(
    ("path", "topology", "counts"),
    [
        (datafiles.XTC, datafiles.PSF, "3,341 .*47,681"),
        (datafiles.DCD, datafiles.two_water_gro, "6 .*3,341"),
        (datafiles.NCDF, datafiles.PSF, "3,341 .*2,661"),
        ("run.traj", datafiles.two_water_gro, "two_water_gro.gro has 6 atoms and the trajectory 9"),
    ],
)
def test_a_topology_of_another_system_names_both_counts(tmp_path, path, topology, counts):
    path = written(tmp_path, "traj", images()) if path == "run.traj" else path
    refuse(counts, path, topology)


@pytest.mark.parametrize(
    "suffix", ["xtc", "trr", "dcd", "ncdf", "nc", "traj", "extxyz", "lammpstrj", "gro", "pdb", "zzz"]
)
@pytest.mark.parametrize("content", [b"", b"\x93 no trajectory \xff\x00" * 40, b"words and words\n" * 9])
def test_a_file_that_is_no_trajectory_is_refused_in_a_line(tmp_path, suffix, content):
    path = tmp_path / f"run.{suffix}"
    path.write_bytes(content)
    refuse(f"{path}.*" if content else f"{path}: the file is empty", path)
    if not content:
        refuse(f"{path}: the file is empty", datafiles.XTC, path)


def test_what_is_not_there_is_told_as_what_it_is(tmp_path):
    for path in ("nowhere.xtc", "nowhere.xtc@3:"):
        refuse("no such file", path)
    refuse(r"nowhere.gro: no such file", datafiles.XTC, "nowhere.gro")
    refuse("is a folder", tmp_path)
    for world, said in (("flips", "holds results, but no trajectory"), ("md", "--save-every 1")):
        (tmp_path / "summary.json").write_text(json.dumps({"world": world}))
        refuse(said, tmp_path)
    path = written(tmp_path, "traj", images())
    with pytest.raises(InputError, match=r"'name OW' matches none of 9 .* Ar"):
        select(open_trajectory(path), "name OW")
    with pytest.raises(InputError, match="is empty"):
        select(open_trajectory(f"{path}@9:"), "name Ar")
    assert list(open_trajectory(f"{path}@9:").frames()) == []
    refuse("selected twice", f"{path}@9:", slice=":2")


@pytest.mark.parametrize("kind", ["traj", "extxyz", "lammpstrj"])
def test_frames_without_atoms_are_refused(tmp_path, kind):
    refuse(rf"run.{kind}: .*no atoms", written(tmp_path, kind, [Atoms(cell=[5, 5, 5], pbc=True)] * 3))


# ---- bytes


@settings(max_examples=12)
@given(at=st.floats(0.05, 0.98), size=st.integers(1, 200), byte=st.integers(0, 255))
def test_a_damaged_xtc_never_ends_the_process(small, at, size, byte):
    whole = list(open_trajectory(small / "small.xtc").frames())
    data = bytearray((small / "small.xtc").read_bytes())
    begin = int(at * len(data))
    data[begin : begin + size] = bytes([byte]) * len(data[begin : begin + size])
    path = small / "damaged.xtc"
    for old in small.glob(".damaged*"):
        old.unlink()
    path.write_bytes(bytes(data))
    frames, error = read(open_trajectory(path, small / "small.gro"))
    assert error is None or (isinstance(error, UnreadableFrame) and error.frame == len(frames))
    first = begin * 12 // len(data)
    for frame, good in zip(frames[:first], whole, strict=False):
        np.testing.assert_array_equal(frame.positions, good.positions)
    assert len(frames) >= first


def test_the_guard_takes_every_real_file():
    for path in (datafiles.XTC, datafiles.XTC_multi_frame, datafiles.XTC_sub_sol):
        with MDAnalysis.lib.formats.libmdaxdr.XTCFile(path) as file:
            count = len(file)
        guard = XtcFile(path)
        for number in range(count):
            guard.check(number)
        with pytest.raises(ValueError, match="ends"):
            guard.check(count)
        guard.close()


@pytest.mark.parametrize(
    ("kind", "damage", "said"),
    [
        ("xtc", "cut", "file ends within"),
        ("xtc", "hole", "damaged"),
        ("dcd", "cut", r"file ends after [\d,]+ bytes"),
        ("trr", "cut", "file ends within"),
        ("trr", "head", "file ends within"),
        ("trr", "hole", "damaged"),
    ],
)
def test_a_file_that_was_cut_or_damaged_is_read_up_to_there(tmp_path, small, kind, damage, said):
    """By a reader and by the analysis; who asks for no more than there is gets it."""
    data = bytearray((small / f"small.{kind}").read_bytes())
    # frames of trr are of one size; elsewhere this is somewhere in frame 7
    begin = 7 * len(data) // 12 if (kind, damage) != ("xtc", "hole") else int(0.62 * len(data))
    if damage == "hole":
        data[begin : begin + 200] = b"\xff" * 200
    else:
        del data[begin + (30 if damage == "head" else 300) :]
    topology, path = small / "small.gro", tmp_path / f"bad.{kind}"
    path.write_bytes(bytes(data))
    assert len(ends(open_trajectory(path, topology), 7, said)) == 7
    assert read(open_trajectory(f"{path}@:7", topology))[1] is None
    assert read(open_trajectory(small / f"small.{kind}", topology))[1] is None
    universe: Any = MDAnalysis.Universe(topology, path)
    good = NeighborFlips(MDAnalysis.Universe(topology, small / f"small.{kind}"), 6.0).run(stop=7)
    assert len(good.results.flips)
    # where the library leaves out what is behind its last frame, who asks for that or for the end is told
    more = ({"stop": 8}, {"step": 5}) if len(universe.trajectory) == 7 else ()
    for asked in ({}, {"n_parts": 3}, *more):
        analysis = NeighborFlips(universe, 6.0)
        with pytest.raises(UnreadableFrame, match="frame 7 cannot be read") as caught:
            analysis.run(**asked)
        assert caught.value.frame == 7
        assert analysis.frames.tolist() == list(range(0, 7, asked.get("step", 1)))
        if "step" not in asked:
            assert "7 frames" in str(caught.value)
            assert analysis.results.flips.equals(good.results.flips)
    for asked in ({"stop": 7}, {"frames": [0, 6]}):
        NeighborFlips(universe, 6.0).run(**asked)


@pytest.mark.parametrize("name", ["NCDF", "NCDFtruncoct", "TRJ_NCBOX", "PFncdf_Trj"])
def test_an_amber_file_that_ends_early_is_read_up_to_there(tmp_path, name):
    path = getattr(datafiles, name)
    head = netcdf_of(path)
    assert head is not None and head.whole == head.told and head.rest == 0
    data, whole = Path(path).read_bytes(), list(open_trajectory(path).frames())
    assert len(whole) == head.told
    cut = tmp_path / "cut.ncdf"
    for kept in (1, len(whole) - 1):
        begin = len(data) - (head.whole - kept) * head.record
        cut.write_bytes(data[: begin + head.record // 2])
        opened = open_trajectory(cut)
        assert opened.reader == "mdnum" and opened.count == kept + 1
        found = ends(cut, kept, f"header announces {head.told} frames")
        for one, good in zip(found, whole[:kept], strict=True):
            assert (one.index, one.time) == (good.index, good.time)
            np.testing.assert_array_equal(one.positions, good.positions)
            np.testing.assert_array_equal(one.box.matrix, good.box.matrix)
            assert (one.velocities is None) == (good.velocities is None)
            if one.velocities is not None:
                np.testing.assert_array_equal(one.velocities, good.velocities)
    # whole in what was asked for
    assert len(list(open_trajectory(f"{cut}@:1").frames())) == 1


def test_amber_files_without_a_whole_frame_or_with_more_than_their_head_names(
    tmp_path,
):
    head, data = netcdf_of(datafiles.NCDF), bytearray(Path(datafiles.NCDF).read_bytes())
    assert head is not None
    path = tmp_path / "a.nc"
    for size in (len(data) - head.whole * head.record + 100, 300, 2):
        path.write_bytes(data[:size])
        refuse("", path)
    path.write_bytes(data[:-40])
    refuse("3,341 atoms and the trajectory 2,661", path, datafiles.PSF)
    data[4:8] = (27).to_bytes(4, "big")
    path.write_bytes(data)
    ends(path, 27, "3 frames more than")


def test_a_traj_that_was_cut_is_read_as_far_as_it_goes(tmp_path):
    path = written(tmp_path, "traj", images())
    path.write_bytes(path.read_bytes()[:-300])
    ends(path, 4, "file ends early")


# ---- text


@pytest.mark.parametrize("kind", ["extxyz", "lammpstrj", "gro", "xyz"])
@pytest.mark.parametrize("damage", ["cut", "words", "number"])
def test_text_is_read_up_to_where_it_goes_wrong(tmp_path, kind, damage):
    path = written(tmp_path, kind, images())
    lines = path.read_text().splitlines(keepends=True)
    each = len(lines) // 5
    at = 2 * each + each - (2 if kind == "gro" else 1)
    if damage == "cut":
        del lines[at:]
    else:
        odd = "something else altogether\n", re.sub(r"(\.\d)\d", r"\1x", lines[at], count=1)
        lines[at] = odd[damage == "number"]
    path.write_text("".join(lines))
    ends(path, 2, "@:2")
    if damage == "number":
        # a word in the middle is not the end of the file
        assert "ends" not in str(read(open_trajectory(path))[1])


@pytest.mark.parametrize(
    ("kind", "word"),
    [
        # as programs write the last column: so many decimals, so many digits in all, with exponents
        ("extxyz", "{:16.8f}"), ("extxyz", "{:.8e}"), ("extxyz", "{:g}"), ("lammpstrj", "{:g}"),
        ("lammpstrj", "{:.8e}"), ("xyz", "{:9.4f}"), ("gro", "{}"),
    ],
)  # fmt: skip
def test_a_number_that_was_cut_is_not_read_as_another(tmp_path, kind, word):
    text = text_of(kind, images(), word.format).rstrip("\n")
    path = tmp_path / f"run.{kind}"
    for cut in range(len(text.split()[-1]) + 1):
        path.write_text(text[: len(text) - cut])
        for old in tmp_path.glob(".run*"):
            old.unlink()
        if cut:
            ends(path, 4)
        else:
            # whole, only the end of the line is missing
            frames, error = read(open_trajectory(path))
            assert error is None and len(frames) == 5


@pytest.mark.parametrize("packed", ["", ".gz", ".bz2"])
def test_what_stands_behind_the_last_whole_frame_is_a_frame_too(tmp_path, packed):
    path = tmp_path / f"run.xyz{packed}"
    pack = {"": bytes, ".gz": gzip.compress, ".bz2": bz2.compress}[packed]
    lines = text_of("xyz", images()).splitlines(keepends=True)
    # a number cut in its fourth atom, whole lines of it, and a number cut in its last line
    for text, said in (
        ("".join(lines[:-5])[:-3], "after 6 lines of it"),
        ("".join(lines[:-4]), "after 7 lines of it"),
        ("".join(lines)[:-4], "ends in the middle of a number"),
    ):
        path.write_bytes(pack(text.encode()))
        for old in tmp_path.glob(".run*"):
            old.unlink()
        ends(path, 4, said)
        assert read(open_trajectory(f"{path}@:4"))[1] is None
        error = read(open_trajectory(f"{path}@::2"))[1]
        assert isinstance(error, UnreadableFrame) and error.frame == 4


def test_a_compressed_file_that_ends_early_is_no_wish_to_stop(tmp_path):
    """EOFError is what a terminal sends for control-D: it must not get as far as the command line."""
    for kind in ("extxyz", "xyz"):
        data = gzip.compress(text_of(kind, images(60)).encode())
        (tmp_path / f"a.{kind}.gz").write_bytes(data[: len(data) // 2])
    refuse("ended before", tmp_path / "a.xyz.gz")
    shutil.copy(tmp_path / "a.xyz.gz", tmp_path / "POSCAR.gz")
    refuse("", tmp_path / "POSCAR.gz")
    found = mdnum.flips(tmp_path / "a.extxyz.gz", cutoffs=[4.0], out=tmp_path / "f", report=False).summary
    assert 0 < found["frames"] < 60 and "cannot be read" in found["stopped"]


def test_a_box_that_was_cut_to_three_numbers_is_not_a_rectangular_one(tmp_path):
    side = "   1.00000"
    text = text_of("gro", images(2), side=side).replace(
        3 * side, 3 * side + "   0.00000   0.00000   0.50000   0.00000   0.50000   0.50000"
    )
    path = tmp_path / "run.gro"
    path.write_text(text.rstrip("\n"))
    assert read(open_trajectory(path))[1] is None
    path.write_text(text.rstrip("\n")[:-60])
    ends(path, 1, "after 3 numbers")


# ---- other atoms


@pytest.mark.parametrize("kind", ["traj", "extxyz"])
def test_atoms_that_come_and_go_are_refused(tmp_path, kind):
    path = written(tmp_path, kind, [*images()[:2], Atoms("Ar8", np.ones((8, 3)))])
    frames, error = read(open_trajectory(path))
    assert len(frames) == 2 and "frame 2 has 8 atoms" in str(error)
    # whoever tells of it need not find out where
    assert isinstance(error, FrameError) and error.frame == 2


def test_lammps_atoms_that_are_others_are_refused(tmp_path):
    path = written(tmp_path, "lammpstrj", images(2))
    first, second = path.read_text().split("TIMESTEP\n1\n")
    path.write_text(first + "TIMESTEP\n1\n" + second.replace("\n2 Ar", "\n17 Ar"))
    frames, error = read(open_trajectory(path))
    assert len(frames) == 1 and "frame 1 lacks atom 2" in str(error)


@pytest.mark.parametrize("kind", ["extxyz", "traj", "xyz", "pdb", "gro", "lammpstrj"])
def test_atoms_that_change_their_order_or_element_in_mid_file_end_it(tmp_path, kind):
    rng = np.random.default_rng(4)
    path = written(tmp_path, kind, [
        Atoms("OH2C" if number < 3 else "OHCH", rng.uniform(0, 8, (4, 3)), cell=np.eye(3) * 9, pbc=True)
        for number in range(6)
    ])  # fmt: skip
    trajectory = open_trajectory(path)
    seen = []
    with pytest.raises(FrameError, match=r"frame 3: atom 2 .*C, .*H") as told:
        for frame in checked(trajectory.frames(), where=str(path)):
            seen.append(frame.index)
    assert seen == [0, 1, 2] and told.value.frame == 3
    # those atoms are not looked at
    assert len(list(checked(trajectory.frames(), np.array([0, 1])))) == 6
    # what came before is kept, and said
    if kind in ("extxyz", "pdb"):
        summary = mdnum.flips(path, cutoffs=[3.0], out=tmp_path / "out", report=False).summary
        assert summary["frames"] == 3 and summary["status"] == "stopped"
        assert "atom 2" in summary["stopped"]
    if kind in ("xyz", "pdb"):
        with pytest.raises(FrameError, match="frame 3: atom 2"):
            NeighborFlips(MDAnalysis.Universe(str(path)), r_cut=3.0).run()
