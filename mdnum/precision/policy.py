"""Precision by role: which dtype the state, the force, the decision and the sums are kept in."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from mdnum.errors import InputError

_DTYPES = {"float64": np.dtype(np.float64), "float32": np.dtype(np.float32)}


@dataclass(frozen=True)
class PrecisionPolicy:
    """The dtype of each role of a number in a rollout.

    Attributes:
        state: positions and velocities as they are carried from step to step.
        force: distances and pair terms that enter forces and energies.
        decision: the quantity and the threshold that a decision compares.
        accumulate: the sums over neighbors.
    """

    state: str = "float64"
    force: str = "float64"
    decision: str = "float64"
    accumulate: str = "float64"

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if value not in _DTYPES:
                raise InputError(
                    f"unknown dtype {value!r}; known are {', '.join(_DTYPES)}",
                    where=f"precision.{field.name}",
                )

    def dtype(self, role: str) -> np.dtype:
        """The numpy dtype of a role ("state", "force", "decision" or "accumulate")."""
        return _DTYPES[getattr(self, role)]
