"""Sums behind one's back, against loops over the entries."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.numerics.reductions import (
    BY_NAME,
    Exact,
    scatter_add,
    segment_sum,
)


def entries(count=200, segments=9, dtype=np.float64, seed=1):
    rng = np.random.default_rng(seed)
    return rng.integers(0, segments, count), rng.normal(size=count).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float64, np.float16, ml_dtypes.bfloat16])
def test_segments_are_summed_in_storage_order(dtype):
    index, values = entries(dtype=dtype)
    expected = np.zeros(9, dtype)
    for i, v in zip(index, values, strict=True):
        expected[i] = expected[i] + v
    seen = np.asarray(segment_sum(jnp.asarray(values), index, 9))
    assert seen.dtype == dtype
    assert np.array_equal(seen, expected)
    if dtype == np.float64:
        assert np.array_equal(np.asarray(jax.jit(scatter_add, static_argnums=2)(values, index, 9)), expected)


@pytest.mark.parametrize("name", ["reversed", "kahan", "exact", "fixed-point"])
def test_segments_are_summed_by_any_reduction(name):
    index, values = entries()
    seen = np.asarray(segment_sum(jnp.asarray(values), index, 10, BY_NAME[name]))
    assert seen[9] == 0  # a segment without entries
    assert seen[3] == float(BY_NAME[name](jnp.asarray(values[index == 3])))
    for k in range(9):
        own = values[index == k]
        assert abs(seen[k] - math.fsum(own)) <= BY_NAME[name].bound(own)


def test_the_derivative_of_a_segment_sum_gathers():
    index, values = entries(20, 4)
    weights = jnp.arange(1.0, 5.0)
    slope = jax.grad(lambda v: jnp.sum(weights * segment_sum(v, index, 4, Exact())))(jnp.asarray(values))
    assert np.array_equal(np.asarray(slope), np.arange(1.0, 5.0)[index])


def test_entries_outside_are_refused():
    with pytest.raises(InputError, match=r"outside 0 ... 2"):
        segment_sum(jnp.ones(2), np.array([0, 3]), 3)
