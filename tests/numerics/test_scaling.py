"""Loss scaling in float16, against the gradient in float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.errors import InputError, NumericalError
from mdnum.numerics.scaling import DynamicScale, StaticScale

X = np.array([0.9, 1.1, 2.3])


def loss(x):
    """Small gradients: among the subnormals of float16, or below them."""
    half = x.astype(jnp.float16)
    return jnp.mean(half * half) * jnp.asarray(3e-7, jnp.float16)


TRUE = 2 * X.astype(np.float16).astype(float) / 3 * float(np.float16(3e-7))


def test_without_scaling_the_gradient_is_quantized_and_with_it_restored():
    bare = StaticScale(1.0).value_and_grad(loss, jnp.asarray(X))
    scaled = StaticScale(2.0**12).value_and_grad(loss, jnp.asarray(X))
    assert np.abs(np.asarray(bare.gradient) / TRUE - 1).max() > 0.1
    assert np.abs(np.asarray(scaled.gradient) / TRUE - 1).max() < 2e-3
    assert scaled.gradient.dtype == jnp.float64
    assert float(bare.value) == float(scaled.value) == float(loss(jnp.asarray(X)))


def test_scaling_by_a_power_of_two_changes_no_bit_of_a_wide_gradient():
    def wide(x):
        return jnp.sum(jnp.sin(x) ** 3)

    plain = jax.grad(wide)(jnp.asarray(X))
    scaled = StaticScale().value_and_grad(wide, jnp.asarray(X)).gradient
    assert np.array_equal(np.asarray(scaled), np.asarray(plain))


def steep(x):
    return jnp.sum(x.astype(jnp.float16) * jnp.asarray(100.0, jnp.float16)).astype(jnp.float16)


def test_a_dynamic_scale_skips_halves_and_grows():
    rule = DynamicScale(initial=2.0**12, interval=3)
    state, step = rule.start(), jax.jit(lambda state, x: rule.value_and_grad(state, steep, x))
    seen = []
    for _ in range(12):
        scale = float(state.scale)
        result, state = step(state, jnp.asarray(X))
        seen.append((scale, bool(result.finite)))
        if bool(result.finite):
            assert np.array_equal(np.asarray(result.gradient), [100, 100, 100])
    # 100 * 2^10 overflows 65504, 100 * 2^9 does not
    assert seen[:6] == [(4096, False), (2048, False), (1024, False), (512, True), (512, True), (512, True)]
    assert seen[6:] == [(1024, False), (512, True), (512, True), (512, True), (1024, False), (512, True)]
    assert int(state.skipped) == 5


def test_settling_finds_the_largest_factor_that_is_finite():
    result, state = DynamicScale().settle(steep, jnp.asarray(X))
    assert float(result.scale) == 512 == float(state.scale)
    low, _ = DynamicScale(initial=1.0).settle(steep, jnp.asarray(X))
    assert float(low.scale) == 512
    tiny, _ = DynamicScale().settle(loss, jnp.asarray(X))
    assert np.abs(np.asarray(tiny.gradient) / TRUE - 1).max() < 2e-3


def test_a_gradient_that_is_never_finite_is_said():
    with pytest.raises(NumericalError, match="not finite even with a scale of 1"):
        DynamicScale().settle(lambda x: jnp.sum(jnp.sqrt(x - x)), jnp.asarray(X))


def test_factors_that_are_not_exact_are_refused():
    with pytest.raises(InputError, match="scale 1000 is not a power of two"):
        StaticScale(1000.0)
    with pytest.raises(InputError, match="outside"):
        DynamicScale(initial=2.0**30)
    with pytest.raises(InputError, match="interval of 0"):
        DynamicScale(interval=0)
