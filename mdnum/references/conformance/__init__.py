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
    from mdnum.references.conformance.lists import KeptList, Limits, PairList
    from mdnum.references.conformance.loading import from_object, installed, known, load
    from mdnum.references.conformance.reproduction import script
    from mdnum.references.conformance.strategies import boxes, cases
    from mdnum.references.conformance.suite import Report, examine

# no module here has the name of what is exported: importing it would put the module in its place
_WHERE = {
    "Case": "case",
    "KeptList": "lists",
    "Limits": "lists",
    "NeighborListConformance": "adoption",
    "PairList": "lists",
    "Report": "suite",
    "Still": "case",
    "boxes": "strategies",
    "cases": "strategies",
    "examine": "suite",
    "from_object": "loading",
    "installed": "loading",
    "known": "loading",
    "load": "loading",
    "script": "reproduction",
}

__all__ = [
    "Case",
    "KeptList",
    "Limits",
    "NeighborListConformance",
    "PairList",
    "Report",
    "Still",
    "boxes",
    "cases",
    "examine",
    "from_object",
    "installed",
    "known",
    "load",
    "script",
]


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        return getattr(importlib.import_module(f"mdnum.references.conformance.{_WHERE[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
