"""Integrators with one decision point a step: what happens between one force evaluation and the next.

A step is: forces at x_s, second half kick to v_s, first half kick, then `drift` to x_{s+1}. The state
between steps is (x_{s+1}, half-kicked v), so a list that is used up is replaced before its forces are asked
for, and a rollout can stop and resume at that point without evaluating anything twice.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

import mdnum.numerics  # noqa: F401 (float64 must be on before the first array exists)


class Integrator(eqx.Module):
    """How positions and half-kicked velocities get to the next force evaluation."""

    name: ClassVar[str]
    timestep: Float[Array, ""]

    def kick(
        self,
        v: Float[Array, "3 atoms"],
        time: Float[Array, ""],
        acceleration: Float[Array, "3 atoms"],
        masses: Float[Array, "atoms"],
    ) -> Float[Array, "3 atoms"]:
        """Velocities after an acceleration has acted for a time."""
        return v + time * acceleration

    def kinetic(self, v: Float[Array, "3 atoms"], masses: Float[Array, "atoms"]) -> Float[Array, ""]:
        """Kinetic energy."""
        speed2 = jnp.sum(jnp.square(v.astype(jnp.float64)), axis=0)
        return 0.5 * jnp.sum(masses * speed2)

    @abstractmethod
    def drift(
        self,
        x: Float[Array, "3 atoms"],
        v: Float[Array, "3 atoms"],
        masses: Float[Array, "atoms"],
        step: Int[Array, ""],
        order: Int[Array, "atoms"],
    ) -> tuple[Float[Array, "3 atoms"], Float[Array, "3 atoms"], Float[Array, ""]]:
        """Positions and velocities before the next force evaluation, and the heat taken up, energy.

        Args:
            x, v: sorted positions and velocities after the first half kick.
            masses: sorted masses.
            step: the step that has just been evaluated.
            order: sorted atom k is atom order[k]; noise belongs to the atom, not to its place.
        """


class VelocityVerlet(Integrator):
    """NVE. Symplectic and time-reversible in exact arithmetic; local error O(dt³)."""

    name = "nve"

    def drift(self, x, v, masses, step, order):
        return x + self.timestep.astype(x.dtype) * v, v, jnp.zeros((), jnp.float64)


class Langevin(Integrator):
    """BAOAB (Leimkuhler & Matthews 2013): drift, exact Ornstein-Uhlenbeck step, drift.

    Noise comes from a counter-based key folded with the step, so two runs can share it and a resumed run
    continues it.
    """

    name = "langevin"
    friction: Float[Array, ""]  # 1/time
    kT: Float[Array, ""]  # temperature as an energy
    key: Array  # counter-based random key

    def drift(self, x, v, masses, step, order):
        half = (0.5 * self.timestep).astype(x.dtype)
        x = x + half * v
        decay = jnp.exp(-self.friction * self.timestep)
        spread = jnp.sqrt(self.kT * (1 - decay * decay) / masses.astype(jnp.float64))
        noise = jax.random.normal(jax.random.fold_in(self.key, step), x.shape, jnp.float64)[:, order]
        kicked = (decay * v.astype(jnp.float64) + spread * noise).astype(v.dtype)
        heat = 0.5 * jnp.sum(
            masses.astype(jnp.float64)
            * (jnp.square(kicked.astype(jnp.float64)) - jnp.square(v.astype(jnp.float64)))
        )
        return x + half * kicked, kicked, heat
