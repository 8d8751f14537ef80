"""Jumps across the box, missing frames and seams: planted ones are found, files of others are not blamed."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from ase import Atoms
from ase.io import write
from MDAnalysisTests import datafiles

import mdnum

warnings.filterwarnings("ignore", module="MDAnalysis")

CODES = {
    "JUMPS_NOT_WHOLE",
    "RESTART_SEAM",
    "MISSING_FRAMES",
    "UNEVEN_FRAMES",
    "TIME_GOES_BACK",
    "REPEATED_FRAMES",
}
FRAMES, MOLECULES, STEP = 120, 120, 0.35


@pytest.fixture(scope="module")
def paths():
    """(paths without jumps, cells): dumbbells that diffuse through a tilted box that breathes by 3 %."""
    rng = np.random.default_rng(7)
    shape = np.array([[11.0, 0, 0], [-2.0, 12.0, 0], [1.5, 2.5, 13.0]])
    cells = shape * (1 + 0.03 * np.sin(np.arange(FRAMES) / 5))[:, None, None]
    middle = rng.uniform(0, 1, (MOLECULES, 3)) @ shape
    walk = np.cumsum(rng.normal(0, STEP, (FRAMES, MOLECULES, 3)), axis=0)
    way = rng.normal(size=(FRAMES, MOLECULES, 3)).cumsum(axis=0)
    bond = 0.8 * way / np.linalg.norm(way, axis=2, keepdims=True)
    x = np.stack([middle + walk, middle + walk + bond], axis=2).reshape(FRAMES, -1, 3)
    return x, cells


def wrapped(x, cells, by=None):
    """In the first cell, by the vectors of each frame or of others."""
    by = cells if by is None else by
    return x - np.floor(x @ np.linalg.inv(cells)) @ by


def codes(x, cells, tmp_path, times=None):
    """(codes of these findings, the summary) of frames in a file."""
    keep = {"cutoffs": 1.0, "report": False, "out": tmp_path / "out"}
    if times is None:
        found = mdnum.flips(x, cell=cells, timestep=1.0, time="ps", **keep)
    else:
        frames = [
            Atoms("CO" * MOLECULES, one, cell=cell, pbc=True) for one, cell in zip(x, cells, strict=True)
        ]
        for atoms, time in zip(frames, times, strict=True):
            atoms.info["time"] = time
        write(tmp_path / "run.extxyz", frames)
        found = mdnum.flips(tmp_path / "run.extxyz", **keep)
    return {one.code for one in found.findings} & CODES, found.summary


def test_whole_jumps_are_undone_and_not_blamed(paths, tmp_path):
    x, cells = paths
    by_name = {"whole": x, "wrapped": wrapped(x, cells)}
    for name, positions in by_name.items():
        (folder := tmp_path / name).mkdir()
        none, summary = codes(positions, cells, folder)
        across, diffusion = summary["unwrapping"], summary["unwrapping"]["diffusion"]
        assert not none and not across["too_far"] and across["split"] > 100
        # <|r|²> = 6 D t; molecules are few, and bonds turn
        assert diffusion["undone"] == pytest.approx(STEP**2 / 2, rel=0.25)
        assert 0 < diffusion["error"] < 0.2 * diffusion["undone"]
        if name == "whole":
            assert across["jumps"] == 0 and diffusion["raw"] == pytest.approx(diffusion["undone"], rel=1e-9)
        else:
            assert across["jumps"] > 1000 and abs(diffusion["raw"]) < 0.7 * diffusion["undone"]
    by_frame = {name: mdnum.read(tmp_path / name / "out").table("motion").to_pandas() for name in by_name}
    # all atoms of a file so small: two for each pair of neighbors in the list, those at its ends once
    twice = np.r_[0 : x.shape[1] - 1, 1 : x.shape[1]]
    for name, table in by_frame.items():
        moved = x[:, twice] - x[0, twice]
        exact = ((moved - moved.mean(axis=1, keepdims=True)) ** 2).sum(axis=2).mean(axis=1)
        # in a box that breathes, an atom in another cell moves with that cell
        np.testing.assert_allclose(table.undone, exact, rtol=1e-4 if name == "whole" else 0.1)


def by_first_box(x, cells):
    return wrapped(x, cells, np.broadcast_to(cells[0], cells.shape))


def by_the_box_when_it_crossed(x, cells):
    """What adding up the jumps of a wrapped file gives, each by the vectors of the frame it came at."""
    inside = wrapped(x, cells)
    jumps = -np.rint(np.diff(inside @ np.linalg.inv(cells), axis=0)) @ cells[1:]
    return inside + np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(jumps, axis=0)])


@pytest.mark.parametrize(
    "spoil", [by_first_box, pytest.param(by_the_box_when_it_crossed, marks=pytest.mark.nightly)]
)
def test_jumps_by_another_box_are_found(paths, spoil, tmp_path):
    x, cells = paths
    found, summary = codes(spoil(x, cells), cells, tmp_path)
    assert found == {"JUMPS_NOT_WHOLE"}
    assert summary["unwrapping"]["off"] > 5 * summary["unwrapping"]["usual"]


def test_missing_and_repeated_times_and_seams_are_found(paths, tmp_path):
    x, cells = paths
    kept = np.r_[0:30, 33:80, 81:FRAMES]
    overlap = np.r_[0:70, 60:FRAMES]
    far = np.r_[0:50, 90:FRAMES]
    other = x.copy()
    other[70:] += wrapped(x, cells[0])[70] - x[70]
    cases = {
        "missing": ((x[kept], cells[kept], tmp_path, kept), {"MISSING_FRAMES"}),
        "uneven": ((x[:20], cells[:20], tmp_path, np.arange(20) ** 1.5), {"UNEVEN_FRAMES"}),
        "overlap": ((x[overlap], cells[overlap], tmp_path, overlap), {"REPEATED_FRAMES", "TIME_GOES_BACK"}),
        # frames left out without a trace in their times
        "joined": ((x[far], cells[far], tmp_path), {"RESTART_SEAM"}),
        # a restart that wrapped the atoms of a file that was whole
        "wrapped again": ((other, np.broadcast_to(cells[0], cells.shape), tmp_path), {"RESTART_SEAM"}),
    }
    for name, (given, expected) in cases.items():
        (folder := tmp_path / name).mkdir()
        found, summary = codes(*given[:2], folder, *given[3:])
        assert found == expected, name
        if name == "missing":
            places = [(one["after"], one["lost"], one["time"]) for one in summary["missing"]["places"]]
            assert places == [(29, 3, 29.0), (76, 1, 79.0)] and summary["missing"]["frames"] == 4
        if expected == {"RESTART_SEAM"}:
            assert [one["number"] for one in summary["unwrapping"]["seams"]] == [
                50 if name == "joined" else 70
            ]


CLEAN = {
    "XTC": ("GRO", "name OW and resid 215:1000"), "TRR": ("GRO", "protein"), "NCDF": ("PRMncdf", "all"),
    "TRZ": ("TRZ_psf", "all"), "LAMMPSdcd2": ("LAMMPSdata2", "all"), "GSD": ("GSD", "all"),
    "DLP_HISTORY": ("DLP_CONFIG", "all"), "TNG_traj": ("TNG_traj_gro", "all"),
    "H5MD_xvf": ("TPR_xvf", "protein"), "PDB_multiframe": ("PDB_multiframe", "all"),
    "DCD": ("PSF", "protein"), "waterDCD": ("waterPSF", "all"), "DCD_TRICLINIC": ("PSF_TRICLINIC", "all"),
    "DCD_NAMD_TRICLINIC": ("PSF_NAMD_TRICLINIC", "all"),
}  # fmt: skip


@pytest.mark.nightly
@pytest.mark.parametrize("name", CLEAN)
def test_files_of_others_are_not_blamed(name, tmp_path):
    topology, words = CLEAN[name]
    file = getattr(datafiles, name)
    found = mdnum.flips(
        file,
        topology=getattr(datafiles, topology),
        cutoffs=4.0,
        between=(words, words),
        report=False,
        out=tmp_path / "o",
    )
    assert not {one.code for one in found.findings} & {"JUMPS_NOT_WHOLE", "RESTART_SEAM", "MISSING_FRAMES"}
