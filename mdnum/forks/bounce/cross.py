"""Decisions that two runs of a ball make differently, each with its margin and its rounding bound."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mdnum.ball.contacts import Projection
from mdnum.ball.rollout import BallRun, counts_alike, height_bound, residual_bound


@dataclass(frozen=True)
class Differing:
    """The decisions that differ, by step and ball; those of contacts before those of solvers.

    Attributes:
        step: of each, from 1.
        channel: "contact" or "stop".
        ball: whose; -1 for a count that all balls share.
        a, b: what each run decided: whether the ball touches, or how many iterations.
        margin_a, margin_b: of the decision in each run (see `ball.compare.Difference`); NaN where a run made
            no such decision.
        bound_a, bound_b: on the rounding error of what was compared.
    """

    step: Int[np.ndarray, "rows"]
    channel: np.ndarray
    ball: Int[np.ndarray, "rows"]
    a: Int[np.ndarray, "rows"]
    b: Int[np.ndarray, "rows"]
    margin_a: Float[np.ndarray, "rows"]
    margin_b: Float[np.ndarray, "rows"]
    bound_a: Float[np.ndarray, "rows"]
    bound_b: Float[np.ndarray, "rows"]

    def __len__(self) -> int:
        return len(self.step)

    def by_step(self, steps: int) -> Int[np.ndarray, "times"]:
        """How many differ at each step 0..steps."""
        return np.bincount(self.step, minlength=steps + 1)[: steps + 1]


def differing(a: BallRun, b: BallRun, last: int | None = None) -> Differing:
    """Every decision that two runs of as many steps and balls make differently.

    Args:
        a, b: with every state kept.
        last: the last step to look at; default all.
    """
    rows = a.steps if last is None else last
    contact = np.argwhere(a.contact[:rows] != b.contact[:rows])
    parts = [_contacts(a, b, contact)]
    if counts_alike(a, b):
        shared = a.iterations.ndim == b.iterations.ndim == 1
        if shared:
            off = np.argwhere(a.iterations[:rows] != b.iterations[:rows])
            off = np.c_[off, np.full(len(off), -1)]
        else:
            counts = [one.iterations.reshape(one.steps, -1)[:rows] for one in (a, b)]
            unequal = np.broadcast_to(counts[0] != counts[1], (rows, a.balls))
            off = np.argwhere(unequal & (_solving(a, rows) | _solving(b, rows)))
        parts.append(_stops(a, b, off))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    # the channels are in one list, in the order of steps
    order = np.lexsort((columns[2], columns[1] == "stop", columns[0]))
    return Differing(*(column[order] for column in columns))


def _contacts(a: BallRun, b: BallRun, at: np.ndarray) -> tuple[np.ndarray, ...]:
    row, ball = at.T
    found = [row + 1, np.full(len(row), "contact"), ball]
    found += [one.contact[row, ball].astype(np.int64) for one in (a, b)]
    found += [-one.height[row, ball].astype(np.float64) for one in (a, b)]
    found += [height_bound(one.world, one.y[row, ball], one.v[row, ball]) for one in (a, b)]
    return tuple(found)


def _stops(a: BallRun, b: BallRun, at: np.ndarray) -> tuple[np.ndarray, ...]:
    row, ball = at.T
    counts = [_at(one.iterations, row, ball).astype(np.int64) for one in (a, b)]
    fewer = np.minimum(*counts)
    found = [row + 1, np.full(len(row), "stop"), ball, *counts]
    margins, bounds = [], []
    for one, count in zip((a, b), counts, strict=True):
        stopped, before, residual = (
            _at(values, row, ball).astype(np.float64) for values in (one.margin, one.before, one.residual)
        )
        # the decision at which one went on and the other did not is on record in the run that stopped, and
        # in the other if it stopped at the next
        margin = np.where(count == fewer, stopped, np.where(count == fewer + 1, before, np.nan))
        margins.append(margin)
        compared = np.abs(residual + stopped - margin)
        terms = 1 if one.iterations.ndim == 2 else one.balls
        bounds.append(residual_bound(one.world, np.where(np.isfinite(compared), compared, 0.0), terms))
    return (*found, *margins, *bounds)


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
    """How many decisions of a run that was told them it would have made otherwise, and how far from it.

    Args:
        run: told every decision.
        last: the last step to look at; default all.

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
    count = against.sum(axis=1)
    margin, earlier = run.margin[:rows].astype(np.float64), run.before[:rows].astype(np.float64)
    # it would have stopped just where it was told to if it went on before and stops there
    solved = np.isfinite(run.residual[:rows].astype(np.float64))
    held = (margin > 0) & (earlier <= 0)
    cap = _cap(run)
    if cap is not None:
        held |= (run.iterations[:rows] >= cap) & (earlier <= 0)
    if solved.ndim == 2:
        solved &= _solving(run, rows)
    stops = (solved & ~held).reshape(rows, -1).sum(axis=1)
    return np.r_[0, count + stops], np.r_[0.0, far.max(axis=1, initial=0.0)]


def _cap(run: BallRun) -> int | None:
    """The most iterations of a solve; None where nothing is solved."""
    world = run.world
    rule = getattr(world.contact, "stop", None) or getattr(world.integrator, "stop", None)
    return None if rule is None else rule.max_iter
