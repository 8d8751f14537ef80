"""Where a reverse pass stops being finite while the run it belongs to is fine, operation by operation.

A force can be finite where its derivative is not, a loss can have a root at zero, a sum can leave the range
of its format on the way back. The pass is repeated up to the step at which that happens, and that step is
run operation by operation, loops and branches included. An operation is at fault where its inputs are finite
and its result is not, and where the program's own result is mended when that result is: a number that is
masked away later does no harm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from mdnum.gradients import parameters
from mdnum.gradients.adjoint import StretchReversal, Trace, transposed
from mdnum.gradients.problem import Problem, Progress
from mdnum.gradients.recorded import GUARD, radial_speed, tape_of, wanted
from mdnum.gradients.tape import RunTape, TapeStretch, frame_of
from mdnum.md.cell import HostCell
from mdnum.md.decide import GROUP

#: Operations that are looked into: what is in their parameters is a program, called once.
_CALLS = ("jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint", "custom_jvp_call",
          "custom_vjp_call", "custom_vjp_call_jaxpr")  # fmt: skip
#: Candidates that are tried before giving up.
_MOST = 12
#: Part of a step by the functions on the way to an operation; the first that is there counts.
_PARTS = (
    ("onto_crossings", "crossings"),
    ("look", "loss"),
    ("seen_at", "loss"),
    ("observe", "loss"),
    # an operation in a loop remembers the function that the loop stands in, and none further out
    ("_of_pairs", "forces"),
    ("_of_energy", "forces"),
    ("drift", "drift"),
)
_NOWHERE = (-1, -1, float("nan"))


@dataclass(frozen=True)
class NotFinite:
    """Where a reverse pass stops being finite.

    Attributes:
        found: whether it does at all.
        forward: whether the forward run, its loss included, is finite.
        step: the first step, in the order of the reverse pass (last in time); -1 where all is finite.
        operation: the first operation there whose inputs are finite and whose result is not; empty where no
            single operation is. inputs: its numbers at that place.
        source: file:line:function that wrote it; empty where it is not known.
        part: "loss", "forces", "crossings", "drift" or "parameters".
        i, j: the pair at fault, i < j; -1 where it is no pair (j alone -1: an atom).
        distance: of the pair, length; NaN where there is none.
    """

    found: bool = False
    forward: bool = True
    step: int = -1
    operation: str = ""
    inputs: tuple[float, ...] = ()
    source: str = ""
    part: str = ""
    i: int = -1
    j: int = -1
    distance: float = float("nan")


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
    before = _not_finite(_Interpreter(mended).outputs(program, leaves))
    if not before:
        return None
    found: Operation | None = None
    for _ in range(_MOST):
        run = _Interpreter(mended)
        run.outputs(program, leaves)
        if run.found is None:
            return found
        after = _not_finite(_Interpreter([*mended, run.found.count]).outputs(program, leaves))
        if after < before:
            return run.found
        # one that is masked away: made finite, so that the search goes on behind it
        found = found or run.found
        mended.append(run.found.count)
    return found


def _finite(leaves: Sequence[Any]) -> bool:
    return all(np.isfinite(np.asarray(leaf, np.float64)).all() for leaf in leaves if _inexact(leaf))


def _not_finite(leaves: Sequence[Any]) -> int:
    return sum(int((~np.isfinite(np.asarray(leaf, np.float64))).sum()) for leaf in leaves if _inexact(leaf))


def _inexact(leaf: Any) -> bool:
    dtype = getattr(leaf, "dtype", None)
    return dtype is not None and jnp.issubdtype(dtype, jnp.floating)


@dataclass
class _Interpreter:
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
            self.found = self._operation(equation, inputs, results)
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

    def _operation(self, equation: Any, inputs: list[Any], results: list[Any]) -> Operation:
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


def detective(
    problem: Problem,
    names: Sequence[str],
    *,
    saltation: bool = True,
    tape: RunTape | None = None,
    progress: Progress | None = None,
) -> NotFinite:
    """The first step and operation of the reverse pass that is not finite, and the pair at fault.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: parameters, full or short names.
        saltation: whether flips count.
        tape: the run, where it has been made (with flips, if saltation is asked for).
        progress: called with the steps done, all steps, and a phase in words.

    Raises:
        InputError: no such parameter, or no pair potential. NumericalError: the run blew up.
    """
    simulation = problem.simulation
    full = parameters.resolve(simulation, names)
    if tape is None:
        tape = tape_of(problem, saltation, progress=progress)
    if not np.isfinite(tape.value):
        return _in_forward(tape)
    back = StretchReversal(tape, wanted(full), GUARD * radial_speed(simulation) if saltation else None)
    if not _all_finite(back.onto_total):
        made = first_not_finite(jax.grad(lambda total: tape.loss.value(total, tape.frames)), tape.total)
        return _blamed(tape.steps, "loss", made)
    for stretch in tape.backward():
        before = back.carry
        _, trace = back.through(stretch, traced=True)
        assert trace is not None
        row = _last_bad(trace, stretch.rows)
        if row is None and not _all_finite(back.carry):
            # what a crossing before the first row of a stretch adds is seen in the carry alone
            row = 0
        if row is not None:
            back.carry = before
            return _looked_into(back, stretch, row)
        if progress is not None:
            progress(tape.steps - stretch.first, tape.steps, "reverse pass")
    return NotFinite()


def _all_finite(tree: Any) -> bool:
    leaves = (np.asarray(leaf) for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating))
    return all(np.isfinite(leaf).all() for leaf in leaves)


def _last_bad(trace: Trace, rows: int) -> int | None:
    """The latest row whose carry is not finite."""
    bad = np.zeros(rows, bool)
    for leaf in jax.tree.leaves(trace):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            values = np.asarray(leaf)[:rows].reshape(rows, -1)
            bad |= ~np.isfinite(values).all(axis=1)
    return int(np.flatnonzero(bad)[-1]) if bad.any() else None


def _in_forward(tape: RunTape) -> NotFinite:
    """The run is finite, the loss is not: the first frame at which it is not."""
    for stretch in tape.forward():
        seen = tape.seen(stretch)
        for row in np.flatnonzero(seen[: stretch.rows]):
            columns = tuple(np.asarray(part)[row] for part in stretch.columns)
            frame = frame_of(columns, jnp.asarray(stretch.table.order), tape.around.matrix)
            made = first_not_finite(lambda frame: tape.loss.observe(frame, tape.origin, tape.around), frame)
            if made is not None:
                return replace(_blamed(stretch.first + int(row), "loss", made), forward=False)
    made = first_not_finite(lambda total: tape.loss.value(total, tape.frames), tape.total)
    return replace(_blamed(tape.steps, "loss", made), forward=False)


def _looked_into(back: StretchReversal, stretch: TapeStretch, row: int) -> NotFinite:
    """The step of a row, operation by operation."""
    whole = back.arguments(stretch, traced=True)
    loss, origin, *rest = whole[8]
    # the energy of the frame of step 0 is not known there, and nothing that is finite has used it
    zero = jnp.zeros_like(origin.potential)
    whole = (*whole[:8], (loss, origin._replace(potential=zero, virial=zero), *rest), *whole[9:])
    # the rows behind it first, for what it gets
    if row + 1 < stretch.rows:
        behind = _rows(whole, row + 1, stretch.rows)
        carry, _ = transposed(*behind)
    else:
        carry = whole[10]
    here = _rows(whole, row, row + 1)
    here = (*here[:10], carry, *here[11:])
    dynamic, fixed = here[:11], here[11:]
    made = first_not_finite(lambda *args: transposed(*args, *fixed), *dynamic)
    part = "parameters"
    if made is not None:
        part = next((word for name, word in _PARTS if name in made.functions), part)
    return _blamed(stretch.first + row, part, made, _pair(back, stretch, row, made, part))


def _rows(arguments: tuple[Any, ...], first: int, end: int) -> tuple[Any, ...]:
    """The arguments of a reverse pass over some of the rows."""
    out = list(arguments)

    def cut(tree):
        return jax.tree.map(lambda leaf: leaf[first:end], tree)

    for k in (4, 5, 7, 9):
        out[k] = cut(out[k])
    out[6] = end - first
    return tuple(out)


def _pair(
    back: StretchReversal, stretch: TapeStretch, row: int, made: Operation | None, part: str
) -> tuple[int, int, float]:
    """Labels of the pair whose number it is, and its distance."""
    if made is None or not made.index:
        return _NOWHERE
    table, atoms = stretch.table, len(stretch.table.order)
    ends: tuple[int, int] | None = None
    if part == "forces" and made.shape[-2:] == (GROUP, atoms) and made.rounds:
        slot = GROUP * made.rounds[-1] + made.index[-2]
        if slot < table.slots and table.index[slot, made.index[-1]] < atoms:
            ends = made.index[-1], int(table.index[slot, made.index[-1]])
    elif part == "crossings" and back.met is not None:
        inside = np.flatnonzero(back.met.row == row)
        if made.index[-1] < len(inside) and made.shape[-1] != atoms:
            k = inside[made.index[-1]]
            ends = int(back.met.i[k]), int(back.met.j[k])
    if ends is None:
        if made.shape[-1] == atoms:
            return int(table.order[made.index[-1]]), -1, float("nan")
        return _NOWHERE
    cell = HostCell(back.tape.simulation.cell)
    x = stretch.x[row].astype(np.float64)
    displacement = cell.displacement(x[:, [ends[0]]].T, x[:, [ends[1]]].T)
    low, high = sorted(int(table.order[end]) for end in ends)
    return low, high, float(np.sqrt(sum(float(c[0]) ** 2 for c in displacement)))


def _blamed(
    step: int, part: str, made: Operation | None, where: tuple[int, int, float] = _NOWHERE
) -> NotFinite:
    name, source, inputs = ("", "", ()) if made is None else (made.name, made.source, made.inputs)
    return NotFinite(True, True, step, name, inputs, source, part, *where)
