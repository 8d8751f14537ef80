"""What a traced program says of its arithmetic: single precision in it, and where numbers become infinite."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

#: Digits that a person writes: numbers in single precision with more are weights, or were computed.
_DIGITS = 6


def _programs(closed: Any) -> Iterator[Any]:
    """A program and all that it calls."""
    yield closed
    for equation in closed.eqns:
        for inner in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda one: hasattr(one, "eqns")
        ):
            if hasattr(inner, "eqns"):
                yield from _programs(inner)


def narrows(closed: Any) -> bool:
    """Whether a program rounds numbers in double precision to single precision."""
    both = {np.dtype(np.float64)}, {np.dtype(np.float32)}
    return any(
        ({one.aval.dtype for one in equation.invars}, {one.aval.dtype for one in equation.outvars}) == both
        for program in _programs(closed) for equation in program.eqns
        if equation.primitive.name == "convert_element_type"
    )  # fmt: skip


def single_numbers(closed: Any) -> list[str]:
    """Constants of a program that were rounded to single precision, as they were most likely written.

    One that was widened again has a value of single precision, and needs no more digits than that.
    """
    numbers: dict[str, None] = {}
    for program in _programs(closed):
        literals = [one.val for equation in program.eqns for one in equation.invars if hasattr(one, "val")]
        for one in map(np.asarray, [*getattr(program, "consts", ()), *literals]):
            if one.dtype not in (np.float32, np.float64) or one.size > 64:
                continue
            with np.errstate(over="ignore"):
                single = one.ravel().astype(np.float32)
            for number in single[(single == one.ravel()) & np.isfinite(single)]:
                # halves and whole numbers lose nothing, and what has all digits was computed
                word = str(number)
                if len(word.strip("-0.").replace(".", "")) <= _DIGITS and float(word) != float(number):
                    numbers[word] = None
    return list(numbers)


def first_not_finite(function: Callable[..., Any], *args: Any) -> str:
    """The first operation of a function that makes of finite numbers one that is not, and its place."""
    closed, found = jax.make_jaxpr(function)(*args), []

    def finite(values: Any) -> bool:
        return all(np.isfinite(one).all() for one in map(np.asarray, values) if one.dtype.kind == "f")

    def run(program: Any, consts: Any, values: Any, outer: str) -> list[Any]:
        known: dict[Any, Any] = dict(
            zip([*program.constvars, *program.invars], [*consts, *values], strict=True)
        )
        for equation in program.eqns:
            place, primitive = _line(equation) or outer, equation.primitive
            ins = [one.val if hasattr(one, "val") else known[one] for one in equation.invars]
            inner = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
            if hasattr(inner, "consts") and primitive.name not in ("scan", "while", "cond"):
                outs = run(inner.jaxpr, inner.consts, ins, place)
            else:
                params = primitive.get_bind_params(equation.params)
                # earlier versions of jax return functions among the arguments, too
                more, params = params if isinstance(params, tuple) else ((), params)
                outs = primitive.bind(*more, *ins, **params)
                outs = outs if primitive.multiple_results else [outs]
            if not found and finite(ins) and not finite(outs):
                found.append(f"{primitive.name} ({place})")
            known |= dict(zip(equation.outvars, outs, strict=True))
        return [one.val if hasattr(one, "val") else known[one] for one in program.outvars]

    run(closed.jaxpr, closed.consts, jax.tree.leaves(args), "place unknown")
    return found[0] if found else "an operation on numbers that were not finite before"


def _line(equation: Any) -> str:
    """File, line and function in which an operation was written, outside of jax."""
    for one in getattr(equation.source_info.traceback, "frames", ()):
        if "/jax/" not in one.file_name and "/equinox/" not in one.file_name:
            return f"{one.file_name.rpartition('/')[2]}:{one.line_num} {one.function_name}"
    return ""
