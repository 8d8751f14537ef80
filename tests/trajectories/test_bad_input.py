"""Files that are not what they should be: refused in a line, or read up to where they go wrong."""

from __future__ import annotations

import gzip
import json
import re
import shutil
import warnings
from typing import Any

import ase.io
import MDAnalysis
import numpy as np
import pytest
from ase import Atoms
from hypothesis import given, settings
from hypothesis import strategies as st
from MDAnalysisTests import datafiles

import mdnum
from mdnum.errors import InputError
from mdnum.trajectories import NeighborFlips
from mdnum.trajectories.binary import XtcFile
from mdnum.trajectories.frame import Box, Frame, FrameError, UnreadableFrame, checked
from mdnum.trajectories.source import open_trajectory, select

warnings.filterwarnings("ignore", module="MDAnalysis")


def read(trajectory):
    """(frames before it went wrong, the error)."""
    frames = []
    try:
        for frame in trajectory.frames():
            frames.append(frame)
    except InputError as error:
        return frames, error
    return frames, None


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A water box of 50 atoms as an xtc of 12 frames that MDAnalysis wrote."""
    folder = tmp_path_factory.mktemp("xtc")
    universe = MDAnalysis.Universe(datafiles.GRO, datafiles.XTC)
    group = universe.select_atoms("resname SOL")[:200]
    group.write(folder / "small.gro")
    with MDAnalysis.Writer(str(folder / "small.xtc"), len(group)) as writer:
        for _ in range(2):
            for _ts in universe.trajectory[:6]:
                writer.write(group)
    return folder


@pytest.mark.parametrize(
    ("path", "topology", "counts"),
    [
        (datafiles.XTC, datafiles.PSF, ("3,341", "47,681")),
        (datafiles.DCD, datafiles.GRO, ("47,681", "3,341")),
        (datafiles.NCDF, datafiles.GRO, ("47,681", "2,661")),
    ],
)
def test_a_topology_of_another_system_names_both_counts(path, topology, counts):
    with pytest.raises(InputError) as caught:
        open_trajectory(path, topology)
    assert all(count in str(caught.value) for count in counts)


def test_a_topology_of_another_system_for_a_file_of_ase(tmp_path):
    ase.io.write(tmp_path / "run.traj", Atoms("H5", np.eye(5, 3)))
    with pytest.raises(InputError, match=r"two_water_gro.gro has 6 atoms and the trajectory 5"):
        open_trajectory(tmp_path / "run.traj", datafiles.two_water_gro)


def test_a_file_that_is_not_there_or_nothing():
    for path in ("nowhere.xtc", "nowhere.xtc@3:"):
        with pytest.raises(InputError, match="no such file"):
            open_trajectory(path)
    with pytest.raises(InputError, match=r"nowhere.gro: no such file"):
        open_trajectory(datafiles.XTC, "nowhere.gro")


@pytest.mark.parametrize(
    "suffix", ["xtc", "trr", "dcd", "ncdf", "traj", "extxyz", "lammpstrj", "gro", "pdb", "zzz"]
)
@pytest.mark.parametrize("content", [b"", b"\x93 no trajectory \xff\x00" * 40, b"words and words\n" * 9])
def test_a_file_that_is_no_trajectory_is_refused_in_a_line(tmp_path, suffix, content):
    path = tmp_path / f"run.{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        list(open_trajectory(path).frames())
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@settings(max_examples=25)
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


@pytest.mark.parametrize("kind", ["cut", "hole"])
def test_the_analysis_keeps_what_it_read_of_a_damaged_file(tmp_path, small, kind):
    data = bytearray((small / "small.xtc").read_bytes())
    begin = int(0.62 * len(data))
    if kind == "cut":
        del data[begin:]
    else:
        data[begin : begin + 150] = b"\x7f" * 150
    shutil.copy(small / "small.gro", tmp_path)
    (tmp_path / "small.xtc").write_bytes(bytes(data))
    universe = MDAnalysis.Universe(tmp_path / "small.gro", tmp_path / "small.xtc")
    good = NeighborFlips(MDAnalysis.Universe(small / "small.gro", small / "small.xtc"), 6.0).run(stop=7)
    for parts in (1, 3):
        analysis = NeighborFlips(universe, 6.0)
        with pytest.raises(UnreadableFrame, match="frame 7 cannot be read") as caught:
            analysis.run(n_parts=parts)
        assert caught.value.frame == 7 and "7 frames before it are kept" in str(caught.value)
        assert analysis.frames.tolist() == list(range(7))
        np.testing.assert_array_equal(analysis.results.flips.frame, good.results.flips.frame)
        np.testing.assert_array_equal(analysis.results.flips.margin, good.results.flips.margin)


def test_a_dcd_that_was_cut_says_so(tmp_path):
    with open(datafiles.DCD, "rb") as file:
        (tmp_path / "cut.dcd").write_bytes(file.read(1_000_000))
    frames, error = read(open_trajectory(tmp_path / "cut.dcd", datafiles.PSF))
    assert isinstance(error, UnreadableFrame) and error.frame == len(frames) == 24
    # who asks for no more than there is gets it
    assert read(open_trajectory(f"{tmp_path / 'cut.dcd'}@:24", datafiles.PSF))[1] is None
    assert read(open_trajectory(datafiles.DCD, datafiles.PSF))[1] is None


def moving_atoms() -> Any:
    """Four frames of forty atoms in memory."""
    universe: Any = MDAnalysis.Universe.empty(40, trajectory=True)
    x = np.random.default_rng(0).uniform(0, 20, (4, 40, 3)).astype(np.float32)
    return universe.load_new(x, dimensions=[20, 20, 20, 90, 90, 90])


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("coordinates", r"frame 2 cannot be read \(the file ends in it\)"),
        ("head", r"frame 2 cannot be read \(the file ends after 30 bytes of it\)"),
        ("damaged", r"frame 2 cannot be read \(the .* bytes behind the frame before are no frame\)"),
    ],
)
def test_a_trr_that_was_cut_or_damaged_says_so(tmp_path, kind, said):
    universe = moving_atoms()
    universe.atoms.write(str(tmp_path / "whole.trr"), frames="all")
    data = bytearray((tmp_path / "whole.trr").read_bytes())
    each = len(data) // 4
    if kind == "damaged":
        data[2 * each : 2 * each + 200] = b"\xff" * 200
    else:
        del data[2 * each + {"coordinates": 300, "head": 30}[kind] :]
    path = tmp_path / "bad.trr"
    path.write_bytes(bytes(data))
    frames, error = read(open_trajectory(path))
    assert isinstance(error, UnreadableFrame) and error.frame == len(frames) == 2
    assert re.search(said, str(error)), error
    # who asks for no more than there is gets it
    assert read(open_trajectory(f"{path}@:2"))[1] is None
    assert read(open_trajectory(tmp_path / "whole.trr"))[1] is None
    universe.load_new(str(path))
    analysis = NeighborFlips(universe, 5.0)
    with pytest.raises(UnreadableFrame, match="frame 2 cannot be read"):
        analysis.run()
    assert analysis.frames.tolist() == [0, 1] and len(analysis.results.pairs) == 2
    NeighborFlips(universe, 5.0).run(stop=2)


def test_the_analysis_names_the_frame_that_a_dcd_ends_in(tmp_path):
    with open(datafiles.DCD, "rb") as file:
        (tmp_path / "cut.dcd").write_bytes(file.read(1_000_000))
    universe: Any = MDAnalysis.Universe(datafiles.PSF, str(tmp_path / "cut.dcd"))
    for parts, asked in ((1, {}), (3, {}), (1, {"stop": 25}), (1, {"step": 5})):
        analysis = NeighborFlips(universe.atoms[:200], 5.0)
        with pytest.raises(UnreadableFrame, match="frame 24 cannot be read") as caught:
            analysis.run(n_parts=parts, **asked)
        assert caught.value.frame == 24
        assert analysis.frames.tolist() == list(range(0, 24, asked.get("step", 1)))
        assert len(analysis.results.flips)
    for asked in ({"stop": 24}, {"frames": [0, 23]}):
        NeighborFlips(universe.atoms[:200], 5.0).run(**asked)


def images():
    random = np.random.default_rng(0)
    return [Atoms("Ar9", random.normal(size=(9, 3)), cell=[9, 9, 9], pbc=True) for _ in range(5)]


LAMMPS = "ITEM: TIMESTEP\n{k}\nITEM: NUMBER OF ATOMS\n2\nITEM: BOX BOUNDS pp pp pp\n0 9\n0 9\n0 9\n"
LAMMPS += "ITEM: ATOMS id type x y z\n1 1 1.5 1.5 1.5\n2 1 3.5 3.5 3.5\n"
GRO = "frame {k}\n    2\n" + "".join(
    f"    1SOL     OW{k:5d}{0.1 * k:8.3f}{0.2 * k:8.3f}{0.3 * k:8.3f}\n" for k in (1, 2)
)
GRO += "   1.00000   1.00000   1.00000\n"


@pytest.mark.parametrize("kind", ["extxyz", "lammpstrj", "gro"])
@pytest.mark.parametrize("damage", ["cut", "words", "number"])
def test_text_is_read_up_to_where_it_goes_wrong(tmp_path, kind, damage):
    path = tmp_path / f"run.{kind}"
    if kind == "extxyz":
        ase.io.write(path, images())
    else:
        path.write_text("".join({"lammpstrj": LAMMPS, "gro": GRO}[kind].format(k=k) for k in range(5)))
    lines = path.read_text().splitlines(keepends=True)
    each = len(lines) // 5
    last = {"extxyz": each - 1, "lammpstrj": each - 1, "gro": each - 2}[kind]
    if damage == "cut":
        del lines[2 * each + last :]
    elif damage == "words":
        lines[2 * each + last] = "something else altogether\n"
    else:
        lines[2 * each + last] = re.sub(r"(\.\d)\d", r"\1x", lines[2 * each + last], count=1)
        if kind == "lammpstrj":
            lines[2 * each + last] = lines[2 * each + last].replace("3.5", "3.x", 1)
    path.write_text("".join(lines))
    frames, error = read(open_trajectory(path))
    assert isinstance(error, UnreadableFrame), error
    assert error.frame == len(frames) == 2 and "frame 2" in str(error) and "@:2" in str(error)


WRITTEN = {
    # as programs write the last column: so many decimals, so many digits in all, with exponents
    "extxyz": lambda x: f"{x:16.8f}",
    "lammpstrj": lambda x: f"{x:g}",
    "gro": lambda x: f"{x:10.5f}",
    "xyz": lambda x: f"{x:9.4f}",
    "exponents": lambda x: f"{x:.8e}",
}


def text_of(kind, name):
    """Five frames of nine atoms as words, the last column as `WRITTEN` has it."""
    word = WRITTEN[name]
    text = ""
    for k, atoms in enumerate(images()):
        rows = [[word(one) for one in row] for row in atoms.positions]
        if kind == "lammpstrj":
            head = LAMMPS.format(k=k).replace("ATOMS\n2\n", "ATOMS\n9\n").partition("1 1 1.5")[0]
            text += head + "".join(f"{i + 1} 1 {' '.join(row)}\n" for i, row in enumerate(rows))
        elif kind == "gro":
            atom = "    1SOL     OW    1   0.100   0.200   0.300\n"
            text += f"frame {k}\n    9\n" + 9 * atom + 3 * word(1.25 + 0.1 * k) + "\n"
        else:
            box = 'Lattice="9 0 0 0 9 0 0 0 9" Properties=species:S:1:pos:R:3'
            text += f"9\n{box if kind == 'extxyz' else ''}\n"
            text += "".join(f"Ar {' '.join(row)}\n" for row in rows)
    return text


@pytest.mark.parametrize(
    ("kind", "name"),
    [(kind, kind) for kind in ("extxyz", "lammpstrj", "gro", "xyz")]
    + [("extxyz", "exponents"), ("lammpstrj", "exponents"), ("extxyz", "lammpstrj")],
)
def test_a_number_that_was_cut_is_not_read_as_another(tmp_path, kind, name):
    text = text_of(kind, name).rstrip("\n")
    path = tmp_path / f"run.{kind}"
    last = len(text.split()[-1])
    for cut in range(last + 1):
        path.write_text(text[: len(text) - cut])
        for old in tmp_path.glob(".run*"):
            old.unlink()
        frames, error = read(open_trajectory(path))
        if cut == 0:
            # whole, only the end of the line is missing
            assert error is None and len(frames) == 5
        else:
            assert isinstance(error, UnreadableFrame) and error.frame == len(frames) == 4, (cut, error)


@pytest.mark.parametrize("packed", ["", ".gz"])
def test_a_number_cut_behind_the_last_whole_frame_is_none_of_its_numbers(tmp_path, packed):
    path = tmp_path / f"run.xyz{packed}"
    lines = text_of("xyz", "xyz").splitlines(keepends=True)
    # in the fourth atom of the last frame
    text = "".join(lines[:-5])[:-3].encode()
    path.write_bytes(gzip.compress(text) if packed else text)
    frames, error = read(open_trajectory(path))
    assert isinstance(error, UnreadableFrame) and error.frame == len(frames) == 4
    assert "after 6 lines of it" in str(error)


def test_a_word_in_the_middle_is_not_the_end_of_the_file(tmp_path):
    path = tmp_path / "run.xyz"
    lines = text_of("xyz", "xyz").splitlines(keepends=True)
    lines[2 * 11 + 5] = "Ar 1.0 nought 2.0\n"
    path.write_text("".join(lines))
    frames, error = read(open_trajectory(path))
    assert isinstance(error, UnreadableFrame) and error.frame == len(frames) == 2
    assert "nought" in str(error) and "ends" not in str(error)


@pytest.mark.parametrize("asked", ["", "@::3"])
def test_lines_behind_the_last_frame_of_a_library_are_a_frame_too(tmp_path, asked):
    path = tmp_path / "run.xyz"
    path.write_text("".join(text_of("xyz", "xyz").splitlines(keepends=True)[:-4]))
    _, error = read(open_trajectory(f"{path}{asked}"))
    assert isinstance(error, UnreadableFrame) and error.frame == 4 and "after 7 lines of it" in str(error)
    assert read(open_trajectory(f"{path}@:4"))[1] is None


def test_a_box_that_was_cut_to_three_numbers_is_not_a_rectangular_one(tmp_path):
    text = GRO.replace("1.00000\n", "1.00000   0.00000   0.00000   0.50000   0.00000   0.50000   0.50000\n")
    text = (text.format(k=0) + text.format(k=1)).rstrip("\n")
    (tmp_path / "run.gro").write_text(text)
    assert read(open_trajectory(tmp_path / "run.gro"))[1] is None
    (tmp_path / "run.gro").write_text(text[:-60])
    frames, error = read(open_trajectory(tmp_path / "run.gro"))
    assert isinstance(error, UnreadableFrame) and len(frames) == 1 and "3 numbers of the box" in str(error)


def test_a_traj_that_was_cut_is_read_as_far_as_it_goes(tmp_path):
    ase.io.write(tmp_path / "run.traj", images())
    data = (tmp_path / "run.traj").read_bytes()
    (tmp_path / "run.traj").write_bytes(data[:-300])
    frames, error = read(open_trajectory(tmp_path / "run.traj"))
    assert isinstance(error, UnreadableFrame) and error.frame == len(frames) == 4
    assert "the file ends in it" in str(error)


@pytest.mark.parametrize("kind", ["traj", "extxyz"])
def test_atoms_that_come_and_go_are_refused(tmp_path, kind):
    ase.io.write(tmp_path / f"run.{kind}", [*images()[:2], Atoms("Ar8", np.ones((8, 3)))])
    frames, error = read(open_trajectory(tmp_path / f"run.{kind}"))
    assert len(frames) == 2 and "frame 2 has 8 atoms and the first 9" in str(error)
    # whoever tells of it need not find out where
    assert isinstance(error, FrameError) and error.frame == 2


def test_lammps_atoms_that_are_others_are_refused(tmp_path):
    text = LAMMPS.format(k=0) + LAMMPS.format(k=1).replace("\n2 1 3.5", "\n7 1 3.5")
    (tmp_path / "run.lammpstrj").write_text(text)
    frames, error = read(open_trajectory(tmp_path / "run.lammpstrj"))
    assert len(frames) == 1 and "frame 1 lacks atom 2" in str(error)


def frames(spoil=lambda k, x: None, pbc=lambda k: True):
    random = np.random.default_rng(0)
    for k in range(4):
        x = random.normal(size=(6, 3))
        spoil(k, x)
        yield Frame(10 * k, float(k), x, Box(9 * np.eye(3), np.full(3, pbc(k))))


def put(number, rows, value):
    def spoil(k, x):
        if k == number:
            x[rows] = value

    return spoil


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (put(2, slice(4, 5), np.nan), r"frame 20: atom 4 is at \(nan, nan, nan\)"),
        (put(2, (slice(1, 4), 2), -np.inf), r"frame 20: atom 1 is at \(.*-inf\), and 2 others"),
        (put(2, slice(None), 0.0), "frame 20: all coordinates are 0"),
        (put(2, slice(3, 5), 0.0), "frame 20: atom 3 is at exactly 0, 0, 0, and 1 other"),
    ],
)
def test_frame_and_atom_are_named(spoil, said):
    seen = []
    with pytest.raises(FrameError, match=said) as caught:
        for frame in checked(frames(spoil)):
            seen.append(frame.index)
    assert seen == [0, 10] and caught.value.frame == 20


def test_what_is_fine_is_not_refused():
    assert len(list(checked(frames()))) == 4
    # one atom may be at the origin, and what is not looked at may be anywhere
    assert len(list(checked(frames(put(2, slice(4, 5), 0.0))))) == 4
    assert len(list(checked(frames(put(2, slice(4, 5), np.nan)), np.array([0, 1, 2])))) == 4
    # large, but a place; too large is test_damage.py
    assert len(list(checked(frames(put(2, slice(4, 5), 1e5))))) == 4


def test_a_box_that_leaves_is_named():
    with pytest.raises(FrameError, match="frame 20 has no box, and the first one looked at has a box"):
        list(checked(frames(pbc=lambda k: k != 2)))


def test_a_box_without_a_vector_is_named_with_its_frame():
    some = [
        Frame(10 * k, 0.0, np.ones((1, 3)), Box(np.diag([9.0, 9.0, 9 - k]), np.ones(3, bool))) for k in (0, 9)
    ]
    with pytest.raises(
        FrameError, match=r"run.traj: frame 90: the box repeats along c, but .* 0.0\]"
    ) as caught:
        list(checked(some, where="run.traj"))
    assert caught.value.frame == 90
    # a direction that does not repeat needs none
    slab = Box(np.diag([9.0, 9.0, 0.0]), np.array([True, True, False]))
    assert len(list(checked([Frame(0, 0.0, np.ones((1, 3)), slab)]))) == 1


def test_the_first_frame_cannot_be_left_out():
    with pytest.raises(FrameError, match="frame 0: atom 4") as caught:
        list(checked(frames(put(0, slice(4, 5), np.nan))))
    assert "@:0" not in str(caught.value) and "from the first frame on" in str(caught.value)


@pytest.mark.parametrize("kind", ["traj", "extxyz", "lammpstrj"])
def test_frames_without_atoms_are_refused(tmp_path, kind):
    path = tmp_path / f"run.{kind}"
    if kind == "lammpstrj":
        path.write_text(3 * LAMMPS.partition("1 1 1.5")[0].replace("ATOMS\n2\n", "ATOMS\n0\n").format(k=0))
    else:
        ase.io.write(path, [Atoms(cell=[5, 5, 5], pbc=True)] * 3)
    with pytest.raises(InputError, match=rf"run.{kind}: .*no atoms"):
        open_trajectory(path)


def test_what_is_no_trajectory_is_told_as_what_it_is(tmp_path):
    (tmp_path / "run.extxyz").write_text("")
    with pytest.raises(InputError, match=r"run.extxyz: the file is empty"):
        open_trajectory(tmp_path / "run.extxyz")
    for world, said in (("flips", "holds results, and no trajectory"), ("md", "--save-every 1")):
        (tmp_path / "summary.json").write_text(json.dumps({"world": world}))
        with pytest.raises(InputError, match=said):
            open_trajectory(tmp_path)


def test_nobody_and_nothing(tmp_path):
    ase.io.write(tmp_path / "run.traj", images())
    with pytest.raises(InputError, match=r"names no atom of 9; there are names Ar"):
        select(open_trajectory(tmp_path / "run.traj"), "name OW")
    with pytest.raises(InputError, match="no frame is left"):
        select(open_trajectory(f"{tmp_path / 'run.traj'}@9:"), "name Ar")
    assert list(open_trajectory(f"{tmp_path / 'run.traj'}@9:").frames()) == []
    with pytest.raises(InputError, match="named twice"):
        open_trajectory(f"{tmp_path / 'run.traj'}@9:", slice=":2")


def relabeled(tmp_path, kind):
    """A file of six frames in whose fourth the last two atoms have changed their places in the list."""
    path = tmp_path / f"relabeled.{kind}"
    rng = np.random.default_rng(4)
    frames = []
    for number in range(6):
        names = ["O", "H", "H", "C"] if number < 3 else ["O", "H", "C", "H"]
        frames.append(Atoms(names, rng.uniform(0, 8, (4, 3)), cell=np.eye(3) * 9, pbc=True))
    if kind in ("extxyz", "traj"):
        ase.io.write(path, frames)
        return path
    text = ""
    for number, atoms in enumerate(frames):
        rows = list(zip(atoms.get_chemical_symbols(), atoms.positions, strict=True))
        if kind == "xyz":
            text += "4\nplain\n" + "".join(f"{n} {x:.5f} {y:.5f} {z:.5f}\n" for n, (x, y, z) in rows)
        elif kind == "pdb":
            text += f"MODEL {number + 1:8d}\nCRYST1{3 * '    9.000'}{3 * '  90.00'} P 1           1\n"
            for at, (name, (x, y, z)) in enumerate(rows, 1):
                text += f"ATOM  {at:5d}  {name:<3s} WAT A   1    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00\n"
            text += "ENDMDL\n"
        elif kind == "gro":
            text += "title\n    4\n"
            for at, (name, (x, y, z)) in enumerate(rows, 1):
                text += f"    1WAT  {name:>5s}{at:5d}{x / 10:8.3f}{y / 10:8.3f}{z / 10:8.3f}\n"
            text += "   0.90000   0.90000   0.90000\n"
        else:
            text += (
                f"ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n4\nITEM: BOX BOUNDS pp pp pp\n"
                + "0 9\n" * 3
            )
            text += "ITEM: ATOMS id element x y z\n"
            text += "".join(
                f"{at} {n} {x:.5f} {y:.5f} {z:.5f}\n" for at, (n, (x, y, z)) in enumerate(rows, 1)
            )
    path.write_text(text)
    return path


@pytest.mark.parametrize("kind", ["extxyz", "traj", "xyz", "pdb", "gro", "lammpstrj"])
def test_atoms_that_change_their_order_or_element_in_mid_file_end_it(tmp_path, kind):
    path = relabeled(tmp_path, kind)
    trajectory = open_trajectory(path)
    read = []
    with pytest.raises(FrameError, match=r"frame 3: atom 2 is .*C, and .*H in the first one") as told:
        for frame in checked(trajectory.frames(), where=str(path)):
            read.append(frame.index)
    assert read == [0, 1, 2] and told.value.frame == 3
    # those atoms are not looked at
    assert len(list(checked(trajectory.frames(), np.array([0, 1])))) == 6
    # what came before is kept, and said
    summary = mdnum.flips(path, cutoffs=[3.0], out=tmp_path / "out", report=False).summary
    assert summary["frames"] == 3 and summary["status"] == "stopped"
    assert "atom 2" in summary["stopped"]
    if kind in ("xyz", "pdb"):
        with pytest.raises(FrameError, match="frame 3: atom 2"):
            NeighborFlips(MDAnalysis.Universe(str(path)), r_cut=3.0).run()


def test_where_a_box_is_another_than_that_of_mdanalysis_it_is_said_with_the_pairs_that_tell():
    opened = open_trajectory(datafiles.DCD_TRICLINIC, datafiles.PSF_TRICLINIC)
    # the reader was left where it was: "around 5 protein" means the first frame
    assert opened.universe.trajectory.frame == 0
    notes = opened.notes
    (said,) = [note for note in notes if "box" in note]
    universe = MDAnalysis.Universe(datafiles.PSF_TRICLINIC, datafiles.DCD_TRICLINIC)
    universe.trajectory[-1]
    x, counts = universe.atoms.positions.astype(float), []
    from MDAnalysis.lib.formats.libdcd import DCDFile
    from MDAnalysis.lib.mdamath import triclinic_vectors

    with DCDFile(datafiles.DCD_TRICLINIC) as file:
        xx, xy, yy, xz, yz, zz = list(file)[-1].unitcell
    shifts = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    for matrix in (
        triclinic_vectors(universe.dimensions, dtype=np.float64),
        np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]),
    ):
        # wrapped first, so that the nearest images are among those tried
        wrapped = (np.linalg.solve(matrix.T, x.T).T % 1.0) @ matrix
        close = 0
        for n in range(len(x)):
            apart = np.linalg.norm(wrapped[n] - wrapped[n + 1 :, None] + shifts @ matrix, axis=2)
            close += int((apart < 1.4).sum())
        counts.append(f"{close:,}")
    assert counts[0] != counts[1]
    assert f"puts {counts[0]} pairs" in said and f"the file's {counts[1]}." in said
    # where both are one, there is nothing to say
    assert not any("box" in note for note in open_trajectory(datafiles.XTC, datafiles.GRO).notes)
