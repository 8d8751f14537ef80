"""The bouncing ball: events, stopping rules and precision in a world small enough to know exactly.

The names below are imported on first use, because most of them import jax and system files are checked
without it.
"""

# ruff: noqa: F401

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mdnum.ball.compare import BallDifference, first_difference
    from mdnum.ball.contacts import Impact, Penalty, Projection
    from mdnum.ball.exact import ExactImpact, ExactPenalty
    from mdnum.ball.integrators import (
        BallVerlet,
        EventLocated,
        ExplicitEuler,
        ImplicitMidpoint,
        SemiImplicitEuler,
    )
    from mdnum.ball.problem import BallProblem, FinalHeight, MeanHeight, ResidualPenetration, arrive, loss_of
    from mdnum.ball.rollout import BallRun, simulate
    from mdnum.ball.state import BallDecisions, BallState, Reason
    from mdnum.ball.stopping import FixedCount, GlobalSum, HysteresisStop, Maximum, PerInstance, Relative
    from mdnum.ball.world import World

_NAMES = {
    "contacts": "Impact Penalty Projection",
    "exact": "ExactImpact ExactPenalty",
    "integrators": "EventLocated ExplicitEuler ImplicitMidpoint SemiImplicitEuler BallVerlet",
    "problem": "FinalHeight MeanHeight BallProblem ResidualPenetration arrive loss_of",
    "compare": "BallDifference first_difference",
    "rollout": "BallRun simulate",
    "state": "BallState BallDecisions Reason",
    "stopping": "FixedCount GlobalSum HysteresisStop Maximum PerInstance Relative",
    "world": "World",
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_HOMES)
