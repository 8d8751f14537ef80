"""Where a reverse pass stops being finite while the run it belongs to is fine.

A force can be finite where its derivative is not, a loss can have a root at zero, a sum can leave the range
of its format on the way back. The pass is repeated up to the step at which that happens, and that step is
run operation by operation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mdnum.gradients import parameters
from mdnum.gradients.adjoint import Backward, Trace, transposed
from mdnum.gradients.base import Problem, Progress
from mdnum.gradients.diagnose.operations import Operation, first_not_finite
from mdnum.gradients.diagnose.places import NotFinite
from mdnum.gradients.symmetric import GUARD, in_phase, radial_speed, wanted
from mdnum.gradients.tape import Stretch, Tape, frame_of, rows_of
from mdnum.md.cell import HostCell
from mdnum.md.decide import GROUP

#: Part of a step by the functions on the way to an operation; the first that is there counts.
_PARTS = (
    ("onto_crossings", "crossings"),
    ("look", "loss"),
    ("seen_at", "loss"),
    ("observe", "loss"),
    ("pull_back", "forces"),
    ("drift", "drift"),
)
_NOWHERE = (-1, -1, float("nan"))


def detective(
    problem: Problem,
    names: Sequence[str],
    *,
    saltation: bool = True,
    budget: int = 2**29,
    tape: Tape | None = None,
    progress: Progress | None = None,
) -> NotFinite:
    """The first step and operation of the reverse pass that is not finite, and the pair at fault.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: parameters, full or short names.
        saltation: whether flips count.
        budget: bytes of the recorded run that are kept.
        tape: the run, where it has been made (with flips, if saltation is asked for).
        progress: called with the steps done, all steps, and a phase in words.

    Raises:
        InputError: no such parameter, or no pair potential. NumericalError: the run blew up.
    """
    simulation = problem.simulation
    full = parameters.resolve(simulation, names)
    if tape is None:
        tape = Tape(
            simulation,
            problem.loss,
            problem.steps,
            flips=saltation,
            budget=budget,
            progress=in_phase(progress, "run"),
        )
    if not np.isfinite(tape.value):
        return _in_forward(tape)
    back = Backward(tape, wanted(full), GUARD * radial_speed(simulation) if saltation else None)
    if not _all_finite(back.onto_total):
        made = first_not_finite(jax.grad(lambda total: tape.loss.value(total, tape.frames)), tape.total)
        return _told(tape.steps, "loss", made, _NOWHERE, "the number that the loss makes of its sums")
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
    return NotFinite(False, True, -1, "", "", "", *_NOWHERE, "Every step of the reverse pass is finite.")


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


def _in_forward(tape: Tape) -> NotFinite:
    """The run is finite, the loss is not: the first frame at which it is not."""
    for stretch in tape.forward():
        seen = tape.seen(stretch)
        for row in np.flatnonzero(seen[: stretch.rows]):
            columns = tuple(np.asarray(part)[row] for part in rows_of(stretch))
            frame = frame_of(columns, jnp.asarray(stretch.table.order), tape.around.matrix)
            made = first_not_finite(lambda frame: tape.loss.observe(frame, tape.origin, tape.around), frame)
            if made is not None:
                step = stretch.first + int(row)
                found = _told(step, "loss", made, _NOWHERE, "the loss of one frame")
                return _without_forward(found)
    made = first_not_finite(lambda total: tape.loss.value(total, tape.frames), tape.total)
    return _without_forward(_told(tape.steps, "loss", made, _NOWHERE, "the number made of its sums"))


def _without_forward(found: NotFinite) -> NotFinite:
    values = dict(vars(found)) | {
        "forward": False,
        "says": found.says.replace("The reverse pass", "The loss itself"),
    }
    return NotFinite(**values)


def _looked_into(back: Backward, stretch: Stretch, row: int) -> NotFinite:
    """The step of a row, operation by operation."""
    whole = back.arguments(stretch, traced=True)
    loss, origin, *rest = whole[8]
    # the energy of the frame of step 0 is not known there, and nothing that is finite has used it
    zero = jnp.zeros_like(origin.potential)
    whole = (*whole[:8], (loss, origin._replace(potential=zero, virial=zero), *rest), *whole[9:])
    # the rows behind it first, for what it is handed
    if row + 1 < stretch.rows:
        behind = _rows(whole, row + 1, stretch.rows)
        carry, _ = transposed(*behind)
    else:
        carry = whole[10]
    here = _rows(whole, row, row + 1)
    here = (*here[:10], carry, *here[11:])
    dynamic, fixed = here[:11], here[11:]
    made = first_not_finite(lambda *args: transposed(*args, *fixed), *dynamic)
    step = stretch.first + row
    part = "parameters"
    if made is not None:
        part = next((word for name, word in _PARTS if name in made.functions), part)
    return _told(step, part, made, _pair(back, stretch, row, made, part), "a step")


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
    back: Backward, stretch: Stretch, row: int, made: Operation | None, part: str
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
    apart = cell.displacement(x[:, [ends[0]]].T, x[:, [ends[1]]].T)
    low, high = sorted(int(table.order[end]) for end in ends)
    return low, high, float(np.sqrt(sum(float(c[0]) ** 2 for c in apart)))


def _told(
    step: int, part: str, made: Operation | None, where: tuple[int, int, float], what: str
) -> NotFinite:
    i, j, distance = where
    name, source = ("", "") if made is None else (made.name, made.source)
    says = f"The reverse pass stops being finite at step {step}, in the {part}"
    if made is None:
        says += f" ({what}): a number is not finite that no single operation makes so."
    else:
        given = ", ".join(f"{value:.4g}" for value in made.inputs)
        says += f": {name}({given}) in {source or 'JAX itself'}"
        if j >= 0:
            says += f", for the pair ({i}, {j}) at distance {distance:.6g}"
        elif i >= 0:
            says += f", for atom {i}"
        says += "."
    return NotFinite(True, True, step, name, source, part, i, j, distance, says)
