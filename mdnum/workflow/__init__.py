"""The verbs as functions: `mdnum run` and `mdnum ball`."""

from __future__ import annotations

from mdnum.workflow.ball import BallResult, bounce
from mdnum.workflow.md import run

__all__ = ["BallResult", "bounce", "run"]
