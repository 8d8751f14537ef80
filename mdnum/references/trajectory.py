"""The steps of a rollout one by one, for comparing them with another code's."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy import ndarray


def trajectory(simulation: Any, steps: int) -> Iterator[tuple[ndarray, ndarray, float]]:
    """Unwrapped positions, velocities (atoms, 3) and potential energy of every step from 0 on."""
    from mdnum.rollout.engine import Engine, unwrapped

    for segment in Engine(simulation, steps).segments():
        potential = segment.rows_of("potential")
        for row in range(segment.rows):
            x = np.asarray(segment.unsorted("x", row), np.float64)
            x = unwrapped(simulation.cell.matrix, x, segment.unsorted("images", row))
            yield x, np.asarray(segment.unsorted("v", row), np.float64), float(potential[row])
