"""Rounding bounds of distances, against rational arithmetic on the stored numbers."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from oracles import exact_r2

from mdnum.md.cell import Cell, displacement, wrap_positions
from mdnum.md.decide import PairDecider
from mdnum.numerics import distance_bound, gamma, squared_distance_bound

BOXES = {
    "cube": np.diag([17.3, 17.3, 17.3]),
    "brick": np.diag([11.1, 23.7, 61.9]),
    "tilted": np.array([[19.1, 0.0, 0.0], [4.3, 17.7, 0.0], [-3.1, 5.9, 21.3]]),
    "leaning": np.array([[18.0, 1.3, -0.7], [8.1, 16.2, 2.0], [7.9, -6.1, 17.1]]),
}


def root(value: Fraction) -> Fraction:
    """The square root to 40 digits."""
    scale = 10**80
    return Fraction(math.isqrt(value.numerator * scale // value.denominator), 10**40)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize("space", ["r2", "r"])
def test_no_computed_distance_is_further_from_the_exact_one_than_its_bound(box, dtype, space):
    rng = np.random.default_rng(17)
    matrix = BOXES[box].astype(dtype).astype(np.float64)
    cell = Cell.create(matrix)
    reach = cell.reach(np.zeros((0, 3)))
    wrapped, _ = wrap_positions(cell, rng.uniform(-30, 60, (400, 3)))
    wrapped = wrapped.astype(dtype)
    i, j = rng.integers(0, 400, (2, 1500))
    i, j = i[i != j], j[i != j]
    decider = PairDecider((1.0,), f"{space} <", np.dtype(dtype).name)
    d = displacement(cell, wrapped[i], wrapped[j], dtype)
    computed = decider.host_quantity(*d)
    assert computed.dtype == dtype
    # the image that was taken, from the components found
    took = np.rint((np.stack(d, 1).astype(float) - (wrapped[j] - wrapped[i])) @ np.linalg.inv(matrix))
    ratios = []
    for pair in range(len(i)):
        exact = exact_r2(wrapped, matrix, i[pair], j[pair], took[pair])
        exact = exact if space == "r2" else root(exact)
        error = abs(Fraction(float(computed[pair])) - exact)
        r = float(np.sqrt(float(computed[pair]))) if space == "r2" else float(computed[pair])
        bound = float((squared_distance_bound if space == "r2" else distance_bound)(r, reach, dtype, dtype))
        assert error <= Fraction(bound), (i[pair], j[pair], float(error), bound)
        if error > 0:
            ratios.append(bound / float(error))
    assert len(ratios) > 100
    # a bound that calls everything ambiguous is useless
    assert min(ratios) < 9 and np.median(ratios) < 100


def test_the_bound_grows_with_the_box_and_with_the_roundoff():
    small, large = (Cell.create([edge] * 3).reach(np.zeros((0, 3))) for edge in (10.0, 10240.0))
    assert squared_distance_bound(3.0, large) > 100 * squared_distance_bound(3.0, small)
    wide, narrow = distance_bound(3.0, small), distance_bound(3.0, small, np.float32, np.float32)
    assert narrow / wide == pytest.approx(2**29, rel=1e-3)


def test_gamma_bounds_a_product_of_roundings():
    u = 2.0**-53
    for n in (1, 3, 7, 100):
        assert (1 + Fraction(u)) ** n - 1 <= Fraction(gamma(n))
        assert gamma(n) >= n * u
