"""The rule: principal components of an ensemble, and when runs do not belong to it.

As in the ensemble-consistency tests of climate models (Baker et al. 2015; Milroy et al. 2018): features are
standardized by the ensemble and projected on its principal components; a run stands out when two of its
components lie beyond a limit, and three runs fail when two of them stand out. That is, when the median over
the runs of their second largest component is beyond the limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from jaxtyping import Float

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
