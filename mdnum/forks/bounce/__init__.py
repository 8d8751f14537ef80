"""Forks of the bouncing ball: the same question, the same verdict, without molecular dynamics."""

from __future__ import annotations

from mdnum.forks.bounce.pair import BallDecision, BallFork, fork
from mdnum.forks.bounce.twin import BallTwin, Pin

__all__ = ["BallDecision", "BallFork", "BallTwin", "Pin", "fork"]
