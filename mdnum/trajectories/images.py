"""Flips of each image (i, j, shift) of a pair, for boxes with several images in range.

The ledger of flips identifies an image by its rank in distance. Wrapping does not change the rank. If one
image leaves and another enters, the ledger has no flip. This module counts two flips.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mdnum.md.ledger import Members
from mdnum.trajectories.frame import Frame

#: Ratio of the width of a box to the range below which pairs are tracked by shift; above 2, because a box may
#: shrink.
NARROW = 2.2
# images of pairs that are examined together; and of one pair that are told apart, along each vector
_TOGETHER, _APART = 1_000_000, 256


def pair_keys(i: np.ndarray, j: np.ndarray, shifts: np.ndarray, atoms: int) -> Int[np.ndarray, "pairs"]:
    """Return an integer key for each pair (i, j), or for each image (i, j, shift)."""
    keys = i * np.int64(atoms) + j
    for column in shifts.T:
        keys = keys * _APART + column % _APART
    return keys


def cell_of(frame: Frame) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """Return lattice vectors as rows (unit normals along nonperiodic axes), and their inverse."""
    from ase.geometry import complete_cell

    matrix = complete_cell(np.where(frame.box.pbc[:, None], frame.box.matrix, 0.0))
    return matrix, np.linalg.inv(matrix)


def image_shifts(frame: Frame, pairs: Any) -> Int[np.ndarray, "pairs 3"]:
    """Return the shift of an image of atom j. `rank` other images of j are nearer to atom i.

    The image is at x[j] + shift @ box, as in ASE, vesin and jax-md. Images of an atom itself have a
    positive first nonzero component.

    Args:
        pairs: object with arrays i, j, rank and distance, such as `Members`.
    """
    x, pbc, (matrix, inverse) = frame.positions, frame.box.pbc, cell_of(frame)
    most = pairs.distance.max(initial=0.0) * np.linalg.norm(inverse, axis=0) + 0.5
    spans = [np.arange(-n, n + 1) for n in np.where(pbc, np.ceil(most), 0).astype(int)]
    offsets = np.stack(np.meshgrid(*spans, indexing="ij"), -1).reshape(-1, 3)
    whole, block = np.empty((len(pairs.i), 3), np.int64), max(_TOGETHER // len(offsets), 1)
    for part in (slice(begin, begin + block) for begin in range(0, len(whole), block)):
        i, j, rank = pairs.i[part], pairs.j[part], pairs.rank[part]
        between = (x[j] - x[i]) @ inverse
        base = np.where(pbc, -np.rint(between), 0.0)
        squares = (((between + base)[:, None] + offsets) @ matrix) ** 2 @ np.ones(3)
        squares[np.ix_(i == j, np.arange(len(offsets)) <= len(offsets) // 2)] = np.inf
        order = np.argsort(squares, axis=1, kind="stable")
        whole[part] = base.astype(np.int64) + offsets[order[np.arange(len(i)), rank]]
    return whole


class ImageFlips:
    """Flips of periodic images between successive frames, for a symmetric membership rule."""

    def __init__(self) -> None:
        self._before: tuple[Frame, np.ndarray] | None = None

    def step(self, frame: Frame, pairs: Members) -> dict[str, Any] | None:
        """Return columns of the flips since the previous frame. None at the first frame."""
        matrix, inverse = cell_of(frame)
        now = np.column_stack([pairs.i, pairs.j, image_shifts(frame, pairs)])
        known, self._before = self._before, (frame, now)
        if known is None:
            return None
        earlier, before = known[0], known[1].copy()
        # where an atom was put into another cell, shifts count from there
        moved = np.rint((frame.positions - earlier.positions) @ inverse).astype(int) * frame.box.pbc
        before[:, 2:] += moved[before[:, 0]] - moved[before[:, 1]]
        left, entered = (pair_keys(one[:, 0], one[:, 1], one[:, 2:], len(moved)) for one in (before, now))
        gone, new = before[~np.isin(left, entered)], now[~np.isin(entered, left)]
        i, j, *shifts = rows = np.concatenate([gone, new]).T
        distance = np.linalg.norm(frame.positions[j] + rows[2:].T @ matrix - frame.positions[i], axis=1)
        named = dict(zip(("i", "j", "shift_a", "shift_b", "shift_c"), (i, j, *shifts), strict=True))
        return {**named, "entered": np.arange(len(i)) >= len(gone), "distance": distance} if len(i) else None
