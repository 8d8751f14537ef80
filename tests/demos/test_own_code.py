"""Functions of demonstrations: the history of a sum, sums of segments, few-bit products and values."""

from __future__ import annotations

import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.numerics.reductions import BY_NAME, Exact
from mdnum.verbs import demos

running_sum_table = demos.load("sum-order").running_sum_table
_coalesce = demos.load("coalesce")
segment_sum, scatter_add = _coalesce.segment_sum, _coalesce.scatter_add

# --- the history of a sum: its last row has the bits of the program --------------------------------------

TOL = np.float16(2.0**-10)
SMALL = [np.float16(2.0**-23)] * 4
LARGE = np.float16(2.0**-10 - 2.0**-21)


@pytest.mark.parametrize("dtype", [np.float64, ml_dtypes.bfloat16])
def test_the_last_row_has_the_bits_of_the_program(dtype):
    rng = np.random.default_rng(8)
    terms = (rng.normal(size=(24, 16)) * 2.0 ** rng.integers(-5, 6, (24, 16))).astype(dtype)
    totals = np.asarray(jax.jit(BY_NAME["sequential"])(jnp.asarray(terms)))
    for column in range(4):
        history = running_sum_table(terms[:, column])
        assert history.result == float(totals[column])
        exact = sum(Fraction(float(t)) for t in terms[:, column])
        assert history.exact == exact
        assert history.error == float(Fraction(history.result) - exact)
        assert history.rows[-1].exact == exact


def test_four_small_terms_after_a_large_one_leave_no_trace():
    history = running_sum_table([LARGE, *SMALL], dtype=np.float16)
    assert [row.running for row in history.rows] == [float(LARGE)] * 5
    assert [row.absorbed for row in history.rows] == [False, True, True, True, True]
    # 2^-23 below a last place of 2^-21: two binary digits each time
    assert [row.bits_lost for row in history.rows] == [0, 2, 2, 2, 2]
    assert history.exact == Fraction(2) ** -10
    assert history.result < TOL
    assert history.error == -(2.0**-21)
    # small first, nothing is lost
    history = running_sum_table([*SMALL, LARGE], dtype=np.float16)
    assert [row.running for row in history.rows] == [2.0**-23, 2.0**-22, 3 * 2.0**-23, 2.0**-21, 2.0**-10]
    assert history.bits_lost == history.error == 0


def test_one_bit_lost_is_one_bit_lost():
    for extra, lost in [(2.0**-24, 1), (2.0**-25, 2), (2.0**-24 + 2.0**-30, 7), (2.0**-23, 0)]:
        assert running_sum_table([1.0, extra], dtype=np.float32).rows[1].bits_lost == lost


def test_what_has_no_history_is_refused():
    with pytest.raises(InputError, match=r"terms have shape \(0,\)"):
        running_sum_table(np.zeros(0))
    with pytest.raises(InputError, match="not finite"):
        running_sum_table([1.0, math.inf])


def test_the_table_has_a_row_for_each_addition():
    assert running_sum_table(np.arange(1.0, 4.0)).table()[2] == ("2", 3.0, 6.0, 6.0, 0)


# --- segments: sums behind one's back, against loops over the entries -------------------------------------


def entries(count=200, segments=9, dtype=np.float64, seed=1):
    rng = np.random.default_rng(seed)
    return rng.integers(0, segments, count), rng.normal(size=count).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float64, np.float16, ml_dtypes.bfloat16])
def test_segments_are_summed_in_storage_order(dtype):
    index, values = entries(dtype=dtype)
    expected = np.zeros(9, dtype)
    for i, v in zip(index, values, strict=True):
        expected[i] = expected[i] + v
    seen = np.asarray(jax.jit(lambda v: segment_sum(v, index, 9))(jnp.asarray(values)))
    assert seen.dtype == dtype
    assert np.array_equal(seen, expected)
    # on another device in any order
    if dtype == np.float64 and jax.default_backend() == "cpu":
        assert np.array_equal(np.asarray(jax.jit(scatter_add, static_argnums=2)(values, index, 9)), expected)


@pytest.mark.parametrize("name", ["reversed", "kahan", "exact", "fixed-point"])
def test_segments_are_summed_by_any_reduction(name):
    index, values = entries()
    seen = np.asarray(jax.jit(lambda v: segment_sum(v, index, 10, BY_NAME[name]))(jnp.asarray(values)))
    assert seen[9] == 0  # a segment without entries
    assert seen[3] == float(BY_NAME[name](jnp.asarray(values[index == 3])))
    for k in range(9):
        own = values[index == k]
        assert abs(seen[k] - math.fsum(own)) <= BY_NAME[name].bound(own)


def test_the_derivative_of_a_segment_sum_gathers():
    index, values = entries(20, 4)
    weights = jnp.arange(1.0, 5.0)

    def weighted(v):
        return jnp.sum(weights * segment_sum(v, index, 4, Exact()))

    slope = jax.jit(jax.grad(weighted))(jnp.asarray(values))
    assert np.array_equal(np.asarray(slope), np.arange(1.0, 5.0)[index])


def test_entries_outside_are_refused():
    with pytest.raises(InputError, match=r"outside the range 0 to 2"):
        segment_sum(jnp.ones(2), np.array([0, 3]), 3)


# --- few bits -------------------------------------------------------------------------------------------


def test_a_tf32_product_is_rounded_inputs_and_float32_sums():
    product = jax.jit(demos.load("tf32-in-solver").matmul, static_argnums=2)
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(9, 40)).astype(np.float32), rng.normal(size=(40, 7)).astype(np.float32)

    def by_bits(x):  # 13 of 23 fraction bits off, to nearest, ties to even: in integers
        bits = x.view(np.uint32).astype(np.uint64)
        return ((bits + 0xFFF + ((bits >> 13) & 1)) & ~np.uint64(0x1FFF)).astype(np.uint32).view(np.float32)

    exact = by_bits(a).astype(np.float64) @ by_bits(b).astype(np.float64)
    size = np.abs(a).astype(np.float64) @ np.abs(b)
    seen = np.asarray(product(a, b, "tf32"))
    assert seen.dtype == np.float32
    assert np.all(np.abs(seen - exact) <= 45 * 2.0**-24 * size)
    # and it is not the product in float32
    assert np.abs(seen - a.astype(np.float64) @ b).max() > 1e-4
    for name, u in [("float32", 0.0), ("tf32", 2.0**-11), ("bfloat16", 2.0**-8), ("float64", 0.0)]:
        error = np.abs(np.asarray(product(a, b, name)) - a.astype(np.float64) @ b)
        assert np.all(error <= (2.1 * u + 45 * 2.0**-24) * size)


def test_a_value_is_quantized_to_the_nearest_of_a_few():
    quantize = demos.load("quantized-state").quantize
    values = jnp.asarray([0.1, 1.7, -1.9, 2.1, -3.0, 0.124, 0.126])

    @jax.jit
    def few(x):
        quantized, pullback = jax.vjp(lambda x: quantize(x, *map(jnp.asarray, (0.25, -8.0, 7.0))), x)
        return quantized, pullback(jnp.ones_like(x))[0]

    quantized, slope = few(values)
    assert np.array_equal(np.asarray(quantized), [0, 1.75, -2, 1.75, -2, 0, 0.25])
    # clamped where the nearest is beyond the ends
    assert np.array_equal(np.asarray(slope), [1, 1, 1, 0, 0, 1, 1])
