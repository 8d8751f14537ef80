"""Where the energy of a run went: its flips, the work of its forces, its integrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import Subject
from mdnum.audit.crossings import Crossing, account, crossings
from mdnum.audit.drift import Drift, drift, wandering
from mdnum.audit.hidden import Hidden, hidden_jumps
from mdnum.audit.noise import Noise
from mdnum.audit.nve import Run
from mdnum.audit.threshold import Threshold

#: Flips whose jumps are measured; the others are told by the mean of these.
_MEASURED = 240
#: Steps with flips that a sample must have.
_ENOUGH = 30


@dataclass(frozen=True)
class Ledger:
    """Where the energy of a run went, step by step.

    Attributes:
        crossed: flips at thresholds.
        jumps: energy that the flips of each step brought, measured or by the mean of those measured, eV.
        measured: crossings whose jump was measured, by place in `crossed`, and their jumps, eV.
        rest: what neither flips nor the work of the forces explains; nan at steps not looked at, eV.
        hidden: jumps in it.
    """

    crossed: Sequence[Crossing]
    jumps: Float[np.ndarray, "steps"]
    measured: Mapping[int, float]
    rest: Float[np.ndarray, "steps"]
    hidden: Hidden = field(default_factory=Hidden)

    @property
    def elsewhere(self) -> Float[np.ndarray, "steps"]:
        """Energy that jumps brought where no pair threshold is, by step, eV."""
        return self.hidden.energies(self.rest)

    @property
    def filled(self) -> Float[np.ndarray, "steps"]:
        """The rest without such jumps, with its mean at steps that were not looked at, eV."""
        left = self.rest - self.elsewhere
        return np.where(np.isnan(left), np.nanmean(left), left)


def balance(
    probe: Subject,
    whole: Run,
    like: Atoms,
    limits: Sequence[Threshold],
    rng: np.random.Generator,
    noise: float = 0.0,
) -> Ledger:
    """Account for the energy of a run.

    Args:
        probe: another object than the run's.
        whole: the run.
        like: species and cell.
        limits: where flips happen.
        rng: picks the steps whose flips are measured where there are too many.
        noise: of the energy, eV.
    """
    crossed = crossings(whole, like, limits)
    by_step: dict[int, list[int]] = {}
    for place, one in enumerate(crossed):
        by_step.setdefault(one.step, []).append(place)
    # a step without a crossing that needs care costs one call; of the others a sample must do
    orders = np.array([limits[one.threshold].order for one in crossed], np.int64)
    sharp = int((orders < 2).sum())
    stepped = len({one.step for one, order in zip(crossed, orders, strict=True) if order < 2})
    # a sample of steps is as good as all, unless it is a handful because each step has so many
    smooth = 2 if sharp <= _MEASURED or _MEASURED * stepped >= _ENOUGH * sharp else 1
    careful = {
        step: count for step, places in by_step.items() if (count := int((orders[places] < smooth).sum()))
    }
    chosen: set[int] = set()
    afforded = 0
    for step in rng.permutation(sorted(careful)):
        if afforded < _MEASURED:
            chosen.add(int(step))
            afforded += careful[int(step)]
    rest = np.full(len(whole.potential), np.nan)
    rest[0] = 0.0
    measured: dict[int, float] = {}
    for step in range(1, len(whole.potential)):
        places = by_step.get(step, [])
        if step in careful and step not in chosen:
            continue
        found = account(probe, whole, like, step, [crossed[place] for place in places], limits, smooth)
        rest[step] = found.rest
        measured |= dict(zip(places, found.jumps, strict=True))
    jumps = np.zeros(len(whole.potential))
    means = mean_jumps(crossed, measured)
    for place, one in enumerate(crossed):
        jumps[one.step] += measured.get(place, _sign(one) * means.get(one.threshold, 0.0))
    known: dict[int, list[float]] = {}
    for one, order in zip(crossed, orders, strict=True):
        if order == 0:
            known.setdefault(one.step, []).append(one.share)
    hidden = hidden_jumps(probe, whole, like, rest, known, noise)
    return Ledger(crossed, jumps, measured, rest, hidden)


def mean_jumps(crossed: Sequence[Crossing], measured: Mapping[int, float]) -> dict[int, float]:
    """Jump of a pair that enters, by threshold, eV."""
    found: dict[int, list[float]] = {}
    for place, jump in measured.items():
        found.setdefault(crossed[place].threshold, []).append(_sign(crossed[place]) * jump)
    return {threshold: float(np.mean(jumps)) for threshold, jumps in found.items()}


def _sign(one: Crossing) -> float:
    return 1.0 if one.entered else -1.0


def by_means(finer: Sequence[Crossing], ledger: Ledger, steps: int) -> Float[np.ndarray, "steps"]:
    """Energy that the flips of another run brought, by the mean jumps of this one, eV."""
    means = mean_jumps(ledger.crossed, ledger.measured)
    jumps = np.zeros(steps)
    for one in finer:
        jumps[one.step] += _sign(one) * means.get(one.threshold, 0.0)
    return jumps


@dataclass(frozen=True)
class Result:
    """Two runs and where their energy went.

    Attributes:
        subject: the calculator.
        whole, half: the run, and the one with half its time step.
        ledger: of the run.
        half_jumps: energy that the flips of the other brought by step, eV.
        limits: thresholds.
        stale: largest difference of the run's energies from those of new objects, and what noise allows, eV.
        noise: of the calculator.
    """

    subject: Subject
    whole: Run
    half: Run
    ledger: Ledger
    half_jumps: Float[np.ndarray, "steps"]
    limits: Sequence[Threshold]
    stale: tuple[float, float]
    noise: Noise

    def shares(self) -> dict[str, Drift]:
        """Drift of all, of flips, of the rest, and of the integrator by either way, eV per internal time."""
        one, other = self.whole, self.half
        rest, elsewhere = self.ledger.filled, self.ledger.elsewhere
        flips = wandering(one.time, self.ledger.jumps)
        left = wandering(one.time, rest)
        half_flips = wandering(other.time, self.half_jumps)
        total = _with(drift(one.time, one.total), flips)
        half = _with(drift(other.time, other.total), half_flips)
        # what a run keeps when flips and the rest are taken out of it is the integrator's
        kept = one.total - np.cumsum(self.ledger.jumps + elsewhere) - np.cumsum(rest)
        halved = other.total - np.cumsum(self.half_jumps)
        unflipped = drift(one.time, one.total - np.cumsum(self.ledger.jumps))
        hidden = {"elsewhere": wandering(one.time, elsewhere)} if self.ledger.hidden.jumps else {}
        return {
            "total": total,
            "total, half the time step": half,
            "flips": flips,
            **hidden,
            "rest": left,
            "integrator": drift(one.time, kept),
            # second order: three quarters of it go with half the time step
            "integrator, by halving": unflipped.minus(drift(other.time, halved)).times(4 / 3),
        }


def _with(fitted: Drift, flips: Drift) -> Drift:
    """A drift whose error knows that the sum of jumps wanders."""
    return Drift(fitted.slope, float(np.hypot(fitted.error, flips.error)))


def energy_rows(result: Result) -> dict[str, Any]:
    """Rows of energies.parquet."""
    parts: list[dict[str, Any]] = []
    for word, run_, jumps, rest in (
        (
            "run",
            result.whole,
            result.ledger.jumps + result.ledger.elsewhere,
            result.ledger.rest - result.ledger.elsewhere,
        ),
        ("half", result.half, result.half_jumps, np.full(len(result.half.potential), np.nan)),
    ):
        count = len(run_.potential)
        entered, left = np.zeros((2, count), np.int64)
        if word == "run":
            for one in result.ledger.crossed:
                (entered if one.entered else left)[one.step] += 1
        parts.append(
            {
                "run": np.full(count, word), "step": np.arange(count), "time": run_.time,
                "potential": run_.potential, "kinetic": run_.kinetic, "total": run_.total,
                "entered": entered, "left": left, "jumps": jumps, "rest": rest,
            }
        )  # fmt: skip
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def crossing_rows(result: Result) -> dict[str, Any]:
    """Rows of crossings.parquet."""
    crossed, count = result.ledger.crossed, len(result.ledger.crossed)
    return {
        "run": np.full(count, "run"),
        "step": np.array([one.step for one in crossed], np.int64),
        "i": np.array([one.i for one in crossed], np.int64),
        "j": np.array([one.j for one in crossed], np.int64),
        "rank": np.array([one.rank for one in crossed], np.int64),
        "entered": np.array([one.entered for one in crossed], bool),
        "threshold": np.array([result.limits[one.threshold].radius for one in crossed], np.float64),
        "distance": np.array([one.distance for one in crossed], np.float64),
        "margin": np.array([one.margin for one in crossed], np.float64),
        "energy_jump": np.array([result.ledger.measured.get(n, np.nan) for n in range(count)], np.float64),
    }
