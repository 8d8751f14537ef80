"""The tables of a ball's run folder, from the record of a run."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from mdnum.ball.contacts import Penalty, Projection
from mdnum.ball.rollout import BallRun, Difference, residual_bound
from mdnum.ball.state import Reason
from mdnum.ball.stopping import Fixed
from mdnum.store import RunFolder
from mdnum.systems.build_ball import BallVariant

#: Balls whose heights are kept in the folder, and that are compared with the exact motion.
FOLLOWED = 8
#: Codes of `Reason`, from what says least to what says most about a step.
_WORST = (Reason.NONE, Reason.FIXED, Reason.TOLERANCE, Reason.REST, Reason.CAP, Reason.NOT_FINITE)


def write(folder: RunFolder, run: BallRun) -> None:
    """Appends the rows of every table."""
    folder.append("steps", steps(run))
    folder.append("contacts", contacts(run))
    folder.append("solver", decisions(run))
    if run.kept:
        folder.append("heights", heights(run))


def steps(run: BallRun) -> dict[str, np.ndarray]:
    """A row per state 0..steps: contacts, flips, the solver's end, margins, mean height and energy."""
    entered, left = run.contacts.counts(run.steps)
    inside = run.contact.sum(axis=1)
    first = inside[0] - entered[1] + left[1]
    none = np.full(run.steps, np.nan)
    residual, margin = _of_batch(run)
    kept = run.kept
    rows = run.steps + 1
    ambiguous = np.bincount(run.contacts.step[ambiguous_flips(run)], minlength=rows)
    ambiguous[1:] += ambiguous_stops(run)
    y = run.y.astype(np.float64) if kept else np.full((rows, 1), np.nan)
    return {
        "step": np.arange(rows),
        "time": run.time,
        "contacts": np.concatenate([[first], inside]),
        "entered": entered,
        "left": left,
        "iterations": _led(0, run.iterations.reshape(run.steps, -1).max(axis=1)),
        "reason": np.array(["none", *_words(run)]),
        "residual": _led(np.nan, residual),
        "stop_margin": _led(np.nan, margin),
        "min_margin": _led(np.nan, np.abs(run.height.astype(np.float64)).min(axis=1) if kept else none),
        "ambiguous": ambiguous,
        "mean_height": y.mean(axis=1),
        "energy": run.energy.mean(axis=1) if kept else np.full(rows, np.nan),
    }


def contacts(run: BallRun) -> dict[str, np.ndarray]:
    """A row per contact flip."""
    flips = run.contacts
    lift = 0.0 if run.world.lift is None else float(run.world.lift)
    return {
        "step": flips.step,
        "ball": flips.subject[:, 0],
        "entered": flips.entered,
        "height": np.where(flips.entered, 0.0, lift) - flips.margin,
        "margin": flips.margin,
        "velocity": flips.extra["velocity"],
        "bound": flips.bound,
        "ambiguous": ambiguous_flips(run),
    }


def decisions(run: BallRun) -> dict[str, np.ndarray]:
    """A row per stop decision of the steps that had something to solve.

    Every one where one rule stops all balls and histories were kept; else the last one of each solve, and
    the one before.
    """
    rule = rule_of(run)
    if rule is None:
        return {
            name: np.zeros(0) for name in ("step", "ball", "iteration", "residual", "margin", "stopped")
        } | {"reason": np.zeros(0, str)}
    busy = solved(run)
    if run.history is not None and run.iterations.ndim == 1:
        return _histories(run, rule, busy)
    at = np.argwhere(busy)
    row = at[:, 0]
    subject = at[:, 1] if at.shape[1] > 1 else np.full(len(at), -1)
    pick = tuple(at.T)
    count, residual, margin = (getattr(run, name)[pick] for name in ("iterations", "residual", "margin"))
    before, reason = run.before[pick].astype(np.float64), run.reason[pick]
    earlier = np.isfinite(before)
    residual, margin = residual.astype(np.float64), margin.astype(np.float64)
    columns = {
        "step": (row + 1, row[earlier] + 1),
        "ball": (subject, subject[earlier]),
        "iteration": (count, count[earlier] - 1),
        # the threshold is the same for both, unless a solve is entered above another one
        "residual": (residual, (residual + margin)[earlier] - before[earlier]),
        "margin": (margin, before[earlier]),
        "stopped": (_stopped(reason), np.zeros(int(earlier.sum()), bool)),
        "reason": (_names(reason), np.full(int(earlier.sum()), "")),
    }
    order = np.lexsort((np.concatenate(columns["iteration"]), np.concatenate(columns["ball"]),
                        np.concatenate(columns["step"])))  # fmt: skip
    return {name: np.concatenate(parts)[order] for name, parts in columns.items()}


def _histories(run: BallRun, rule: Any, busy: np.ndarray) -> dict[str, np.ndarray]:
    assert run.history is not None
    rows = np.flatnonzero(busy)
    history = run.history[rows]
    number = np.broadcast_to(np.arange(history.shape[1], dtype=np.int32), history.shape)
    made = number <= run.iterations[rows][:, None]
    first = np.broadcast_to(history[:, :1], history.shape)
    threshold = np.asarray(rule.threshold(jnp.asarray(first), jnp.asarray(number)))
    with np.errstate(invalid="ignore"):
        margin = (threshold - history).astype(np.float64)
    last = number == run.iterations[rows][:, None]
    reason = np.broadcast_to(run.reason[rows][:, None], history.shape)
    return {
        "step": np.broadcast_to(rows[:, None] + 1, history.shape)[made],
        "ball": np.full(int(made.sum()), -1),
        "iteration": number[made],
        "residual": history[made].astype(np.float64),
        "margin": margin[made],
        "stopped": (last & _stopped(reason))[made],
        "reason": np.where(last, _names(reason), "")[made],
    }


def heights(run: BallRun) -> dict[str, np.ndarray]:
    """Height and velocity of the first balls at every step."""
    count = min(run.balls, FOLLOWED)
    shape = (run.steps + 1, count)
    return {
        "step": np.broadcast_to(np.arange(run.steps + 1)[:, None], shape).ravel(),
        "ball": np.broadcast_to(np.arange(count), shape).ravel(),
        "y": run.y[:, :count].astype(np.float64).ravel(),
        "v": run.v[:, :count].astype(np.float64).ravel(),
    }


def separations(variant: BallVariant, found: Difference) -> dict[str, Any]:
    """A row per step: how far the heights of a variant are from those of the run."""
    apart = found.separation
    return {
        "variant": np.full(len(apart), variant.name),
        "step": np.arange(len(apart)),
        "separation": apart,
    }


# --- parts --------------------------------------------------------------------------------------------


def _led(first: float, rest: np.ndarray) -> np.ndarray:
    """A column with a value for the start, at which no step was decided."""
    return np.concatenate([np.asarray([first], np.asarray(rest).dtype), rest])


def rule_of(run: BallRun) -> Any:
    """The rule that stops this run's solver, or None where nothing is solved."""
    contact = run.world.contact
    if isinstance(contact, Projection):
        return contact.stop
    return getattr(run.world.integrator, "stop", None) if isinstance(contact, Penalty) else None


def solved(run: BallRun) -> np.ndarray:
    """Steps (and balls, where each has a solve of its own) with something to solve or locate."""
    if rule_of(run) is None:
        return run.reason != Reason.NONE.value
    if isinstance(run.world.contact, Penalty):
        return np.ones(run.iterations.shape, bool)
    touched = run.contact if run.iterations.ndim == 2 else run.contact.any(axis=1)
    return touched | (run.iterations > 0)


def ambiguous_stops(run: BallRun) -> np.ndarray:
    """Stop decisions of each step that another order of the residual's sum could have made otherwise."""
    rule = rule_of(run)
    if rule is None or isinstance(rule, Fixed):
        return np.zeros(run.steps, np.int64)
    share = residual_bound(run.world, 1.0, 1 if run.iterations.ndim == 2 else run.balls)
    busy = solved(run)
    residual = run.residual.astype(np.float64)
    near = np.zeros(busy.shape, bool)
    for margin in (run.margin.astype(np.float64), run.before.astype(np.float64)):
        near |= np.isfinite(margin) & (np.abs(margin) <= share * (residual + np.abs(run.margin - margin)))
    return (near & busy).reshape(run.steps, -1).sum(axis=1)


def _of_batch(run: BallRun) -> tuple[np.ndarray, np.ndarray]:
    """Residual and stop margin of each step; of the ball nearest to its tolerance where each has its own."""
    residual, margin = run.residual.astype(np.float64), run.margin.astype(np.float64)
    if residual.ndim == 1:
        return residual, margin
    near = np.where(np.isfinite(margin), np.abs(margin), np.inf).argmin(axis=1)[:, None]
    return np.take_along_axis(residual, near, 1)[:, 0], np.take_along_axis(margin, near, 1)[:, 0]


def _words(run: BallRun) -> np.ndarray:
    rank = np.zeros(max(Reason) + 1, np.int64)
    rank[[code.value for code in _WORST]] = np.arange(len(_WORST))
    worst = rank[run.reason.reshape(run.steps, -1)].max(axis=1)
    reasons = np.array([code.word for code in _WORST])
    # a step without contact ends its solve before it begins
    busy = solved(run).reshape(run.steps, -1).any(axis=1)
    return np.where(busy, reasons[worst], Reason.NONE.word)


def _names(reason: np.ndarray) -> np.ndarray:
    return np.array([code.word for code in Reason])[reason]


def _stopped(reason: np.ndarray) -> np.ndarray:
    return np.isin(reason, [Reason.TOLERANCE.value, Reason.FIXED.value])


def ambiguous_flips(run: BallRun) -> np.ndarray:
    """Contact flips that another rounding could have dated otherwise; an exact height is not one."""
    return run.contacts.ambiguous & (run.contacts.bound > 0)
