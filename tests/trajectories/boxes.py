"""Boxes and atoms that a search has to get right: skewed, thin, left-handed, partly periodic, far outside."""

from __future__ import annotations

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from mdnum.trajectories.frame import Box

length = st.floats(1.2, 9.0)


@st.composite
def boxes(draw):
    """A box of any shape; its vectors need not be reduced, and rows of free directions may be zero."""
    matrix = np.diag([draw(length) for _ in range(3)])
    if draw(st.booleans()):
        tilts = [draw(st.floats(-1.0, 1.0)) for _ in range(6)]
        matrix[np.triu_indices(3, 1)] = np.array(tilts[:3]) * 3.0
        matrix[np.tril_indices(3, -1)] = np.array(tilts[3:]) * 3.0
    if draw(st.booleans()):
        # the same lattice, told with vectors that are skewed beyond need
        for _ in range(2):
            a, b = draw(st.permutations([0, 1, 2]))[:2]
            matrix[a] += draw(st.integers(-3, 3)) * matrix[b]
    if draw(st.booleans()):
        matrix[draw(st.integers(0, 2))] *= -1.0
    pbc = np.array(draw(st.lists(st.booleans(), min_size=3, max_size=3)))
    if draw(st.booleans()):
        pbc[:] = True
    if draw(st.booleans()):
        matrix = np.where(pbc[:, None], matrix, 0.0)
    rows = matrix[pbc]
    if len(rows):
        shape = rows / np.linalg.norm(rows, axis=1)[:, None]
        assume(np.linalg.det(shape @ shape.T) > 1e-3)
        # brute force tries every image
        assume((1.0 / np.linalg.norm(np.linalg.pinv(rows), axis=0)).min() > 0.6)
    return Box(matrix, pbc)


@st.composite
def atoms(draw, box: Box, most: int = 10):
    """Positions within a few boxes of one another; some on top of others, some on the faces of the box."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(0, most))
    positions = rng.uniform(-1.0, 1.0, (count, 3)) * draw(st.sampled_from([2.0, 6.0, 20.0]))
    rows = np.where(box.pbc[:, None], box.matrix, 0.0)
    if count > 2 and draw(st.booleans()):
        positions[0] = draw(st.sampled_from([0.0, -1e-300, 1e-17, -1e-17]))
        positions[1] = positions[0] + rows[draw(st.integers(0, 2))]
    return positions + rng.integers(-2, 3, (count, 3)) @ rows
