"""What the summary of a ball's run says: counts, and how its variants compare."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mdnum.ball.integrators import EventLocated
from mdnum.ball.rollout import BallRun, Difference, first_difference
from mdnum.ball.state import Reason
from mdnum.systems.build_ball import BallSimulation, BallVariant
from mdnum.workflow.ball_tables import ambiguous_flips, ambiguous_stops, rule_of, solved


def summarize(simulation: BallSimulation, run: BallRun) -> dict[str, Any]:
    """The run in numbers."""
    spec = simulation.system.spec
    entered = int(run.contacts.entered.sum())
    busy = solved(run)
    codes, counts = np.unique(run.reason[busy], return_counts=True)
    margins = np.concatenate([run.margin[busy], run.before[busy]]).astype(np.float64)
    margins = np.abs(margins[np.isfinite(margins)])
    first = run.first_contact[run.first_contact > 0]
    broken = _first_not_finite(run)
    flips, stops = int(ambiguous_flips(run).sum()), int(ambiguous_stops(run).sum())
    findings = [
        {field: getattr(one, field) for field in ("code", "severity", "title", "text", "remedy")}
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
        "ambiguous": flips + stops,
        "ambiguous_contacts": flips,
        "ambiguous_stops": stops,
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


def _counted(run: BallRun) -> str:
    """What the iterations of a run are."""
    if rule_of(run) is not None:
        return "iterations"
    return "impacts" if isinstance(run.world.integrator, EventLocated) else "nothing"


def _first_not_finite(run: BallRun) -> int | None:
    """The first state (of those kept) that holds a number which is not finite."""
    fine = np.isfinite(run.y.astype(np.float64)).all(axis=1) & np.isfinite(run.v.astype(np.float64)).all(
        axis=1
    )
    if fine.all():
        return None
    return int(np.argmin(fine)) if run.kept else run.steps
