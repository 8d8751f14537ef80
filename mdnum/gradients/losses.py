"""Losses of a trajectory. Frames are evaluated one by one, so no trajectory is stored.

A loss computes observations from each frame and sums them over frames. The value of the loss is a function of
the sums. Examples of losses are averages, correlations with the start, and histograms. The derivatives of a
loss also require only one frame at a time. Each loss of the command line is a class with a name, a label and
a unit.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import fields
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Inexact, Int

from mdnum.errors import InputError
from mdnum.registry import Registry

if TYPE_CHECKING:
    from mdnum.systems.simulation import Simulation

# why a complex loss is refused where a real one is needed, and what to do
NOT_REAL = ("it is complex; expected a real number", "Use gradients.value_and_grad, jnp.real or jnp.abs")


class LossFrame(NamedTuple):
    """State and energies at one step of a trajectory. Atoms are in the user's order."""

    step: Int[Array, ""]  # its number
    x: Float[Array, "3 atoms"]  # positions as if the box had no faces, length
    v: Float[Array, "3 atoms"]  # velocities, length per internal time
    potential: Float[Array, ""]  # potential energy
    virial: Float[Array, ""]  # sum over pairs of r_ij · F_ij, energy


class LossContext(NamedTuple):
    """Quantities for a loss that do not change from frame to frame, such as masses."""

    masses: Float[Array, "atoms"]  # of the atoms
    matrix: Float[Array, "3 3"]  # lattice vectors as rows, length
    volume: Float[Array, ""]  # of the box, length³; 0 without one
    kB: Float[Array, ""]  # Boltzmann's constant in the units of the run
    timestep: Float[Array, ""]  # internal time
    time_factor: Float[Array, ""]  # internal time of one unit of time of the system file


class Loss(eqx.Module):
    """A number computed from the frames of a trajectory."""

    # name, label, unit: its name on the command line, a few words, and its unit with the names of `Units` in
    # braces
    name: ClassVar[str]
    label: ClassVar[str] = ""
    unit: ClassVar[str] = ""
    # whether each frame shows it by itself, so that an ensemble has it too
    of_single_frames: ClassVar[bool] = False
    needs_volume: ClassVar[bool] = False  # whether it is not defined without a box
    every: int = eqx.field(static=True, default=1)  # looks at every n-th step
    first: int = eqx.field(static=True, default=0)  # from this step on

    def __check_init__(self):
        if self.every < 1 or self.first < 0:
            raise self.wrong(
                f"every = {self.every}, first = {self.first}; expected at least 1 and at least 0"
            )

    def wrong(self, seen: str, remedy: str | None = None) -> InputError:
        """Create an error about the options of this loss, with the given message."""
        return InputError(seen, remedy=remedy, where=f"loss {self.name}")

    @classmethod
    def named(cls, options: dict[str, Any], simulation: Simulation, steps: int) -> Loss:
        """Create the loss for a system from options of the command line."""
        return cls(**options)

    def looks_at(self, steps: Int[np.ndarray, "rows"], last: int) -> Bool[np.ndarray, "rows"]:
        """Return for each given step whether the loss uses it. `last` is the last step of the run."""
        return (steps >= self.first) & ((steps - self.first) % self.every == 0)

    @abstractmethod
    def observe(self, frame: LossFrame, origin: LossFrame, around: LossContext) -> Any:
        """Return the observations of a frame. `origin` is the frame of step 0."""

    def value(self, total: Any, frames: Int[Array, ""] | int) -> Inexact[Array, ""]:
        """Compute the loss from the sum of observations. The default is the mean over frames."""
        return total / frames

    def reason_unavailable(self, around: LossContext) -> str | None:
        """Return why the loss is not defined for this system. None if it is defined."""
        lacks_volume = self.needs_volume and not float(around.volume) > 0
        return "the box has no volume: it is not periodic everywhere" if lacks_volume else None


class _OfLast(Loss):
    """Base class of losses that use only the last step."""

    def looks_at(self, steps, last):
        return steps == last

    def value(self, total, frames):
        return total


class Custom(Loss):
    """A user-defined loss, which is a function of sums over frames.

    Attributes:
        see: maps (frame, origin, surroundings) to a pytree of arrays that is summed over frames.
        conclude: maps (sum, number of frames) to a scalar.
        single: whether `see` ignores the origin, so that the loss is also an ensemble average.
    """

    name = "custom"
    see: Callable[[LossFrame, LossFrame, LossContext], Any] = eqx.field(static=True, kw_only=True)
    conclude: Callable[[Any, Any], Any] = eqx.field(
        static=True, kw_only=True, default=lambda total, frames: total / frames
    )
    single: bool = eqx.field(static=True, kw_only=True, default=False)

    def observe(self, frame, origin, around):
        return self.see(frame, origin, around)

    def value(self, total, frames):
        return self.conclude(total, frames)

    @property
    def of_single_frames(self) -> bool:  # type: ignore[override]
        return self.single


class ComplexPart(Loss):
    """Real part of the product of a complex loss and a constant. The constant -i gives the imaginary part."""

    name = "part of a complex loss"
    inner: Loss = eqx.field(kw_only=True)
    factor: Complex[Array, ""] = eqx.field(kw_only=True)  # an array: one program for both parts
    looks_at = property(lambda self: self.inner.looks_at)  # type: ignore[assignment]
    observe = property(lambda self: self.inner.observe)  # type: ignore[assignment]

    def value(self, total, frames):
        made = self.inner.value(total, frames)
        return jnp.real(self.factor.astype(made.dtype) * made)


class FinalProjection(_OfLast):
    """Projection of the final positions onto a fixed vector per atom, averaged over atoms."""

    name, label, unit = "final-projection", "mean of the last positions along x", "{length}"
    # shape (3, atoms), or (3,) for all atoms alike
    direction: Float[Array, "3 *atoms"] = eqx.field(default_factory=lambda: jnp.array([1.0, 0.0, 0.0]))

    def observe(self, frame, origin, around):
        way = self.direction if self.direction.ndim == 2 else self.direction[:, None]
        return jnp.sum(frame.x * way.astype(frame.x.dtype)) / frame.x.shape[1]


class MeanSquaredDisplacement(_OfLast):
    """Mean squared displacement (length²) of the atoms between step 0 and the last step."""

    name, label, unit = "msd", "mean squared displacement at the last step", "{length}²"

    def observe(self, frame, origin, around):
        return jnp.mean(jnp.sum(jnp.square(frame.x - origin.x), axis=0))


class VelocityAutocorrelation(_OfLast):
    """Mean of v(0) · v(t) over atoms at the last step, in units of (length / internal time)²."""

    # inside, time is length * sqrt(mass / energy)
    name, label, unit = "vacf", "mean of v(0) · v(t) at the last step", "{energy}/{mass}"

    def observe(self, frame, origin, around):
        return _correlation(frame, origin)


class MeanPotential(Loss):
    """Potential energy per atom, averaged over frames."""

    name, label, unit = "potential", "potential energy of an atom, averaged over steps", "{energy}"
    of_single_frames = True

    def observe(self, frame, origin, around):
        return frame.potential / frame.x.shape[1]


class MeanTemperature(Loss):
    """Kinetic temperature 2 K / (3 N kB), averaged over frames, in kelvin (or reduced units)."""

    name, label, unit = "temperature", "kinetic temperature, averaged over steps", "{temperature}"
    of_single_frames = True

    def observe(self, frame, origin, around):
        return 2 * _kinetic(frame, around) / (3 * frame.x.shape[1] * around.kB)


class MeanPressure(Loss):
    """Pressure (2 K + virial) / (3 V), averaged over frames, in units of energy/length³."""

    name, label, unit = "pressure", "pressure, averaged over steps", "{energy}/{length}³"
    of_single_frames = needs_volume = True

    def observe(self, frame, origin, around):
        return (2 * _kinetic(frame, around) + frame.virial) / (3 * around.volume)


class MeanVolume(Loss):
    """Volume of the periodic box, averaged over frames, in units of length³."""

    name, label, unit = "volume", "volume of the box, averaged over steps", "{length}³"
    of_single_frames = needs_volume = True

    def observe(self, frame, origin, around):
        return around.volume


class MeanDensity(MeanVolume):
    """Mass density (total mass divided by volume), averaged over frames, in units of mass/length³."""

    name, label, unit = "density", "mass over volume, averaged over steps", "{mass}/{length}³"

    def observe(self, frame, origin, around):
        return jnp.sum(around.masses) / around.volume


class EinsteinDiffusion(Loss):
    """Diffusion constant (length² per unit of time) from the slope of the mean squared displacement.

    A straight line is fitted to the mean squared displacement since step 0. D is a sixth of the slope of this
    line. Motion is ballistic at first: set `first` to a later step.

    Source: Allen and Tildesley, Computer Simulation of Liquids (2017), section 2.7.
    """

    name, unit = "diffusion-einstein", "{length}²/{time}"
    label = "diffusion constant from the slope of displacements"

    def observe(self, frame, origin, around):
        moved = jnp.sum(jnp.square((frame.x - origin.x).astype(jnp.float64)), axis=0)
        # steps are exact; the time of a step is in what they are compared with
        rate = jnp.mean(moved) / (around.timestep / around.time_factor)
        step = frame.step.astype(jnp.float64)
        return jnp.stack([step, step * step, rate, step * rate])

    def value(self, total, frames):
        step, step2, rate, both = total / frames
        spread = step2 - step * step
        return (both - step * rate) / spread / 6

    def looks_at(self, steps, last):
        if last < self.first + self.every:
            seen = f"a slope needs two frames, but there is at most one frame up to step {last}"
            raise self.wrong(seen, "Run longer, or evaluate the loss earlier or more often")
        return super().looks_at(steps, last)


class GreenKuboDiffusion(Loss):
    """Diffusion constant (length² per unit of time) from the integral of the velocity autocorrelation.

    D is a third of the integral of v(0) · v(t) from step 0 to step `until`, averaged over atoms. The integral
    uses the trapezoidal rule with a spacing of `every` steps.

    Error: of order (every × timestep)² times the slope of the autocorrelation at `until`.
    Source: Allen and Tildesley (2017), section 2.7, as for `EinsteinDiffusion`.
    """

    name, unit = "diffusion-green-kubo", "{length}²/{time}"
    label = "diffusion constant from the velocity autocorrelation"
    # the step up to which is integrated, a multiple of `every`; correlations are noise later on
    until: int = eqx.field(static=True, kw_only=True)

    def __check_init__(self):
        if self.first or self.until < self.every or self.until % self.every:
            seen = f"first = {self.first}, every = {self.every}, until = {self.until}"
            raise self.wrong(f"{seen}; expected 0, and a positive multiple of every")

    @classmethod
    def named(cls, options, simulation, steps):
        every = options.get("every", 1)
        return cls(**({"until": steps // every * every} | options))

    def looks_at(self, steps, last):
        if last < self.until:
            seen = f"the integral ends at step {self.until}, but the run ends at step {last}"
            raise self.wrong(seen, "Run longer, or integrate less far")
        return super().looks_at(steps, last) & (steps <= self.until)

    def observe(self, frame, origin, around):
        end = (frame.step == 0) | (frame.step == self.until)
        # length²/internal time² times internal time, per unit of time
        width = self.every * around.timestep * around.time_factor
        return jnp.where(end, 0.5, 1.0) * width * _correlation(frame, origin) / 3

    def value(self, total, frames):
        return total


class RadialDistribution(Loss):
    """Loss computed from the radial distribution function g(r), averaged over frames.

    Each pair distance contributes to the four nearest bins with cubic B-spline weights. Therefore, g(r) has
    two continuous derivatives with respect to positions. Each frame of N atoms takes a time of order N² and
    memory of order N.

    Source: Hansen and McDonald, Theory of Simple Liquids (2013), section 2.5.
    """

    name, label = "rdf", "mean squared difference of g(r) from 1"
    of_single_frames = needs_volume = True
    r_max: float = eqx.field(static=True, kw_only=True)  # right edge of the last bin, length
    bins: int = eqx.field(static=True, kw_only=True, default=60)  # of equal width, from 0
    # the loss is the mean squared difference from this, shape (bins,), or from the same in all
    target: Float[Array, "*bins"] = eqx.field(kw_only=True, default_factory=lambda: jnp.ones((), jnp.float64))
    # the loss is the sum of g(r) with these weights instead, shape (bins,)
    weights: Float[Array, "bins"] | None = eqx.field(kw_only=True, default=None)

    def __check_init__(self):
        if not self.r_max > 0 or self.bins < 4:
            raise self.wrong(f"r_max = {self.r_max:g}, bins = {self.bins}; expected above 0, and at least 4")
        for name, given in (("target", self.target), ("weights", self.weights)):
            if given is not None and jnp.shape(given) not in ((), (self.bins,)):
                raise self.wrong(f"{name} has shape {jnp.shape(given)}; expected ({self.bins},)")

    @classmethod
    def named(cls, options, simulation, steps):
        # all pairs are examined, and neighboring steps look alike
        # bins reach two widths further, and no further than nearest images do
        half = 0.5 * float(min(simulation.cell.widths))
        bins = options.get("bins", 60)
        # a box that moves has room to shrink
        room = 0.9 if simulation.integrator.moves_cell else 0.999
        own: dict[str, Any] = {"every": 10, "bins": bins, "r_max": room * half / (1 + 2 / bins)}
        return cls(**(own | options))

    @property
    def width(self) -> float:
        """Width (length) of a bin of g(r)."""
        return self.r_max / self.bins

    @property
    def centers(self) -> Float[Array, "bins"]:
        """Centers (lengths) of the bins of g(r)."""
        return (jnp.arange(self.bins, dtype=jnp.float64) + 0.5) * self.width

    def reason_unavailable(self, around: LossContext) -> str | None:
        """Return why g(r) is not defined for the box. None if it is defined."""
        if why := super().reason_unavailable(around):
            return why
        half = float(jnp.min(1 / jnp.linalg.norm(jnp.linalg.inv(around.matrix), axis=0))) / 2
        reach = self.r_max + 2 * self.width
        if reach > half:
            seen = f"its last bin reaches to {reach:.4g}, beyond half the smallest box width {half:.4g}"
            return f"{seen}: make r_max smaller"
        return None

    def observe(self, frame: LossFrame, origin: LossFrame, around: LossContext):
        x = frame.x.astype(jnp.float64)
        atoms = x.shape[1]
        inverse = jnp.linalg.inv(around.matrix)
        labels = jnp.arange(atoms)

        @jax.checkpoint
        def row(counts, i):
            d = x - x[:, i][:, None]
            # which image is the nearest has no derivative
            d = d - around.matrix.T @ lax.stop_gradient(jnp.round(inverse.T @ d))
            r2 = jnp.sum(d * d, axis=0)
            near = (labels != i) & (r2 < (self.r_max + 2 * self.width) ** 2)
            r = jnp.sqrt(jnp.where(near, r2, 1.0))
            return counts + _shared(r, near, self.width, self.bins), None

        counts, _ = lax.scan(row, jnp.zeros(self.bins, jnp.float64), labels)
        # the second moment of a B-spline is part of the volume that it covers
        shells = 4 * jnp.pi * self.width * (jnp.square(self.centers) + self.width**2 / 3)
        return counts * around.volume / (atoms * (atoms - 1) * shells)

    def curve(self, total, frames) -> Float[Array, "bins"]:
        """Compute g(r) at the bin centers from the sum over frames."""
        return total / frames

    def value(self, total, frames):
        g = self.curve(total, frames)
        if self.weights is not None:
            return jnp.sum(self.weights * g)
        return jnp.mean(jnp.square(g - self.target))


def _shared(r: Float[Array, "pairs"], near, width: float, bins: int) -> Float[Array, "bins"]:
    """Histogram of distances with cubic B-spline weights. Bin centers are (k + 1/2) * width."""
    u = r / width - 0.5
    left = lax.stop_gradient(jnp.floor(u))
    t = u - left
    rest = 1 - t
    shares = (
        rest * rest * rest / 6,
        (4 - 6 * t * t + 3 * t * t * t) / 6,
        (4 - 6 * rest * rest + 3 * rest * rest * rest) / 6,
        t * t * t / 6,
    )
    # two more bins on either side take what lies beyond the ends
    first = jnp.clip(left.astype(jnp.int32), -1, bins + 1)
    counts = jnp.zeros(bins + 5, jnp.float64)
    for k, share in enumerate(shares):
        counts = counts.at[first + jnp.int32(k + 1)].add(jnp.where(near, share, 0), mode="promise_in_bounds")
    return counts[2 : bins + 2]


def _correlation(frame: LossFrame, origin: LossFrame):
    return jnp.mean(jnp.sum(frame.v.astype(jnp.float64) * origin.v.astype(jnp.float64), axis=0))


def _kinetic(frame: LossFrame, around: LossContext) -> Float[Array, ""]:
    speed2 = jnp.sum(jnp.square(frame.v.astype(jnp.float64)), axis=0)
    return 0.5 * jnp.sum(around.masses * speed2)


#: Losses by their names on the command line.
LOSSES: Registry[Loss] = Registry("loss", "mdnum.losses", Loss)
for _loss in (
    MeanSquaredDisplacement, VelocityAutocorrelation, EinsteinDiffusion, GreenKuboDiffusion,
    RadialDistribution, MeanPotential, MeanTemperature, MeanPressure, MeanVolume,
    MeanDensity, FinalProjection,
):  # fmt: skip
    LOSSES.add(_loss.name, _loss, description=_loss.label)


def parse(text: str, simulation: Simulation, steps: int) -> Loss:
    """Create a loss from its description on the command line.

    Args:
        text: a name of `LOSSES`, optionally with options after a colon: "potential:every=10,first=500".

    Raises:
        InputError: the loss, or an option of the loss, does not exist.
    """
    name, _, rest = text.partition(":")
    name = name.strip()
    kind: type[Loss] = LOSSES[name]
    known = {one.name: str(one.type) for one in fields(kind) if one.type in ("int", "float", int, float)}
    options: dict[str, Any] = {}
    for part in filter(None, (part.strip() for part in rest.split(","))):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or key not in known:
            raise InputError(
                f"{part!r} is not an option of the loss {name}",
                remedy=f"The options of this loss are {', '.join(known)}; write for example {name}:every=10",
            )
        try:
            options[key] = int(value) if "int" in known[key] else float(value)
        except ValueError:
            a = "a whole number" if "int" in known[key] else "a number"
            raise InputError(f"the option {key} of the loss {name} is {value!r}; expected {a}") from None
    return kind.named(options, simulation, steps)
