"""A time step of the bouncing ball: integration schemes and contact models.

Each integration scheme decides contact from one height, and records this height. Products are rounded before
they are added, so that numpy reproduces every bit of the results.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from mdnum.ball.stopping import Maximum, Reason, Solve, StopRule, elementwise, iterate, no_solve
from mdnum.numerics.exact import fence
from mdnum.numerics.roles import RolePrecision

Balls = Float[Array, "balls"]
Touching = Bool[Array, "balls"]


class BallState(NamedTuple):
    """State of all balls between two time steps."""

    step: Int[Array, ""]  # number of steps made
    y: Float[Array, "balls"]  # heights above the floor, m, shape (balls,)
    v: Float[Array, "balls"]  # velocities, upward positive, m/s, shape (balls,)
    # accelerations that velocity Verlet carries from one step to the next, m/s², shape (balls,)
    a: Float[Array, "balls"]
    # the contact decision of the step before, shape (balls,); what hysteresis looks back to
    touching: Bool[Array, "balls"]


class BallDecisions(NamedTuple):
    """All decisions of a time step. Decisions are imposed on a step in the same format."""

    # whether each ball is in contact, shape (balls,). Integers may be imposed instead: 0 or 1, and a negative
    # number where the step is to decide by itself
    contact: Bool[Array, "balls"] | Int[Array, "balls"]
    # iterations of the step's solver, shape () where one rule stops it for all balls, (balls,) where each
    # ball has its own; impacts located in the step for an event-located one. A negative number, imposed,
    # leaves it to the step
    iterations: Int[Array, "..."]


class BallRecord(NamedTuple):
    """Record of one time step: height, contact decision, remaining penetration and solver iterations."""

    height: Float[Array, "balls"]  # what the contact decision compared with zero, m, shape (balls,)
    contact: Bool[Array, "balls"]  # the decision, shape (balls,)
    # penetration that the contact model left, m, shape (balls,); carries derivatives
    left: Float[Array, "balls"]
    solve: Solve  # of the step's solver

    @property
    def decisions(self) -> BallDecisions:
        """The decisions of the step, which can be imposed on another step."""
        return BallDecisions(self.contact, self.solve.iterations)


class Rounding(eqx.Module):
    """Function that forces the compiler to round a value."""

    zero: Int[Array, ""]  # an integer zero that the compiler must not know (see mdnum.numerics.exact)

    def __call__(self, x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Return x, rounded to its dtype before it is used."""
        return fence(x, self.zero)


class Motion(NamedTuple):
    """Data that a contact model needs for one time step."""

    # y, v, carried: height, velocity and the acceleration that velocity Verlet carries, in the dtype of
    # arithmetic
    y: Balls
    v: Balls
    carried: Balls
    free: Balls  # acceleration without contact (control minus gravity), shape (balls,)
    touching: Touching  # the contact decision of the step before
    # the contact decision at a height: the world's own, or what was imposed
    judge: Callable[[Balls], Touching]
    imposed: Int[Array, "..."] | None  # iterations that are imposed, or None
    # integrator, policy, rounding: of the world
    integrator: Scheme
    policy: RolePrecision
    rounding: Rounding
    history: bool  # whether solvers keep the residual of every decision


class Moved(NamedTuple):
    """Result of a time step."""

    y: Balls
    v: Balls
    a: Balls
    record: BallRecord


#: Function that returns the acceleration from height, velocity and contact decision.
Pull = Callable[[Balls, Balls, Touching], Balls]


# --- schemes --------------------------------------------------------------------------------------------


class Scheme(Protocol):
    """Base class of the integration schemes."""

    h: Any  # time step, s

    def fly(self, y: Balls, v: Balls, a: Balls, r: Rounding) -> tuple[Balls, Balls]:
        """Advance height and velocity by one time step under a constant acceleration."""
        ...

    def push(self, pull: Pull, motion: Motion) -> Moved:
        """Make one time step with a contact force. The remaining penetration is not recorded yet."""
        ...


def _pushed(y, v, a, height, contact, solve=None, *, policy: RolePrecision) -> Moved:
    solve = no_solve(policy.dtype("decision")) if solve is None else solve
    return Moved(y, v, a, BallRecord(height, contact, jnp.zeros_like(y), solve))


class _Euler(eqx.Module):
    h: Any

    def push(self, pull, motion):
        """Make one time step with a contact force. The height before the step decides contact."""
        y, v = motion.y, motion.v
        contact = motion.judge(y)
        a = pull(y, v, contact)
        return _pushed(*self.fly(y, v, a, motion.rounding), a, y, contact, policy=motion.policy)  # type: ignore[attr-defined]


class ExplicitEuler(_Euler):
    """Explicit Euler (y += h v; v += h a(y)), of order 1. A stiff contact adds energy at any time step."""

    def fly(self, y, v, a, r):
        return r(y + r(self.h * v)), r(v + r(self.h * a))


class SemiImplicitEuler(_Euler):
    """Semi-implicit Euler (v += h a(y); y += h v): symplectic, of order 1, stable for h sqrt(k) < 2."""

    def fly(self, y, v, a, r):
        v = r(v + r(self.h * a))
        return r(y + r(self.h * v)), v


class BallVerlet(eqx.Module):
    """Velocity Verlet (kick, drift, kick): symplectic, order 2 between events, stable for h sqrt(k) < 2."""

    h: Any

    def _drift(self, y, v, a, r):
        half = r(0.5 * self.h)
        v = r(v + r(half * a))
        return r(y + r(self.h * v)), v, half

    def fly(self, y, v, a, r):
        y, v, half = self._drift(y, v, a, r)
        return y, r(v + r(half * a))

    def push(self, pull, motion):
        """Make one time step. The final height decides contact. Damping uses the half-step velocity."""
        r = motion.rounding
        y, v, half = self._drift(motion.y, motion.v, motion.carried, r)
        contact = motion.judge(y)
        a = pull(y, v, contact)
        return _pushed(y, r(v + r(half * a)), a, y, contact, policy=motion.policy)


class ImplicitMidpoint(eqx.Module):
    """Implicit midpoint scheme, solved by Newton's method. Order 2, and stable for any time step.

    The acceleration is evaluated in the middle of the time step. Derivatives are implicit derivatives of the
    solved equation, not derivatives of the iterations.
    """

    h: Any  # time step, s
    # when the solve ends; its residual is h times the error in the acceleration, m/s
    stop: StopRule = Maximum(1e-12, 50)

    def fly(self, y, v, a, r):
        half = r(0.5 * self.h)
        middle = r(v + r(half * a))
        return r(y + r(self.h * middle)), r(v + r(self.h * a))

    def push(self, pull, motion):
        """Make one time step with a contact force. The height in the middle of the step decides contact."""
        y, v, r, judge = motion.y, motion.v, motion.rounding, motion.judge
        half = r(0.5 * self.h)
        quarter = r(half * half)
        ahead = r(y + r(half * v))

        def middle(a):
            return r(ahead + r(quarter * a)), r(v + r(half * a))

        def defect(a, contact):
            return a - pull(*middle(a), contact)

        def newton(a, contact):
            value, slope = jax.jvp(lambda x: defect(x, contact), (a,), (jnp.ones_like(a),))
            return r(a - value / slope)

        free = pull(*middle(motion.carried), jnp.zeros(y.shape, bool))
        free = lax.stop_gradient(free)
        # which balls touch, and after how many iterations: decided without derivatives
        found, solve = iterate(
            self.stop,
            free,
            lambda a: lax.stop_gradient(newton(a, judge(middle(a)[0]))),
            lambda a: jnp.abs(self.h * defect(a, judge(middle(a)[0]))),
            motion.policy,
            r.zero,
            imposed=motion.imposed,
            history=motion.history,
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
        return _pushed(y, v, a, height, contact, solve, policy=motion.policy)


class EventLocated(eqx.Module):
    """Exact parabolic flight with computed times of all impacts. Only for the contact model `Impact`."""

    h: Any  # time step, s; the trajectory does not depend on it, only where it is looked at
    max_impacts: int = eqx.field(static=True, default=200)  # the cap on impacts inside one step

    def fly(self, y, v, a, r):
        drift = r(self.h * r(v + r(r(0.5 * self.h) * a)))
        return r(y + drift), r(v + r(self.h * a))

    def push(self, pull, motion):
        raise TypeError("the integrator event-located computes impacts, but no contact forces")


# --- contact models -------------------------------------------------------------------------------------


class Contact(Protocol):
    """Base class of the contact models."""

    def move(self, motion: Motion) -> Moved:
        """Make one time step with this contact model."""
        ...

    def acceleration(self, y: Balls, v: Balls, free: Balls, contact: Touching, r: Rounding) -> Balls:
        """Return the acceleration of each ball. Some schemes use this acceleration again in the next step."""
        ...


class _Forceless(eqx.Module):
    """A contact model that resets the state and does not exert a force."""

    def acceleration(self, y, v, free, contact, r):
        """Return the acceleration of free flight. This model has no contact force."""
        return free


class Penalty(eqx.Module):
    """Contact by a spring and a damper: the force is k p - damping v, where p is the depth below the floor.

    In a smooth contact, p is a softplus of -y (y: height). If contact is imposed, the force is -k y at any
    height y. The force thus continues smoothly above the floor.

    Source: soft contact of the discrete element method (Cundall and Strack 1979).
    """

    k: Any  # stiffness per mass, 1/s²
    damping: Any = 0.0  # per mass, 1/s; the force may pull while the ball leaves
    eps: Any = 0.0  # width of the softplus, m, where `smooth`
    # p = eps softplus(-y/eps) for every height; the decision is recorded and not acted on, except by the
    # damping
    smooth: bool = eqx.field(static=True, default=False)

    def depth(self, y, contact):
        """Return the penetration p of each ball, m."""
        if self.smooth:
            return self.eps * jax.nn.softplus(-y / self.eps)
        return jnp.where(contact, -y, jnp.zeros_like(y))

    def acceleration(self, y, v, free, contact, r):
        """Return the total acceleration from control, gravity, spring and damper."""
        drag = jnp.where(contact, r(self.damping * v), jnp.zeros_like(v))
        return r(free + r(r(self.k * self.depth(y, contact)) - drag))

    def move(self, motion: Motion) -> Moved:
        """Make one time step with the contact force of this model."""
        r = motion.rounding

        def pull(y, v, contact):
            return self.acceleration(y, v, motion.free, contact, r)

        made = motion.integrator.push(pull, motion)
        return made._replace(record=made.record._replace(left=self.depth(made.y, made.y < 0)))


class Projection(_Forceless):
    """Iterate y ← y + alpha k max(0, -y) until the stopping rule holds; then clamp y and apply restitution.

    Each iteration multiplies the penetration by 1 - alpha k. Hence p0 falls to tol after ceil(log(tol / p0) /
    log(1 - alpha k)) iterations. Iterations overshoot for alpha k between 1 and 2. For alpha k = 2,
    iterations never end. The floor is at 0 for any k. The value of k affects only the remaining penetration.
    """

    k: Any  # gain, dimensionless; what is learned in place of a stiffness
    alpha: Any  # relaxation, dimensionless
    stop: StopRule  # when the iteration stops
    restitution: Any = 0.8  # speed after over speed before; the velocity is reset at the end of the step
    # None for the derivative of the iterations that ran; else an object whose `attach(y, gain, contact)`
    # gives the result another one
    derivative: Any = None

    def move(self, motion: Motion) -> Moved:
        """Make one time step of free flight. A ball below the floor is then projected to the floor."""
        r, policy = motion.rounding, motion.policy
        height, v = motion.integrator.fly(motion.y, motion.v, motion.free, r)
        contact = motion.judge(height)
        history = motion.history

        def run(inputs, rest):
            y, gain = inputs
            touching, rule, imposed, rounding = rest

            def depth(y):
                return jnp.where(touching & (y < 0), -y, jnp.zeros_like(y))

            y, solve = iterate(
                rule,
                y,
                lambda y: rounding(y + rounding(gain * depth(y))),
                depth,
                policy,
                rounding.zero,
                imposed=imposed,
                history=history,
            )
            return (y,), solve

        gain = jnp.broadcast_to(r(self.alpha * self.k), height.shape)
        (y,), solve = elementwise(run)((height, gain), (contact, self.stop, motion.imposed, r))
        if self.derivative is not None:
            y = self.derivative.attach(y, gain, contact)
        left = jnp.where(contact & (y < 0), -y, jnp.zeros_like(y))
        y = jnp.where(contact & (y < 0), jnp.zeros_like(y), y)
        v = jnp.where(contact, r(-self.restitution * jnp.where(v < 0, v, jnp.zeros_like(v))), v)
        return Moved(y, v, motion.free, BallRecord(height, contact, left, solve))


class Impact(_Forceless):
    """Instantaneous impact: v ← -restitution v at the floor.

    With `EventLocated`, the impact takes place at its exact time. The flight then continues until the end of
    the step. With another scheme, a ball below the floor is put on the floor at the end of the step. The
    velocity of this ball is reset. Such a reset causes an error of order h in the state and of order 1 in the
    derivative.
    """

    restitution: Any = 0.8  # speed after over speed before
    # a rebound at or below this speed, m/s, ends the bouncing (a ball that loses a share of its speed bounces
    # infinitely often in a finite time)
    rest_speed: Any = 1e-6

    def move(self, motion: Motion) -> Moved:
        """Make one time step of flight, with all impacts during this step."""
        if isinstance(motion.integrator, EventLocated):
            return self._located(motion, motion.integrator)
        r = motion.rounding
        height, v = motion.integrator.fly(motion.y, motion.v, motion.free, r)
        contact = motion.judge(height)
        zero = jnp.zeros_like(height)
        rebound = r(-self.restitution * jnp.where(v < 0, v, zero))
        rests = contact & (rebound <= self.rest_speed)
        y = jnp.where(contact, zero, height)
        v = jnp.where(contact, jnp.where(rests, zero, rebound), v)
        solve = no_solve(motion.policy.dtype("decision"))
        reason = jnp.where(jnp.any(rests), Reason.REST.value, Reason.NONE.value).astype(jnp.int8)
        record = BallRecord(height, contact, zero, solve._replace(reason=reason))
        return Moved(y, v, motion.free, record)

    def _located(self, motion: Motion, scheme: EventLocated) -> Moved:
        r = motion.rounding
        h = jnp.broadcast_to(jnp.asarray(scheme.h, motion.y.dtype), motion.y.shape)
        height = lowest(motion.y, motion.v, motion.free, h, r)
        contact = motion.judge(height)

        def run(inputs, rest):
            y, v, a, left, restitution = inputs
            touching, rest_speed, imposed, rounding = rest
            count = jnp.zeros(y.shape, jnp.int32)
            still = jnp.zeros(y.shape, bool)

            def ahead(y, v, left, count, still):
                below = jnp.where(count == 0, touching, lowest(y, v, a, left, rounding) < 0)
                own = below & ~still & (count < scheme.max_impacts)
                return own if imposed is None else jnp.where(imposed < 0, own, (count < imposed) & ~still)

            def body(carry):
                y, v, left, count, still, hits = carry
                time = jnp.minimum(time_of_impact(y, v, a, rounding), left)
                speed = rounding(v + rounding(a * time))
                rebound = rounding(-restitution * speed)
                rests = hits & (rebound <= rest_speed) & (a <= 0)
                nothing = jnp.zeros_like(y)
                y = jnp.where(hits, nothing, y)
                v = jnp.where(hits, jnp.where(rests, nothing, rebound), v)
                left = jnp.where(hits, jnp.where(rests, nothing, rounding(left - time)), left)
                count = count + hits.astype(jnp.int32)
                still = still | rests
                return y, v, left, count, still, ahead(y, v, left, count, still)

            start = (y, v, left, count, still, ahead(y, v, left, count, still))
            y, v, left, count, still, _ = lax.while_loop(lambda carry: jnp.any(carry[5]), body, start)
            # impacts without end inside one step, cut off at the cap: what is left of it is no flight
            capped = (count >= scheme.max_impacts) & (lowest(y, v, a, left, rounding) < 0)
            rise = rounding(left * rounding(v + rounding(rounding(0.5 * left) * a)))
            y_end, v_end = rounding(y + rise), rounding(v + rounding(a * left))
            nothing = jnp.zeros_like(y)
            y = jnp.where(still | capped, nothing, y_end)
            v = jnp.where(still | capped, nothing, v_end)
            reason = jnp.where(still, Reason.REST.value, Reason.NONE.value)
            reason = jnp.where(capped, Reason.CAP.value, reason).astype(jnp.int8)
            return (y, v), (count, reason)

        restitution = jnp.broadcast_to(jnp.asarray(self.restitution, motion.y.dtype), h.shape)
        (y, v), (count, reason) = elementwise(run)(
            (motion.y, motion.v, motion.free, h, restitution),
            (contact, self.rest_speed, motion.imposed, r),
        )
        nothing = jnp.full(y.shape, jnp.nan, motion.policy.dtype("decision"))
        empty = jnp.zeros(0, nothing.dtype)
        solve = Solve(count, reason, nothing, nothing, nothing, empty)
        return Moved(y, v, motion.free, BallRecord(height, contact, jnp.zeros_like(y), solve))


def lowest(y, v, a, time, r):
    """Return the lowest height of a parabolic flight of given duration."""
    end = r(y + r(time * r(v + r(r(0.5 * time) * a))))
    up = (a > 0) & (v < 0) & (r(-v) < r(a * time))
    safe = jnp.where(up, a, jnp.ones_like(a))
    return jnp.where(up, r(y - r(r(v * v) / r(2.0 * safe))), end)


def time_of_impact(y, v, a, r):
    """Return the first time (s) at which a parabolic flight meets the floor, or infinity.

    The relative error is a few units of roundoff, because the formula avoids cancellation.
    """
    inside = r(r(v * v) - r(r(2.0 * a) * y))
    # the argument is masked as well, so that no derivative is taken where there is no root
    there = inside > 0
    root = jnp.sqrt(jnp.where(there, inside, jnp.ones_like(inside)))
    root = jnp.where(there, root, jnp.zeros_like(root))
    falling = v < 0
    below = jnp.where(falling, root - v, jnp.ones_like(v))
    down = jnp.where(falling | (a >= 0), jnp.ones_like(a), a)
    time = jnp.where(falling, r(2.0 * y) / below, (v + root) / -down)
    never = (~falling & (a >= 0)) | (inside < 0)
    return jnp.where(never, jnp.full_like(time, jnp.inf), time)
