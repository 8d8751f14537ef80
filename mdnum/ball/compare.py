"""Two rollouts side by side: what they decide differently, when, by how much."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mdnum.ball.contacts import Penalty, Projection
from mdnum.ball.integrators import EventLocated, ImplicitMidpoint
from mdnum.ball.rollout import BallRun, height_bound, residual_bound
from mdnum.errors import InputError


class CrossDecision(NamedTuple):
    """A decision that two runs made differently.

    Attributes:
        step: from 1.
        channel: "contact" or "stop".
        ball: whose; -1 for a count that all balls share.
        a, b: what each run decided: whether the ball touches, or how many iterations.
        margin_a, margin_b: minus the height, or tolerance minus residual at the decision at which one run
            stopped and the other did not; NaN where a run made no such decision.
        bound_a, bound_b: on the rounding error of what was compared.
    """

    step: int
    channel: str
    ball: int
    a: int
    b: int
    margin_a: float
    margin_b: float
    bound_a: float
    bound_b: float

    @property
    def run(self) -> str:
        """The run that decided yes: in which the ball touches, or the solver stops first."""
        return "A" if (self.a > self.b) == (self.channel == "contact") else "B"


@dataclass(frozen=True)
class BallDifference:
    """Where two rollouts of the same length diverge.

    Attributes:
        seed: first step whose state bits differ (0: the start itself); None where none do.
        fork: first step whose decisions differ; None where none do.
        channel: "contact" or "stop", whichever differs at the fork; "" without one.
        ball: the first ball whose decision differs there; -1 where the decision is the batch's.
        margins: the deciding margin in the first and in the second run (see `CrossDecision`).
        iterations_differ: number of steps whose iteration counts differ; 0 where the runs count other things
            (impacts, iterations of one solver or another, nothing).
        contacts_differ: number of contact decisions that differ.
        separation: largest |difference| of heights at each step, m, shape (steps + 1,); empty where states
            were not kept.
    """

    seed: int | None
    fork: int | None
    channel: str
    ball: int
    margins: tuple[float, float]
    iterations_differ: int
    contacts_differ: int
    separation: Float[np.ndarray, "times"]


def first_difference(a: BallRun, b: BallRun) -> BallDifference:
    """Where two rollouts diverge.

    Raises:
        InputError: of other lengths or batch sizes.
    """
    if (a.steps, a.balls) != (b.steps, b.balls):
        raise InputError(
            f"the first run has {a.steps} steps of {a.balls} balls, the second {b.steps} of {b.balls}",
            remedy="Compare runs of equal size",
        )
    separation, seed = np.zeros(0), None
    if a.kept and b.kept:
        y, v = (np.stack([getattr(run, name).astype(np.float64) for run in (a, b)]) for name in "yv")
        separation = np.max(np.abs(y[0] - y[1]), axis=1)
        bits = np.any((y[0] != y[1]) | (v[0] != v[1]), axis=1)
        seed = int(bits.argmax()) if bits.any() else None
    contact, stops = a.contact != b.contact, _unequal_counts(a, b, a.steps)
    steps = np.flatnonzero(contact.any(axis=1) | stops.any(axis=1))
    if not len(steps):
        return BallDifference(seed, None, "", -1, (np.nan, np.nan), 0, 0, separation)
    first = cross_decisions(a, b, int(steps[0]) + 1)[0]
    return BallDifference(
        seed, first.step, first.channel, first.ball, (first.margin_a, first.margin_b),
        int(stops.any(axis=1).sum()), int(contact.sum()), separation,
    )  # fmt: skip


def cross_decisions(a: BallRun, b: BallRun, last: int | None = None) -> list[CrossDecision]:
    """Every decision that two runs of equal size make differently, contacts of a step before its stops.

    Args:
        a, b: margins and bounds of contacts are NaN where states were not kept.
        last: the last step to compare; default all.
    """
    rows = a.steps if last is None else last
    row, ball = np.nonzero(a.contact[:rows] != b.contact[:rows])
    columns: list[Any] = [row + 1, np.full(len(row), "contact"), ball]
    columns += [run.contact[row, ball].astype(np.int64) for run in (a, b)]
    unknown = np.full(len(row), np.nan)
    kept = a.kept and b.kept
    columns += [-run.height[row, ball].astype(np.float64) if kept else unknown for run in (a, b)]
    columns += [
        height_bound(run.world, run.y[row, ball], run.v[row, ball]) if kept else unknown for run in (a, b)
    ]
    found = [CrossDecision(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]
    found += _stops(a, b, rows)
    return sorted(found, key=lambda flip: (flip.step, flip.channel == "stop", flip.ball))


def _stops(a: BallRun, b: BallRun, rows: int) -> list[CrossDecision]:
    """Solves whose iterations differ."""
    row, ball = np.nonzero(_unequal_counts(a, b, rows))
    if a.iterations.ndim == b.iterations.ndim == 1:
        ball = np.full(len(row), -1)
    made = [_at(run.iterations, row, ball).astype(np.int64) for run in (a, b)]
    fewer = np.minimum(*made)
    margins, bounds = [], []
    for run, count in zip((a, b), made, strict=True):
        stopped, before, residual = (
            _at(values, row, ball).astype(np.float64) for values in (run.margin, run.before, run.residual)
        )
        # the decision at which one went on and the other did not is on record in the run that stopped, and
        # in the other if it stopped at the next
        margin = np.where(count == fewer, stopped, np.where(count == fewer + 1, before, np.nan))
        margins.append(margin)
        compared = np.abs(residual + stopped - margin)
        terms = 1 if run.iterations.ndim == 2 else run.balls
        bounds.append(residual_bound(run.world, np.where(np.isfinite(compared), compared, 0.0), terms))
    columns = (row + 1, np.full(len(row), "stop"), ball, *made, *margins, *bounds)
    return [CrossDecision(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]


def _solving(run: BallRun, rows: int) -> np.ndarray:
    """Whether iterations move each ball: where a shared rule goes on, balls that do not touch stay put."""
    if isinstance(run.world.contact, Projection):
        return run.contact[:rows]
    return np.ones((rows, run.balls), bool)


def _at(values: np.ndarray, row: np.ndarray, ball: np.ndarray) -> np.ndarray:
    return values[row] if values.ndim == 1 else values[row, ball]


def overridden(
    run: BallRun, last: int | None = None
) -> tuple[Int[np.ndarray, "times"], Float[np.ndarray, "times"]]:
    """How many imposed decisions a run would have made otherwise, and how far it was from them.

    Args:
        run: under imposed decisions.
        last: the last step to compare; default all.

    Returns:
        the number at each step 0..last, and the largest |height - threshold| of its contacts, m, 0 for none.
    """
    rows = run.steps if last is None else last
    # as it is compared: in the dtype of decisions
    height = run.height[:rows].astype(run.world.policy.dtype("decision")).astype(np.float64)
    before = np.vstack([np.asarray(run.y[:1] < 0), run.contact[:rows][:-1]]) if rows else run.contact[:0]
    lift = 0.0 if run.world.lift is None else float(run.world.lift)
    threshold = np.where(before, lift, 0.0)
    own = np.where(before & (lift > 0), height <= lift, height < 0)
    against = own != run.contact[:rows]
    far = np.where(against, np.abs(height - threshold), 0.0)
    margin, earlier = run.margin[:rows].astype(np.float64), run.before[:rows].astype(np.float64)
    # it would have stopped just where it was made to if it went on before and stops there
    solved = np.isfinite(run.residual[:rows].astype(np.float64))
    held = (margin > 0) & (earlier <= 0)
    world = run.world
    rule = getattr(world.contact, "stop", None) or getattr(world.integrator, "stop", None)
    if rule is not None:
        held |= (run.iterations[:rows] >= rule.max_iter) & (earlier <= 0)
    if solved.ndim == 2:
        solved &= _solving(run, rows)
    stops = (solved & ~held).reshape(rows, -1).sum(axis=1)
    return np.r_[0, against.sum(axis=1) + stops], np.r_[0.0, far.max(axis=1, initial=0.0)]


def _unequal_counts(a: BallRun, b: BallRun, rows: int) -> np.ndarray:
    """Solves whose iterations differ, shape (rows, 1) where one rule stops all balls, else by ball."""
    counts = [run.iterations.reshape(run.steps, -1)[:rows] for run in (a, b)]
    differ = counts[0] != counts[1]
    if not counts_alike(a, b):
        # impacts are no iterations, and a run without a solver has stopped none: nothing to compare
        return np.zeros_like(differ)
    if a.iterations.ndim == b.iterations.ndim == 1:
        return differ
    return differ & (_solving(a, rows) | _solving(b, rows))


def counts_alike(a: BallRun, b: BallRun) -> bool:
    """Whether the iteration counts of two runs count the same, so that they can be compared."""
    return _counted(a) == _counted(b)


def _counted(run: BallRun) -> str:
    """What the iteration counts of a run count."""
    contact, scheme = run.world.contact, run.world.integrator
    if isinstance(scheme, EventLocated):
        return "impacts"
    if isinstance(contact, Projection):
        return "iterations of a projection"
    if isinstance(contact, Penalty) and isinstance(scheme, ImplicitMidpoint):
        return "iterations of Newton's method"
    return "nothing"
