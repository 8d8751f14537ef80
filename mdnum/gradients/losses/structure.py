"""The radial distribution function as a loss: bins with smooth edges, so that it has a derivative."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.gradients.losses.base import Frame, Loss, Surroundings


class RadialDistribution(Loss):
    """A number made of g(r), the density of pairs against that of an ideal gas, averaged over frames.

    Every distance is shared between the four nearest bins by cubic B-splines, which add up to one: no
    pair is lost, and g(r) has two continuous derivatives by every position. All pairs are looked at, row by
    row, so that a frame costs of the order of atoms² operations and of atoms memory.

    Attributes:
        r_max: right edge of the last bin, length.
        bins: how many, of equal width, from 0.
        target: the loss is the mean squared difference from this, shape (bins,), or from the same in all.
        weights: the loss is the sum of g(r) with these weights instead, shape (bins,).

    Source: of the loss, J. P. Hansen, I. R. McDonald, Theory of Simple Liquids (2013), section 2.5.
    """

    name = "rdf"
    r_max: float = eqx.field(static=True, kw_only=True)
    bins: int = eqx.field(static=True, kw_only=True, default=60)
    target: Float[Array, "*bins"] = eqx.field(kw_only=True, default_factory=lambda: jnp.ones((), jnp.float64))
    weights: Float[Array, "bins"] | None = eqx.field(kw_only=True, default=None)

    def __check_init__(self):
        if not self.r_max > 0 or self.bins < 4:
            raise InputError(
                f"r_max = {self.r_max:g}, bins = {self.bins}; expected above 0, and at least 4",
                where=f"loss {self.name}",
            )
        for name, given in (("target", self.target), ("weights", self.weights)):
            if given is not None and jnp.shape(given) not in ((), (self.bins,)):
                raise InputError(
                    f"{name} has shape {jnp.shape(given)}; expected ({self.bins},)", where=f"loss {self.name}"
                )

    @property
    def width(self) -> float:
        """Of a bin, length."""
        return self.r_max / self.bins

    @property
    def centers(self) -> Float[Array, "bins"]:
        """Of the bins, length."""
        return (jnp.arange(self.bins, dtype=jnp.float64) + 0.5) * self.width

    def why_not(self, around: Surroundings) -> str | None:
        """Distances are those of nearest images."""
        if not float(around.volume) > 0:
            return "the box has no volume: it is not periodic everywhere"
        half = float(jnp.min(1 / jnp.linalg.norm(jnp.linalg.inv(around.matrix), axis=0))) / 2
        reach = self.r_max + 2 * self.width
        if reach > half:
            return (
                f"its last bin reaches to {reach:.4g}, beyond half the smallest box width {half:.4g}: make "
                "r_max smaller"
            )
        return None

    def observe(self, frame: Frame, origin: Frame, around: Surroundings):
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
        """g(r) at the centers of the bins, from the sum over frames."""
        return total / frames

    def value(self, total, frames):
        g = self.curve(total, frames)
        if self.weights is not None:
            return jnp.sum(self.weights * g)
        return jnp.mean(jnp.square(g - self.target))

    @property
    def of_single_frames(self) -> bool:
        """Each frame has its own."""
        return True


def _shared(r: Float[Array, "pairs"], near, width: float, bins: int) -> Float[Array, "bins"]:
    """Counts of bins with centers at (k + 1/2) width, each distance shared by a cubic B-spline."""
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
