"""Integrators that move the box, as another package would bring them."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mdnum.md.cell import transformed
from mdnum.md.integrators import Integrator, quantity


class Drifting(Integrator):
    """Velocity Verlet."""

    name = "drifting"

    def finish(self, v, extra, at, time):
        return v + time * at.acceleration, extra

    def begin(self, x, v, extra, at):
        v = v + (0.5 * self.timestep).astype(v.dtype) * at.acceleration
        return x + self.timestep.astype(x.dtype) * v.astype(x.dtype), v, extra, jnp.zeros(())


class Strained(Drifting):
    """A box that is strained by a schedule, and all positions with it."""

    name = "strained"
    stretch: Float[Array, ""] = quantity("rate")  # of every lattice vector along itself
    shear: Float[Array, ""] = quantity("rate")  # of x into y, and half as much of y into -z, of z into x

    def deform(self, v, extra, at):
        turned = jnp.zeros((3, 3)).at[0, 1].set(1.0).at[1, 2].set(-0.5).at[2, 0].set(0.5)
        # all of it turns round after 50 steps
        way = jnp.where(at.step % 100 < 50, 1.0, -1.0) * self.timestep
        return jnp.eye(3) + way * (self.stretch * jnp.eye(3) + self.shear * turned), v, extra


class Forgetful(Strained):
    """The same; of its own class, so that it is compiled on its own."""

    name = "forgetful"


class Resting(Strained):
    """The box is strained around atoms that it does not take along."""

    name = "resting"

    def begin(self, x, v, extra, at):
        x, v, extra, heat = super().begin(x, v, extra, at)
        return transformed(x, jnp.linalg.inv(self.deform(v, extra, at)[0])), v, extra, heat


class Flat(Drifting):
    """Strained in the plane alone, so that a box without a lattice vector along z has no part of it."""

    name = "flat"
    stretch: Float[Array, ""] = quantity("rate")
    shear: Float[Array, ""] = quantity("rate")

    def deform(self, v, extra, at):
        plane = jnp.diag(jnp.array([1.0, 1.0, 0.0])) * self.stretch
        return jnp.eye(3) + self.timestep * plane.at[0, 1].set(self.shear), v, extra


class Pressed(Drifting):
    """A box that follows the pressure, with velocities scaled the other way and what it did in its state."""

    name = "pressed"
    pressure: Any = eqx.field(default=None)  # energy/length³
    stiffness: Any = eqx.field(default=None)  # how fast it follows, length³/energy/time

    def init(self, x, v, masses):
        return jnp.zeros(())

    def deform(self, v, extra, at):
        volume = jnp.abs(jnp.linalg.det(at.cell.matrix))
        pressure = (2 * self.kinetic(v, at.masses) + at.virial) / (3 * volume)
        growth = self.timestep * self.stiffness * (pressure - self.pressure)
        return (1 + growth) * jnp.eye(3), v / (1 + growth).astype(v.dtype), extra + growth


class Piston(Integrator):
    """A box of inertia against an outer pressure (Andersen), in the splitting of Tuckerman et al. 2006."""

    name = "piston"
    pressure: Any = eqx.field(default=None)  # energy/length³
    inertia: Any = eqx.field(default=None)  # energy time²

    def init(self, x, v, masses):
        return jnp.zeros(())

    def push(self, v, rate, at, time):
        volume = jnp.abs(jnp.linalg.det(at.cell.matrix))
        excess = (2 + 2 / at.masses.shape[0]) * self.kinetic(v, at.masses) + at.virial
        return rate + time * (excess - 3 * volume * self.pressure) / self.inertia

    def kick(self, v, rate, at, time):
        slow = jnp.exp(-0.5 * (1 + 1 / at.masses.shape[0]) * rate * time)
        return slow * (slow * v + time * at.acceleration)

    def finish(self, v, extra, at, time):
        v = self.kick(v, extra, at, time)
        return v, self.push(v, extra, at, time)

    def begin(self, x, v, extra, at):
        rate = self.push(v, extra, at, 0.5 * self.timestep)
        v = self.kick(v, rate, at, 0.5 * self.timestep)
        return x + self.timestep * jnp.exp(-0.5 * self.timestep * rate) * v, v, rate, jnp.zeros(())

    def deform(self, v, extra, at):
        return jnp.exp(self.timestep * extra) * jnp.eye(3), v, extra


class Sheared(Pressed):
    """A box that follows the whole stress."""

    name = "sheared"

    @property
    def anisotropic(self):
        return True

    def deform(self, v, extra, at):
        volume = jnp.abs(jnp.linalg.det(at.cell.matrix))
        stress = ((at.masses * v) @ v.T + at.tensor) / volume
        return jnp.eye(3) + self.timestep * self.stiffness * (stress - self.pressure * jnp.eye(3)), v, extra
