"""The verbs as functions: `mdnum run`, `mdnum ball` and `mdnum fork`."""

from __future__ import annotations

from mdnum.workflow.ball import BallResult, bounce
from mdnum.workflow.fork import ForkResult, fork
from mdnum.workflow.md import run

__all__ = ["BallResult", "ForkResult", "bounce", "fork", "run"]
