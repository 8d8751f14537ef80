"""Elementary functions against many digits, and their bits in numpy, in XLA and in the compiled loop."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import llvmlite.binding as llvm
import mpmath
import numpy as np
import pytest
from by_numpy import by_numpy
from devices import on_cpu
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from mdnum.md import kernel
from mdnum.md.decide import Tables
from mdnum.numerics.elementary import FUNCTIONS
from mdnum.numerics.exact import reproducible, zero_bits

# by name: in many digits, least and greatest argument, largest error in ulps
CASES = {
    "exp": (mpmath.exp, (-708.3, 709.78), 1.5),
    "expm1": (mpmath.expm1, (-745.0, 709.78), 4.0),
    "logistic": (lambda x: 1 / (1 + mpmath.exp(-x)), (-708.3, 745.0), 4.0),
    "tanh": (mpmath.tanh, (-400.0, 400.0), 4.0),
    "log": (mpmath.log, (2.0**-1022, 1.7e308), 3.0),
    "log1p": (mpmath.log1p, (-1 + 2.0**-53, 1.7e308), 4.0),
    "erf": (mpmath.erf, (-30.0, 30.0), 6.0),
    "erfc": (mpmath.erfc, (-30.0, 26.5), 12.0),
}
LEAST = 2.0**-1022
SPECIAL = [0.0, -0.0, 1.0, -1.0, math.inf, -math.inf, math.nan, 800.0, -800.0, 1e300, -1e300]


def off(value: float, true: mpmath.mpf) -> float:
    """The error in ulps of a result, of a normal one."""
    spacing = math.ulp(float(true)) if abs(true) >= LEAST else LEAST
    return float(abs(mpmath.mpf(value) - true) / spacing) if math.isfinite(value) else math.inf


def drawn(seed: int, low: float, high: float, count: int) -> np.ndarray:
    """Of a common size, of any size, and uniform."""
    rng = np.random.default_rng(seed)
    small, large = rng.uniform(max(low, -4), min(high, 4), count), rng.uniform(low, high, count)
    scale = np.exp2(rng.uniform(-60, np.log2(high), count)) * rng.choice([-1, 1], count)
    one = np.concatenate([small, scale, large, [low, high]])
    return one[(one >= low) & (one <= high) & (np.abs(one) >= LEAST)]


@pytest.mark.parametrize("name", CASES)
def test_errors_are_within_the_bounds_of_the_documentation(name):
    true, (low, high), most = CASES[name]

    @given(st.integers(0, 2**32))
    @settings(max_examples=5)
    def check(seed):
        points = drawn(seed, low, high, 25)
        if seed == 0:
            # where the argument is reduced to another power of 2
            halves = 0.5 * math.log(2) * np.array([1, 1 - 2**-52, 1 + 2**-52, -1, 3, -3])
            points = np.concatenate([points, halves[halves > low], np.sqrt(2.0) * np.array([0.5, 1.0])])
        found = by_numpy(FUNCTIONS[name], points)
        with mpmath.workdps(50):
            errors = [off(float(a), true(mpmath.mpf(float(x)))) for a, x in zip(found, points, strict=True)]
        assert max(errors) < most, points[int(np.argmax(errors))]

    check()


@given(st.integers(0, 2**32))
@settings(max_examples=8)
def test_errors_of_powers_grow_with_the_exponent(seed):
    bases, exponents = np.abs(drawn(seed, LEAST, 1.7e308, 20)), drawn(seed + 1, -600.0, 600.0, 30)
    bases = np.resize(bases, len(exponents))
    bases = np.where(np.abs(exponents) > 4, 0.7 + 0.7 * (bases % 1.0), bases)
    found = by_numpy(FUNCTIONS["pow"], bases, exponents)
    with mpmath.workdps(60):
        for x, y, value in zip(bases.tolist(), exponents.tolist(), found.tolist(), strict=True):
            true = mpmath.mpf(x) ** mpmath.mpf(y)
            if LEAST * 1.001 < true < 1.7976e308:
                assert off(value, true) < 1.5 + abs(y) / 40, (x, y)
    # of negative numbers for whole exponents only
    whole = np.rint(exponents)
    signs, sized = np.where(whole % 2 == 1, -1.0, 1.0), by_numpy(FUNCTIONS["pow"], bases, whole)
    assert np.array_equal(by_numpy(FUNCTIONS["pow"], -bases, whole), signs * sized)
    assert np.isnan(by_numpy(FUNCTIONS["pow"], -bases, np.full(len(bases), 0.5))).all()


@given(st.integers(0, 2**32))
@settings(max_examples=5)
def test_cosine_and_sine_are_absolutely_right(seed):
    points = drawn(seed, -8e5, 8e5, 30)
    for name, true in (("cos", mpmath.cos), ("sin", mpmath.sin)):
        found = by_numpy(FUNCTIONS[name], points)
        with mpmath.workdps(50):
            errors = [
                abs(a - true(mpmath.mpf(x))) for a, x in zip(found.tolist(), points.tolist(), strict=True)
            ]
        assert max(errors) < 2.5e-16
    assert np.isnan(by_numpy(FUNCTIONS["cos"], np.array([9e5, -math.inf, math.nan]))).all()


@pytest.mark.parametrize("name", [*CASES, "pow", "max", "min", "sign"])
def test_special_numbers_are_those_of_jax(name):
    x = np.array(SPECIAL)
    given = (x,) if name in {*CASES, "sign"} else tuple(map(np.ravel, np.meshgrid(x, [*x, 2.0, -3.0, 0.5])))
    if name == "pow":
        # an odd power of -0 would be -0 or its inverse, and no distance is that
        given = tuple(one[~(np.signbit(given[0]) & (np.abs(given[0]) < 1e-3))] for one in given)
    found = by_numpy(FUNCTIONS[name], *given)
    known = np.asarray(getattr(lax, name)(*map(jnp.asarray, given)))
    if name == "pow":
        finite = np.isfinite(given[0])
        found, known = found[finite | (given[0] > 0)], known[finite | (given[0] > 0)]
    np.testing.assert_allclose(found, known, rtol=1e-13)


def test_subnormal_arguments_count_as_zero():
    tiny, zero = np.array([1e-310, -1e-310]), np.zeros(2)
    assert np.array_equal(by_numpy(FUNCTIONS["log"], tiny), [-math.inf] * 2)
    for y in (2.0, -0.5, 0.0):
        y = np.full(2, y)
        seen, known = (by_numpy(FUNCTIONS["pow"], np.abs(x), y) for x in (tiny, zero))
        assert np.array_equal(seen, known)


def formula(name: str):
    """A function of one number, and arguments that it is tried at."""
    rng = np.random.default_rng(7)
    high = {"exp": 700.0, "log": 1e9, "pow": 50.0}.get(name, 6.0)
    low = 1e-6 if name in ("log", "pow", "rsqrt") else -0.99 if name == "log1p" else -high
    x = np.concatenate([rng.uniform(low, high, 1200), rng.uniform(max(low, -1), 1, 800)])
    function = FUNCTIONS[name]
    return (lambda x: function(x, 1.7)) if name == "pow" else function, x


NAMES = [*CASES, "pow", "cos", "sin"]
PROCESSORS = {"x86-64-v2": "sse4.2", "x86-64-v3": "avx2", "x86-64-v4": "avx512f"}


@on_cpu
def test_every_instruction_set_has_the_bits_of_numpy(monkeypatch):
    """Those with and without fused multiply-add, compiled in one process; vectors of eight and the rest."""
    known = llvm.get_host_cpu_features()
    processors = [name for name, feature in PROCESSORS.items() if known.get(feature)]
    x = {name: formula(name)[1] for name in NAMES}
    columns = jnp.asarray(np.array(list(x.values()))[:, :-3])
    atoms = columns.shape[1]
    # each atom is its own neighbor, once
    index = np.full((1, 8, atoms), atoms, np.int32)
    index[0, 0] = np.arange(atoms)
    tables = Tables(jnp.asarray(index), None, jnp.arange(atoms))

    def pair(own, other, types):
        return [jnp.where(b == b, formula(name)[0](b), 0.0) for name, b in zip(NAMES, other, strict=True)]

    registered = kernel._registered
    for cpu in ["", *processors]:
        monkeypatch.setattr(kernel, "_registered", partial(registered, cpu=cpu))
        made = jax.jit(lambda columns: kernel.over_pairs(pair, columns, tables).sums)(columns)
        for name, row, numbers in zip(NAMES, np.asarray(made), np.asarray(columns), strict=True):
            assert np.array_equal(row, 0.0 + by_numpy(formula(name)[0], numbers)), (cpu, name)
    assert len(processors) == 3 or not known.get("avx512f")


@pytest.mark.parametrize("name", NAMES)
def test_fixed_point_runs_have_the_bits_of_numpy(name):
    """XLA contracts products into sums and takes constants together, were it not kept from it."""
    function, x = formula(name)
    if name == "pow":
        compiled = jax.jit(lambda x, zero: reproducible(lambda x: x**1.7, zero)(x))
    else:
        compiled = jax.jit(lambda x, zero: reproducible(getattr(lax, name), zero)(x))
    assert np.array_equal(np.asarray(compiled(jnp.asarray(x), zero_bits(np.float64))), by_numpy(function, x))
