"""One frame of a trajectory, and the box it stands in: float64, whatever the file stores."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

_NO_BOX = ((0.0, 0.0, 0.0),) * 3


@dataclass(frozen=True)
class Box:
    """Lattice vectors, and the directions in which they repeat.

    Attributes:
        matrix: lattice vectors as rows, length; rows of directions that do not repeat are not looked at.
        pbc: which of them repeat.
    """

    matrix: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.array(_NO_BOX))
    pbc: Bool[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3, bool))

    @property
    def periodic(self) -> bool:
        """Whether any direction repeats."""
        return bool(self.pbc.any())


@dataclass(frozen=True)
class Frame:
    """Positions at one moment.

    Attributes:
        index: number of the frame in its file, from 0.
        time: in the file's unit; the index where the file has no times.
        positions: length; those of all atoms of the file.
        box: the box of this frame.
        velocities: length per time, where the file has them.
        labels: names, elements or types of the atoms, where the file has them in every frame.
    """

    index: int
    time: float
    positions: Float[np.ndarray, "atoms 3"]
    box: Box
    velocities: Float[np.ndarray, "atoms 3"] | None = None
    labels: np.ndarray | None = None
