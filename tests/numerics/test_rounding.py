"""Floats as integers against nextafter; bounds of margins, for all roles, against rationals."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from typing import Any

import ml_dtypes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mdnum.forks.certified import exact_margin
from mdnum.md.cell import Cell, HostCell, complete, wrap_positions
from mdnum.md.decide import CONVENTIONS, PairDecider
from mdnum.numerics.rounding import gamma, neighbor, ordinal, unit_roundoff

WIDTHS: dict[type, Any] = {np.float64: 64, np.float32: 32, np.float16: 16, ml_dtypes.bfloat16: 32}


def numbers(dtype):
    drawn = st.floats(width=WIDTHS[dtype], allow_nan=False, allow_infinity=False).map(dtype)
    # the largest float32 rounds to infinity in bfloat16
    return drawn.filter(np.isfinite)


@pytest.mark.parametrize("dtype", WIDTHS)
@given(data=st.data(), ulps=st.integers(-20, 20))
@np.errstate(over="ignore")  # above the largest float comes infinity
def test_ordinals_count_steps_of_nextafter_and_keep_the_order_of_the_floats(dtype, data, ulps):
    a, b = data.draw(numbers(dtype)), data.draw(numbers(dtype))
    difference = int(ordinal(np.asarray(b))) - int(ordinal(np.asarray(a)))
    assert np.sign(difference) == np.sign(float(b) - float(a))
    walked = a
    for _ in range(abs(ulps)):
        walked = np.nextafter(walked, dtype(np.inf if ulps > 0 else -np.inf))
    if np.isfinite(walked):
        found = neighbor(a, ulps, dtype)
        assert found == walked and found.dtype == dtype
        assert int(ordinal(found)) - int(ordinal(a)) == ulps


def test_both_zeros_are_one_place():
    for dtype in WIDTHS:
        assert ordinal(dtype(-0.0)) == ordinal(dtype(0.0)) == 0
        tiny = np.nextafter(dtype(0), dtype(1))
        assert int(ordinal(tiny)) - int(ordinal(-tiny)) == 2
        assert neighbor(-tiny, 1, dtype) == 0


def test_gamma_bounds_a_product_of_roundings():
    for dtype, u in ((np.float64, 2.0**-53), (np.float32, 2.0**-24), (ml_dtypes.bfloat16, 2.0**-8)):
        assert unit_roundoff(dtype) == u
        for n in (1, 3, 7, 100):
            assert n * u <= gamma(n, dtype) and (1 + Fraction(u)) ** n - 1 <= Fraction(gamma(n, dtype))


# --- the bound of a margin --------------------------------------------------------------------------------

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


def random_box(rng: np.random.Generator) -> Cell:
    """A box with any of its axes open, wide enough for the cutoff."""
    matrix = np.diag(rng.uniform(6, 9, 3)) + rng.uniform(-1, 1, (3, 3))
    return Cell.create(matrix * (6 / min(6.0, Cell.create(matrix).widths.min())), rng.random(3) < 0.5)


@settings(max_examples=150)
@given(
    seed=st.integers(0, 2**32 - 1),
    compare=st.sampled_from(CONVENTIONS),
    roles=st.sampled_from(ROLES),
    drift=st.floats(-1, 5),
)
def test_a_bound_holds_wherever_atoms_drift(seed, compare, roles, drift):
    """Bounds asked of a decider that knows where the atoms began, of pairs that have moved on together."""
    state, dtype = roles
    rng = np.random.default_rng(seed)
    cell, count = random_box(rng), 6
    start = rng.random((count, 3)) @ np.asarray(complete(np.asarray(cell.matrix), np.array(cell.pbc)))
    decider = decider_of(cell, compare, state, dtype, start)
    start = start + 10**drift * rng.standard_normal(3)
    direction = rng.standard_normal((count, 3))
    # some roundings of the distance away from the cutoff, or some of the coordinates
    unit = float(np.finfo(dtype).eps) * rng.choice([RADIUS, np.abs(start).max()], (count, 1))
    r = RADIUS + rng.uniform(-2, 2, (count, 1)) * unit
    end = start + r * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    start, end = (wrap_positions(cell, x)[0].astype(state) for x in (start, end))
    quantity = decider.host_quantity(*HostCell(cell, dtype).displacement(start, end))
    value = Fraction(RADIUS * RADIUS)
    for k, (bound,) in enumerate(decider.bounds_at(np.stack([start, end], axis=2))):
        square = nearest_square(start[k], end[k], cell)
        exact = Fraction(RADIUS) - root(square) if decider.space == "r" else value - square
        margin = Fraction(decider.thresholds[0].value) - Fraction(float(quantity[k]))
        told = cell.pbc, roles, compare, float(margin), float(exact), bound
        if square < Fraction(1.001 * RADIUS) ** 2:
            assert abs(margin - exact) <= bound, told
            without, decided = exact_margin(decider, cell, start[k], end[k])
            assert abs(without - exact) < Fraction(1, 1 << 190), told
            # the sign of the exact margin is the exact decision
            assert decided == (exact >= 0 if compare.endswith("<=") else exact > 0), told
        inside, should = (x >= 0 if compare.endswith("<=") else x > 0 for x in (margin, exact))
        assert inside == should or abs(margin) <= bound, told


@pytest.mark.parametrize("compare", CONVENTIONS)
def test_a_pair_at_the_cutoff_is_decided_by_the_convention_in_exact_arithmetic_too(compare):
    decider = PairDecider((1.5,), compare, "float32")
    found = exact_margin(decider, Cell.create([6.0] * 3), np.zeros(3), np.array([0.0, 1.5, 0.0]))
    assert found == (0, compare.endswith("<="))


def test_bounds_grow_only_along_free_axes_and_only_where_positions_are_narrowed():
    far = np.full((1, 3, 2), 3004.0)
    for box, roles in itertools.product(("brick", "cluster"), ROLES):
        cell = Cell.create(*BOXES[box])
        decider = decider_of(cell, "r2 <", *roles, np.ones((2, 3)))
        grows = box == "cluster" and roles == ("float64", "float32")
        assert bool(decider.bounds_at(far)[0, 0] > 100 * decider.bounds[0]) is grows
        assert decider.bounds_at(far / 3004)[0] == decider.bounds


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
