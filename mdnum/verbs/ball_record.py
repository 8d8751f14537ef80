"""Content of the output folder of a ball's run: tables, summary, and differences from closed forms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from mdnum.ball.exact import ExactImpact, ExactPenalty
from mdnum.ball.rollout import BallDifference, BallRun, residual_bound
from mdnum.ball.step import Penalty, Projection
from mdnum.ball.stopping import FixedCount, Reason
from mdnum.ranges import columns
from mdnum.systems import ball
from mdnum.systems.build_ball import BallSimulation, BallVariant
from mdnum.systems.load import BallSystem

#: Number of balls whose heights are stored in the folder and compared with the exact motion.
FOLLOWED = 8
#: Codes of `Reason`, in order of increasing importance for a step.
_WORST = (Reason.NONE, Reason.FIXED, Reason.TOLERANCE, Reason.REST, Reason.CAP, Reason.NOT_FINITE)


def tables(run: BallRun) -> dict[str, dict[str, np.ndarray]]:
    """Return all tables of a ball's run, by name."""
    made = {"steps": steps(run), "contacts": contacts(run), "solver": decisions(run)}
    return made | ({"heights": heights(run)} if run.kept else {})


def steps(run: BallRun) -> dict[str, np.ndarray]:
    """Return a table of contacts, flips, margins, height and energy by step."""
    entered, left = run.contacts.counts(run.steps)
    inside = run.contact.sum(axis=1)
    first = inside[0] - entered[1] + left[1]
    rows, kept = run.steps + 1, run.kept
    residual, margin = _of_batch(run)
    nearest = np.abs(run.height.astype(np.float64)).min(axis=1) if kept else np.full(run.steps, np.nan)
    ambiguous = np.bincount(run.contacts.step[ambiguous_flips(run)], minlength=rows)
    ambiguous[1:] += ambiguous_stops(run)
    y = run.y.astype(np.float64) if kept else np.full((rows, 1), np.nan)
    return {
        "step": np.arange(rows), "time": run.time, "contacts": np.concatenate([[first], inside]),
        "entered": entered, "left": left,
        "iterations": np.concatenate([[0], run.iterations.reshape(run.steps, -1).max(axis=1)]),
        "reason": np.array(["none", *_words(run)]), "residual": np.concatenate([[np.nan], residual]),
        "stop_margin": np.concatenate([[np.nan], margin]), "min_margin": np.concatenate([[np.nan], nearest]),
        "ambiguous": ambiguous, "mean_height": y.mean(axis=1),
        "energy": run.energy.mean(axis=1) if kept else np.full(rows, np.nan), **ranges(run),
    }  # fmt: skip


def ranges(run: BallRun) -> dict[str, np.ndarray]:
    """Smallest and largest magnitude of heights, velocities, depths and forces by step."""
    if not run.kept:
        return {}
    y, v = run.y.astype(np.float64), run.v.astype(np.float64)
    depth = np.vstack([np.maximum(-y[:1], 0.0), np.maximum(-run.height.astype(np.float64), 0.0)])
    quantities = {"y": y, "v": v, "depth": depth}
    if isinstance(run.world.contact, Penalty):
        quantities["push"] = float(run.world.contact.k) * np.maximum(-y, 0.0)
    return columns(quantities)


def contacts(run: BallRun) -> dict[str, np.ndarray]:
    """Return a table of contact flips (beginnings and ends of contacts)."""
    flips = run.contacts
    lift = 0.0 if run.world.lift is None else float(run.world.lift)
    return {
        "step": flips.step, "ball": flips.subject[:, 0], "entered": flips.entered,
        "height": np.where(flips.entered, 0.0, lift) - flips.margin, "margin": flips.margin,
        "velocity": flips.extra["velocity"], "bound": flips.bound, "ambiguous": ambiguous_flips(run),
    }  # fmt: skip


def decisions(run: BallRun) -> dict[str, np.ndarray]:
    """Return a table of the solver's stop decisions.

    If one solver with residual histories serves all balls, all decisions are included. In other cases, only
    the last two decisions of each solver call are included.
    """
    rule = rule_of(run)
    if rule is None:
        names = ("step", "ball", "iteration", "residual", "margin", "stopped")
        return {name: np.zeros(0) for name in names} | {"reason": np.zeros(0, str)}
    busy = solved(run)
    if run.history is not None and run.iterations.ndim == 1:
        return _histories(run, rule, busy)
    at = np.argwhere(busy)
    row = at[:, 0]
    subject = at[:, 1] if at.shape[1] > 1 else np.full(len(at), -1)
    pick = tuple(at.T)
    count, reason = run.iterations[pick], run.reason[pick]
    residual, margin, before = (
        getattr(run, name)[pick].astype(np.float64) for name in ("residual", "margin", "before")
    )
    earlier = np.isfinite(before)
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
    order = np.lexsort([np.concatenate(columns[name]) for name in ("iteration", "ball", "step")])
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
        "step": np.broadcast_to(rows[:, None] + 1, history.shape)[made], "ball": np.full(int(made.sum()), -1),
        "iteration": number[made], "residual": history[made].astype(np.float64), "margin": margin[made],
        "stopped": (last & _stopped(reason))[made], "reason": np.where(last, _names(reason), "")[made],
    }  # fmt: skip


def heights(run: BallRun) -> dict[str, np.ndarray]:
    """Return a table of height and velocity of the first `FOLLOWED` balls."""
    count = min(run.balls, FOLLOWED)
    shape = (run.steps + 1, count)
    return {
        "step": np.broadcast_to(np.arange(run.steps + 1)[:, None], shape).ravel(),
        "ball": np.broadcast_to(np.arange(count), shape).ravel(),
        "y": run.y[:, :count].astype(np.float64).ravel(),
        "v": run.v[:, :count].astype(np.float64).ravel(),
    }


def separations(name: str, found: BallDifference) -> dict[str, np.ndarray]:
    """Return, by step, the largest height difference between a variant and the main run."""
    size = len(found.separation)
    return {"variant": np.full(size, name), "step": np.arange(size), "separation": found.separation}


# --- summary ------------------------------------------------------------------------------------------


def summarize(simulation: BallSimulation, run: BallRun) -> dict[str, Any]:
    """Return summary.json of a ball's run: sizes, counts, margins and status."""
    spec = simulation.system.spec
    entered = int(run.contacts.entered.sum())
    busy = solved(run)
    codes, counts = np.unique(run.reason[busy], return_counts=True)
    margins = np.concatenate([run.margin[busy], run.before[busy]]).astype(np.float64)
    margins = np.abs(margins[np.isfinite(margins)])
    first = run.first_contact[run.first_contact > 0]
    finite = np.all(np.isfinite(run.y.astype(float)) & np.isfinite(run.v.astype(float)), axis=1)
    broken = None if finite.all() else int(np.argmin(finite)) if run.kept else run.steps
    flips, stops = int(ambiguous_flips(run).sum()), int(ambiguous_stops(run).sum())
    return {
        "system": simulation.system.name, "balls": run.balls, "steps": run.steps,
        "steps_asked": run.steps, "time": run.steps * run.h, "contact_kind": spec.contact.kind,
        "integrator": spec.integrator.kind, "loss_kind": spec.loss.kind, "flips_entered": entered,
        "flips_left": len(run.contacts) - entered, "first_contact": int(first.min()) if len(first) else None,
        "iterations_total": int(np.sum(run.iterations)), "iterations_max": int(np.max(run.iterations)),
        "ended": {Reason(code).word: int(n) for code, n in zip(codes, counts, strict=True)},
        "ambiguous": flips + stops, "ambiguous_contacts": flips, "ambiguous_stops": stops,
        "smallest_stop_margin": float(margins.min()) if len(margins) else None, "not_finite": broken,
        "status": "complete" if broken is None else "failed", "findings": [],
    }  # fmt: skip


def compared(
    variant: BallVariant,
    found: BallDifference,
    other: BallRun,
    gradient: Sequence[Mapping[str, Any]],
    theirs: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the differences between a variant and the run, and the variant's gradient.

    Args:
        found: the difference between the two runs.
        other: the run of the variant.
        gradient, theirs: derivatives of the run and of the variant; those by the first method come first.
    """
    own, their = (dict(made[0]["gradient"]) if made else {} for made in (gradient, theirs))
    forked, separation = found.fork is not None, found.separation
    return {
        "name": variant.name, "changes": dict(variant.changes), "seed": found.seed, "fork": found.fork,
        "channel": found.channel or None, "ball": found.ball if forked and found.ball >= 0 else None,
        "margin": found.margins[0] if forked else None, "margin_there": found.margins[1] if forked else None,
        "separation_end": float(separation[-1]) if len(separation) else None,
        "iterations_differ": found.iterations_differ, "contacts_differ": found.contacts_differ,
        "iterations_total": int(np.sum(other.iterations)), "ended": other.ended(), "gradient": their,
        "depends": dict(theirs[0].get("depends", {})) if theirs else {},
        "gradient_change": {name: their[name] - own[name] for name in own if name in their},
    }  # fmt: skip


def exact(system: BallSystem, run: BallRun, gradient: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Return the run's deviations from the closed form. None if there is none.

    The ball must start above the floor and accelerate downward at a constant rate. The contact must be an
    impact, a projection or a sharp penalty (a spring).

    Args:
        gradient: derivatives by each method; they are compared if the loss is a height.
    """
    spec, contact = system.spec, system.spec.contact
    pull = spec.flight.gravity
    if isinstance(spec.flight.control, ball.ConstantControl):
        pull -= spec.flight.control.value
    elif not isinstance(spec.flight.control, ball.NoControl):
        return None
    y0, v0 = run.y[0].astype(np.float64), run.v[0].astype(np.float64)
    spring = isinstance(contact, ball.PenaltyContact)
    if pull <= 0 or (spring and (contact.eps > 0 or contact.damping**2 == 4 * contact.k)):
        return None
    if contact.hysteresis is not None or not run.kept or np.any(y0 < 0) or np.any((y0 == 0) & (v0 == 0)):
        return None
    count = min(run.balls, FOLLOWED)
    motions: list[ExactPenalty | ExactImpact] = [
        ExactPenalty(y0[n], v0[n], pull, contact.k, contact.damping)
        if isinstance(contact, ball.PenaltyContact)
        else ExactImpact(y0[n], v0[n], pull, contact.restitution)
        for n in range(count)
    ]
    begins = [float(motion.first_contact().value) for motion in motions]
    right = np.stack([motion.height(run.time).value for motion in motions], axis=1)
    off = np.abs(run.y[:, :count].astype(np.float64) - right)
    found: dict[str, Any] = {
        "model": type(motions[0]).__name__,
        "balls": count,
        "height_error": float(off[-1].max()),
        "height_error_largest": float(off.max()),
        "height_error_before_contact": float(off[run.time < min(begins)].max()),
        "first_contact_time": begins[0],
        "first_contact_step": int(run.first_contact[0]),
    }
    if isinstance(motions[0], ExactImpact) and motions[0].restitution < 1:
        found["rest_time"] = float(motions[0].rest_time().value)
    if count < run.balls or spec.loss.kind == "residual-penetration" or spec.loss.target is not None:
        return found
    # the loss is a height; one over the steps does not count the start
    times = run.time[-1:] if spec.loss.kind == "final-height" else run.time[1:]
    known = [motion.height(times).gradient for motion in motions]
    slopes = {
        name: float(np.mean([one[name] for one in known])) for name in known[0] if name in spec.gradient.of
    }
    found["gradient"] = slopes
    found["gradient_error"] = {
        made["method"]: {name: made["gradient"][name] - slopes[name] for name in slopes}
        for made in gradient
        if not made.get("refused")
    }
    return found


# --- parts --------------------------------------------------------------------------------------------


def rule_of(run: BallRun) -> Any:
    """Return the stopping rule of the solver. None if there is no solver."""
    contact = run.world.contact
    if isinstance(contact, Projection):
        return contact.stop
    return getattr(run.world.integrator, "stop", None) if isinstance(contact, Penalty) else None


def solved(run: BallRun) -> np.ndarray:
    """True for each step (and each ball, if solvers are separate) at which a solver was needed."""
    if rule_of(run) is None:
        return run.reason != Reason.NONE.value
    if isinstance(run.world.contact, Penalty):
        return np.ones(run.iterations.shape, bool)
    touched = run.contact if run.iterations.ndim == 2 else run.contact.any(axis=1)
    return touched | (run.iterations > 0)


def ambiguous_flips(run: BallRun) -> np.ndarray:
    """True for contact flips whose margin is within a nonzero rounding bound."""
    return run.contacts.ambiguous & (run.contacts.bound > 0)


def ambiguous_stops(run: BallRun) -> np.ndarray:
    """Count stop decisions that may depend on the order of summation, by step."""
    rule = rule_of(run)
    if rule is None or isinstance(rule, FixedCount):
        return np.zeros(run.steps, np.int64)
    share = residual_bound(run.world, 1.0, 1 if run.iterations.ndim == 2 else run.balls)
    busy = solved(run)
    residual = run.residual.astype(np.float64)
    near = np.zeros(busy.shape, bool)
    for margin in (run.margin.astype(np.float64), run.before.astype(np.float64)):
        near |= np.isfinite(margin) & (np.abs(margin) <= share * (residual + np.abs(run.margin - margin)))
    return (near & busy).reshape(run.steps, -1).sum(axis=1)


def _of_batch(run: BallRun) -> tuple[np.ndarray, np.ndarray]:
    """Residual and stop margin of each step. For separate solvers, take the ball with smallest |margin|."""
    residual, margin = run.residual.astype(np.float64), run.margin.astype(np.float64)
    if residual.ndim == 1:
        return residual, margin
    near = np.where(np.isfinite(margin), np.abs(margin), np.inf).argmin(axis=1)[:, None]
    return np.take_along_axis(residual, near, 1)[:, 0], np.take_along_axis(margin, near, 1)[:, 0]


def _words(run: BallRun) -> np.ndarray:
    rank = np.zeros(max(Reason) + 1, np.int64)
    rank[[code.value for code in _WORST]] = np.arange(len(_WORST))
    worst = rank[run.reason.reshape(run.steps, -1)].max(axis=1)
    # a step without contact ends its solve before it begins
    busy = solved(run).reshape(run.steps, -1).any(axis=1)
    return np.where(busy, np.array([code.word for code in _WORST])[worst], Reason.NONE.word)


def _names(reason: np.ndarray) -> np.ndarray:
    return np.array([code.word for code in Reason])[reason]


def _stopped(reason: np.ndarray) -> np.ndarray:
    return np.isin(reason, [Reason.TOLERANCE.value, Reason.FIXED.value])
