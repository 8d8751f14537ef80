"""Differences in a wider format than the run's own: what its derivative would be without its rounding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mdnum.gradients.base import Gradient, Problem, Progress, check
from mdnum.gradients.differences import FiniteDifferences
from mdnum.precision import PrecisionPolicy
from mdnum.precision.policy import LATTICE
from mdnum.systems.build import Simulation


def in_float64(simulation: Simulation) -> Simulation:
    """The same system with every role of a number in float64."""
    decider = replace(simulation.decider, dtype="float64", state="float64")
    return replace(simulation, policy=PrecisionPolicy(), decider=decider)


@dataclass(frozen=True)
class ShadowDifferences:
    """Differences of the same run in a wider format than its own: what it would give without its rounding.

    Float64 has no wider format that a long run could be made in; its differences say themselves how far
    their noise lets them be trusted.

    Attributes:
        relative: the largest step as a share of the parameter.
        levels: steps of the extrapolation.
    """

    relative: float = 1e-4
    levels: int = 6

    @property
    def name(self) -> str:
        """Its word."""
        return "shadow-differences"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return "differences of the loss in float64, of a run that is made in a narrower format"

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Runs with a role below float64."""
        if problem.simulation.policy.state == LATTICE:
            return "a state in whole numbers is another program, not a rounded one"
        if problem.simulation.policy == PrecisionPolicy():
            return "the run is in float64 throughout, and there is no wider format to shadow it in"
        return self._plain.why_not(problem, names)

    @property
    def _plain(self) -> FiniteDifferences:
        return FiniteDifferences(self.relative, self.levels)

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters; its error estimates are in the details."""
        names = check(self, problem, names)
        wide = replace(problem, simulation=in_float64(problem.simulation))
        found = self._plain(wide, names, progress)
        own = problem.value()
        details = {**found.details, "value of the run itself": own}
        return Gradient(self.name, self.says, found.value, found.gradient, {}, details)
