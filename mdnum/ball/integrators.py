"""One step of flight, and one step with a contact force: the schemes as objects.

Every scheme says at which height the contact decision is made; the record holds that height. All products
are rounded before they are added (no fused multiply-add), so numpy in the same dtype has the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from mdnum.ball.state import Solve
from mdnum.ball.stopping import Maximum, StopRule, iterate, no_solve
from mdnum.numerics.exact import fence
from mdnum.numerics.roles import RolePrecision

Balls = Float[Array, "balls"]


class Rounding(eqx.Module):
    """Rounds a product (or anything) before it is used: the fence, with the zero it needs.

    Attributes:
        zero: an integer zero that the compiler must not know (see mdnum.numerics.exact).
    """

    zero: Int[Array, ""]

    def __call__(self, x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """x, rounded here."""
        return fence(x, self.zero)


class Push(NamedTuple):
    """A contact that acts through a force, as a scheme sees it.

    Attributes:
        judge: the contact decision at a height.
        pull: acceleration from height, velocity and the decision.
        policy: dtype by role.
        imposed: iterations that an implicit scheme makes instead of its own number.
        history: whether residuals are kept.
    """

    judge: Callable[[Balls], Bool[Array, "balls"]]
    pull: Callable[[Balls, Balls, Bool[Array, "balls"]], Balls]
    policy: RolePrecision
    imposed: Int[Array, "..."] | None
    history: bool


class Pushed(NamedTuple):
    """What a step with a contact force gives: the state, and what was decided at which height."""

    y: Balls
    v: Balls
    a: Balls
    height: Balls
    contact: Bool[Array, "balls"]
    solve: Solve


class Scheme(Protocol):
    """The contract of a scheme.

    Attributes:
        h: time step, s.
    """

    h: Any

    def fly(self, y: Balls, v: Balls, a: Balls, r: Rounding) -> tuple[Balls, Balls]:
        """One step under a constant acceleration."""
        ...

    def push(self, push: Push, y: Balls, v: Balls, carried: Balls, r: Rounding) -> Pushed:
        """One step under a contact force."""
        ...


class ExplicitEuler(eqx.Module):
    """y += h v; v += h a(y), both from the old state. Order 1; a stiff contact gains energy at any step."""

    h: Any

    def fly(self, y, v, a, r):
        """One step under a constant acceleration."""
        return r(y + r(self.h * v)), r(v + r(self.h * a))

    def push(self, push, y, v, carried, r):
        """The decision is made at the old height."""
        contact = push.judge(y)
        a = push.pull(y, v, contact)
        return Pushed(*self.fly(y, v, a, r), a, y, contact, no_solve(push.policy.dtype("decision")))


class SemiImplicitEuler(eqx.Module):
    """v += h a(y); y += h v with the new velocity. Order 1, symplectic; stable for h sqrt(k) < 2."""

    h: Any

    def fly(self, y, v, a, r):
        """One step under a constant acceleration."""
        v = r(v + r(self.h * a))
        return r(y + r(self.h * v)), v

    def push(self, push, y, v, carried, r):
        """The decision is made at the old height."""
        contact = push.judge(y)
        a = push.pull(y, v, contact)
        return Pushed(*self.fly(y, v, a, r), a, y, contact, no_solve(push.policy.dtype("decision")))


class BallVerlet(eqx.Module):
    """Half kick, drift, force, half kick. Order 2 between events, symplectic; stable for h sqrt(k) < 2."""

    h: Any

    def _drift(self, y, v, a, r):
        half = r(0.5 * self.h)
        v = r(v + r(half * a))
        return r(y + r(self.h * v)), v, half

    def fly(self, y, v, a, r):
        """One step under a constant acceleration."""
        y, v, half = self._drift(y, v, a, r)
        return y, r(v + r(half * a))

    def push(self, push, y, v, carried, r):
        """The decision is made at the new height; a damping force sees the velocity of the half step."""
        y, v, half = self._drift(y, v, carried, r)
        contact = push.judge(y)
        a = push.pull(y, v, contact)
        return Pushed(y, r(v + r(half * a)), a, y, contact, no_solve(push.policy.dtype("decision")))


class ImplicitMidpoint(eqx.Module):
    """The acceleration of the middle of the step, found by Newton's method. Order 2, stable at any step.

    The derivative is the implicit one: of the equation that the solve ends at, not of its iterations.

    Attributes:
        h: time step, s.
        stop: when the solve ends; its residual is h times the error in the acceleration, m/s.
    """

    h: Any
    stop: StopRule = Maximum(1e-12, 50)

    def fly(self, y, v, a, r):
        """One step under a constant acceleration."""
        half = r(0.5 * self.h)
        middle = r(v + r(half * a))
        return r(y + r(self.h * middle)), r(v + r(self.h * a))

    def push(self, push, y, v, carried, r):
        """The decision is made at the height of the middle of the step."""
        half = r(0.5 * self.h)
        quarter = r(half * half)
        ahead = r(y + r(half * v))

        def middle(a):
            return r(ahead + r(quarter * a)), r(v + r(half * a))

        def defect(a, contact):
            return a - push.pull(*middle(a), contact)

        def newton(a, contact):
            value, slope = jax.jvp(lambda x: defect(x, contact), (a,), (jnp.ones_like(a),))
            return r(a - value / slope)

        free = push.pull(*middle(carried), jnp.zeros(y.shape, bool))
        free = lax.stop_gradient(free)
        judge = push.judge
        # which balls touch, and after how many iterations: decided without derivatives
        found, solve = iterate(
            self.stop,
            free,
            lambda a: lax.stop_gradient(newton(a, judge(middle(a)[0]))),
            lambda a: jnp.abs(self.h * defect(a, judge(middle(a)[0]))),
            push.policy,
            r.zero,
            imposed=push.imposed,
            history=push.history,
        )
        contact = judge(middle(found)[0])
        # the same iterations under the decision that was reached: as a step under imposed decisions
        count = solve.iterations

        def body(carry):
            a, n = carry
            return jnp.where(n < count, lax.stop_gradient(newton(a, contact)), a), n + 1

        a, _ = lax.while_loop(lambda carry: jnp.any(carry[1] < count), body, (free, jnp.zeros((), jnp.int32)))
        a = lax.stop_gradient(a)
        # one more Newton step has the derivative of the equation; its value is taken off again
        _, slope = jax.jvp(lambda x: defect(x, contact), (a,), (jnp.ones_like(a),))
        more = -defect(a, contact) / lax.stop_gradient(slope)
        a = a + (more - lax.stop_gradient(more))
        height, _ = middle(a)
        y, v = self.fly(y, v, a, r)
        return Pushed(y, v, a, height, contact, solve)


class EventLocated(eqx.Module):
    """Flight along the exact parabola, with every impact located inside the step. For impacts only.

    Attributes:
        h: time step, s; the trajectory does not depend on it, only where it is looked at.
        max_impacts: the cap on impacts inside one step.
    """

    h: Any
    max_impacts: int = eqx.field(static=True, default=200)

    def fly(self, y, v, a, r):
        """One step under a constant acceleration."""
        drift = r(self.h * r(v + r(r(0.5 * self.h) * a)))
        return r(y + drift), r(v + r(self.h * a))

    def push(self, push, y, v, carried, r):
        """Not for forces; refused before anything runs."""
        raise TypeError("an event-located step has no contact force")
