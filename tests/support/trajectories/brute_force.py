"""Boxes and atoms that a search has to get right, and neighbors by trying every atom and every image.

Nothing of mdnum is in it but the contract of its answers.
"""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import oracles
import pytest
from hypothesis import assume
from hypothesis import strategies as st

from mdnum.trajectories.frame import Box

length = st.floats(1.2, 9.0)
PERIODIC = np.ones(3, bool)


def cube(edge: float) -> Box:
    return Box(np.eye(3) * edge, PERIODIC)


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


def as_dict(members) -> dict:
    keys = zip(members.i.tolist(), members.j.tolist(), members.rank.tolist(), strict=True)
    made = dict(zip(keys, members.distance.tolist(), strict=True))
    assert list(made) == sorted(made) and len(made) == len(members)
    return made


def same(ours: dict, theirs: dict) -> None:
    assert set(ours) == set(theirs) and ours == pytest.approx(theirs, abs=1e-9)


def rows(flips) -> list:
    columns = (flips.i, flips.j, flips.rank, flips.entered)
    return list(zip(*(column.tolist() for column in columns), strict=True))


def differences(before: dict | None, now: dict) -> list:
    """Flips between two sets of pairs, as `rows` has them; none where nothing is known of the first."""
    entered = [(*key, True) for key in now.keys() - (now if before is None else before).keys()]
    return sorted(entered + [(*key, False) for key in (before or {}).keys() - now.keys()])


def image_list(positions, matrix, pbc, i, j, reach):
    """Ascending squared distances (float64, from the coordinates as given) of images of j seen from i.

    Images of an atom itself: one of each ± pair. Every lattice vector that could matter is tried.
    """
    rows = np.where(np.asarray(pbc)[:, None], np.asarray(matrix, float), 0.0)
    d = positions[j] - positions[i]
    inverse = np.linalg.pinv(rows)
    middle = d @ inverse
    margin = reach * np.linalg.norm(inverse, axis=0)
    spans = [
        np.arange(np.floor(-middle[k] - margin[k]) - 1, np.ceil(-middle[k] + margin[k]) + 2)
        if pbc[k]
        else [0.0]
        for k in range(3)
    ]
    shifts = np.array(list(itertools.product(*spans)))
    if i == j:
        keep = (shifts[:, 0] > 0) | ((shifts[:, 0] == 0) & (shifts[:, 1] > 0))
        keep |= (shifts[:, 0] == 0) & (shifts[:, 1] == 0) & (shifts[:, 2] > 0)
        shifts = shifts[keep]
    moved = d + shifts @ rows
    squares = np.sort((moved * moved).sum(axis=1))
    return squares[squares <= reach * reach]


def everything(positions, matrix, pbc, first, second, reach):
    """{(i, j): squared distances of images} of symmetric pairs between the two sides, i <= j."""
    found = {}
    for i, j in itertools.combinations_with_replacement(range(len(positions)), 2):
        if (i in first and j in second) or (i in second and j in first):
            squares = image_list(positions, matrix, pbc, i, j, reach)
            if len(squares):
                found[i, j] = squares
    return found


def members(pairs, radius_of):
    """{(i, j, rank): distance} of the pairs inside."""
    return {
        (i, j, rank): float(np.sqrt(square))
        for (i, j), squares in pairs.items()
        for rank, square in enumerate(squares)
        if square < (radius_of(i, j) or 0.0) ** 2
    }


def clear(pairs, radius_of, by=1e-9):
    """Whether no pair is so close to its radius that another order of operations could decide otherwise."""
    close = (
        radius_of(i, j) is not None and (abs(np.sqrt(squares) - radius_of(i, j)) < by).any()
        for (i, j), squares in pairs.items()
    )
    return not any(close)


def nearest(positions, matrix, pbc, first, second, most, radius, reach):
    """{(i, j, rank): distance}, per center (distance of the last inside, of the first outside), and whether
    no two distances that compete for a last place are the same but for rounding."""
    inside, limits, clearly = {}, {}, True
    for i in first:
        candidates = []
        for j in second:
            squares = image_list(positions, matrix, pbc, min(i, j), max(i, j), reach)
            if i == j:
                squares = np.repeat(squares, 2)
            candidates += [(float(square), int(j), rank) for rank, square in enumerate(squares)]
        candidates.sort()
        within = [one for one in candidates if one[0] < radius * radius]
        for square, j, rank in within[:most]:
            inside[i, j, rank] = float(np.sqrt(square))
        full = len(within) >= most
        last = float(np.sqrt(within[most - 1][0])) if full else radius
        after = float(np.sqrt(candidates[most][0])) if full and len(candidates) > most else np.inf
        limits[i] = (last, min(radius, after))
        clearly &= not full or after - last > 1e-9
        clearly &= all(abs(np.sqrt(one[0]) - radius) > 1e-9 for one in candidates)
    return inside, limits, clearly


def exactly_inside(positions, matrix, pbc, i, j, rank, radius):
    """Whether the image of that rank is inside, in rational arithmetic."""
    rows = np.where(np.asarray(pbc)[:, None], np.asarray(matrix, float), 0.0)
    d = positions[j] - positions[i]
    middle = -np.rint(d @ np.linalg.inv(rows)).astype(int)
    shifts = itertools.product(*(range(m - 3, m + 4) for m in middle))
    # fractions are slow
    near = (shift for shift in shifts if np.linalg.norm(d + np.array(shift) @ rows) <= 2.0 * radius)
    squares = sorted(oracles.exact_r2(positions, rows, i, j, shift) for shift in near)
    return rank < len(squares) and squares[rank] < Fraction(float(radius)) ** 2
