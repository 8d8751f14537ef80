"""Range checks on numbers whose range is known."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.numerics.formats import RangeReport, measure

VALUES = np.array([[1.0, -2.0], [2.0**-20, 0.0], [1e5, -3.0], [np.inf, np.nan], [np.nan, np.nan]])


def test_a_range_by_step():
    seen = measure("y", VALUES, "float16")
    assert np.array_equal(seen.low, [-2, 0, -3, np.nan, np.nan], equal_nan=True)
    assert np.array_equal(seen.high, [1, 2.0**-20, 1e5, np.nan, np.nan], equal_nan=True)
    assert np.array_equal(seen.smallest, [1, 2.0**-20, 3, np.inf, np.inf])
    assert np.array_equal(seen.zeros, [0, 1, 0, 0, 0])
    assert np.array_equal(seen.subnormal, [0, 1, 0, 0, 0])
    assert np.array_equal(seen.not_finite, [0, 0, 0, 2, 2])
    # 65504 is almost 2^16; two is 15 doublings below, 1e5 is above
    assert seen.headroom[0] == pytest.approx(15, abs=1e-3)
    assert seen.headroom[2] == pytest.approx(np.log2(65504 / 1e5))
    assert [seen.first(what) for what in ("not finite", "subnormal", "out of range")] == [3, 1, 2]


def test_the_same_numbers_fit_a_wider_format():
    seen = measure("y", VALUES[:3], "bfloat16")
    assert [seen.first(what) for what in ("not finite", "subnormal", "out of range")] == [-1, -1, -1]
    assert seen.findings() == ()


def test_what_is_wrong_is_said_with_its_step():
    said = RangeReport(
        {"y": measure("y", VALUES, "float16"), "distance": measure("distance", VALUES[:3], "float16", True)}
    ).findings()
    assert said[0] == "y in float16 is not finite at step 3"
    assert said[1] == "y in float16 reaches 1e+05 at step 2, above 6.55e+04"
    assert said[2].startswith("y in float16 is 9.54e-07 at step 1, below 6.1e-05")
    assert said[-1] == "distance in float16 is divided by and is too near zero at step 1"
    assert len(said) == 6


def test_a_denominator_may_be_small_but_not_too_small():
    near = measure("r", np.array([[1e-4], [1e-5]]), "float16", denominator=True)
    assert list(near.reciprocal_overflows) == [False, True]
