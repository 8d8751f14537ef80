"""Summary of a run: totals, and checks of energies and neighbor lists."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mdnum.md.cell import Cell, displacement, wrap_positions
from mdnum.md.ledger import FlipTable
from mdnum.numerics import unit_roundoff
from mdnum.rollout.adequacy import beyond_cutoff
from mdnum.rollout.engine import Segment
from mdnum.rollout.flips import decided_pairs, true_pairs
from mdnum.systems.schema import pair_names
from mdnum.systems.simulation import Simulation


@dataclass
class LineFit:
    """A least-squares line through a stream of points, in constant memory.

    The first value is subtracted from all values to keep the sums small.
    """

    count: int = 0
    first: float = 0.0
    x: float = 0.0
    y: float = 0.0
    xx: float = 0.0
    xy: float = 0.0

    def add(self, x: Float[np.ndarray, "rows"], y: Float[np.ndarray, "rows"]) -> None:
        """Add points (x, y) to the least-squares fit."""
        if not self.count:
            self.first = float(y[0])
        relative = y - self.first
        self.count += len(x)
        self.x += float(x.sum())
        self.y += float(relative.sum())
        self.xx += float(x @ x)
        self.xy += float(x @ relative)

    @property
    def slope(self) -> float | None:
        """Slope dy/dx of the line. None for fewer than 3 points, or if sums under- or overflow."""
        spread = self.count * self.xx - self.x * self.x
        if self.count < 3 or not 1e-280 < spread < np.inf:
            return None
        return (self.count * self.xy - self.x * self.y) / spread


@dataclass
class RunTally:
    """Sums and extreme values over all time steps up to the current step."""

    step: int = -1
    entered: int = 0
    left: int = 0
    by_box: int | None = None  # flips that the box has caused; None where it does not move
    ambiguous: int = 0
    ambiguous_flips: int = 0
    pairs_first: int = 0
    pairs_last: int = 0
    bound: float = 0.0
    start_up_seconds: float = 0.0
    seconds: float = 0.0
    steps_per_second: float | None = None
    jumps: float = 0.0
    # heat, work: energy that the atoms have from a thermostat and from the box so far
    heat: float = 0.0
    work: float = 0.0
    conserved: LineFit = field(default_factory=LineFit)
    without_jumps: LineFit = field(default_factory=LineFit)

    def take(
        self, segment: Segment, rows: dict[str, np.ndarray], ledger: FlipTable, bounds: np.ndarray
    ) -> None:
        """Add a group of time steps to the totals."""
        self.bound = max(self.bound, float(np.max(bounds)))
        pairs = rows["pairs"]
        if self.step < 0:
            self.pairs_first = int(pairs[0])
        self.step = segment.last
        self.heat, self.work = (float(segment.rows_of(name)[-1]) for name in ("heat", "work"))
        self.pairs_last = int(pairs[-1])
        self.entered += int(ledger.entered.sum())
        self.left += int((~ledger.entered).sum())
        if "by_box" in rows:
            self.by_box = (self.by_box or 0) + int(rows["by_box"].sum())
        self.ambiguous += int(rows["ambiguous"].sum())
        self.ambiguous_flips += int(ledger.ambiguous.sum())
        jumps = self.jumps + np.cumsum(rows["energy_jump"])
        self.jumps = float(jumps[-1])
        self.conserved.add(rows["time"], rows["conserved"])
        self.without_jumps.add(rows["time"], rows["conserved"] - jumps)

    @classmethod
    def from_dict(cls, values: dict) -> RunTally:
        """Restore the totals from the values that `to_dict` returned."""
        lines = {name: LineFit(**values[name]) for name in ("conserved", "without_jumps")}
        return cls(**{**values, **lines})


def log_line(simulation: Simulation, segment: Segment, row: int, pairs: int, flips: int) -> str:
    """Format a line of log.txt, with the numbers of pairs inside the cutoff and of flips."""
    potential, kinetic = segment.rows_of("potential")[row], segment.rows_of("kinetic")[row]
    temperature = 2 * kinetic / (degrees_of_freedom(simulation) * simulation.units.k_B)
    step = segment.first + row
    time = step * simulation.timestep
    return (
        f"{step:8d} {time:10.4f} {potential:14.6f} {kinetic:14.6f} {potential + kinetic:14.6f} "
        f"{temperature:12.4f} {pairs:9d} {flips:6d}"
    )


def summarize(simulation: Simulation, done: Any, steps: int, status: str) -> dict[str, Any]:
    """Return the entries of summary.json for the totals of a run."""
    tally, health, budget = done.tally, done.health, done.budget
    jumps = energy_jump, force_jump = simulation.jumps()
    pairs = pair_names(simulation.symbols)
    alike = all(np.allclose(np.abs(one), np.abs(one[0]), rtol=1e-9, atol=0) for one in jumps)
    timestep = simulation.timestep
    cutoff = simulation.cutoff
    pressure = done.pressure.summary()
    slope, without = tally.conserved.slope, tally.without_jumps.slope
    return {
        "system": simulation.name,
        "about": simulation.origin.about,
        "status": status,
        "units": simulation.units.name,
        "atoms": simulation.atoms,
        "steps": tally.step,
        "steps_asked": steps,
        "time": tally.step * timestep,
        "dynamics": simulation.integrator.name,
        "degrees_of_freedom": degrees_of_freedom(simulation),
        "flips_entered": tally.entered,
        "flips_left": tally.left,
        **({} if tally.by_box is None else {"flips_by_box": tally.by_box}),
        "pairs_first": tally.pairs_first,
        "pairs_last": tally.pairs_last,
        "algebra_residual": tally.pairs_last - tally.pairs_first - tally.entered + tally.left,
        "rebuilds": health.rebuilds,
        "dangerous_builds": health.dangerous,
        "count_mismatches": health.mismatches,
        "lost_pairs": len(health.lost),
        "lost_pair_steps": health.lost_pair_steps,
        "first_lost_step": health.first_lost_step,
        "ambiguous": tally.ambiguous,
        "ambiguous_flips": tally.ambiguous_flips,
        "energy_drift": None if slope is None else slope / simulation.atoms,
        # the flips' own jumps follow the number of pairs, up and down, and are no drift of the integrator
        "energy_drift_without_jumps": None if without is None else without / simulation.atoms,
        **({"heat": tally.heat, "work": tally.work} if tally.heat or tally.work else {}),
        "energy_budget_residual": budget.residual,
        "energy_budget_tolerance": budget.tolerance,
        "energy_budget_checks": budget.checks,
        "energy_budget_closes": budget.closes,
        "steps_per_second": tally.steps_per_second,
        "start_up_seconds": tally.start_up_seconds,
        "seconds": tally.start_up_seconds + tally.seconds,
        "wall_seconds": tally.seconds,
        "cutoff": {
            "kind": cutoff.name if cutoff is not None else simulation.model.name,
            "radius": simulation.r_cut,
            "skin": simulation.rule.skin,
            "compare": simulation.decider.compare,
            "energy_jump": float(energy_jump[np.argmax(np.abs(energy_jump))]),
            "force_jump": float(force_jump[np.argmax(np.abs(force_jump))]),
            # where they differ, pair types with the largest
            **({} if alike else {"largest": [pairs[np.argmax(np.abs(one)) % len(pairs)] for one in jumps]}),
            "smoothness": cutoff.smoothness if cutoff is not None else simulation.model.smoothness.order,
            "bound": max(tally.bound, *simulation.decider.bounds),
        },
        "fixed_point": None
        if simulation.fixed_point is None
        else simulation.fixed_point.to_dict(float(simulation.integrator.timestep)),
        "beyond_cutoff": pressure["tail"] if pressure else beyond_cutoff(simulation),
        "pressure": pressure,
        "ase": None,
        "findings": [],
        "verdict": "",
    }


def closest_pair(simulation: Simulation, positions: Float[np.ndarray, "atoms 3"]) -> str:
    """Return a phrase about the closest two atoms, for the error message of a blow-up."""
    if simulation.atoms < 2 or not np.all(np.isfinite(positions)):
        return ""
    wrapped, _ = wrap_positions(simulation.cell, positions)
    table = simulation.verlet_list().build(wrapped, simulation.cell)
    slot, column = np.nonzero(table.index < simulation.atoms)
    if not len(slot):
        return ""
    i, j = table.order[column], table.order[table.index[slot, column]]
    d = displacement(simulation.cell, wrapped[i], wrapped[j])
    distance = np.sqrt(sum(c * c for c in d))
    k = int(np.argmin(distance))
    low, high = sorted((int(i[k]), int(j[k])))
    return f"; the closest pair is {low}-{high} at {distance[k]:.4g} {simulation.units.length}"


# --- one row per step: energies, temperature, pressure, pairs and flips, in the user's units ----------


def degrees_of_freedom(simulation: Simulation) -> int:
    """Return the number of degrees of freedom: 3 N, or 3 N - 3 with conserved total momentum."""
    return simulation.integrator.freedom(simulation.masses)


def series_columns(
    simulation: Simulation,
    segment: Segment,
    pairs: np.ndarray,
    ambiguous: np.ndarray,
    ledger: FlipTable,
    by_box: Bool[np.ndarray, "flips"] | None = None,
) -> dict[str, np.ndarray]:
    """Return the columns of series.parquet for the steps of a segment.

    Args:
        simulation: the system as objects.
        segment: the engine's record.
        pairs: number of pairs inside the cutoff at each row.
        ambiguous: number of pairs with |margin| below the rounding bound at each row.
        ledger: the flips of the segment.
        by_box: mask of the flips caused by a change of the box; None if the box is fixed.
    """
    units = simulation.units
    step = np.arange(segment.first, segment.first + segment.rows)
    potential, kinetic = segment.rows_of("potential"), segment.rows_of("kinetic")
    row = ledger.step - segment.first
    count = segment.rows
    entered = np.bincount(row[ledger.entered], minlength=count)
    left = np.bincount(row[~ledger.entered], minlength=count)
    total = potential + kinetic
    volume = np.array([cell.volume for cell in segment.cells or (segment.cell,)])
    pressure = (2 * kinetic + segment.rows_of("virial")) / (3 * volume)
    return {
        "step": step,
        "time": step * simulation.timestep,
        "potential": potential,
        "kinetic": kinetic,
        "total": total,
        "temperature": 2 * kinetic / (degrees_of_freedom(simulation) * units.k_B),
        "pressure": pressure * units.pressure_factor,
        "pairs": pairs,
        "entered": entered,
        "left": left,
        "displacement": segment.rows_of("moved"),
        "energy_jump": np.bincount(row, weights=ledger.energy_jump, minlength=count),
        "ambiguous": ambiguous,
        "min_margin": segment.rows_of("nearest"),
        "conserved": total - segment.rows_of("heat") - segment.rows_of("work"),
        **(
            {
                "work": segment.rows_of("work"),
                "volume": volume,
                **_lattice(segment.rows_of("cell")),
                "by_box": np.bincount(row[by_box], minlength=count),
            }
            if segment.cells
            else {}
        ),
    }


def _lattice(vectors: Float[np.ndarray, "rows 3 3"]) -> dict[str, np.ndarray]:
    """Return the lengths of the lattice vectors, and their angles in degrees."""
    lengths = np.linalg.norm(vectors, axis=2)
    pairs = np.array([1, 2, 0]), np.array([2, 0, 1])
    dots, products = (np.prod([one[:, k] for k in pairs], axis=0) for one in (vectors, lengths))
    with np.errstate(invalid="ignore", divide="ignore"):
        angles = np.degrees(np.arccos(np.clip(dots.sum(axis=2) / products, -1, 1)))
    return dict(zip(("a", "b", "c", "alpha", "beta", "gamma"), (*lengths.T, *angles.T), strict=True))


# --- the energy budget: what the ledger says the flips did, against what the energy did -----------------
#
# For a hard cutoff E_hard(t) = E_shifted(t) + sum over pair types of u(r_cut) * pairs inside(t), exactly. So
# the change of the hard energy minus the jumps in the ledger must be the change of the shifted energy at the
# same positions. A ledger that misses one flip is off by one u(r_cut).

# a missed flip shows as one jump; rounding of the sums must stay far below it
_SHARE_OF_A_JUMP = 0.1
# differences of four energies, the largest of many, over the largest rounding of a few
_NOISES = 20.0


@dataclass
class EnergyBudget:
    """Check of the recorded energy jumps against energies computed without neighbor lists."""

    simulation: Simulation  # the system as objects
    start: float | None = None  # hard energy minus reference energy at step 0, or None before it was seen
    jumps: float = 0.0  # sum of the ledger's energy jumps so far
    residual: float = 0.0  # largest |deviation| found, energy
    step: int = 0  # the step it was found at
    checks: int = 0  # how many steps were checked

    _fields = ("start", "jumps", "residual", "step", "checks")

    @cached_property
    def _reference(self) -> Simulation:
        jumps = bool(np.any(self.simulation.jumps()[0] != 0))
        return self.simulation.continuous if jumps else self.simulation

    def check(
        self, step: int, positions: Float[np.ndarray, "atoms 3"], potential: float, cell: Cell | None = None
    ) -> dict:
        """Check the energy at one step; return forces and pair distances from `Simulation.numbers`.

        Args:
            step: the step.
            positions: wrapped positions at this step, shape (atoms, 3).
            potential: potential energy that the run computed at this step.
            cell: the box at this step; required if the integrator changes the box.
        """
        energy, numbers = self._reference.in_row(cell).numbers(positions)
        difference = potential - energy
        # a reference that is the system itself has the jumps, too
        jumps = 0.0 if self._reference is self.simulation else self.jumps
        if self.start is None:
            self.start = difference - jumps
        deviation = difference - self.start - jumps
        if abs(deviation) >= abs(self.residual):
            self.residual, self.step = deviation, step
        self.checks += 1
        return numbers

    @property
    def tolerance(self) -> float:
        """Largest allowed energy error: a tenth of the smallest jump, or a rounding bound."""
        if self._reference is not self.simulation:
            jumps = np.abs(self.simulation.jumps()[0])
            return _SHARE_OF_A_JUMP * float(jumps[jumps > 0].min())
        eps = 2 * unit_roundoff(self.simulation.policy.dtype("force"))
        # an energy function may cancel large terms
        noise = _NOISES * getattr(self.simulation.model, "noise", 0.0)
        return max(1e3 * eps * max(1.0, abs(self._reference.numbers()[0])), noise)

    @property
    def closes(self) -> bool:
        """True if the deviation of every check was within the tolerance."""
        return abs(self.residual) <= self.tolerance

    def to_dict(self) -> dict:
        """Return the state of the check as plain values, for a checkpoint."""
        return {name: getattr(self, name) for name in self._fields}

    @classmethod
    def from_dict(cls, simulation: Simulation, values: dict) -> EnergyBudget:
        """Restore the state of the check from the values that `to_dict` returned."""
        return cls(simulation, **values)


# --- the life of Verlet lists: epochs, dangerous builds, and the audit that finds pairs a list has lost


@dataclass
class Epoch:
    """Statistics of the current neighbor list, up to the current step."""

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
        """Return the statistics of a new neighbor list, before its first step."""
        table = segment.table
        return cls(
            segment.epoch, segment.built, table.pairs, table.slots, table.occupancy, 1e3 * table.build_seconds
        )


@dataclass
class ListHealth:
    """Monitor of a run's neighbor lists, which counts missed pairs and dangerous rebuilds.

    A list can miss a pair only if the displacements of two atoms add up to more than the skin. A safe rule
    rebuilds the list before pairs can be missed. For an unsafe rule, a new search checks for missed pairs.
    """

    simulation: Simulation  # the system as objects
    current: Epoch | None = None
    lost: set[int] = field(default_factory=set)  # keys of all pairs lost at any step so far
    lost_pair_steps: int = 0  # pairs missing, summed over steps
    first_lost_step: int = -1  # -1 while nothing was lost
    rebuilds: int = 0  # lists built after the first
    dangerous: int = 0  # rebuilds at the first step they were allowed at, in LAMMPS's meaning
    # rebuilds at which the new list found pairs that the old one had missed at its last step
    mismatches: int = 0

    def take(self, segment: Segment, missed: int) -> list[dict[str, np.ndarray]]:
        """Add a group of time steps to the counts. Return a table row for each replaced list.

        Args:
            segment: the engine's record.
            missed: number of pairs of the new list that the previous list missed at its last step.
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
        """Return the table row of the last neighbor list of a run."""
        return None if self.current is None else self._close(self.current, "end")

    def _audit(self, segment: Segment, moved, epoch: Epoch) -> None:
        skin = self.simulation.rule.skin
        for row in np.flatnonzero(2 * moved > skin).tolist():
            positions = segment.unsorted("x", row).astype(np.float64)
            if not np.all(np.isfinite(positions)):
                continue
            true = true_pairs(self.simulation.in_row(segment.cell_of(row)), positions)
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
            **{name: getattr(epoch, name) for name in ("epoch", "start", "length", "displacement")},
            "skin_consumed": consumed,
            **{name: getattr(epoch, name) for name in ("pairs_listed", "capacity", "occupancy")},
            "reason": reason,
            "dangerous": dangerous,
            "lost_pairs": len(epoch.lost),
            **{name: getattr(epoch, name) for name in ("lost_pair_steps", "first_lost_step", "build_ms")},
            # the flip of the `rebuild` channel: how far the skin was overdrawn at the step that follows
            "margin": rule.skin / 2 - epoch.next_displacement if rebuilt else np.nan,
        }
        return {name: np.array([value]) for name, value in values.items()}

    def to_dict(self) -> dict:
        """Return the counts as plain values, for a checkpoint."""
        epoch = self.current and {**vars(self.current), "lost": sorted(self.current.lost)}
        values = {k: v for k, v in vars(self).items() if k not in ("simulation", "current", "lost")}
        return {**values, "lost": sorted(self.lost), "current": epoch}

    @classmethod
    def from_dict(cls, simulation: Simulation, values: dict) -> ListHealth:
        """Restore a monitor from the values that `to_dict` returned."""
        epoch = values["current"] and Epoch(**{**values["current"], "lost": set(values["current"]["lost"])})
        return cls(simulation, **{**values, "lost": set(values["lost"]), "current": epoch})
