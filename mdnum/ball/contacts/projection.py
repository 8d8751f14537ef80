"""Contact as a constraint: a step that would end below the floor is iterated back to it."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mdnum.ball.contacts.base import Motion, Moved
from mdnum.ball.elementwise import elementwise
from mdnum.ball.solver import iterate
from mdnum.ball.state import Record
from mdnum.ball.stopping import StopRule


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
            touching, rule, told, rounding = rest

            def depth(y):
                return jnp.where(touching & (y < 0), -y, jnp.zeros_like(y))

            y, solve = iterate(
                rule,
                y,
                lambda y: rounding(y + rounding(gain * depth(y))),
                depth,
                policy,
                rounding.zero,
                told=told,
                history=history,
            )
            return (y,), solve

        gain = jnp.broadcast_to(r(self.alpha * self.k), height.shape)
        (y,), solve = elementwise(run)((height, gain), (contact, self.stop, motion.told, r))
        if self.derivative is not None:
            y = self.derivative.attach(y, gain, contact)
        left = jnp.where(contact & (y < 0), -y, jnp.zeros_like(y))
        y = jnp.where(contact & (y < 0), jnp.zeros_like(y), y)
        v = jnp.where(contact, r(-self.restitution * jnp.where(v < 0, v, jnp.zeros_like(v))), v)
        return Moved(y, v, motion.free, Record(height, contact, left, solve))
