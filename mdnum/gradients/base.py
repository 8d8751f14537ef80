"""What a derivative of a rollout is asked for and answered with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import jax
import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.losses import Frame, Loss
from mdnum.gradients.tape import Tape, surroundings
from mdnum.systems.build import Simulation

#: Called with the steps done, all steps, and a phase in words.
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Problem:
    """A loss of a rollout.

    Attributes:
        simulation: the system as objects, its start included.
        loss: what is made of the trajectory.
        steps: last step.
    """

    simulation: Simulation
    loss: Loss
    steps: int

    def __post_init__(self):
        if self.steps < 1:
            raise InputError(f"steps = {self.steps}; expected at least 1")
        if not self.loss.looks_at(np.arange(self.steps + 1), self.steps).any():
            raise InputError(
                f"the loss {self.loss.name} looks at no step up to {self.steps}",
                remedy="Run longer, or look earlier or more often",
            )
        why = self.loss.why_not(surroundings(self.simulation))
        if why is not None:
            raise InputError(f"the loss {self.loss.name} has no meaning here: {why}")
        self._check_scalar()

    def _check_scalar(self) -> None:
        """Refuse a loss that is no real number, before anything is run."""
        simulation = self.simulation
        atoms, dtype = (3, simulation.atoms), simulation.policy.dtype("state")
        vector, number = jax.ShapeDtypeStruct(atoms, dtype), jax.ShapeDtypeStruct((), np.float64)
        shapes: tuple[Any, ...] = (jax.ShapeDtypeStruct((), np.int64), vector, vector, number, number)
        frame = Frame(*shapes)

        def loss(frame: Frame):
            return self.loss.value(self.loss.observe(frame, frame, surroundings(simulation)), 1)

        found = jax.eval_shape(loss, frame)
        if jax.tree.structure(found) != jax.tree.structure(0.0) or found.shape != ():
            seen = getattr(found, "shape", None) or jax.tree.structure(found)
            raise InputError(f"the loss has shape {seen}; expected a scalar", remedy="Reduce it to a number")
        if not np.issubdtype(found.dtype, np.floating):
            raise InputError(
                f"the loss is of dtype {found.dtype}; expected a real number",
                remedy="A count or a complex number has no gradient: make a float of it that varies smoothly",
            )

    def at(self, values: Mapping[str, Any]) -> Problem:
        """The same loss of a rollout with other parameters."""
        return replace(self, simulation=parameters.with_values(self.simulation, values)) if values else self

    def value(self, values: Mapping[str, Any] | None = None) -> float:
        """The loss, of the run that the rollout makes."""
        made = self.at(values or {})
        return Tape(made.simulation, made.loss, made.steps, budget=0).value


@dataclass(frozen=True)
class Gradient:
    """A derivative of a loss, and which derivative it is.

    Attributes:
        method: name of the method.
        says: which derivative this is, one sentence.
        value: the loss of the program that was differentiated.
        gradient: derivative by full name of the parameter, of the shape of its value.
        notes: what a reader must know about single parameters, by name: no dependence, a missing term.
        details: plain values that belong to the method: counts, errors, tables.
    """

    method: str
    says: str
    value: float
    gradient: dict[str, Float[np.ndarray, "..."]]
    notes: dict[str, str] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)


class Method(Protocol):
    """A way to differentiate a rollout."""

    @property
    def name(self) -> str:
        """Its word."""
        ...

    @property
    def says(self) -> str:
        """Which derivative it gives, one sentence."""
        ...

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Why this derivative does not exist for this problem; None where it does."""
        ...

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters.

        Raises:
            InputError: it does not exist for this problem, or there is no such parameter.
        """
        ...


def check(method: Method, problem: Problem, names: Sequence[str]) -> tuple[str, ...]:
    """Full names of the parameters.

    Raises:
        InputError: no such parameter, or the method does not apply.
    """
    full = parameters.resolve(problem.simulation, names)
    why = method.why_not(problem, full)
    if why is not None:
        raise InputError(f"the method {method.name} does not apply: {why}")
    return full


def independent(problem: Problem, gradient: Mapping[str, Any], *, saltation: bool) -> dict[str, str]:
    """Notes on parameters whose derivative is exactly zero, or misses what the flips add."""
    notes = {}
    jumps = bool(np.any(problem.simulation.jumps()[1] != 0))
    for name, value in gradient.items():
        if not np.any(np.asarray(value)):
            notes[name] = (
                "exactly 0 in this run: no step on the way to the loss depends on it, or what does cancels"
            )
            if name == "cutoff.radius" and jumps and not saltation:
                notes[name] = (
                    "exactly 0 because it only decides which pairs interact, and decisions are not "
                    "differentiated; event-aware adds what they do"
                )
        elif jumps and not saltation:
            notes[name] = "without what the flips add: the force jumps at the cutoff; event-aware adds it"
    return notes
