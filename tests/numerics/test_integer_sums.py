"""Sums of integers against exact rational arithmetic and math.fsum."""

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
from mdnum.numerics.reductions import BY_NAME, Exact, FixedPoint

DTYPES = [np.float64, np.float32, np.float16, ml_dtypes.bfloat16]
EXACT = jax.jit(Exact())
PATTERN = {8: np.int64, 4: np.int32, 2: np.int16}


def nearest(value: Fraction, dtype):
    """The float nearest to a rational, ties to even: tried among the neighbors of a first guess."""
    largest = Fraction(float(ml_dtypes.finfo(dtype).max))
    spacing = largest - Fraction(float(np.nextafter(ml_dtypes.finfo(dtype).max, dtype(0))))
    if abs(value) >= largest + spacing / 2:
        return dtype(np.inf if value > 0 else -np.inf)
    guess = dtype(max(-float(largest), min(float(largest), float(value))))
    around = [guess, np.nextafter(guess, dtype(np.inf)), np.nextafter(guess, dtype(-np.inf))]
    around = [g for g in around if np.isfinite(g)]
    gaps = [abs(Fraction(float(g)) - value) for g in around]
    best = [g for g, gap in zip(around, gaps, strict=True) if gap == min(gaps)]
    integer = PATTERN[np.dtype(dtype).itemsize]
    return min(best, key=lambda g: int(np.asarray(g).view(integer)) & 1)


def any_bits(dtype, count):
    """Arrays of arbitrary finite bit patterns, subnormals and extremes included."""
    integer = PATTERN[np.dtype(dtype).itemsize]
    info = np.iinfo(integer)

    def finite(patterns):
        x = np.array(patterns, integer).view(dtype)
        return np.where(np.isfinite(x), x, dtype(1))

    return st.lists(st.integers(int(info.min), int(info.max)), min_size=count, max_size=count).map(finite)


@pytest.mark.parametrize("dtype", DTYPES)
@given(data=st.data())
@settings(max_examples=150)
@np.errstate(all="ignore")
def test_the_exact_sum_is_the_rational_sum_rounded_once(dtype, data):
    terms = data.draw(any_bits(dtype, 6))
    if data.draw(st.booleans()):  # nearly cancelling, so that the rounding is decided far down
        terms[3:5] = -terms[:2]
    exact = sum((Fraction(float(t)) for t in terms), Fraction(0))
    seen = np.asarray(EXACT(jnp.asarray(terms)))
    expected = nearest(exact, dtype)
    assert seen.view(PATTERN[seen.dtype.itemsize]) == np.abs(expected).view(PATTERN[seen.dtype.itemsize]) or (
        seen.tobytes() == np.asarray(expected).tobytes()
    )
    assert float(seen) == float(expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_ties_go_to_even_and_a_bit_far_below_breaks_them(dtype):
    info = ml_dtypes.finfo(dtype)
    one, half_ulp, tiny = dtype(1), dtype(float(info.eps) / 2), info.smallest_subnormal
    for terms, expected in [
        ([one, half_ulp], 1.0),
        ([one, half_ulp, tiny], 1.0 + float(info.eps)),
        ([one, half_ulp, -tiny], 1.0),
        ([one + dtype(info.eps), half_ulp], 1.0 + 2 * float(info.eps)),
        ([tiny, tiny, tiny], 3 * float(tiny)),
        ([info.max, info.max, -info.max], float(info.max)),
        ([info.max, info.max], math.inf),
        ([-info.max, -info.max], -math.inf),
    ]:
        padded = np.zeros(4, dtype)
        padded[: len(terms)] = terms
        assert float(np.asarray(EXACT(jnp.asarray(padded)))) == expected


@given(st.lists(st.floats(-1e200, 1e200, allow_nan=False), min_size=40, max_size=40), st.randoms())
def test_the_exact_sum_agrees_with_fsum_in_every_order(values, random):
    seen = float(EXACT(jnp.asarray(values, jnp.float64)))
    assert seen == math.fsum(values)
    random.shuffle(values)
    assert float(EXACT(jnp.asarray(values, jnp.float64))) == seen


def test_columns_are_summed_apart_and_infinities_are_kept():
    rng = np.random.default_rng(2)
    terms = rng.normal(size=(100, 3, 5)) * 10.0 ** rng.integers(-200, 200, (100, 3, 5))
    seen = np.asarray(EXACT(jnp.asarray(terms)))
    assert seen.shape == (3, 5)
    expected = [[math.fsum(terms[:, i, j]) for j in range(5)] for i in range(3)]
    assert np.array_equal(seen, expected)
    special = np.array([[1.0, np.inf, np.inf, np.nan], [2.0, 1.0, -np.inf, 0.0]])
    assert np.array_equal(
        np.asarray(EXACT(jnp.asarray(special))), [3.0, np.inf, np.nan, np.nan], equal_nan=True
    )
    batched = jax.jit(jax.vmap(Exact()))(jnp.asarray(np.moveaxis(terms, 1, 0)))
    assert np.array_equal(np.asarray(batched), expected)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("reduction", [Exact(), FixedPoint(30), BY_NAME["sorted"]], ids=str)
def test_no_order_of_arrival_changes_a_bit(reduction, dtype):
    rng = np.random.default_rng(3)
    terms = rng.normal(size=(60, 8)).astype(dtype)
    summed = jax.jit(reduction)
    first = np.asarray(summed(jnp.asarray(terms))).tobytes()
    for _ in range(20):
        assert np.asarray(summed(jnp.asarray(rng.permutation(terms)))).tobytes() == first


def test_a_fixed_point_sum_is_a_sum_of_rounded_integers():
    rng = np.random.default_rng(4)
    terms = rng.normal(size=(50, 6))
    expected = [sum(round(Fraction(v) * 2**20) for v in column) / 2**20 for column in terms.T]
    assert np.array_equal(np.asarray(FixedPoint(20)(jnp.asarray(terms))), expected)
    # a coarse unit loses the small terms altogether
    assert float(FixedPoint(0)(jnp.asarray([0.4] * 10))) == 0.0
    # out of range is said, never wrapped
    assert np.isnan(float(FixedPoint(40)(jnp.asarray([2.0**21, 1.0]) * 2)))
    assert float(FixedPoint(40)(jnp.asarray([2.0**21, 1.0]))) == 2.0**21 + 1
    with pytest.raises(InputError, match="2000 digits"):
        FixedPoint(2000)


FEW = {**BY_NAME, "fixed-point": FixedPoint(20)}
EVERY = jax.jit(lambda terms: {name: reduction(terms) for name, reduction in FEW.items()})


@pytest.mark.parametrize("dtype", DTYPES)
@given(seed=st.integers(0, 2**31))
@settings(max_examples=25)
def test_every_sum_is_within_its_bound(dtype, seed):
    rng = np.random.default_rng(seed)
    terms = (rng.normal(size=(20, 4)) * 2.0 ** rng.integers(-6, 7, (20, 4))).astype(dtype)
    exact = [sum(Fraction(float(v)) for v in column) for column in terms.T]
    for name, total in EVERY(jnp.asarray(terms)).items():
        pairs = zip(np.asarray(total), exact, strict=True)
        error = np.array([float(abs(Fraction(float(s)) - e)) for s, e in pairs])
        bound = FEW[name].bound(terms)
        assert np.isfinite(bound).all()
        assert (error <= bound).all(), name
