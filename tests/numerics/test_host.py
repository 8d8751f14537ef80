"""Formulas by numpy, operation by operation, beside jax's own."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.numerics import host
from mdnum.numerics.host import by_numpy

WEIGHTS = np.random.default_rng(0).normal(size=(2, 5, 5))


def network(r):
    h = r[..., None] * np.arange(1.0, 6.0)
    for one in WEIGHTS:
        h = jnp.tanh(h @ one)
    return jnp.sum(h, -1)


FUNCTIONS = [
    network,
    lambda r: jnp.where(r < 2, jnp.exp(-r), jnp.abs(r - 3) ** 2.5) + jax.scipy.special.erfc(r) / r,
    lambda r: jax.nn.softplus(r) + jnp.clip(r, 1.2, 2.5) ** 3 + jnp.cbrt(r) + jax.nn.sigmoid(r) + r**-6,
    lambda r: jnp.maximum(r, 2.0) + jnp.min(jnp.stack([r, r * r]), 0) + jax.lax.rsqrt(r),
    lambda r: jnp.interp(r, jnp.linspace(0, 4, 9), jnp.arange(9.0)),
]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_values_and_slopes_are_those_of_jax(function):
    r = np.linspace(1, 3, 40) + 0.00123

    def both(r):
        return jax.jvp(function, (r,), (jnp.ones_like(r),))

    for mine, theirs in zip(by_numpy(both, r), both(jnp.asarray(r)), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-13)


def test_nothing_is_compiled(monkeypatch):
    """A formula of elementary functions never comes to jax."""
    monkeypatch.setattr(host, "bound", lambda *_: pytest.fail("jax is asked"))
    by_numpy(lambda r: jax.jvp(network, (r,), (jnp.ones_like(r),)), np.linspace(1, 3, 9))
