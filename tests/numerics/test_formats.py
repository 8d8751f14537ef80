"""Formats, against numpy's own casts, exact fractions and known tables."""

from __future__ import annotations

import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mdnum.errors import InputError
from mdnum.numerics.formats import (
    FORMATS,
    cast,
    format_of,
    matmul,
    quantize,
    round_to,
    stochastic_round,
)
from mdnum.numerics.roles import ALL


def test_the_table_says_what_the_dtypes_say():
    for name, dtype in ALL.items():
        form, info = FORMATS[name], ml_dtypes.finfo(dtype)
        assert form.largest == float(info.max)
        assert form.smallest_normal == float(info.smallest_normal)
        assert form.smallest_subnormal == float(info.smallest_subnormal)
        assert form.unit_roundoff == float(info.eps) / 2
        assert form.bits == info.bits
    assert FORMATS["tf32"].unit_roundoff == 2.0**-11
    assert FORMATS["tf32"].largest == (2 - 2.0**-10) * 2.0**127
    with pytest.raises(InputError, match=r"unknown format 'fp8'; known are float64, float32, tf32"):
        format_of("fp8")


FINITE = st.floats(-1e5, 1e5) | st.floats(-1e-4, 1e-4) | st.floats(-1e-7, 1e-7)
ROUND = {name: jax.jit(lambda x, name=name: round_to(x, name)) for name in FORMATS}


@given(st.lists(FINITE, min_size=20, max_size=20))
def test_rounding_to_float16_is_numpys(values):
    x = np.array(values)
    with np.errstate(over="ignore"):
        expected = x.astype(np.float16).astype(np.float64)
    assert np.array_equal(np.asarray(ROUND["float16"](jnp.asarray(x))), expected)


@given(st.lists(st.floats(width=32, min_value=-(2.0**127), max_value=2.0**127), min_size=20, max_size=20))
def test_rounding_to_bfloat16_is_that_of_the_library(values):
    x = np.array(values, np.float32)
    expected = x.astype(ml_dtypes.bfloat16).astype(np.float64)
    assert np.array_equal(np.asarray(ROUND["bfloat16"](jnp.asarray(x.astype(np.float64)))), expected)


@pytest.mark.parametrize("name", ["tf32", "float32", "bfloat16", "float16"])
@given(value=FINITE)
@settings(max_examples=40)
def test_rounding_is_to_the_nearest_number_ties_to_even(name, value):
    form = FORMATS[name]
    seen = Fraction(float(ROUND[name](jnp.asarray([value]))[0])) if abs(value) < form.largest else None
    if seen is None:
        return
    exact = Fraction(value)
    exponent = max(math.frexp(value)[1] - 1, form.emin) if value else form.emin
    unit = Fraction(2) ** (exponent + 1 - form.significand)
    assert seen == round(exact / unit) * unit  # Python rounds fractions half to even


def test_double_rounding_does_not_happen():
    # just above the middle of two bfloat16 numbers, by less than float32 can say
    x = 1 + 2.0**-8 + 2.0**-40
    assert float(round_to(jnp.asarray(x), "bfloat16")) == 1 + 2.0**-7
    assert float(np.float64(x).astype(np.float32).astype(ml_dtypes.bfloat16)) == 1.0
    assert float(cast(jnp.asarray(x), "bfloat16")) == 1 + 2.0**-7


def test_the_ends_of_a_format():
    x = jnp.asarray([65504.0, 65519.9, 65520.0, -1e9, math.inf, 2.0**-24, 2.0**-25, 1.5 * 2.0**-25, -0.0])
    seen = np.asarray(round_to(x, "float16"))
    assert np.array_equal(seen, [65504, 65504, math.inf, -math.inf, math.inf, 2.0**-24, 0, 2.0**-24, 0])
    assert np.isnan(float(round_to(jnp.asarray(math.nan), "float16")))
    assert np.array_equal(np.asarray(round_to(x, "float64")), np.asarray(x))


def test_a_tf32_product_is_rounded_inputs_and_float32_sums():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(9, 40)).astype(np.float32), rng.normal(size=(40, 7)).astype(np.float32)

    def by_bits(x):  # 13 of 23 fraction bits off, to nearest, ties to even: in integers
        bits = x.view(np.uint32).astype(np.uint64)
        return ((bits + 0xFFF + ((bits >> 13) & 1)) & ~np.uint64(0x1FFF)).astype(np.uint32).view(np.float32)

    exact = by_bits(a).astype(np.float64) @ by_bits(b).astype(np.float64)
    size = np.abs(a).astype(np.float64) @ np.abs(b)
    seen = np.asarray(jax.jit(lambda a, b: matmul(a, b, "tf32"))(a, b))
    assert seen.dtype == np.float32
    assert np.all(np.abs(seen - exact) <= 45 * 2.0**-24 * size)
    # and it is not the product in float32
    assert np.abs(seen - a.astype(np.float64) @ b).max() > 1e-4
    for name, u in [("float32", 0.0), ("tf32", 2.0**-11), ("bfloat16", 2.0**-8), ("float64", 0.0)]:
        error = np.abs(np.asarray(matmul(jnp.asarray(a), jnp.asarray(b), name)) - a.astype(np.float64) @ b)
        assert np.all(error <= (2.1 * u + 45 * 2.0**-24) * size)


def test_stochastic_rounding_has_the_right_mean():
    x = jnp.asarray([1.0003, -0.7777, 3e-6, 1234.5678, 0.5])
    keys = jax.random.split(jax.random.key(3), 40_000)
    draws = np.asarray(jax.vmap(lambda key: stochastic_round(x, "float16", key))(keys))
    below = np.asarray(x).astype(np.float16)
    for k in range(5):
        values = np.unique(draws[:, k])
        # the two neighbors and nothing else; a number of the format stays
        assert len(values) == (1 if k == 4 else 2)
        assert values[0] <= float(x[k]) <= values[-1]
        assert float(below[k]) in values
        spread = values[-1] - values[0]
        assert abs(draws[:, k].mean() - float(x[k])) < 5 * spread / 2 / math.sqrt(40_000) + 1e-300


def test_a_sum_that_stands_still_moves_on_with_stochastic_rounding():
    step = 2.0**-13  # a quarter of the spacing of float16 above 1/2

    @jax.jit
    def walk(key):
        def add(total, key):
            return cast(total.astype(jnp.float64) + step, "float16", "stochastic", key), None

        return jax.lax.scan(add, jnp.asarray(0.5, jnp.float16), jax.random.split(key, 1000))[0]

    ends = [float(walk(jax.random.key(seed))) for seed in range(20)]
    still = jnp.asarray(0.5, jnp.float16)
    assert float(cast(still.astype(jnp.float64) + step, "float16")) == 0.5
    assert abs(np.mean(ends) - (0.5 + 1000 * step)) < 0.01
    with pytest.raises(InputError, match="needs a key"):
        cast(still, "bfloat16", "stochastic")


def test_derivatives_go_straight_through():
    x = jnp.asarray([0.3, -2.7])
    for function in (
        lambda x: round_to(x, "bfloat16"),
        lambda x: stochastic_round(x, "float16", jax.random.key(0)),
        lambda x: cast(x, "float16").astype(jnp.float64),
    ):
        assert np.array_equal(np.asarray(jax.grad(lambda x, f=function: jnp.sum(f(x) * 3))(x)), [3, 3])


def test_a_value_is_quantized_to_the_nearest_of_a_few():
    values = jnp.asarray([0.1, 1.7, -1.9, 2.1, -3.0, 0.124, 0.126])
    few = lambda x: quantize(x, *map(jnp.asarray, (0.25, -8.0, 7.0)))  # noqa: E731
    assert np.array_equal(np.asarray(few(values)), [0, 1.75, -2, 1.75, -2, 0, 0.25])
    slope = jax.grad(lambda x: jnp.sum(few(x)))(values)
    # clamped where the nearest is beyond the ends
    assert np.array_equal(np.asarray(slope), [1, 1, 1, 0, 0, 1, 1])
