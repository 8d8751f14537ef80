"""Decisions of a run, given its own states: which of them rounding could have decided otherwise.

This looks at one step at a time. A decision that is right given the state is right for this run, which may
have left the exact history long before (that is what `certify` dates).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.forks.exact.tape import DecisionTape
from mdnum.md.cell import Cell, HostCell
from mdnum.md.decide import PairDecider
from mdnum.rollout.compared import ReferenceFrame
from mdnum.rollout.engine import FAILURES, Engine, Segment, Start
from mdnum.rollout.flips import PairRecorder, decided_pairs
from mdnum.rollout.tracks import rows_of
from mdnum.systems.build import Simulation

#: Ambiguous decisions that are listed; the count covers all of them.
LISTED = 10_000
#: Binary digits behind the point to which the square root of an exact squared distance is taken.
_ROOT_BITS = 400


@dataclass(frozen=True)
class AmbiguousDecision:
    """A decision closer to its threshold than its rounding bound.

    Attributes:
        step, i, j: which decision; i < j.
        inside: as the program decided.
        margin: threshold - quantity as it computed it, in the quantity's space.
        bound: on the rounding error of that margin.
        exact: the margin of the same state without any rounding.
        wrong: whether the exact margin asks for the other decision.
    """

    step: int
    i: int
    j: int
    inside: bool
    margin: float
    bound: float
    exact: float
    wrong: bool


@dataclass(frozen=True)
class CertifiedHorizon:
    """What is certain about the decisions of one run, from its own states.

    Attributes:
        steps: last step that was looked at.
        horizon: first step with an ambiguous decision; every decision before it would have come out the same
            in exact arithmetic from the same states. None where there is none.
        wrong: first step with a decision that exact arithmetic decides otherwise; None where there is none.
        total: ambiguous decisions.
        decisions: the first of them.
        bounds: of the margin, by pair type, in the quantity's space: the largest of any step.
        closest: smallest |margin| of any pair at each step, in the quantity's space, shape (steps + 1,).
    """

    steps: int
    horizon: int | None
    wrong: int | None
    total: int
    decisions: tuple[AmbiguousDecision, ...]
    bounds: tuple[float, ...]
    closest: Float[np.ndarray, "rows"]


@dataclass(frozen=True)
class Taped:
    """A real run as the tape of its decisions.

    Attributes:
        tape: what it decided.
        x: wrapped positions, length, shape (rows, 3, atoms).
        failed: "blow-up", "runaway", or "".
    """

    tape: DecisionTape
    x: Float[np.ndarray, "rows 3 atoms"]
    failed: str


def taped(simulation: Simulation, steps: int, start: Start | None = None) -> Taped:
    """Run a simulation and keep every decision and position up to a step."""
    engine, recorder = Engine(simulation, steps, start=start), PairRecorder(simulation)
    frame = ReferenceFrame.same(simulation.atoms)
    first, failed, last = np.empty(0, np.int64), "", 0
    rows, at, keys, entered = [], [], [], []
    for segment in engine.segments():
        if not rows:
            first = decided_pairs(simulation, segment, 0)
        ledger = recorder.flips(segment)
        at.append(ledger.step)
        keys.append(ledger.subject[:, 0].astype(np.int64) * simulation.atoms + ledger.subject[:, 1])
        entered.append(ledger.entered)
        failed = segment.closes if segment.closes in FAILURES else ""
        rows.append(rows_of(segment, frame, failed).x)
        last = segment.last
    step, key, now = np.concatenate(at).astype(np.int64), np.concatenate(keys), np.concatenate(entered)
    order = np.lexsort((key, step))
    tape = DecisionTape(simulation.atoms, last, first, step[order], key[order], now[order])
    return Taped(tape, np.concatenate(rows), failed)


def exact_margin(
    decider: PairDecider,
    cell: Cell,
    start: Float[np.ndarray, "3"],
    end: Float[np.ndarray, "3"],
    kind: int = 0,
) -> tuple[Fraction, bool]:
    """The margin of a pair without rounding, and the decision that it asks for.

    Positions are the floats of the state; the threshold and the lattice vectors are the doubles of the
    system, as in the exact program, whatever the decision holds. In the space of r the margin is good to 400
    binary digits, the decision exact.

    Args:
        start, end: positions, length.
        kind: pair type.
    """
    matrix = np.asarray(cell.matrix, np.float64)
    inverse = [[Fraction(float(c)) for c in row] for row in np.asarray(cell.inverse)]
    d = [Fraction(float(b)) - Fraction(float(a)) for a, b in zip(start, end, strict=True)]
    n = [round(sum((d[c] * inverse[c][k] for c in range(3)), start=Fraction(0))) for k in range(3)]
    for k in range(3):
        if cell.pbc[k]:
            d = [d[c] - n[k] * Fraction(float(matrix[k, c])) for c in range(3)]
    squared = sum((c * c for c in d), start=Fraction(0))
    value = Fraction(decider.exact_thresholds[kind])
    against = value * value if decider.space == "r" else value
    inside = squared <= against if decider.compare.endswith("<=") else squared < against
    quantity = _root(squared) if decider.space == "r" else squared
    return value - quantity, inside


def _root(x: Fraction) -> Fraction:
    scaled = (x.numerator << (2 * _ROOT_BITS)) // x.denominator
    return Fraction(math.isqrt(scaled), 1 << _ROOT_BITS)


def certified_horizon(
    simulation: Simulation,
    steps: int | None = None,
    *,
    start: Start | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CertifiedHorizon:
    """Every decision of a run against its rounding bound, and the ambiguous ones in exact arithmetic.

    Args:
        simulation: a pair potential.
        steps: last step; default the system's own.
        start: where it begins; default the system's own start.
        progress: called with the step reached and the last one.

    Raises:
        InputError: a many-body potential, or a rebuild rule that may miss pairs.
    """
    _check(simulation)
    last = simulation.system.spec.dynamics.steps if steps is None else steps
    listed: list[AmbiguousDecision] = []
    closest: list[np.ndarray] = []
    total, reached = 0, 0
    horizon = wrong = None
    largest = np.array(simulation.decider.bounds)
    for segment in Engine(simulation, last, start=start).segments():
        bounds = simulation.decider.bounds_at(segment.rows_of("x"))
        largest = np.maximum(largest, bounds.max(axis=0))
        nearest = segment.rows_of("nearest")
        closest.append(nearest)
        for row in np.flatnonzero(nearest <= bounds.max(axis=1)):
            found = _ambiguous(simulation, segment, int(row), bounds[row])
            total += len(found)
            if found and horizon is None:
                horizon = segment.first + int(row)
            if wrong is None and any(one.wrong for one in found):
                wrong = segment.first + int(row)
            listed += found[: max(0, LISTED - len(listed))]
        reached = segment.last
        if progress is not None:
            progress(reached, last)
    bounds = tuple(largest.tolist())
    return CertifiedHorizon(reached, horizon, wrong, total, tuple(listed), bounds, np.concatenate(closest))


def _check(simulation: Simulation) -> None:
    if not simulation.pairwise:
        raise InputError(
            f"{simulation.potential.name!r} decides inside jax-md's own list, without a rounding bound",
            remedy="Use a pair potential",
            where="potential.kind",
        )
    if not simulation.rule.safe:
        raise InputError(
            "this rebuild rule may leave pairs out of the list, and then nothing is decided about them",
            remedy="Use --set neighbors.rebuild.every=1 with check = true",
            where="neighbors.rebuild",
        )


def _ambiguous(
    simulation: Simulation, segment: Segment, row: int, bounds: Float[np.ndarray, "types"]
) -> list[AmbiguousDecision]:
    table, decider = segment.table, simulation.decider
    x = segment.unsorted("x", row)
    slot, column = np.nonzero(table.index < simulation.atoms)
    i, j = table.order[column], table.order[table.index[slot, column]]
    i, j = i[i < j], j[i < j]
    kind = simulation.type_of(i, j)
    d = HostCell(simulation.cell, decider.dtype).displacement(x[i], x[j])
    quantity = decider.host_quantity(*d)
    value = np.array([t.value for t in decider.thresholds])[kind]
    margin = value - quantity.astype(np.float64)
    decided = decider.inside(quantity.astype(np.float64), value)
    found = []
    for p in np.flatnonzero(np.abs(margin) <= bounds[kind]).tolist():
        exact, inside = exact_margin(decider, simulation.cell, x[i[p]], x[j[p]], int(kind[p]))
        found.append(
            AmbiguousDecision(
                segment.first + row,
                int(i[p]),
                int(j[p]),
                bool(decided[p]),
                float(margin[p]),
                float(bounds[kind[p]]),
                float(exact),
                bool(decided[p]) != inside,
            )
        )
    return sorted(found, key=lambda one: (one.i, one.j))
