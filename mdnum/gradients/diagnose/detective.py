"""Search for the first operation of a reverse pass that gives an infinite or NaN result.

Examples are a square root at zero in the loss, and an overflow of a sum. The reverse pass is repeated up to
the first step with a non-finite number. The operations of this step are then run one by one. An operation is
the cause if its inputs are finite and its result is not. A finite number in place of the result must make the
program's result finite. Numbers that are masked out later are therefore not a cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mdnum.gradients import parameters
from mdnum.gradients.adjoint import StretchReversal, transposed
from mdnum.gradients.problem import Problem, Progress
from mdnum.gradients.recorded import GUARD, radial_speed, tape_of, wanted
from mdnum.gradients.tape import RunTape, TapeStretch, seen_in
from mdnum.md.cell import HostCell
from mdnum.md.decide import GROUP
from mdnum.numerics.jaxprs import Operation, count_bad, first_not_finite, is_inexact

#: Part of a step to which an operation belongs, by the functions that call it; the first match counts.
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


@dataclass(frozen=True)
class NotFinite:
    """The step, operation and pair of atoms with the first infinite or NaN result."""

    found: bool = False  # whether it does at all
    forward: bool = True  # whether the forward run, its loss included, is finite
    step: int = -1  # the first step, in the order of the reverse pass (last in time); -1 where all is finite
    # the first operation there whose inputs are finite and whose result is not; empty where no single
    # operation is
    operation: str = ""
    inputs: tuple[float, ...] = ()  # its numbers at that place
    source: str = ""  # file:line:function that wrote it; empty where it is not known
    part: str = ""  # "loss", "forces", "crossings", "drift" or "parameters"
    # i, j: the pair at fault, i < j; -1 where it is no pair (j alone -1: an atom)
    i: int = -1
    j: int = -1
    distance: float = float("nan")  # of the pair, length; NaN where there is none


def detective(
    problem: Problem,
    names: Sequence[str],
    *,
    saltation: bool = True,
    tape: RunTape | None = None,
    progress: Progress | None = None,
) -> NotFinite:
    """Find the first step, operation and pair with an infinite or NaN result.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: parameters, full or short names. saltation: whether to include the contribution of flips.
        tape: the run, if already made (with flips, if saltation is requested).

    Raises:
        InputError: a parameter does not exist, or the potential is no pair potential.
        NumericalError: the run blew up.
    """
    simulation = problem.simulation
    full = parameters.resolve(simulation, names)
    if tape is None:
        tape = tape_of(problem, saltation, progress=progress)
    if not np.isfinite(tape.value):
        return _in_forward(tape)
    back = StretchReversal(tape, wanted(full), GUARD * radial_speed(simulation) if saltation else None)
    if count_bad(back.onto_total):
        made = first_not_finite(jax.grad(lambda total: tape.loss.value(total, tape.frames)), tape.total)
        return _blamed(tape.steps, "loss", made)
    for stretch in tape.backward():
        before = back.carry
        _, trace = back.through(stretch)
        # the latest row whose cotangents are not finite
        leaves = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(trace) if is_inexact(leaf)]
        bad = (row for row in reversed(range(stretch.rows)) if count_bad([leaf[row] for leaf in leaves]))
        row = next(bad, None)
        if row is None and count_bad(back.carry):
            # what a crossing before the first row of a stretch adds is seen in the carry alone
            row = 0
        if row is not None:
            back.carry = before
            return _looked_into(back, stretch, row)
        if progress is not None:
            progress(tape.steps - stretch.first, tape.steps, "reverse pass")
    return NotFinite()


def _in_forward(tape: RunTape) -> NotFinite:
    """Find the first frame of a finite run at which the loss is not finite."""
    for stretch in tape.forward():
        seen = tape.seen(stretch)
        for row in np.flatnonzero(seen[: stretch.rows]):
            columns = jax.tree.map(lambda part, row=row: part[row], stretch.columns)
            frame, *rest = seen_in(columns, jnp.asarray(stretch.table.order), tape.origin, tape.around)
            made = first_not_finite(lambda frame, rest=rest: tape.loss.observe(frame, *rest), frame)
            if made is not None:
                return replace(_blamed(stretch.first + int(row), "loss", made), forward=False)
    made = first_not_finite(lambda total: tape.loss.value(total, tape.frames), tape.total)
    return replace(_blamed(tape.steps, "loss", made), forward=False)


def _looked_into(back: StretchReversal, stretch: TapeStretch, row: int) -> NotFinite:
    """Run the reverse pass of one step operation by operation. Find the cause of non-finite numbers."""
    whole = back.arguments(stretch)
    loss, origin, *rest = whole[8]
    # the energy of the frame of step 0 is not known there, and nothing that is finite has used it
    zero = jnp.zeros_like(origin.potential)
    whole = (*whole[:8], (loss, origin._replace(potential=zero, virial=zero), *rest), *whole[9:])
    # the rows behind it first, for what it gets
    behind = row + 1 < stretch.rows
    carry = transposed(*_rows(whole, row + 1, stretch.rows))[0] if behind else whole[10]
    here, fixed = _rows(whole, row, row + 1), whole[11:]
    made = first_not_finite(lambda *args: transposed(*args, *fixed), *here[:10], carry)
    part = "parameters"
    if made is not None:
        part = next((word for name, word in _PARTS if name in made.functions), part)
    return _blamed(stretch.first + row, part, made, _pair(back, stretch, row, made, part))


def _rows(arguments: tuple[Any, ...], first: int, end: int) -> tuple[Any, ...]:
    """Restrict the arguments of a reverse pass to a range of time steps."""
    out = list(arguments)
    for k in (4, 5, 7):
        out[k] = jax.tree.map(lambda leaf: leaf[first:end], out[k])
    out[6] = end - first
    if out[9] is not None:
        # crossings of all rows lie one after the other; a span tells which are a row's
        out[9] = out[9]._replace(spans=out[9].spans[first:end])
    return tuple(out)


def _pair(
    back: StretchReversal, stretch: TapeStretch, row: int, made: Operation | None, part: str
) -> tuple[int, int, float]:
    """Return the atoms and the distance of the pair of a result, or -1, -1, NaN."""
    nowhere = (-1, -1, float("nan"))
    if made is None or not made.index:
        return nowhere
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
        return (int(table.order[made.index[-1]]), *nowhere[1:]) if made.shape[-1] == atoms else nowhere
    cell = HostCell(stretch.cell_of(row, back.tape.simulation.cell))
    x = stretch.x[row].astype(np.float64)
    displacement = cell.displacement(x[:, [ends[0]]].T, x[:, [ends[1]]].T)
    low, high = sorted(int(table.order[end]) for end in ends)
    return low, high, float(np.sqrt(sum(float(c[0]) ** 2 for c in displacement)))


def _blamed(step: int, part: str, made: Operation | None, where: tuple[Any, ...] = ()) -> NotFinite:
    name, source, inputs = ("", "", ()) if made is None else (made.name, made.source, made.inputs)
    return NotFinite(True, True, step, name, inputs, source, part, *where)
