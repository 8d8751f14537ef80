"""Damage that leaves numbers: atoms far out, leaps, NetCDF files that end early, text cut and compressed."""

from __future__ import annotations

import bz2
import gzip
import shutil
from pathlib import Path
from typing import Any

import ase.io
import MDAnalysis
import numpy as np
import pytest
from ase import Atoms
from MDAnalysisTests import datafiles

import mdnum
from mdnum.errors import InputError
from mdnum.trajectories import NeighborFlips
from mdnum.trajectories.binary import head_of
from mdnum.trajectories.frame import (
    Box,
    Frame,
    FrameError,
    UnreadableFrame,
    checked,
    far_out,
    leap,
)
from mdnum.trajectories.rules import CutoffRule, Nearest, SpeciesCutoffs, smallest_radius
from mdnum.trajectories.source import open_trajectory

DLPOLY = Path(datafiles.PSF).parent / "dlpoly" / "HISTORY"


def gas(side: float | None = 20.0, atoms: int = 60) -> Frame:
    x = np.random.default_rng(3).uniform(0, 20.0, (atoms, 3))
    return Frame(4, 4.0, x, Box() if side is None else Box(np.eye(3) * side, np.ones(3, bool)))


def moved(frame: Frame, atom: int, to: tuple[float, float, float]) -> Frame:
    x = frame.positions.copy()
    x[atom] = to
    return Frame(frame.index, frame.time, x, frame.box)


@pytest.mark.parametrize("side", [20.0, None])
@pytest.mark.parametrize("place", [(1e30, 2.0, 3.0), (2.0, -3e38, 3.0), (2.0, 3.0, 1e9)])
def test_an_atom_that_no_simulation_puts_there_is_named(side, place):
    frame = moved(gas(side), 17, place)
    with pytest.raises(FrameError, match="frame 4: atom 17 is at") as caught:
        list(checked([frame]))
    assert caught.value.frame == 4 and "away from the others" in str(caught.value)
    # two of them, and one that nobody asked about
    with pytest.raises(FrameError, match=r"atom 17 .*, and 1 other likewise"):
        list(checked([moved(frame, 2, (0.9 * place[0], 0.9 * place[1], 0.9 * place[2]))]))
    assert len(list(checked([frame], np.arange(10)))) == 1


def test_what_does_fly_off_drifts_or_was_never_wrapped_is_left_alone():
    for side, far in ((20.0, 1e5), (None, 1e6)):
        assert far_out(moved(gas(side), 5, (far, 0.0, 0.0))) is None
    # all of them together, in a box and out of it
    for side in (20.0, None):
        here = gas(side)
        assert far_out(Frame(0, 0.0, here.positions + 3e7, here.box)) is None
        assert leap(here, Frame(0, 0.0, here.positions + 3e7, here.box)) is None
    assert far_out(Frame(0, 0.0, np.zeros((1, 3)), Box())) is None
    assert far_out(Frame(0, 0.0, np.array([[0.0, 0, 0], [1e9, 0, 0]]), Box())) is None


def test_floats_that_tell_no_distance_there_are_said_to():
    drifted = gas()
    drifted = Frame(0, 0.0, drifted.positions + 3e7, drifted.box)
    assert far_out(drifted, radius=2.5, bits=64) is None
    found = far_out(drifted, radius=2.5, bits=32)
    assert found is not None and "float32 tells distances no better than to" in found[2] and found[1] == 60
    assert smallest_radius([Nearest(3), CutoffRule(4.0), SpeciesCutoffs({("A", "B"): 2.0})]) == 2.0
    assert smallest_radius([Nearest(3)]) == np.inf


def test_a_leap_is_told_and_wrapping_is_none(tmp_path):
    here = gas()
    found = leap(here, moved(here, 9, (5e3, 0.0, 0.0)))
    assert found is not None and found[0] == 9
    assert leap(here, moved(here, 9, (5e3, 0.0, 0.0)), np.arange(9)) is None
    assert leap(here, moved(here, 9, (600.0, 0.0, 0.0))) is None
    frames = [Atoms("Ar60", here.positions, cell=[20.0] * 3, pbc=True) for _ in range(5)]
    frames[3].positions[9] = [1e5, 1.0, 1.0]
    ase.io.write(tmp_path / "a.traj", frames)
    found = mdnum.flips(tmp_path / "a.traj", cutoffs=[4.0], out=tmp_path / "f", report=False).summary
    assert found["leaps"] == {"frames": 2, "frame": 3, "atom": 9, "distance": pytest.approx(1e5, rel=1e-3)}
    said = next(one for one in found["findings"] if one["code"] == "LEAP")
    assert said["severity"] == "warning" and "at frame 3" in said["title"] and "Atom 9" in said["text"]


def test_garbage_in_a_dcd_keeps_what_came_before(tmp_path):
    universe: Any = MDAnalysis.Universe(datafiles.PDB_small)
    group = universe.atoms[:200]
    group.write(tmp_path / "a.pdb")
    with MDAnalysis.Writer(str(tmp_path / "a.dcd"), len(group)) as writer:
        for k in range(6):
            group.positions += 0.1
            if k == 4:
                group.positions = np.where(np.arange(200)[:, None] == 77, 1e30, group.positions)
            writer.write(group)
    found = mdnum.flips(
        tmp_path / "a.dcd", topology=tmp_path / "a.pdb", nearest=[4], out=tmp_path / "f", report=False
    ).summary
    assert found["frames"] == 4 and "frame 4: atom 77 is at (1e+30, 1e+30, 1e+30)" in found["stopped"]
    analysis = NeighborFlips(MDAnalysis.Universe(tmp_path / "a.pdb", tmp_path / "a.dcd"), r_cut=5.0)
    with pytest.raises(FrameError, match="atom 77"):
        analysis.run()
    assert analysis.frames.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("name", ["NCDF", "NCDFtruncoct", "TRJ_NCBOX", "PFncdf_Trj"])
def test_an_amber_file_that_ends_early_is_read_up_to_there(tmp_path, name):
    path = getattr(datafiles, name)
    head = head_of(path)
    assert head is not None and not head.cut and head.rest == 0
    data, whole = Path(path).read_bytes(), list(open_trajectory(path).frames())
    assert len(whole) == head.records
    cut = tmp_path / "cut.ncdf"
    for kept in (1, len(whole) - 1):
        begin = len(data) - (head.whole - kept) * head.record
        cut.write_bytes(data[: begin + head.record // 2])
        opened = open_trajectory(cut)
        assert opened.reader == "mdnum" and opened.count == kept + 1
        frames = opened.frames()
        for good in whole[:kept]:
            read = next(frames)
            assert (read.index, read.time) == (good.index, good.time)
            np.testing.assert_array_equal(read.positions, good.positions)
            np.testing.assert_array_equal(read.box.matrix, good.box.matrix)
            assert (read.velocities is None) == (good.velocities is None)
            if read.velocities is not None:
                np.testing.assert_array_equal(read.velocities, good.velocities)
        with pytest.raises(UnreadableFrame, match=f"frame {kept} .*its head tells of {head.records} frames"):
            next(frames)
    # whole in what was asked for
    assert len(list(open_trajectory(f"{cut}@:1").frames())) == 1


def test_an_amber_file_without_a_whole_frame_is_refused(tmp_path):
    head, data = head_of(datafiles.NCDF), Path(datafiles.NCDF).read_bytes()
    assert head is not None
    path = tmp_path / "a.nc"
    for size in (len(data) - head.whole * head.record + 100, 300, 2):
        path.write_bytes(data[:size])
        with pytest.raises(InputError):
            open_trajectory(path)
    path.write_bytes(data[:-40])
    with pytest.raises(InputError, match="47,681 atoms and the trajectory 2,661"):
        open_trajectory(path, datafiles.GRO)


def test_an_amber_file_that_goes_on_behind_its_head_says_so(tmp_path):
    data = bytearray(Path(datafiles.NCDF).read_bytes())
    data[4:8] = (27).to_bytes(4, "big")
    path = tmp_path / "a.ncdf"
    path.write_bytes(data)
    frames = open_trajectory(path).frames()
    assert sum(1 for _ in zip(range(27), frames, strict=False)) == 27
    with pytest.raises(UnreadableFrame, match="3 frames more than its head tells of"):
        next(frames)


@pytest.mark.parametrize(("suffix", "packed"), [("gz", gzip.compress), ("bz2", bz2.compress)])
def test_a_number_cut_in_a_compressed_file_is_no_number(tmp_path, suffix, packed):
    frames = [Atoms("Ar30", gas(atoms=30).positions + n) for n in range(4)]
    ase.io.write(tmp_path / "a.xyz", frames, format="xyz")
    data = (tmp_path / "a.xyz").read_bytes()
    path = tmp_path / f"a.xyz.{suffix}"
    path.write_bytes(packed(data))
    assert len(list(open_trajectory(path).frames())) == 4
    path.write_bytes(packed(data[:-6]))
    frames = open_trajectory(path).frames()
    assert [next(frames).index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(UnreadableFrame, match="ends in the middle of a number"):
        next(frames)


def test_a_compressed_file_that_ends_early_is_no_wish_to_stop(tmp_path):
    """EOFError is what a terminal sends for control-D: it must not get as far as the command line."""
    frames = [Atoms("Ar30", gas(atoms=30).positions + n) for n in range(6)]
    for name, form in (("a.extxyz", "extxyz"), ("a.xyz", "xyz")):
        ase.io.write(tmp_path / name, frames, format=form)
        data = gzip.compress((tmp_path / name).read_bytes())
        (tmp_path / f"{name}.gz").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="ended before"):
        open_trajectory(tmp_path / "a.xyz.gz")
    shutil.copy(tmp_path / "a.xyz.gz", tmp_path / "POSCAR.gz")
    with pytest.raises(InputError):
        open_trajectory(tmp_path / "POSCAR.gz")
    found = mdnum.flips(tmp_path / "a.extxyz.gz", cutoffs=[4.0], out=tmp_path / "f", report=False).summary
    assert 0 < found["frames"] < 6 and "cannot be read" in found["stopped"]


def test_boxes_of_dl_poly_are_turned_as_its_atoms_are():
    ours = open_trajectory(DLPOLY, format="HISTORY")
    assert ours.reader == "MDAnalysis"
    cells = [atoms.cell.array for atoms in ase.io.iread(DLPOLY, ":", format="dlp-history")]
    for frame, cell in zip(ours.frames(), cells, strict=True):
        np.testing.assert_array_equal(frame.box.matrix, cell)
        assert np.triu(frame.box.matrix, 1).any()
    # read out of order too
    last = list(open_trajectory(f"{DLPOLY}@2", format="HISTORY").frames())[-1]
    np.testing.assert_array_equal(last.box.matrix, cells[2])


def test_a_folder_and_nothing_at_all_are_refused(tmp_path):
    with pytest.raises(InputError, match="it is a folder"):
        open_trajectory(tmp_path)
    for name in ("a.xtc", "a.nc", "a.pdb"):
        (tmp_path / name).touch()
        with pytest.raises(InputError, match="the file is empty"):
            open_trajectory(tmp_path / name)
        with pytest.raises(InputError, match="the file is empty"):
            open_trajectory(datafiles.XTC, tmp_path / name)
