"""Counts of what a narrow type loses, against casting to it."""

from __future__ import annotations

import ml_dtypes
import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.gradients.diagnose.growth import ScalingWatch

TYPES = {"float16": np.float16, "bfloat16": ml_dtypes.bfloat16, "float32": np.float32}


def spans(low: float, high: float, steps: int = 20, numbers: int = 600) -> np.ndarray:
    """Cotangents whose sizes fall by a constant factor from step to step, and scatter by powers of two."""
    rng = np.random.default_rng(3)
    sizes = 2.0 ** np.linspace(high, low, steps + 1)
    values = sizes[:, None] * rng.standard_normal((steps + 1, numbers))
    values[:, ::50] = 0.0
    return values


def watched(values: np.ndarray, format: str) -> ScalingWatch:
    watch = ScalingWatch(len(values) - 1, format)
    for step, row in enumerate(values):
        watch.put(step, row)
    return watch


def cast(values: np.ndarray, format: str) -> tuple[np.ndarray, np.ndarray]:
    """Overflows and losses by horizon."""
    with np.errstate(over="ignore"):
        narrow = values.astype(TYPES[format]).astype(np.float64)
    lost = (narrow == 0) & (values != 0)
    return (~np.isfinite(narrow)).sum(axis=1)[::-1], lost.sum(axis=1)[::-1]


@pytest.mark.parametrize(
    ("format", "low", "high"), [("float16", -40, 20), ("bfloat16", -150, 130), ("float32", -155, 131)]
)
def test_counts_are_those_of_a_cast_with_and_without_the_scale(format, low, high):
    values = spans(low, high)
    found = watched(values, format).result()
    overflow, lost = cast(values, format)
    assert overflow.any() and lost.any()
    assert np.array_equal(found.table["overflow"], overflow) and np.array_equal(
        found.table["underflow"], lost
    )
    power = np.floor(np.log2(watched(values, format).format.largest / np.abs(values).max()))
    overflow, lost = cast(values * 2.0**power, format)
    assert not overflow.any() and not found.table["scaled_overflow"].any()
    assert np.array_equal(found.table["scaled_underflow"], lost)
    # one doubling more, and something overflows
    assert cast(values * 2.0 ** (power + 1), format)[0].any()
    assert not found.fits


def test_small_cotangents_fit_with_a_scale():
    found = watched(spans(-35, -25), "float16").result()
    assert found.table["underflow"].sum() > 1000 and found.table["scaled_underflow"].sum() < 30
    assert found.fits and found.scale >= 2.0**35
    assert {len(column) for column in found.table.values()} == {21}


def test_nothing_and_what_is_not_finite_have_no_scale():
    nothing = watched(np.zeros((3, 4)), "float16").result()
    assert np.isnan(nothing.scale) and not nothing.usable
    broken = np.ones((3, 4))
    broken[1, 2] = np.nan
    found = watched(broken, "float16").result()
    assert np.isnan(found.scale) and not found.fits and found.table["overflow"].tolist() == [0, 1, 0]
    with pytest.raises(InputError):
        ScalingWatch(3, "float17")
