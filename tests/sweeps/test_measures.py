"""Measures of a run, against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ase import Atoms
from ase.io.trajectory import Trajectory

import mdnum
from mdnum.errors import InputError
from mdnum.sweeps.measures import Sample, chosen, structure_factors


def sample(folder: Path, frames: list[Atoms]) -> Sample:
    """A run that left these frames."""
    with Trajectory(str(folder / "trajectory.traj"), "w") as file:
        for k, one in enumerate(frames):
            one.info |= {"images": np.zeros((len(one), 3)), "time": float(k)}
            file.write(one)
    return Sample({}, {}, len(frames[0]), 1.0, folder)


def test_the_structure_factor_of_an_ideal_gas_is_one(tmp_path):
    rng = np.random.default_rng(5)
    cell = np.array([[6.0, 0, 0], [-1.5, 7, 0], [1, 0.5, 8]])
    frames = [Atoms("Ar150", scaled_positions=rng.random((150, 3)), cell=cell, pbc=True) for _ in range(60)]
    s, k = structure_factors(sample(tmp_path, frames))
    shortest = 2 * np.pi * np.linalg.norm(np.linalg.inv(cell), axis=0).min()
    assert len(k) > 8 and (np.abs(k / shortest - np.arange(1, len(k) + 1)) <= 0.5).all()
    assert s[:, 4:].mean() == pytest.approx(1, abs=0.01) and np.abs(s.mean(axis=0) - 1).max() < 0.3


def test_the_structure_factor_of_a_lattice_is_its_size_at_its_reciprocal_vectors(tmp_path):
    """Simple cubic, moved as a whole: S(2π/a) = N for the vectors along the axes, else 0."""
    side, edge = 4, 1.3
    at = np.stack(np.meshgrid(*[np.arange(side)] * 3), -1).reshape(-1, 3) * edge + 0.37
    s, k = structure_factors(sample(tmp_path, [Atoms("Ar64", at, cell=[side * edge] * 3, pbc=True)]))
    whole = np.stack(np.meshgrid(*[np.arange(-8, 9)] * 3), -1).reshape(-1, 3)
    size = np.linalg.norm(whole, axis=1)
    near = (size > 0) & (size * 2 * np.pi / side <= 10)
    whole, size = whole[near], size[near]
    expected = [64 * (whole[np.rint(size) == n] % side == 0).all(axis=1).mean() for n in range(1, len(k) + 1)]
    assert expected[side - 1] > 1 and s[0] == pytest.approx(expected, abs=1e-9)
    assert k[side - 1] == pytest.approx(2 * np.pi / edge, rel=0.05)


def test_a_function_of_a_file_is_told_by_its_digest(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("def last(outcome):\n    return outcome.summary['steps'], 0.5\n")
    with pytest.raises(InputError, match="allow-code"):
        chosen([f"{file}:last"], "md")
    with mdnum.allow_code():
        (one,) = chosen([f"{file}:last"], "md")
        before = one.digest
        file.write_text(file.read_text() + "\n")
        assert len(before) == 16 and one.digest != before
        with pytest.raises(InputError):
            chosen([f"{file}:first"], "md")
        (tmp_path / "helper.py").write_text("")
        for text in ("import helper", "from helper import x", "from . import x", "import helper.y"):
            file.write_text(f"def last(outcome):\n    {text}\n")
            with pytest.raises(InputError, match="not be noticed"):
                chosen([f"{file}:last"], "md")
