"""What differs between the neighbors at two frames, pair by pair and image by image."""

from __future__ import annotations

import numba
import numpy as np
from jaxtyping import Int

from mdnum.trajectories.lattice import Lattice, image_square, near_squares
from mdnum.trajectories.pairs import Rows


@numba.njit(cache=True, nogil=True)
def _compared(first0, count0, other0, first1, count1, other1, i_out, j_out, rank_out, entered_out):
    """Write (i, j, rank, entered) of what differs; rows that do not fit are counted only.

    seen[j] = (images before, images now) while the row of i is looked at.
    """
    atoms = first0.shape[0]
    seen = np.zeros((atoms, 2), np.int32)
    total, room = 0, i_out.shape[0]
    for i in range(atoms):
        for k in range(first0[i], first0[i] + count0[i]):
            seen[other0[k], 0] += 1
        for k in range(first1[i], first1[i] + count1[i]):
            seen[other1[k], 1] += 1
        for side in range(2):
            last = first0[i] + count0[i] if side == 0 else first1[i] + count1[i]
            for k in range(first0[i] if side == 0 else first1[i], last):
                j = other0[k] if side == 0 else other1[k]
                before, now = seen[j, 0], seen[j, 1]
                seen[j, 0], seen[j, 1] = 0, 0
                for rank in range(min(before, now), max(before, now)):
                    if total < room:
                        i_out[total], j_out[total] = i, j
                        rank_out[total], entered_out[total] = rank, now > before
                    total += 1
    return total


def compared(before: Rows, now: Rows, room: int):
    """(i, j, rank, entered) of every decision that differs, in no order; indices are those of the rows.

    Args:
        room: decisions to make room for.
    """
    while True:
        i, j, rank = (np.empty(room, np.int64) for _ in range(3))
        entered = np.empty(room, np.bool_)
        total = _compared(
            before.first, before.count, before.other, now.first, now.count, now.other, i, j, rank, entered
        )
        if total <= room:
            return i[:total], j[:total], rank[:total], entered[:total]
        room = total


@numba.njit(cache=True, nogil=True)
def _image_distances(x, vectors, inverse, periodic, widths, i, j, rank, out):
    narrowest = min(widths[0], widths[1], widths[2])
    near, block = 0.2499 * narrowest * narrowest, 1024
    y = np.empty((3, block))
    for begin in range(0, i.shape[0], block):
        end = begin + block
        near_squares(x, i[begin:end], j[begin:end], vectors, inverse, y, out[begin:end])
    for k in range(i.shape[0]):
        # any other image is a lattice vector away, and none is shorter than the narrowest width
        if not (out[k] < near and rank[k] == 0 and i[k] != j[k]):
            a, b = min(i[k], j[k]), max(i[k], j[k])
            out[k] = image_square(x, a, b, rank[k], vectors, inverse, periodic, widths)
        out[k] = np.sqrt(out[k])


def image_distances(
    positions,
    lattice: Lattice,
    i: Int[np.ndarray, "pairs"],
    j: Int[np.ndarray, "pairs"],
    rank: Int[np.ndarray, "pairs"],
):
    """Distances to the images that have `rank` nearer ones, length; inf where there are not so many."""
    out = np.empty(len(i))
    _image_distances(
        positions, lattice.vectors, lattice.inverse, lattice.periodic, lattice.widths, i, j, rank, out
    )
    return out
