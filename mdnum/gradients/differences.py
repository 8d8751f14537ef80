"""Finite differences that say how far they can be trusted: Richardson tables with an estimate of noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.base import Gradient, Problem, Progress, check


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
        relative: the largest step as a share of the parameter.
        levels: steps of the extrapolation.
    """

    relative: float = 1e-4
    levels: int = 6

    @property
    def name(self) -> str:
        """Its word."""
        return "finite-differences"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return "differences of the loss between runs with shifted parameters, extrapolated to no shift"

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Scalars only."""
        large = [name for name in names if np.ndim(parameters.value(problem.simulation, name))]
        return f"{', '.join(large)}: a value for each shift of each entry would be needed" if large else None

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters; its error estimates are in the details."""
        names = check(self, problem, names)
        gradient, errors, tables = {}, {}, {}
        done, runs = 0, 2 * self.levels * len(names)
        for name in names:
            here = float(parameters.value(problem.simulation, name))
            if here == 0:
                raise InputError(
                    f"{name} is 0, and a step is a share of it", remedy="Shift another parameter"
                )

            def at(q: float, name: str = name) -> float:
                nonlocal done
                done += 1
                if progress is not None:
                    progress(done, runs, "differences")
                return problem.value({name: q})

            found = richardson(at, here, self.relative * abs(here), self.levels)
            gradient[name], errors[name], tables[name] = np.asarray(found.value), found.error, found.table
        details = {"error": errors, "table": tables}
        return Gradient(self.name, self.says, problem.value(), gradient, {}, details)
