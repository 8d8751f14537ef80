"""The verbs as functions: `mdnum run`, `mdnum ball`, `mdnum fork` and `mdnum grad`."""

from __future__ import annotations

from mdnum.workflow.audit import AuditResult, audit
from mdnum.workflow.ball import bounce
from mdnum.workflow.conform import conform
from mdnum.workflow.demos import demonstrate
from mdnum.workflow.flips import FlipsResult, flips
from mdnum.workflow.fork import ForkResult, fork
from mdnum.workflow.fork_certify import CertifyResult, fork_certify
from mdnum.workflow.fork_forecast import ForecastResult, fork_forecast
from mdnum.workflow.fork_map import MapResult, fork_map
from mdnum.workflow.fork_processes import ProcessesResult, fork_processes
from mdnum.workflow.fork_replay import fork_folders
from mdnum.workflow.grad import grad
from mdnum.workflow.run import run

__all__ = [
    "AuditResult",
    "CertifyResult",
    "FlipsResult",
    "ForecastResult",
    "ForkResult",
    "MapResult",
    "ProcessesResult",
    "audit",
    "bounce",
    "conform",
    "demonstrate",
    "flips",
    "fork",
    "fork_certify",
    "fork_folders",
    "fork_forecast",
    "fork_map",
    "fork_processes",
    "grad",
    "run",
]
