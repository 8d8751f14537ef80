"""Thermostats that scale all velocities by one factor (Nosé-Hoover chains, stochastic rescaling).

If the total momentum is zero, it stays zero. The system then has three fewer degrees of freedom
(`Integrator.freedom`). The variables of a thermostat are always float64. Velocities are also scaled in
float64. A factor rounded to float32 would give the velocities of all atoms the same relative error.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mdnum.md.integrators import Integrator, Number, quantity

#: Weights of three second-order steps that form a fourth-order step (Yoshida, Phys. Lett. A 150, 262, 1990).
_FIRST = 1 / (2 - 2 ** (1 / 3))
_WEIGHTS = (_FIRST, 1 - 2 * _FIRST, _FIRST)


class Chain(NamedTuple):
    """Nosé-Hoover chain of thermostats, in which each thermostat controls the previous thermostat."""

    rate: Float[Array, "links"]  # p_ξ / Q, one over time
    way: Float[Array, "links"]  # ξ

    @classmethod
    def at_rest(cls, links: int) -> Chain:
        """Return the initial state of a thermostat chain: all thermostats at rest."""
        return cls(jnp.zeros(links), jnp.zeros(links))

    def act(
        self, kinetic: Number, freedom: int | Number, kT: Number, relaxation: Number, time: Number
    ) -> tuple[Number, Chain]:
        """Advance the chain by a time. Return the scale factor of velocities and the new chain.

        Each of three substeps is the operator L_NHC of Tuckerman et al., J. Phys. A 39, 5629, 2006. The error
        is O(time⁵).

        Args:
            kinetic: kinetic energy of the atoms or the box, with the number of degrees of freedom.
            time: float64.
        """
        rate, way, scale = list(self.rate), list(self.way), jnp.ones(())
        links, heavy = len(rate), freedom * kT * relaxation**2  # inertia of the first; the others: kT τ²

        def kick(k: int, t: Number) -> None:
            slowed = jnp.exp(-0.25 * t * rate[k + 1]) if k + 1 < links else 1.0
            if k == 0:
                pull = (2 * kinetic * scale**2 - freedom * kT) / heavy
            else:
                pull = (freedom if k == 1 else 1) * rate[k - 1] ** 2 - 1 / relaxation**2
            rate[k] = (rate[k] * slowed + 0.5 * t * pull) * slowed

        for weight in _WEIGHTS:
            t = weight * time
            for k in reversed(range(links)):
                kick(k, t)
            way = [one + t * each for one, each in zip(way, rate, strict=True)]
            scale = scale * jnp.exp(-t * rate[0])
            for k in range(links):
                kick(k, t)
        return scale, Chain(jnp.stack(rate), jnp.stack(way))

    def energy(self, freedom: int | Number, kT: Number, relaxation: Number) -> Number:
        """Return the energy of the chain (Martyna, Klein, Tuckerman, J. Chem. Phys. 97, 2635, eq. 2.8)."""
        shares = jnp.ones(len(self.rate)).at[0].set(freedom)
        return kT * jnp.sum(shares * (0.5 * jnp.square(relaxation * self.rate) + self.way))


class NoseHooverChain(Integrator):
    """Canonical ensemble by velocity Verlet and a Nosé-Hoover chain.

    The dynamics is deterministic and time-reversible. Source: Martyna, Klein, Tuckerman, J. Chem. Phys. 97,
    2635 (1992), integrated as in Tuckerman et al., J. Phys. A 39, 5629 (2006). A stiff system at low
    temperature may not be ergodic.

    Example:
        >>> mdnum.simulation(atoms, argon, cut, timestep=0.002, temperature=90, integrator="nose-hoover",
        ...                  dynamics={"relaxation": 0.2})

    Attributes:
        kT: energy. relaxation: period of the thermostat divided by 2π, internal time. chain: number of links.
    """

    name = "nose-hoover"
    kT: Float[Array, ""] = quantity("temperature")
    relaxation: Float[Array, ""] = quantity("time")
    chain: int = eqx.field(static=True, default=3)

    def init(self, x, v, masses):
        return Chain.at_rest(self.chain)

    def _scaled(self, v, extra, masses, time):
        freedom = self.freedom(masses)
        scale, extra = extra.act(self.kinetic(v, masses), freedom, self.kT, self.relaxation, time)
        return (v.astype(jnp.float64) * scale).astype(v.dtype), extra

    def finish(self, v, extra, at, time):
        v = v + time * at.acceleration
        return self._scaled(v, extra, at.masses, time.astype(jnp.float64))

    def begin(self, x, v, extra, at):
        v, extra = self._scaled(v, extra, at.masses, 0.5 * self.timestep)
        v = v + (0.5 * self.timestep).astype(v.dtype) * at.acceleration
        return x + self.timestep.astype(x.dtype) * v, v, extra, jnp.zeros(())

    def exchanged(self, extra, at):
        return -extra.energy(self.freedom(at.masses), self.kT, self.relaxation), 0.0


def rescaled(
    key: Array, kinetic: Number, freedom: int, kT: Number, relaxation: Number, time: Number
) -> Number:
    """Return the factor that scales velocities in an exact stochastic step of the kinetic energy.

    Bussi, Donadio, Parrinello, J. Chem. Phys. 126, 014101 (2007), eqs. A7 and A8. Zero velocities stay zero.

    Args:
        key: random key of this step. time: time during which the thermostat acts.
    """
    for_one, for_others = jax.random.split(key)
    first = jax.random.normal(for_one, (), jnp.float64)
    others = 2 * jax.random.gamma(for_others, 0.5 * (freedom - 1), (), jnp.float64) if freedom > 1 else 0.0
    kept = jnp.exp(-time / relaxation)
    moving = kinetic > 0
    # what one degree of freedom takes up, over the energy that there is
    share = -jnp.expm1(-time / relaxation) * 0.5 * kT / jnp.where(moving, kinetic, 1.0)
    squared = kept + share * (first**2 + others) + 2 * first * jnp.sqrt(kept * share)
    sign = jnp.where(first + jnp.sqrt(kept / share) < 0, -1.0, 1.0)
    return jnp.where(moving, sign * jnp.sqrt(squared), 1.0)


class CSVR(Integrator):
    """Canonical ensemble by velocity Verlet and stochastic velocity rescaling.

    Bussi, Donadio, Parrinello, J. Chem. Phys. 126, 014101 (2007). The random numbers depend only on the
    random key and the step number. A resumed run continues the sequence of random numbers. The effective
    energy (total energy minus heat) is conserved (eq. 15 of the paper).

    Example:
        >>> mdnum.simulation(atoms, argon, cut, timestep=0.002, temperature=90, integrator="csvr",
        ...                  dynamics={"relaxation": 0.1})

    Attributes:
        kT: energy. relaxation: relaxation time of the kinetic energy, internal time. key: random key.
    """

    name = "csvr"
    kT: Float[Array, ""] = quantity("temperature")
    relaxation: Float[Array, ""] = quantity("time")
    key: Array = quantity("seed")

    @property
    def noise_belongs_to(self):
        return ()

    def begin(self, x, v, extra, at):
        kinetic, key = self.kinetic(v, at.masses), jax.random.fold_in(self.key, at.step)
        scale = rescaled(key, kinetic, self.freedom(at.masses), self.kT, self.relaxation, self.timestep)
        v = (v.astype(jnp.float64) * scale).astype(v.dtype)
        heat = self.kinetic(v, at.masses) - kinetic
        v = v + (0.5 * self.timestep).astype(v.dtype) * at.acceleration
        return x + self.timestep.astype(x.dtype) * v, v, extra, heat

    def finish(self, v, extra, at, time):
        return v + time * at.acceleration, extra
