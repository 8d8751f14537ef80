"""A traced function operation by operation in numpy, which contracts nothing: an oracle of bits."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np


def _logical(bits, places):
    return (np.asarray(bits).view(np.uint64) >> np.uint64(places)).view(np.int64)


_OPERATIONS: dict[str, Any] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "abs": np.abs,
    "sqrt": np.sqrt,
    "round": np.rint,
    "select_n": lambda which, no, yes: np.where(which, yes, no),
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "shift_left": np.left_shift,
    "shift_right_logical": _logical,
    "broadcast_in_dim": np.asarray,
}
# to the numbers of another type; the bits of one
_CASTS: dict[str, Any] = {
    "convert_element_type": lambda x, dtype: np.asarray(x).astype(dtype),
    "bitcast_convert_type": lambda x, dtype: np.asarray(x).view(dtype),
}


def by_numpy(function: Any, *arguments: Any) -> Any:
    """The function of float64 arrays, traced for scalars."""
    program = jax.make_jaxpr(function)(*[jax.ShapeDtypeStruct((), np.float64)] * len(arguments))
    with np.errstate(all="ignore"):
        return _run(program.jaxpr, program.consts, arguments)[0]


def _run(jaxpr: Any, constants: Any, arguments: Any) -> list[Any]:
    known = dict(zip(jaxpr.constvars, constants, strict=True)) | dict(
        zip(jaxpr.invars, arguments, strict=True)
    )

    def value(atom: Any) -> Any:
        return atom.val if hasattr(atom, "val") else known[atom]

    for equation in jaxpr.eqns:
        inputs, inner = list(map(value, equation.invars)), equation.params.get("jaxpr")
        name = equation.primitive.name
        if inner is not None:
            outputs = _run(inner.jaxpr, inner.consts, inputs)
        elif name in _CASTS:
            outputs = [_CASTS[name](*inputs, equation.params["new_dtype"])]
        else:
            outputs = [_OPERATIONS[name](*inputs)]
        known.update(zip(equation.outvars, outputs, strict=True))
    return list(map(value, jaxpr.outvars))
