"""Arithmetic inside jit that has the bits of numpy, and programs that are run operation by operation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import ml_dtypes
import mpmath
import numpy as np
import pytest
from devices import on_cpu
from jax import lax

from mdnum.numerics.exact import (
    fence,
    normal_quantile,
    reproducible,
    root,
    rounded,
    squared_norm,
    zero_bits,
)

DTYPES = [np.float16, ml_dtypes.bfloat16, np.float32, np.float64]
each = pytest.mark.parametrize("dtype", DTYPES)
ZERO = zero_bits(np.float64)


def draws(dtype, count=3, columns=4000):
    rng = np.random.default_rng(5)
    return [
        (rng.normal(size=columns) * 2.0 ** rng.integers(-5, 3, columns)).astype(dtype) for _ in range(count)
    ]


@each
def test_products_sums_and_recurrences_have_the_bits_of_numpy(dtype):
    x, y, z = draws(dtype)
    divisor, scale = (np.abs(z) + z.dtype.type(0.5)).astype(dtype), np.asarray(0.75, dtype)

    @jax.jit
    def run(x, y, z, divisor, zero):
        def step(a, _):
            return fence(fence(a * jnp.asarray(scale), zero) + y, zero), None

        total = fence(fence(x * y, zero) + z, zero)
        widened = fence(x * y, zero).astype(jnp.float64)
        norm = squared_norm(x, y, z, zero)
        return fence(fence(total * x, zero) - y, zero) / divisor, widened, norm, lax.scan(step, x, None, 9)[0]

    a = x
    for _ in range(9):
        a = a * scale + y
    expected = ((x * y + z) * x - y) / divisor, (x * y).astype(np.float64), x * x + y * y + z * z, a
    made = run(x, y, z, divisor, zero_bits(dtype))
    # quotients of a GPU in float32 are approximate
    quotients = dtype != np.float32 or jax.default_backend() == "cpu"
    for seen, known in zip(
        made if quotients else made[1:], expected if quotients else expected[1:], strict=True
    ):
        assert known.dtype == seen.dtype
        assert np.array_equal(np.asarray(seen), known)


@pytest.mark.parametrize("by_double", [False, True])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_root_is_correctly_rounded(dtype, by_double, monkeypatch):
    """Also by way of double precision, which a device needs whose own is not."""
    if by_double:
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    x = np.concatenate([draws(dtype)[0] ** 2, [0, np.inf, np.finfo(dtype).tiny, np.finfo(dtype).max]]).astype(
        dtype
    )
    seen = np.asarray(jax.jit(lambda x: root(x))(jnp.asarray(x)))
    assert seen.dtype == dtype and np.array_equal(seen, np.sqrt(x))


@on_cpu
# float16 is missing: XLA on a CPU was not seen to skip a rounding to it, though it may
@pytest.mark.parametrize("dtype", DTYPES[1:])
def test_without_fences_some_bits_differ(dtype):
    # what the fence is for; if XLA ever rounds by itself, this is the place that says so
    x, y, z = draws(dtype)

    def run(x, y, z):
        # a bfloat16 product that is widened at once is never rounded; a wider one is contracted
        return (x * y).astype(jnp.float32) if dtype == ml_dtypes.bfloat16 else x * y + z

    assert not np.array_equal(np.asarray(jax.jit(run)(x, y, z)), run(x, y, z).astype(np.float64))


@each
def test_the_fence_keeps_special_numbers_and_its_derivative_is_one(dtype):
    zero = zero_bits(dtype)
    x = jnp.asarray(np.array([np.inf, -np.inf, -0.0, 1.5], dtype))
    out = np.asarray(jax.jit(fence)(x, zero))
    assert np.array_equal(out, np.asarray(x))
    assert np.signbit(out[2].astype(np.float64))
    slope = jax.jit(jax.grad(lambda v: fence(v * v, zero).astype(jnp.float32)))(jnp.asarray(1.5, dtype))
    assert float(slope) == 3.0


def test_the_fence_lets_second_derivatives_through():
    x = jnp.asarray([1.0, -2.5, 0.0])
    curvature = jax.jit(jax.hessian(lambda v: squared_norm(v[0], v[1], v[2], ZERO)))(x)
    assert np.array_equal(curvature, 2 * np.eye(3))


@pytest.mark.parametrize("dtype", DTYPES[:2])
def test_a_formula_is_rounded_behind_every_operation(dtype):
    x, y, z = draws(dtype)

    def formula(x, y, z):
        return jnp.where(x > 0, x * y + z, (x - y) * z * x)

    seen = jax.jit(lambda x, y, z, zero: rounded(formula, zero)(x, y, z))(x, y, z, zero_bits(dtype))
    assert np.array_equal(np.asarray(seen), np.where(x > 0, x * y + z, (x - y) * z * x))


# --- elementary functions, and programs that no compiler changes ----------------------------------------


def quantile(u: float):
    """sqrt(2) erf⁻¹(u) in 40 digits."""
    return mpmath.sqrt(2) * mpmath.erfinv(mpmath.mpf(u))


def test_the_error_of_the_quantile_is_as_documented():
    x = np.random.default_rng(0).uniform(-1, 1, 400)
    x[:2] = -1 + 1e-15, 1 - 1e-15
    got = np.asarray(jax.jit(normal_quantile)(jnp.asarray(x), ZERO))
    with mpmath.workdps(40):
        for argument, value in zip(x.tolist(), got.tolist(), strict=True):
            true = quantile(argument)
            assert abs(value - true) <= 3e-15 * abs(true), argument


def formula(x, y):
    """Products that a compiler contracts into sums, and quotients that it turns into products."""
    s = x * y
    return (
        s * (s + s - 1) / 3.7 - x * x * y / (y + 0.3),
        jnp.exp(-x) * y + jnp.cos(x * y) - x**y,
        # constants that would be taken together
        ((x + 1e9) - 1e9) * y + (x * 0.1) * 0.7,
    )


def test_compiled_and_operation_by_operation_agree_to_the_last_bit():
    rng = np.random.default_rng(1)
    x, y = (jnp.asarray(rng.uniform(0.1, 3, 4001)) for _ in range(2))
    ours = jax.jit(lambda x, y, zero: reproducible(formula, zero)(x, y))
    # on a CPU: on a GPU, XLA multiplies by the reciprocal of a divisor that it knows, eagerly too
    with jax.disable_jit(), jax.default_device(jax.devices("cpu")[0]):
        eager = reproducible(formula, ZERO)(*map(np.asarray, (x, y)))
    for a, b in zip(ours(x, y, ZERO), eager, strict=True):
        assert np.array_equal(np.asarray(a), np.asarray(b))
    # the formula itself is one that compilers change
    compiled, plain = jax.jit(formula)(x, y)[0], formula(x, y)[0]
    assert not np.array_equal(np.asarray(compiled), np.asarray(plain))
