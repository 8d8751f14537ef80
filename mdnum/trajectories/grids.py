"""Which decimals numbers were written with: a fixed number after the point, or so many digits in all."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# decimal steps tried, in Å or in fractions of the box: from 1 down
_STEPS = tuple(one * 10.0**-k for k in range(13) for one in (1.0, 0.5, 0.2))
# significant digits tried; LAMMPS writes 6 unless told otherwise
_DIGITS = range(4, 13)
# what chance would do with no more than this probability is taken for meant
_CHANCE = np.log(1e-6)


def decimal_grid(
    values: Float[np.ndarray, "values"], slack: Float[np.ndarray, "values"]
) -> tuple[float, int]:
    """The decimals that all values keep to.

    Args:
        values: as read.
        slack: how far each may be off through the arithmetic behind it.

    Returns:
        the coarsest decimal step that all are multiples of, and 0; or the step of the largest and the number
        of significant digits that all have; or 0.0 and 0 where they are no decimals.
    """
    values, index = np.unique(values, return_index=True)
    slack = slack[index]
    some = values != 0
    values, slack = values[some], slack[some]
    if not len(values):
        return 0.0, 0
    fixed = _fixed(values, slack)
    floor = np.maximum(2 * slack, fixed)
    for digits in _DIGITS:
        steps = steps_of(values, 0.0, digits)
        # where they are finer than what is known already they say nothing
        coarse = steps > floor
        if not coarse.any():
            continue
        if _chance(floor[coarse] / steps[coarse]) > _CHANCE:
            break
        if _multiples(values[coarse], steps[coarse], slack[coarse]):
            return float(steps.max()), digits
    return fixed, 0


def steps_of(values: Float[np.ndarray, "*shape"], step: float, digits: int) -> Float[np.ndarray, "*shape"]:
    """What the last digit of each value is worth: the step, or by the value's size where digits count."""
    if digits == 0:
        return np.full_like(values, step)
    size = np.where(values == 0, 1.0, np.abs(values))
    # just below a power of ten rounds up to it
    exponent = np.floor(np.log10(size * (1 + 1e-12)))
    return np.where(values == 0, 0.0, 10.0 ** (exponent + 1 - digits))


def _fixed(values: Float[np.ndarray, "values"], slack: Float[np.ndarray, "values"]) -> float:
    for step in _STEPS:
        if _chance(np.minimum(2 * slack / step, 1.0)) > _CHANCE:
            # finer steps are told from chance less well still
            return 0.0
        if _multiples(values, np.full_like(values, step), slack):
            return step
    return 0.0


def _chance(parts: Float[np.ndarray, "values"]) -> float:
    """Logarithm of the probability that values at random all fall into these parts of a step."""
    return float(np.log(np.maximum(parts, 1e-300)).sum())


def _multiples(
    values: Float[np.ndarray, "values"],
    steps: Float[np.ndarray, "values"],
    slack: Float[np.ndarray, "values"],
) -> bool:
    ratio = values / steps
    return bool((np.abs(ratio - np.round(ratio)) * steps <= slack).all())
