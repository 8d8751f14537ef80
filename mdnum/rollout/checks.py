"""The energy budget: what the ledger says the flips did, against what the energy did.

For a hard cutoff E_hard(t) = E_shifted(t) + sum over pair types of u(r_cut) * pairs inside(t), exactly. So
the change of the hard energy minus the jumps in the ledger must be the change of the shifted energy at the
same positions. A ledger that misses one flip is off by one u(r_cut).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float

from mdnum.numerics import unit_roundoff
from mdnum.rollout.engine import Segment
from mdnum.rollout.flips import decided_pairs, true_pairs
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
        difference = potential - self._reference.energy(positions)
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
        return 1e3 * eps * max(1.0, abs(self._reference.energy()))

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


# --- the life of Verlet lists: epochs, dangerous builds, and the audit that finds pairs a list has lost


@dataclass
class Epoch:
    """One list in use: what has been seen of it so far."""

    epoch: int
    start: int
    pairs_listed: int
    capacity: int
    occupancy: int
    build_ms: float
    length: int = 0
    displacement: float = 0.0
    next_displacement: float = 0.0
    lost: set[int] = field(default_factory=set)
    lost_pair_steps: int = 0
    first_lost_step: int = -1

    @classmethod
    def of(cls, segment: Segment) -> Epoch:
        """The epoch that a segment belongs to, before its first row."""
        table = segment.table
        return cls(
            segment.epoch, segment.built, table.pairs, table.slots, table.occupancy, 1e3 * table.build_seconds
        )

    def to_dict(self) -> dict:
        """Plain values, for a checkpoint."""
        return {**self.__dict__, "lost": sorted(self.lost)}

    @classmethod
    def from_dict(cls, values: dict) -> Epoch:
        """The inverse of `to_dict`."""
        return cls(**{**values, "lost": set(values["lost"])})


@dataclass
class ListHealth:
    """Follows the lists of a run and counts what went wrong.

    A list can only lose a pair once two atoms together have used up the skin. With a safe rebuild rule that
    never happens; where it does, every such step is audited against a fresh search.

    Attributes:
        simulation: the system as objects.
        lost: keys of all pairs lost at any step so far.
        lost_pair_steps: pairs missing, summed over steps.
        first_lost_step: -1 while nothing was lost.
        rebuilds: lists built after the first.
        dangerous: rebuilds at the first step they were allowed at, in LAMMPS's meaning.
        mismatches: rebuilds at which the new list found pairs that the old one had missed at its last step.
    """

    simulation: Simulation
    current: Epoch | None = None
    lost: set[int] = field(default_factory=set)
    lost_pair_steps: int = 0
    first_lost_step: int = -1
    rebuilds: int = 0
    dangerous: int = 0
    mismatches: int = 0

    def take(self, segment: Segment, missed: int) -> list[dict[str, np.ndarray]]:
        """Account for a segment; returns the rows of the epochs that are known to have ended.

        Args:
            segment: what the engine recorded.
            missed: pairs that the list before had missed at its last step, as this one found.
        """
        self.mismatches += missed > 0
        rows = []
        if self.current is not None and self.current.epoch != segment.epoch:
            # the run had ended with this list just used up, and was continued
            rows.append(
                self._close(self.current, "displacement" if self.simulation.rule.check else "interval")
            )
        if self.current is None or self.current.epoch != segment.epoch:
            self.current = Epoch.of(segment)
        epoch = self.current
        moved = segment.rows_of("moved")
        epoch.length += segment.rows
        epoch.displacement = max(epoch.displacement, float(np.max(moved, initial=0.0)))
        epoch.next_displacement = segment.moved
        self._audit(segment, moved, epoch)
        # a run that has come to its end may be continued with the list it has: see last_row
        if segment.closes and segment.closes != "end":
            rows.append(self._close(epoch, segment.closes))
            self.current = None
        return rows

    def last_row(self) -> dict[str, np.ndarray] | None:
        """The row of the list that is in use when a run comes to its end."""
        return None if self.current is None else self._close(self.current, "end")

    def _audit(self, segment: Segment, moved, epoch: Epoch) -> None:
        skin = self.simulation.rule.skin
        for row in np.flatnonzero(2 * moved > skin).tolist():
            positions = segment.unsorted("x", row).astype(np.float64)
            if not np.all(np.isfinite(positions)):
                continue
            true = true_pairs(self.simulation, positions)
            missing = np.setdiff1d(true, decided_pairs(self.simulation, segment, row), assume_unique=True)
            if not len(missing):
                continue
            step = segment.first + row
            for tally in (epoch, self):
                tally.lost_pair_steps += len(missing)
                tally.lost |= set(missing.tolist())
                tally.first_lost_step = step if tally.first_lost_step < 0 else tally.first_lost_step

    def _close(self, epoch: Epoch, reason: str) -> dict[str, np.ndarray]:
        rule = self.simulation.rule
        rebuilt = reason in ("displacement", "interval")
        dangerous = reason == "displacement" and epoch.length == rule.first_allowed
        self.rebuilds += rebuilt
        self.dangerous += dangerous
        consumed = 2 * epoch.displacement / rule.skin if rule.skin > 0 else np.inf
        values = {
            "epoch": epoch.epoch,
            "start": epoch.start,
            "length": epoch.length,
            "displacement": epoch.displacement,
            "skin_consumed": consumed,
            "pairs_listed": epoch.pairs_listed,
            "capacity": epoch.capacity,
            "occupancy": epoch.occupancy,
            "reason": reason,
            "dangerous": dangerous,
            "lost_pairs": len(epoch.lost),
            "lost_pair_steps": epoch.lost_pair_steps,
            "first_lost_step": epoch.first_lost_step,
            "build_ms": epoch.build_ms,
            # the flip of the `rebuild` channel: how far the skin was overdrawn at the step that follows
            "margin": rule.skin / 2 - epoch.next_displacement if rebuilt else np.nan,
        }
        return {name: np.array([value]) for name, value in values.items()}

    def to_dict(self) -> dict:
        """Plain values, for a checkpoint."""
        values = {k: v for k, v in self.__dict__.items() if k not in ("simulation", "current", "lost")}
        current = None if self.current is None else self.current.to_dict()
        return {**values, "lost": sorted(self.lost), "current": current}

    @classmethod
    def from_dict(cls, simulation: Simulation, values: dict) -> ListHealth:
        """The inverse of `to_dict`."""
        current = None if values["current"] is None else Epoch.from_dict(values["current"])
        rest = {k: v for k, v in values.items() if k not in ("lost", "current")}
        return cls(simulation, current=current, lost=set(values["lost"]), **rest)
