"""Formats and roles, against numpy's own casts, exact fractions and known tables; loss scaling."""

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
    check_scale,
    format_of,
    round_to,
    scaled_gradient,
    stochastic_round,
)
from mdnum.numerics.roles import ALL, PrecisionPolicy, RolePrecision


def test_the_table_says_what_the_dtypes_say():
    for name, dtype in ALL.items():
        form, info = FORMATS[name], ml_dtypes.finfo(dtype)
        assert form.largest == float(info.max)
        assert form.smallest_normal == float(info.smallest_normal)
        assert form.smallest_subnormal == float(info.smallest_subnormal)
        assert form.bits == info.bits
    assert FORMATS["tf32"].largest == (2 - 2.0**-10) * 2.0**127
    with pytest.raises(InputError, match=r"'fp8'.*float64, float32, tf32"):
        format_of("fp8")


FINITE = st.floats(-1e5, 1e5) | st.floats(-1e-4, 1e-4) | st.floats(-1e-7, 1e-7)
ROUND = {name: jax.jit(lambda x, name=name: round_to(x, name)) for name in FORMATS}
SCALED = jax.jit(scaled_gradient, static_argnums=0)


@pytest.mark.parametrize("name", ["float16", "bfloat16"])
@given(values=st.lists(FINITE.map(np.float32), min_size=20, max_size=20))
def test_rounding_is_that_of_the_libraries(name, values):
    x = np.array(values, np.float32)
    with np.errstate(over="ignore"):
        expected = x.astype(ALL[name]).astype(np.float64)
    assert np.array_equal(np.asarray(ROUND[name](jnp.asarray(x.astype(np.float64)))), expected)


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
    assert float(ROUND["bfloat16"](jnp.asarray(x))) == 1 + 2.0**-7
    assert float(np.float64(x).astype(np.float32).astype(ml_dtypes.bfloat16)) == 1.0


def test_the_ends_of_a_format():
    x = jnp.asarray([65504.0, 65519.9, 65520.0, -1e9, math.inf, 2.0**-24, 2.0**-25, 1.5 * 2.0**-25, math.nan])
    seen = np.asarray(ROUND["float16"](x))
    ends = [65504, 65504, math.inf, -math.inf, math.inf, 2.0**-24, 0, 2.0**-24, math.nan]
    assert np.array_equal(seen, ends, equal_nan=True)
    assert np.array_equal(np.asarray(ROUND["float64"](x)), np.asarray(x), equal_nan=True)
    assert np.signbit(float(ROUND["bfloat16"](jnp.asarray(-0.0))))


def test_stochastic_rounding_has_the_right_mean():
    x = jnp.asarray([1.0003, -0.7777, 3e-6, 1234.5678, 0.5])

    @jax.jit
    def drawn(key):
        return jax.vmap(lambda key: stochastic_round(x, "float16", key))(jax.random.split(key, 40_000))

    draws = np.asarray(drawn(jax.random.key(3)))
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
            moved = stochastic_round(total.astype(jnp.float64) + step, "float16", key)
            return moved.astype(jnp.float16), None

        return jax.lax.scan(add, jnp.asarray(0.5, jnp.float16), jax.random.split(key, 1000))[0]

    ends = [float(walk(jax.random.key(seed))) for seed in range(20)]
    assert float(ROUND["float16"](jnp.asarray(0.5 + step))) == 0.5
    assert abs(np.mean(ends) - (0.5 + 1000 * step)) < 0.01


def test_derivatives_go_straight_through():
    functions = (
        lambda x: round_to(x, "bfloat16"),
        lambda x: stochastic_round(x, "float16", jax.random.key(0)),
    )
    slopes = jax.jit(lambda x: [jax.grad(lambda x, f=f: jnp.sum(f(x) * 3))(x) for f in functions])
    assert np.array_equal(np.asarray(slopes(jnp.asarray([0.3, -2.7]))), [[3, 3]] * 2)


# --- loss scaling in float16 -----------------------------------------------------------------------------

X = np.array([0.9, 1.1, 2.3])


def loss(x):
    """Small gradients: among the subnormals of float16, or below them."""
    half = x.astype(jnp.float16)
    return jnp.mean(half * half) * jnp.asarray(3e-7, jnp.float16)


TRUE = 2 * X.astype(np.float16).astype(float) / 3 * float(np.float16(3e-7))


def test_without_scaling_the_gradient_is_quantized_and_with_it_restored():
    bare, scaled = (SCALED(loss, scale, jnp.asarray(X)) for scale in (1.0, 2.0**12))
    assert np.abs(np.asarray(bare.gradient) / TRUE - 1).max() > 0.1
    assert np.abs(np.asarray(scaled.gradient) / TRUE - 1).max() < 2e-3
    assert scaled.gradient.dtype == jnp.float64
    assert float(bare.value) == float(scaled.value) == float(loss(jnp.asarray(X)))


def test_scaling_by_a_power_of_two_changes_no_bit_of_a_wide_gradient():
    def wide(x):
        return jnp.sum(jnp.sin(x) ** 3)

    plain = jax.jit(jax.grad(wide))(jnp.asarray(X))
    assert np.array_equal(np.asarray(SCALED(wide, 2.0**15, jnp.asarray(X)).gradient), np.asarray(plain))


@pytest.mark.parametrize(("exponent", "finite"), [(9, True), (10, False)])
def test_a_scale_that_overflows_is_noticed(exponent, finite):
    def steep(x):
        return jnp.sum(x.astype(jnp.float16) * jnp.asarray(100.0, jnp.float16)).astype(jnp.float16)

    # 100 * 2^10 overflows 65504, 100 * 2^9 does not
    assert bool(SCALED(steep, 2.0**exponent, jnp.asarray(X)).finite) is finite


@pytest.mark.parametrize("scale", [1000.0, 0.0, -2.0, math.inf, math.nan])
def test_factors_that_are_not_exact_are_refused(scale):
    with pytest.raises(InputError, match=f"^the scale .* {scale:g}, .*power"):
        check_scale(scale)
    check_scale(2.0**-30)


# --- which dtype a role has, and what is refused ----------------------------------------------------------


def test_every_role_can_have_its_own_dtype_and_no_other():
    policy = RolePrecision("float16", "bfloat16", "float32", "float64", "float16")
    seen = [policy.dtype(role) for role in ("state", "arithmetic", "decision", "accumulate", "loss")]
    assert seen == [np.float16, ml_dtypes.bfloat16, np.float32, np.float64, np.float16]
    assert RolePrecision.all("bfloat16") == RolePrecision(*["bfloat16"] * 5)
    for wrong, message in (
        ({"decision": "half"}, r"precision\.decision.*'half'.*Choose from.*bfloat16"),
        ({"rounding": "up"}, r"precision\.rounding.*'up'.*nearest, stochastic"),
        ({"seed": -1}, r"precision\.seed"),
    ):
        with pytest.raises(InputError, match=message):
            RolePrecision(**wrong)


def test_sixteen_bits_are_for_pair_forces_alone():
    assert PrecisionPolicy(state="float32").dtype("state") == np.float32
    short = PrecisionPolicy(decision="float32", force="bfloat16")
    assert short.dtype("force") == ml_dtypes.bfloat16 and short.geometry == np.float32
    assert PrecisionPolicy(decision="float64", force="float32").geometry == np.float32
    for role in ("state", "decision", "accumulate"):
        with pytest.raises(InputError, match=rf"precision\.{role}.*cannot be bfloat16.*precision.force"):
            PrecisionPolicy(**{role: "bfloat16"})
    with pytest.raises(InputError, match=r"precision\.force.*'half'.*Choose from.*bfloat16"):
        PrecisionPolicy(force="half")
