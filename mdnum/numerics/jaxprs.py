"""Analysis of functions traced by jax: float32 operations, and the origin of non-finite numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mdnum.numerics.exact import inlined, interpreted

#: Largest number of candidates that are tried.
_MOST = 12
#: Number of digits that a person would write: single-precision numbers with more digits are weights or
#: computed.
_DIGITS = 6


def _programs(closed: Any) -> Iterator[Any]:
    """Yield a jaxpr and the jaxprs called in it."""
    yield closed
    for equation in closed.eqns:
        for inner in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda one: hasattr(one, "eqns")
        ):
            if hasattr(inner, "eqns"):
                yield from _programs(inner)


def narrows(closed: Any) -> bool:
    """Return whether a jaxpr rounds numbers from double to single precision."""
    both = {np.dtype(np.float64)}, {np.dtype(np.float32)}
    return any(
        ({one.aval.dtype for one in equation.invars}, {one.aval.dtype for one in equation.outvars}) == both
        for program in _programs(closed) for equation in program.eqns
        if equation.primitive.name == "convert_element_type"
    )  # fmt: skip


def held_numbers(closed: Any, least: int = 10) -> int:
    """Count the entries of large constant arrays in a jaxpr, such as model weights."""
    consts = [one for program in _programs(closed) for one in getattr(program, "consts", ())]
    return sum({id(one): one.size for one in consts if is_inexact(one) and one.size >= least}.values())


def single_numbers(closed: Any) -> list[str]:
    """Return the constants of a jaxpr that were rounded to float32, as short decimal numbers.

    Constants rounded to float32 need fewer digits than other float64 numbers.
    """
    numbers: dict[str, None] = {}
    for program in _programs(closed):
        literals = [one.val for equation in program.eqns for one in equation.invars if hasattr(one, "val")]
        for one in map(np.asarray, [*getattr(program, "consts", ()), *literals]):
            if one.dtype not in (np.float32, np.float64) or one.size > 64:
                continue
            with np.errstate(over="ignore"):
                single = one.ravel().astype(np.float32)
            single = single[(single == one.ravel()) & np.isfinite(single)]
            # an array with one that has all digits was computed; halves and whole numbers lose nothing
            if all(len(str(number).strip("-0.").replace(".", "")) <= _DIGITS for number in single):
                numbers |= {str(number): None for number in single if float(str(number)) != float(number)}
    return list(numbers)


@dataclass(frozen=True)
class Operation:
    """An operation whose result is infinite or NaN."""

    name: str  # of the primitive, such as "div"
    source: str  # file:line:function that wrote it, innermost one outside of JAX; empty where it is not known
    functions: tuple[str, ...]  # all functions on the way to it, outermost first
    index: tuple[int, ...]  # of the first number that is not finite, in the result
    shape: tuple[int, ...]  # of the result
    rounds: tuple[int, ...]  # rounds of the loops around it, outermost first
    # the numbers at that place of inputs that have the shape of the result, or no shape
    inputs: tuple[float, ...]
    count: int  # how many operations ran before it


def first_not_finite(function: Callable[..., Any], *args: Any) -> Operation | None:
    """Find the operation that first makes the result of a function infinite or NaN.

    Returns:
        the operation; None if all results are finite, or if an argument is not finite.
    """
    leaves, tree = jax.tree.flatten(args)
    if count_bad(leaves):
        return None
    program = jax.make_jaxpr(lambda *leaves: function(*jax.tree.unflatten(tree, leaves)))(*leaves)

    def run(mended: list[int]) -> tuple[int, Operation | None]:
        interpreter = _Interpreter(mended)
        return count_bad(interpreter.closed(program, leaves)), interpreter.found

    mended: list[int] = []
    before, candidate = run(mended)
    first = candidate
    for _ in range(_MOST if before else 0):
        if candidate is None or run([*mended, candidate.count])[0] < before:
            return candidate or first
        # one that is masked away: made finite, so that the search goes on behind it
        mended.append(candidate.count)
        _, candidate = run(mended)
    return first if before else None


def count_bad(tree: Any) -> int:
    """Count the infinite and NaN numbers in arrays."""
    leaves = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(tree) if is_inexact(leaf)]
    return sum(int((~np.isfinite(leaf)).sum()) for leaf in leaves)


def is_inexact(leaf: Any) -> bool:
    """Return whether an object is an array of floats, including ml_dtypes' small types."""
    return jnp.issubdtype(getattr(leaf, "dtype", np.int64), jnp.floating)


@dataclass
class _Interpreter:
    """Interpreter that runs a jaxpr one operation at a time and finds results that are not finite."""

    mended: list[int]  # numbers of operations whose results are made finite
    found: Operation | None = None  # the first operation at fault
    count: int = 0  # operations so far
    rounds: list[int] = field(default_factory=list)  # of the loops that it is in

    def closed(self, program: Any, inputs: Sequence[Any]) -> list[Any]:
        """Run a jaxpr one operation at a time, and return its results."""
        return interpreted(program, inputs, self._equation)

    def _equation(self, equation: Any, inputs: list[Any]) -> list[Any]:
        name, params = equation.primitive.name, equation.params
        if name == "scan":
            return self._scan(params, inputs)
        if name == "while":
            return self._while(params, inputs)
        if name == "cond":
            chosen = int(np.clip(int(inputs[0]), 0, len(params["branches"]) - 1))
            return self.closed(params["branches"][chosen], inputs[1:])
        if (inner := inlined(equation)) is not None:
            return self.closed(inner, inputs)
        made = equation.primitive.bind(*inputs, **params)
        results = list(made) if equation.primitive.multiple_results else [made]
        self.count += 1
        if not count_bad(results):
            return results
        if self.count in self.mended:
            return [jnp.nan_to_num(one, posinf=0, neginf=0) if is_inexact(one) else one for one in results]
        if self.found is None and not count_bad(inputs):
            self.found = self._operation(equation, inputs, results)
        return results

    def _scan(self, params: Any, inputs: list[Any]) -> list[Any]:
        body, length = params["jaxpr"], params["length"]
        if "ft_in" in params:  # jax 0.11.2
            fixed, carry, rows = map(list, params["ft_in"].update(inputs).unpack())
        else:
            ends = np.cumsum([params["num_consts"], params["num_carry"]])
            fixed, carry, rows = inputs[: ends[0]], inputs[ends[0] : ends[1]], inputs[ends[1] :]
        carries = len(carry)
        out: dict[int, list[Any]] = {}
        for k in reversed(range(length)) if params["reverse"] else range(length):
            self.rounds.append(k)
            made = self.closed(body, [*fixed, *carry, *(row[k] for row in rows)])
            self.rounds.pop()
            carry, out[k] = made[:carries], made[carries:]
        shapes = [atom.aval for atom in body.jaxpr.outvars[carries:]]
        stacked = [
            jnp.stack([out[k][n] for k in range(length)]) if length else jnp.zeros((0, *one.shape), one.dtype)
            for n, one in enumerate(shapes)
        ]
        return [*carry, *stacked]

    def _while(self, params: Any, inputs: list[Any]) -> list[Any]:
        first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        carry, k = list(inputs[second:]), 0
        while bool(self.closed(params["cond_jaxpr"], [*inputs[:first], *carry])[0]):
            self.rounds.append(k)
            carry = self.closed(params["body_jaxpr"], [*inputs[first:second], *carry])
            self.rounds.pop()
            k += 1
        return carry

    def _operation(self, equation: Any, inputs: list[Any], results: list[Any]) -> Operation:
        values = np.asarray(next(one for one in results if count_bad(one)), np.float64)
        index = tuple(int(k) for k in np.argwhere(~np.isfinite(values))[0])
        given = tuple(
            float(np.asarray(one, np.float64)[index if np.shape(one) else ()])
            for one in inputs
            if is_inexact(one) and np.shape(one) in ((), values.shape)
        )
        where = (index, values.shape, tuple(self.rounds), given, self.count)
        return Operation(equation.primitive.name, *_written(equation), *where)


def _written(equation: Any) -> tuple[str, tuple[str, ...]]:
    """Return the source location of an operation, and the calls that lead to it."""
    traceback, inside = equation.source_info.traceback, f"{Path(jax.__file__).parent}/"
    frames = [
        one
        for one in (traceback.frames if traceback is not None else ())
        if not one.file_name.startswith(inside) and Path(one.file_name).name != Path(__file__).name
    ]
    if not frames:
        return "", ()
    names = [name for one in reversed(frames) for name in one.function_name.split(".") if name != "<locals>"]
    here = frames[0]
    return f"{Path(here.file_name).name}:{here.line_num}:{here.function_name}", tuple(names)
