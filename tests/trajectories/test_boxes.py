"""Boxes as the files have them: turned as their coordinates are, and wherever their records stand."""

from __future__ import annotations

import gzip
import warnings
from pathlib import Path

import ase.io
import MDAnalysis
import MDAnalysis.transformations
import numpy as np
import pytest
from MDAnalysis.lib.formats.libdcd import DCDFile
from MDAnalysis.lib.mdamath import triclinic_vectors
from MDAnalysisTests import datafiles
from trajectories.files import water

from mdnum.errors import InputError
from mdnum.trajectories import NeighborFlips
from mdnum.trajectories.trajectory import open_trajectory

warnings.filterwarnings("ignore", module="MDAnalysis")

DLPOLY = Path(datafiles.PSF).parent / "dlpoly" / "HISTORY"


def symmetric_cells():
    """The boxes of CHARMM's file."""
    with DCDFile(datafiles.DCD_TRICLINIC) as file:
        for xx, xy, yy, xz, yz, zz in (frame.unitcell for frame in file):
            yield np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def test_a_charmm_box_is_turned_as_its_coordinates_are():
    trajectory = open_trajectory(datafiles.DCD_TRICLINIC, datafiles.PSF_TRICLINIC)
    for frame, cell in zip(trajectory.frames(), symmetric_cells(), strict=True):
        np.testing.assert_array_equal(frame.box.matrix, cell)
    # lengths and cosines stand in the same places of another program's file
    other = next(open_trajectory(datafiles.DCD_NAMD_TRICLINIC, datafiles.PSF_NAMD_TRICLINIC).frames())
    assert other.box.matrix[0, 1] == 0 and abs(other.box.matrix[1, 0]) > 1


def test_cosines_near_zero_are_no_symmetric_box(tmp_path):
    with DCDFile(str(tmp_path / "run.dcd"), "w") as file:
        file.write_header(remarks="", natoms=2, istart=0, nsavc=1, delta=1.0, is_periodic=1)
        # lengths, and cosines of the angles between
        file.write(xyz=np.eye(2, 3, dtype=np.float32), box=np.array([30.0, 0.001, 31.0, 0.0, 0.002, 32.0]))
    matrix = next(open_trajectory(tmp_path / "run.dcd").frames()).box.matrix
    np.testing.assert_allclose(np.linalg.norm(matrix, axis=1), [30, 31, 32], rtol=1e-6)
    assert matrix[0, 1] == 0 and matrix[1, 0] == pytest.approx(31 * 0.001, rel=1e-2)


def test_the_tilt_of_a_hoomd_box_is_no_cosine(tmp_path):
    hoomd = pytest.importorskip("gsd.hoomd")
    with hoomd.open(str(tmp_path / "run.gsd"), "w") as file:
        for size in (10.0, 10.0, 11.0):
            frame = hoomd.Frame()
            frame.particles.N, frame.particles.types = 2, ["A"]
            frame.particles.position = np.eye(2, 3, dtype=np.float32)
            frame.configuration.box = [size, 8.0, 9.0, 0.5, -0.25, 0.125]
            file.append(frame)
    trajectory = open_trajectory(tmp_path / "run.gsd")
    assert trajectory.length == "" and trajectory.species.tolist() == ["A", "A"]
    for frame, size in zip(trajectory.frames(), (10.0, 10.0, 11.0), strict=True):
        np.testing.assert_array_equal(frame.box.matrix, [[size, 0, 0], [4, 8, 0], [-2.25, 1.125, 9]])


def test_the_vectors_of_an_h5md_box_point_where_they_do(tmp_path):
    h5py = pytest.importorskip("h5py")
    universe = MDAnalysis.Universe(datafiles.two_water_gro)
    matrix = np.array([[0.0, 20.0, 1.0], [18.0, 0.0, 0.5], [3.0, 2.0, -22.0]])
    with MDAnalysis.Writer(str(tmp_path / "run.h5md"), 6) as writer:
        universe.dimensions = [20, 21, 22, 80, 85, 95]
        writer.write(universe)
        writer.write(universe)
    with h5py.File(tmp_path / "run.h5md", "r+") as file:
        file["particles/trajectory/box/edges/value"][1] = matrix
    trajectory = open_trajectory(tmp_path / "run.h5md", datafiles.two_water_gro)
    # MDAnalysis converts where all units are named, and here that of time is not
    assert trajectory.length == "nm"
    frames = list(trajectory.frames())
    np.testing.assert_allclose(frames[1].box.matrix, matrix, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(frames[0].box.matrix, axis=1), [2.0, 2.1, 2.2], rtol=1e-6)
    with pytest.raises(InputError, match=r"3,341 atoms and the trajectory 6"):
        open_trajectory(tmp_path / "run.h5md", datafiles.PSF)


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


def test_where_a_box_is_another_than_that_of_mdanalysis_it_is_said_with_the_pairs_that_tell():
    opened = open_trajectory(datafiles.DCD_TRICLINIC, datafiles.PSF_TRICLINIC)
    # the reader was left where it was: "around 5 protein" means the first frame
    assert opened.universe.trajectory.frame == 0
    notes = opened.notes
    (said,) = [note for note in notes if "box" in note]
    universe = MDAnalysis.Universe(datafiles.PSF_TRICLINIC, datafiles.DCD_TRICLINIC)
    universe.trajectory[-1]
    x, counts = universe.atoms.positions.astype(float), []
    shifts = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    for matrix in (triclinic_vectors(universe.dimensions, dtype=np.float64), list(symmetric_cells())[-1]):
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
    assert not any("box" in note for note in water().notes)


def box(side):
    return f"CRYST1{side:9.3f}{side:9.3f}{side:9.3f}  90.00  90.00  90.00 P 1           1\n"


def model(number, inside=""):
    atoms = "".join(
        f"HETATM{k + 1:5d}  O   HOH A{k + 1:4d}    {x + 0.1 * number:8.3f}{1.0:8.3f}{1.0:8.3f}  1.00  0.00\n"
        for k, x in enumerate((0.5, 9.0))
    )
    return f"MODEL     {number + 1:4d}\n{inside}{atoms}ENDMDL\n"


FILES = {
    # OpenMM: once, however many models follow
    "head": (box(10.0) + "".join(model(k) for k in range(4)), [10.0] * 4),
    # GROMACS: before each model; killed before the one that the last was for
    "before": ("".join(box(10.0 + k) + model(k) for k in range(4)) + box(99.0), [10.0, 11.0, 12.0, 13.0]),
    "each": ("".join(box(10.0 + k) + model(k) for k in range(4)), [10.0, 11.0, 12.0, 13.0]),
    "within": ("".join(model(k, box(10.0 + k)) for k in range(4)), [10.0, 11.0, 12.0, 13.0]),
    # where it changes
    "seldom": (box(10.0) + model(0) + model(1) + box(12.0) + model(2) + model(3), [10.0, 10.0, 12.0, 12.0]),
    "none": ("".join(model(k) for k in range(4)), [None] * 4),
    "no box": (box(1.0) + "".join(model(k) for k in range(4)), [None] * 4),
}


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("packed", ["", ".gz"])
def test_every_model_has_the_box_that_stands_before_its_atoms(tmp_path, kind, packed):
    text, sides = FILES[kind]
    path = tmp_path / f"run.pdb{packed}"
    path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    trajectory = open_trajectory(path)
    for _ in range(2):
        frames = list(trajectory.frames())
        assert [float(one.box.matrix[0, 0]) if one.box.periodic else None for one in frames] == sides
    (skipped,) = open_trajectory(f"{path}@3").frames()
    assert (float(skipped.box.matrix[0, 0]) if skipped.box.periodic else None) == sides[3]
    once = any("once" in note for note in trajectory.notes)
    assert once == (kind == "head")


@pytest.mark.parametrize("parts", [1, 2])
def test_the_analysis_sees_it_too_and_keeps_what_somebody_set(tmp_path, parts):
    path = tmp_path / "run.pdb"
    path.write_text(FILES["head"][0])
    universe = MDAnalysis.Universe(path)
    # 8.5 apart, and 1.5 through the boundary
    assert NeighborFlips(universe, 2.0).run(n_parts=parts).results.pairs.tolist() == [1, 1, 1, 1]
    dimensions = np.array([30.0, 30.0, 30.0, 90.0, 90.0, 90.0])
    universe.trajectory.add_transformations(MDAnalysis.transformations.set_dimensions(dimensions))
    assert NeighborFlips(universe, 2.0).run(n_parts=parts).results.pairs.tolist() == [0, 0, 0, 0]
