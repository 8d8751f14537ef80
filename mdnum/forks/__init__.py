"""Forks: where two runs diverge, which decision made them diverge, and whether it mattered.

The code serves both worlds, molecular dynamics and the ball. A pair of programs (`Twin`) is made by a choice
(`forks.choices`) or from two folders (`forks.folders`); `fork` follows both runs. `forks.boundaries` finds
where decisions change along a number, `forks.exact` runs exact arithmetic. Four modules serve molecular
dynamics only: `forks.replays` (overridden decisions, minimal causes), `forks.linearized` (exponents and
forecasts), `forks.processes` (compilers) and `forks.benign` (ensembles).
"""

from __future__ import annotations

from mdnum.forks.pair import SPLIT, Fork, displacements, fork
from mdnum.program import Decision, Twin

__all__ = ["SPLIT", "Decision", "Fork", "Twin", "displacements", "fork"]
