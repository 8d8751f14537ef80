"""Two rollouts side by side: when their bits part, which decision differs first, how far apart they get."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mdnum.ball.contacts import Penalty, Projection
from mdnum.ball.integrators import EventLocated, ImplicitMidpoint
from mdnum.ball.rollout import BallRun
from mdnum.errors import InputError


@dataclass(frozen=True)
class Difference:
    """Where two rollouts of the same length part.

    Attributes:
        seed: first step whose state bits differ (0: the start itself); None where none do.
        fork: first step whose decisions differ; None where none do.
        channel: "contact" or "stop", whichever differs at the fork; "" without one.
        ball: the first ball whose decision differs there; -1 where the decision is the batch's.
        margins: the deciding margin in the first and in the second run: for a contact minus the height, for
            a stop threshold minus residual at the decision that differed.
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


def first_difference(a: BallRun, b: BallRun) -> Difference:
    """Where two rollouts part.

    Raises:
        InputError: of other lengths or batch sizes.
    """
    if (a.steps, a.balls) != (b.steps, b.balls):
        raise InputError(
            f"the first run has {a.steps} steps of {a.balls} balls, the second {b.steps} of {b.balls}",
            remedy="Compare runs of equal size",
        )
    separation = np.zeros(0)
    seed = None
    if a.kept and b.kept:
        y = np.stack([run.y.astype(np.float64) for run in (a, b)])
        v = np.stack([run.v.astype(np.float64) for run in (a, b)])
        separation = np.max(np.abs(y[0] - y[1]), axis=1)
        apart = np.any((y[0] != y[1]) | (v[0] != v[1]), axis=1)
        seed = int(apart.argmax()) if apart.any() else None
    contact = a.contact != b.contact
    # a rule per ball and a rule for all have counts of other shapes: compare them per ball
    counts = [_per_ball(run) for run in (a, b)]
    stops = counts[0] != counts[1]
    if not counts_alike(a, b):
        # impacts are no iterations, and a run without a solver has stopped none: nothing to compare
        stops = np.zeros_like(stops)
    at = [
        int(steps.argmax()) if (steps := differ.any(axis=1)).any() else a.steps for differ in (contact, stops)
    ]
    row = min(at)
    if row == a.steps:
        return Difference(seed, None, "", -1, (np.nan, np.nan), 0, 0, separation)
    channel = "contact" if at[0] <= at[1] else "stop"
    ball = int((contact if channel == "contact" else stops)[row].argmax())
    if channel == "contact":
        margins = _contact_margin(a, row, ball), _contact_margin(b, row, ball)
    else:
        margins = _stop_margins(a, b, row, ball)
        ball = ball if a.iterations.ndim == 2 else -1
    return Difference(
        seed, row + 1, channel, ball, margins, int(stops.any(axis=1).sum()), int(contact.sum()), separation
    )


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


def _per_ball(run: BallRun) -> np.ndarray:
    counts = run.iterations
    return counts if counts.ndim == 2 else np.broadcast_to(counts[:, None], run.contact.shape)


def _contact_margin(run: BallRun, row: int, ball: int) -> float:
    return -float(run.height[row, ball]) if len(run.height) else np.nan


def _stop_margins(a: BallRun, b: BallRun, row: int, ball: int) -> tuple[float, float]:
    """The margins of the decision after which one run stopped and the other went on."""

    def at(run: BallRun, name: str) -> float:
        values = getattr(run, name)
        return float(values[row, ball] if values.ndim == 2 else values[row])

    counts = [int(_per_ball(run)[row, ball]) for run in (a, b)]
    shorter, longer = (a, b) if counts[0] < counts[1] else (b, a)
    # the longer run's decision at that iteration is on record if it made just one more iteration
    went_on = at(longer, "before") if abs(counts[0] - counts[1]) == 1 else np.nan
    stopped = at(shorter, "margin")
    return (stopped, went_on) if shorter is a else (went_on, stopped)
