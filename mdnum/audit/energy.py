"""Energy balance of a run: energy jumps, work of the forces, energy drift.

If the force is minus the energy gradient, energy change plus work is zero in every step. An unexplained
energy change at a distance threshold is the energy jump of a flip. An energy jump elsewhere is due to a limit
on the number of neighbors or a selection of nearest neighbors. An unexplained change at many points means
that the force is not minus the energy gradient.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from ase import Atoms
from ase.neighborlist import neighbor_list
from jaxtyping import Float

from mdnum.audit.curve import Curve
from mdnum.audit.structures import exchanged
from mdnum.audit.subject import CalculatorSubject
from mdnum.audit.thresholds import PairThreshold

_BESIDE = 1e-7  # Å before and after a crossing at which the energy is asked for
_MEASURED = 240  # flips whose jumps are measured; the others get the mean of these
_ENOUGH = 30  # steps with flips that a sample must have
_LEVELS = 15  # halvings of a step's way: what is left of it then is a millionth of an Å
_SPREAD_AT = 4  # after this many, a force that is no gradient is in sixteen parts, a jump still in one
_FOLLOWED = 0.15  # of the largest: a part with less is not followed, and of a spread each of sixteen has less
_MOST_STEPS, _CALLS = 40, 800  # steps that are searched for jumps, and calls after which no further one is
_SMALL = 1e-6  # of kT: what a step leaves unexplained below this is not searched
_BLOCKS = 8
_SKIN = 1.0  # Å by which a list of pairs reaches further than the threshold, so that it lasts for some steps

Steps = Float[np.ndarray, "steps"]


@dataclass(frozen=True)
class NveRun:
    """Trajectory of a run at constant energy."""

    start: Atoms  # its species and cell
    timestep: float  # internal time (length * sqrt(mass / energy))
    potential: Float[np.ndarray, "steps"]  # of every step, eV
    kinetic: Float[np.ndarray, "steps"]  # of every step, eV
    positions: Float[np.ndarray, "steps atoms 3"]  # never wrapped, Å
    forces: Float[np.ndarray, "steps atoms 3"]  # of the calculator, without those of constraints, eV/Å
    blown_up: bool  # whether it was stopped because the atoms flew apart

    @property
    def total(self) -> Float[np.ndarray, "steps"]:
        """Total energy (eV) at every time step."""
        return self.potential + self.kinetic

    @property
    def time(self) -> Float[np.ndarray, "steps"]:
        """Time at every step, in internal units."""
        return self.timestep * np.arange(len(self.potential))

    def at(self, positions: Float[np.ndarray, "atoms 3"]) -> Atoms:
        """Return the atoms of the run at given positions, without constraints."""
        there = self.start.copy()
        there.set_constraint()
        there.positions = positions
        return there

    def way(self, step: int, share: float) -> Float[np.ndarray, "atoms 3"]:
        """Return the positions at a fraction of the line between two time steps."""
        return self.positions[step - 1] + share * (self.positions[step] - self.positions[step - 1])


@dataclass(frozen=True)
class RunCrossing:
    """A pair of atoms whose distance crossed a threshold between two time steps."""

    step: int  # after it; the step before is one less
    # i, j, rank: the pair, and how many of its images inside are nearer
    i: int
    j: int
    rank: int
    entered: bool  # whether it is inside afterwards
    threshold: PairThreshold
    distance: float  # at `step`, Å
    margin: float  # at `step`, Å
    share: float  # of the step's straight way at which the distance is the threshold's
    slack: float  # of the way to stay clear of it on either side

    @property
    def sign(self) -> float:
        """Crossing direction: 1 if the pair distance falls below the threshold, else -1."""
        return 1.0 if self.entered else -1.0


def crossings(run: NveRun, thresholds: Sequence[PairThreshold]) -> list[RunCrossing]:
    """Find all flips of a run, in order of time."""
    species, cell, found = set(run.start.get_chemical_symbols()), run.start.cell.array, []
    for threshold in (one for one in thresholds if set(one.species) <= species):
        radius, skin, reference = threshold.radius, 0.0, run.positions[0]
        for step in range(1, len(run.positions)):
            before, after = run.positions[step - 1 : step + 1]
            if step == 1 or 2 * _furthest(after - reference) > skin:
                skin, reference = max(_SKIN, 3 * _furthest(after - before)), before
                i, j, image = neighbor_list("ijS", run.at(before), {threshold.species: radius + skin})
                once = (i < j) | ((i == j) & (image @ [1_000_000, 1000, 1] > 0))
                i, j, shift = i[once], j[once], image[once] @ cell
            start, end = (positions[j] - positions[i] + shift for positions in (before, after))
            was, now = np.linalg.norm(start, axis=1), np.linalg.norm(end, axis=1)
            for k in np.flatnonzero((was < radius) != (now < radius)):
                entered, way = bool(now[k] < radius), end[k] - start[k]
                distances = now if entered else was
                nearer = (i == i[k]) & (j == j[k]) & (distances < distances[k])
                clear = max(_BESIDE, 3 * threshold.located) / max(float(np.linalg.norm(way)), 1e-300)
                found.append(
                    RunCrossing(
                        step, int(i[k]), int(j[k]), int(nearer.sum()), entered, threshold, float(now[k]),
                        radius - float(now[k]), _root(start[k], way, radius**2),
                        float(np.clip(clear, 1e-9, 1e-3)),
                    )
                )  # fmt: skip
    return sorted(found, key=lambda one: (one.step, one.share))


def _furthest(moved: Float[np.ndarray, "atoms 3"]) -> float:
    return float(np.linalg.norm(moved, axis=1).max())


def _root(start: Float[np.ndarray, "3"], way: Float[np.ndarray, "3"], square: float) -> float:
    """Return the fraction s in [0, 1] at which |start + s * way|² = `square`."""
    a, b, c = float(way @ way), 2 * float(start @ way), float(start @ start) - square
    inside = b * b - 4 * a * c
    if a == 0 or inside < 0:
        return 0.5
    # the form without cancellation
    q = -0.5 * (b + np.copysign(np.sqrt(inside), b))
    roots = [q / a, c / q if q else 0.0]
    return float(np.clip(min(roots, key=lambda one: abs(one - 0.5)), 0.0, 1.0))


def along_step(subject: CalculatorSubject, run: NveRun, step: int, ends: bool = False) -> Curve:
    """Energy and force on the line between two steps. If `ends` is true, values at the ends are the run's."""
    way = run.positions[step] - run.positions[step - 1]

    def at_share(share: float) -> tuple[float, float]:
        energy, forces = subject.both(run.at(run.way(step, share)))
        return energy, float(np.sum(forces * way))

    curve = Curve(at_share)
    for share, n in ((0.0, step - 1), (1.0, step)) if ends else ():
        curve.known[share] = float(run.potential[n]), float(np.sum(run.forces[n] * way))
    return curve


def account(
    subject: CalculatorSubject, run: NveRun, step: int, crossed: Sequence[RunCrossing], smooth: int = 2
) -> tuple[list[float], float]:
    """Compute the work of the forces between two time steps, separately between crossings.

    Args:
        subject: a calculator object separate from the run's; called three times per crossing, plus once.
        crossed: crossings that happen in the step that ends with this number, ordered along the line.
        smooth: crossings of thresholds of this order or higher are ignored: 2, since Simpson's rule tolerates
            a kink in the force's slope; or 1 if there are too many force kinks, symmetric about the middle.

    Returns:
        (jump of the energy at each crossing, 0 if there is none; energy change that neither the jumps nor the
        work of the forces explain), eV.

    Error:
        that of Simpson's rule over one step, fifth power of the step's length; the calculator's noise.
    """
    curve, left = along_step(subject, run, step, ends=True), 0.0
    jumps, rest = [], 0.0
    for one in crossed:
        order = one.threshold.order
        if order >= smooth:
            jumps.append(0.0)
            continue
        below, above = max(one.share - one.slack, left), min(one.share + one.slack, 1.0)
        rest += _unexplained(curve, left, below)
        (before, first), (after, last) = curve(below), curve(above)
        # what the smooth forces do between the two places is no jump
        change = after - before + 0.5 * (first + last) * (above - below)
        jumps.append(change if order == 0 else 0.0)
        rest += 0.0 if order == 0 else change
        left = above
    return jumps, rest + _unexplained(curve, left, 1.0)


def _unexplained(curve: Curve, low: float, high: float) -> float:
    """Sum of energy change and work of the force (Simpson's rule). 0 if the force is -dE/dx."""
    if high <= low:
        return 0.0
    (before, first), (after, last) = curve(low), curve(high)
    return after - before + (high - low) * (first + 4 * curve(0.5 * (low + high))[1] + last) / 6


@dataclass(frozen=True)
class HiddenJump:
    """A point between two steps at which the energy jumps."""

    step: int  # at its end
    share: float  # of the way
    energy: float  # after minus before, without the work done between, eV
    ties: tuple[tuple[int, int], ...]  # (atom, k) whose k-th and next neighbors change places there
    radius: float | None = None  # Å, of the pair threshold that is crossed there, smoothly for two atoms


@dataclass(frozen=True)
class HiddenJumps:
    """Energy jumps in those time steps with an unexplained energy change."""

    jumps: tuple[HiddenJump, ...] = ()  # found in the steps that were searched
    steps: Mapping[int, float] = field(default_factory=dict)  # those, with what they left unexplained, eV
    candidates: tuple[int, ...] = ()  # steps that leave more unexplained than noise does

    @property
    def share(self) -> float:
        """Fraction of the energy change that jumps explain."""
        whole = sum(abs(rest) for rest in self.steps.values())
        left = sum(abs(rest - self.brought(step)) for step, rest in self.steps.items())
        return max(1.0 - left / whole, 0.0) if whole else 0.0

    def brought(self, step: int) -> float:
        """Return the sum (eV) of the energy jumps found in a time step."""
        return sum(jump.energy for jump in self.jumps if jump.step == step)

    def energies(self, rest: Steps) -> Steps:
        """Energy change (eV) of each step due to hidden jumps. Steps not searched have estimates."""
        found = np.zeros(len(rest))
        for step in self.candidates:
            found[step] = self.brought(step) if step in self.steps else self.share * rest[step]
        return found

    @property
    def rank(self) -> tuple[int, int]:
        """Rank k for which neighbors k and k+1 swap most often at jumps, and number of these jumps."""
        return _most_frequent(k for jump in self.jumps for k in {k for _, k in jump.ties})

    @property
    def radius(self) -> tuple[float, int]:
        """Distance that pairs cross most often at a jump, and number of these jumps."""
        return _most_frequent(jump.radius for jump in self.jumps if jump.radius is not None)


def _most_frequent(values: Iterable[Any]) -> tuple[Any, int]:
    return next(iter(Counter(values).most_common(1)), (0, 0))


def hidden_jumps(
    probe: CalculatorSubject,
    run: NveRun,
    rest: Steps,
    crossed: Mapping[int, Sequence[RunCrossing]],
    noise: float,
) -> HiddenJumps:
    """Search the steps with the largest unexplained energy changes for energy jumps.

    Args:
        rest: unexplained energy change of each step, eV; nan where unknown.
        crossed: flips by step; a jump at the crossing of an energy-jump threshold is not counted again.
        noise: noise level of the energy, eV.
    """
    limit = max(noise, _SMALL * probe.kT)
    large = np.abs(np.nan_to_num(rest)) > limit
    candidates = np.flatnonzero(large)[np.argsort(-np.abs(rest[large]), kind="stable")].tolist()
    began = probe.meter.calls
    jumps: list[HiddenJump] = []
    searched: dict[int, float] = {}
    for step in candidates[:_MOST_STEPS]:
        if searched and probe.meter.calls - began > _CALLS:
            break
        searched[step] = float(rest[step])
        jumps += _within(probe, run, step, crossed.get(step, ()), limit)
    return HiddenJumps(tuple(jumps), searched, tuple(candidates))


def _within(
    probe: CalculatorSubject, run: NveRun, step: int, crossed: Sequence[RunCrossing], limit: float
) -> list[HiddenJump]:
    """Find the jumps of the energy within one time step."""
    curve, parts = along_step(probe, run, step), [(0.0, 1.0)]
    first = _unexplained(curve, 0.0, 1.0)
    for level in range(_LEVELS):
        middles = [(low, 0.5 * (low + high), high) for low, high in parts]
        halves = [half for low, middle, high in middles for half in ((low, middle), (middle, high))]
        sizes = [abs(_unexplained(curve, *half)) for half in halves]
        floor = max(limit, _FOLLOWED * max(max(sizes), abs(first) if level >= _SPREAD_AT else 0.0))
        parts = [half for half, size in zip(halves, sizes, strict=True) if size > floor]
        if not parts:
            return []
    found = []
    for low, high in parts:
        middle = 0.5 * (low + high)
        near = [one.threshold for one in crossed if abs(one.share - middle) < 1e-3]
        if not any(one.order == 0 for one in near):
            ties = exchanged(*(run.at(run.way(step, share)) for share in (low, high)))
            radius = near[0].radius if near else None
            found.append(HiddenJump(step, middle, _unexplained(curve, low, high), ties, radius))
    return found


@dataclass(frozen=True)
class EnergyBalance:
    """Energy balance of a run at every time step."""

    crossed: Sequence[RunCrossing]  # flips at thresholds
    jumps: Steps  # energy that the flips of each step brought, measured or by the mean of those measured, eV
    # crossings whose jump was measured, by place in `crossed`, and their jumps, eV
    measured: Mapping[int, float]
    rest: Steps  # what neither flips nor the work of the forces explains; nan at steps that were left out, eV
    hidden: HiddenJumps = field(default_factory=HiddenJumps)  # jumps in it

    @property
    def elsewhere(self) -> Steps:
        """Energy change (eV) of each step due to jumps away from distance thresholds."""
        return self.hidden.energies(self.rest)

    @property
    def filled(self) -> Steps:
        """Unexplained energy change (eV) of each step without jumps. Unmeasured steps get the mean change."""
        left = self.rest - self.elsewhere
        return np.where(np.isnan(left), np.nanmean(left), left)

    @property
    def means(self) -> dict[PairThreshold, float]:
        """Mean energy jump (eV) at each threshold, for a pair that comes closer."""
        found: dict[PairThreshold, list[float]] = {}
        for place, jump in self.measured.items():
            found.setdefault(self.crossed[place].threshold, []).append(self.crossed[place].sign * jump)
        return {threshold: float(np.mean(jumps)) for threshold, jumps in found.items()}

    def by_means(self, crossed: Sequence[RunCrossing], steps: int) -> Steps:
        """Estimate the energy changes (eV) at flips of another run, from this run's mean jumps."""
        jumps, means = np.zeros(steps), self.means
        for one in crossed:
            jumps[one.step] += one.sign * means.get(one.threshold, 0.0)
        return jumps


def balance(
    probe: CalculatorSubject,
    run: NveRun,
    limits: Sequence[PairThreshold],
    rng: np.random.Generator,
    noise: float = 0.0,
) -> EnergyBalance:
    """Compute the energy balance of a run at every time step.

    Args:
        probe: a calculator object separate from that of the run.
        rng: random generator that selects the steps at which flips are measured, if there are too many flips.
        noise: noise level of the energy, eV.
    """
    crossed = crossings(run, limits)
    by_step: dict[int, list[int]] = {}
    for place, one in enumerate(crossed):
        by_step.setdefault(one.step, []).append(place)
    # a step without a crossing that needs care costs one call; of the others a sample must do
    orders = np.array([one.threshold.order for one in crossed], np.int64)
    sharp = int((orders < 2).sum())
    stepped = len({one.step for one, order in zip(crossed, orders, strict=True) if order < 2})
    # a sample of steps is as good as all, unless it is a handful because each step has so many
    smooth = 2 if sharp <= _MEASURED or _MEASURED * stepped >= _ENOUGH * sharp else 1
    counts = {step: int((orders[places] < smooth).sum()) for step, places in by_step.items()}
    careful = rng.permutation(sorted(step for step, count in counts.items() if count)).tolist()
    before = np.cumsum([0, *(counts[step] for step in careful)])
    left_out = {step for step, spent in zip(careful, before, strict=False) if spent >= _MEASURED}
    count = len(run.potential)
    rest = np.full(count, np.nan)
    rest[0] = 0.0
    measured: dict[int, float] = {}
    for step in range(1, count):
        places = by_step.get(step, [])
        if step not in left_out:
            here = [crossed[place] for place in places]
            jumped, rest[step] = account(probe, run, step, here, smooth)
            measured |= dict(zip(places, jumped, strict=True))
    means = EnergyBalance(crossed, rest, measured, rest).means
    jumps = np.zeros(count)
    for place, one in enumerate(crossed):
        jumps[one.step] += measured.get(place, one.sign * means.get(one.threshold, 0.0))
    flips = {step: [crossed[place] for place in places] for step, places in by_step.items()}
    hidden = hidden_jumps(probe, run, rest, flips, noise)
    return EnergyBalance(crossed, jumps, measured, rest, hidden)


# -- drift: a slope with an error that blocks give -------------------------------------------------


@dataclass(frozen=True)
class Drift:
    """Rate at which a quantity changes with time, and its standard error."""

    slope: float  # per unit of time
    error: float  # standard error of it, from blocks

    @property
    def significant(self) -> bool:
        """True if the drift differs from zero by more than four standard errors."""
        return abs(self.slope) > 4 * self.error

    def times(self, factor: float) -> Drift:
        """Return the drift multiplied by a unit conversion factor."""
        return Drift(self.slope * factor, abs(factor) * self.error)

    def minus(self, other: Drift) -> Drift:
        """Return the difference between two statistically independent drifts."""
        return Drift(self.slope - other.slope, float(np.hypot(self.error, other.error)))


def drift(time: Steps, values: Steps) -> Drift:
    """Return the slope of a line fitted to block averages, with its standard error.

    Values at neighboring time steps are correlated. Blocks are longer than the correlation time, to make
    their averages independent. The fit needs at least 16 values.
    """
    blocks = np.array_split(np.arange(len(values)), _BLOCKS)
    x, y = ([float(row[block].mean()) for block in blocks] for row in (time, values))
    (slope, _), covariance = np.polyfit(x, y, 1, cov=True)
    return Drift(float(slope), float(np.sqrt(covariance[0, 0])))


def wandering(time: Steps, increments: Steps) -> Drift:
    """Return the drift of a quantity with uncorrelated increments, such as energy jumps.

    The deviation of a random walk from a fitted line is itself a random walk. The standard error is therefore
    computed from sums over blocks.

    Args:
        increments: at least 16, each of the interval that ends at its time.
    """
    sums = [float(np.sum(block)) for block in np.array_split(increments, _BLOCKS)]
    whole = float(time[-1] - time[0])
    error = float(np.std(sums, ddof=1) * np.sqrt(_BLOCKS)) / whole
    return Drift(drift(time, np.cumsum(increments)).slope, error)


def ratio(time: Steps, total: Steps, kinetic: Steps) -> float:
    """Return the total energy drift divided by the standard deviation of the kinetic energy.

    Source: the energy conservation score of mlipaudit. lambench reports the drift in meV/atom/ps.
    """
    slope = float(np.polyfit(time - time[0], total - total[0], 1)[0])
    scatter = float(np.std(kinetic))
    change = slope * float(time[-1] - time[0])
    return change / scatter if scatter else (float("inf") if change else 0.0)
