"""A run of the ball against the closed form, where there is one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mdnum.ball.exact import ExactImpact, ExactPenalty
from mdnum.ball.rollout import BallRun
from mdnum.systems import ball
from mdnum.systems.ball_system import BallSystem
from mdnum.workflow.ball_tables import FOLLOWED


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
        begins = [float(motion.first_contact().value) for motion in motions]
    else:
        motions = [ExactImpact(y0[n], v0[n], pull, contact.restitution) for n in range(count)]
        begins = [float(motion.first_contact().value) for motion in motions]
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
