"""The energy budget: what the ledger says the flips did, against what the energy did.

For a hard cutoff E_hard(t) = E_shifted(t) + sum over pair types of u(r_cut) * pairs inside(t), exactly. So
the change of the hard energy minus the jumps in the ledger must be the change of the shifted energy at the
same positions. A ledger that misses one flip is off by one u(r_cut).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from mdnum.numerics import unit_roundoff
from mdnum.systems.build import Simulation

# a missed flip shows as one jump; rounding of the sums must stay far below it
_SHARE_OF_A_JUMP = 0.1


@dataclass
class EnergyBudget:
    """Checks the ledger against an evaluation that shares no list with the run.

    Attributes:
        simulation: the system as objects.
        start: hard energy minus reference energy at step 0, or None before it was seen.
        jumps: sum of the ledger's energy jumps so far.
        residual: largest |deviation| found, energy.
        step: the step it was found at.
        checks: how many steps were checked.
    """

    simulation: Simulation
    start: float | None = None
    jumps: float = 0.0
    residual: float = 0.0
    step: int = 0
    checks: int = 0

    _fields = ("start", "jumps", "residual", "step", "checks")

    @cached_property
    def _reference(self) -> Simulation:
        jumps = bool(np.any(self.simulation.jumps()[0] != 0))
        return self.simulation.continuous if jumps else self.simulation

    def check(self, step: int, positions: Float[np.ndarray, "atoms 3"], potential: float) -> float:
        """Close the budget at one step; returns the deviation there.

        Args:
            step: the step.
            positions: wrapped positions at it, shape (atoms, 3).
            potential: potential energy that the run computed there.
        """
        difference = potential - self._reference.evaluate(positions).energy
        # a reference that is the system itself has the jumps, too
        jumps = 0.0 if self._reference is self.simulation else self.jumps
        if self.start is None:
            self.start = difference - jumps
        deviation = difference - self.start - jumps
        if abs(deviation) >= abs(self.residual):
            self.residual, self.step = deviation, step
        self.checks += 1
        return deviation

    @property
    def tolerance(self) -> float:
        """Deviation below which the budget closes: a tenth of the smallest jump, or rounding."""
        if self._reference is not self.simulation:
            jumps = np.abs(self.simulation.jumps()[0])
            return _SHARE_OF_A_JUMP * float(jumps[jumps > 0].min())
        eps = 2 * unit_roundoff(self.simulation.policy.dtype("force"))
        return 1e3 * eps * max(1.0, abs(self._reference.evaluate().energy))

    @property
    def closes(self) -> bool:
        """Whether every check stayed within the tolerance."""
        return abs(self.residual) <= self.tolerance

    def to_dict(self) -> dict:
        """Plain values, for a checkpoint."""
        return {name: getattr(self, name) for name in self._fields}

    @classmethod
    def from_dict(cls, simulation: Simulation, values: dict) -> EnergyBudget:
        """The inverse of `to_dict`."""
        return cls(simulation, **values)
