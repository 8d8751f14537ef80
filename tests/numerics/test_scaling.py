"""Loss scaling in float16, against the gradient in float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.numerics.scaling import check_scale, scaled_gradient

X = np.array([0.9, 1.1, 2.3])


def loss(x):
    """Small gradients: among the subnormals of float16, or below them."""
    half = x.astype(jnp.float16)
    return jnp.mean(half * half) * jnp.asarray(3e-7, jnp.float16)


TRUE = 2 * X.astype(np.float16).astype(float) / 3 * float(np.float16(3e-7))


def test_without_scaling_the_gradient_is_quantized_and_with_it_restored():
    bare, scaled = (scaled_gradient(loss, scale, jnp.asarray(X)) for scale in (1.0, 2.0**12))
    assert np.abs(np.asarray(bare.gradient) / TRUE - 1).max() > 0.1
    assert np.abs(np.asarray(scaled.gradient) / TRUE - 1).max() < 2e-3
    assert scaled.gradient.dtype == jnp.float64
    assert float(bare.value) == float(scaled.value) == float(loss(jnp.asarray(X)))


def test_scaling_by_a_power_of_two_changes_no_bit_of_a_wide_gradient():
    def wide(x):
        return jnp.sum(jnp.sin(x) ** 3)

    plain = jax.grad(wide)(jnp.asarray(X))
    assert np.array_equal(
        np.asarray(scaled_gradient(wide, 2.0**15, jnp.asarray(X)).gradient), np.asarray(plain)
    )


@pytest.mark.parametrize(("exponent", "finite"), [(9, True), (10, False)])
def test_a_scale_that_overflows_is_noticed(exponent, finite):
    def steep(x):
        return jnp.sum(x.astype(jnp.float16) * jnp.asarray(100.0, jnp.float16)).astype(jnp.float16)

    # 100 * 2^10 overflows 65504, 100 * 2^9 does not
    assert bool(scaled_gradient(steep, 2.0**exponent, jnp.asarray(X)).finite) is finite


@pytest.mark.parametrize("scale", [1000.0, 0.0, -2.0, float("inf"), float("nan")])
def test_factors_that_are_not_exact_are_refused(scale):
    with pytest.raises(InputError, match="is not a power of two"):
        check_scale(scale)
    check_scale(2.0**-30)
