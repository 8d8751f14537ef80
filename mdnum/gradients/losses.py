"""Losses of a trajectory, evaluated frame by frame: the trajectory is never stored whole.

A loss looks at some frames, each together with the first, adds up what it sees, and makes a number of the
sums. That is enough for averages, correlations with the start and histograms, and its derivative needs one
frame at a time too.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mdnum.errors import InputError


class Frame(NamedTuple):
    """One step as a loss sees it, atoms in the user's order.

    Attributes:
        step: its number.
        x: positions as if the box had no faces, length, shape (3, atoms).
        v: velocities, length per internal time, shape (3, atoms).
        potential: potential energy.
        virial: sum over pairs of r_ij · F_ij, energy.
    """

    step: Int[Array, ""]
    x: Float[Array, "3 atoms"]
    v: Float[Array, "3 atoms"]
    potential: Float[Array, ""]
    virial: Float[Array, ""]


class Surroundings(NamedTuple):
    """What does not change along a run.

    Attributes:
        masses: shape (atoms,).
        matrix: lattice vectors as rows, length, shape (3, 3).
        volume: of the box, length³; 0 without one.
        kB: Boltzmann's constant in the units of the run.
    """

    masses: Float[Array, "atoms"]
    matrix: Float[Array, "3 3"]
    volume: Float[Array, ""]
    kB: Float[Array, ""]


class Loss(eqx.Module):
    """A number made of the frames of a trajectory.

    Attributes:
        every: looks at every so many steps.
        first: from this step on.
    """

    name: ClassVar[str]
    every: int = eqx.field(static=True, default=1)
    first: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        if self.every < 1 or self.first < 0:
            raise InputError(
                f"every = {self.every}, first = {self.first}; expected at least 1 and at least 0",
                where=f"loss {self.name}",
            )

    def looks_at(self, steps: Int[np.ndarray, "rows"], last: int) -> Bool[np.ndarray, "rows"]:
        """Which steps it looks at, of a run up to the last one."""
        return (steps >= self.first) & ((steps - self.first) % self.every == 0)

    @abstractmethod
    def observe(self, frame: Frame, origin: Frame, around: Surroundings) -> Any:
        """What one frame adds: a pytree of arrays, differentiable in both frames.

        Args:
            frame: the frame.
            origin: the frame of step 0.
            around: masses and box.
        """

    @abstractmethod
    def value(self, total: Any, frames: Int[Array, ""] | int) -> Float[Array, ""]:
        """The number, from the sum of what was observed and how many frames there were."""


class FinalProjection(Loss):
    """Projection of the last positions on fixed directions, divided by the number of atoms.

    Attributes:
        direction: shape (3, atoms), or (3,) for all atoms alike.
    """

    name = "final-projection"
    direction: Float[Array, "3 *atoms"] = eqx.field(default_factory=lambda: jnp.array([1.0, 0.0, 0.0]))

    def looks_at(self, steps, last):
        """The last step alone."""
        return steps == last

    def observe(self, frame, origin, around):
        way = self.direction if self.direction.ndim == 2 else self.direction[:, None]
        return jnp.sum(frame.x * way.astype(frame.x.dtype)) / frame.x.shape[1]

    def value(self, total, frames):
        return total


class MeanSquaredDisplacement(Loss):
    """Mean squared displacement since step 0 at the last step, length²."""

    name = "msd"

    def looks_at(self, steps, last):
        """The last step alone."""
        return steps == last

    def observe(self, frame, origin, around):
        return jnp.mean(jnp.sum(jnp.square(frame.x - origin.x), axis=0))

    def value(self, total, frames):
        return total


class VelocityAutocorrelation(Loss):
    """Mean of v(0) · v(t) over atoms at the last step, (length / internal time)²."""

    name = "vacf"

    def looks_at(self, steps, last):
        """The last step alone."""
        return steps == last

    def observe(self, frame, origin, around):
        return jnp.mean(jnp.sum(frame.v * origin.v, axis=0))

    def value(self, total, frames):
        return total


class MeanPotential(Loss):
    """Potential energy of an atom, averaged over frames."""

    name = "potential"

    def observe(self, frame, origin, around):
        return frame.potential / frame.x.shape[1]

    def value(self, total, frames):
        return total / frames


def _kinetic(frame: Frame, around: Surroundings) -> Float[Array, ""]:
    speed2 = jnp.sum(jnp.square(frame.v.astype(jnp.float64)), axis=0)
    return 0.5 * jnp.sum(around.masses * speed2)


class MeanTemperature(Loss):
    """Kinetic temperature 2 K / (3 N kB), averaged over frames, K (or the units' temperature)."""

    name = "temperature"

    def observe(self, frame, origin, around):
        return 2 * _kinetic(frame, around) / (3 * frame.x.shape[1] * around.kB)

    def value(self, total, frames):
        return total / frames


class MeanPressure(Loss):
    """Pressure (2 K + virial) / (3 V), averaged over frames, energy/length³."""

    name = "pressure"

    def observe(self, frame, origin, around):
        return (2 * _kinetic(frame, around) + frame.virial) / (3 * around.volume)

    def value(self, total, frames):
        return total / frames


class Custom(Loss):
    """Any function of the trajectory that is a function of sums over frames.

    Attributes:
        see: (frame, origin, surroundings) to a pytree of arrays that is summed over frames.
        conclude: (sum, number of frames) to a scalar.
    """

    name = "custom"
    see: Callable[[Frame, Frame, Surroundings], Any] = eqx.field(static=True, kw_only=True)
    conclude: Callable[[Any, Any], Any] = eqx.field(
        static=True, kw_only=True, default=lambda total, frames: total / frames
    )

    def observe(self, frame, origin, around):
        return self.see(frame, origin, around)

    def value(self, total, frames):
        value = self.conclude(total, frames)
        shape = jnp.shape(value)
        if jax.tree.structure(value) != jax.tree.structure(0.0) or shape != ():
            raise InputError(
                f"the loss has shape {shape}; expected a scalar", remedy="Reduce it, with a sum or a mean"
            )
        return jnp.asarray(value)
