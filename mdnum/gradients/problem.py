"""Gradients of a loss: the problem, the result, and the base class of methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Inexact

from mdnum.errors import InputError, expect_at_least
from mdnum.gradients import parameters
from mdnum.gradients.losses import ComplexPart, Loss, LossFrame
from mdnum.gradients.tape import RunTape, surroundings
from mdnum.md.integrators import without_kick
from mdnum.md.pairforce import PairForce
from mdnum.registry import Registry
from mdnum.systems.simulation import Simulation

#: Function that is called with the number of steps done, the total number, and the name of the phase.
Progress = Callable[[int, int, str], None]
#: Object that a method differentiates: steps at fixed decisions, the flow with shifted event times, values
#: between shifted runs, an average over runs or states, or another program.
Kind = Literal["steps", "flow", "values", "average", "other program"]
#: Parameters by name; each has the shape of its value in the simulation.
Values = Mapping[str, Any]


@dataclass(frozen=True)
class Problem:
    """A problem to differentiate: a simulation, a number of steps and a loss.

    Example:
        >>> loss = mdnum.gradients.losses.MeanPotential()
        >>> mdnum.Problem(mdnum.build("argon/crystal-108"), loss, steps=100)

    Attributes:
        simulation: the system as objects, including its start.
        loss: the number that is computed from the trajectory.
        steps: last step.
        parts: for a complex loss, the problems of its real and imaginary parts; otherwise empty.
    """

    simulation: Simulation
    loss: Loss
    steps: int
    parts: tuple[Problem, ...] = field(default=(), init=False, repr=False, compare=False)

    def __post_init__(self):
        expect_at_least(1, steps=self.steps)
        # a state that the integrator has no steps for is refused before anything is run
        assert self.simulation.propagator is not None
        if not self.loss.looks_at(np.arange(self.steps + 1), self.steps).any():
            raise InputError(
                f"the loss {self.loss.name} is not evaluated at any step from 0 to {self.steps}",
                remedy="Run more steps, or evaluate the loss at earlier steps or more often",
            )
        around = surroundings(self.simulation)
        why = self.loss.reason_unavailable(around)
        if why is not None:
            raise InputError(f"the loss {self.loss.name} is not defined for this system: {why}")
        # a loss that is no number is refused before anything is run
        shape: Any = jax.ShapeDtypeStruct
        vector = shape((3, self.simulation.atoms), self.simulation.policy.dtype("state"))
        frame = LossFrame(shape((), np.int64), vector, vector, *[shape((), np.float64)] * 2)
        made = jax.eval_shape(
            lambda frame: self.loss.value(self.loss.observe(frame, frame, around), 1), frame
        )
        if jax.tree.structure(made) != jax.tree.structure(0.0) or made.shape != ():
            seen = getattr(made, "shape", None) or jax.tree.structure(made)
            raise InputError(f"the loss has shape {seen}; expected a scalar", remedy="Return one number")
        if not np.issubdtype(made.dtype, np.inexact):
            remedy = "A count has no gradient: replace it by a float that varies smoothly"
            raise InputError(
                f"the loss has dtype {made.dtype}; expected a floating-point type", remedy=remedy
            )
        if np.issubdtype(made.dtype, np.complexfloating):
            parts = (ComplexPart(inner=self.loss, factor=jnp.asarray(one)) for one in (1 + 0j, -1j))
            object.__setattr__(self, "parts", tuple(replace(self, loss=one) for one in parts))

    def at(self, values: Values) -> Problem:
        """Return a copy of the problem with other values of parameters."""
        return replace(self, simulation=parameters.with_values(self.simulation, values)) if values else self

    def value(self, values: Values | None = None) -> Any:
        """Run the simulation and return its loss. The loss may be a complex number."""
        made = self.at(values or {})
        runs = (RunTape(one.simulation, one.loss, one.steps, budget=0) for one in made.parts or (made,))
        return sum(factor * run.value for factor, run in zip((1, 1j), runs, strict=False))

    @property
    def jumps(self) -> bool:
        """True if the pair force is discontinuous at the cutoff."""
        return bool(np.any(self.simulation.jumps()[1] != 0))


@dataclass(frozen=True)
class Gradient:
    """Gradient of a loss by one method, and a description of this method.

    Attributes:
        method: name of the method. description: one sentence on the derivative that the method computes.
        value: the loss of the program that was differentiated.
        gradient: derivatives by full name of the parameter, in the shape of its value; complex for a complex
            loss.
        notes: warnings by parameter name, such as a missing contribution of flips.
        details: plain values of the method: counts, errors, tables.
        kind: what was differentiated. depends: whether the run used each parameter, if known.
    """

    method: str
    description: str
    value: Any
    gradient: dict[str, Inexact[np.ndarray, "..."]]
    notes: dict[str, str] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)
    kind: Kind = "steps"
    depends: dict[str, bool] = field(default_factory=dict)


class Method:
    """Base class of gradient methods. The registry is METHODS.

    Methods for a ball are subclasses of `ball.BallMethod`.

    Attributes:
        name: name on the command line. description: which derivative the method computes, one sentence.
        kind: what is differentiated.
    """

    name: ClassVar[str]
    description: ClassVar[str]
    kind: ClassVar[Kind] = "steps"

    def reason_unavailable(self, problem: Any, names: Sequence[str]) -> str | None:
        """Return why the method does not apply. None if it applies."""
        return None

    def __call__(self, problem: Any, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """Compute the gradient. For a complex loss, real and imaginary parts are differentiated in turn.

        Raises:
            InputError: the method does not apply to this problem, or a parameter does not exist.
        """
        full = self.check(problem, names)
        if not getattr(problem, "parts", ()):
            return self.differentiate(problem, full, progress)
        real, imag = (self.differentiate(part, full, progress) for part in problem.parts)
        gradient = {name: np.asarray(real.gradient[name] + 1j * imag.gradient[name]) for name in full}
        # what holds of both: that one part is constant is no note on the other
        notes = dict(real.notes.items() & imag.notes.items())
        told = {"notes": notes, "details": {"real": real.details, "imaginary": imag.details}}
        return replace(real, value=real.value + 1j * imag.value, gradient=gradient, **told)

    def known(self, problem: Any, names: Sequence[str]) -> tuple[str, ...]:
        """Return the full names of parameters; raise an error for an unknown name."""
        return parameters.resolve(problem.simulation, names)

    def check(self, problem: Any, names: Sequence[str]) -> tuple[str, ...]:
        """Return full names of parameters. Raise an error if the method does not apply.

        Raises:
            InputError: a parameter does not exist, or the method does not apply.
        """
        full = self.known(problem, names)
        why = self.reason_unavailable(problem, full)
        if why is not None:
            raise InputError(f"the gradient method {self.name} is not applicable: {why}")
        return full

    def differentiate(self, problem: Any, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        """Compute the gradient with respect to parameters whose names were already checked."""
        raise NotImplementedError

    def result(self, value: float, gradient: dict[str, Any], notes=None, details=None) -> Gradient:
        """Create a `Gradient` with the name, description and kind of this method."""
        return Gradient(self.name, self.description, value, gradient, notes or {}, details or {}, self.kind)


#: Methods by their names on the command line, in the order of tables.
METHODS: Registry[Method] = Registry("method", "mdnum.gradient_methods", Method)
for _name, _class in {
    "symmetric": "recorded:Symmetric", "forward": "recorded:Forward", "unrolled": "unrolled:Unrolled",
    "reversible": "recorded:Reversible", "event-aware": "recorded:EventAware",
    "finite-differences": "differences:FiniteDifferences",
    "shadow-differences": "differences:ShadowDifferences",
    "smoothed-differences": "differences:SmoothedDifferences", "surrogate": "recorded:Surrogate",
    "ensemble": "differences:Ensemble", "reweighting": "averages:Reweighting",
    "boundary": "averages:BoundaryTerm",
}.items():  # fmt: skip
    METHODS.add(_name, f"mdnum.gradients.{_class}")
#: Names of the data that a reverse pass stores from its forward pass, chosen by the available memory.
_SPELLINGS = {"epochs": "unrolled", "recursive": "unrolled"}


def method(name: str) -> Method:
    """Return the gradient method with the given name and default options.

    Example:
        >>> mdnum.method("symmetric")

    Raises:
        InputError: no method has this name.
    """
    return METHODS.parse(_SPELLINGS.get(name, name))


def independent(problem: Problem, gradient: Mapping[str, Any], *, saltation: bool) -> dict[str, str]:
    """Return a note for derivatives that are exactly zero or omit flips."""
    notes = {}
    missing = problem.jumps and not saltation
    for name, value in gradient.items():
        if np.any(np.asarray(value)):
            if missing:
                notes[name] = "without what the flips add: the force jumps at the cutoff; event-aware adds it"
            continue
        why = "in this run: the loss does not depend on it, or its contributions cancel"
        if name.endswith("cutoff.radius") and missing:
            why = (
                "because it only decides which pairs interact, and decisions are not differentiated; "
                "event-aware adds their contribution"
            )
        notes[name] = f"exactly 0 {why}"
    return notes


def pairs_only(simulation: Simulation, *, any_step: bool = False) -> str | None:
    """Return why a method for pair potentials does not apply, or None.

    Args:
        any_step: whether every integrator is supported.
    """
    if not isinstance(simulation.force, PairForce):
        return "it is for pair potentials"
    return (None if any_step else without_kick(simulation.integrator)) or rounded(simulation)


def one_term(simulation: Simulation) -> str | None:
    """Return why a method for one pair potential does not apply, or None."""
    if simulation.pairwise and "" not in simulation.model.terms:
        return f"it is for one pair potential, and {simulation.potential.name} are several terms"
    return pairs_only(simulation)


def rounded(simulation: Simulation) -> str | None:
    """Return why forces of fewer than 32 bits have no derivative, or None."""
    if simulation.policy.dtype("force").itemsize < 4:
        precision = simulation.policy.force
        return f"forces in {precision} are rounded after every operation, which has no derivative"
    return None


def scalars_only(problem: Problem, names: Sequence[str]) -> str | None:
    """Return why finite differences do not apply, or None. Array parameters are unsupported."""
    large = [name for name in names if np.ndim(parameters.value(problem.simulation, name))]
    return f"{', '.join(large)}: a value for each shift of each entry would be needed" if large else None


def in_phase(progress: Progress | None, phase: str) -> Callable[[int, int], None] | None:
    """Return a callback (step, steps) that reports progress under the name `phase`."""
    if progress is None:
        return None
    return lambda step, steps: progress(step, steps, phase)
