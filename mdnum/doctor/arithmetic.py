"""Is the arithmetic what mdnum's rounding bounds assume, and which liberties does the compiler take?

Bounds and margins rest on +, -, *, / and sqrt being correctly rounded, one by one, and on no sum being
reordered. XLA keeps that on CPUs but also contracts a*b+c and rewrites divisions by constants: each
changes last bits legitimately, so two builds may decide a margin within its bound differently.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mdnum.precision  # noqa: F401 (turns on float64)
from mdnum.doctor.rows import Row

# beyond 16,384 elements XLA splits work between threads, by other code paths
_COUNT = 20_011
_FUNCTION_ULPS = 16


def _numbers(seed: int, dtype: Any = np.float64) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.5, 20.0, _COUNT).astype(dtype)


def _differing(a: Any, b: Any) -> int:
    return int(np.sum(np.asarray(a) != np.asarray(b)))


def float64() -> Row:
    """Double precision is on, and a double survives the way to the device, through jit and back."""
    third = np.float64(1) / 3
    values = np.array([third, np.pi, 1 + 2**-52, 8.5125, 1e300, -(2.0**-1000)])
    there = jnp.asarray(values)
    after = np.asarray(jax.jit(lambda x: x)(there))
    kept = after.dtype == np.float64 and after.tobytes() == values.tobytes()
    default = jnp.zeros(()).dtype
    literal = jnp.asarray(0.1).dtype
    if kept and default == literal == np.float64:
        return Row("float64", "ok", "on by default and kept through jit bit for bit")
    return Row(
        "float64",
        "unsafe",
        f"default {default}, a Python float becomes {literal}, a double comes back as {after.dtype}"
        f" {'unchanged' if kept else 'changed'}",
        "Remove JAX_ENABLE_X64 and other jax settings from the environment; on a device without"
        " float64 set JAX_PLATFORMS=cpu",
    )


def elementwise() -> Row:
    """Basic operations under jit and eagerly against numpy, bit for bit, in both precisions."""
    operations: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
        "add": (jnp.add, np.add),
        "subtract": (jnp.subtract, np.subtract),
        "multiply": (jnp.multiply, np.multiply),
        "divide": (jnp.divide, np.divide),
        "sqrt": (lambda a, b: jnp.sqrt(a), lambda a, b: np.sqrt(a)),
        "round": (lambda a, b: jnp.round(a), lambda a, b: np.round(a)),
        "floor": (lambda a, b: jnp.floor(a), lambda a, b: np.floor(a)),
        "less": (jnp.less, np.less),
    }
    wrong = []
    for dtype in (np.float64, np.float32):
        a, b = _numbers(1, dtype), _numbers(2, dtype)
        for name, (ours, reference) in operations.items():
            expected = reference(a, b)
            for mode, function in (("jit", jax.jit(ours)), ("eager", ours)):
                count = _differing(function(jnp.asarray(a), jnp.asarray(b)), expected)
                if count:
                    wrong.append(f"{name} {np.dtype(dtype).name} {mode}: {count} of {_COUNT}")
    if not wrong:
        names = ", ".join(operations)
        return Row("jit = eager = numpy", "ok", f"{names}: every bit, float64 and float32")
    return Row(
        "jit = eager = numpy",
        "unsafe",
        "; ".join(wrong),
        "Rounding bounds do not hold on this device or with these XLA_FLAGS; unset XLA_FLAGS or set"
        " JAX_PLATFORMS=cpu",
    )


def functions() -> Row:
    """exp, log, cos and power against numpy, in units in the last place."""
    a, b = _numbers(3), _numbers(4) / 10
    pairs: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
        "exp": (lambda a, b: jnp.exp(-a), lambda a, b: np.exp(-a)),
        "log": (lambda a, b: jnp.log(a), lambda a, b: np.log(a)),
        "cos": (lambda a, b: jnp.cos(a) + 2.0, lambda a, b: np.cos(a) + 2.0),
        "power": (jnp.power, np.power),
    }
    ulps = {}
    for name, (ours, reference) in pairs.items():
        expected = reference(a, b)
        got = np.asarray(jax.jit(ours)(jnp.asarray(a), jnp.asarray(b)))
        ulps[name] = float(np.max(np.abs(got - expected) / np.spacing(np.abs(expected))))
    seen = "largest distance to numpy in ulps: " + ", ".join(f"{k} {v:.3g}" for k, v in ulps.items())
    if all(value <= _FUNCTION_ULPS for value in ulps.values()):
        return Row("functions", "ok", seen)
    return Row(
        "functions",
        "unsafe",
        seen,
        "Potentials with exponentials (Morse, Tersoff, Stillinger-Weber) are wrong here; unset XLA_FLAGS",
    )


def reassociation() -> Row:
    """Sums keep their order: (x + c) - c is not folded and an error-free transformation is exact."""
    x, c = _numbers(5) * 1e-3, np.full(_COUNT, 1e3)

    def two_sum(a: Any, b: Any) -> tuple[Any, Any]:
        s = a + b
        t = s - a
        return s, (a - (s - t)) + (b - t)

    expected = [*two_sum(x, c), (x + c) - c]
    s, e = jax.jit(two_sum)(jnp.asarray(x), jnp.asarray(c))
    folded = jax.jit(lambda a, b: (a + b) - b)(jnp.asarray(x), jnp.asarray(c))
    counts = [_differing(a, b) for a, b in zip((s, e, folded), expected, strict=True)]
    nan = bool(jax.jit(lambda a: jnp.any(a != a))(jnp.asarray([1.0, np.nan])))
    if not any(counts) and nan:
        return Row("order of sums", "ok", "kept; TwoSum is exact under jit, and NaN is seen")
    return Row(
        "order of sums",
        "unsafe",
        f"TwoSum differs in {counts[0]} sums and {counts[1]} errors, (x + c) - c in {counts[2]} of {_COUNT},"
        f" NaN {'is' if nan else 'is not'} seen",
        "Something turned on fast math; remove xla_cpu_enable_fast_math from XLA_FLAGS",
    )


def contraction() -> Row:
    """Whether a*b + c is contracted to one rounding under jit."""
    a, b, c = _numbers(6), _numbers(7), -_numbers(8)
    count = _differing(jax.jit(lambda a, b, c: a * b + c)(*map(jnp.asarray, (a, b, c))), a * b + c)
    if count == 0:
        return Row("fused multiply-add", "ok", "a*b + c is rounded twice, as written")
    return Row(
        "fused multiply-add",
        "info",
        f"jit contracts a*b + c: {count} of {_COUNT} results differ from two roundings. Legitimate, and"
        " inside mdnum's bounds, but a CPU without FMA gets other bits",
    )


def constant_division() -> Row:
    """Whether x / constant becomes x * (1 / constant), and (x*c)*d becomes x*(c*d)."""
    x = _numbers(9)
    divided = _differing(jax.jit(lambda x: x / 3.0)(jnp.asarray(x)), x / 3.0)
    folded = _differing(jax.jit(lambda x: (x * 0.1) * 0.7)(jnp.asarray(x)), (x * 0.1) * 0.7)
    if divided == 0 and folded == 0:
        return Row("division by a constant", "ok", "computed as written")
    return Row(
        "division by a constant",
        "info",
        f"x / 3.0 differs from IEEE division in {divided} of {_COUNT} (a multiplication by 1/3.0),"
        f" (x * 0.1) * 0.7 in {folded} (constants folded); the minimum image is affected in its last bit",
    )


def subnormals() -> Row:
    """Whether numpy and jax keep numbers below 2.2e-308, or flush them to zero.

    XLA flushes them on CPUs, and a library that is loaded can have the processor do so for everything. Asked
    by computing with them, in the size at which XLA's own threads work too; compared as integers, because a
    processor that takes them for zero calls them equal to it.
    """

    def power(exponent: int, count: int) -> np.ndarray:
        # from its bits, and an argument: nothing here can be folded before it is computed
        bits = 1023 + exponent << 52 if exponent > -1023 else 1 << exponent + 1074
        return np.full(count, bits, np.int64).view(np.float64)

    def word(multiply: Callable[..., Any]) -> str:
        for count in (8, _COUNT):
            # a result that is subnormal, and an argument that is
            for a, b in ((-1000, -60), (-1060, 60)):
                made = np.asarray(multiply(power(a, count), power(b, count)))
                if not np.array_equal(made.view(np.int64), power(a + b, count).view(np.int64)):
                    return "flushed to zero"
        return "kept"

    jitted = jax.jit(lambda a, b: a * b)
    numpy, xla = word(np.multiply), word(lambda a, b: jitted(jnp.asarray(a), jnp.asarray(b)))
    return Row("subnormal numbers", "info", f"{numpy} by numpy, {xla} by jax")
