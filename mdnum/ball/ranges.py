"""How near a rollout comes to the ends of its formats, step by step."""

from __future__ import annotations

import numpy as np

from mdnum.ball.contacts import Penalty
from mdnum.ball.rollout import BallRun
from mdnum.ball.state import Reason
from mdnum.errors import InputError
from mdnum.precision.ranges import RangeReport, measure


def ranges(run: BallRun, format: str | None = None) -> RangeReport:
    """The ranges of what a rollout carried, squared and decided on, against the limits of a format.

    Heights, velocities and residuals as recorded; penetrations and their squares (what a loss sums, and what
    falls among the subnormals first); the force of a spring; energies.

    Args:
        run: with every state kept.
        format: of all quantities: would the run have fitted? None: each in its own role's format.

    Raises:
        InputError: the run kept only its first and last state.
    """
    if not run.kept:
        raise InputError("the run kept no states", remedy="Simulate with keep=True.")
    policy = run.world.policy
    depth = np.maximum(0.0, -run.height.astype(np.float64))
    found = {
        "height": (run.y, policy.state),
        "velocity": (run.v, policy.state),
        "penetration": (depth, policy.arithmetic),
        "penetration squared": (depth**2, policy.loss),
        "energy": (run.energy, policy.arithmetic),
    }
    if isinstance(run.world.contact, Penalty):
        found["spring force"] = (float(run.world.contact.k) * depth, policy.arithmetic)
    solved = run.reason != Reason.NONE.value
    if solved.any():
        # a step without a solve has no residual; one whose solve lost its numbers has, and it shows
        found["residual"] = (np.where(solved, run.residual, 0.0), policy.decision)
    return RangeReport(
        {name: measure(name, np.asarray(values), format or own) for name, (values, own) in found.items()}
    )
