"""Finite differences that estimate their own error: Richardson tables with an estimate of noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import factorial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.problem import Gradient, Method, Problem, Progress, scalars_only
from mdnum.numerics import PrecisionPolicy
from mdnum.numerics.roles import LATTICE
from mdnum.systems.build import Simulation

#: The widest step that is tried, and the spacing of the values that the noise is estimated from in rounding
#: errors of the parameter, as shares of it.
_WIDEST, _SPACING = 1e-4, 64.0
#: Relative rounding of a fixed-point integer state: an impulse is rounded to a share of its unit.
_LATTICE = 2.0**-30
#: About the number of runs it takes to choose a step: for the noise, and for one or two steps.
_CHOOSING = 15
#: Estimates of the noise by neighboring orders that are within this factor are believed.
_AGREE = 4.0
#: What a step is shrunk to at most at a time: a first truncation may be anything.
_MOST_SHRINK = 1e-3
#: How often the spacing is widened where all values are the same; values of which a noise is estimated.
_WIDENINGS, _POINTS = 4, 7


@dataclass(frozen=True)
class Differentiated:
    """A derivative from values.

    Attributes:
        value: the derivative.
        error: what truncation and noise leave uncertain: the disagreement of the last two extrapolations.
        step: the largest step of the extrapolation that was chosen.
        table: central differences by step, largest step first.
    """

    value: float
    error: float
    step: float
    table: tuple[tuple[float, float], ...]


def richardson(f: Callable[[float], float], x: float, step: float, levels: int = 6) -> Differentiated:
    """The derivative of f at x by Richardson's extrapolation of central differences (Ridders 1982).

    Steps shrink by 1.4 and the extrapolation with the least estimated error wins, so that neither a step
    that is too wide nor the noise of one that is too narrow does.

    Args:
        f: of one number. x: where.
        step: the largest step. levels: number of steps.
    """
    shrink = 1.4
    table = np.full((levels, levels), np.nan)
    rows: list[tuple[float, float]] = []
    best, error, chosen = np.nan, np.inf, step
    h = step
    for k in range(levels):
        table[k, 0] = (f(x + h) - f(x - h)) / (2 * h)
        rows.append((h, float(table[k, 0])))
        factor = shrink**2
        for m in range(1, k + 1):
            table[k, m] = (table[k, m - 1] * factor - table[k - 1, m - 1]) / (factor - 1)
            factor *= shrink**2
            here = max(abs(table[k, m] - table[k, m - 1]), abs(table[k, m] - table[k - 1, m - 1]))
            if here < error:
                best, error, chosen = float(table[k, m]), float(here), h * shrink**m
        if k and abs(table[k, k] - table[k - 1, k - 1]) >= 2 * error:
            break
        h /= shrink
    return Differentiated(best, error, chosen, tuple(rows))


def noise_of(values: Float[np.ndarray, "points"]) -> float:
    """The standard deviation of the noise in values at equal, tiny spacings; 0 where all are the same.

    Differences of an order k take away what is smooth and keep the noise, enlarged by a known factor.

    Args:
        values: of a function at x, x + h, x + 2h, ...; at least 4, h so small that the function is nearly
            straight over all of them.

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


class DifferenceStep(NamedTuple):
    """A step for central differences.

    Attributes:
        size: the step.
        noise: standard deviation of the function's noise.
        truncation: estimated error of the central difference from the function's third derivative.
    """

    size: float
    noise: float
    truncation: float


def choose_step(
    f: Callable[[float], float], x: float, first: float, spacing: float, tries: int = 4
) -> DifferenceStep:
    """The step at which truncation and noise of a central difference are about alike.

    Args:
        f: of one number. x: where.
        first: the step to begin with, which is never passed: beyond it the function may be another one.
        spacing: between the values of which the noise is estimated: some rounding errors of x.
        tries: how often the step may be changed.

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
    # a value has at least the rounding error of its last operation
    noise = max(noise_of(values), float(np.finfo(np.float64).eps) * abs(f(x)))
    size, truncation = first, 0.0
    for attempt in range(tries):
        one = (f(x + size) - f(x - size)) / (2 * size)
        two = (f(x + 2 * size) - f(x - 2 * size)) / (4 * size)
        truncation, rounding = abs(two - one) / 3, noise / size
        if truncation <= 10 * rounding or rounding == 0 or attempt == tries - 1:
            break
        # truncation goes with the square of the step, noise with one over it
        wanted = (rounding / truncation) ** (1 / 3) if np.isfinite(truncation) else 0.0
        size *= max(wanted, _MOST_SHRINK)
    return DifferenceStep(size, noise, truncation)


def nonzero(problem: Problem, name: str) -> float:
    """The value of a scalar parameter, of which a step is a share.

    Raises:
        InputError: it is 0.
    """
    here = float(parameters.value(problem.simulation, name))
    if here == 0:
        raise InputError(f"{name} is 0, and a step is a share of it", remedy="Shift another parameter")
    return here


@dataclass(frozen=True)
class FiniteDifferences(Method):
    """Values of the loss at shifted parameters, extrapolated; scalars only.

    Errors, steps and the noise are in the details.

    Attributes:
        relative: the largest step as a share of the parameter; None for one that the noise of the loss and
            its third derivative ask for. In a long run the loss is straight over tiny steps only.
        levels: steps of the extrapolation.
    """

    relative: float | None = None
    levels: int = 3

    name = "finite-differences"
    kind = "values"
    description = "differences of the loss between runs with shifted parameters, extrapolated to no shift"

    @property
    def runs(self) -> int:
        """About the number of runs that a parameter takes."""
        return 2 * self.levels + (0 if self.relative is not None else _CHOOSING)

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        return scalars_only(problem, names)

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        gradient: dict[str, np.ndarray] = {}
        details: dict[str, dict[str, Any]] = {"error": {}, "step": {}, "noise": {}, "table": {}}
        done, runs = 0, self.runs * len(names)
        for name in names:
            here = nonzero(problem, name)

            @cache
            def at(q: float, name: str = name) -> float:
                nonlocal done
                done += 1
                if progress is not None:
                    progress(min(done, runs), runs, "differences")
                return problem.value({name: q})

            if self.relative is None:
                # a shift below the relative spacing of the numbers that a parameter is kept in is none
                policy = problem.simulation.policy
                narrow = policy.state == LATTICE
                rounding = _LATTICE if narrow else float(jnp.finfo(policy.dtype("force")).eps)
                chosen = choose_step(at, here, _WIDEST * abs(here), _SPACING * rounding * abs(here))
                found = richardson(at, here, 2 * chosen.size, self.levels)
                details["noise"][name] = chosen.noise
                error = max(found.error, chosen.noise / found.step)
            else:
                found = richardson(at, here, self.relative * abs(here), self.levels)
                error = found.error
            gradient[name] = np.asarray(found.value)
            details["error"][name], details["step"][name] = error, found.step
            details["table"][name] = found.table
        same = "the loss was the same at all shifts"
        notes = {name: same for name, value in gradient.items() if not np.any(value)}
        return self.result(problem.value(), gradient, notes, details)


def in_float64(simulation: Simulation) -> Simulation:
    """The same system with every role of a number in float64."""
    decider = replace(simulation.decider, dtype="float64", state="float64")
    return replace(simulation, policy=PrecisionPolicy(), decider=decider, lattice=None)


@dataclass(frozen=True)
class ShadowDifferences(Method):
    """Differences of the same run in a wider format than its own: what it would give without its rounding.

    Float64 has no wider format that a long run could be made in; its differences state themselves how far
    their noise lets them be trusted.

    Attributes:
        relative: the largest step as a share of the parameter. levels: steps of the extrapolation.
    """

    relative: float = 1e-4
    levels: int = 6

    name = "shadow-differences"
    kind = "values"
    description = "differences of the loss in float64, of a run that is made in a narrower format"

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        if problem.simulation.policy.state == LATTICE:
            return "a fixed-point integer state is another program, not a rounded one"
        if problem.simulation.policy == PrecisionPolicy():
            return "the run is in float64 throughout, and there is no wider format to shadow it in"
        return scalars_only(problem, names)

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        wide = replace(problem, simulation=in_float64(problem.simulation))
        found = FiniteDifferences(self.relative, self.levels)(wide, names, progress)
        details = {**found.details, "value of the run itself": problem.value()}
        return self.result(found.value, found.gradient, {}, details)
