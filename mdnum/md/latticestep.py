"""Steps between whole numbers, forward and back.

A kick adds integer impulses to integer momenta; a drift adds to each place a rounded multiple of the
momentum, which does not change meanwhile. Either is undone by subtracting what was added.

Friction is different: it forgets. A factor below 1 takes many momenta to one, so nothing that only knows the
later momentum can name the earlier one. The factor is therefore a fraction n/d, and the remainder of the
division goes into a second integer for each component, from which the multiplication by n is filled up
(Maclaurin, Duvenaud & Adams 2015). That integer grows by log2(d/n) = friction x timestep / ln 2 bits a step,
which is what is forgotten and no more; before it is full it is put aside and begun anew.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mdnum.errors import InputError
from mdnum.md.integrators import Integrator, Langevin, VelocityVerlet
from mdnum.md.lattice import Lattice
from mdnum.numerics.exact import squared_norm, zero_bits
from mdnum.numerics.reproducible import normal_quantile

# a velocity in float64 tells its integer momentum back up to here
_LARGEST = 2.0**50
# friction is a multiple of 2^-24; the remainders may take the bits of a 64-bit integer that are left
_SHIFT = 24
_ROOM = 62 - _SHIFT


class LatticeStep(Integrator):
    """Kicks, drifts and sums in whole numbers: what the schemes on a lattice share.

    Attributes:
        lattice: the units.
        impulse: unit of momentum: that of force times half a time step.
        stride: spacings that an atom of unit mass moves in a step for each unit of momentum.
        zero: an integer zero that XLA must not know.
    """

    lattice: Lattice = eqx.field(static=True, kw_only=True)
    impulse: Float[Array, ""] = eqx.field(kw_only=True)
    stride: Float[Array, ""] = eqx.field(kw_only=True)
    zero: Int[Array, ""] = eqx.field(kw_only=True)

    def momentum(self, v: Float[Array, "3 atoms"], masses: Float[Array, "atoms"]) -> Float[Array, "3 atoms"]:
        """Momenta in units of the impulse; a velocity of this run gives its own back exactly."""
        return jnp.round(v * (masses / self.impulse))

    def velocity(self, p: Float[Array, "3 atoms"], masses: Float[Array, "atoms"]) -> Float[Array, "3 atoms"]:
        """Velocities of momenta; NaN where one is too large to be told back."""
        return jnp.where(jnp.abs(p) < _LARGEST, p * (self.impulse / masses), jnp.nan)

    def kick(self, v, time, acceleration, masses):
        """As any kick, rounded to whole momenta."""
        push = jnp.round(time * acceleration * (masses / self.impulse))
        return self.velocity(self.momentum(v, masses) + push, masses)

    def kinetic(self, v, masses):
        """The same in every order of atoms."""
        return self.lattice.total(0.5 * (masses * squared_norm(v[0], v[1], v[2], self.zero)))

    def glide(self, x, p, masses, share: float, direction: int):
        """Places after a share of a step at given momenta; direction -1 takes it back."""
        moved = jnp.round(p * (share * self.stride / masses))
        return x + direction * self.lattice.spacing * moved


class LatticeVerlet(LatticeStep, VelocityVerlet):
    """NVE in whole numbers."""

    def drift(self, x, v, masses, step, order):
        p = self.momentum(v, masses)
        return self.glide(x, p, masses, 1.0, 1), v, jnp.zeros((), jnp.float64)

    def undrift(self, x, v, bath, masses, step, order):
        """Places, velocities and bath before the drift that follows a step."""
        return self.glide(x, self.momentum(v, masses), masses, 1.0, -1), v, bath


class LatticeLangevin(LatticeStep, Langevin):
    """BAOAB in whole numbers; what friction forgets goes into the bath.

    Attributes:
        kept: numerator of the factor that friction leaves of a momentum in a step, over 2^24.
        spread: size of the noise of an atom of unit mass, in units of momentum.
        period: steps after which the bath is put aside.
    """

    kept: Int[Array, ""] = eqx.field(kw_only=True)
    spread: Float[Array, ""] = eqx.field(kw_only=True)
    period: Int[Array, ""] = eqx.field(kw_only=True)

    def noise(self, step, masses, order) -> Float[Array, "3 atoms"]:
        """The momentum that noise adds after a step, from the counter alone: whole units."""
        low = np.nextafter(-1.0, 0.0)
        shape = (3, masses.shape[0])
        # the numbers that jax.random.normal makes its deviates of
        u = jax.random.uniform(jax.random.fold_in(self.key, step), shape, jnp.float64, low, 1.0)[:, order]
        return jnp.round(normal_quantile(u, self.zero) * (self.spread * jnp.sqrt(masses)))

    def drift(self, x, v, masses, step, order):
        """Refused: friction on a lattice needs the bath, which `exchange` takes and gives."""
        raise InputError("a Langevin step on a lattice cannot be taken without its bath")

    def exchange(self, x, v, bath, masses, step, order):
        """The drift with its thermostat: places, velocities, heat and bath."""
        p = self.momentum(v, masses)
        x = self.glide(x, p, masses, 0.5, 1)
        bath = jnp.where(step % self.period == 0, 0, bath)
        whole = p.astype(jnp.int64)
        filled = (bath << _SHIFT) | (whole & ((1 << _SHIFT) - 1))
        bath = filled // self.kept
        whole = (whole >> _SHIFT) * self.kept + (filled - bath * self.kept)
        after = whole.astype(jnp.float64) + self.noise(step, masses, order)
        kicked = self.velocity(after, masses)
        heat = self.kinetic(kicked, masses) - self.kinetic(v, masses)
        return self.glide(x, after, masses, 0.5, 1), kicked, heat, bath

    def undrift(self, x, v, bath, masses, step, order):
        """Places, velocities and bath before the drift that follows a step."""
        p = self.momentum(v, masses)
        x = self.glide(x, p, masses, 0.5, -1)
        whole = (p - self.noise(step, masses, order)).astype(jnp.int64)
        high = jnp.floor_divide(whole, self.kept)
        filled = bath * self.kept + (whole - high * self.kept)
        before = (high << _SHIFT) | (filled & ((1 << _SHIFT) - 1))
        before = before.astype(jnp.float64)
        return self.glide(x, before, masses, 0.5, -1), self.velocity(before, masses), filled >> _SHIFT


def on_lattice(integrator: Integrator, lattice: Lattice) -> LatticeVerlet | LatticeLangevin:
    """The scheme in whole numbers.

    Raises:
        InputError: the friction is too small or too large for a step.
    """
    timestep = float(integrator.timestep)
    impulse = lattice.force * (0.5 * timestep)
    common = {
        "lattice": lattice,
        "impulse": jnp.asarray(impulse, jnp.float64),
        "stride": jnp.asarray(timestep * impulse / lattice.spacing, jnp.float64),
        "zero": zero_bits(np.float64),
    }
    if isinstance(integrator, Langevin):
        loss = float(integrator.friction) * timestep
        kept = round(math.exp(-loss) * 2**_SHIFT)
        period = _period(kept)
        if period < 1:
            raise InputError(
                f"friction x timestep = {loss:.3g}; on a lattice it must lie between 1e-7 and 10",
                where="dynamics.friction",
            )
        decay = kept / 2**_SHIFT
        spread = math.sqrt(float(integrator.kT) * (1 - decay * decay)) / impulse
        return LatticeLangevin(
            integrator.timestep,
            integrator.friction,
            integrator.kT,
            integrator.key,
            kept=jnp.asarray(kept, jnp.int64),
            spread=jnp.asarray(spread, jnp.float64),
            period=jnp.asarray(period, jnp.int64),
            **common,
        )
    assert isinstance(integrator, VelocityVerlet)
    return LatticeVerlet(integrator.timestep, **common)


def _period(kept: int) -> int:
    """Steps until a bath that grows by 2^24/kept a step might no longer fit."""
    if not 0 < kept < 2**_SHIFT:
        return 0
    growth = 2**_SHIFT / kept
    # b' <= (b + 1) growth, from 0: b_k <= growth^(k+1) / (growth - 1)
    return int((_ROOM + math.log2(growth - 1)) / math.log2(growth)) - 2


def forgotten_bits(integrator: Integrator) -> float:
    """Bits that friction forgets in a step for each component of a momentum; 0 without a thermostat."""
    if isinstance(integrator, Langevin):
        return float(integrator.friction) * float(integrator.timestep) / math.log(2)
    return 0.0
