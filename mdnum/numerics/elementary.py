"""Elementary functions made of IEEE 754 operations, with the same results on all machines.

The elementary functions of libraries differ between versions and instruction sets. The functions here have no
branch, no table and no fused multiply-add. Each function consists of sums, products, quotients, roots,
comparisons, selections and bit operations. A function gives the same result wherever its operations are
executed one by one.

Arguments and results are float64. Subnormal arguments are treated as 0. Results below 2.2261e-308 are 0.
Exponentials and powers above 1.7976e308 are infinite. Errors are in ulps (spacing of the floats at the
result). The error bound of the exponential was derived by counting roundings. Every other bound is at least
1.3 times the largest measured error. Errors were measured for ten million arguments, and for 100,000 of error
functions (docs/compiled-loop.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr

# ln 2 and π/2 in two parts; the first has zeros at its end, so that a small integer times it is exact
_LN2 = (float.fromhex("0x1.62e42fee00000p-1"), float.fromhex("0x1.a39ef35793c76p-33"))
_HALF_PI = (float.fromhex("0x1.921fb54400000p+0"), float.fromhex("0x1.0b4611a626331p-34"))
_EXPONENT = 52
_MANTISSA = (1 << _EXPONENT) - 1
# bits of 1.0 and of 2^52, whose last bits count in ones
_ONE, _COUNT = 1023 << _EXPONENT, 1075 << _EXPONENT
# added to a number below 2^51 it rounds it to an integer, which the last bits then hold
_ROUND = 1.5 * 2.0**52
_TINY = 2.0**-1022
# below and above, an exponential is 0 and infinite
_LEAST, _GREATEST = -708.396, 709.7827
# beyond, whole multiples of π/2 are not exact
_FAR = 8e5


def _bits(x: Any) -> Any:
    return lax.bitcast_convert_type(x, jnp.int64)


def _number(bits: Any) -> Any:
    return lax.bitcast_convert_type(bits, jnp.float64)


def _short(x: Any) -> Any:
    """Return x truncated to 26 bits. The product of two such numbers is exact."""
    return _number(_bits(x) & -(1 << 27))


def _with_sign(of: Any, x: Any) -> Any:
    return jnp.where(of < 0, -x, x)


def polynomial(coefficients: Sequence[float], x: Any) -> Any:
    """Evaluate a polynomial by Horner's rule. Coefficients are in descending order."""
    total = coefficients[0] * x + coefficients[1]
    for c in coefficients[2:]:
        total = total * x + c
    return total


def _halved(coefficients: Sequence[Any], x: Any) -> Any:
    """Evaluate a polynomial by Estrin's scheme. Coefficients are in ascending order."""
    if len(coefficients) == 1:
        return coefficients[0]
    pairs = [a + b * x for a, b in zip(coefficients[::2], coefficients[1::2], strict=False)]
    return _halved(pairs + list(coefficients[2 * len(pairs) :]), x * x)


# (exp(r) - 1 - r) / r² for |r| <= ln(2)/2: Chebyshev interpolation, off by 1.6e-17 of the exponential
_EXP = (
    0.5000000000000001, 0.16666666666666669, 0.041666666666624164, 0.008333333333330065,
    0.0013888888917196881, 0.0001984126986304067, 2.4801521322116825e-05, 2.7557268480116333e-06,
    2.762007599981065e-07, 2.5100375924709717e-08,
)  # fmt: skip


def _reduced(x: Any, low: Any = None) -> tuple[Any, Any]:
    """Return p and n such that exp(x + low) = (1 + p) 2^n. n is in the last bits of the second result."""
    shifted = x * (1 / math.log(2)) + _ROUND
    n = shifted - _ROUND
    r = (x - n * _LN2[0]) - n * _LN2[1]
    r = r if low is None else r + low
    return r + r * r * _halved(_EXP, r), _bits(shifted)


def _scaled(x: Any, p: Any, n: Any) -> Any:
    """Return (1 + p) 2^n, given p and n that represent exp(x)."""
    value = _number(_bits(1.0 + p) + (n << _EXPONENT))
    return jnp.where(x < _LEAST, 0.0, jnp.where(x <= _GREATEST, value, x + math.inf))


def exp(x: Any, low: Any = None) -> Any:
    """Return the exponential of an argument that is the sum x + low. Error: below 1.5 ulp."""
    return _scaled(x if low is None else x + low, *_reduced(x, low))


def expm1(x: Any) -> Any:
    """Return exp(x) - 1. Error: below 4 ulp."""
    p, n = _reduced(x)
    power = _number((n << _EXPONENT) + _ONE)
    near = power * p + (power - 1.0)
    return jnp.where(x < -40, -1.0, jnp.where(x > 40, _scaled(x, p, n), near))


def logistic(x: Any) -> Any:
    """Return 1 / (1 + exp(-x)). Error: below 4 ulp."""
    return 1.0 / (1.0 + exp(-x))


def tanh(x: Any) -> Any:
    """Return the hyperbolic tangent. Error: below 4 ulp."""
    size = jnp.abs(x)
    e = expm1(2 * jnp.where(size > 20, 20.0, size))
    return _with_sign(x, e / (e + 2))


# (2 atanh(s) - 2 s) / s³ in powers of s²
_LOG = [2 / (2 * k + 1) for k in range(11, 0, -1)]


def _split(x: Any) -> tuple[Any, Any]:
    """Return n and m such that x = m 2^n, with m between √(1/2) and √2. x is a positive normal number."""
    bits = _bits(x)
    exponent = _number(lax.shift_right_logical(bits, np.int64(_EXPONENT)) | _COUNT) - (2.0**52 + 1023)
    m = _number((bits & _MANTISSA) | _ONE)
    large = m > math.sqrt(2)
    return jnp.where(large, exponent + 1, exponent), jnp.where(large, 0.5 * m, m)


def log(x: Any) -> Any:
    """Return the natural logarithm. Error: below 3 ulp."""
    n, m = _split(x)
    s = (m - 1) / (m + 1)
    square = s * s
    small = s * (polynomial(_LOG, square) * square) + (s + s)
    value = n * _LN2[0] + (small + n * _LN2[1])
    other = jnp.where(jnp.abs(x) < _TINY, -math.inf, math.nan)
    return jnp.where(x >= _TINY, jnp.where(x < math.inf, value, x), other)


def log1p(x: Any) -> Any:
    """Return log(1 + x). Error: below 4 ulp."""
    u = 1.0 + x
    # what the sum has lost
    rest = jnp.where((x > -1) & (x < 2.0**53), (x - (u - 1.0)) / u, 0.0)
    return log(u) + rest


def power(x: Any, y: Any) -> Any:
    """Return x**y, where y is an integer if x < 0. The error of x**y is below 1.5 + |y|/40 ulp."""
    size, huge = jnp.abs(x), 2.0**1000
    n, m = _split(size)
    # the logarithm in two parts: s and the sum that divides it lose what the second one has
    inverse = 1 / (m + 1)
    s, whole = (m - 1) * inverse, _short(m + 1)
    first = _short(s)
    second = (((m - 1) - first * whole) - first * (m - (whole - 1))) * inverse
    square = s * s
    lead, double = n * _LN2[0], first + first
    high = lead + double
    tail = s * (polynomial(_LOG, square) * square) + n * _LN2[1]
    low = ((lead - high) + double) + ((second + second) + tail)
    high, low = high + low, (high - (high + low)) + low
    y = jnp.where(y > huge, huge, jnp.where(y < -huge, -huge, y))
    short, y_short = _short(high), _short(y)
    value = exp(short * y_short, (y - y_short) * short + y * ((high - short) + low))
    zero = size < _TINY
    value = jnp.where(zero | (size >= math.inf), jnp.where(zero ^ (y > 0), math.inf, 0.0), value)
    integer, half = jnp.round(y) == y, 0.5 * y
    negative = jnp.where(integer, jnp.where(jnp.round(half) == half, value, -value), math.nan)
    value = jnp.where(x < 0, negative, jnp.where(x >= 0, jnp.where(y == y, value, y), x))
    return jnp.where((y == 0) | (x == 1), 1.0, value)


_COS = [(-1) ** k / math.factorial(2 * k) for k in range(8, -1, -1)]
_SIN = [(-1) ** k / math.factorial(2 * k + 1) for k in range(8, 0, -1)]


def cos_sin(x: Any) -> tuple[Any, Any]:
    """Return cosine and sine of x, or NaN if |x| exceeds 8e5. The absolute error of both is below 2.5e-16."""
    n = jnp.round(x * (2 / math.pi))
    r = (x - n * _HALF_PI[0]) - n * _HALF_PI[1]
    square = r * r
    c, s = polynomial(_COS, square), r * (polynomial(_SIN, square) * square) + r
    # the quarter, from -2 to 2
    quarter = n - 4 * jnp.round(0.25 * n)
    swap, negative = jnp.abs(quarter) == 1, (quarter < 0) | (quarter > 1)
    cosine, sine = jnp.where(swap, -s, c), jnp.where(swap, c, s)
    known = jnp.abs(x) <= _FAR
    cosine, sine = (jnp.where(known, jnp.where(negative, -one, one), math.nan) for one in (cosine, sine))
    return cosine, sine


# after Shepherd and Laframboise, Mathematics of Computation 36, 249 (1981): exp(z²) erfc(z) (K + z) / 2K in
# powers of (K - z) / (K + z), 0 <= z <= 26.7, Chebyshev interpolation, off by 1.0e-16 of it
_K = 3.5
_ERFC = (
    0.1552936556088943, 0.13397138922387314, 0.09915909237637781, 0.06217943238812671, 0.03224837452105712,
    0.01318838666264674, 0.003788374268833984, 0.00045386433461232955, -0.00018647924186923487,
    -0.00010207595493217573, -6.008879991399653e-06, 1.068244168812723e-05, 2.66388299537707e-06,
    -1.0348829458897832e-06, -4.845742799326001e-07, 1.1377272416274112e-07, 7.864801784286018e-08,
    -1.6593031116558224e-08, -1.1932630252347436e-08, 3.107946914232945e-09, 1.2930900412670003e-09,
    -4.712046012546798e-10,
)  # fmt: skip
# erf(z) / z in powers of z², z <= 1/2, likewise, off by 2.1e-17
_ERF = (
    1.4725865480556744e-06, -1.4845849259707869e-05, 0.00012053335124353741, -0.0008548297753674966,
    0.00522397737302147, -0.026866170632887928, 0.11283791670925353, -0.37612638903183476, 1.1283791670955126,
)  # fmt: skip


def _complement(z: Any) -> Any:
    """Return the complementary error function of non-negative numbers."""
    z = jnp.where(z > 28, 28.0, z)
    short = _short(z)
    inverse = 1 / (_K + z)
    falling = exp(-(short * short), (short - z) * (short + z))
    return falling * ((2 * _K) * inverse * _halved(_ERFC, (_K - z) * inverse))


def erfc(x: Any) -> Any:
    """Return the complementary error function. Error: below 12 ulp."""
    value = _complement(jnp.abs(x))
    return jnp.where(x < 0, 2.0 - value, value)


def erf(x: Any) -> Any:
    """Return the error function. Error: below 6 ulp."""
    size = jnp.abs(x)
    return jnp.where(size < 0.5, x * polynomial(_ERF, x * x), _with_sign(x, 1.0 - _complement(size)))


def _larger(x: Any, y: Any) -> Any:
    return jnp.where((x > y) | (x != x), x, y)


def _smaller(x: Any, y: Any) -> Any:
    return jnp.where((x < y) | (x != x), x, y)


#: Functions by the names of operations in jax.
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "exp": exp, "expm1": expm1, "logistic": logistic, "tanh": tanh, "log": log, "log1p": log1p, "pow": power,
    "cos": lambda x: cos_sin(x)[0], "sin": lambda x: cos_sin(x)[1], "erf": erf, "erfc": erfc,
    "max": _larger, "min": _smaller, "clamp": lambda low, x, high: _smaller(_larger(x, low), high),
    "sign": lambda x: jnp.where(x > 0, 1.0, jnp.where(x < 0, -1.0, x)),
}  # fmt: skip


def program(name: str, *shapes: tuple[int, ...]) -> ClosedJaxpr:
    """Return the jaxpr of the elementary function with a jax name, for given shapes."""
    return jax.make_jaxpr(FUNCTIONS[name])(*(jax.ShapeDtypeStruct(shape, np.float64) for shape in shapes))
