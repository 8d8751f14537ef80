"""Contact as a force: a spring that pushes while the ball is below the floor."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mdnum.ball.contacts.base import Motion, Moved
from mdnum.ball.integrators import Push
from mdnum.ball.state import Record


class Penalty(eqx.Module):
    """Force k p - damping v on a ball in contact, with p = -y; k p with a softplus p when smooth.

    A step that is told of a contact pushes with -k y whatever the sign of y: the branch goes on smoothly
    beyond its threshold, as a pair force beyond its cutoff does when it is told to.

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

        push = Push(motion.judge, pull, motion.policy, motion.told, motion.history)
        made = motion.integrator.push(push, motion.y, motion.v, motion.carried, r)
        left = self.depth(made.y, made.y < 0)
        record = Record(made.height, made.contact, left, made.solve)
        return Moved(made.y, made.v, made.a, record)
