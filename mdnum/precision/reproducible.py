"""Programs whose float64 results no compiler changes: the same bits in every fusion and instruction set.

A formula is written once, as any other; here it is run operation by operation, with a fence wherever a
compiler could contract a product into a sum or replace a quotient by a product, and with the elementary
functions of `mdnum.precision.elementary`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from mdnum.precision import elementary
from mdnum.precision.exact import fence

# what a function that is jitted by itself, as jnp.where is, looks like inside another
_CALLS = ("jit", "pjit")
_SUMS = ("add", "sub")
# results that are not a product or quotient, nor a rearranged one
_SAFE = ("add", "sub", "sqrt", "abs", "max", "min", "round", "floor", "convert_element_type", "iota")


def reproducible(function: Callable[..., Any], zero: jax.Array) -> Callable[..., Any]:
    """The function in float64, with results that do not depend on how it is compiled.

    Args:
        function: of arrays; it may close over others.
        zero: an integer zero that XLA must not know (`mdnum.precision.exact.zero_bits`).
    """

    def stepwise(*args: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        program, shape = jax.make_jaxpr(
            lambda *leaves: function(*jax.tree.unflatten(tree, leaves)), return_shape=True
        )(*leaves)
        results, _ = _run(program.jaxpr, program.consts, leaves, [True] * len(leaves), zero)
        return jax.tree.unflatten(jax.tree.structure(shape), results)

    return stepwise


def _run(
    program: Any, constants: Sequence[Any], arguments: Sequence[Any], safe: Sequence[bool], zero: jax.Array
) -> tuple[list[Any], list[bool]]:
    """Run a program; returns its results, and which of them may be added as they are."""
    known: dict[Any, Any] = dict(zip(program.constvars, constants, strict=True))
    known.update(zip(program.invars, arguments, strict=True))
    addable: dict[Any, bool] = dict.fromkeys(program.constvars, True)
    addable.update(zip(program.invars, safe, strict=True))

    # a literal divides as any compiler divides by it, and cannot be looked up
    shared: set[Any] = set()

    def value(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else known[atom]

    def is_safe(atom: Any) -> bool:
        return isinstance(atom, Literal) or addable[atom]

    def fenced(atom: Any) -> Any:
        """The value of an operand of a sum; what has been fenced once need not be again."""
        if is_safe(atom) or not _is_float(value(atom)):
            return value(atom)
        known[atom], addable[atom] = fence(known[atom], zero), True
        return known[atom]

    for equation in program.eqns:
        name = equation.primitive.name
        inner = equation.params.get("jaxpr")
        fine = [name in _SAFE] * len(equation.outvars)
        if name in _CALLS and isinstance(inner, ClosedJaxpr):
            inputs = [value(atom) for atom in equation.invars]
            outputs, fine = _run(inner.jaxpr, inner.consts, inputs, list(map(is_safe, equation.invars)), zero)
        elif name in _OWN and _is_float(value(equation.invars[0])):
            outputs = [_OWN[name](*(value(atom) for atom in equation.invars), zero=zero, **equation.params)]
        else:
            if any(isinstance(param, Jaxpr | ClosedJaxpr) for param in equation.params.values()):
                raise TypeError(f"{name} cannot be run operation by operation")
            inputs = [fenced(atom) if name in _SUMS else value(atom) for atom in equation.invars]
            if name == "div" and not isinstance(equation.invars[1], Literal) and equation.invars[1] in shared:
                # of a divisor that all entries share, XLA takes the reciprocal once
                inputs[1] = fence(inputs[1], zero)
            outputs = equation.primitive.bind(*inputs, **equation.params)
            outputs = list(outputs) if equation.primitive.multiple_results else [outputs]
            if name == "broadcast_in_dim":
                shared.update(equation.outvars)
        known.update(zip(equation.outvars, outputs, strict=True))
        addable.update(zip(equation.outvars, fine, strict=True))
    return [value(atom) for atom in program.outvars], [is_safe(atom) for atom in program.outvars]


def _is_float(x: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def _power(x: Any, y: Any, *, zero: jax.Array, **_: Any) -> jax.Array:
    """x to the power y, for x above 0; 0 or 1 at 0."""
    x = jnp.asarray(x)
    y = jnp.asarray(y, x.dtype)
    value = elementary.exp(fence(y * elementary.log(x, zero), zero), zero)
    return jnp.where(x > 0, value, jnp.where(y == 0, jnp.ones_like(x), jnp.zeros_like(x)))


_OWN: dict[str, Callable[..., Any]] = {
    "exp": lambda x, zero, **_: elementary.exp(x, zero),
    "log": lambda x, zero, **_: elementary.log(x, zero),
    "cos": lambda x, zero, **_: elementary.cos_sin(x, zero)[0],
    "sin": lambda x, zero, **_: elementary.cos_sin(x, zero)[1],
    "pow": _power,
}
