"""Forward mode: tangents along the recorded run, for a few numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mdnum.gradients.base import Gradient, Problem, Progress, check, independent
from mdnum.gradients.directions import columns_of, gathered
from mdnum.gradients.symmetric import GUARD, in_phase, pairs_only, radial_speed
from mdnum.gradients.tangents import by_column, tangents
from mdnum.gradients.tape import Tape

#: Tangents that are carried at once; each costs a force evaluation a step, a reverse pass about three.
MOST = 64


@dataclass(frozen=True)
class Forward:
    """The derivative of the steps that ran, by tangents that are carried along with them.

    Attributes:
        saltation: whether every flip adds what moving its time does, as the method event-aware has it.
        guard: as for `EventAware`.
        budget: as for `Symmetric`.
        most: numbers that it differentiates by, at most.
    """

    saltation: bool = False
    guard: float = GUARD
    budget: int = 2**29
    most: int = MOST

    @property
    def name(self) -> str:
        """Its word."""
        return "forward"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        if self.saltation:
            return "the derivative of the steps plus what moving the time of every flip does, by tangents"
        return "the derivative of the steps that ran, their decisions held fixed, by tangents"

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Few numbers only, and pair potentials where flips count."""
        simulation = problem.simulation
        if simulation.lattice is not None:
            return "a state in whole numbers has no tangent; the method reversible serves it"
        if self.saltation or simulation.pairwise:
            why = pairs_only(simulation)
            if why is not None:
                return why
        many = len(columns_of(problem.simulation, names))
        if many > self.most:
            return f"{many} numbers would need a tangent each, and at most {self.most} are carried"
        return None

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters."""
        names = check(self, problem, names)
        simulation = problem.simulation

        tape = Tape(
            simulation,
            problem.loss,
            problem.steps,
            flips=self.saltation,
            budget=self.budget,
            progress=in_phase(progress, "run"),
        )
        guard = self.guard * radial_speed(simulation)
        total: Any = None
        crossed = grazing = 0
        for part in tangents(
            tape, names, saltation=self.saltation, guard=guard, progress=in_phase(progress, "tangents")
        ):
            total = part.total
            if part.crossings is not None:
                crossed += len(part.crossings)
                grazing += int(part.crossings.grazing.sum())
        gradient = gathered(simulation, names, by_column(tape, total))
        notes = independent(problem, gradient, saltation=self.saltation)
        details: dict[str, Any] = {"tangents": int(np.sum([np.size(value) for value in gradient.values()]))}
        if self.saltation:
            details |= {"guard": guard, "crossings": crossed, "grazing": grazing}
        return Gradient(self.name, self.says, tape.value, gradient, notes, details)
