"""Certified decisions: a run against the same map in exact real arithmetic."""

from __future__ import annotations

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
