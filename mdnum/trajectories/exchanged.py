"""Pairs that are inside at one of two frames alone, each frame having been searched afresh.

Every pair of one frame is measured at the other. So nothing is sorted or looked up; but a pair may have no
more than one image within reach at either.
"""

from __future__ import annotations

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.trajectories.lattice import Lattice, near_squares
from mdnum.trajectories.pairs import Found


def exchanged(
    before: Found,
    now: Found,
    old: tuple[Float[np.ndarray, "atoms 3"], Lattice],
    new: tuple[Float[np.ndarray, "atoms 3"], Lattice],
    species: Int[np.ndarray, "atoms"],
    radii: Float[np.ndarray, "species species"],
) -> tuple[Int[np.ndarray, "flips"], Int[np.ndarray, "flips"], Bool[np.ndarray, "flips"]]:
    """(i, j, entered) of every pair that flipped, in no order.

    Args:
        before, now: pairs inside.
        old, new: positions and lattice at the frame before and now.
        species, radii: as of `pairs.search`.
    """
    square = np.where(radii >= 0, radii * radii, -1.0)
    parts = []
    for found, (positions, lattice) in ((before, new), (now, old)):
        chosen = np.empty(len(found.i) + 1, np.int32)
        count = _outside(
            positions, lattice.vectors, lattice.inverse, species, square, found.i, found.j, chosen
        )  # fmt: skip
        chosen = chosen[:count]
        ids = (found.i[chosen].astype(np.int64), found.j[chosen].astype(np.int64))
        parts.append((*ids, np.full(count, found is now)))
    i, j, entered = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return i, j, entered


@numba.njit(cache=True, nogil=True)
def _outside(x, vectors, inverse, species, square, i, j, chosen):
    """Number the pairs whose rounded image is not inside; the one that is inside is always a rounded one."""
    several = square.shape[0] > 1
    count, block = 0, 1024
    y, flags, squares = np.empty((3, block)), np.empty(block, np.uint8), np.empty(block)
    limits = np.full(block, square[0, 0])
    for begin in range(0, i.shape[0], block):
        i_here, j_here = i[begin : begin + block], j[begin : begin + block]
        near_squares(x, i_here, j_here, vectors, inverse, y, squares)
        if several:
            for k in range(i_here.shape[0]):
                limits[k] = square[species[i_here[k]], species[j_here[k]]]
        for k in range(i_here.shape[0]):
            flags[k] = not squares[k] < limits[k]
        for k in range(i_here.shape[0]):
            chosen[count] = begin + k
            count += flags[k]
    return count
