"""The bound of a margin, for every combination of roles: against rationals, and not far too large."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from mdnum.md.cell import Cell, HostCell, wrap_positions
from mdnum.md.decide import CONVENTIONS, PairDecider

ROLES = [(state, dtype) for state in ("float64", "float32") for dtype in ("float64", "float32")]
#: Lattice vectors as rows, and which of them are periodic.
BOXES = {
    "brick": (np.diag([6.1, 7.3, 5.3]), (True, True, True)),
    "tilted": (np.array([[6.1, 0, 0], [1.3, 6.3, 0], [-0.9, 0.8, 5.7]]), (True, True, True)),
    "leaning": (np.array([[6.1, 0.7, -0.4], [1.3, 6.3, 0.2], [-0.9, 0.8, 5.7]]), (True, True, True)),
    "slab": (np.array([[6.1, 0.4, 0.3], [0.2, 6.3, -0.7], [0, 0, 0]]), (True, True, False)),
    "cluster": (np.zeros((3, 3)), (False, False, False)),
}
RADIUS = 2.3


def pairs(box: str, state: str, dtype: str, count: int, seed: int, widest: float = 4.0):
    """A decider's cell, and pairs some roundings away from the cutoff, across the faces or not."""
    matrix, pbc = BOXES[box]
    cell = Cell.create(matrix, pbc)
    rng = np.random.default_rng(seed)
    start = rng.random((count, 3)) @ np.where(np.array(pbc)[:, None], matrix, 7.0 * np.eye(3))
    direction = rng.standard_normal((count, 3))
    r = RADIUS * (1 + rng.uniform(-widest, widest, (count, 1)) * float(np.finfo(dtype).eps))
    end = start + r * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    start, end = (wrap_positions(cell, x)[0].astype(state) for x in (start, end))
    return cell, start, end


def decider_of(cell: Cell, compare: str, state: str, dtype: str, positions) -> PairDecider:
    return PairDecider((RADIUS,), compare, dtype, cell.reach(np.asarray(positions, np.float64)), state)


def nearest_square(start, end, cell: Cell) -> Fraction:
    """The squared distance of the nearest of 27 images, in rationals, in the box as doubles."""
    rows = [[Fraction(float(c)) for c in row] for row in np.asarray(cell.matrix)]
    d = [Fraction(float(b)) - Fraction(float(a)) for a, b in zip(start, end, strict=True)]
    choices = [(-1, 0, 1) if periodic else (0,) for periodic in cell.pbc]
    images = (
        [d[c] - sum((n[k] * rows[k][c] for k in range(3)), start=Fraction(0)) for c in range(3)]
        for n in itertools.product(*choices)
    )
    return min(sum((c * c for c in image), start=Fraction(0)) for image in images)


def root(x: Fraction) -> Fraction:
    """The square root to some sixty digits."""
    return Fraction(math.isqrt((x.numerator << 400) // x.denominator), 1 << 200)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    box=st.sampled_from(sorted(BOXES)),
    compare=st.sampled_from(CONVENTIONS),
    roles=st.sampled_from(ROLES),
    widest=st.sampled_from([0.0, 4.0, 1000.0]),
)
def test_no_margin_is_further_from_the_exact_one_than_its_bound(seed, box, compare, roles, widest):
    state, dtype = roles
    cell, start, end = pairs(box, state, dtype, 8, seed, widest)
    decider = decider_of(cell, compare, state, dtype, np.concatenate([start, end]))
    quantity = decider.host_quantity(*HostCell(cell, dtype).displacement(start, end))
    exact_value = Fraction(RADIUS) if decider.space == "r" else Fraction(RADIUS * RADIUS)
    for k in range(len(start)):
        margin = Fraction(decider.thresholds[0].value) - Fraction(float(quantity[k]))
        square = nearest_square(start[k], end[k], cell)
        exact = exact_value - (root(square) if decider.space == "r" else square)
        assert abs(margin - exact) <= decider.bounds[0], (box, roles, compare, float(abs(margin - exact)))


@pytest.mark.parametrize("compare", ["r2 <", "r <"])
@pytest.mark.parametrize("roles", ROLES)
def test_the_bound_is_within_a_factor_of_what_happens(roles, compare):
    """The largest error of 40,000 pairs reaches a ninth of it, in every box."""
    state, dtype = roles
    for box in BOXES:
        cell, start, end = pairs(box, state, dtype, 40_000, 7)
        decider = decider_of(cell, compare, state, dtype, np.concatenate([start, end]))
        quantity = decider.host_quantity(*HostCell(cell, dtype).displacement(start, end))
        # eleven more bits than a double are enough to see its roundings
        wide = np.longdouble
        if np.finfo(wide).nmant < 63 and dtype == "float64":
            pytest.skip("no floats here that are wider than doubles")
        x = end.astype(wide) - start.astype(wide)
        images = np.rint(x.astype(np.float64) @ np.asarray(cell.inverse)).astype(wide)
        x = x - images @ np.asarray(cell.matrix).astype(wide)
        square = (x * x).sum(axis=1)
        exact = np.sqrt(square) if decider.space == "r" else square
        offset = wide(decider.thresholds[0].value) - wide(decider.exact_thresholds[0])
        error = float(np.abs(offset - (quantity.astype(wide) - exact)).max())
        assert decider.bounds[0] / 9 < error <= decider.bounds[0], (box, error, decider.bounds[0])
