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
    "ExplicitEuler": "integrators",
    "FinalHeight": "losses",
    "Fixed": "stopping",
    "GlobalSum": "stopping",
    "Hysteresis": "stopping",
    "Impact": "contacts",
    "ImplicitMidpoint": "integrators",
    "Maximum": "stopping",
    "MeanHeight": "losses",
    "PerInstance": "stopping",
    "Penalty": "contacts",
    "Problem": "problem",
    "Projection": "contacts",
    "Reason": "state",
    "Relative": "stopping",
    "ResidualPenetration": "losses",
    "SemiImplicitEuler": "integrators",
    "VelocityVerlet": "integrators",
    "World": "world",
    "first_difference": "compare",
    "loss_of": "problem",
    "simulate": "rollout",
}

if TYPE_CHECKING:
    from mdnum.ball.compare import Difference, first_difference
    from mdnum.ball.contacts import Impact, Penalty, Projection
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
    "Projection",
    "Reason",
    "Relative",
    "ResidualPenetration",
    "SemiImplicitEuler",
    "VelocityVerlet",
    "World",
    "first_difference",
    "loss_of",
    "simulate",
]


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{home}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
