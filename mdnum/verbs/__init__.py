"""The verbs as functions: `mdnum run`, `mdnum ball`, `mdnum fork` and `mdnum grad`."""

from __future__ import annotations

from mdnum.verbs.audit import audit
from mdnum.verbs.ball import bounce
from mdnum.verbs.conform import conform
from mdnum.verbs.demos import demonstrate
from mdnum.verbs.flips import flips
from mdnum.verbs.fork import fork, fork_benign, fork_folders, fork_screen
from mdnum.verbs.fork_certify import fork_certify, fork_processes
from mdnum.verbs.fork_map import fork_forecast, fork_map
from mdnum.verbs.grad import grad
from mdnum.verbs.run import run

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
