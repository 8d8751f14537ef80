"""Forks: where two runs diverge, which decision did it, and whether it mattered; once for both worlds.

A pair of programs (`Twin`) is made by a choice (`forks.choices`) or from two folders (`forks.folders`), and
followed (`fork`). Maps along a number are in `forks.boundaries`, exact arithmetic in `forks.exact`; of
molecular dynamics alone are `forks.replays` (overridden decisions, minimal causes), `forks.linearized`
(exponents and forecasts), `forks.processes` (compilers) and `forks.benign` (ensembles).
"""

from __future__ import annotations

from mdnum.forks.pair import SPLIT, Fork, displacements, fork
from mdnum.program import Decision, Twin

__all__ = ["SPLIT", "Decision", "Fork", "Twin", "displacements", "fork"]
