"""Elementary functions against mpmath, and programs that have the same bits compiled and not."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from mdnum.numerics import reproducible as elementary
from mdnum.numerics.exact import zero_bits
from mdnum.numerics.reproducible import reproducible

ZERO = zero_bits(np.float64)


def quantile(u: float):
    """sqrt(2) erf⁻¹(u) in 40 digits."""
    return mpmath.sqrt(2) * mpmath.erfinv(mpmath.mpf(u))


CASES = {
    "exp": (elementary.exp, mpmath.exp, (-700.0, 700.0), 4e-16),
    "log": (elementary.log, mpmath.log, (1e-300, 1e300), 4e-16),
    "cos": (lambda x, zero: elementary.cos_sin(x, zero)[0], mpmath.cos, (-20.0, 20.0), None),
    "sin": (lambda x, zero: elementary.cos_sin(x, zero)[1], mpmath.sin, (-20.0, 20.0), None),
    "normal_quantile": (elementary.normal_quantile, quantile, (-1 + 1e-15, 1 - 1e-15), 3e-15),
}


@pytest.mark.parametrize("name", CASES)
def test_errors_are_as_documented(name):
    ours, exact, (low, high), relative = CASES[name]
    rng = np.random.default_rng(0)
    x = np.exp(rng.uniform(np.log(low), np.log(high), 400)) if name == "log" else rng.uniform(low, high, 400)
    x[:2] = low, high
    got = np.asarray(jax.jit(ours)(jnp.asarray(x), ZERO))
    with mpmath.workdps(40):
        for argument, value in zip(x.tolist(), got.tolist(), strict=True):
            true = exact(mpmath.mpf(argument))
            allowed = 1e-15 if relative is None else relative * abs(true)
            assert abs(value - true) <= allowed, argument


def test_limits():
    x = jnp.asarray([-800.0, 800.0, np.inf, -np.inf, np.nan])
    seen = np.asarray(elementary.exp(x, ZERO))
    assert np.array_equal(seen, np.array([0, np.inf, np.inf, 0, np.nan]), equal_nan=True)
    assert np.isnan(np.asarray(elementary.log(jnp.asarray([0.0, -1.0]), ZERO))).all()


def formula(x, y):
    """Products that a compiler contracts into sums, and quotients that it turns into products."""
    s = x * y
    return s * (s + s - 1) / 3.7 - x * x * y / (y + 0.3), jnp.exp(-x) * y + jnp.cos(x * y) - x**y


def test_compiled_and_operation_by_operation_agree_to_the_last_bit():
    rng = np.random.default_rng(1)
    x, y = (jnp.asarray(rng.uniform(0.1, 3, 4001)) for _ in range(2))
    ours = jax.jit(lambda x, y, zero: reproducible(formula, zero)(x, y))
    with jax.disable_jit():
        eager = reproducible(formula, ZERO)(x, y)
    for a, b in zip(ours(x, y, ZERO), eager, strict=True):
        assert np.array_equal(np.asarray(a), np.asarray(b))
    # the formula itself is one that compilers change
    compiled, plain = jax.jit(formula)(x, y)[0], formula(x, y)[0]
    assert not np.array_equal(np.asarray(compiled), np.asarray(plain))
