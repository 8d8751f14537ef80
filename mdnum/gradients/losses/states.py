"""Losses of positions and energies at single steps, and their averages."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mdnum.gradients.losses.base import Frame, Loss, Surroundings


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


class MeanPotential(Loss):
    """Potential energy of an atom, averaged over frames."""

    name = "potential"

    def observe(self, frame, origin, around):
        return frame.potential / frame.x.shape[1]

    def value(self, total, frames):
        return total / frames

    @property
    def of_single_frames(self) -> bool:
        """Each frame has its own."""
        return True


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

    @property
    def of_single_frames(self) -> bool:
        """Each frame has its own."""
        return True


class MeanPressure(Loss):
    """Pressure (2 K + virial) / (3 V), averaged over frames, energy/length³."""

    name = "pressure"

    def observe(self, frame, origin, around):
        return (2 * _kinetic(frame, around) + frame.virial) / (3 * around.volume)

    def value(self, total, frames):
        return total / frames

    @property
    def of_single_frames(self) -> bool:
        """Each frame has its own."""
        return True

    def why_not(self, around: Surroundings) -> str | None:
        """A pressure needs a volume."""
        return None if float(around.volume) > 0 else "the box has no volume: it is not periodic everywhere"
