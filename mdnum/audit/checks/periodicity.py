"""Check slabs and wires: atoms must interact with images along periodic axes only."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from ase import Atoms

from mdnum.audit.checks.invariance import InvarianceCheck, Same, ulp
from mdnum.audit.noise import displaced
from mdnum.audit.structures import FARTHEST, modified, nearest_distance
from mdnum.units import LENGTH

_SHORT = 1.3  # of the nearest distance: length of a free vector with which atoms would feel their own images


class PeriodicityCheck(InvarianceCheck):
    """Do atoms interact with their images along periodic axes, and only along periodic axes?

    The nonperiodic cell vectors are long, short, zero or skewed.
    """

    name, title, order, calls = "periodicity", "Mixed periodicity", 45, 250

    def ways(self, atoms: Atoms, given: Atoms, rng: np.random.Generator) -> Iterator[Same]:
        """Yield representations of a slab and of a wire made from the structure."""
        axes = np.flatnonzero(atoms.pbc)
        if not len(axes) and len(atoms):  # a molecule that repeats along x
            apart = float(np.ptp(atoms.positions[:, 0])) + 1.2 * (nearest_distance(atoms) or 4.0)
            atoms, axes = modified(atoms, cell=np.diag([apart, 0.0, 0.0])), np.array([0])
        wanted = {tuple(axes[:2]): None, tuple(axes[-1:]): None}
        for repeating in wanted:
            yield from mixed(atoms, np.isin(range(3), repeating), rng)


def mixed(atoms: Atoms, periodic: np.ndarray, rng: np.random.Generator) -> Iterator[Same]:
    """Yield a structure that is periodic along the given axes, with various other cell vectors."""
    rows, axes = atoms.cell.array[periodic], np.flatnonzero(periodic)
    normals = np.linalg.svd(rows)[2][len(rows) :]
    extents = np.ptp(atoms.positions @ normals.T, axis=0)
    # beyond all reach, so that images along a free axis are not felt by a calculator that makes them
    base = _with(atoms, periodic, normals * (extents + 2 * FARTHEST)[:, None])
    name = f"{'abc'[axes[0]]} alone" if len(axes) == 1 else " and ".join("abc"[axis] for axis in axes)

    def same(
        what: str, there: Atoms, rounding: float = 0.0, order: np.ndarray | None = None, copies: int = 1
    ):
        order = np.arange(len(there)) if order is None else order
        what = f"periodic along {name}, {what}"
        return Same(what, "MIXED_PERIODICITY", there, order, copies, rounding=rounding, before=base)

    short = _SHORT * (nearest_distance(atoms) or 3.0)
    yield same(f"free axes of {short:.3g} {LENGTH}", _with(base, periodic, normals * short))
    yield same("free axes of length 0", _with(base, periodic, 0.0 * normals))
    leaning = base.cell.array[~periodic] + 1.7 * rows[0]
    yield same("free axes that lean", _with(base, periodic, leaning))
    if np.abs(given := atoms.cell.array[~periodic]).any():
        yield same("free axes as long as in the structure", _with(base, periodic, given))
    boxes = rng.integers(-3, 4, (len(atoms), 3)) * periodic
    there = displaced(base, boxes @ base.cell.array)
    yield same("each atom moved by lattice vectors of its own", there, ulp(there, base))
    there = displaced(base, -(base.positions.mean(axis=0) @ normals.T) @ normals)
    yield same("centered on the faces of the free axes", there, ulp(there, base))
    counts = np.where(np.arange(3) == axes[-1], 2, 1)
    order = np.tile(np.arange(len(base)), 2)
    there = base.repeat(counts)
    yield same(f"repeated twice along {'abc'[axes[-1]]}", there, ulp(there, base), order, 2)


def _with(atoms: Atoms, periodic: np.ndarray, free: np.ndarray) -> Atoms:
    """Return the structure with other cell vectors along nonperiodic axes."""
    cell = atoms.cell.array.copy()
    cell[~periodic] = free
    if np.linalg.det(cell) < 0:
        cell[np.flatnonzero(~periodic)[-1]] *= -1
    return modified(atoms, cell=cell, pbc=periodic)
