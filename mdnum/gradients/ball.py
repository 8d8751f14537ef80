"""Derivatives of a ball's rollout: a program with decisions has several, and each is a method of its own.

Of the operations that ran (unrolled), with every decision pinned (frozen), of the mean loss over random
parameters (randomized); those of other contacts are in `ball_contacts`, that of the motion in `ball_motion`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mdnum.ball.problem import START, BallLoss, BallProblem, loss_of
from mdnum.ball.rollout import BallRun
from mdnum.ball.step import BallDecisions, Projection
from mdnum.ball.world import World
from mdnum.errors import InputError, MdnumError
from mdnum.gradients.dependence import dependence, follow
from mdnum.gradients.problem import Gradient, Kind
from mdnum.numerics.scaling import check_scale, scaled_gradient
from mdnum.registry import Registry


class BallMethod:
    """A way to differentiate a ball's rollout, called with a problem and names of parameters.

    Attributes:
        name: as in system files. description: which derivative it gives, one sentence.
        kind: what it differentiates.
    """

    name: ClassVar[str]
    description: ClassVar[str]
    kind: ClassVar[Kind] = "steps"

    def __call__(self, problem: BallProblem, names: Sequence[str]) -> Gradient:
        """The derivative of the loss by the named parameters; a batch moves as a whole along y0 and v0.

        Raises:
            InputError: this derivative does not exist for this world, or there is no such parameter.
        """
        raise NotImplementedError

    def result(self, value: float, slopes: dict[str, float], used: Used, details: dict[str, Any]) -> Gradient:
        """A gradient of this method."""
        gradient = {name: np.asarray(slope, np.float64) for name, slope in slopes.items()}
        return Gradient(
            self.name, self.description, value, gradient, used.notes, details, self.kind, used.depends
        )


#: Methods by the names that system files give them; names take the options of the classes.
BALL_METHODS: Registry[BallMethod] = Registry("gradient", "mdnum.ball_gradient_methods", BallMethod)
for _name, _class in {
    "unrolled": "ball:ThroughIterations", "frozen": "ball:Frozen", "implicit": "ball_contacts:Implicit",
    "event-aware": "ball_motion:ThroughContacts", "smoothed": "ball_contacts:SoftFloor",
    "randomized": "ball:RandomizedSmoothing",
}.items():  # fmt: skip
    BALL_METHODS.add(_name, f"mdnum.gradients.{_class}")


@dataclass(frozen=True)
class BallGradients:
    """Derivatives of one problem by several methods.

    Attributes:
        gradients: of the methods that apply, in the order asked for.
        refused: why another does not, by its name.
    """

    gradients: tuple[Gradient, ...]
    refused: Mapping[str, str]

    def __iter__(self) -> Iterator[Gradient]:
        return iter(self.gradients)


def compare(
    problem: BallProblem, names: Sequence[str], methods: Sequence[str | BallMethod] | None = None
) -> BallGradients:
    """The derivative of one loss by several methods, and why some do not apply.

    Args:
        names: parameters, "y0" and "v0" among them.
        methods: names or objects; default all.

    Raises:
        InputError: there is no such parameter or method.
    """
    problem.values(names)
    asked = BALL_METHODS if methods is None else methods
    chosen = [BALL_METHODS.parse(one) if isinstance(one, str) else one for one in asked]
    gradients, refused = [], {}
    for one in chosen:
        try:
            gradients.append(one(problem, names))
        except MdnumError as error:
            refused[one.name] = str(error)
    return BallGradients(tuple(gradients), refused)


class Used(NamedTuple):
    """Whether the run used each parameter on the way to the loss, and the answer in words."""

    depends: dict[str, bool]
    notes: dict[str, str]


def origin(problem: BallProblem, names: Sequence[str]) -> dict[str, jax.Array]:
    """Where a problem is, for `moved_loss`: parameters by value, the start by how far it is moved (0)."""
    problem.values(names)
    dtype = problem.world.policy.dtype("arithmetic")
    return {
        name: jnp.zeros((), np.float64)
        if name in START
        else jnp.asarray(problem.world.value(name)).astype(np.float64 if name in ("tol", "enter") else dtype)
        for name in names
    }


def moved_loss(
    values: Mapping[str, Any],
    world: World,
    y0: jax.Array,
    v0: jax.Array,
    decisions: BallDecisions | None,
    steps: int,
    loss: BallLoss,
) -> jax.Array:
    """The loss with parameters set and the start moved, everything an argument, so that no fence is folded.

    Args:
        values: as from `origin`.
        decisions: of every step, or None for the world's own.
    """
    rest = {name: value for name, value in values.items() if name not in START}
    y, v = (
        start + jnp.asarray(values[name]).astype(start.dtype) if name in values else start
        for name, start in zip(START, (y0, v0), strict=True)
    )
    return loss_of(world.with_values(rest), y, v, steps, loss, decisions)


def start_of(problem: BallProblem) -> tuple[jax.Array, jax.Array]:
    """Heights and velocities at the start as floating arrays, shapes (balls,) and () or (balls,)."""
    y = jnp.atleast_1d(jnp.asarray(problem.y0))
    y = y if jnp.issubdtype(y.dtype, jnp.floating) else y.astype(jnp.float64)
    return y, jnp.asarray(problem.v0).astype(y.dtype)


class _Rollout(eqx.Module):
    """`moved_loss` of so many steps: equal for equal problems, so that it is compiled once."""

    steps: int = eqx.field(static=True)
    loss: BallLoss

    def __call__(self, values, world, y0, v0, decisions):
        return moved_loss(values, world, y0, v0, decisions, self.steps, self.loss)


@eqx.filter_jit
def evaluate(values, world, y0, v0, decisions, steps, loss):
    """`moved_loss`, compiled."""
    return moved_loss(values, world, y0, v0, decisions, steps, loss)


@eqx.filter_jit
def differentiate(values, world, y0, v0, decisions, steps, loss, names, scale):
    """Loss and reverse-mode derivative under loss scaling, and what the run used, as one compiled program."""
    function, rest = _Rollout(steps, loss), (world, y0, v0, decisions)
    made = scaled_gradient(lambda values: function(values, *rest), scale, values)
    return made, follow(function, values, rest, names)


def used(
    problem: BallProblem,
    names: Sequence[str],
    slopes: Mapping[str, float],
    run: BallRun | None = None,
    marks: Any = None,
) -> Used:
    """Whether the run used each parameter on the way to the loss.

    Args:
        slopes: derivatives already known.
        run: of this problem, made here when None.
        marks: what `follow` gave for the names, where it was asked already.
    """
    run = problem.run(keep=False) if run is None else run
    answers = dependence(
        _Rollout(problem.steps, problem.loss), origin(problem, names), names,
        (problem.world, *start_of(problem), None), gradient=slopes, marks=marks,
        why_unused=_why(problem.world, run),
    )  # fmt: skip
    return Used(
        {name: answer.used for name, answer in answers.items()},
        {name: answer.message for name, answer in answers.items()},
    )


def _why(world: World, run: BallRun) -> str:
    if not run.contact.any():
        return "no ball touched the floor, and nothing else used {name}"
    if isinstance(world.contact, Projection) and not run.iterations.any():
        return "the loop ended before {name} was used"
    return "nothing that ran used {name}"


@dataclass(frozen=True)
class ThroughIterations(BallMethod):
    """The derivative of the operations that ran, iteration by iteration.

    Attributes:
        loss_scale: the reverse pass starts with it instead of 1 and the derivative is divided by it, so that
            a narrow dtype does not lose it below its smallest number (`mdnum.numerics.scaling`); a power of
            two.
    """

    loss_scale: float = 1.0

    name = "unrolled"
    description = (
        "the derivative of the iterations that ran; decisions are held, a solver's tolerance is in it"
    )

    def __call__(self, problem: BallProblem, names: Sequence[str], run: BallRun | None = None) -> Gradient:
        """The derivative, by reverse mode.

        Args:
            run: of this problem, where there already is one.

        Error: rounding of the reverse pass in the dtypes of the policy.
        """
        run = problem.run(keep=False) if run is None else run
        value, slopes, marks = scaled(problem, names, None, self.loss_scale)
        depends, why = used(problem, names, slopes, run, marks)
        details = {"iterations": int(run.iterations.sum()), "loss_scale": self.loss_scale}
        return self.result(value, slopes, Used(depends, why), details)


@dataclass(frozen=True)
class Frozen(BallMethod):
    """The derivative of the program whose decisions and iteration counts are those of a recording.

    The pinned program has no branches left, so finite differences of it exist; in float64 they are taken as
    a check.

    Attributes:
        check: whether to take them.
    """

    check: bool = True

    name = "frozen"
    description = (
        "the derivative of a program without branches, with the decisions and counts of a recorded run"
    )

    def __call__(self, problem: BallProblem, names: Sequence[str]) -> Gradient:
        """The derivative, by reverse mode, with central differences of the pinned program beside it.

        Error: of the derivative, rounding; of the differences, about u^(2/3) relative.
        """
        run = problem.run(keep=False)
        decisions = run.decisions()
        decisions = type(decisions)(jnp.asarray(decisions.contact), jnp.asarray(decisions.iterations))
        value, slopes, marks = scaled(problem, names, decisions)
        details: dict = {"decisions": int(run.contact.size), "iterations": int(run.iterations.sum())}
        if self.check and problem.world.policy.arithmetic == "float64":
            details["finite_difference"] = pinned_differences(problem, names, decisions)
        depends, why = used(problem, names, slopes, run, marks)
        return self.result(value, slopes, Used(depends, why), details)


class Scaled(NamedTuple):
    """A loss, its derivative by name, and whether the run used each name."""

    value: float
    slopes: dict[str, float]
    marks: np.ndarray


def scaled(
    problem: BallProblem, names: Sequence[str], decisions: BallDecisions | None = None, scale: float = 1.0
) -> Scaled:
    """Loss and reverse-mode derivative under loss scaling.

    Args:
        decisions: to act on, or None.
        scale: a power of two.

    Raises:
        InputError: it is not.
    """
    values, start = origin(problem, names), start_of(problem)
    check_scale(scale)
    factor = jnp.asarray(scale, jnp.float64)
    made, marks = differentiate(
        values, problem.world, *start, decisions, problem.steps, problem.loss, tuple(names), factor
    )
    slopes = {name: float(made.gradient[name]) for name in names}
    return Scaled(float(made.value), slopes, np.asarray(marks))


def pinned_differences(problem: BallProblem, names: Sequence[str], decisions) -> dict[str, float]:
    """Central differences of the loss with all decisions imposed.

    Error: about u^(2/3), relative to the loss over the size of the parameter.
    """
    at, start = origin(problem, names), start_of(problem)
    found = {}
    for name in names:
        size = float(np.max(np.abs(getattr(problem, name)))) if name in START else abs(float(at[name]))
        width = 6e-6 * (size or 1.0)

        def loss(shift: float, name: str = name) -> float:
            values = at | {name: at[name] + shift}
            return float(evaluate(values, problem.world, *start, decisions, problem.steps, problem.loss))

        found[name] = (loss(width) - loss(-width)) / (2 * width)
    return found


@dataclass(frozen=True)
class RandomizedSmoothing(BallMethod):
    """The derivative of E[loss(parameters + width * noise)], estimated from values alone.

    It needs no derivative of the program, sees through jumps (of iteration counts, of contacts), and is that
    of a smoother loss; the same seed gives the same bits. Each sample is used with its mirror image, which
    removes the value of the loss from the variance.

    Attributes:
        width: standard deviation of the noise, as a share of a parameter's size (of 1 where it is 0).
        samples: pairs of mirrored samples.
        seed: of the noise.
    """

    width: float = 1e-2
    samples: int = 256
    seed: int = 0

    name = "randomized"
    kind = "average"
    description = (
        "the derivative of the loss averaged over Gaussian noise in the parameters: of a smoother loss, and "
        "with a standard error"
    )

    def __call__(self, problem: BallProblem, names: Sequence[str]) -> Gradient:
        """The estimate; `details` holds its standard error for each name.

        Raises:
            InputError: width or samples out of range.

        Error: the standard error, and the bias of averaging, of the order of width².

        Source: Nesterov and Spokoiny (2017), with antithetic samples.
        """
        if not self.width > 0 or self.samples < 2:
            raise InputError(
                f"width is {self.width} and samples {self.samples}",
                remedy="Choose a width above 0 and at least 2 samples.",
            )
        at, start = origin(problem, names), start_of(problem)
        sizes = {
            name: float(np.max(np.abs(getattr(problem, name)))) if name in START else abs(float(at[name]))
            for name in names
        }
        widths = {name: self.width * (size or 1.0) for name, size in sizes.items()}
        noise = np.asarray(
            jax.random.normal(jax.random.key(self.seed), (self.samples, len(names)), jnp.float64)
        )
        shifts = {name: noise[:, column] * widths[name] for column, name in enumerate(names)}
        both = {name: np.concatenate([shift, -shift]) for name, shift in shifts.items()}
        values = {name: np.asarray(at[name], np.float64) + both[name] for name in names}
        losses = np.asarray(
            _many(
                {name: jnp.asarray(value).astype(at[name].dtype) for name, value in values.items()},
                problem.world, *start, problem.steps, problem.loss,
            ),
            np.float64,
        )  # fmt: skip
        half = (losses[: self.samples] - losses[self.samples :]) / 2
        slopes, errors = {}, {}
        for column, name in enumerate(names):
            each = half * noise[:, column] / widths[name]
            slopes[name] = float(np.mean(each))
            errors[name] = float(np.std(each, ddof=1) / np.sqrt(self.samples))
        depends, why = used(problem, names, slopes)
        for name in names:
            if np.any(half) and not depends[name]:
                depends[name], why[name] = (
                    True,
                    f"the loss jumps with {name}, which the run itself did not use",
                )
        details = {"standard_error": errors, "width": widths, "samples": self.samples, "seed": self.seed}
        return self.result(float(np.mean(losses)), slopes, Used(depends, why), details)


@eqx.filter_jit
def _many(values, world, y0, v0, steps, loss):
    return jax.vmap(lambda one: moved_loss(one, world, y0, v0, None, steps, loss))(values)
