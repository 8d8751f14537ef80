"""Floats as integers, against numpy's own nextafter and spacing."""

from __future__ import annotations

from typing import Any

import ml_dtypes
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.numerics.rounding import neighbor, ordinal, ulp_distance, unit_roundoff

WIDTHS: dict[type, Any] = {np.float64: 64, np.float32: 32, np.float16: 16, ml_dtypes.bfloat16: 32}


def numbers(dtype):
    drawn = st.floats(width=WIDTHS[dtype], allow_nan=False, allow_infinity=False).map(dtype)
    # the largest float32 rounds to infinity in bfloat16
    return drawn.filter(np.isfinite)


@pytest.mark.parametrize("dtype", WIDTHS)
@given(data=st.data())
@np.errstate(over="ignore")  # above the largest float comes infinity
def test_the_next_float_has_the_next_ordinal(dtype, data):
    x = data.draw(numbers(dtype))
    above, below = np.nextafter(x, dtype(np.inf)), np.nextafter(x, dtype(-np.inf))
    here = int(ordinal(np.asarray(x)))
    assert int(ordinal(np.asarray(above))) == here + 1
    assert int(ordinal(np.asarray(below))) == here - 1


@pytest.mark.parametrize("dtype", WIDTHS)
@given(data=st.data())
def test_ordinals_keep_the_order_of_the_floats(dtype, data):
    a, b = data.draw(numbers(dtype)), data.draw(numbers(dtype))
    difference = int(ordinal(np.asarray(b))) - int(ordinal(np.asarray(a)))
    assert (difference > 0) == bool(b > a)
    assert (difference == 0) == bool(b == a)


@pytest.mark.parametrize("dtype", WIDTHS)
@given(data=st.data(), ulps=st.integers(-40, 40))
def test_a_neighbor_is_reached_by_so_many_steps_of_nextafter(dtype, data, ulps):
    x = data.draw(numbers(dtype).filter(lambda v: abs(v) < float(ml_dtypes.finfo(dtype).max) / 2))
    walked = x
    for _ in range(abs(ulps)):
        walked = np.nextafter(walked, dtype(np.inf if ulps > 0 else -np.inf))
    found = neighbor(x, ulps, dtype)
    assert found == walked
    assert found.dtype == dtype
    assert int(ulp_distance(x, found, dtype)) == ulps


def test_both_zeros_are_one_place():
    for dtype in WIDTHS:
        assert int(ulp_distance(-0.0, 0.0, dtype)) == 0
        tiny = np.nextafter(dtype(0), dtype(1))
        assert int(ulp_distance(-tiny, tiny, dtype)) == 2
        assert neighbor(-tiny, 1, dtype) == 0


def test_unit_roundoff_is_the_largest_error_of_one_rounding():
    assert unit_roundoff(np.float64) == 2.0**-53
    assert unit_roundoff(np.float32) == 2.0**-24
    assert unit_roundoff(ml_dtypes.bfloat16) == 2.0**-8
    for dtype in (np.float64, np.float32):
        u = unit_roundoff(dtype)
        # half way rounds to even, a little more goes up: nothing is further than u away
        assert dtype(1) + dtype(u) == 1
        assert dtype(1) + dtype(u * 1.001) > 1 or dtype is np.float64
        assert np.nextafter(dtype(1), dtype(2)) == dtype(1 + 2 * u)
