"""Referees: ASE, other neighbor searches and plain numpy, and mdnum as an ASE calculator.

Nothing here is imported before it is used: ASE, MDAnalysis and jax each cost a second or more.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mdnum.references.ase_models import MdnumCalculator
    from mdnum.references.energy_check import check_dynamics, check_energy
    from mdnum.references.oracle import all_pairs
    from mdnum.references.pair_check import Search, all_searches, check_pairs, effective_cutoff

__all__ = [
    "MdnumCalculator",
    "Search",
    "all_pairs",
    "all_searches",
    "check_dynamics",
    "check_energy",
    "check_pairs",
    "effective_cutoff",
]

_HOMES = {
    "MdnumCalculator": "ase_models",
    "Search": "pair_check",
    "all_pairs": "oracle",
    "all_searches": "pair_check",
    "check_dynamics": "energy_check",
    "check_energy": "energy_check",
    "check_pairs": "pair_check",
    "effective_cutoff": "pair_check",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"mdnum.references.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
