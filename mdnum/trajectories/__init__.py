"""Detection of flips in trajectories of any program.

`NeighborFlips` is an MDAnalysis analysis class. `mdnum flips` runs the same analysis.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mdnum.lazy import on_first_use

if TYPE_CHECKING:
    from mdnum.trajectories.analysis import NeighborFlips as NeighborFlips
    from mdnum.trajectories.frame import Box as Box
    from mdnum.trajectories.frame import Frame as Frame
    from mdnum.trajectories.readers import open_trajectory as open_trajectory
    from mdnum.trajectories.rules import CutoffRule as CutoffRule
    from mdnum.trajectories.tracker import Tracker as Tracker

# MDAnalysis takes seconds to import
__getattr__, __dir__, __all__ = on_first_use(__name__)
