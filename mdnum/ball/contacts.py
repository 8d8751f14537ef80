"""Contact models: a force (penalty), an iterated constraint (projection), an instant (impact)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from mdnum.ball.integrators import Balls, EventLocated, Push, Rounding, Scheme
from mdnum.ball.state import BallRecord, Reason, Solve
from mdnum.ball.stopping import StopRule, elementwise, iterate, no_solve
from mdnum.numerics.roles import RolePrecision


class Motion(NamedTuple):
    """What a contact model is given for one step.

    Attributes:
        y, v, carried: height, velocity and the acceleration that velocity Verlet carries, in the dtype of
            arithmetic.
        free: acceleration without contact (control minus gravity), shape (balls,).
        judge: the contact decision at a height: the world's own, or what was imposed.
        imposed: iterations that are imposed, or None.
        integrator, policy, rounding: of the world.
        history: whether solvers keep the residual of every decision.
    """

    y: Balls
    v: Balls
    carried: Balls
    free: Balls
    judge: Callable[[Balls], Bool[Array, "balls"]]
    imposed: Int[Array, "..."] | None
    integrator: Scheme
    policy: RolePrecision
    rounding: Rounding
    history: bool


class Moved(NamedTuple):
    """The next height, velocity and carried acceleration, and the record of how they came about."""

    y: Balls
    v: Balls
    a: Balls
    record: BallRecord


class Contact(Protocol):
    """What happens at the floor."""

    def move(self, motion: Motion) -> Moved:
        """One step."""
        ...

    def acceleration(
        self, y: Balls, v: Balls, free: Balls, contact: Bool[Array, "balls"], r: Rounding
    ) -> Balls:
        """Acceleration of a state, for schemes that carry it."""
        ...


class Penalty(eqx.Module):
    """Force k p - damping v on a ball in contact, with p = -y; k p with a softplus p when smooth.

    A step on which a contact is imposed pushes with -k y whatever the sign of y: the branch continues
    smoothly beyond its threshold, as a pair force beyond its cutoff does when it is imposed.

    Attributes:
        k: stiffness per mass, 1/s².
        damping: per mass, 1/s; the force may pull while the ball leaves.
        eps: width of the softplus, m, where `smooth`.
        smooth: p = eps softplus(-y/eps) for every height; the decision is recorded and not acted on, except
            by the damping.

    Source: the soft contact of the discrete element method (Cundall and Strack 1979).
    """

    k: Any
    damping: Any = 0.0
    eps: Any = 0.0
    smooth: bool = eqx.field(static=True, default=False)

    def depth(self, y, contact):
        """Penetration p, m."""
        if self.smooth:
            return self.eps * jax.nn.softplus(-y / self.eps)
        return jnp.where(contact, -y, jnp.zeros_like(y))

    def acceleration(self, y, v, free, contact, r):
        """Control, gravity, spring and damper."""
        drag = jnp.where(contact, r(self.damping * v), jnp.zeros_like(v))
        return r(free + r(r(self.k * self.depth(y, contact)) - drag))

    def move(self, motion: Motion) -> Moved:
        """One step of the scheme under this force."""
        r = motion.rounding

        def pull(y, v, contact):
            return self.acceleration(y, v, motion.free, contact, r)

        push = Push(motion.judge, pull, motion.policy, motion.imposed, motion.history)
        made = motion.integrator.push(push, motion.y, motion.v, motion.carried, r)
        left = self.depth(made.y, made.y < 0)
        record = BallRecord(made.height, made.contact, left, made.solve)
        return Moved(made.y, made.v, made.a, record)


class Projection(eqx.Module):
    """y ← y + alpha k p with p = max(0, -y) until the rule stops it; then the clamp, and restitution.

    Each iteration leaves 1 - alpha k of the penetration, so tol is reached after
    ceil(log(tol / p0) / log(1 - alpha k)) iterations; alpha k in (1, 2) overshoots, at 2 it never ends.
    The floor is at 0 whatever k is: where the iterations end depends on k only through what they leave.

    Attributes:
        k: gain, dimensionless; what is learned in place of a stiffness.
        alpha: relaxation, dimensionless.
        restitution: speed after over speed before; the velocity is reset at the end of the step.
        stop: when the iteration stops.
        derivative: None for the derivative of the iterations that ran; else an object whose
            `attach(y, gain, contact)` gives the result another one.
    """

    k: Any
    alpha: Any
    stop: StopRule
    restitution: Any = 0.8
    derivative: Any = None

    def acceleration(self, y, v, free, contact, r):
        """There is no contact force."""
        return free

    def move(self, motion: Motion) -> Moved:
        """Flight, and the projection back where it ends below the floor."""
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


class Impact(eqx.Module):
    """v ← -restitution v at the floor.

    With an event-located step the impact happens at its exact time, and the rest of the step flies on from
    there; with any other scheme the ball is put on the floor and reset at the end of the step in which it
    passed the floor, an error of order h in its state and of order 1 in its derivative.

    Attributes:
        restitution: speed after over speed before.
        rest_speed: a rebound at or below this speed, m/s, ends the bouncing (a ball that loses a share of
            its speed bounces infinitely often in a finite time).
    """

    restitution: Any = 0.8
    rest_speed: Any = 1e-6

    def acceleration(self, y, v, free, contact, r):
        """There is no contact force."""
        return free

    def move(self, motion: Motion) -> Moved:
        """Flight with the impacts of this step."""
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
    """The lowest height of the parabola over the given time: at its end, or at its vertex."""
    end = r(y + r(time * r(v + r(r(0.5 * time) * a))))
    up = (a > 0) & (v < 0) & (r(-v) < r(a * time))
    safe = jnp.where(up, a, jnp.ones_like(a))
    return jnp.where(up, r(y - r(r(v * v) / r(2.0 * safe))), end)


def time_of_impact(y, v, a, r):
    """The first time at which the parabola meets the floor, s; infinite where it never does.

    Error: a few units roundoff relative; of the two forms of the root the one without cancellation is used.
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
