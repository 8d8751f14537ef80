"""Contact as an instant: the velocity is reset, at the time of impact or at the end of the step."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from mdnum.ball.contacts.base import Motion, Moved
from mdnum.ball.elementwise import elementwise
from mdnum.ball.integrators import EventLocated
from mdnum.ball.solver import no_solve
from mdnum.ball.state import Reason, Record, Solve


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
        record = Record(height, contact, zero, solve._replace(reason=reason))
        return Moved(y, v, motion.free, record)

    def _located(self, motion: Motion, scheme: EventLocated) -> Moved:
        r = motion.rounding
        h = jnp.broadcast_to(jnp.asarray(scheme.h, motion.y.dtype), motion.y.shape)
        height = lowest(motion.y, motion.v, motion.free, h, r)
        contact = motion.judge(height)

        def run(inputs, rest):
            y, v, a, left, restitution = inputs
            touching, rest_speed, told, rounding = rest
            count = jnp.zeros(y.shape, jnp.int32)
            still = jnp.zeros(y.shape, bool)

            def ahead(y, v, left, count, still):
                below = jnp.where(count == 0, touching, lowest(y, v, a, left, rounding) < 0)
                own = below & ~still & (count < scheme.max_impacts)
                return own if told is None else jnp.where(told < 0, own, (count < told) & ~still)

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
            (contact, self.rest_speed, motion.told, r),
        )
        nothing = jnp.full(y.shape, jnp.nan, motion.policy.dtype("decision"))
        empty = jnp.zeros(0, nothing.dtype)
        solve = Solve(count, reason, nothing, nothing, nothing, empty)
        return Moved(y, v, motion.free, Record(height, contact, jnp.zeros_like(y), solve))


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
