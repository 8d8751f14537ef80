"""Certified decisions: a run against the same map in exact real arithmetic.

The names below are imported on first use: most are of molecular dynamics, which the exact ball needs not.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

_HOMES = {
    "Ambiguous": "bounds",
    "BallHistory": "ball",
    "BallHorizon": "ball",
    "Certificate": "horizon",
    "CertifiedHorizon": "bounds",
    "Difference": "tape",
    "Exact": "program",
    "ExactProgram": "program",
    "MOST_ATOMS": "program",
    "POLICIES": "horizon",
    "PolicyHorizon": "horizon",
    "ShadowHorizon": "bounds",
    "Tape": "tape",
    "Taped": "horizon",
    "ball_history": "ball",
    "ball_horizon": "ball",
    "certified_horizon": "bounds",
    "certify": "horizon",
    "certify_ball": "ball",
    "exact_margin": "bounds",
    "first_difference": "tape",
    "installed": "program",
    "shadow_horizon": "bounds",
    "taped": "horizon",
    "why_not": "program",
    "with_policy": "program",
}

if TYPE_CHECKING:
    from mdnum.forks.exact.ball import (
        BallHistory,
        BallHorizon,
        ball_history,
        ball_horizon,
        certify_ball,
    )
    from mdnum.forks.exact.bounds import (
        Ambiguous,
        CertifiedHorizon,
        ShadowHorizon,
        certified_horizon,
        exact_margin,
        shadow_horizon,
    )
    from mdnum.forks.exact.horizon import POLICIES, Certificate, PolicyHorizon, Taped, certify, taped
    from mdnum.forks.exact.program import MOST_ATOMS, Exact, ExactProgram, installed, why_not, with_policy
    from mdnum.forks.exact.tape import Difference, Tape, first_difference

__all__ = [
    "MOST_ATOMS",
    "POLICIES",
    "Ambiguous",
    "BallHistory",
    "BallHorizon",
    "Certificate",
    "CertifiedHorizon",
    "Difference",
    "Exact",
    "ExactProgram",
    "PolicyHorizon",
    "ShadowHorizon",
    "Tape",
    "Taped",
    "ball_history",
    "ball_horizon",
    "certified_horizon",
    "certify",
    "certify_ball",
    "exact_margin",
    "first_difference",
    "installed",
    "shadow_horizon",
    "taped",
    "why_not",
    "with_policy",
]


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{home}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
