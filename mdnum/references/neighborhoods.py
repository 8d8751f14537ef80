"""A few atoms of a large system with all their neighbors: small enough to be evaluated by anybody."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from ase import Atoms
from ase.geometry import complete_cell
from jaxtyping import Int
from numpy import ndarray
from scipy.spatial import KDTree

#: Places at random, and atoms nearest to each whose energies and forces are compared.
PLACES, ATOMS = 8, 32


def neighborhoods(
    atoms: Atoms, reach: float, *, places: int = PLACES, count: int = ATOMS, seed: int = 0
) -> Iterator[tuple[Atoms, Int[ndarray, "chosen"]]]:
    """Groups of atoms at random places, each with every atom within reach of one of them, as a free cluster.

    What a pair potential of that reach gives the chosen atoms in the cluster is what it gives them in the
    whole system, so a difference there is one of the whole. Found by a tree over the atoms and their images,
    which shares nothing with mdnum's cell lists.

    Args:
        atoms: the whole, of any cell; coordinates may lie outside of it.
        reach: no interaction is longer, length.
        places, count: how many groups, and atoms in each at most, all within reach of its place.
        seed: of the random places, each an atom.

    Yields:
        (a cluster without periodicity, whose first atoms are the chosen ones; their numbers in the whole).
    """
    x, origin = _with_images(atoms, reach)
    tree = KDTree(x)
    # coordinates as they are after a lattice vector is added carry rounding: a little more does no harm
    reach = reach * (1 + 1e-9)
    rng = np.random.default_rng(seed)
    numbers = atoms.numbers
    for center in rng.choice(len(atoms), size=min(places, len(atoms)), replace=False):
        # the first rows of x are the atoms themselves
        near = np.array(tree.query_ball_point(x[center], reach))
        chosen = near[np.argsort(((x[near] - x[center]) ** 2).sum(axis=1), kind="stable")[:count]]
        around = np.concatenate([np.array(rows) for rows in tree.query_ball_point(x[chosen], reach)])
        rows = np.concatenate([chosen, np.setdiff1d(around, chosen)])
        yield Atoms(numbers=numbers[origin[rows]], positions=x[rows]), origin[chosen]


def _with_images(atoms: Atoms, reach: float) -> tuple[ndarray, ndarray]:
    """Positions in the box, then their images out to twice the reach beyond its faces; whose each is."""
    cell = complete_cell(np.where(atoms.pbc[:, None], atoms.cell, 0.0))
    inverse = np.linalg.inv(cell)
    x = atoms.positions
    fractional = x @ inverse
    x = x - np.where(atoms.pbc, np.floor(fractional), 0.0) @ cell
    fractional = x @ inverse
    margin = 2.001 * reach * np.linalg.norm(inverse, axis=0)
    origin = np.arange(len(x))
    for axis in np.flatnonzero(atoms.pbc):
        low, high = fractional[:, axis] < margin[axis], fractional[:, axis] >= 1 - margin[axis]
        shift = np.eye(3)[axis]
        fractional = np.concatenate([fractional, fractional[low] + shift, fractional[high] - shift])
        x = np.concatenate([x, x[low] + cell[axis], x[high] - cell[axis]])
        origin = np.concatenate([origin, origin[low], origin[high]])
    return x, origin
