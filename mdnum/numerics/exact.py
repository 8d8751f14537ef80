"""Arithmetic inside jit that has the same bits everywhere.

XLA on a CPU contracts a*b + c into a fused multiply-add, so the same expression has other bits in
another fusion, another instruction set, or in numpy. A decision must not depend on that: it is written
with the products fenced, and then the host reproduces it bit for bit. A formula that is written as any
other is run operation by operation instead: rounded behind each, or enclosed by intervals.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal


def integer_of(dtype):
    """The signed integer type as wide as a float dtype."""
    return jnp.dtype(f"int{8 * np.dtype(dtype).itemsize}")


def zero_bits(dtype) -> jax.Array:
    """An integer zero of the width of dtype; pass it into jit as an argument, so that XLA cannot fold it."""
    return jnp.zeros((), integer_of(dtype))


def _through_integers(x, zero):
    integer = integer_of(x.dtype)
    return lax.bitcast_convert_type(lax.bitcast_convert_type(x, integer) ^ zero.astype(integer), x.dtype)


@jax.custom_jvp
def fence(x: jax.Array, zero: jax.Array) -> jax.Array:
    """x, opaque to fused multiply-add contraction: XLA sees an integer operation with a runtime zero.

    It also forces the rounding to float16 and bfloat16: XLA may keep the float32 in which it computed (a
    bfloat16 product that is widened at once is never rounded on a CPU), but an integer needs the bits.

    Source: optimization_barrier and reduce_precision do not stop the contraction on CPU
    (openxla/xla#41579); the exclusive-or with a runtime integer does.
    """
    return _through_integers(x, zero)


@fence.defjvp
def _fence_jvp(primals, tangents):
    x, zero = primals
    return _through_integers(x, zero), tangents[0]


def squared_norm(dx: jax.Array, dy: jax.Array, dz: jax.Array, zero: jax.Array) -> jax.Array:
    """dx² + dy² + dz², rounded after every operation: the bits of numpy's `dx*dx + dy*dy + dz*dz`.

    Error: at most gamma_3 * r² for exact components (Higham 2002, 3.1).
    """
    return (fence(dx * dx, zero) + fence(dy * dy, zero)) + fence(dz * dz, zero)


# --- programs, operation by operation -------------------------------------------------------------------

# what a function that is jitted by itself, as jnp.where is, looks like inside another
_CALLS = ("jit", "pjit")
Rule = Callable[[Any, list[Any]], Sequence[Any]]


def _same(x: Any) -> Any:
    return x


def stepwise(
    function: Callable[..., Any],
    rule: Rule,
    enter: Callable[[Any], Any] = _same,
    leave: Callable[[Any], jax.Array] = _same,
) -> Callable[..., Any]:
    """The function of arrays, traced where it is called, whose operations a rule computes one by one.

    Args:
        function: may close over other arrays.
        rule: of an equation of jax's program and its inputs: its outputs.
        enter: makes what the rule works on of an argument, a constant, and what enters or leaves a call.
        leave: makes an array of a result of the rule.
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
    """The results of a closed program (see `stepwise`)."""
    jaxpr = program.jaxpr
    known = dict(zip(jaxpr.constvars, map(enter, program.consts), strict=True))
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


def bound(equation: Any, inputs: Sequence[Any]) -> list[jax.Array]:
    """What jax itself makes of an equation's inputs.

    Raises:
        TypeError: it is a program of its own, such as a loop.
    """
    if any(isinstance(param, Jaxpr | ClosedJaxpr) for param in equation.params.values()):
        raise TypeError(f"{equation.primitive.name} cannot be run operation by operation")
    outputs = equation.primitive.bind(*inputs, **equation.params)
    return list(outputs) if equation.primitive.multiple_results else [outputs]


def rounded(function: Callable[..., Any], zero: jax.Array) -> Callable[..., Any]:
    """The function with every sixteen-bit result in it rounded, one operation after the other.

    XLA on a CPU computes in float32 what is written in float16 or bfloat16, and may leave out the roundings
    between two operations. Here a fence stands behind each: numpy with ml_dtypes then gives the same bits,
    for + - * / and sqrt (exp and cos are float32's, which libraries round differently). Results of other
    dtypes are left alone.

    Args:
        function: of arrays; it may close over others.
        zero: an integer zero that XLA must not know (`zero_bits`).
    """

    def rule(equation: Any, inputs: list[Any]) -> list[jax.Array]:
        outputs = bound(equation, inputs)
        return [fence(x, zero) if _is_short(x.dtype) else x for x in outputs]

    return stepwise(function, rule)


def _is_short(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jnp.floating) and np.dtype(dtype).itemsize == 2


def enclosed(function: Callable[..., jax.Array], arguments: int) -> Callable[..., Any]:
    """A function of float64 numbers in ball arithmetic: every number an interval that holds the exact one.

    Constants of the formula are the doubles that they are. A `where` whose condition holds for a part of a
    ball only gives the union of both of its values; at most one of them may be the wrong branch.

    Args:
        function: of scalars; jax traces it once.
        arguments: how many; numbers of flint.

    Raises:
        TypeError: by the function, for an operation that has no counterpart here.
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
        if name not in _IN_BALLS:
            raise TypeError(f"{name} has no counterpart in ball arithmetic")
        return [_IN_BALLS[name](*inputs, **equation.params)]

    return lambda *balls: interpreted(program, balls, rule, enter)[0]


def _method(name: str) -> Callable[..., Any]:
    return lambda a, *more, **_: getattr(a, name)(*more)


def _compare(yes: Callable[[Any, Any], bool], no: Callable[[Any, Any], bool]) -> Callable[..., bool | None]:
    return lambda a, b, **_: True if yes(a, b) else False if no(a, b) else None


def _select(condition: bool | None, no: Any, yes: Any, **_: Any) -> Any:
    return no.union(yes) if condition is None else yes if condition else no


def _both(a: bool | None, b: bool | None, **_: Any) -> bool | None:
    return False if a is False or b is False else None if a is None or b is None else True


_IN_BALLS: dict[str, Callable[..., Any]] = {
    "add": lambda a, b, **_: a + b,
    "sub": lambda a, b, **_: a - b,
    "mul": lambda a, b, **_: a * b,
    "div": lambda a, b, **_: a / b,
    "neg": lambda a, **_: -a,
    "abs": lambda a, **_: abs(a),
    **{name: _method(name) for name in ("sqrt", "rsqrt", "exp", "log", "sin", "cos", "tanh", "max", "min")},
    "square": lambda a, **_: a * a,
    "pow": lambda a, b, **_: a**b,
    "integer_pow": lambda a, *, y, **_: a**y,
    **dict.fromkeys(("convert_element_type", "broadcast_in_dim", "copy", "stop_gradient"), lambda a, **_: a),
    "select_n": _select,
    "and": _both,
    "gt": _compare(operator.gt, operator.le),
    "ge": _compare(operator.ge, operator.lt),
    "lt": _compare(operator.lt, operator.ge),
    "le": _compare(operator.le, operator.gt),
}
