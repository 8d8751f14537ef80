"""Means over random seeds, and differences between settings, each with its statistical error.

The error of a run's mean is estimated from autocorrelation. A second estimate uses the scatter of means over
random seeds. Errors from autocorrelation have many degrees of freedom. The errors are too small if a run is
shorter than the slowest relaxation. Each error is therefore multiplied by one factor. The scatter of means
over all seeds and settings determines this factor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

#: Probability of a falsely reported change in a whole sweep, and of detecting a difference of the size
#: `detectable`.
ALPHA, POWER = 0.05, 0.9
#: Share of ALPHA that tests use, because correlation times are only estimated: in 1,200 sweeps 4.8 % had a
#: false change without this factor, and 4.1 % with it.
_SHARE = 0.8
#: Probability that uncorrelated runs of one seed are taken for correlated.
_CHANCE_OF_SEEDS = 0.002
K = TypeVar("K")
Name = tuple[str, ...]


@dataclass(frozen=True)
class SeedMean:
    """Mean of a measure over random seeds, with its standard error."""

    value: float
    error: float  # standard error; nan from a single run without one of its own, 0 of what does not vary
    freedom: float  # degrees of freedom of the error
    runs: int  # that it is a mean of
    effective: float = float("nan")  # samples that are worth an independent one each, of all runs

    @property
    def known(self) -> bool:
        """True if the mean and its error are known (finite)."""
        return bool(np.isfinite(self.value) and np.isfinite(self.error))


def estimates(found: Mapping[K, Sequence[tuple[float, float, float]]]) -> dict[K, SeedMean]:
    """Return the mean of one measure over random seeds, at each setting.

    The error of each mean is estimated from its runs, and then multiplied by a ratio. The ratio is the
    observed scatter between seeds, divided by the scatter expected from these errors. All settings of a
    measure have the same ratio. More settings make the ratio more precise. The scatter between the seeds of
    one setting is used instead if it has more degrees of freedom.

    Args:
        found: (value, standard error, independent samples) of each run; nan if unknown.
    """
    arrays = {key: np.asarray(rows, float).reshape(-1, 3) for key, rows in found.items()}
    means = {key: _Runs.of(rows) for key, rows in arrays.items()}
    several = [one for one in means.values() if one.runs > 1 and one.within > 0]
    freedom = float(sum(one.runs - 1 for one in several))
    more = sum((one.runs - 1) * one.between / one.within for one in several) / freedom if several else 1.0
    made = {}
    for key, one in means.items():
        value, samples = float(np.mean(arrays[key][:, 0])), float(np.sum(arrays[key][:, 2]))
        alone = one.runs - 1.0
        whole = one.freedom
        if several and whole:
            whole = 1 / (1 / freedom + 1 / whole)
        if one.within == 0 and not one.between > 0:
            made[key] = SeedMean(value, 0.0, max(alone, 1.0), one.runs, samples)
        elif one.within > 0 and (one.runs == 1 or whole > alone):
            made[key] = SeedMean(value, float((more * one.within) ** 0.5), whole, one.runs, samples)
        else:
            made[key] = SeedMean(value, float(one.between**0.5), alone, one.runs, samples)
    return made


class _Runs(NamedTuple):
    """Variance of a mean over runs, from the errors and the scatter of the runs. nan if unknown."""

    runs: int
    within: float
    freedom: float  # of within: as its samples and as the scatter of the runs' own errors have it
    between: float

    @classmethod
    def of(cls, rows: Float[np.ndarray, "runs 3"]) -> _Runs:
        value, error, samples = rows.T
        runs = len(rows)
        between = float(value.var(ddof=1)) / runs if runs > 1 else np.nan
        within = float(np.sum(error**2)) / runs**2
        if within == 0:
            # exact values, such as counts and what nothing random enters
            return cls(runs, 0.0, np.inf, between)
        if not (np.isfinite(within) and (samples > 1).all()):
            return cls(runs, np.nan, 0.0, between)
        freedom = float(np.sum(error**2) ** 2 / np.sum(error**4 / (samples - 1)))
        if runs > 2:
            square = error**2
            freedom = min(freedom, 2 * runs * float(square.mean() ** 2 / max(square.var(ddof=1), 1e-300)))
        return cls(runs, within, freedom, between)


@dataclass(frozen=True)
class Difference:
    """Change of a measure between the base value and another value of a choice."""

    value: float
    error: float  # of the difference
    freedom: float
    chance: float  # of one at least as large where nothing differs; corrected for all comparisons of a sweep
    detectable: float  # smallest that this sweep would have called one, nine times of ten

    @property
    def moves(self) -> bool | None:
        """True if the measure changes significantly. None if the error is unknown."""
        return None if np.isnan(self.chance) else bool(self.chance < ALPHA)

    @property
    def sigmas(self) -> float:
        """Difference divided by its standard error."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(np.float64(self.value) / self.error)


def difference(one: SeedMean, base: SeedMean) -> tuple[float, float, float]:
    """Return the difference of two means, its error, and Welch's degrees of freedom (nan if unknown)."""
    variances = np.array([one.error**2, base.error**2])
    value, error = one.value - base.value, float(np.sqrt(variances.sum()))
    if not (one.known and base.known):
        return value, error, np.nan
    parts = variances**2 / np.maximum([one.freedom, base.freedom], 1e-12)
    return value, error, float(variances.sum() ** 2 / parts.sum()) if error > 0 else np.inf


def paired(
    raw: Mapping[K, tuple[float, float, float]], by_seed: Mapping[K, Float[np.ndarray, "seeds"]]
) -> dict[K, tuple[float, float, float]]:
    """Return differences from a reference setting. Correlated runs with the same seed are compared in pairs.

    Runs at constant energy with the same initial velocities may remain correlated. Few differences of
    uncorrelated runs give a poor estimate of the error. Runs are therefore compared in pairs only if this
    clearly reduces the scatter of all differences.

    Args:
        raw: results of `difference` for each comparison of one measure. by_seed: the differences of each
            seed.
    """
    from scipy.special import chdtr

    if not raw or any(len(by_seed[key]) < 3 for key in raw):
        return dict(raw)
    freedom = min(len(by_seed[key]) for key in raw) - 1
    each = {key: float(one.var(ddof=1)) / len(one) for key, one in by_seed.items()}
    with np.errstate(divide="ignore", invalid="ignore"):
        share = float(np.mean([each[key] / np.square(raw[key][1]) for key in raw]))
    widest = np.sqrt(share) * _quantile(_CHANCE_OF_SEEDS, freedom)
    if not (chdtr(freedom, freedom * share) < _CHANCE_OF_SEEDS and widest < _quantile(_CHANCE_OF_SEEDS, 1e9)):
        return dict(raw)
    rounding = 1e-12 * max(float(np.abs(one).max()) for one in by_seed.values())
    return {
        key: (float(by_seed[key].mean()), max(each[key] ** 0.5, rounding), float(len(by_seed[key]) - 1))
        for key in raw
    }


def _quantile(chance: float, freedom: float) -> float:
    """Return the value that Student's t exceeds with probability `chance`."""
    from scipy.special import stdtrit

    # scipy.stats has the same, and takes a hundred times as long
    return float(-stdtrit(freedom, chance))


def corrected(raw: Mapping[Name, tuple[float, float, float]]) -> dict[Name, Difference]:
    """Add p-values, corrected for multiple comparisons (Holm 1979), to differences with known errors.

    A difference with unknown degrees of freedom (nan) gets no p-value and is not counted.
    """
    from scipy.special import stdtr

    alone = {
        name: 2 * float(stdtr(free, -abs(value) / error)) if error > 0 else float(value == 0)
        for name, (value, error, free) in raw.items()
        if np.isfinite(error) and not np.isnan(free)
    }
    chances, least, count = dict.fromkeys(raw, np.nan), 0.0, len(alone)
    for k, name in enumerate(sorted(alone, key=lambda name: alone[name])):
        least = chances[name] = max(least, min(1.0, (count - k) * alone[name] / _SHARE))
    found = {}
    for name, (value, error, free) in raw.items():
        seen = np.nan
        if name in alone:
            # the hardest of Holm's levels: what is beyond it is seen whatever the others are
            reach = _quantile(_SHARE * ALPHA / 2 / count, free) + _quantile(1 - POWER, free)
            seen = error * reach if error > 0 else 0.0
        found[name] = Difference(value, error, free, chances[name], seen)
    return found


def effects(places: Float[np.ndarray, "points axes"], values: Float[np.ndarray, "points"]) -> list[Any]:
    """Return the change of a measure over the range of each varied choice, by a linear fit.

    Args:
        places: position of each point along each axis, from 0 to 1.

    Returns:
        (value, error, degrees of freedom) for each axis, as for `corrected`; the error includes deviations
        from the plane.
    """
    rows, count = places.shape
    freedom = rows - count - 1
    if freedom < 1:
        return [(np.nan, np.nan, np.nan)] * count
    plane = np.column_stack([np.ones(rows), places])
    found, _, rank, _ = np.linalg.lstsq(plane, values, rcond=None)
    if rank < count + 1:
        return [(np.nan, np.nan, np.nan)] * count
    scatter = float(np.sum((values - plane @ found) ** 2)) / freedom
    errors = np.sqrt(scatter * np.diag(np.linalg.inv(plane.T @ plane)))
    return [(float(a), float(b), float(freedom)) for a, b in zip(found[1:], errors[1:], strict=True)]


@dataclass(frozen=True)
class Within:
    """Result of the comparison of a difference with a tolerance."""

    inside: bool | None  # None: not decided
    # times as many seeds that would decide it, if the difference stays what it is; 1 where it is decided
    more: float


def within(value: float, error: float, freedom: float, tolerance: float, comparisons: int = 1) -> Within:
    """Test whether |difference| ≤ tolerance with the difference's confidence interval (Schuirmann 1987).

    Args:
        comparisons: number of comparisons among which the error probability, ALPHA, is divided.
    """
    if not np.isfinite(value) or not np.isfinite(error) or np.isnan(freedom):
        return Within(None, np.inf)
    reach = error * _quantile(ALPHA / max(comparisons, 1), freedom) if error > 0 else 0.0
    away = tolerance - abs(value)
    if abs(away) >= reach:
        return Within(away >= 0, 1.0)
    return Within(None, (reach / abs(away)) ** 2 if away else np.inf)
