"""A conformance suite for neighbor lists: anybody's pair search against an exact oracle.

`examine` puts a list through all questions; `load` finds one by name; `NeighborListConformance` is a class to
subclass in a library's own tests; `cases` and `boxes` are hypothesis strategies for tests of one's own.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mdnum.references.conformance.adoption import NeighborListConformance
    from mdnum.references.conformance.case import Case, Still
    from mdnum.references.conformance.judge import Report
    from mdnum.references.conformance.lists import LISTS, KeptList, ListLimits, PairList, from_object
    from mdnum.references.conformance.peers import installed, known, load
    from mdnum.references.conformance.questions import boxes, cases
    from mdnum.references.conformance.reproduction import script
    from mdnum.references.conformance.suite import examine

# no module here has the name of what is exported: importing it would put the module in its place
_HOMES = {
    "adoption": ("NeighborListConformance",),
    "case": ("Case", "Still"),
    "judge": ("Report",),
    "lists": ("LISTS", "KeptList", "ListLimits", "PairList", "from_object"),
    "peers": ("installed", "known", "load"),
    "questions": ("boxes", "cases"),
    "reproduction": ("script",),
    "suite": ("examine",),
}

__all__ = [
    "LISTS", "Case", "KeptList", "ListLimits", "NeighborListConformance", "PairList", "Report", "Still",
    "boxes", "cases", "examine", "from_object", "installed", "known", "load", "script",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
