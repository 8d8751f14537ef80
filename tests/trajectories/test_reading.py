"""The one way to the readers of other packages: one line for every failure, and no file beside the user's."""

import os
import resource
import shutil
import struct
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import MDAnalysis
import numpy as np
import pytest
from ase import Atoms
from ase.io import write
from MDAnalysisTests import datafiles
from scipy.io import netcdf_file

import mdnum
from mdnum.audit.structures import read_structure
from mdnum.cli import main
from mdnum.errors import InputError
from mdnum.reading import UnreadableFrame, ase_images, first_line, reading
from mdnum.trajectories import NeighborFlips
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.readers import open_trajectory
from mdnum.trajectories.rules import CutoffRule
from mdnum.trajectories.selection import select
from mdnum.trajectories.tracker import Tracker

SIDE = 12.0


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def frames_of(path, *more) -> tuple[list, InputError | None]:
    """The frames that can be read, and what ended them."""
    frames = []
    try:
        for frame in open_trajectory(path, *more).frames():
            frames.append(frame)
    except InputError as error:
        assert "\n" not in str(error)
        return frames, error
    return frames, None


def trr(path: Path, positions, boxes, width=4, velocities=None) -> Path:
    """A trr file as GROMACS writes it; a box of None is none."""
    data, real = b"", f">f{width}"
    for number, (x, box) in enumerate(zip(positions, boxes, strict=True)):
        sizes = [0] * 10
        blocks = [np.array([number * 0.5, 0.0])]
        for place, block in ((2, box), (7, x), (8, None if velocities is None else velocities[number])):
            if block is not None:
                sizes[place] = width * np.size(block)
                blocks.append(np.asarray(block))
        data += struct.pack(">3i12s13i", 1993, 13, 12, b"GMX_trn_file", *sizes, len(positions[0]), 0, 0)
        data += b"".join(block.astype(real).tobytes() for block in blocks)
    path.write_bytes(data)
    return path


# ---- the seam


@pytest.mark.parametrize(
    "error",
    [
        OverflowError("too large"), AttributeError("no units"), struct.error("4 bytes"), MemoryError(),
        ZeroDivisionError("by zero"), UnboundLocalError("no x"), NotImplementedError(), StopIteration(),
        AssertionError(), EOFError("ended early"), RecursionError("too deep"), KeyError("units"),
    ],
)  # fmt: skip
def test_whatever_a_reader_raises_is_one_line_with_file_and_frame(error):
    with (
        pytest.raises(UnreadableFrame, match=r"^run\.xyz: frame 4 cannot be read \(.+\)\. .*@:4 ") as told,
        reading("run.xyz", 4),
    ):
        raise error
    assert told.value.frame == 4 and "\n" not in str(told.value)
    with (
        pytest.raises(InputError, match=r"^run\.xyz: ASE cannot open the file \(.+\)"),
        reading("run.xyz", by="ASE"),
    ):
        raise error


def test_what_mdnum_says_itself_and_a_wish_to_stop_pass():
    own = InputError("said already")
    with pytest.raises(InputError) as told, reading("run.xyz", 4):
        raise own
    assert told.value is own
    with pytest.raises(KeyboardInterrupt), reading("run.xyz", 4):
        raise KeyboardInterrupt
    with pytest.raises(InputError, match=r"run\.tng: .*not installed \(.*pytng"), reading("run.tng"):
        raise ImportError("please install pytng")


def test_the_message_of_a_parser_is_not_lost_behind_what_is_put_around_it():
    error = ValueError(
        "Failed to construct topology from file x with parser P.\nError: give atom_style='id x y z'"
    )
    assert first_line(error) == "give atom_style='id x y z'"


# ---- files of which libraries' readers fail


def amber(path: Path, rng, units=True, magic=b"CDF\x02") -> Path:
    with netcdf_file(path, "w", version=2) as file:
        file.Conventions, file.ConventionVersion = b"AMBER", b"1.0"
        for name, size in (("frame", None), ("spatial", 3), ("atom", 8)):
            file.createDimension(name, size)
        for name, of, unit in (
            ("time", ("frame",), b"picosecond"),
            ("coordinates", ("frame", "atom", "spatial"), b"angstrom"),
        ):
            variable: Any = file.createVariable(name, "f4", of)
            if units:
                variable.units = unit
            for number in range(4):
                variable[number] = number if name == "time" else rng.uniform(0, SIDE, (8, 3))
    path.write_bytes(magic + path.read_bytes()[4:])
    return path


def dcd(path: Path, rng, order="<", marker="i") -> Path:
    def record(data: bytes) -> bytes:
        length = struct.pack(order + marker, len(data))
        return length + data + length

    head = struct.pack(order + "9if10i", 4, 1, 1, 4, 0, 0, 0, 0, 0, 0.02, 0, 0, 0, 0, 0, 0, 0, 0, 0, 24)
    data = (
        record(b"CORD" + head)
        + record(struct.pack(order + "i", 1) + b" " * 80)
        + record(struct.pack(order + "i", 8))
    )
    for _ in range(4):
        data += b"".join(record(row.astype(order + "f4").tobytes()) for row in rng.uniform(0, SIDE, (3, 8)))
    path.write_bytes(data)
    return path


def test_netcdf_without_units_or_of_another_kind_is_one_line(tmp_path, rng):
    assert len(frames_of(amber(tmp_path / "good.nc", rng))[0]) == 4
    bad = {
        "lacks the attribute units": amber(tmp_path / "a.nc", rng, units=False),
        "CDF-5 is not supported": amber(tmp_path / "b.nc", rng, magic=b"CDF\x05"),
    }
    for said, path in bad.items():
        frames, error = frames_of(path)
        assert not frames and error is not None and str(path) in str(error) and said in str(error)
        assert ("nccopy" in str(error)) == ("CDF-5" in said) and "-s TOPOLOGY" not in str(error)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.extxyz", "1\nProperties=species:S:1:pos:R:3\nUue 0 0 0\n", "Uue is the symbol"),
        ("a.extxyz", "-5\nProperties=species:S:1:pos:R:3\nAr 0 0 0\n", "is -5"),
        ("a.xyz", "-5\nwords\nAr 0 0 0\n", "announces -5 atoms"),
        ("a.gro", "words\n-5\n\n", "-5 "),
        ("a.mdcrd", "words\n  1.0  2.0  3.0\n", "-s TOPOLOGY"),
    ],
)
def test_what_a_text_cannot_mean_is_said(tmp_path, name, text, said):
    path = tmp_path / name
    path.write_text(text)
    frames, error = frames_of(path)
    assert not frames and said in str(error) and ("TOPOLOGY" in str(error)) == ("TOPOLOGY" in said)


@pytest.mark.parametrize(("order", "marker"), [("<", "i"), (">", "i"), ("<", "q"), (">", "q")])
def test_dcd_of_either_byte_order_is_read_and_one_with_long_record_markers_is_one_line(
    tmp_path, rng, order, marker
):
    path = dcd(tmp_path / "a.dcd", rng, order, marker)
    frames, error = frames_of(path)
    if marker == "i":
        assert error is None and len(frames) == 4
        assert frames[3].positions.min() >= 0 and frames[3].positions.max() <= SIDE
        # a step of 0.02 of 48.9 fs, after the first
        np.testing.assert_allclose(
            [one.time for one in frames], 0.02 * 0.0488882 * np.arange(1, 5), rtol=1e-5
        )
    else:
        assert error is not None and "64 bits" in str(error)
        assert "-s TOPOLOGY" not in str(error)


@pytest.mark.parametrize("changing", [False, True])
def test_xdatcar_is_read_up_to_the_frame_with_fused_numbers(tmp_path, rng, changing):
    def text(bad: int | None) -> str:
        lines = []
        for number, x in enumerate(places):
            if changing or number == 0:
                lines += ["argon", "1.0", f"{SIDE + number} 0 0", "0 12 0", "0 0 12", "Ar He", "5 3"]
            lines += [
                f"Direct configuration= {number + 1:5d}",
                *("".join(f"{one:12.8f}" for one in row) for row in x),
            ]
            if number == bad:
                lines[-3] = "  0.12345678-10.12345678-10.12345678"
        return "\n".join(lines) + "\n"

    places, path = rng.uniform(0, 1, (6, 8, 3)), tmp_path / "XDATCAR"
    path.write_text(text(None))
    frames, error = frames_of(path)
    assert error is None and len(frames) == 6
    want = list(ase_images(path))
    for frame, x, atoms in zip(frames, places, want, strict=True):
        np.testing.assert_allclose(frame.positions, x * [SIDE + changing * frame.index, 12, 12], atol=1e-6)
        np.testing.assert_array_equal(frame.positions, atoms.positions)
        np.testing.assert_array_equal(frame.box.matrix, atoms.cell.array)
    assert open_trajectory(path).species.tolist() == ["Ar"] * 5 + ["He"] * 3
    path.write_text(text(4))
    for of in ("", "@::2"):
        frames, error = frames_of(f"{path}{of}")
        assert len(frames) == (4 if not of else 2) and isinstance(error, UnreadableFrame) and error.frame == 4
    summary = mdnum.flips(path, cutoffs=[4.0], out=tmp_path / "out", report=False).summary
    assert summary["frames"] == 4 and "frame 4" in summary["stopped"]
    # cut in a frame, and in a head
    lines = text(None).splitlines(keepends=True)
    path.write_text("".join(lines[:-2]))
    assert len(frames_of(path)[0]) == 5
    path.write_text("".join(lines) + "\n\n")
    assert frames_of(path)[1] is None


@pytest.mark.parametrize("kind", ["traj", "extxyz", "json"])
@pytest.mark.parametrize("number", [119, 4000, -1, -7])
def test_an_atomic_number_of_no_element_is_one_line(tmp_path, rng, kind, number):
    path = tmp_path / f"a.{kind}"
    if kind == "extxyz":
        row = "{} 0 0 0\n18 1 1 3\n"
        head = "2\nProperties=Z:I:1:pos:R:3\n"
        path.write_text((head + row.format(18)) * 2 + head + row.format(number))
    else:
        images = [Atoms("Ar5", rng.uniform(0, SIDE, (5, 3))) for _ in range(3)]
        images[2].numbers[3] = number
        write(path, images)
    frames, error = frames_of(path)
    assert error is not None and f"atomic number {number}; expected 0 to 118" in str(error)
    # a database is sorted out as a whole
    assert len(frames) == (2 if kind != "json" else len(frames))


HEADS = {
    "a.xyz": "{}\n\nAr 0 0 0\n", "a.extxyz": "{}\nProperties=species:S:1:pos:R:3\nAr 0 0 0\n",
    "a.gro": "words\n{}\n    1SOL     OW    1   0.126   1.624   1.679\n",
    "a.lammpstrj": "ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n{}\nITEM: BOX BOUNDS pp pp pp\n0 1\n0 1\n0 1\n"
    "ITEM: ATOMS id type x y z\n1 1 0 0 0\n",
    "POSCAR": "x\n1.0\n5 0 0\n0 5 0\n0 0 5\nAr\n{}\nDirect\n0 0 0\n",
    "a.inpcrd": "words\n{} 0.0\n  1.0 2.0 3.0\n", "a.txyz": "{} words\n1 C 0 0 0 1\n",
    "a.psf": "PSF\n\n       1 !NTITLE\n REMARKS\n\n{} !NATOM\n",
    "a.data": "words\n\n{} atoms\n1 atom types\n\n0 9 xlo xhi\n0 9 ylo yhi\n0 9 zlo zhi\n\n"
    "Atoms\n\n1 1 0 0 0\n",
    "a.cube": "a\nb\n{} 0 0 0\n2 1 0 0\n2 0 1 0\n2 0 0 1\n1 1 0 0 0\n",
    "a.xsf": "CRYSTAL\nPRIMVEC\n5 0 0\n0 5 0\n0 0 5\nPRIMCOORD\n{} 1\n18 0 0 0\n",
}  # fmt: skip


@pytest.mark.parametrize("atoms", [10**9, 10**12])
@pytest.mark.parametrize("name", HEADS)
def test_a_file_that_announces_more_atoms_than_it_can_hold_is_one_line_at_once(tmp_path, name, atoms):
    path = tmp_path / name
    path.write_text(HEADS[name].format(1))
    path.write_text(HEADS[name].format(atoms))
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for open_it in (
        lambda: open_trajectory(path),
        lambda: open_trajectory(datafiles.XTC, path),
        lambda: read_structure(path),
    ):
        with pytest.raises(InputError) as told:
            open_it()
        assert "\n" not in str(told.value) and name in str(told.value)
    # kilobytes; a number for each atom would be 4 GB
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 10**6
    assert time.perf_counter() - began < 20


@pytest.mark.parametrize("kind", ["xtc", "trr", "dcd"])
def test_a_binary_head_that_announces_more_atoms_than_the_file_can_hold(tmp_path, rng, kind):
    places = rng.uniform(0, 1, (3, 20, 3))
    path = tmp_path / f"a.{kind}"
    universe: Any = MDAnalysis.Universe.empty(20, trajectory=True)
    universe.load_new(places, order="fac")
    universe.atoms.write(path, frames="all")
    data = bytearray(path.read_bytes())
    count = (20).to_bytes(4, "little" if kind == "dcd" else "big")
    # xtc has it twice in the head of a frame, and again before the coordinates
    for _ in range({"xtc": 3, "trr": 1, "dcd": 1}[kind]):
        at = data.index(count, {"dcd": 268}.get(kind, 4 if kind == "xtc" else 60))
        data[at : at + 4] = (2**31 - 1).to_bytes(4, "little" if kind == "dcd" else "big")
    path.write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError):
        open_trajectory(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 10**6


# ---- trr, and files beside the user's


@pytest.mark.parametrize("width", [4, 8])
def test_trr_is_read_as_it_is_written(tmp_path, rng, width):
    places, speeds = rng.uniform(0, 1, (2, 5, 9, 3))
    boxes = [np.array([[1.2, 0, 0], [0.3, 1.1, 0], [-0.2, 0.4, 1 + 0.1 * number]]) for number in range(5)]
    path = trr(tmp_path / "a.trr", places, boxes, width, speeds)
    opened = open_trajectory(path)
    assert (opened.atoms, opened.count, opened.bits, opened.time) == (9, 5, 8 * width, "ps")
    frames = list(opened.frames())
    (tmp_path / "copy").mkdir()
    universe: Any = MDAnalysis.Universe(shutil.copy(path, tmp_path / "copy"))
    for frame, x, v, box, ts in zip(frames, places, speeds, boxes, universe.trajectory, strict=True):
        assert frame.velocities is not None and frame.time == ts.time
        if width == 4:
            np.testing.assert_array_equal(frame.positions, ts.positions)
            np.testing.assert_array_equal(frame.velocities, ts.velocities)
        else:
            # MDAnalysis has narrowed them
            np.testing.assert_array_equal(frame.positions, 10 * x)
            np.testing.assert_array_equal(frame.velocities, 10 * v)
        np.testing.assert_allclose(frame.box.matrix, 10 * box, atol=1e-5 if width == 4 else 1e-14)
    assert [frame.index for frame in open_trajectory(f"{path}@1::2").frames()] == [1, 3]


def test_a_trr_whose_later_frame_has_no_box_or_no_positions_ends_there(tmp_path, rng):
    places, box = rng.uniform(0, 1, (5, 12, 3)), np.eye(3) * 1.2
    path = trr(tmp_path / "a.trr", places, [box, box, box, None, box])
    summary = mdnum.flips(path, cutoffs=[4.0], out=tmp_path / "a", report=False).summary
    assert summary["frames"] == 3 and "frame 3" in summary["stopped"]
    analysis = NeighborFlips(MDAnalysis.Universe(str(path)), 4.0)
    with pytest.raises(InputError, match="frame 3 has no box"):
        analysis.run()
    assert len(analysis.frames) == 3
    # never one: a cluster
    path = trr(tmp_path / "b.trr", places, [None] * 5)
    assert not any(frame.box.periodic for frame in open_trajectory(path).frames())
    assert len(NeighborFlips(MDAnalysis.Universe(str(path)), 4.0).run().frames) == 5
    # velocities alone, as where they are written more often
    path = trr(tmp_path / "c.trr", [*places[:2], None, *places[3:]], [box] * 5, 8, places)
    frames, error = frames_of(path)
    assert len(frames) == 2 and "no positions" in str(error)


def test_no_box_is_so_small_that_counting_its_images_overflows():
    for size in (1e-5, 1e-30):
        frame = Frame(0, 0.0, np.zeros((2, 3)), Box(np.eye(3) * size, np.ones(3, bool)))
        with pytest.raises(InputError, match=r"^cutoff: .* pairs within 4[:.] .*box"):
            Tracker(CutoffRule(4.0)).step(frame)


@pytest.fixture(params=["trr", "xtc"])
def gromacs(request, tmp_path, rng) -> Path:
    """A trajectory of 12 frames in a folder of its own."""
    path = tmp_path / "data" / f"run.{request.param}"
    path.parent.mkdir()
    universe: Any = MDAnalysis.Universe.empty(30, trajectory=True)
    universe.load_new(
        rng.uniform(0, SIDE, (12, 30, 3)), order="fac", dimensions=np.array([SIDE] * 3 + [90.0] * 3)
    )
    universe.atoms.write(path, frames="all")
    return path


def index_of(path: Path, kind: str = "npz") -> Path:
    return path.with_name(f".{path.name}_offsets.{kind}")


def count(path: Path, out: Path, *topology) -> int:
    summary = mdnum.flips(
        path, topology=topology[0] if topology else None, cutoffs=[4.0], out=out, report=False
    ).summary
    return summary["rules"][0]["entered"] + summary["rules"][0]["left"]


def test_nothing_is_written_beside_a_trajectory_or_a_topology(gromacs, tmp_path):
    before = set(gromacs.parent.iterdir())
    count(gromacs, tmp_path / "a")
    # a trajectory may stand for the topology, which is where MDAnalysis would read coordinates too
    count(gromacs, tmp_path / "b", gromacs)
    select(open_trajectory(gromacs, gromacs), "index 0:3")
    mdnum.flips(gromacs, gromacs, cutoffs=[4.0], out=tmp_path / "c", report=False)
    assert set(gromacs.parent.iterdir()) == before


@pytest.mark.parametrize("kind", ["npz", "lock"])
def test_a_link_in_the_place_of_an_index_leads_to_nothing_that_is_written(gromacs, tmp_path, kind):
    precious = tmp_path / "precious"
    precious.write_text("words")
    index_of(gromacs, kind).symlink_to(precious)
    count(gromacs, tmp_path / "a", gromacs)
    assert precious.read_text() == "words"


@pytest.mark.parametrize("kind", ["npz", "lock"])
def test_a_pipe_in_the_place_of_an_index_is_not_waited_for(gromacs, tmp_path, kind):
    os.mkfifo(index_of(gromacs, kind))
    done = threading.Thread(target=count, args=(gromacs, tmp_path / "a", gromacs), daemon=True)
    done.start()
    done.join(60)
    assert not done.is_alive()


def test_a_stale_index_changes_no_answer_and_is_named_where_a_universe_trusts_it(gromacs, tmp_path):
    want = count(gromacs, tmp_path / "a")
    # of the same file with frames left out and put in twice, as after a repair
    offsets = MDAnalysis.Universe(str(gromacs)).trajectory._xdr.offsets
    index = index_of(gromacs)
    kept = dict(np.load(index))
    for stale in (offsets[[0, 1, 2, 2, *range(4, 12)]], offsets[:9]):
        np.savez(index, **{**kept, "offsets": stale})
        assert count(gromacs, tmp_path / f"b{len(stale)}") == want
        universe: Any = MDAnalysis.Universe(str(gromacs))
        assert len(universe.trajectory) == len(stale)
        with pytest.raises(UnreadableFrame, match="refresh_offsets=True"):
            NeighborFlips(universe, 4.0).run()
    fresh: Any = MDAnalysis.Universe(str(gromacs), refresh_offsets=True)
    assert len(NeighborFlips(fresh, 4.0).run().results.flips) == want


def test_a_pipe_or_a_device_is_no_file_to_open(tmp_path):
    os.mkfifo(tmp_path / "run.xyz")
    for path in (tmp_path / "run.xyz", Path("/dev/zero")):
        with pytest.raises(InputError, match="not a regular file"):
            open_trajectory(path)
        with pytest.raises(InputError, match="not a regular file"):
            open_trajectory(datafiles.XTC, path)


# ---- topologies


LAMMPS = """\
ITEM: TIMESTEP
0
ITEM: NUMBER OF ATOMS
8
ITEM: BOX BOUNDS pp pp pp
0 12
0 12
0 12
ITEM: ATOMS id type element x y z
"""


@pytest.mark.parametrize("suffix", ["lammpstrj", "extxyz", "traj", "XDATCAR", "gro", "data", "cif", "npz"])
def test_any_structure_that_can_be_read_says_what_the_atoms_of_a_dcd_are(tmp_path, rng, suffix):
    path, places = dcd(tmp_path / "a.dcd", rng), rng.uniform(1, SIDE - 1, (8, 3))
    words = ["O", "H", "H", "C", "O", "H", "H", "N"]
    atoms = Atoms(words, places, cell=[SIDE] * 3, pbc=True)
    topology = tmp_path / (suffix if suffix == "XDATCAR" else f"a.{suffix}")
    if suffix == "lammpstrj":
        # in the order of LAMMPS's neighbor list, where the dcd has that of the ids
        rows = [
            f"{k + 1} 1 {word} {x:.3f} {y:.3f} {z:.3f}\n"
            for k, (word, (x, y, z)) in enumerate(zip(words, places, strict=True))
        ]
        topology.write_text(LAMMPS + "".join(rows[::-1]))
    elif suffix == "XDATCAR":
        atoms = atoms[np.argsort(words)]
        write(topology, atoms, format="vasp-xdatcar")
    elif suffix == "data":
        write(topology, atoms, format="lammps-data", masses=True)
    elif suffix == "npz":
        np.savez(topology, a=1)
    else:
        write(topology, atoms)
    if suffix in ("data", "npz"):
        # what is none is refused, as is one that says nothing of a species
        with pytest.raises(InputError):
            mdnum.flips(path, topology=topology, pairs=["O-H=5"], out=tmp_path / "a", report=False)
        return
    opened = open_trajectory(path, topology)
    assert opened.species.tolist() == atoms.get_chemical_symbols()
    assert len(select(opened, "element H")) == 4
    summary = mdnum.flips(path, topology=topology, pairs=["O-H=5"], out=tmp_path / "a", report=False).summary
    frames, (oxygen, hydrogen) = (
        list(opened.frames()),
        ([np.flatnonzero(opened.species == one) for one in "OH"]),
    )
    inside = [
        {
            (i, j)
            for i in oxygen
            for j in hydrogen
            if np.linalg.norm(frame.positions[i] - frame.positions[j]) < 5
        }
        for frame in frames
    ]
    flips = sum(len(one ^ other) for one, other in pairwise(inside))
    rule = summary["rules"][0]
    assert rule["entered"] + rule["left"] == flips > 0


@pytest.mark.parametrize("kind", ["dcd", "trr", "nc"])
def test_no_topology_is_needed_without_species(tmp_path, rng, kind):
    path = tmp_path / f"a.{kind}"
    if kind == "trr":
        trr(path, rng.uniform(0, 1, (4, 8, 3)), [None] * 4)
    else:
        (dcd if kind == "dcd" else amber)(path, rng)
    assert mdnum.flips(path, cutoffs=[5.0], out=tmp_path / "a", report=False).summary["frames"] == 4


def test_what_mdanalysis_says_of_a_data_file_reaches_the_message(tmp_path, rng):
    topology = tmp_path / "a.data"
    topology.write_text(HEADS["a.data"].format(1).replace("1 1 0 0 0", "1 water 0 0 0"))
    with pytest.raises(InputError, match="atom_style="):
        open_trajectory(dcd(tmp_path / "a.dcd", rng), topology)


@pytest.mark.parametrize("name", ["a.xyz", "a.extxyz", "POSCAR", "a.cube"])
def test_a_system_whose_structure_announces_too_many_atoms_is_refused_at_once(tmp_path, capsys, name):
    (tmp_path / name).write_text(HEADS[name].format(10**12))
    (tmp_path / "system.toml").write_text(SYSTEM.format(name))
    began = time.perf_counter()
    with pytest.raises(SystemExit) as ended:
        sys.exit(main(["systems", "check", str(tmp_path / "system.toml")]))
    said = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2 and len(said) == 1 and name in said[0]
    assert time.perf_counter() - began < 20


SYSTEM = """\
name = "argon"
units = "metal"
[structure]
file = "{}"
[potential]
kind = "lennard-jones"
sigma = 3.405
epsilon = 0.0103235
[cutoff]
kind = "hard"
radius = 8.5
compare = "r2 <"
[neighbors]
skin = 1.0
[dynamics]
kind = "nve"
timestep = 0.002
temperature = 40.0
steps = 4
seed = 7
"""
