"""The bouncing ball, a system with an exact solution, to test events and precision.

Names are imported on first use, because validation does not need jax.
"""

# ruff: noqa: F401

from __future__ import annotations

from typing import TYPE_CHECKING

from mdnum.lazy import on_first_use

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

__getattr__, __dir__, __all__ = on_first_use(__name__)
