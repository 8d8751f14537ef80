"""Losses of motion: velocity autocorrelation, and the diffusion constant by two routes."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from mdnum.errors import InputError
from mdnum.gradients.losses.base import Frame, Loss, Surroundings


class VelocityAutocorrelation(Loss):
    """Mean of v(0) · v(t) over atoms at the last step, (length / internal time)²."""

    name = "vacf"

    def looks_at(self, steps, last):
        """The last step alone."""
        return steps == last

    def observe(self, frame, origin, around):
        return _correlation(frame, origin)

    def value(self, total, frames):
        return total


class EinsteinDiffusion(Loss):
    """Diffusion constant from the slope of the mean squared displacement, length² per unit of time.

    A straight line is fitted to the displacements since step 0 of all frames, and D is a sixth of its slope.
    Displacements are ballistic at first: look from a step on at which they no longer are.

    Source: M. P. Allen, D. J. Tildesley, Computer Simulation of Liquids (2017), section 2.7.
    """

    name = "diffusion-einstein"

    def observe(self, frame, origin, around):
        moved = jnp.sum(jnp.square((frame.x - origin.x).astype(jnp.float64)), axis=0)
        # steps are exact; the time between two of them stands in what they are compared with
        rate = jnp.mean(moved) / _step_time(around)
        step = frame.step.astype(jnp.float64)
        return jnp.stack([step, step * step, rate, step * rate])

    def value(self, total, frames):
        step, step2, rate, both = total / frames
        spread = step2 - step * step
        return (both - step * rate) / spread / 6

    def looks_at(self, steps, last):
        """Every so many steps; a line needs two of them."""
        if last < self.first + self.every:
            raise InputError(
                f"a slope needs two frames, and up to step {last} there is one at most",
                remedy="Run longer, or look earlier or more often",
                where=f"loss {self.name}",
            )
        return super().looks_at(steps, last)


class GreenKuboDiffusion(Loss):
    """Diffusion constant as the integral of the velocity autocorrelation, length² per unit of time.

    A third of the integral of v(0) · v(t), averaged over atoms, from step 0 to `until`, by the trapezoidal
    rule over every so many steps.

    Attributes:
        until: the step up to which is integrated, a multiple of `every`; correlations are noise later on.

    Error: of order (every × timestep)² in the correlation's slope at `until`; at 0 it has none.
    Source: as for `EinsteinDiffusion`.
    """

    name = "diffusion-green-kubo"
    until: int = eqx.field(static=True, kw_only=True)

    def __check_init__(self):
        if self.first or self.until < self.every or self.until % self.every:
            raise InputError(
                f"first = {self.first}, every = {self.every}, until = {self.until}; expected 0, and a "
                "positive multiple of every",
                where=f"loss {self.name}",
            )

    def looks_at(self, steps, last):
        """Every so many steps up to `until`."""
        if last < self.until:
            raise InputError(
                f"the integral goes up to step {self.until}, the run to step {last}",
                remedy="Run longer, or integrate less far",
                where=f"loss {self.name}",
            )
        return super().looks_at(steps, last) & (steps <= self.until)

    def observe(self, frame, origin, around):
        end = (frame.step == 0) | (frame.step == self.until)
        # length²/internal time² times internal time; told per unit of time
        width = self.every * around.timestep * around.time_factor
        return jnp.where(end, 0.5, 1.0) * width * _correlation(frame, origin) / 3

    def value(self, total, frames):
        return total


def _correlation(frame: Frame, origin: Frame):
    return jnp.mean(jnp.sum(frame.v.astype(jnp.float64) * origin.v.astype(jnp.float64), axis=0))


def _step_time(around: Surroundings):
    """Time of a step in units of a person's time."""
    return around.timestep / around.time_factor
