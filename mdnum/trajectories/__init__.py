"""Anybody's trajectory: which pairs entered or left a cutoff between the frames of a file.

`NeighborFlips` is an MDAnalysis analysis class; `mdnum flips` is the same for the command line.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mdnum.trajectories.analysis import NeighborFlips

__all__ = ["NeighborFlips"]


def __getattr__(name: str) -> Any:
    if name != "NeighborFlips":
        raise AttributeError(f"module 'mdnum.trajectories' has no attribute {name!r}")
    # on first use: MDAnalysis takes seconds to import
    from mdnum.trajectories.analysis import NeighborFlips

    return NeighborFlips
