"""Anybody's trajectory: which pairs entered or left a cutoff between the frames of a file.

`NeighborFlips` is an MDAnalysis analysis class; `mdnum flips` is the same for the command line.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mdnum.trajectories.analysis import NeighborFlips

# imported on first use: MDAnalysis takes seconds to import
_HOMES = {"NeighborFlips": "mdnum.trajectories.analysis"}

__all__ = ["NeighborFlips"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'mdnum.trajectories' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
