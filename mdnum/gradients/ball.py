"""Derivatives of a ball's rollout: a program with decisions has several, and each is a method of its own.

Of the operations that ran (unrolled), with every decision pinned (frozen), of what a solver approaches
(implicit), of a program with a soft floor (smoothed), of the mean loss over random parameters (randomized);
that of the motion, with the times of contacts, is in `ball_motion`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float

from mdnum.ball.contacts import Motion, Moved, Penalty, Projection
from mdnum.ball.integrators import EventLocated, Push, VelocityVerlet
from mdnum.ball.problem import START, Loss, Problem, loss_of
from mdnum.ball.rollout import BallRun
from mdnum.ball.state import Decisions, Record
from mdnum.ball.stopping import Fixed
from mdnum.ball.world import World
from mdnum.errors import InputError, MdnumError
from mdnum.gradients.dependence import dependence, follow
from mdnum.gradients.problem import Gradient, Kind
from mdnum.numerics.scaling import check_scale, scaled_gradient
from mdnum.registry import Registry

#: Beyond this condition number the linear solve means nothing in float64.
LIMIT = 1e12
#: Steps that the soft floor of an impact must act for.
_RESOLVED = 10


class BallMethod:
    """A way to differentiate a ball's rollout, called with a problem and names of parameters.

    Attributes:
        name: as in system files. description: which derivative it gives, one sentence.
        kind: what it differentiates.
    """

    name: ClassVar[str]
    description: ClassVar[str]
    kind: ClassVar[Kind] = "steps"

    def __call__(self, problem: Problem, names: Sequence[str]) -> Gradient:
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
    "unrolled": "ball:ThroughIterations", "frozen": "ball:Frozen", "implicit": "ball:Implicit",
    "event-aware": "ball_motion:ThroughContacts", "smoothed": "ball:SoftFloor",
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
    problem: Problem, names: Sequence[str], methods: Sequence[str | BallMethod] | None = None
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


def origin(problem: Problem, names: Sequence[str]) -> dict[str, jax.Array]:
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
    decisions: Decisions | None,
    steps: int,
    loss: Loss,
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


def start_of(problem: Problem) -> tuple[jax.Array, jax.Array]:
    """Heights and velocities at the start as floating arrays, shapes (balls,) and () or (balls,)."""
    y = jnp.atleast_1d(jnp.asarray(problem.y0))
    y = y if jnp.issubdtype(y.dtype, jnp.floating) else y.astype(jnp.float64)
    return y, jnp.asarray(problem.v0).astype(y.dtype)


class _Rollout(eqx.Module):
    """`moved_loss` of so many steps: equal for equal problems, so that it is compiled once."""

    steps: int = eqx.field(static=True)
    loss: Loss

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
    problem: Problem,
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
            a narrow dtype does not lose it below its smallest number (`mdnum.precision.scaling`); a power of
            two.
    """

    loss_scale: float = 1.0

    name = "unrolled"
    description = (
        "the derivative of the iterations that ran; decisions are held, a solver's tolerance is in it"
    )

    def __call__(self, problem: Problem, names: Sequence[str], run: BallRun | None = None) -> Gradient:
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

    def __call__(self, problem: Problem, names: Sequence[str]) -> Gradient:
        """The derivative, by reverse mode, with central differences of the pinned program beside it.

        Error: of the derivative, rounding; of the differences, about u^(2/3) relative.
        """
        run = problem.run(keep=False)
        decisions = run.told()
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
    problem: Problem, names: Sequence[str], decisions: Decisions | None = None, scale: float = 1.0
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


def pinned_differences(problem: Problem, names: Sequence[str], decisions) -> dict[str, float]:
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


def solve(
    matvec: Callable[[Any], Any],
    right: Float[Array, "unknowns"],
    tolerance: float | Float[Array, ""] = 1e-12,
    regularization: float | Float[Array, ""] = 0.0,
    max_iter: int = 200,
) -> Float[Array, "unknowns"]:
    """x of (A + regularization) x = right by conjugate gradients, differentiable both ways.

    Args:
        matvec: A, symmetric and positive definite.
        right: right-hand side.
        tolerance: of the residual, relative to the right-hand side.
        regularization: added to the diagonal of A; moves the answer by about regularization / smallest
            eigenvalue, relative.
        max_iter: the cap.

    Error: at most tolerance times the condition number, relative.
    """

    def matrix(x):
        return matvec(x) + jnp.asarray(regularization, x.dtype) * x

    def conjugate(matvec, b):
        return cg(matvec, b, tol=tolerance, maxiter=max_iter)[0]  # type: ignore[arg-type]

    return jax.lax.custom_linear_solve(matrix, right, conjugate, symmetric=True)


def fixed_point_tangent(
    update: Callable[..., Float[Array, "unknowns"]],
    x: Float[Array, "unknowns"],
    parameters: tuple[Any, ...],
    tangents: tuple[Any, ...],
    **options: Any,
) -> Float[Array, "unknowns"]:
    """dx of x = update(x, *parameters), by the implicit function theorem: (1 - dG/dx) dx = dG/dp dp.

    Args:
        update: G; 1 - dG/dx symmetric and positive definite at x.
        x: a fixed point. At a point that is only near one, the answer is off by about that distance.
        options: of `solve`.
    """
    _, right = jax.jvp(lambda *given: update(x, *given), parameters, tangents)

    def matvec(dx):
        return dx - jax.jvp(lambda at: update(at, *parameters), (x,), (dx,))[1]

    return solve(matvec, right, **options)


class FixedPointRule(eqx.Module):
    """Gives a projection's result the derivative of the fixed point it stands for.

    For a ball in contact the fixed point of y ← y + gain max(0, -y) that is reached from below is y = 0. It
    lies on the kink of max(0, -y), where dG/dy has two values: the one from below is used, because the ball
    comes from there (a choice of branch, as the active set of a complementarity problem).

    Attributes:
        tolerance, regularization, max_iter: of the linear solve.
        at_iterate: evaluate at the height where the iteration stopped instead, which is no fixed point: then
            the tolerance is back, as p / k.
    """

    tolerance: float = eqx.field(static=True, default=1e-12)
    regularization: float = eqx.field(static=True, default=0.0)
    max_iter: int = eqx.field(static=True, default=200)
    at_iterate: bool = eqx.field(static=True, default=False)

    def attach(
        self, y: Float[Array, "balls"], gain: Float[Array, "balls"], contact: Bool[Array, "balls"]
    ) -> Float[Array, "balls"]:
        """y, unchanged, with the other derivative.

        Args:
            y: heights where the iteration stopped.
            gain: alpha k, by ball.
            contact: the contact decision.
        """

        @jax.custom_jvp
        def given(y, gain, contact):
            return y

        @given.defjvp
        def rule(primals, tangents):
            y, gain, contact = primals
            ends = y if self.at_iterate else jnp.where(contact & (y < 0), jnp.zeros_like(y), y)

            def update(y, gain):
                # the branch below the floor for every ball in contact; the others stay where they are
                return jnp.where(contact, y - gain * y, jnp.zeros_like(y))

            moved = fixed_point_tangent(
                update,
                ends,
                (gain,),
                (tangents[1],),
                tolerance=self.tolerance,
                regularization=self.regularization,
                max_iter=self.max_iter,
            )
            return y, jnp.where(contact, moved, tangents[0])

        return given(y, gain, contact)


class _Settled(eqx.Module):
    """Puts every ball in contact where its iteration was heading."""

    def attach(self, y, gain, contact):
        """The fixed point."""
        return jnp.where(contact & (y < 0), jnp.zeros_like(y), y)


@dataclass(frozen=True)
class Implicit(BallMethod):
    """The derivative of the projection's fixed point, by the implicit function theorem.

    The loss is that of the iterations that ran; its derivative is that of where they were heading. For the
    projection of a ball the fixed point is the floor, whatever the gain: the derivative by k is 0, and what
    the unrolled one gives instead is an artefact of the tolerance.

    Attributes:
        tolerance, regularization, max_iter: of the linear solve.
        at_iterate: take the stopped iterate for the fixed point (an error of the order of the tolerance).
    """

    tolerance: float = 1e-12
    regularization: float = 0.0
    max_iter: int = 200
    at_iterate: bool = False

    name = "implicit"
    description = (
        "the derivative of the fixed point that the solver approaches, not of the iterations it took; a "
        "linear solve with a tolerance of its own"
    )

    def __call__(self, problem: Problem, names: Sequence[str]) -> Gradient:
        """The derivative, by reverse mode through the linear solve.

        Raises:
            InputError: nothing is iterated here, or the linear system is too ill conditioned.

        Error: tolerance times the condition number of 1 - dG/dy, and what regularization moves.
        """
        contact = problem.world.contact
        if not isinstance(contact, Projection):
            raise InputError(
                f"{type(contact).__name__} has no iterated projection to take the fixed point of",
                remedy="Use the unrolled derivative, or event-aware for an impact.",
            )
        gain = float(contact.alpha) * float(contact.k)
        condition = max(1.0, gain + self.regularization) / min(1.0, gain + self.regularization)
        if condition > LIMIT:
            raise InputError(
                f"1 - dG/dy has the condition number {condition:.3g}; expected at most {LIMIT:g}",
                remedy="Regularize the solve, and read the derivative as that of a regularized problem.",
            )
        rule = FixedPointRule(self.tolerance, self.regularization, self.max_iter, self.at_iterate)
        attached = _with_contact(problem, replace(contact, derivative=rule))
        value, slopes, _ = scaled(attached, names)
        # what the run would be if every solve ended at its fixed point
        ideal = _with_contact(problem, replace(contact, stop=Fixed(0), derivative=_Settled()))
        asked = problem if self.at_iterate else ideal
        depends, why = used(asked, names, slopes)
        if not self.at_iterate:
            why |= {name: f"the fixed point does not depend on {name}" for name in names if not depends[name]}
        details = {
            "tolerance": self.tolerance,
            "regularization": self.regularization,
            "condition": condition,
            "at": "the stopped iterate" if self.at_iterate else "the fixed point",
        }
        return self.result(value, slopes, Used(depends, why), details)


def _with_contact(problem: Problem, contact: Any) -> Problem:
    return replace(problem, world=replace(problem.world, contact=contact))


class SoftImpact(eqx.Module):
    """An impact without a decision: a soft spring that pushes harder on the way in than on the way out.

    The spring has stiffness k while the ball falls and restitution² k while it rises, with smooth passages
    between the two and at the floor, so that the ball leaves with restitution times its speed.

    Attributes:
        restitution: speed after over speed before, in the limit of small widths.
        k: stiffness per mass on the way in, 1/s².
        eps: width in height over which the spring sets in, m.
        slow: width in velocity over which the way in passes into the way out, m/s.

    Source: the latching spring of Walton and Braun (1986), smoothed.
    """

    restitution: Any
    k: Any
    eps: Any
    slow: Any

    def acceleration(self, y, v, free, contact, r):
        """Gravity, control and the spring; the decision is not used."""
        depth = self.eps * jax.nn.softplus(-y / self.eps)
        share = self.restitution**2
        return free + self.k * depth * (share + (1 - share) * jax.nn.sigmoid(-v / self.slow))

    def move(self, motion: Motion) -> Moved:
        """One step of the scheme under this force; the contact decision is only recorded."""

        def pull(y, v, contact):
            return self.acceleration(y, v, motion.free, contact, motion.rounding)

        push = Push(motion.judge, pull, motion.policy, motion.told, motion.history)
        made = motion.integrator.push(push, motion.y, motion.v, motion.carried, motion.rounding)
        left = jnp.maximum(-made.y, 0)
        return Moved(made.y, made.v, made.a, Record(made.height, made.contact, left, made.solve))


@dataclass(frozen=True)
class SoftFloor(BallMethod):
    """The derivative of a program with a soft floor: softplus contact, softened restitution.

    Attributes:
        eps: width, m. Small: near the given program, with derivatives that peak at its contacts. Large: a
            tame derivative, of something else. None for one that suits the problem: a tenth of the depth to
            which a penalty gives way, and for an impact the narrowest floor that the step resolves.
    """

    eps: float | None = None

    name = "smoothed"
    kind = "other program"
    description = (
        "the derivative of another program, whose floor acts over a width eps; its loss is another too"
    )

    def __call__(self, problem: Problem, names: Sequence[str]) -> Gradient:
        """The derivative, by reverse mode, of the smooth program; the value is its loss.

        Raises:
            InputError: eps is not positive, or a parameter that the smooth program does not have.

        Error: rounding; as a derivative of the given program a bias that shrinks with eps only where that
        program has a derivative.
        """
        eps = _suitable(problem) if self.eps is None else self.eps
        if not eps > 0:
            raise InputError(f"eps is {eps}", remedy="Choose a width above 0.", where="eps")
        soft = softened(problem, eps)
        # the soft floor's own stiffness and width are not what these names mean in the given program
        theirs = [name for name in names if name in START or problem.world.has(name)]
        own = (
            ()
            if isinstance(problem.world.contact, Penalty)
            else ("k", "eps", "alpha", "tol", "enter", "rest_speed")
        )
        here = [name for name in theirs if name not in own]
        problem.values(names)
        value, slopes, marks = scaled(soft, here)
        depends, why = used(soft, here, slopes, marks=marks)
        for name in names:
            if name not in here:
                slopes[name], depends[name] = 0.0, False
                why[name] = f"the smooth program has no {name}"
        hard = problem.value()
        details = {"eps": eps, "loss_of_the_given_program": hard, "bias_of_the_loss": value - hard}
        return self.result(value, slopes, Used(depends, why), details)


def softened(problem: Problem, eps: float) -> Problem:
    """The problem with a soft floor: a softplus penalty, or a spring that an impact sinks into by about eps.

    Raises:
        InputError: the ball would pass so narrow a floor in a few steps.
    """
    world = problem.world
    contact, dtype = world.contact, world.policy.dtype("arithmetic")
    width = jnp.asarray(eps, dtype)
    if isinstance(contact, Penalty):
        return replace(problem, world=replace(world, contact=replace(contact, eps=width, smooth=True)))
    speed = _speed(problem)
    # a spring of this stiffness stops a ball of this speed within eps
    rate, h = speed / eps, float(world.integrator.h)
    if h * rate * _RESOLVED > 1.001:
        raise InputError(
            f"a floor of width {eps:g} m acts for {1 / rate:.3g} s; a step of {h:g} s does not resolve it",
            remedy=f"Choose eps of at least {_RESOLVED * speed * h:.2g} or a shorter step.",
            where="eps",
        )
    soft = SoftImpact(
        contact.restitution,  # type: ignore[attr-defined]
        *(jnp.asarray(value, dtype) for value in (rate**2, eps / 4, speed / 20)),
    )
    scheme = (
        VelocityVerlet(world.integrator.h) if isinstance(world.integrator, EventLocated) else world.integrator
    )
    return replace(problem, world=replace(world, contact=soft, integrator=scheme))


def _speed(problem: Problem) -> float:
    """With which a ball of this problem arrives at the floor, m/s; 1 where none falls."""
    height = max(float(np.max(np.asarray(problem.y0, np.float64))), 0.0)
    square = float(np.max(np.asarray(problem.v0, np.float64) ** 2))
    return float(np.sqrt(square + 2 * abs(float(problem.world.gravity)) * height)) or 1.0


def _suitable(problem: Problem) -> float:
    contact = problem.world.contact
    if isinstance(contact, Penalty):
        return 0.1 * _speed(problem) / float(np.sqrt(float(contact.k)))
    return _RESOLVED * _speed(problem) * float(problem.world.integrator.h)


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

    def __call__(self, problem: Problem, names: Sequence[str]) -> Gradient:
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
