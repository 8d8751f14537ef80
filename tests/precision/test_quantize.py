"""Fake quantization against exact integers."""

from __future__ import annotations

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.errors import InputError
from mdnum.precision.exact import zero_bits
from mdnum.precision.quantize import Grid, fake_quantize


@given(st.lists(st.floats(-3, 3), min_size=1, max_size=20), st.integers(1, 16))
def test_a_value_is_the_nearest_of_a_few(values, bits):
    scale = 2.0**-4  # exact, so the fractions below are what is computed
    seen = np.asarray(fake_quantize(jnp.asarray(values), bits, scale))
    low, high = -(2 ** (bits - 1)), 2 ** (bits - 1) - 1
    expected = [float(min(max(round(Fraction(v) * 16), low), high)) * scale for v in values]
    assert np.array_equal(seen, expected)
    assert np.array_equal(np.asarray(fake_quantize(jnp.asarray(seen), bits, scale)), seen)


def test_a_grid_over_an_interval_has_so_many_values():
    grid = Grid.over(-1.0, 2.0, 3)
    x = np.linspace(-2, 3, 1001)
    seen = np.asarray(grid(jnp.asarray(x)))
    assert np.allclose(np.unique(seen), np.linspace(-1, 2, 8), rtol=0, atol=1e-15)
    assert grid.limits == (-1.0, pytest.approx(2.0))
    inside = (x >= -1) & (x <= 2)
    assert np.abs(seen - x)[inside].max() <= grid.scale / 2 + 1e-15


def test_the_derivative_is_one_inside_and_zero_outside():
    slope = jax.grad(lambda x: jnp.sum(fake_quantize(x, 4, 0.25)))(jnp.asarray([0.1, 1.7, -1.9, 2.1, -3.0]))
    assert np.array_equal(np.asarray(slope), [1, 1, 1, 0, 0])


def test_with_a_fence_the_bits_are_those_of_numpy():
    grid = Grid.over(-0.37, 1.91, 9)
    x = np.random.default_rng(2).normal(size=5000)
    index = np.clip(np.rint((x - grid.offset) / grid.scale), 0, 511)
    expected = grid.offset + index * grid.scale
    seen = jax.jit(lambda x, zero: grid(x, zero))(jnp.asarray(x), zero_bits(np.float64))
    assert np.array_equal(np.asarray(seen), expected)


def test_grids_that_are_none_are_refused():
    with pytest.raises(InputError, match="0 bits"):
        Grid(0, 1.0)
    with pytest.raises(InputError, match="scale 0"):
        Grid(8, 0.0)
    with pytest.raises(InputError, match="from 1 to 1"):
        Grid.over(1, 1, 8)
