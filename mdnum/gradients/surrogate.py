"""The gradient of another program: the same loss with a cutoff that switches off smoothly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import equinox as eqx

from mdnum.gradients.base import Gradient, Method, Problem, Progress, check
from mdnum.gradients.symmetric import Symmetric, pairs_only
from mdnum.systems.build import Simulation
from mdnum.systems.schema import ONSET_FRACTION


def switched_twin(simulation: Simulation, kind: str = "quintic", onset: float = ONSET_FRACTION) -> Simulation:
    """The same system with its potential switched off between a share of each cutoff and the cutoff.

    Args:
        simulation: the system as objects, with a pair potential.
        kind: a cutoff with an onset.
        onset: share of the cutoff.
    """
    made = simulation.with_cutoff(kind)
    return replace(made, model=eqx.tree_at(lambda m: m.r_onset, made.model, made.model.r_cut * onset))


@dataclass(frozen=True)
class Surrogate:
    """The gradient of a switched twin, whose flips add nothing because no force jumps.

    Attributes:
        kind: cutoff of the twin.
        onset: where its switching begins, as a share of the cutoff.
        method: how the twin is differentiated.
    """

    kind: str = "quintic"
    onset: float = ONSET_FRACTION
    method: Method = field(default_factory=Symmetric)

    @property
    def name(self) -> str:
        """Its word."""
        return "surrogate"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return f"the derivative of another program, whose cutoff is {self.kind}"

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """A pair potential whose cutoff does not switch already."""
        why = pairs_only(problem.simulation)
        if why is not None:
            return why
        if problem.simulation.cutoff.switches:
            return f"the cutoff is {problem.simulation.cutoff.name}, which has no force jump to smooth"
        return self.method.why_not(self.twin(problem), names)

    def twin(self, problem: Problem) -> Problem:
        """The problem that is differentiated."""
        return replace(problem, simulation=switched_twin(problem.simulation, self.kind, self.onset))

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters, and the loss of the twin."""
        names = check(self, problem, names)
        found = self.method(self.twin(problem), names, progress)
        details = {"cutoff": self.kind, "onset": self.onset, **found.details}
        notes = dict.fromkeys(names, "of the switched twin, not of the system that was asked about")
        return Gradient(self.name, self.says, found.value, found.gradient, notes | found.notes, details)
