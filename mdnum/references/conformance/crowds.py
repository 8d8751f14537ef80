"""Many neighbors on few atoms, and many atoms with a pair set known in closed form."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy import ndarray

from mdnum.references.conformance.case import Case, one
from mdnum.references.conformance.catalog import gas
from mdnum.references.oracle import PairSet

#: Atoms along an edge of the lattices: some 5,000 atoms, and 100,000.
SMALL_EDGE, LARGE_EDGE = 17, 47


def crowds() -> Iterator[Case]:
    """Clusters with more neighbors than lists like to give an atom, alone and in a thin gas."""
    for count in (20, 33, 41, 66, 130, 260):
        cluster = 5.0 + 0.45 * gas(count, 1.0, 70 + count, -1.0, 1.0)
        yield one(f"{count} atoms in one clump", "crowded", cluster, 12.0, r_cut=1.6)
    for count in (150, 520):
        around = np.vstack([np.zeros((1, 3)), 0.97 * _sphere(count)])
        yield one(f"{count} neighbors on one atom", "crowded", around + 4.0, 9.0)
    thin = gas(300, 24.0, 71)
    clump = 12.0 + 0.3 * gas(60, 1.0, 72, -1.0, 1.0)
    yield one("a clump in a thin gas", "crowded", np.vstack([thin, clump]), 24.0)
    yield one("a clump in a thin gas, first in the file", "crowded", np.vstack([clump, thin]), 24.0)
    yield one("a clump and emptiness, free", "crowded", np.vstack([clump, thin[:5] * 40.0]))
    yield one("a crystal with 86 neighbors", "crowded", _lattice(6)[0] + 0.3, 6.0, r_cut=2.85)
    small = gas(3, 0.9, 73)
    yield one("three atoms with hundreds of images", "crowded", small, 0.9, r_cut=3.5)


def vast() -> Iterator[Case]:
    """Few atoms in so much space that a grid of cells over it has no room in memory, or in 32 bits.

    For lists in a process of their own: those that make such a grid end it.
    """
    apart = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.5], [700.0, 2500.0, 2400.0], [700.5, 2500.0, 2400.0]])
    yield one("two pairs thousands of cutoffs apart, free", "axes", apart)
    yield one("two pairs thousands of cutoffs apart, along a wire", "axes", apart, 3.0, (False, False, True))
    yield one("a box of thousands of cutoffs", "boxes", apart + 1.0, 4000.0)


def lattice(edge: int, seed: int = 0) -> Case:
    """A cubic lattice of whole numbers with gaps, its atoms in any order and in any image of the box.

    Neighbors are the 26 around a place, known by counting modulo the edge: no search and no rounding.

    Args:
        edge: places along an edge.
        seed: of gaps, order and images.
    """
    rng = np.random.default_rng(seed)
    places = _lattice(edge)[1]
    kept = rng.permutation(len(places))[: len(places) - len(places) // 50]
    places = places[kept]
    images = rng.integers(-1, 2, places.shape)
    positions = (places + images * edge).astype(np.float64)
    at = np.full((edge,) * 3, -1)
    at[tuple(places.T)] = np.arange(len(places))
    parts = []
    for x, y, z in np.ndindex(3, 3, 3):
        step = np.array([x, y, z]) - 1
        if tuple(step) <= (0, 0, 0):
            continue
        target = places + step
        j = at[tuple(np.mod(target, edge).T)]
        there = j >= 0
        i, j = np.flatnonzero(there), j[there]
        # x_j + shift L = place of i + step, in the images that the atoms are given in
        shift = np.floor_divide(target[i], edge) + images[i] - images[j]
        parts.append((i, j, shift, np.full(len(i), np.sqrt(float(step @ step)))))
    i, j, shift, distance = (np.concatenate([part[n] for part in parts]) for n in range(4))
    turn = i > j
    i, j, shift = np.where(turn, j, i), np.where(turn, i, j), np.where(turn[:, None], -shift, shift)
    yes = np.ones(len(i), bool)
    known = PairSet(i, j, shift, distance, yes, ~yes)
    name = f"{len(places):,} atoms on a lattice with gaps"
    return one(name, "large", positions, float(edge), r_cut=1.875, known=known)


def _lattice(edge: int) -> tuple[ndarray, ndarray]:
    places = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), -1).reshape(-1, 3)
    return places.astype(np.float64), places


def _sphere(count: int) -> ndarray:
    """Directions spread evenly over a sphere (Fibonacci's)."""
    k = np.arange(count) + 0.5
    height, angle = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1)
