"""Evaluation of jax functions by numpy and scipy, without compilation.

The results are an independent reference for jax. Compilation would take longer than the rest of a short run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from mdnum.numerics.exact import bound, inlined, interpreted

#: Elementwise operations with different names in numpy or scipy and in jax.
_NAMES = {
    "add_any": "add", "sub": "subtract", "mul": "multiply", "div": "true_divide", "neg": "negative",
    "max": "maximum", "min": "minimum", "pow": "power", "atan2": "arctan2", "asin": "arcsin",
    "acos": "arccos", "atan": "arctan", "abs": "absolute", "gt": "greater", "ge": "greater_equal",
    "lt": "less", "le": "less_equal", "eq": "equal", "ne": "not_equal", "and": "logical_and",
    "or": "logical_or", "not": "logical_not", "logistic": "expit", "erf_inv": "erfinv", "lgamma": "gammaln",
}  # fmt: skip


def by_numpy(function: Callable[..., Any], *arguments: np.ndarray) -> list[np.ndarray]:
    """Evaluate a function of arrays by numpy. jax computes operations that numpy and scipy lack.

    Each elementary function of numpy and scipy has an error of a few ulps.
    """
    with jax.enable_x64(True), np.errstate(all="ignore"):
        program = jax.make_jaxpr(function)(*arguments)
        try:
            return interpreted(program, arguments, _rule, np.asarray)
        except TypeError:
            # a loop, which is no single operation
            return [np.asarray(one) for one in jax.tree.leaves(function(*arguments))]


def _rule(equation: Any, inputs: Sequence[np.ndarray]) -> list[Any]:
    import scipy.special

    name: str = equation.primitive.name
    if (inner := inlined(equation)) is not None:
        return interpreted(inner, inputs, _rule, np.asarray)
    if name in _KNOWN:
        return [_KNOWN[name](*inputs, **equation.params)]
    for library in (np, scipy.special):
        same = getattr(library, _NAMES.get(name, name), None)
        if isinstance(same, np.ufunc):
            return [same(*inputs)]
    return bound(equation, inputs)


def _broadcast(x: np.ndarray, *, shape, broadcast_dimensions, **_: Any) -> np.ndarray:
    wide = [1] * len(shape)
    for size, axis in zip(x.shape, broadcast_dimensions, strict=True):
        wide[axis] = size
    return np.broadcast_to(x.reshape(wide), shape)


def _dot(a: np.ndarray, b: np.ndarray, *, dimension_numbers, **_: Any) -> np.ndarray:
    (left, right), batches = dimension_numbers
    if any(batches):
        raise TypeError("products of stacks of matrices (batched matmul) are not supported")
    return np.tensordot(a, b, (left, right))


_KNOWN: dict[str, Callable[..., Any]] = {
    "rsqrt": lambda x, **_: 1 / np.sqrt(x),
    "integer_pow": lambda x, *, y, **_: x**y if y >= 0 else 1 / x ** (-y),
    "select_n": lambda which, *cases, **_: np.choose(which, cases),
    "convert_element_type": lambda x, *, new_dtype, **_: x.astype(new_dtype),
    "copy": lambda x, **_: x,
    "broadcast_in_dim": _broadcast,
    "reshape": lambda x, *, new_sizes, **_: x.reshape(new_sizes),
    "squeeze": lambda x, *, dimensions, **_: np.squeeze(x, dimensions),
    "dot_general": _dot,
    "reduce_sum": lambda x, *, axes, **_: np.sum(x, axis=axes),
}
