"""Certified decisions: a run against the same map in exact real arithmetic."""

from __future__ import annotations

from mdnum.forks.exact.horizon import POLICIES, Certificate, PolicyHorizon, Taped, certify, taped
from mdnum.forks.exact.program import MOST_ATOMS, Exact, ExactProgram, installed, why_not, with_policy
from mdnum.forks.exact.tape import Difference, Tape, first_difference

__all__ = [
    "MOST_ATOMS",
    "POLICIES",
    "Certificate",
    "Difference",
    "Exact",
    "ExactProgram",
    "PolicyHorizon",
    "Tape",
    "Taped",
    "certify",
    "first_difference",
    "installed",
    "taped",
    "why_not",
    "with_policy",
]
