"""The bouncing ball: events, stopping rules and precision in a world small enough to know exactly.

The names below are imported on first use, because most of them import jax and the command line lists the
demonstrations without it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

_HOMES = {
    "BallRun": "rollout",
    "BallState": "state",
    "Decisions": "state",
    "Difference": "compare",
    "EventLocated": "integrators",
    "ExactDamped": "exact_damped",
    "ExactImpact": "exact",
    "ExactPenalty": "exact_penalty",
    "ExplicitEuler": "integrators",
    "FinalHeight": "losses",
    "Fixed": "stopping",
    "GlobalSum": "stopping",
    "Hysteresis": "stopping",
    "Impact": "contacts",
    "ImplicitMidpoint": "integrators",
    "Maximum": "stopping",
    "MeanHeight": "losses",
    "Penalty": "contacts",
    "PerInstance": "stopping",
    "Problem": "problem",
    "Profile": "adjoint",
    "Projection": "contacts",
    "Reason": "state",
    "Relative": "stopping",
    "ResidualPenetration": "losses",
    "SemiImplicitEuler": "integrators",
    "VelocityVerlet": "integrators",
    "World": "world",
    "fingerprint": "determinism",
    "first_difference": "compare",
    "loss_of": "problem",
    "profile": "adjoint",
    "require_deterministic": "determinism",
    "simulate": "rollout",
}

if TYPE_CHECKING:
    from mdnum.ball.adjoint import Profile, profile
    from mdnum.ball.compare import Difference, first_difference
    from mdnum.ball.contacts import Impact, Penalty, Projection
    from mdnum.ball.determinism import fingerprint, require_deterministic
    from mdnum.ball.exact import ExactImpact
    from mdnum.ball.exact_damped import ExactDamped
    from mdnum.ball.exact_penalty import ExactPenalty
    from mdnum.ball.integrators import (
        EventLocated,
        ExplicitEuler,
        ImplicitMidpoint,
        SemiImplicitEuler,
        VelocityVerlet,
    )
    from mdnum.ball.losses import FinalHeight, MeanHeight, ResidualPenetration
    from mdnum.ball.problem import Problem, loss_of
    from mdnum.ball.rollout import BallRun, simulate
    from mdnum.ball.state import BallState, Decisions, Reason
    from mdnum.ball.stopping import Fixed, GlobalSum, Hysteresis, Maximum, PerInstance, Relative
    from mdnum.ball.world import World

__all__ = [
    "BallRun",
    "BallState",
    "Decisions",
    "Difference",
    "EventLocated",
    "ExactDamped",
    "ExactImpact",
    "ExactPenalty",
    "ExplicitEuler",
    "FinalHeight",
    "Fixed",
    "GlobalSum",
    "Hysteresis",
    "Impact",
    "ImplicitMidpoint",
    "Maximum",
    "MeanHeight",
    "Penalty",
    "PerInstance",
    "Problem",
    "Profile",
    "Projection",
    "Reason",
    "Relative",
    "ResidualPenetration",
    "SemiImplicitEuler",
    "VelocityVerlet",
    "World",
    "fingerprint",
    "first_difference",
    "loss_of",
    "profile",
    "require_deterministic",
    "simulate",
]


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{home}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
