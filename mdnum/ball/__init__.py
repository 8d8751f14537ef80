"""The bouncing ball: events, stopping rules and precision in a world small enough to know exactly.

The names below are imported on first use, because most of them import jax and system files are checked
without it.
"""

# ruff: noqa: F401

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mdnum.ball.exact import ExactImpact, ExactPenalty
    from mdnum.ball.problem import BallProblem, FinalHeight, MeanHeight, ResidualPenetration, arrive, loss_of
    from mdnum.ball.rollout import BallDifference, BallRun, first_difference, simulate
    from mdnum.ball.step import (
        BallDecisions,
        BallState,
        BallVerlet,
        EventLocated,
        ExplicitEuler,
        Impact,
        ImplicitMidpoint,
        Penalty,
        Projection,
        SemiImplicitEuler,
    )
    from mdnum.ball.stopping import (
        FixedCount,
        GlobalSum,
        HysteresisStop,
        Maximum,
        PerInstance,
        Reason,
        Relative,
    )
    from mdnum.ball.world import World

_NAMES = {
    "exact": "ExactImpact ExactPenalty",
    "problem": "FinalHeight MeanHeight BallProblem ResidualPenetration arrive loss_of",
    "rollout": "BallDifference BallRun first_difference simulate",
    "step": "BallDecisions BallState BallVerlet EventLocated ExplicitEuler Impact ImplicitMidpoint Penalty "
    "Projection SemiImplicitEuler",
    "stopping": "FixedCount GlobalSum HysteresisStop Maximum PerInstance Reason Relative",
    "world": "World",
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_HOMES)
