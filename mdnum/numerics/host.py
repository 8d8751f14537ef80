"""What jax traces, evaluated by numpy and scipy operation by operation: another program, and no compiler.

It is what a judge is made of: the formula is the same, its elementary functions and loops are not. Nothing is
compiled, which of a formula's operations one by one takes longer than all the rest of a short run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from mdnum.numerics.exact import bound, interpreted


def by_numpy(function: Callable[..., Any], *arguments: np.ndarray) -> list[np.ndarray]:
    """The results of a function of arrays; operations that are not known here are jax's own.

    Error: that of numpy's and scipy's functions, some ulp each.
    """
    with jax.enable_x64(True):
        program = jax.make_jaxpr(function)(*arguments)
        with np.errstate(all="ignore"):
            try:
                return interpreted(program, arguments, _rule, np.asarray)
            except TypeError:
                # a loop, which is no single operation
                return [np.asarray(one) for one in jax.tree.leaves(function(*arguments))]


def _rule(equation: Any, inputs: Sequence[np.ndarray]) -> list[Any]:
    name, params = equation.primitive.name, equation.params
    inner = params.get("call_jaxpr")
    if name.startswith("custom_") and inner is not None:
        return interpreted(inner, inputs, _rule, np.asarray)
    if name in _SPECIAL:
        import scipy.special

        return [getattr(scipy.special, _SPECIAL[name])(*inputs)]
    if name in _KNOWN:
        return [_KNOWN[name](*inputs, **params)]
    return bound(equation, inputs)


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *inputs, **_: function(*inputs)


def _broadcast(x: np.ndarray, *, shape, broadcast_dimensions, **_: Any) -> np.ndarray:
    wide = [1] * len(shape)
    for size, axis in zip(x.shape, broadcast_dimensions, strict=True):
        wide[axis] = size
    return np.broadcast_to(x.reshape(wide), shape)


def _dot(a: np.ndarray, b: np.ndarray, *, dimension_numbers, **_: Any) -> np.ndarray:
    (left, right), (one, other) = dimension_numbers
    letters = iter(range(a.ndim + b.ndim))
    of_a = [next(letters) for _ in range(a.ndim)]
    of_b = [-1] * b.ndim
    for k, m in zip((*left, *one), (*right, *other), strict=True):
        of_b[m] = of_a[k]
    of_b = [next(letters) if k < 0 else k for k in of_b]
    shared = [of_a[k] for k in one]
    out = [*shared, *(k for k in of_a if k not in of_b), *(k for k in of_b if k not in of_a)]
    return np.einsum(a, of_a, b, of_b, out)


#: jax's names of scipy's special functions.
_SPECIAL = {"erf": "erf", "erfc": "erfc", "erf_inv": "erfinv", "logistic": "expit", "lgamma": "gammaln"}
_KNOWN: dict[str, Callable[..., Any]] = {
    **{
        name: _plain(getattr(np, name))
        for name in (
            "exp", "log", "log1p", "expm1", "exp2", "sqrt", "cbrt", "square", "sin", "cos", "tan", "sinh",
            "cosh", "tanh", "abs", "sign", "floor", "ceil",
        )
    },
    **{
        name: _plain(getattr(np, word))
        for name, word in {
            "add": "add", "add_any": "add", "sub": "subtract", "mul": "multiply", "div": "true_divide",
            "neg": "negative", "max": "maximum", "min": "minimum", "pow": "power", "atan2": "arctan2",
            "asin": "arcsin", "acos": "arccos", "atan": "arctan", "gt": "greater", "ge": "greater_equal",
            "lt": "less", "le": "less_equal", "eq": "equal", "ne": "not_equal", "and": "logical_and",
            "or": "logical_or", "not": "logical_not",
        }.items()
    },
    "rsqrt": lambda x, **_: 1 / np.sqrt(x),
    "integer_pow": lambda x, *, y, **_: x**y if y >= 0 else 1 / x ** (-y),
    "select_n": lambda which, *cases, **_: np.choose(which, cases) if which.ndim else cases[int(which)],
    "clamp": lambda low, x, high, **_: np.clip(x, low, high),
    "convert_element_type": lambda x, *, new_dtype, **_: x.astype(new_dtype),
    "copy": lambda x, **_: x,
    "broadcast_in_dim": _broadcast,
    "reshape": lambda x, *, new_sizes, **_: x.reshape(new_sizes),
    "squeeze": lambda x, *, dimensions, **_: np.squeeze(x, dimensions),
    "transpose": lambda x, *, permutation, **_: np.transpose(x, permutation),
    "dot_general": _dot,
    "reduce_sum": lambda x, *, axes, **_: np.sum(x, axis=axes),
    "reduce_max": lambda x, *, axes, **_: np.max(x, axis=axes),
    "reduce_min": lambda x, *, axes, **_: np.min(x, axis=axes),
}  # fmt: skip
