"""What a derivative of a rollout is asked for and answered with, and what every method is."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Inexact

from mdnum.errors import InputError, NumericalError
from mdnum.gradients import parameters
from mdnum.gradients.losses import ComplexPart, Loss, LossFrame
from mdnum.gradients.tape import RunTape, surroundings
from mdnum.md.integrators import check_one_box, without_kick
from mdnum.md.pairforce import PairForce
from mdnum.registry import Registry
from mdnum.systems.simulation import Simulation

#: Called with the steps done, all steps, and the name of the phase.
Progress = Callable[[int, int, str], None]
#: What a method differentiates: the steps with decisions held fixed, the flow with the times of its flips,
#: values between shifted runs, an average over runs or states, another program.
Kind = Literal["steps", "flow", "values", "average", "other program"]
#: Parameters by name, each of the shape of its value in the simulation.
Values = Mapping[str, Any]


@dataclass(frozen=True)
class Problem:
    """A loss of a rollout.

    Example:
        >>> loss = mdnum.gradients.losses.MeanPotential()
        >>> mdnum.Problem(mdnum.build("argon/crystal-108"), loss, steps=100)

    Attributes:
        simulation: the system as objects, its start included.
        loss: what is made of the trajectory.
        steps: last step.
        parts: of a complex loss the problems of its real and imaginary parts; else empty.
    """

    simulation: Simulation
    loss: Loss
    steps: int
    parts: tuple[Problem, ...] = field(default=(), init=False, repr=False, compare=False)

    def __post_init__(self):
        if self.steps < 1:
            raise InputError(f"steps = {self.steps}; expected at least 1")
        # a state that the integrator has no steps for is refused before anything is run
        assert self.simulation.propagator is not None
        check_one_box(self.simulation.integrator, "gradients")
        if not self.loss.looks_at(np.arange(self.steps + 1), self.steps).any():
            raise InputError(
                f"the loss {self.loss.name} looks at no step up to {self.steps}",
                remedy="Run longer, or look earlier or more often",
            )
        around = surroundings(self.simulation)
        why = self.loss.reason_unavailable(around)
        if why is not None:
            raise InputError(f"the loss {self.loss.name} has no meaning here: {why}")
        # a loss that is no number is refused before anything is run
        shape: Any = jax.ShapeDtypeStruct
        vector = shape((3, self.simulation.atoms), self.simulation.policy.dtype("state"))
        frame = LossFrame(shape((), np.int64), vector, vector, *[shape((), np.float64)] * 2)
        made = jax.eval_shape(
            lambda frame: self.loss.value(self.loss.observe(frame, frame, around), 1), frame
        )
        if jax.tree.structure(made) != jax.tree.structure(0.0) or made.shape != ():
            seen = getattr(made, "shape", None) or jax.tree.structure(made)
            raise InputError(f"the loss has shape {seen}; expected a scalar", remedy="Reduce it to a number")
        if not np.issubdtype(made.dtype, np.inexact):
            remedy = "A count has no gradient: make a float of it that varies smoothly"
            raise InputError(f"the loss is of dtype {made.dtype}; expected a float", remedy=remedy)
        if np.issubdtype(made.dtype, np.complexfloating):
            parts = (ComplexPart(inner=self.loss, factor=jnp.asarray(one)) for one in (1 + 0j, -1j))
            object.__setattr__(self, "parts", tuple(replace(self, loss=one) for one in parts))

    def at(self, values: Values) -> Problem:
        """The same loss of a rollout with other parameters."""
        return replace(self, simulation=parameters.with_values(self.simulation, values)) if values else self

    def value(self, values: Values | None = None) -> Any:
        """The loss, of the run that the rollout makes: a float, or of a complex loss complex."""
        made = self.at(values or {})
        runs = (RunTape(one.simulation, one.loss, one.steps, budget=0) for one in made.parts or (made,))
        return sum(factor * run.value for factor, run in zip((1, 1j), runs, strict=False))

    @property
    def jumps(self) -> bool:
        """Whether the force jumps at the cutoff."""
        return bool(np.any(self.simulation.jumps()[1] != 0))


@dataclass(frozen=True)
class Gradient:
    """A derivative of a loss, and which derivative it is.

    Attributes:
        method: name of the method. description: which derivative this is, one sentence.
        value: the loss of the program that was differentiated.
        gradient: derivative by full name of the parameter, of the shape of its value; complex like the loss.
        notes: what must be known about a parameter, by name: no dependence, a missing term.
        details: plain values of the method: counts, errors, tables.
        kind: what was differentiated. depends: whether the run used each parameter, where that is known.
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
    """A way to differentiate a rollout: a frozen dataclass of its options, in a file with a row in METHODS.

    The contract of both worlds: `ball.BallMethod` is called with the problem of a ball.

    Attributes:
        name: as the command line has it. description: which derivative it gives, one sentence.
        kind: what it differentiates.
    """

    name: ClassVar[str]
    description: ClassVar[str]
    kind: ClassVar[Kind] = "steps"

    def reason_unavailable(self, problem: Any, names: Sequence[str]) -> str | None:
        """Why this derivative does not exist for this problem; None where it does."""
        return None

    def __call__(self, problem: Any, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The derivative by the named parameters; a complex loss takes a run for each of its parts.

        Raises:
            InputError: it does not exist for this problem, or there is no such parameter.
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
        """Full names of the parameters, of which there is none of another name."""
        return parameters.resolve(problem.simulation, names)

    def check(self, problem: Any, names: Sequence[str]) -> tuple[str, ...]:
        """Full names of the parameters.

        Raises:
            InputError: no such parameter, or the method does not apply.
        """
        full = self.known(problem, names)
        why = self.reason_unavailable(problem, full)
        if why is not None:
            raise InputError(f"the method {self.name} does not apply: {why}")
        return full

    def differentiate(self, problem: Any, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        """The derivative, of names that were checked."""
        raise NotImplementedError

    def result(self, value: float, gradient: dict[str, Any], notes=None, details=None) -> Gradient:
        """A gradient of this method."""
        return Gradient(self.name, self.description, value, gradient, notes or {}, details or {}, self.kind)


#: Methods by the names that the command line gives them, in the order of tables.
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
#: Names of what reverse mode keeps of its forward pass, which its method decides by the memory there is.
_SPELLINGS = {"epochs": "unrolled", "recursive": "unrolled"}


def method(name: str) -> Method:
    """The method of that name, with its defaults.

    Example:
        >>> mdnum.method("symmetric")

    Raises:
        InputError: there is none.
    """
    return METHODS.parse(_SPELLINGS.get(name, name))


def independent(problem: Problem, gradient: Mapping[str, Any], *, saltation: bool) -> dict[str, str]:
    """Notes on parameters whose derivative is exactly zero, or misses what the flips add."""
    notes = {}
    missing = problem.jumps and not saltation
    for name, value in gradient.items():
        if np.any(np.asarray(value)):
            if missing:
                notes[name] = "without what the flips add: the force jumps at the cutoff; event-aware adds it"
            continue
        why = "in this run: no step on the way to the loss depends on it, or what does cancels"
        if name.endswith("cutoff.radius") and missing:
            why = (
                "because it only decides which pairs interact, and decisions are not differentiated; "
                "event-aware adds what they do"
            )
        notes[name] = f"exactly 0 {why}"
    return notes


def pairs_only(simulation: Simulation) -> str | None:
    """Why the reverse pass of pairs does not apply; None where it does."""
    if not isinstance(simulation.force, PairForce):
        return "it is for pair potentials"
    return without_kick(simulation.integrator) or rounded(simulation)


def one_term(simulation: Simulation) -> str | None:
    """Why what knows a single pair potential does not apply; None where it does."""
    if simulation.pairwise and "" not in simulation.model.terms:
        return f"it is for one pair potential, and {simulation.potential.name} are several terms"
    return pairs_only(simulation)


def rounded(simulation: Simulation) -> str | None:
    """Why forces have no derivative: one that is rounded after every operation has none."""
    if simulation.policy.dtype("force").itemsize < 4:
        precision = simulation.policy.force
        return f"forces in {precision} are rounded after every operation, which has no derivative"
    return None


def scalars_only(problem: Problem, names: Sequence[str]) -> str | None:
    """Why differences of values do not apply."""
    large = [name for name in names if np.ndim(parameters.value(problem.simulation, name))]
    return f"{', '.join(large)}: a value for each shift of each entry would be needed" if large else None


def in_phase(progress: Progress | None, phase: str) -> Callable[[int, int], None] | None:
    """A callback of steps alone, that names the phase too."""
    if progress is None:
        return None
    return lambda step, steps: progress(step, steps, phase)


# --- the shape that JAX gives to gradients, for training loops ----------------------------------------
# The run is made on the host, list by list; a transformation that would trace it as one program cannot.


def value_and_grad(
    problem: Problem, names: Sequence[str], method: Method | str = "event-aware", *, has_aux: bool = False
) -> Callable[[Values], tuple[Any, dict[str, np.ndarray]]]:
    """A function that gives the loss and its gradient, as `jax.value_and_grad` does.

    Example:
        >>> f = mdnum.value_and_grad(problem, ["sigma"])
        >>> value, slopes = f({"sigma": 1.01})

    Args:
        names: parameters to differentiate by, full or short names. method: a method, or its name.
        has_aux: whether to return the whole `Gradient` too, as ((value, gradient), gradient by name).

    Returns:
        values by name (any of the names; the others stay as the system file has them) to (value, gradient by
        name), spelled as they were asked for. Of a complex loss z both are complex, and the derivative by a
        real parameter p is dz/dp = d Re z/dp + i d Im z/dp, without a conjugate: d|z|² = 2 Re(conj(z) dz),
        d arg z = Im(dz/z). It is no direction of descent; `mdnum grad` and `trust` take real losses only.

    Raises:
        InputError: no such parameter or method, or it does not apply; a value is not real.

    Warns:
        UserWarning: a derivative that is exactly zero, with the reason.
    """
    chosen, full = _chosen(problem, names, method)
    # a word for several parameters is none of them
    spelled = {word: parameters.resolve(problem.simulation, [word]) for word in reversed(names)}
    asked = {name: name for name in full} | {one[0]: word for word, one in spelled.items() if len(one) == 1}

    def function(values: Values | None = None):
        found = _differentiated(chosen, problem.at(_in_full(problem, values or {}, full)), full)
        gradient = {asked[name]: found.gradient[name] for name in full}
        return ((found.value, found) if has_aux else found.value), gradient

    return function


def differentiable(
    problem: Problem,
    names: Sequence[str],
    method: Method | str = "event-aware",
    watch: Callable[[Gradient], None] | None = None,
) -> Callable[[Values], jax.Array]:
    """The loss as a function that JAX can differentiate in reverse mode.

    Parameters may be any pytree: put a function of your own before it, which makes the named values of it,
    and `jax.grad` goes through both.

    Args:
        problem, names, method: as for `value_and_grad`, which see for what is raised and warned of.
        watch: called with the whole gradient each time that one is worked out.

    Returns:
        values by name to the loss, a scalar; of a complex one `jax.grad` takes real functions, as jnp.abs.
        It runs outside of `jit` and `vmap`.
    """
    chosen, full = _chosen(problem, names, method)

    def at(values: Values) -> Problem:
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values)):
            raise InputError(
                "a rollout was called inside jit or vmap; its lists are made on the host",
                remedy="Call it, and jax.grad of it, outside of jit and vmap",
            )
        return problem.at(_in_full(problem, values, full))

    @jax.custom_vjp
    def loss(values: Values) -> jax.Array:
        return jnp.asarray(at(values).value())

    def forward(values: Values):
        found = _differentiated(chosen, at(values), full)
        if watch is not None:
            watch(found)
        by_name = {}
        for name, value in values.items():
            (one,) = parameters.resolve(problem.simulation, [name])
            derivative = found.gradient[one]
            dtype = np.promote_types(jnp.result_type(value), np.complex64)
            by_name[name] = jnp.asarray(derivative).astype(dtype)
        return jnp.asarray(found.value), by_name

    def backward(gradient, onto):
        # the cotangent of x + iy is that of x minus i times that of y
        return (jax.tree.map(lambda one: jnp.real(onto.astype(one.dtype) * one), gradient),)

    loss.defvjp(forward, backward)
    return loss


def _chosen(problem: Problem, names: Sequence[str], word: Method | str) -> tuple[Method, tuple[str, ...]]:
    chosen = method(word) if isinstance(word, str) else word
    return chosen, chosen.check(problem, names)


def _differentiated(chosen: Method, problem: Problem, names: tuple[str, ...]) -> Gradient:
    """The gradient, with a warning of a derivative that is exactly zero: a training loop reads no notes.

    Raises:
        NumericalError: it is not finite; names the first operation at fault where one is.
    """
    found = chosen(problem, names)
    for name, value in found.gradient.items():
        if not np.any(np.asarray(value)):
            note = found.notes.get(name, "exactly 0 in this run")
            warnings.warn(f"{found.method} by {name}: {note}", UserWarning, stacklevel=3)
    bad = [name for name, value in found.gradient.items() if not np.isfinite(value).all()]
    if bad or not np.isfinite(found.value):
        from mdnum.gradients.diagnose.detective import detective

        why = ""
        with suppress(InputError):
            blamed = detective((problem.parts or (problem,))[0], names, saltation=False)
            inputs = ", ".join(f"{one:.3g}" for one in blamed.inputs)
            if blamed.operation:
                why = f": at step {blamed.step} {blamed.operation}({inputs}) in {blamed.source}"
        what = "the loss" if not np.isfinite(found.value) else f"the gradient by {', '.join(bad)}"
        raise NumericalError(f"{what} is not finite{why}", where=found.method, remedy="Mend that operation")
    return found


def _in_full(problem: Problem, values: Values, full: Sequence[str]) -> dict[str, np.ndarray]:
    """Values by full name.

    Raises:
        InputError: a name that is not differentiated by.
    """
    out = {}
    for word, value in values.items():
        (name,) = parameters.resolve(problem.simulation, [word])
        if name not in full:
            raise InputError(
                f"a value for {word}, which the gradient was not asked for",
                remedy=f"Name it among the parameters; they are {', '.join(full)}",
            )
        out[name] = np.asarray(value)
    return out
