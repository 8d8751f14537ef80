"""Boxes of PDB files of many models, wherever their CRYST1 records stand."""

from __future__ import annotations

import gzip
import warnings

import MDAnalysis
import MDAnalysis.transformations
import numpy as np
import pytest

from mdnum.trajectories import NeighborFlips
from mdnum.trajectories.source import open_trajectory

warnings.filterwarnings("ignore", module="MDAnalysis")


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
