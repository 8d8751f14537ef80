"""Calibration: at which step of a system a planted change is seen and rounding is not, and by which rule.

Too early, the ensemble differs by less than rounding may; too late, every run has forgotten its start and a
changed program gives the same scatter. Between the two lies a window, and it belongs to the system: so
planted changes are run, and the step is taken at which all of them are told apart.

The rule is that of the ensemble-consistency tests of climate models (Baker et al. 2015; Milroy et al. 2018):
features are standardized by the ensemble and projected on its principal components; a run stands out when two
of its components lie beyond a limit, and three runs fail when two of them stand out. That is, when the median
over the runs of their second largest component is beyond the limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.forks.benign.ensemble import Change, Ruler, ensemble, parting, planted, starts
from mdnum.rollout.engine import Start, first_state
from mdnum.systems.build import Simulation

#: Components that are looked at, at most.
COMPONENTS = 10
#: Fewer where so much of the variance is explained by fewer.
_EXPLAINED = 0.999
#: Runs of one verdict.
RUNS = 3
#: A component beyond so many standard deviations stands out; more where an ensemble has wider tails.
LIMIT = 2.0
#: Share of the ensemble's own runs that may stand out: two of three do then in 2.8 % of all tries.
ALONE = 0.1
#: False positives that are accepted.
ACCEPTED = 0.04
_FOLDS = 10
# a feature whose spread is rounding has none
_ROUNDING = 1e-14


@dataclass(frozen=True)
class Space:
    """The principal components of an ensemble.

    Attributes:
        mean, spread: of each feature over the ensemble; infinite spread leaves a feature out.
        axes: components as rows, in standardized features.
        sigma: standard deviation of the ensemble along each component.
    """

    mean: Float[np.ndarray, "features"]
    spread: Float[np.ndarray, "features"]
    axes: Float[np.ndarray, "components features"]
    sigma: Float[np.ndarray, "components"]

    @classmethod
    def of(cls, features: Float[np.ndarray, "runs features"]) -> Space:
        """The components that explain an ensemble's variance, at most ten and a third of its runs, at
        least two."""
        mean, spread = features.mean(axis=0), features.std(axis=0, ddof=1)
        # nothing can be said of a feature that is constant, such as a distance that no pair has
        spread = np.where(spread > _ROUNDING * np.abs(mean), spread, np.inf)
        z = (features - mean) / spread
        _, size, axes = np.linalg.svd(z, full_matrices=False)
        explained = np.cumsum(size**2) / np.sum(size**2)
        count = int(min(np.searchsorted(explained, _EXPLAINED) + 1, COMPONENTS, len(features) // 3))
        # the rule looks at the second largest
        count = max(count, 2)
        return cls(mean, spread, axes[:count], size[:count] / np.sqrt(len(features) - 1))

    def standardized(
        self, features: Float[np.ndarray, "*runs features"]
    ) -> Float[np.ndarray, "*runs features"]:
        """Features in standard deviations of the ensemble."""
        return (features - self.mean) / self.spread

    def scores(self, features: Float[np.ndarray, "runs features"]) -> Float[np.ndarray, "runs components"]:
        """Components in standard deviations of the ensemble."""
        return self.standardized(features) @ self.axes.T / self.sigma

    def second(self, features: Float[np.ndarray, "runs features"]) -> Float[np.ndarray, "runs"]:
        """Each run's second largest component: it stands out where that is beyond the limit."""
        return np.sort(np.abs(self.scores(features)), axis=1)[:, -2]


def own_seconds(features: Float[np.ndarray, "runs features"]) -> Float[np.ndarray, "runs"]:
    """The second largest component of each run of an ensemble, in the components of the others.

    In its own ensemble's components a run stands out less than one that did not shape them.
    """
    out = np.empty(len(features))
    for fold in range(min(_FOLDS, len(features))):
        left_out = np.arange(len(features)) % _FOLDS == fold
        out[left_out] = Space.of(features[~left_out]).second(features[left_out])
    return out


def limit_of(features: Float[np.ndarray, "runs features"]) -> float:
    """Standard deviations beyond which a component stands out: two, or more so that at most a tenth of the
    ensemble's own runs do."""
    seconds = np.sort(own_seconds(features))
    allowed = int(ALONE * len(seconds))
    return max(LIMIT, float(seconds[len(seconds) - 1 - allowed]))


def triples(seconds: Float[np.ndarray, "runs"]) -> Float[np.ndarray, "tries"]:
    """The median of each three runs in turn: what the rule compares with its limit."""
    tries = len(seconds) // RUNS
    return np.median(seconds[: RUNS * tries].reshape(tries, RUNS), axis=1)


def two_of_three(rate: float) -> float:
    """How often two of three runs stand out where one does at a given rate."""
    return 3 * rate**2 - 2 * rate**3


def bounds(count: int, of: int, level: float = 0.95) -> tuple[float, float]:
    """The exact (Clopper-Pearson) interval of a rate of which `count` of `of` were seen."""
    tail = (1 - level) / 2
    low = 0.0 if count == 0 else _solve(lambda p: 1 - _at_most(count - 1, of, p), tail)
    high = 1.0 if count == of else _solve(lambda p: -_at_most(count, of, p), -tail)
    return low, high


def _at_most(count: int, of: int, p: float) -> float:
    return sum(comb(of, k) * p**k * (1 - p) ** (of - k) for k in range(count + 1))


def _solve(rising, value: float) -> float:
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if rising(middle) < value else (low, middle)
    return (low + high) / 2


# --- windows --------------------------------------------------------------------------------------------

#: Windows that are tried, as shares of the step at which two members have split.
_SHARES = (0.07, 0.15, 0.25, 0.4, 0.55, 0.7, 0.85)
#: Where members do not split: windows up to this step.
_UNSPLIT = 1000
#: Runs further apart than so many cutoffs have parted.
_PARTED = 0.04
#: A window is good where every planted change is so many limits away, and the latest good one is taken:
#: a change that acts rarely has then had time to act.
_CLEAR = 3.0
#: Fewer members than this have no tail to set a limit by.
FEWEST = 20


@dataclass(frozen=True)
class Planted:
    """What the rule said of a planted change.

    Attributes:
        change: in words.
        must_fail: whether it is another model; else only other rounding.
        failures, tries: verdicts "fail" of all, each from three runs of their own.
        scores: what each verdict compared with 1: the second largest component, in limits.
    """

    change: str
    must_fail: bool
    failures: int
    tries: int
    scores: tuple[float, ...]

    @property
    def ok(self) -> bool:
        """Seen every time, or not more often than chance allows."""
        if self.must_fail:
            return self.failures == self.tries
        return bounds(self.failures, self.tries)[0] <= ACCEPTED


@dataclass(frozen=True)
class Window:
    """One step at which runs could be compared.

    Attributes:
        step: of the comparison.
        space: components of the ensemble.
        limit: standard deviations beyond which a component stands out.
        table: what the rule said of each planted change.
    """

    step: int
    space: Space
    limit: float
    table: tuple[Planted, ...]

    @property
    def power(self) -> float:
        """The least that a change that must fail is beyond the limit, in limits; infinity without any."""
        return min((score for one in self.table if one.must_fail for score in one.scores), default=np.inf)

    @property
    def ok(self) -> bool:
        """Whether every planted change was told apart."""
        return all(one.ok for one in self.table)


@dataclass(frozen=True)
class Calibration:
    """An ensemble that runs can be compared with.

    Attributes:
        simulation: the program of the ensemble.
        start: without its noise; None for the system's own.
        members: runs of the ensemble.
        ruler: what features are measured on.
        window: the one that was chosen.
        windows: all that were tried.
        held_out: runs of the same program that the ensemble does not hold. alone: those that stood out.
        triples: tries of three of them each. false_positives: those that failed.
    """

    simulation: Simulation
    start: Start | None
    members: int
    ruler: Ruler
    window: Window
    windows: tuple[Window, ...]
    held_out: int
    alone: int
    triples: int
    false_positives: int

    @property
    def rate(self) -> float:
        """False positives per verdict, from how often single runs that were held out stand out."""
        return two_of_three(self.alone / self.held_out) if self.held_out else float("nan")

    @property
    def rate_bounds(self) -> tuple[float, float]:
        """Its exact 95 % interval."""
        low, high = bounds(self.alone, self.held_out)
        return two_of_three(low), two_of_three(high)


Progress = Callable[[int, int, dict[str, Any]], None]


def calibrate(
    simulation: Simulation,
    *,
    start: Start | None = None,
    members: int = 60,
    held_out: int = 30,
    tries: int = 3,
    steps: int | None = None,
    windows: Sequence[int] | None = None,
    changes: Sequence[Change] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Calibration:
    """Run an ensemble, and choose the step at which planted changes are told from rounding.

    Args:
        simulation: the program.
        start: where it begins; default the system's own start.
        members: runs of the ensemble.
        held_out: further runs, which the rate of false positives is taken from.
        tries: verdicts on each planted change, three runs each; one on the other list search, which is slow.
        steps: the only step to compare at; default chosen.
        windows: steps to choose from; default up to where two members have split.
        changes: that are planted; default all of `planted(simulation)`.
        seed: of the noise.
        progress: called with runs done, runs in all, and figures.

    Raises:
        InputError: too few runs, a program that blows up, or no step at which planted changes are told
            apart.

    Error: statistical. The limit is a quantile over the members, see `Calibration.rate_bounds`.
    """
    _check(members, held_out, tries, [] if windows is None else windows, steps)
    if steps is not None:
        tried = [steps]
    else:
        tried = sorted(set(_windows(simulation, start, seed) if windows is None else windows))
    changes = planted(simulation) if changes is None else changes
    if not any(change.must_fail for change in changes):
        raise InputError("no planted change must fail", remedy="Plant one that must: else nothing is proven")
    ruler = Ruler.of(simulation, start or first_state(simulation))
    own = members + held_out
    runs = [RUNS * (1 if change.once else tries) for change in changes]
    note = _counter(own + sum(runs), progress)
    features = ensemble(simulation, starts(simulation, own, seed, start), tried, ruler, note)
    if not np.isfinite(features).all():
        raise InputError(
            "a run of the ensemble blew up", where=simulation.system.name, remedy="Use a shorter time step"
        )
    spaces = [Space.of(rows[:members]) for rows in features]
    limits = [limit_of(rows[:members]) for rows in features]
    tables: list[list[Planted]] = [[] for _ in tried]
    for number, change in enumerate(changes):
        begin = starts(change.simulation, runs[number], seed + 1 + number, start)
        rows = ensemble(change.simulation, begin, tried, ruler, note)
        for w, space in enumerate(spaces):
            tables[w].append(_told(change, space, limits[w], rows[w]))
    made = tuple(Window(*one[:3], tuple(one[3])) for one in zip(tried, spaces, limits, tables, strict=True))
    chosen = choose(made, simulation.system.name)
    seconds = chosen.space.second(features[made.index(chosen)][members:]) if held_out else np.empty(0)
    medians = triples(seconds)
    return Calibration(
        simulation,
        start,
        members,
        ruler,
        chosen,
        made,
        held_out,
        int(np.count_nonzero(seconds > chosen.limit)),
        len(medians),
        int(np.count_nonzero(medians > chosen.limit)),
    )


def choose(windows: Sequence[Window], name: str) -> Window:
    """The latest window in which every planted change is clearly told apart, else the one that does it best.

    Raises:
        InputError: there is none.
    """
    good = [window for window in windows if window.ok and window.power > 1]
    clear = [window for window in good if window.power >= _CLEAR]
    if clear:
        return clear[-1]
    if good:
        return max(good, key=lambda window: window.power)
    steps = ", ".join(str(window.step) for window in windows)
    best = max(windows, key=lambda window: sum(one.ok for one in window.table))
    missed = ", ".join(
        f"{one.change} {'passes' if one.must_fail else 'fails'} ({one.failures} of {one.tries} fail)"
        for one in best.table
        if not one.ok
    )
    raise InputError(
        f"planted changes cannot be told from rounding after {steps} steps: after {best.step}, {missed}",
        where=name,
        remedy="Compare at an earlier step, before members have split, or start from a hotter fluid",
    )


def _windows(simulation: Simulation, start: Start | None, seed: int) -> list[int]:
    split = parting(simulation, start, _PARTED * simulation.r_cut, seed) or _UNSPLIT
    return [max(1, round(share * split)) for share in _SHARES]


def _told(change: Change, space: Space, limit: float, rows: Float[np.ndarray, "runs features"]) -> Planted:
    seconds = np.full(len(rows), np.inf)
    # a run that blew up stands out in everything
    whole = np.isfinite(rows).all(axis=1)
    if whole.any():
        seconds[whole] = space.second(rows[whole])
    scores = triples(seconds) / limit
    failures = int(np.count_nonzero(scores > 1))
    return Planted(change.name, change.must_fail, failures, len(scores), tuple(scores.tolist()))


def _check(members: int, held_out: int, tries: int, windows: Sequence[int], steps: int | None) -> None:
    if members < FEWEST:
        raise InputError(f"members = {members} are too few for a limit", remedy=f"Give at least {FEWEST}")
    if held_out < 0:
        raise InputError(f"held_out = {held_out}; expected 0 or more")
    if tries < 1:
        raise InputError(f"tries = {tries}; expected at least 1: a window that is not tried proves nothing")
    shortest = min([*windows, 1 if steps is None else steps])
    if shortest < 1:
        raise InputError(f"steps = {shortest}; expected at least 1")


def _counter(total: int, progress: Progress | None) -> Callable[[], None]:
    done = 0

    def note() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total, {"phase": "ensemble"})

    return note
