"""Finite differences that say how far they can be trusted: Richardson tables with an estimate of noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.base import Gradient, Problem, Progress, check
from mdnum.gradients.noise import choose_step
from mdnum.precision.policy import LATTICE

#: The widest step that is tried, and the spacing of the values that the noise is estimated from in rounding
#: errors of the parameter, as shares of it.
_WIDEST, _SPACING = 1e-4, 64.0
#: Relative rounding of a state in whole numbers.
_LATTICE = 2.0**-30
#: About how many runs it takes to choose a step: for the noise, and for one or two steps.
_CHOOSING = 15


@dataclass(frozen=True)
class Difference:
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


def richardson(f: Callable[[float], float], x: float, step: float, levels: int = 6) -> Difference:
    """The derivative of f at x by Richardson's extrapolation of central differences (Ridders 1982).

    Steps shrink by 1.4 and the extrapolation with the least estimated error wins, so that neither a step
    that is too wide nor the noise of one that is too narrow does.

    Args:
        f: of one number.
        x: where.
        step: the largest step.
        levels: how many steps.
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
    return Difference(best, error, chosen, tuple(rows))


@dataclass(frozen=True)
class FiniteDifferences:
    """Values of the loss at shifted parameters, extrapolated; scalars only.

    Attributes:
        relative: the largest step as a share of the parameter; None for one that the noise of the loss and
            its third derivative ask for. In a long run the loss is straight over tiny steps only.
        levels: steps of the extrapolation.
    """

    relative: float | None = None
    levels: int = 3

    @property
    def name(self) -> str:
        """Its word."""
        return "finite-differences"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return "differences of the loss between runs with shifted parameters, extrapolated to no shift"

    @property
    def runs(self) -> int:
        """About how many runs a parameter takes."""
        return 2 * self.levels + (0 if self.relative is not None else _CHOOSING)

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Scalars only."""
        large = [name for name in names if np.ndim(parameters.value(problem.simulation, name))]
        return f"{', '.join(large)}: a value for each shift of each entry would be needed" if large else None

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters; its errors, steps and the noise are in the details."""
        names = check(self, problem, names)
        gradient: dict[str, np.ndarray] = {}
        details: dict[str, dict[str, Any]] = {"error": {}, "step": {}, "noise": {}, "table": {}}
        done, runs = 0, self.runs * len(names)
        for name in names:
            here = float(parameters.value(problem.simulation, name))
            if here == 0:
                raise InputError(
                    f"{name} is 0, and a step is a share of it", remedy="Shift another parameter"
                )

            @cache
            def at(q: float, name: str = name) -> float:
                nonlocal done
                done += 1
                if progress is not None:
                    progress(min(done, runs), runs, "differences")
                return problem.value({name: q})

            if self.relative is None:
                spacing = _SPACING * _rounding(problem) * abs(here)
                chosen = choose_step(at, here, _WIDEST * abs(here), spacing)
                found = richardson(at, here, 2 * chosen.size, self.levels)
                details["noise"][name] = chosen.noise
                error = max(found.error, chosen.noise / found.step)
            else:
                found = richardson(at, here, self.relative * abs(here), self.levels)
                error = found.error
            gradient[name] = np.asarray(found.value)
            details["error"][name], details["step"][name] = error, found.step
            details["table"][name] = found.table
        notes = {
            name: "the loss was the same at all shifts"
            for name, value in gradient.items()
            if not np.any(value)
        }
        return Gradient(self.name, self.says, problem.value(), gradient, notes, details)


def _rounding(problem: Problem) -> float:
    """Relative spacing of the numbers that a parameter is kept in: a shift below it is none."""
    policy = problem.simulation.policy
    # in whole numbers an impulse is rounded to a share of its unit, however exact the parameter
    return _LATTICE if policy.state == LATTICE else float(jnp.finfo(policy.dtype("force")).eps)
