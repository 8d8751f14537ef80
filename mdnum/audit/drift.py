"""A slope with an error that blocks give: energy drift of a run in meV/atom/ps and without a dimension."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_BLOCKS = 8


@dataclass(frozen=True)
class Drift:
    """How a quantity changes with time.

    Attributes:
        slope: per unit of time.
        error: standard error of it, from blocks.
    """

    slope: float
    error: float

    @property
    def there(self) -> bool:
        """Whether it is told from zero: more than four standard errors away."""
        return abs(self.slope) > 4 * self.error

    def times(self, factor: float) -> Drift:
        """In another unit."""
        return Drift(self.slope * factor, abs(factor) * self.error)

    def minus(self, other: Drift) -> Drift:
        """The difference of two that scatter independently."""
        return Drift(self.slope - other.slope, float(np.hypot(self.error, other.error)))


def drift(time: Float[np.ndarray, "steps"], values: Float[np.ndarray, "steps"]) -> Drift:
    """Slope of a straight line through the means of blocks, with its standard error.

    Blocks are longer than what a step remembers, so their means scatter independently where the run is long
    enough; neighboring steps do not.

    Args:
        time: of the values.
        values: at least 16.
    """
    blocks = np.array_split(np.arange(len(values)), _BLOCKS)
    x = np.array([time[block].mean() for block in blocks])
    y = np.array([values[block].mean() for block in blocks])
    x = x - x.mean()
    square = float(np.sum(x**2))
    slope = float(np.sum(x * y)) / square
    left = y - y.mean() - slope * x
    error = float(np.sqrt(np.sum(left**2) / (_BLOCKS - 2) / square))
    return Drift(slope, error)


def wandering(time: Float[np.ndarray, "steps"], increments: Float[np.ndarray, "steps"]) -> Drift:
    """Slope of a quantity that changes by increments, such as jumps, whose sum wanders without a memory.

    What is left of a straight line through a random walk is itself a walk, so the error is taken from the
    sums over blocks instead.

    Args:
        time: after each increment.
        increments: at least 16.
    """
    fitted = drift(time, np.cumsum(increments))
    sums = [float(np.sum(block)) for block in np.array_split(increments, _BLOCKS)]
    whole = float(time[-1] - time[0])
    return Drift(fitted.slope, float(np.std(sums, ddof=1) * np.sqrt(_BLOCKS)) / whole)


def ratio(time: Float[np.ndarray, "steps"], total: Float[np.ndarray, "steps"], kinetic: np.ndarray) -> float:
    """Energy drifted over the run, over the standard deviation of the kinetic energy.

    Source:
        the energy conservation score of the mlipaudit suite; meV/atom/ps is what lambench reports.
    """
    slope = float(np.polyfit(time - time[0], total - total[0], 1)[0])
    scatter = float(np.std(kinetic))
    change = slope * float(time[-1] - time[0])
    return change / scatter if scatter else (float("inf") if change else 0.0)
