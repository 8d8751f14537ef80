"""The checks that `mdnum check` runs, by name."""

from __future__ import annotations

from mdnum.references.dynamics import DynamicsReport, check_dynamics
from mdnum.references.energy import EnergyReport, FrameComparison, check_energy
from mdnum.references.pairs import FinderResult, PairsReport, check_pairs

__all__ = [
    "DynamicsReport",
    "EnergyReport",
    "FinderResult",
    "FrameComparison",
    "PairsReport",
    "check_dynamics",
    "check_energy",
    "check_pairs",
]
