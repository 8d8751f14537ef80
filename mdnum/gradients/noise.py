"""How noisy a computed function is, and the step of a difference that this noise asks for."""

from __future__ import annotations

from collections.abc import Callable
from math import factorial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

#: Orders whose estimates agree within this factor are believed.
_AGREE = 4.0
#: What a step is shrunk to at most at a time: a first truncation may be anything.
_MOST_SHRINK = 1e-3
#: How often the spacing is widened where all values are the same.
_WIDENINGS = 4
#: Values of which a noise is estimated.
_POINTS = 7


def noise_of(values: Float[np.ndarray, "points"]) -> float:
    """The standard deviation of the noise in values at equal, tiny spacings.

    Differences of an order k take away what is smooth and keep the noise, enlarged by a known factor.

    Args:
        values: of a function at x, x + h, x + 2h, ...; at least 4, h so small that the function is nearly
            straight over all of them.

    Returns:
        The noise; 0 where all values are the same.

    Error: within a factor of a few, from so few values.

    Source: J. J. Moré, S. M. Wild, Estimating Computational Noise, SIAM J. Sci. Comput. 33 (2011) 1292.
    """
    levels, signs = [], []
    differences = np.asarray(values, np.float64)
    for k in range(1, len(values) - 1):
        differences = np.diff(differences)
        gamma = factorial(k) ** 2 / factorial(2 * k)
        levels.append(float(np.sqrt(gamma * np.mean(differences**2))))
        signs.append(bool(differences.min() < 0 < differences.max()))
    for k in range(len(levels) - 2):
        near = levels[k : k + 3]
        if signs[k] and max(near) <= _AGREE * min(near):
            return levels[k]
    # no plateau: what is smooth is still in the lower orders
    return levels[-1]


class Step(NamedTuple):
    """A step for central differences.

    Attributes:
        size: the step.
        noise: standard deviation of the function's noise.
        truncation: estimated error of the central difference from the function's third derivative.
    """

    size: float
    noise: float
    truncation: float


def choose_step(f: Callable[[float], float], x: float, first: float, spacing: float, tries: int = 4) -> Step:
    """The step at which truncation and noise of a central difference are about alike.

    Args:
        f: of one number.
        x: where.
        first: the step to begin with.
        spacing: between the values of which the noise is estimated: some rounding errors of x.
        tries: how often the step may be changed.

    Returns:
        The step. It never passes `first`: beyond it the function may be another one.

    Error: the truncation is estimated from differences over one and two steps, so a function that jumps in
    between has one that is too small by chance; extrapolate and compare.
    """
    values = np.full(_POINTS, f(x))
    for _ in range(_WIDENINGS):
        values = np.array([f(x + k * spacing) for k in range(_POINTS)])
        if np.ptp(values) > 0:
            break
        # what a rounding hides has a noise that was not seen, not none
        spacing *= 64
    noise = noise_of(values)
    # a value has at least the rounding error of its last operation
    noise = max(noise, float(np.finfo(np.float64).eps) * abs(f(x)))
    size = first
    for attempt in range(tries):
        one = (f(x + size) - f(x - size)) / (2 * size)
        two = (f(x + 2 * size) - f(x - 2 * size)) / (4 * size)
        truncation, rounding = abs(two - one) / 3, noise / size
        if truncation <= 10 * rounding or rounding == 0 or attempt == tries - 1:
            break
        # truncation goes with the square of the step, noise with one over it
        wanted = (rounding / truncation) ** (1 / 3) if np.isfinite(truncation) else 0.0
        size *= max(wanted, _MOST_SHRINK)
    return Step(size, noise, truncation)
