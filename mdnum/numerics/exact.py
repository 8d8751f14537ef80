"""Floating-point arithmetic inside jit whose results have the same bits on every processor.

XLA on a CPU contracts a*b + c into a fused multiply-add. With fused operations, bits depend on the processor
and differ from numpy. A cutoff decision must not depend on the compiler. `fence` prevents fused multiply-add,
so numpy reproduces the decisions. Formulas can also be rounded at every operation, or evaluated in interval
arithmetic.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from mdnum.numerics import elementary


def integer_of(dtype):
    """Return the signed integer type with the width of a float dtype."""
    return jnp.dtype(f"int{8 * np.dtype(dtype).itemsize}")


def zero_bits(dtype) -> jax.Array:
    """Return an integer zero with the width of dtype, for `fence`."""
    return jax.device_put(np.zeros((), integer_of(dtype)))


def _through_integers(x, zero):
    integer = integer_of(x.dtype)
    return lax.bitcast_convert_type(lax.bitcast_convert_type(x, integer) ^ zero.astype(integer), x.dtype)


@jax.custom_jvp
def fence(x: jax.Array, zero: jax.Array) -> jax.Array:
    """Return x. XLA cannot fuse the operations before and after the fence.

    The bits of x are combined (exclusive-or) with a zero unknown to XLA. The fence also forces rounding to
    float16 and bfloat16 on a CPU.

    XLA's optimization_barrier and reduce_precision do not prevent contraction (openxla/xla#41579).
    """
    return _through_integers(x, zero)


@fence.defjvp
def _fence_jvp(primals, tangents):
    x, zero = primals
    return _through_integers(x, zero), tangents[0]


def squared_norm(dx: jax.Array, dy: jax.Array, dz: jax.Array, zero: jax.Array) -> jax.Array:
    """Return dx² + dy² + dz² with the same bits as numpy.

    The relative error of r² is at most 3 u / (1 - 3 u) for exact dx, dy, dz (Higham 2002, 3.1).
    """
    return (fence(dx * dx, zero) + fence(dy * dy, zero)) + fence(dz * dz, zero)


def root(x: jax.Array) -> jax.Array:
    """Return the square root, correctly rounded on every device.

    On an H200 GPU, one float32 square root in six is wrong by one ulp. A float64 square root, rounded to
    float32, is correctly rounded (Figueroa 1995, "When is double rounding innocuous?").
    """
    if x.dtype != jnp.float32 or jax.default_backend() == "cpu":
        return jnp.sqrt(x)
    return jnp.sqrt(x.astype(jnp.float64)).astype(jnp.float32)


# --- programs, operation by operation -------------------------------------------------------------------

# what a function that is jitted by itself, as jnp.where is, looks like inside another
_CALLS = ("jit", "pjit")
#: Operations that call a program once, other than by compiling it.
_CALLED = ("closed_call", "core_call", "remat", "remat2", "checkpoint", "custom_jvp_call", "custom_vjp_call",
           "custom_vjp_call_jaxpr")  # fmt: skip
Rule = Callable[[Any, list[Any]], Sequence[Any]]


def _same(x: Any) -> Any:
    return x


def stepwise(
    function: Callable[..., Any],
    rule: Rule,
    enter: Callable[[Any], Any] = _same,
    leave: Callable[[Any], jax.Array] = _same,
) -> Callable[..., Any]:
    """Return a function in which a rule computes the result of each operation.

    Args:
        function: function of arrays, which may close over other arrays.
        rule: maps an equation of jax's program and its inputs to its outputs.
        enter: converts arguments, constants, and inputs and outputs of calls to the values of the rule.
        leave: converts a result of the rule to an array.
    """

    def run(*args: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        program, shape = jax.make_jaxpr(
            lambda *leaves: function(*jax.tree.unflatten(tree, leaves)), return_shape=True
        )(*leaves)
        results = [leave(x) for x in interpreted(program, leaves, rule, enter)]
        return jax.tree.unflatten(jax.tree.structure(shape), results)

    return run


def interpreted(
    program: Any, arguments: Sequence[Any], rule: Rule, enter: Callable[[Any], Any] = _same
) -> list[Any]:
    """Run a jaxpr with a rule for each operation, and return the results."""
    jaxpr, constants = (program.jaxpr, program.consts) if isinstance(program, ClosedJaxpr) else (program, ())
    known = dict(zip(jaxpr.constvars, map(enter, constants), strict=True))
    known.update(zip(jaxpr.invars, map(enter, arguments), strict=True))

    def value(atom: Any) -> Any:
        return enter(atom.val) if isinstance(atom, Literal) else known[atom]

    for equation in jaxpr.eqns:
        inputs = [value(atom) for atom in equation.invars]
        inner = equation.params.get("jaxpr")
        if equation.primitive.name in _CALLS and isinstance(inner, ClosedJaxpr):
            outputs = [enter(x) for x in interpreted(inner, inputs, rule, enter)]
        else:
            outputs = rule(equation, inputs)
        known.update(zip(equation.outvars, outputs, strict=True))
    return [value(atom) for atom in jaxpr.outvars]


def inlined(equation: Any) -> Any:
    """Return the jaxpr that an operation calls once, or None."""
    programs = (equation.params.get(key) for key in ("jaxpr", "call_jaxpr", "fun_jaxpr"))
    return next(filter(None, programs), None) if equation.primitive.name in _CALLED else None


def bound(equation: Any, inputs: Sequence[Any]) -> list[jax.Array]:
    """Return the results that jax computes for one equation of a jaxpr.

    Raises:
        TypeError: the equation contains another jaxpr, such as the body of a loop.
    """
    if any(isinstance(param, Jaxpr | ClosedJaxpr) for param in equation.params.values()):
        raise TypeError(f"{equation.primitive.name} is not an elementary operation")
    outputs = equation.primitive.bind(*inputs, **equation.params)
    return list(outputs) if equation.primitive.multiple_results else [outputs]


def rounded(function: Callable[..., Any], zero: jax.Array) -> Callable[..., Any]:
    """Return a function that rounds the result of every 16-bit operation.

    On a CPU, XLA computes 16-bit expressions in float32, and may omit roundings. In the returned function, a
    fence after each operation forces the rounding. For + - * / and sqrt, the bits are those of numpy with
    ml_dtypes. exp and cos are computed in float32 and may differ between libraries. Results that are not
    16-bit floats do not change.

    Args:
        function: function of arrays; it may close over others.
        zero: an integer zero that XLA must not know (`zero_bits`).
    """

    def rule(equation: Any, inputs: list[Any]) -> list[jax.Array]:
        outputs = bound(equation, inputs)
        return [fence(x, zero) if _is_short(x.dtype) else x for x in outputs]

    return stepwise(function, rule)


def _is_short(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jnp.floating) and np.dtype(dtype).itemsize == 2


def enclosed(function: Callable[..., Any], arguments: int) -> Callable[..., list[Any]]:
    """Return a float64 function in interval arithmetic. Each interval contains the exact value.

    Constants of the formula are treated as exact float64 numbers. If both branches of a `where` are possible,
    the result covers both branches.

    Args:
        function: function of scalars; jax traces it once.
        arguments: number of arguments; arguments and results are flint numbers.

    Raises:
        TypeError: on calling the function, for an operation without a counterpart here.
    """
    from flint import arb

    with jax.enable_x64(True):
        program = jax.make_jaxpr(function)(*[jnp.float64(1)] * arguments)

    def enter(x: Any) -> Any:
        if isinstance(x, arb | bool | None):
            return x
        number = np.asarray(x)
        return bool(number) if number.dtype == bool else arb(float(number))

    def rule(equation: Any, inputs: list[Any]) -> list[Any]:
        name = equation.primitive.name
        if (inner := inlined(equation)) is not None:
            return interpreted(inner, inputs, rule, enter)
        if name not in _IN_BALLS:
            raise TypeError(f"the operation {name} is not supported in exact arithmetic")
        return [_IN_BALLS[name](*inputs, **equation.params)]

    return lambda *balls: interpreted(program, balls, rule, enter)


def _method(name: str) -> Callable[..., Any]:
    return lambda a, *more, **_: getattr(a, name)(*more)


def _compare(yes: Callable[[Any, Any], bool], no: Callable[[Any, Any], bool]) -> Callable[..., bool | None]:
    return lambda a, b, **_: True if yes(a, b) else False if no(a, b) else None


def _both(a: bool | None, b: bool | None, **_: Any) -> bool | None:
    return False if a is False or b is False else None if a is None or b is None else True


def _not(a: bool | None) -> bool | None:
    return None if a is None else not a


_IN_BALLS: dict[str, Callable[..., Any]] = {
    **dict.fromkeys(("add", "add_any"), lambda a, b, **_: a + b),
    "sub": lambda a, b, **_: a - b,
    "mul": lambda a, b, **_: a * b,
    "div": lambda a, b, **_: a / b,
    "neg": lambda a, **_: -a,
    "abs": lambda a, **_: abs(a),
    **{name: _method(name) for name in (
        "sqrt", "rsqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tanh", "erf", "erfc",
    )},
    # one of both where that is proven, which `eq` sees: jax asks for it in their derivatives
    "max": lambda a, b, **_: a if a >= b else b if b >= a else a.max(b),
    "min": lambda a, b, **_: a if a <= b else b if b <= a else a.min(b),
    "logistic": lambda a, **_: 1 / (1 + (-a).exp()),
    "square": lambda a, **_: a * a,
    "pow": lambda a, b, **_: a**b,
    "integer_pow": lambda a, *, y, **_: a**y,
    **dict.fromkeys(
        ("convert_element_type", "broadcast_in_dim", "reshape", "squeeze", "copy", "stop_gradient"),
        lambda a, **_: a,
    ),
    # either case where the condition is not proven
    "select_n": lambda is_yes, no, yes, **_: no.union(yes) if is_yes is None else yes if is_yes else no,
    "and": _both,
    "or": lambda a, b, **_: _not(_both(_not(a), _not(b))),
    "not": lambda a, **_: _not(a),
    "eq": _compare(lambda a, b: a is b or a == b, operator.ne),
    "ne": _compare(operator.ne, lambda a, b: a is b or a == b),
    "gt": _compare(operator.gt, operator.le),
    "ge": _compare(operator.ge, operator.lt),
    "lt": _compare(operator.lt, operator.ge),
    "le": _compare(operator.le, operator.gt),
}  # fmt: skip


# --- programs that no compiler changes ------------------------------------------------------------------

# Wichura, Applied Statistics 37, 477 (1988), algorithm AS 241 (PPND16): numerators and denominators
_CENTER = (
    (2.5090809287301226727e3, 3.3430575583588128105e4, 6.7265770927008700853e4, 4.5921953931549871457e4,
     1.3731693765509461125e4, 1.9715909503065514427e3, 1.3314166789178437745e2, 3.3871328727963666080e0),
    (5.2264952788528545610e3, 2.8729085735721942674e4, 3.9307895800092710610e4, 2.1213794301586595867e4,
     5.3941960214247511077e3, 6.8718700749205790830e2, 4.2313330701600911252e1, 1.0),
)  # fmt: skip
_NEAR = (
    (7.74545014278341407640e-4, 2.27238449892691845833e-2, 2.41780725177450611770e-1,
     1.27045825245236838258e0, 3.64784832476320460504e0, 5.76949722146069140550e0, 4.63033784615654529590e0,
     1.42343711074968357734e0),
    (1.05075007164441684324e-9, 5.47593808499534494600e-4, 1.51986665636164571966e-2,
     1.48103976427480074590e-1, 6.89767334985100004550e-1, 1.67638483018380384940e0,
     2.05319162663775882187e0, 1.0),
)  # fmt: skip
_FAR = (
    (2.01033439929228813265e-7, 2.71155556874348757815e-5, 1.24266094738807843860e-3,
     2.65321895265761230930e-2, 2.96560571828504891230e-1, 1.78482653991729133580e0,
     5.46378491116411436990e0, 6.65790464350110377720e0),
    (2.04426310338993978564e-15, 1.42151175831644588870e-7, 1.84631831751005468180e-5,
     7.86869131145613259100e-4, 1.48753612908506148525e-2, 1.36929880922735805310e-1,
     5.99832206555887937690e-1, 1.0),
)  # fmt: skip


def normal_quantile(u: jax.Array, zero: jax.Array) -> jax.Array:
    """Return sqrt(2) erf⁻¹(u), a normal deviate for uniform u between -1 and 1.

    The relative error of the result is about 1e-15.
    """

    def ratio(parts, r):
        return elementary.polynomial(parts[0], r) / elementary.polynomial(parts[1], r)

    def quantile(u):
        q = 0.5 * u
        center = q * ratio(_CENTER, 0.180625 - q * q)
        r = jnp.sqrt(-elementary.log(0.5 * (1 - jnp.abs(u))))
        tail = jnp.where(r <= 5, ratio(_NEAR, r - 1.6), ratio(_FAR, r - 5))
        return jnp.where(jnp.abs(q) <= 0.425, center, jnp.where(q < 0, -tail, tail))

    return reproducible(quantile, zero)(u)


_SUMS = ("add", "sub")
# results that are not a product or quotient, nor a rearranged one
_SAFE = (
    "add", "sub", "sqrt", "abs", "max", "min", "round", "floor", "convert_element_type", "iota",
    "bitcast_convert_type",
)  # fmt: skip


@dataclass
class _Held:
    """A number in an interpreted jaxpr, with flags for fences."""

    value: Any
    safe: bool = True
    shared: bool = False
    folds: bool = False  # the sum or product with a constant, which a compiler takes together with another


def reproducible(function: Callable[..., Any], zero: jax.Array) -> Callable[..., Any]:
    """Return a float64 function whose results do not depend on compilation.

    Args:
        function: function of arrays; it may close over others.
        zero: an integer zero that XLA must not know (`mdnum.numerics.exact.zero_bits`).
    """

    def enter(x: Any) -> _Held:
        return _Held(x.value, x.safe, folds=x.folds) if isinstance(x, _Held) else _Held(x)

    def rule(equation: Any, inputs: list[_Held]) -> list[_Held]:
        name = equation.primitive.name
        if name in elementary.FUNCTIONS and _is_float(inputs[0].value):
            # as the compiled loop has them; a compiler's own differ between instruction sets
            inner = elementary.program(name, *(jnp.shape(x.value) for x in inputs))
            return interpreted(inner, inputs, rule, enter)
        folds = name in (*_SUMS, "mul") and any(isinstance(atom, Literal) for atom in equation.invars)
        for held in inputs:
            # what has been fenced once need not be again
            opaque = (held.safe or name not in _SUMS) and not (held.folds and folds)
            if not opaque and _is_float(held.value):
                held.value, held.safe, held.folds = fence(held.value, zero), True, False
        values = [x.value for x in inputs]
        if name == "div" and inputs[1].shared:
            # of a divisor that all entries share, XLA takes the reciprocal once
            values[1] = fence(values[1], zero)
        return [_Held(x, name in _SAFE, name == "broadcast_in_dim", folds) for x in bound(equation, values)]

    return stepwise(function, rule, enter, lambda held: held.value)


def _is_float(x: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)
