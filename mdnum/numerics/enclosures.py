"""A formula in ball arithmetic: every number an interval that holds the exact one, whatever is computed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal


def enclosed(function: Callable[..., jax.Array], arguments: int) -> Callable[..., Any]:
    """A function of float64 numbers, run operation by operation on flint's balls.

    Constants of the formula are the doubles that they are. A `where` whose condition holds for a part of a
    ball only gives the union of both of its values; at most one of them may be the wrong branch.

    Args:
        function: of scalars; jax traces it once.
        arguments: how many.

    Raises:
        TypeError: by the function, for an operation that has no counterpart here.
    """
    with jax.enable_x64(True):
        program = jax.make_jaxpr(function)(*[jnp.float64(1)] * arguments)
    return lambda *balls: _run(program, balls)[0]


def _run(program: Any, balls: Any) -> list[Any]:
    from flint import arb

    known = dict(zip(program.jaxpr.constvars, (arb(float(c)) for c in program.consts), strict=True))
    known.update(zip(program.jaxpr.invars, balls, strict=True))

    def value(atom: Any) -> Any:
        if not isinstance(atom, Literal):
            return known[atom]
        number = np.asarray(atom.val)
        return bool(number) if number.dtype == bool else arb(float(number))

    for equation in program.jaxpr.eqns:
        inputs = [value(atom) for atom in equation.invars]
        name, inner = equation.primitive.name, equation.params.get("jaxpr")
        if isinstance(inner, ClosedJaxpr):
            outputs = _run(inner, inputs)
        elif name in _OPERATIONS:
            outputs = [_OPERATIONS[name](*inputs, **equation.params)]
        else:
            raise TypeError(f"{name} has no counterpart in ball arithmetic")
        known.update(zip(equation.outvars, outputs, strict=True))
    return [value(atom) for atom in program.jaxpr.outvars]


def _compare(yes: Callable[[Any, Any], bool], no: Callable[[Any, Any], bool]) -> Callable[..., bool | None]:
    return lambda a, b, **_: True if yes(a, b) else False if no(a, b) else None


def _select(condition: bool | None, no: Any, yes: Any, **_: Any) -> Any:
    return no.union(yes) if condition is None else yes if condition else no


def _both(a: bool | None, b: bool | None, **_: Any) -> bool | None:
    return False if a is False or b is False else None if a is None or b is None else True


_OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": lambda a, b, **_: a + b,
    "sub": lambda a, b, **_: a - b,
    "mul": lambda a, b, **_: a * b,
    "div": lambda a, b, **_: a / b,
    "neg": lambda a, **_: -a,
    "abs": lambda a, **_: abs(a),
    "sqrt": lambda a, **_: a.sqrt(),
    "rsqrt": lambda a, **_: a.rsqrt(),
    "exp": lambda a, **_: a.exp(),
    "log": lambda a, **_: a.log(),
    "sin": lambda a, **_: a.sin(),
    "cos": lambda a, **_: a.cos(),
    "tanh": lambda a, **_: a.tanh(),
    "square": lambda a, **_: a * a,
    "pow": lambda a, b, **_: a**b,
    "integer_pow": lambda a, *, y, **_: a**y,
    "max": lambda a, b, **_: a.max(b),
    "min": lambda a, b, **_: a.min(b),
    "convert_element_type": lambda a, **_: a,
    "broadcast_in_dim": lambda a, **_: a,
    "copy": lambda a, **_: a,
    "stop_gradient": lambda a, **_: a,
    "select_n": _select,
    "and": _both,
    "gt": _compare(lambda a, b: a > b, lambda a, b: a <= b),
    "ge": _compare(lambda a, b: a >= b, lambda a, b: a < b),
    "lt": _compare(lambda a, b: a < b, lambda a, b: a >= b),
    "le": _compare(lambda a, b: a <= b, lambda a, b: a > b),
}
