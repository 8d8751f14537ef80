"""Which operation of a program first makes a number that is not finite.

The program is run operation by operation, loops and branches included. An operation is at fault where its
inputs are finite and its result is not, and where the program's own result is mended when that result is:
a number that is masked away later does no harm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

#: Operations that are looked into: what stands in their parameters is a program, called once.
_CALLS = ("jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint", "custom_jvp_call",
          "custom_vjp_call", "custom_vjp_call_jaxpr")  # fmt: skip
#: Candidates that are tried before giving up.
_MOST = 12


@dataclass(frozen=True)
class Operation:
    """An operation whose result is not finite.

    Attributes:
        name: of the primitive, such as "div".
        source: file:line:function that wrote it, innermost one outside of JAX; empty where it is not known.
        functions: all functions on the way to it, outermost first.
        index: of the first number that is not finite, in the result.
        shape: of the result.
        rounds: rounds of the loops around it, outermost first.
        inputs: the numbers at that place of inputs that have the shape of the result, or no shape.
        count: how many operations ran before it.
    """

    name: str
    source: str
    functions: tuple[str, ...]
    index: tuple[int, ...]
    shape: tuple[int, ...]
    rounds: tuple[int, ...]
    inputs: tuple[float, ...]
    count: int


def first_not_finite(function: Callable[..., Any], *args: Any) -> Operation | None:
    """The operation that makes the result of a function not finite.

    Args:
        function: of arrays; it is traced, and not compiled.
        args: pytrees of arrays.

    Returns:
        None where every number of the result is finite, or one of the arguments is not.
    """
    leaves, tree = jax.tree.flatten(args)
    if not _finite(leaves):
        return None
    program = jax.make_jaxpr(lambda *leaves: function(*jax.tree.unflatten(tree, leaves)))(*leaves)
    mended: list[int] = []
    before = _bad_ones(_Run(mended).outputs(program, leaves))
    if not before:
        return None
    found: Operation | None = None
    for _ in range(_MOST):
        run = _Run(mended)
        run.outputs(program, leaves)
        if run.found is None:
            return found
        after = _bad_ones(_Run([*mended, run.found.count]).outputs(program, leaves))
        if after < before:
            return run.found
        # one that is masked away: made finite, so that the search goes on behind it
        found = found or run.found
        mended.append(run.found.count)
    return found


def _finite(leaves: Sequence[Any]) -> bool:
    return all(np.isfinite(np.asarray(leaf, np.float64)).all() for leaf in leaves if _inexact(leaf))


def _bad_ones(leaves: Sequence[Any]) -> int:
    return sum(int((~np.isfinite(np.asarray(leaf, np.float64))).sum()) for leaf in leaves if _inexact(leaf))


def _inexact(leaf: Any) -> bool:
    dtype = getattr(leaf, "dtype", None)
    return dtype is not None and jnp.issubdtype(dtype, jnp.floating)


@dataclass
class _Run:
    """One run of a program, operation by operation, up to and including its end.

    Attributes:
        mended: numbers of operations whose results are made finite.
        found: the first operation at fault.
        count: operations so far. rounds: of the loops that it is in.
    """

    mended: list[int]
    found: Operation | None = None
    count: int = 0
    rounds: list[int] = field(default_factory=list)

    def outputs(self, program: ClosedJaxpr, inputs: Sequence[Any]) -> list[Any]:
        """The results of a program."""
        return self._program(program.jaxpr, program.consts, inputs)

    def _program(self, program: Any, constants: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
        known = dict(zip(program.constvars, constants, strict=True))
        known.update(zip(program.invars, inputs, strict=True))

        def value(atom: Any) -> Any:
            return atom.val if isinstance(atom, Literal) else known[atom]

        for equation in program.eqns:
            results = self._equation(equation, [value(atom) for atom in equation.invars])
            known.update(zip(equation.outvars, results, strict=True))
        return [value(atom) for atom in program.outvars]

    def _equation(self, equation: Any, inputs: list[Any]) -> list[Any]:
        name, params = equation.primitive.name, equation.params
        if name == "scan":
            return self._scan(params, inputs)
        if name == "while":
            return self._while(params, inputs)
        if name == "cond":
            chosen = int(np.clip(int(inputs[0]), 0, len(params["branches"]) - 1))
            return self._closed(params["branches"][chosen], inputs[1:])
        inner = next((params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in params), None)
        if name in _CALLS and isinstance(inner, Jaxpr | ClosedJaxpr):
            return self._closed(inner, inputs)
        made = equation.primitive.bind(*inputs, **params)
        results = list(made) if equation.primitive.multiple_results else [made]
        self.count += 1
        if _finite(results):
            return results
        if self.count in self.mended:
            return [_made_finite(one) for one in results]
        if self.found is None and _finite(inputs):
            self.found = self._told(equation, inputs, results)
        return results

    def _closed(self, inner: Any, inputs: Sequence[Any]) -> list[Any]:
        if isinstance(inner, ClosedJaxpr):
            return self._program(inner.jaxpr, inner.consts, inputs)
        return self._program(inner, (), inputs)

    def _scan(self, params: Any, inputs: list[Any]) -> list[Any]:
        body, length = params["jaxpr"], params["length"]
        constants, carries = params["num_consts"], params["num_carry"]
        fixed, carry = inputs[:constants], list(inputs[constants : constants + carries])
        rows = inputs[constants + carries :]
        out: dict[int, list[Any]] = {}
        for k in reversed(range(length)) if params["reverse"] else range(length):
            self.rounds.append(k)
            made = self._closed(body, [*fixed, *carry, *(row[k] for row in rows)])
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
        while bool(self._closed(params["cond_jaxpr"], [*inputs[:first], *carry])[0]):
            self.rounds.append(k)
            carry = self._closed(params["body_jaxpr"], [*inputs[first:second], *carry])
            self.rounds.pop()
            k += 1
        return carry

    def _told(self, equation: Any, inputs: list[Any], results: list[Any]) -> Operation:
        bad = next(one for one in results if _inexact(one) and not _finite([one]))
        values = np.asarray(bad, np.float64)
        index = tuple(int(k) for k in np.argwhere(~np.isfinite(values))[0])
        given = tuple(
            float(np.asarray(one, np.float64)[index if np.shape(one) else ()])
            for one in inputs
            if _inexact(one) and np.shape(one) in ((), values.shape)
        )
        source, functions = _written(equation)
        return Operation(
            equation.primitive.name,
            source,
            functions,
            index,
            values.shape,
            tuple(self.rounds),
            given,
            self.count,
        )


def _made_finite(one: Any) -> Any:
    return jnp.where(jnp.isfinite(one), one, jnp.zeros((), one.dtype)) if _inexact(one) else one


def _written(equation: Any) -> tuple[str, tuple[str, ...]]:
    """Where an operation was written, and the functions on the way there, outermost first."""
    traceback = equation.source_info.traceback
    if traceback is None:
        return "", ()
    inside = str(Path(jax.__file__).parent)
    frames = [
        one
        for one in traceback.frames
        if not one.file_name.startswith(inside) and f"{Path(one.file_name).name}" != Path(__file__).name
    ]
    if not frames:
        return "", ()
    here = frames[0]
    functions = tuple(
        name for one in reversed(frames) for name in one.function_name.split(".") if name != "<locals>"
    )
    return f"{Path(here.file_name).name}:{here.line_num}:{here.function_name}", functions
