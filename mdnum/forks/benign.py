"""Test whether two programs whose runs diverge give the same averages.

Runs of program B are compared with an ensemble of program A at a calibrated step. At early steps, rounding
errors can exceed the scatter of the ensemble. At late steps, no run depends on its initial state any more.
The steps suitable for a comparison depend on the system. In the calibration, programs are deliberately
changed. At the chosen step, all changes are distinguishable from rounding.

The test follows tests of climate models (Baker et al. 2015; Milroy et al. 2018). Measured quantities
(features) are standardized and projected onto principal components of the ensemble. A run is an outlier if at
least two of its components exceed the limit. A program fails the test if at least two of its three runs are
outliers. In other words, the median of the second-largest component over its runs exceeds the limit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float
from scipy.special import betaincinv

from mdnum.errors import InputError, expect_at_least
from mdnum.forks.ensemble import Change, ensemble, feature_names, nodes_of, planted, starts, steps_to_diverge
from mdnum.plain import result
from mdnum.program import Progress, Twin
from mdnum.rollout.engine import Start, first_state
from mdnum.systems.simulation import Simulation

#: Largest number of compared components; fewer if they explain this share of the variance.
COMPONENTS, _EXPLAINED = 10, 0.999
#: Number of runs of one verdict.
RUNS = 3
#: Number of standard deviations beyond which a component is an outlier; larger if an ensemble has wider
#: tails.
LIMIT = 2.0
#: Share of the runs of the ensemble that may be outliers; two of three are then outliers in 2.8 % of all
#: tests.
ALONE = 0.1
#: Accepted rate of false positives.
ACCEPTED = 0.04
_FOLDS = 10
# a feature whose spread is rounding has none
_ROUNDING = 1e-14
#: Tested windows, as shares of the step at which two members split; if they do not split, of the given number
#: of steps.
_SHARES, _UNSPLIT = (0.07, 0.15, 0.25, 0.4, 0.55, 0.7, 0.85), 1000
#: Separation at which runs count as split, in cutoffs.
_SPLIT = 0.04
#: Factor by which every deliberate change must exceed its limit in a usable window; the latest usable window
#: is chosen, so that changes with rare effects have time to act.
_CLEAR = 3.0
#: Smallest number of members for which a limit can be estimated.
FEWEST = 20
#: Largest number of features that are named, and smallest weight of a named feature relative to the largest
#: weight.
_NAMED, _TELLING = 5, 0.02
#: Random seed of the noise of runs B, which differs from those of calibrations.
_SEED = 1_000_003


# --- the rule -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Space:
    """Principal components of the features (measured quantities) of an ensemble of runs."""

    # mean, spread: of each feature over the ensemble; infinite spread leaves a feature out
    mean: Float[np.ndarray, "features"]
    spread: Float[np.ndarray, "features"]
    axes: Float[np.ndarray, "components features"]  # components as rows, in standardized features
    sigma: Float[np.ndarray, "components"]  # standard deviation of the ensemble along each component

    @classmethod
    def of(cls, features: Float[np.ndarray, "runs features"]) -> Space:
        """Compute 2 to 10 principal components of the features."""
        mean, spread = features.mean(axis=0), features.std(axis=0, ddof=1)
        # nothing can be said of a feature that is constant, such as a distance that no pair has
        spread = np.where(spread > _ROUNDING * np.abs(mean), spread, np.inf)
        z = (features - mean) / spread
        _, size, axes = np.linalg.svd(z, full_matrices=False)
        explained = np.cumsum(size**2) / np.sum(size**2)
        count = int(min(np.searchsorted(explained, _EXPLAINED) + 1, COMPONENTS, len(features) // 3))
        # the rule is about the second largest
        count = max(count, 2)
        return cls(mean, spread, axes[:count], size[:count] / np.sqrt(len(features) - 1))

    def standardized(
        self, features: Float[np.ndarray, "*runs features"]
    ) -> Float[np.ndarray, "*runs features"]:
        """Return the features in units of the ensemble's standard deviations."""
        return (features - self.mean) / self.spread

    def scores(self, features: Float[np.ndarray, "runs features"]) -> Float[np.ndarray, "runs components"]:
        """Return principal components in units of their standard deviations. NaN for a run that blew up."""
        return self.standardized(features) @ self.axes.T / self.sigma

    def second(self, features: Float[np.ndarray, "runs features"]) -> Float[np.ndarray, "runs"]:
        """Return the second-largest principal component of each run.

        A run that blew up has the result infinity.
        """
        scores = np.abs(self.scores(features))
        return np.sort(np.where(np.isnan(scores), np.inf, scores), axis=1)[:, -2]


def limit_of(features: Float[np.ndarray, "runs features"]) -> float:
    """Return the limit above which a principal component is an outlier.

    The limit is two standard deviations, or more if over a tenth of the ensemble would be outliers. The
    components of a run are computed from other runs, since a run influences its own.
    """
    seconds = np.empty(len(features))
    for fold in range(min(_FOLDS, len(features))):
        left_out = np.arange(len(features)) % _FOLDS == fold
        seconds[left_out] = Space.of(features[~left_out]).second(features[left_out])
    return max(LIMIT, float(np.sort(seconds)[len(seconds) - 1 - int(ALONE * len(seconds))]))


def triples(seconds: Float[np.ndarray, "runs"]) -> Float[np.ndarray, "tries"]:
    """Return the median of the second-largest component for every three successive runs."""
    tries = len(seconds) // RUNS
    return np.median(seconds[: RUNS * tries].reshape(tries, RUNS), axis=1)


def two_of_three(rate: float) -> float:
    """Return the probability that at least two of three runs are outliers."""
    return 3 * rate**2 - 2 * rate**3


def bounds(count: int, of: int) -> tuple[float, float]:
    """Compute the exact (Clopper-Pearson) 95 % confidence interval of the rate `count` / `of`."""
    tail = 0.025
    low = betaincinv(count, of - count + 1, tail) if count else 0.0
    high = betaincinv(count + 1, of - count, 1 - tail) if count < of else 1.0
    return float(low), float(high)


# --- calibration ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Planted:
    """Test result for one program with a deliberate change."""

    change: str  # what it is
    must_fail: bool  # whether it is another model; else only other rounding
    # failures, tries: verdicts "fail" of all, each from three runs of their own
    failures: int
    tries: int
    scores: tuple[float, ...]  # what each verdict compared with 1: the second largest component, in limits

    @property
    def ok(self) -> bool:
        """True if a harmful change always failed, or if a harmless change failed only by chance."""
        if self.must_fail:
            return self.failures == self.tries
        return bounds(self.failures, self.tries)[0] <= ACCEPTED


@dataclass(frozen=True)
class Window:
    """A step at which runs can be compared, with the outlier limit at this step."""

    step: int  # of the comparison
    space: Space  # components of the ensemble
    limit: float  # standard deviations beyond which a component stands out
    table: tuple[Planted, ...]  # what the rule said of each planted change

    @property
    def power(self) -> float:
        """Smallest ratio of score to limit of changes that must be detected. Infinity without changes."""
        return min((score for one in self.table if one.must_fail for score in one.scores), default=np.inf)

    @property
    def ok(self) -> bool:
        """True if the test gave the expected result for every deliberate change."""
        return all(one.ok for one in self.table)


@dataclass(frozen=True)
class Calibration:
    """An ensemble of runs with which other runs can be compared."""

    nodes: Float[np.ndarray, "nodes"]  # of the pair histogram that features are measured on
    window: Window  # the one that was chosen
    held_out: int  # runs of the same program that the ensemble does not hold
    alone: int  # those that stood out
    triples: int  # tries of three of them each
    false_positives: int  # those that failed

    @property
    def rate(self) -> float:
        """Rate of false positives, from runs of the same program outside the ensemble."""
        return two_of_three(self.alone / self.held_out) if self.held_out else float("nan")

    @property
    def rate_bounds(self) -> tuple[float, float]:
        """Exact 95 % confidence interval of the false-positive rate."""
        low, high = bounds(self.alone, self.held_out)
        return two_of_three(low), two_of_three(high)


def calibrate(
    simulation: Simulation,
    *,
    start: Start | None = None,
    members: int = 60,
    held_out: int = 30,
    tries: int = 3,
    steps: int | None = None,
    changes: Sequence[Change] | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Run an ensemble, and find the step at which deliberate changes can be detected.

    Args:
        simulation: the simulation of which an ensemble is run.
        start: start of the ensemble; default the simulation's own start.
        members: number of runs of the ensemble.
        held_out: number of runs outside the ensemble, from which the rate of false positives is estimated.
        tries: tests of each deliberate change, with three runs each; only one for the slower list search.
        steps: step of the comparison; default the most suitable step before two members split.
        changes: deliberate changes; default all of `planted(simulation)`.
        progress: called with the number of runs done, their total, and a dictionary of current values.

    Raises:
        InputError: there are too few runs, the program blows up, or deliberate changes cannot be
            distinguished from rounding at any step.

    Error: statistical; the limit is a quantile over the members, see `Calibration.rate_bounds`.
    """
    if members < FEWEST:
        raise InputError(
            f"members = {members}: statistical limits cannot be estimated from so few runs",
            remedy=f"Set members to at least {FEWEST}",
        )
    expect_at_least(0, held_out=held_out)
    expect_at_least(1, tries=tries, steps=1 if steps is None else steps)
    changes = planted(simulation) if changes is None else changes
    if not any(change.must_fail for change in changes):
        raise InputError(
            "the sensitivity of the test is not checked, because no deliberate change has must_fail = True",
            remedy="Set must_fail = True for a deliberate change that the test must detect",
        )
    tried = [steps] if steps is not None else _windows(simulation, start)
    nodes = nodes_of(simulation, start or first_state(simulation))
    own = members + held_out
    runs = [RUNS * (1 if change.once else tries) for change in changes]
    done, total = 0, own + sum(runs)

    def note() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total, {"phase": "ensemble"})

    features = ensemble(simulation, starts(simulation, own, 0, start), tried, nodes, note)
    if not np.isfinite(features).all():
        raise InputError(
            "a run of the ensemble blew up", where=simulation.name, remedy="Use a shorter time step"
        )
    spaces = [(Space.of(rows[:members]), limit_of(rows[:members])) for rows in features]
    tables: list[list[Planted]] = [[] for _ in tried]
    for number, change in enumerate(changes):
        begin = starts(change.simulation, runs[number], 1 + number, start)
        rows = ensemble(change.simulation, begin, tried, nodes, note)
        for table, (space, limit), seen in zip(tables, spaces, rows, strict=True):
            scores = triples(space.second(seen)) / limit
            failures = int(np.count_nonzero(scores > 1))
            scored = tuple(scores.tolist())
            table.append(Planted(change.name, change.must_fail, failures, len(scores), scored))
    windows = [
        Window(step, *space, tuple(table)) for step, space, table in zip(tried, spaces, tables, strict=True)
    ]
    chosen = choose(windows, simulation.name)
    seconds = chosen.space.second(features[windows.index(chosen)][members:]) if held_out else np.empty(0)
    medians = triples(seconds)
    alone, failed = (int(np.count_nonzero(values > chosen.limit)) for values in (seconds, medians))
    return Calibration(nodes, chosen, held_out, alone, len(medians), failed)


def choose(windows: Sequence[Window], name: str) -> Window:
    """Return the latest step that detects all deliberate changes well, otherwise the most sensitive.

    Raises:
        InputError: at no step are the deliberate changes distinguishable from rounding.
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
        f"after {steps} steps, the effects of the deliberate changes cannot be distinguished from those of "
        f"rounding errors. The two kinds of effects differed most clearly at step {best.step}: {missed}",
        where=name,
        remedy=(
            "Compare at an earlier step, before the runs of the ensemble diverge, or start from a fluid "
            "at a higher temperature"
        ),
    )


def _windows(simulation: Simulation, start: Start | None) -> list[int]:
    split = steps_to_diverge(simulation, start, _SPLIT * simulation.r_cut, seed=0) or _UNSPLIT
    return sorted({max(1, round(share * split)) for share in _SHARES})


# --- the verdict ----------------------------------------------------------------------------------------


@result
class Benign:
    """Result of a test whether program B agrees statistically with program A."""

    passed: bool  # whether they do
    window: int  # step of the comparison
    # components, limit: principal components that were compared, and standard deviations beyond which one
    # stands out
    components: int
    limit: float
    # components of B's runs, in standard deviations of A's ensemble, shape (runs, components); not a number
    # for a run that blew up
    scores: Float[np.ndarray, "runs components"]
    # features that give B away, by name, with the median over B's runs of their distance from A's mean, in
    # standard deviations of A's ensemble; the ones that matter most come first
    failing: dict[str, float]
    calibration: tuple[Planted, ...]  # what the rule said of each planted change
    # false_positive_rate, false_positive_bounds: verdicts "fail" on A itself, expected from runs that were
    # held out, and the exact 95 % interval; not a number where none were
    false_positive_rate: float
    false_positive_bounds: tuple[float, float]
    false_positives: tuple[int, int]  # verdicts "fail" that were counted, and of how many


def benign(
    twin: Twin,
    *,
    steps: int | None = None,
    calibration: Calibration | None = None,
    progress: Progress | None = None,
) -> Benign:
    """Compare three runs of program B with an ensemble of runs of program A.

    B fails if two principal components exceed the outlier limit in two of three runs. A program that passes
    has no larger effect than the smallest perturbation of the initial state.

    Args:
        twin: the programs. Atom labels and axes of B do not matter, because no feature depends on them.
        steps: step of the comparison; default the step found by calibration.
        calibration: an existing calibration of the ensemble of A.
        progress: called with the number of runs done, their total, and a dictionary of current values.

    Raises:
        InputError: the programs cannot be compared, or deliberate changes are detected at no step.
    """
    _check(twin)
    found = calibration or calibrate(twin.a.simulation, start=twin.a.begin, steps=steps, progress=progress)
    window, b = found.window, twin.b.simulation
    begin = starts(b, RUNS, _SEED, twin.b.begin)
    (rows,) = ensemble(b, begin, [window.step], found.nodes)
    passed = bool(np.median(window.space.second(rows)) <= window.limit)
    scores, whole = window.space.scores(rows), np.isfinite(rows).all(axis=1)
    failing = {} if passed or not whole.any() else _failing(found, rows[whole], scores[whole])
    return Benign(
        passed, window.step, len(window.space.sigma), window.limit, scores, failing, window.table, found.rate,
        found.rate_bounds, (found.false_positives, found.triples),
    )  # fmt: skip


def _check(twin: Twin) -> None:
    """Raise an error if two programs cannot be compared."""
    twin.a.check(twin.b)
    keys = [one.simulation.integrator.random for one in (twin.a, twin.b)]
    a, b = (() if key is None else np.asarray(jax.random.key_data(key)) for key in keys)
    if not np.array_equal(a, b):
        raise InputError(
            "the two runs use different random noise, so they diverge at the first step",
            where="dynamics.seed",
            remedy="Give both runs the same seed; compare runs with different seeds by their averages",
        )


def _failing(calibration: Calibration, rows: np.ndarray, scores: np.ndarray) -> dict[str, float]:
    """Return the features that contribute most to components above the limit."""
    space, limit = calibration.window.space, calibration.window.limit
    z = np.median(space.standardized(rows), axis=0)
    middle = np.median(scores, axis=0)
    weight = np.where(np.abs(middle) > limit, middle / space.sigma, 0.0)
    share = (weight @ space.axes) * z
    names = feature_names(calibration.nodes)
    telling = [k for k in np.argsort(-share) if share[k] > _TELLING * share.max()]
    # none is where they are beyond the limit only together, as a sum of energies that is kept can be
    chosen = [k for k in telling if abs(z[k]) > limit] or telling
    return {names[k]: float(z[k]) for k in chosen[:_NAMED]}
