"""Kinetic tensor and excess pressure of barostats against numpy's, without a run."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.md.barostats import MTK, CellRescaling
from mdnum.md.cell import Cell
from mdnum.md.integrators import AtStep

H = np.array([[5.0, 0.1, 0.3], [0.0, 6.0, -0.2], [0.4, 0.0, 7.0]])
NUMBERS: dict[str, Any] = {"timestep": 0.01, "kT": 0.8, "pressure": 0.7, "relaxation": 0.2}
NUMBERS |= {"pressure_relaxation": 2.0}
OWN: dict[type, dict[str, Any]] = {
    MTK: {}, CellRescaling: {"compressibility": jnp.float64(0.1), "key": jax.random.key(0)}
}  # fmt: skip


@pytest.mark.parametrize("kind", OWN)
@pytest.mark.parametrize("box", ["isotropic", "full"])
@pytest.mark.parametrize(("atoms", "dtype"), [(13, np.float64), (16, np.float32)])
def test_the_excess_is_what_numpy_makes_of_its_formula(kind, box: str, atoms: int, dtype):
    """The numbers of atoms are a multiple of eight, in which sums are taken, and not one."""
    random = np.random.default_rng(atoms)
    masses, v = random.uniform(1, 3, atoms), random.normal(size=(3, atoms)).astype(dtype)
    tensor = random.normal(size=(3, 3))
    tensor += tensor.T
    numbers = {name: jnp.asarray(one) for name, one in NUMBERS.items()}
    integrator = kind(**numbers, **OWN[kind], box=box)
    cell = jax.tree.map(jnp.asarray, Cell.create(H, (True,) * 3))
    wide = v.astype(np.float64)
    v, m = jnp.asarray(v), jnp.asarray(masses)
    at = AtStep(v, jnp.trace(tensor), jnp.asarray(tensor), cell, m, jnp.int64(0), jnp.arange(atoms))
    whole = (masses * wide) @ wide.T + tensor - 0.7 * np.linalg.det(H) * np.eye(3)
    found = integrator.excess(integrator.motion(v, m), at)
    expected = whole if box == "full" else np.trace(whole) / 3
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-12)
    kinetic = 0.5 * np.sum(masses * np.sum(wide**2, axis=0))
    np.testing.assert_allclose(integrator.kinetic(v, m), kinetic, rtol=1e-13)
