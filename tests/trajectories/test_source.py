"""Frames as the files have them: against MDAnalysis, ASE and the text itself."""

from __future__ import annotations

import tracemalloc
import warnings
from pathlib import Path

import ase.io
import MDAnalysis
import numpy as np
import pytest
from ase import Atoms, units
from MDAnalysisTests import datafiles
from trajectories.files import arrays_held, universe_of, water

from mdnum.errors import InputError
from mdnum.trajectories.readers import open_trajectory, parse_slice, split_path
from mdnum.trajectories.selection import select
from mdnum.trajectories.trajectory import chosen

warnings.filterwarnings("ignore", module="MDAnalysis")

REAL = {
    "xtc, triclinic": (datafiles.XTC, datafiles.GRO),
    "trr": (datafiles.TRR, datafiles.GRO),
    "dcd, no box": (datafiles.DCD, datafiles.PSF),
    "netcdf": (datafiles.NCDF, datafiles.PRMncdf),
    "pdb": (datafiles.PDB_multiframe if hasattr(datafiles, "PDB_multiframe") else datafiles.PDB_small, None),
    "gsd": (datafiles.GSD, None),
    "h5md": (datafiles.H5MD_xvf, datafiles.TPR_xvf),
    "trz": (datafiles.TRZ, datafiles.TRZ_psf),
    "lammps dcd": (datafiles.LAMMPSdcd2, datafiles.LAMMPSdata2),
    "xyz": (datafiles.XYZ_mini, None),
}


def argon(frames=6, atoms=5, seed=0):
    random = np.random.default_rng(seed)
    images = []
    for k in range(frames):
        one = Atoms(
            "Ar" * atoms, random.normal(size=(atoms, 3)), cell=[[7, 0, 0], [1, 8, 0], [2, -1, 9]], pbc=True
        )
        one.set_velocities(random.normal(size=(atoms, 3)))
        one.info["time"] = 0.5 * k
        images.append(one)
    return images


@pytest.mark.parametrize("kind", REAL)
def test_a_real_file_is_what_mdanalysis_makes_of_it(kind):
    path, topology = REAL[kind]
    trajectory = open_trajectory(path, topology, slice="::2")
    universe = universe_of(*(one for one in (topology, path) if one is not None))
    frames = list(trajectory.frames())
    assert len(frames) == trajectory.count == len(universe.trajectory[::2])
    assert trajectory.atoms == len(universe.atoms) == len(trajectory.species)
    for frame in (frames[0], frames[-1]):
        ts = universe.trajectory[frame.index]
        assert frame.positions.dtype == np.float64
        np.testing.assert_array_equal(frame.positions, ts.positions.astype(np.float64))
        if trajectory.time != "frame":
            assert frame.time == ts.time
        if ts.dimensions is None:
            assert not frame.box.pbc.any()
        else:
            # float32 there
            np.testing.assert_allclose(frame.box.matrix, ts.triclinic_dimensions, rtol=1e-6, atol=1e-5)
            assert frame.box.pbc.all()
        assert (frame.velocities is not None) == ts.has_velocities


def test_elements_are_told_or_guessed_and_types_stay_where_there_are_no_names():
    names = list(water().table.names)
    assert water().species[names.index("OW")] == "O"
    assert water().table.guessed and any("guessed" in note for note in water().notes)
    # alpha carbons are no calcium, in a protein
    assert water().species[names.index("CA")] == "C"
    assert set(open_trajectory(datafiles.LAMMPSdcd2, datafiles.LAMMPSdata2).species) >= {"4", "29"}


def test_atoms_nobody_names_can_be_looked_at_all_the_same():
    trajectory = open_trajectory(datafiles.XTC)
    assert trajectory.atoms == 47681 and not trajectory.table.named
    assert any("topology" in note for note in trajectory.notes)
    with pytest.raises(InputError, match="-s TOPOLOGY"):
        select(trajectory, "name OW")
    np.testing.assert_array_equal(select(trajectory, "index 3:5"), [3, 4, 5])


@pytest.mark.parametrize(
    "name", [pytest.param("GRO", marks=pytest.mark.nightly), "GRO_velocity", "two_water_gro"]
)
def test_gro_keeps_the_digits_of_the_text(name):
    path = getattr(datafiles, name)
    frame = next(open_trajectory(path).frames())
    ts = MDAnalysis.Universe(path).trajectory.ts
    np.testing.assert_allclose(frame.positions, ts.positions, atol=2e-5)
    np.testing.assert_allclose(frame.box.matrix, ts.triclinic_dimensions, atol=2e-5)
    np.testing.assert_allclose(frame.positions, np.round(frame.positions, 2), atol=1e-12)
    if ts.has_velocities:
        np.testing.assert_allclose(frame.velocities, ts.velocities, atol=1e-4)


def test_gro_of_many_frames_has_all_of_them():
    path = datafiles.two_water_gro_multiframe
    frames = list(open_trajectory(path).frames())
    assert len(frames) == 2
    with open(path) as lines:
        text = lines.read().splitlines()
    expected = [10 * float(text[11][20 + 8 * k : 28 + 8 * k]) for k in range(3)]
    np.testing.assert_array_equal(frames[1].positions[0], expected)


DUMP = """ITEM: UNITS
metal
ITEM: TIME
{time}
ITEM: TIMESTEP
{step}
ITEM: NUMBER OF ATOMS
3
ITEM: BOX BOUNDS xy xz yz pp pp ff
{bounds}
ITEM: ATOMS id element {columns}
{rows}
"""
RIGHT = "0 9 0\n0 9 0\n0 9 0"


# in each of them another corner of the box is the first along x, and another the last
@pytest.mark.parametrize(
    "tilt", [(1.5, -1.0, 0.25), (-2.0, -0.5, -0.75), (-1.0, 3.0, -0.5), (2.0, 0.5, 0.75)], ids=str
)
@pytest.mark.parametrize("suffix", ["lammpstrj", "lammpsdump"])
def test_a_lammps_dump_has_its_tilt_its_free_sides_and_the_order_of_ids(tmp_path, tilt, suffix):
    matrix, origin = np.diag([8.0, 7.75, 8.0]), np.array([0.5, 2.0, -1.0])
    matrix[1, 0], matrix[2, 0], matrix[2, 1] = tilt
    # bounds are those around the corners of the tilted box
    corners = origin + np.array(list(np.ndindex(2, 2, 2))) @ matrix
    bounds = "\n".join(
        f"{low} {high} {value}"
        for low, high, value in zip(corners.min(axis=0), corners.max(axis=0), tilt, strict=True)
    )
    scaled = np.array([[0.1, 0.2, 0.3], [0.5, -0.25, 1.5], [0.0, 0.0, 0.0]])
    text = ""
    for step, order in ((0, (0, 1, 2)), (5, (2, 0, 1))):
        rows = "\n".join(f"{k + 1} {'OHH'[k]} {' '.join(map(repr, scaled[k].tolist()))} 1 2 3" for k in order)
        text += DUMP.format(time=0.5 * step, step=step, bounds=bounds, columns="xs ys zs vx vy vz", rows=rows)
    # MDAnalysis, which has a reader for the second name, narrows positions and takes the box without its tilt
    (tmp_path / f"run.{suffix}").write_text(text)
    trajectory = open_trajectory(tmp_path / f"run.{suffix}")
    frames = list(trajectory.frames())
    assert (trajectory.length, trajectory.time, trajectory.bits) == ("Å", "ps", 64)
    assert trajectory.species.tolist() == ["O", "H", "H"]
    assert [frame.time for frame in frames] == [0.0, 2.5]
    for frame in frames:
        np.testing.assert_allclose(frame.box.matrix, matrix, atol=1e-14)
        assert frame.box.pbc.tolist() == [True, True, False]
        np.testing.assert_allclose(frame.positions, origin + scaled @ matrix, atol=1e-14)
        np.testing.assert_array_equal(frame.velocities, [[1, 2, 3]] * 3)


def test_a_lammps_dump_agrees_with_ase():
    trajectory = open_trajectory(datafiles.LAMMPSDUMP_image_vf)
    images = ase.io.read(datafiles.LAMMPSDUMP_image_vf, index=":", format="lammps-dump-text")
    frames = list(trajectory.frames())
    assert len(frames) == len(images) and trajectory.time == "step"
    for frame, image in zip(frames, images, strict=True):
        np.testing.assert_array_equal(frame.positions, image.positions)
        np.testing.assert_array_equal(frame.box.matrix, image.cell.array)


def test_lammps_atoms_without_ids_are_refused(tmp_path):
    text = DUMP.format(
        time=0, step=0, bounds=RIGHT, columns="x y z", rows="O 1 2 3\nH 1 2 3\nH 2 2 2"
    ).replace("id ", "")
    (tmp_path / "run.dump").write_text(text)
    with pytest.raises(InputError, match="no atom ids"):
        open_trajectory(tmp_path / "run.dump")


@pytest.mark.parametrize("name", ["run.extxyz", "run.traj", "run.json", "run.extxyz.gz"])
def test_ase_files_keep_every_digit(tmp_path, name):
    images = argon()
    ase.io.write(tmp_path / name, images)
    trajectory = open_trajectory(tmp_path / name)
    frames, kept = list(trajectory.frames()), ase.io.read(tmp_path / name, index=":")
    assert len(frames) == 6 and trajectory.bits == 64 and trajectory.species.tolist() == ["Ar"] * 5
    for k, (frame, image) in enumerate(zip(frames, kept, strict=True)):
        assert frame.index == k
        np.testing.assert_array_equal(frame.positions, image.positions)
        np.testing.assert_array_equal(frame.box.matrix, image.cell.array)
        if "json" not in name:
            assert frame.time == 0.5 * k
            # Å per ps
            np.testing.assert_allclose(frame.velocities, image.get_velocities() * 1e3 * units.fs, rtol=1e-12)


@pytest.mark.parametrize(
    ("file", "text"), [("system.toml", 'units = "lj"\n'), ("simulation.json", '{"units": "lj"}')]
)
def test_a_run_of_mdnum_has_its_units(tmp_path, file, text):
    ase.io.write(tmp_path / "trajectory.traj", argon())
    (tmp_path / file).write_text(text)
    trajectory = open_trajectory(tmp_path)
    assert (trajectory.length, trajectory.time) == ("σ", "τ")
    np.testing.assert_allclose(next(trajectory.frames()).velocities, argon()[0].get_velocities())
    with pytest.raises(InputError, match="--save-every"):
        (tmp_path / "trajectory.traj").unlink()
        (tmp_path / "summary.json").write_text("{}")
        open_trajectory(tmp_path)


def test_a_topology_names_the_atoms_of_an_ase_file(tmp_path):
    water = MDAnalysis.Universe(datafiles.two_water_gro)
    ase.io.write(tmp_path / "run.extxyz", Atoms("OHHOHH", water.atoms.positions))
    trajectory = open_trajectory(tmp_path / "run.extxyz", datafiles.two_water_gro)
    np.testing.assert_array_equal(select(trajectory, "name OW and resid 2"), [3])
    assert trajectory.table.residues.tolist() == [0, 0, 0, 1, 1, 1]


@pytest.mark.parametrize("name", ["run.extxyz", "run.traj", "run.json", "run.lammpstrj"])
@pytest.mark.parametrize("words", ["", "2:", ":3", "::2", "1:5:3", "-2:", ":-4", "3", "-1", "9:", "0:0"])
def test_slices_are_those_of_python(tmp_path, name, words):
    ase.io.write(tmp_path / "run.extxyz", argon())
    if name.endswith("lammpstrj"):
        rows = "1 O 1 2 3\n2 H 1 2 3\n3 H 2 2 2"
        text = "".join(
            DUMP.format(time=k, step=k, bounds=RIGHT, columns="x y z", rows=rows) for k in range(6)
        )
        (tmp_path / name).write_text(text)
    else:
        ase.io.write(tmp_path / name, argon())
    trajectory = open_trajectory(f"{tmp_path / name}@{words}" if words else tmp_path / name)
    expected = (
        list(range(6))[parse_slice(words)] if words not in ("3", "-1") else [list(range(6))[int(words)]]
    )
    assert [frame.index for frame in trajectory.frames()] == expected
    # as often as wanted
    assert [frame.index for frame in trajectory.frames()] == expected
    assert trajectory.count in (None, len(expected))


def test_slices_in_words(tmp_path):
    assert split_path("a/b.xtc@100:") == (type(tmp_path)("a/b.xtc"), "100:")
    assert split_path("a@home/b.xtc")[1] == ""
    (tmp_path / "run@5").write_text("")
    assert split_path(str(tmp_path / "run@5")) == (tmp_path / "run@5", "")
    assert list(chosen(slice(1, 9, 3), None)) == [1, 4, 7]
    for words in ("::-1", "::0", "a:b", "1:2:3:4"):
        with pytest.raises(InputError):
            parse_slice(words)


def test_memory_does_not_grow_with_frames(tmp_path):
    ase.io.write(tmp_path / "run.extxyz", argon(20, atoms=100))
    trajectory = open_trajectory(tmp_path / "run.extxyz")
    tracemalloc.start()
    held = [arrays_held() for _ in trajectory.frames()]
    tracemalloc.stop()
    # positions and velocities of one frame
    one = 100 * 6 * 8
    assert len(held) == 20 and held[19] < held[2] + 3 * one


def test_selections_are_one_language(tmp_path):
    for trajectory, files in (
        (open_trajectory(datafiles.NCDF, datafiles.PRMncdf), (datafiles.PRMncdf, datafiles.NCDF)),
        (water(), (datafiles.GRO, datafiles.XTC)),
    ):
        universe = universe_of(*files)
        universe.trajectory[0]
        for words in ("protein", "name O and around 4 resid 1"):
            np.testing.assert_array_equal(select(trajectory, words), universe.select_atoms(words).indices)
        assert len(select(trajectory, "element O")) == (trajectory.species == "O").sum()
    images = [Atoms("NaCl", [[0.2, 0, 0], [2.0, 0, 0]], cell=[5, 5, 5], pbc=True)]
    ase.io.write(tmp_path / "salt.traj", images)
    salt = open_trajectory(tmp_path / "salt.traj")
    np.testing.assert_array_equal(select(salt, "element Na or name Cl"), [0, 1])
    np.testing.assert_array_equal(select(salt, "around 2 element Na"), [1])
    for words, said in (("element O", "names Cl, Na"), ("nam O", "not a valid selection")):
        with pytest.raises(InputError, match=said):
            select(salt, words)


def test_the_libraries_still_lose_what_mdnum_reads_itself(tmp_path):
    """The reasons for readers of mdnum's own: when one of these fails, a reader can go."""
    text = Path(datafiles.two_water_gro).read_text().rstrip() + "\n"
    (tmp_path / "two.gro").write_text(text * 2)
    assert len(list(open_trajectory(tmp_path / "two.gro").frames())) == 2
    assert MDAnalysis.Universe(tmp_path / "two.gro").trajectory.n_frames == 1
    try:
        images = ase.io.read(tmp_path / "two.gro", index=":", format="gromacs")
    except Exception:
        images = []
    assert len(images) < 2
    # every digit of a dump
    dump = MDAnalysis.Universe(datafiles.LAMMPSDUMP, format="LAMMPSDUMP").trajectory.ts.positions
    ours = next(iter(open_trajectory(datafiles.LAMMPSDUMP).frames())).positions
    assert dump.dtype == np.float32 and (ours != ours.astype(np.float32)).any()
    # Amber's file of a run that was killed
    whole = Path(datafiles.NCDF).read_bytes()
    (tmp_path / "cut.nc").write_bytes(whole[: int(0.7 * len(whole))])
    with pytest.raises((ValueError, OSError, TypeError)):
        MDAnalysis.Universe(datafiles.PRMncdf, tmp_path / "cut.nc", format="NCDF")
