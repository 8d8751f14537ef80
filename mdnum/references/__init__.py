"""Referees: ASE, other neighbor searches and plain numpy, and mdnum as an ASE calculator.

Nothing here is imported before it is used: ASE, MDAnalysis and jax each cost a second or more.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mdnum.references.calculator import MdnumCalculator
    from mdnum.references.check import check_dynamics, check_energy, check_pairs
    from mdnum.references.effective import effective_cutoff
    from mdnum.references.finders import Finder
    from mdnum.references.oracle import all_pairs
    from mdnum.references.own import all_finders

__all__ = [
    "Finder",
    "MdnumCalculator",
    "all_finders",
    "all_pairs",
    "check_dynamics",
    "check_energy",
    "check_pairs",
    "effective_cutoff",
]

_WHERE = {
    "Finder": "finders",
    "MdnumCalculator": "calculator",
    "all_pairs": "oracle",
    "check_dynamics": "check",
    "check_energy": "check",
    "check_pairs": "check",
    "effective_cutoff": "effective",
    "all_finders": "own",
}


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        return getattr(importlib.import_module(f"mdnum.references.{_WHERE[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
