"""The derivative of what a solver converges to, whatever iterations it took to get near it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float

from mdnum.ball.contacts import Projection
from mdnum.ball.gradients.base import Gradient, used
from mdnum.ball.gradients.unrolled import scaled
from mdnum.ball.problem import Problem
from mdnum.ball.stopping import Fixed
from mdnum.errors import InputError

#: Beyond this condition number the linear solve means nothing in float64.
LIMIT = 1e12


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


class FixedPoint(eqx.Module):
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
class Implicit:
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
    says = (
        "The derivative of the fixed point that the solver approaches, not of the iterations it took; "
        "a linear solve with a tolerance of its own."
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
        rule = FixedPoint(self.tolerance, self.regularization, self.max_iter, self.at_iterate)
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
        return Gradient(self.name, self.says, value, slopes, depends, why, details)


def _with_contact(problem: Problem, contact: Any) -> Problem:
    return replace(problem, world=replace(problem.world, contact=contact))
