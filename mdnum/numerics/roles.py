"""Choice of the dtypes of state, arithmetic, comparisons with thresholds (decisions), and sums."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import ml_dtypes
import numpy as np

from mdnum.errors import InputError
from mdnum.registry import expect_known

WIDE: Mapping[str, np.dtype] = {"float64": np.dtype(np.float64), "float32": np.dtype(np.float32)}
ALL: Mapping[str, np.dtype] = {
    **WIDE,
    "float16": np.dtype(np.float16),
    "bfloat16": np.dtype(ml_dtypes.bfloat16),
}
#: Name of a fixed-point state: doubles that are integer multiples of fixed units.
FIXED_POINT = "lattice"
#: Roles of molecular dynamics for which sixteen bits are not supported, and the reason.
_TOO_SHORT: Mapping[str, str] = {
    "state": "a step moves an atom by less than the spacing of such coordinates, so nothing would move",
    "decision": "such coordinates are some hundredths of a distance apart, and their grid would decide",
    "accumulate": "it keeps two or three digits of a sum of some hundred terms, and the small ones are lost",
}


def carrier(name: str) -> np.dtype:
    """Return the numpy dtype for a dtype name. Fixed-point numbers are stored in float64."""
    return ALL["float64" if name == FIXED_POINT else name]


def check_role(role: str, dtype: str) -> None:
    """Raise an error if a dtype is not allowed for a role, such as "force".

    Raises:
        InputError: the dtype does not exist, or it has 16 bits and the role requires more.
    """
    known = ALL if role == "force" else WIDE
    if role == "state" and dtype == FIXED_POINT:
        return
    if dtype in ALL and dtype not in known:
        raise InputError(
            f"in molecular dynamics, precision.{role} cannot be {dtype}: {_TOO_SHORT[role]}",
            where=f"precision.{role}",
            remedy=f"Use {' or '.join(WIDE)}; only pair forces can be computed in {dtype} (precision.force)",
        )
    expect_known("dtype", [dtype], known, where=f"precision.{role}")


@dataclass(frozen=True)
class PrecisionPolicy:
    """The dtypes of state, forces, cutoff decisions and sums in a molecular-dynamics simulation.

    Example:
        >>> mdnum.PrecisionPolicy(force="float32")
    """

    # positions and velocities as they are carried from step to step; "lattice" for fixed-point numbers
    state: str = "float64"
    # distances and pair terms that enter forces and energies. In bfloat16 or float16 displacements are those
    # of the decision, rounded, and all that follows has sixteen bits up to the sum
    force: str = "float64"
    decision: str = "float64"  # the quantity and the threshold that a decision compares
    accumulate: str = "float64"  # the sums over neighbors

    def __post_init__(self):
        for role in ("state", "force", "decision", "accumulate"):
            check_role(role, getattr(self, role))

    def dtype(self, role: str) -> np.dtype:
        """Return the numpy dtype for a role: "state", "force", "decision" or "accumulate"."""
        return carrier(getattr(self, role))

    @property
    def geometry(self) -> np.dtype:
        """The dtype of the pair displacements from which forces are computed.

        For 32- and 64-bit forces, displacements have the force dtype. For 16-bit forces, displacements have
        the dtype of cutoff decisions.
        """
        return self.dtype("force") if self.force in WIDE else self.dtype("decision")


@dataclass(frozen=True)
class RolePrecision:
    """The dtypes of all numbers in a bouncing-ball simulation. 16-bit formats are also allowed."""

    state: str = "float64"  # what is carried from step to step
    arithmetic: str = "float64"  # the operations between one state and the next
    decision: str = "float64"  # the quantity and the threshold that a decision compares
    accumulate: str = "float64"  # sums; wider than `arithmetic` it is "store low, accumulate high"
    loss: str = "float64"  # the scalar that is differentiated
    # how a result becomes a state: "nearest" (ties to even) or "stochastic" (up or down with probabilities
    # that make the mean exact)
    rounding: str = "nearest"
    seed: int = 0  # of stochastic rounding

    def __post_init__(self):
        for role in ("state", "arithmetic", "decision", "accumulate", "loss"):
            expect_known("dtype", [getattr(self, role)], ALL, where=f"precision.{role}")
        known = ("nearest", "stochastic")
        expect_known("rounding", [self.rounding], known, where="precision.rounding")
        if self.seed < 0:
            raise InputError(f"seed {self.seed} is negative", remedy="Give 0 or more", where="precision.seed")

    def dtype(self, role: str) -> np.dtype:
        """Return the numpy dtype for a role: "state", "arithmetic", "decision", "accumulate" or "loss"."""
        return ALL[getattr(self, role)]

    @classmethod
    def all(cls, name: str) -> RolePrecision:
        """Return a precision policy with the same dtype for every role."""
        return cls(name, name, name, name, name)
