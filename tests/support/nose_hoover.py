"""Integrators with a state of their own, as another package would bring them: a class each, no other edit."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mdnum.md.integrators import ByAtom, Integrator, quantity


class Link(NamedTuple):
    """The thermostat: its velocity, 1/time, and how far it has come."""

    velocity: Float[Array, ""]
    position: Float[Array, ""]


class NoseHoover(Integrator):
    """The canonical ensemble: a friction that follows the kinetic energy, on both sides of each half kick."""

    name = "one-link"
    kT: Float[Array, ""] = quantity("temperature")
    relaxation: Float[Array, ""] = quantity("time")

    def freedom(self, masses):
        """Degrees of freedom: the center of mass keeps its velocity."""
        return 3 * masses.shape[0] - 3

    def inertia(self, masses):
        """Of the link, energy x time²."""
        return self.freedom(masses) * self.kT * self.relaxation**2

    def init(self, x, v, masses):
        return Link(jnp.zeros(()), jnp.zeros(()))

    def rub(self, v, link, masses, time):
        """The thermostat for a time: half its own kick, the friction, half its own kick."""
        time = time.astype(jnp.float64)
        speed = link.velocity + 0.5 * time * self.pull(v, masses)
        v = v * jnp.exp(-speed * time).astype(v.dtype)
        position = link.position + time * speed
        return v, Link(speed + 0.5 * time * self.pull(v, masses), position)

    def pull(self, v, masses):
        """Acceleration of the link."""
        excess = 2 * self.kinetic(v, masses) - self.freedom(masses) * self.kT
        return excess / self.inertia(masses)

    def finish(self, v, extra, at, time):
        return self.rub(v + time * at.acceleration, extra, at.masses, time)

    def begin(self, x, v, extra, at):
        half = (0.5 * self.timestep).astype(v.dtype)
        v, link = self.rub(v, extra, at.masses, half)
        v = v + half * at.acceleration
        return x + self.timestep.astype(x.dtype) * v, v, link, jnp.zeros(())

    def exchanged(self, extra, at):
        inertia, freedom = self.inertia(at.masses), self.freedom(at.masses)
        return -(0.5 * inertia * extra.velocity**2 + freedom * self.kT * extra.position), 0.0


class Frictions(NamedTuple):
    """A friction for each component of each atom, and how often it has acted."""

    friction: ByAtom
    calls: Int[Array, ""]


class PerAtom(Integrator):
    """As `NoseHoover`, with a thermostat of unit inertia times kT relaxation² for each component."""

    name = "per-atom"
    kT: Float[Array, ""] = quantity("temperature")
    relaxation: Float[Array, ""] = quantity("time")

    def init(self, x, v, masses):
        return Frictions(ByAtom(masses * v**2 / self.kT / self.relaxation), jnp.zeros((), jnp.int64))

    def rub(self, v, extra, masses, time):
        """The thermostats for a time."""

        def pull(v):
            return (masses * v**2 - self.kT) / (self.kT * self.relaxation**2)

        friction = extra.friction.value + 0.5 * time * pull(v)
        v = v * jnp.exp(-friction * time)
        friction = friction + 0.5 * time * pull(v)
        return v, Frictions(ByAtom(friction), extra.calls + 1)

    def finish(self, v, extra, at, time):
        return self.rub(v + time * at.acceleration, extra, at.masses, time)

    def begin(self, x, v, extra, at):
        half = 0.5 * self.timestep
        v, extra = self.rub(v, extra, at.masses, half)
        v = v + half * at.acceleration
        return x + self.timestep * v, v, extra, jnp.zeros(())
