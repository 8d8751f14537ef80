"""The verbs as functions: `mdnum run`, `mdnum ball`, `mdnum fork` and `mdnum grad`."""

from __future__ import annotations

from mdnum.workflow.audit import AuditResult, audit
from mdnum.workflow.ball import BallResult, bounce
from mdnum.workflow.conform import ConformResult, conform
from mdnum.workflow.flips import FlipsResult, flips
from mdnum.workflow.fork import fork, fork_benign, fork_folders, fork_screen
from mdnum.workflow.fork_certify import fork_certify, fork_processes
from mdnum.workflow.fork_map import fork_forecast, fork_map
from mdnum.workflow.grad import GradResult, grad
from mdnum.workflow.run import run

__all__ = [
    "AuditResult",
    "BallResult",
    "ConformResult",
    "FlipsResult",
    "GradResult",
    "audit",
    "bounce",
    "conform",
    "flips",
    "fork",
    "fork_benign",
    "fork_certify",
    "fork_folders",
    "fork_forecast",
    "fork_map",
    "fork_processes",
    "fork_screen",
    "grad",
    "run",
]
