"""Derivatives of a ball with another contact: of the fixed point of a solver, and of a soft floor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float

from mdnum.ball.problem import START, BallProblem
from mdnum.ball.step import BallVerlet, EventLocated, Motion, Moved, Penalty, Projection
from mdnum.ball.stopping import FixedCount
from mdnum.errors import InputError
from mdnum.gradients.ball import BallMethod, Used, scaled, used
from mdnum.gradients.problem import Gradient

#: Beyond this condition number the linear solve means nothing in float64.
LIMIT = 1e12
#: Steps that the soft floor of an impact must act for.
_RESOLVED = 10


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

    def __call__(self, problem: BallProblem, names: Sequence[str]) -> Gradient:
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
        ideal = _with_contact(problem, replace(contact, stop=FixedCount(0), derivative=_Settled()))
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


def _with_contact(problem: BallProblem, contact: Any) -> BallProblem:
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

        made = motion.integrator.push(pull, motion)
        return made._replace(record=made.record._replace(left=jnp.maximum(-made.y, 0)))


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

    def __call__(self, problem: BallProblem, names: Sequence[str]) -> Gradient:
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


def softened(problem: BallProblem, eps: float) -> BallProblem:
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
        BallVerlet(world.integrator.h) if isinstance(world.integrator, EventLocated) else world.integrator
    )
    return replace(problem, world=replace(world, contact=soft, integrator=scheme))


def _speed(problem: BallProblem) -> float:
    """With which a ball of this problem arrives at the floor, m/s; 1 where none falls."""
    height = max(float(np.max(np.asarray(problem.y0, np.float64))), 0.0)
    square = float(np.max(np.asarray(problem.v0, np.float64) ** 2))
    return float(np.sqrt(square + 2 * abs(float(problem.world.gravity)) * height)) or 1.0


def _suitable(problem: BallProblem) -> float:
    contact = problem.world.contact
    if isinstance(contact, Penalty):
        return 0.1 * _speed(problem) / float(np.sqrt(float(contact.k)))
    return _RESOLVED * _speed(problem) * float(problem.world.integrator.h)
