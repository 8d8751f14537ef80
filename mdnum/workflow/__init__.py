"""The verbs as functions: `mdnum run`, `mdnum ball`, `mdnum fork` and `mdnum grad`."""

from __future__ import annotations

from mdnum.workflow.audit import audit
from mdnum.workflow.ball import bounce
from mdnum.workflow.conform import conform
from mdnum.workflow.demos import demonstrate
from mdnum.workflow.flips import flips
from mdnum.workflow.fork import fork, fork_benign, fork_folders, fork_screen
from mdnum.workflow.fork_certify import fork_certify, fork_processes
from mdnum.workflow.fork_map import fork_forecast, fork_map
from mdnum.workflow.grad import grad
from mdnum.workflow.run import run

__all__ = [
    "audit",
    "bounce",
    "conform",
    "demonstrate",
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
