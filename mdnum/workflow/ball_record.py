"""What a run of the ball puts into its folder: tables, summary, and comparisons with what is known."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from mdnum.ball.compare import Difference, first_difference
from mdnum.ball.contacts import Penalty, Projection
from mdnum.ball.exact import ExactImpact
from mdnum.ball.exact_penalty import ExactPenalty
from mdnum.ball.integrators import EventLocated
from mdnum.ball.rollout import BallRun
from mdnum.ball.state import Reason
from mdnum.ball.stopping import Fixed
from mdnum.precision.bounds import gamma
from mdnum.store import RunFolder
from mdnum.systems import ball
from mdnum.systems.ball_system import BallSystem
from mdnum.systems.build_ball import BallSimulation, BallVariant

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
    ambiguous = np.bincount(run.contacts.step[run.contacts.ambiguous], minlength=rows)
    ambiguous[1:] += _ambiguous_stops(run)
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
        "ambiguous": flips.ambiguous,
    }


def decisions(run: BallRun) -> dict[str, np.ndarray]:
    """A row per stop decision of the steps that had something to solve.

    Every one where one rule stops all balls and histories were kept; else the last one of each solve, and
    the one before.
    """
    rule = _rule(run)
    if rule is None:
        return {
            name: np.zeros(0) for name in ("step", "ball", "iteration", "residual", "margin", "stopped")
        } | {"reason": np.zeros(0, str)}
    solved = _solved(run)
    if run.history is not None and run.iterations.ndim == 1:
        return _histories(run, rule, solved)
    at = np.argwhere(solved)
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


def _histories(run: BallRun, rule: Any, solved: np.ndarray) -> dict[str, np.ndarray]:
    assert run.history is not None
    rows = np.flatnonzero(solved)
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


def summarize(simulation: BallSimulation, run: BallRun) -> dict[str, Any]:
    """The run in numbers."""
    spec = simulation.system.spec
    entered = int(run.contacts.entered.sum())
    solved = _solved(run)
    codes, counts = np.unique(run.reason[solved], return_counts=True)
    margins = np.concatenate([run.margin[solved], run.before[solved]]).astype(np.float64)
    margins = np.abs(margins[np.isfinite(margins)])
    first = run.first_contact[run.first_contact > 0]
    broken = _first_not_finite(run)
    findings = [
        {"code": one.code, "severity": "warning", "title": one.title, "text": one.text, "remedy": one.remedy}
        for one in simulation.system.warnings
    ]
    return {
        "world": "ball",
        "system": simulation.system.name,
        "balls": run.balls,
        "steps": run.steps,
        "steps_asked": run.steps,
        "time": run.steps * run.h,
        "contact_kind": spec.contact.kind,
        "integrator": spec.integrator.kind,
        "loss_kind": spec.loss.kind,
        "flips_entered": entered,
        "flips_left": len(run.contacts) - entered,
        "first_contact": int(first.min()) if len(first) else None,
        "iterations_total": int(np.sum(run.iterations)),
        "iterations_max": int(np.max(run.iterations)),
        "ended": {Reason(code).word: int(n) for code, n in zip(codes, counts, strict=True)},
        "ambiguous": int(run.contacts.ambiguous.sum()) + int(_ambiguous_stops(run).sum()),
        "ambiguous_contacts": int(run.contacts.ambiguous.sum()),
        "ambiguous_stops": int(_ambiguous_stops(run).sum()),
        "smallest_stop_margin": float(margins.min()) if len(margins) else None,
        "not_finite": broken,
        "status": "complete" if broken is None else "failed",
        "findings": findings,
    }


def parted(run: BallRun, other: BallRun) -> Difference:
    """Where two runs part.

    Counts that do not count the same (iterations of a solver, impacts inside a step, nothing) are no
    decisions of one kind: then contacts alone are compared.
    """
    if _counted(run) != _counted(other):
        none = np.zeros(run.steps, np.int32)
        run, other = (dataclasses.replace(one, iterations=none) for one in (run, other))
    return first_difference(run, other)


def separations(variant: BallVariant, found: Difference) -> dict[str, Any]:
    """A row per step: how far the heights of a variant are from those of the run."""
    apart = found.separation
    return {
        "variant": np.full(len(apart), variant.name),
        "step": np.arange(len(apart)),
        "separation": apart,
    }


def compared(
    variant: BallVariant,
    found: Difference,
    other: BallRun,
    gradient: Sequence[Mapping[str, Any]],
    theirs: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Where a variant parts from the run, and what that does to the loss and its gradient.

    Args:
        variant: what was changed.
        found: where it parts from the run.
        other: the run with the change.
        gradient, theirs: derivatives of both, the first method's first.
    """
    fork = None if found.fork is None else found.fork
    own, their = (dict(made[0]["gradient"]) if made else {} for made in (gradient, theirs))
    separation = found.separation
    return {
        "name": variant.name,
        "changes": dict(variant.changes),
        "seed": found.seed,
        "fork": fork,
        "channel": found.channel or None,
        "ball": None if fork is None or found.ball < 0 else found.ball,
        "margin": None if fork is None else found.margins[0],
        "margin_there": None if fork is None else found.margins[1],
        "separation_end": float(separation[-1]) if len(separation) else None,
        "iterations_differ": found.iterations_differ,
        "contacts_differ": found.contacts_differ,
        "iterations_total": int(np.sum(other.iterations)),
        "ended": other.ended(),
        "gradient": their,
        "depends": dict(theirs[0].get("depends", {})) if theirs else {},
        "gradient_change": {name: their[name] - own[name] for name in own if name in their},
    }


# --- closed form --------------------------------------------------------------------------------------


def exact(system: BallSystem, run: BallRun, gradient: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Errors against the closed form, or None where there is none.

    There is one for a ball above the floor under a constant acceleration downward, with an impact or a
    projection (the ball with restitution) or an undamped sharp penalty (the ball on a spring).

    Args:
        system: what the file says.
        run: of it.
        gradient: derivatives, of which those of the final height are compared.
    """
    spec = system.spec
    pull = spec.flight.gravity
    if isinstance(spec.flight.control, ball.ConstantControl):
        pull -= spec.flight.control.value
    elif not isinstance(spec.flight.control, ball.NoControl):
        return None
    contact = spec.contact
    damped = isinstance(contact, ball.PenaltyContact) and (contact.damping > 0 or contact.eps > 0)
    y0, v0 = run.y[0].astype(np.float64), run.v[0].astype(np.float64)
    if pull <= 0 or damped or contact.hysteresis is not None or not run.kept:
        return None
    if np.any(y0 < 0) or np.any((y0 == 0) & (v0 == 0)):
        return None
    count = min(run.balls, FOLLOWED)
    if isinstance(contact, ball.PenaltyContact):
        motions = [ExactPenalty(y0[n], v0[n], pull, contact.k) for n in range(count)]
        begins = [float(motion.contact_time(1).value) for motion in motions]
    else:
        motions = [ExactImpact(y0[n], v0[n], pull, contact.restitution) for n in range(count)]
        begins = [float(motion.impact_time(1).value) for motion in motions]
    y = run.y[:, :count].astype(np.float64)
    right = np.stack([motion.height(run.time).value for motion in motions], axis=1)
    off = np.abs(y - right)
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
    slopes = _slopes(spec, motions, run) if count == run.balls else None
    if slopes is not None:
        found["gradient"] = slopes
        found["gradient_error"] = {
            made["method"]: {name: made["gradient"][name] - slopes[name] for name in slopes}
            for made in gradient
            if not made.get("refused")
        }
    return found


def _slopes(spec: ball.BallSpec, motions: Sequence[Any], run: BallRun) -> dict[str, float] | None:
    """Derivatives of the loss of the exact motion, where the loss is a height."""
    if spec.loss.kind == "residual-penetration" or spec.loss.target is not None:
        return None
    # a loss over the steps does not count the start
    times = run.time[-1:] if spec.loss.kind == "final-height" else run.time[1:]
    heights = [motion.height(times) for motion in motions]
    return {
        name: float(np.mean([one.gradient[name] for one in heights]))
        for name in motions[0].NAMES
        if name in spec.gradient.of
    }


# --- parts --------------------------------------------------------------------------------------------


def _led(first: float, rest: np.ndarray) -> np.ndarray:
    """A column with a value for the start, at which no step was decided."""
    return np.concatenate([np.asarray([first], np.asarray(rest).dtype), rest])


def _rule(run: BallRun) -> Any:
    """The rule that stops this run's solver, or None where nothing is solved."""
    contact = run.world.contact
    if isinstance(contact, Projection):
        return contact.stop
    return getattr(run.world.integrator, "stop", None) if isinstance(contact, Penalty) else None


def _counted(run: BallRun) -> str:
    """What the iterations of a run are."""
    if _rule(run) is not None:
        return "iterations"
    return "impacts" if isinstance(run.world.integrator, EventLocated) else "nothing"


def _solved(run: BallRun) -> np.ndarray:
    """Steps (and balls, where each has a solve of its own) with something to solve or locate."""
    if _rule(run) is None:
        return run.reason != Reason.NONE.value
    if isinstance(run.world.contact, Penalty):
        return np.ones(run.iterations.shape, bool)
    touched = run.contact if run.iterations.ndim == 2 else run.contact.any(axis=1)
    return touched | (run.iterations > 0)


def _ambiguous_stops(run: BallRun) -> np.ndarray:
    """Stop decisions of each step that another order of the residual's sum could have made otherwise."""
    rule = _rule(run)
    if rule is None or isinstance(rule, Fixed):
        return np.zeros(run.steps, np.int64)
    # all terms of a residual have one sign: |computed - exact| is at most gamma times the sum
    terms = 1 if run.iterations.ndim == 2 else max(run.balls - 1, 1)
    share = gamma(terms, run.world.policy.dtype("accumulate"))
    solved = _solved(run)
    residual = run.residual.astype(np.float64)
    near = np.zeros(solved.shape, bool)
    for margin in (run.margin.astype(np.float64), run.before.astype(np.float64)):
        near |= np.isfinite(margin) & (np.abs(margin) <= share * (residual + np.abs(run.margin - margin)))
    return (near & solved).reshape(run.steps, -1).sum(axis=1)


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
    solved = _solved(run).reshape(run.steps, -1).any(axis=1)
    return np.where(solved, reasons[worst], Reason.NONE.word)


def _names(reason: np.ndarray) -> np.ndarray:
    return np.array([code.word for code in Reason])[reason]


def _stopped(reason: np.ndarray) -> np.ndarray:
    return np.isin(reason, [Reason.TOLERANCE.value, Reason.FIXED.value])


def _first_not_finite(run: BallRun) -> int | None:
    """The first state (of those kept) that holds a number which is not finite."""
    fine = np.isfinite(run.y.astype(np.float64)).all(axis=1) & np.isfinite(run.v.astype(np.float64)).all(
        axis=1
    )
    if fine.all():
        return None
    return int(np.argmin(fine)) if run.kept else run.steps
