"""Forks: where two runs diverge, which decision caused it, and whether it matters.

The package works for molecular dynamics and the bouncing ball. `fork` compares the runs of two programs
(`Twin`). The two runs differ in a choice (`forks.choices`) or belong to two run folders (`forks.folders`).
`forks.boundaries` finds parameter values at which decisions change; `forks.exact` uses exact arithmetic. Some
modules are for molecular dynamics only: `forks.replays` (imposed decisions, minimal causes),
`forks.linearized` (exponents and forecasts), `forks.processes` (compilers) and `forks.benign` (ensembles).
"""

from __future__ import annotations

from mdnum.forks.pair import SPLIT, Fork, displacements, fork
from mdnum.program import Decision, Twin

__all__ = ["SPLIT", "Decision", "Fork", "Twin", "displacements", "fork"]
