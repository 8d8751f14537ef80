"""Arithmetic in jit with the bits of numpy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.numerics.exact import fence, squared_norm, zero_bits


def triples(dtype, count=100_000):
    rng = np.random.default_rng(5)
    return [rng.normal(0, 4, count).astype(dtype) for _ in range(3)]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_squared_norm_in_jit_is_that_of_numpy_bit_for_bit(dtype):
    x, y, z = triples(dtype)
    inside = np.asarray(jax.jit(squared_norm)(*map(jnp.asarray, (x, y, z)), zero_bits(dtype)))
    assert inside.dtype == dtype
    assert np.array_equal(inside, x * x + y * y + z * z)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_without_the_fence_the_bits_differ_where_products_are_contracted(dtype):
    x, y, z = triples(dtype)
    plain = np.asarray(jax.jit(lambda a, b, c: a * a + b * b + c * c)(*map(jnp.asarray, (x, y, z))))
    differing = np.count_nonzero(plain != x * x + y * y + z * z)
    if differing == 0:
        pytest.skip("this machine's XLA contracts nothing: there is nothing to fence off here")
    assert differing > 1000


def test_the_fence_lets_derivatives_through():
    zero = zero_bits(np.float64)
    x = jnp.asarray([1.0, -2.5, 0.0])
    assert np.array_equal(jax.jit(fence)(x, zero), x)
    gradient = jax.grad(lambda v: squared_norm(v[0], v[1], v[2], zero))(x)
    assert np.array_equal(gradient, 2 * x)
    curvature = jax.hessian(lambda v: squared_norm(v[0], v[1], v[2], zero))(x)
    assert np.array_equal(curvature, 2 * np.eye(3))


def test_the_fence_keeps_special_numbers():
    zero = zero_bits(np.float64)
    x = jnp.asarray([np.inf, -np.inf, -0.0, 5e-324])
    out = np.asarray(jax.jit(fence)(x, zero))
    assert np.array_equal(out, x)
    assert np.signbit(out[2])
