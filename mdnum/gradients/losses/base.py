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
        timestep: internal time.
        time_factor: internal time of one unit of time as a person writes it.
    """

    masses: Float[Array, "atoms"]
    matrix: Float[Array, "3 3"]
    volume: Float[Array, ""]
    kB: Float[Array, ""]
    timestep: Float[Array, ""]
    time_factor: Float[Array, ""]


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

    def why_not(self, around: Surroundings) -> str | None:
        """Why it has no meaning in these surroundings; None where it has."""
        return None

    @property
    def of_single_frames(self) -> bool:
        """Whether it is made of what each frame shows by itself, so that an ensemble has it too."""
        return False


class Custom(Loss):
    """Any function of the trajectory that is a function of sums over frames.

    Attributes:
        see: (frame, origin, surroundings) to a pytree of arrays that is summed over frames.
        conclude: (sum, number of frames) to a scalar.
        single: `see` does not look at the origin, so that the loss is one of an ensemble, too.
    """

    name = "custom"
    see: Callable[[Frame, Frame, Surroundings], Any] = eqx.field(static=True, kw_only=True)
    conclude: Callable[[Any, Any], Any] = eqx.field(
        static=True, kw_only=True, default=lambda total, frames: total / frames
    )
    single: bool = eqx.field(static=True, kw_only=True, default=False)

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

    @property
    def of_single_frames(self) -> bool:
        """As it was told."""
        return self.single
