"""Stillinger and Weber's silicon, through jax-md's energy function."""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mdnum.md.jaxmd import Format, NeighborList, displacement, standard_promotion, upstream
from mdnum.md.manybody.base import ManyBody, Smoothness

# jax_md.quantity adds 1e-7 to both lengths before it divides by them, which bends every cosine by 1e-7 and
# the forces of rattled silicon by 3e-7. The 1e-7 is a length, so it shrinks with the unit of length: in
# units of 2^-24 Å it is 6e-15 Å, below rounding, and a power of two costs no digit anywhere else. (Not
# more: jax-md also takes two neighbors closer than 1e-5 of that unit for one.) In float32 the offset is
# about one rounding, and 2^4 puts it below.
_UNIT = {"float64": 2.0**24, "float32": 2.0**4}


class StillingerWeber(ManyBody):
    """Two- and three-body potential for tetrahedral semiconductors.

    Smooth at its cutoff to every order: a flip changes neither energy nor force.

    Attributes:
        epsilon: energy scale, energy.
        sigma: length scale, length.
        a: cutoff in sigma.
        A, B: strength of the pair term and of its repulsion (p = 4, q = 0).
        strength: lambda, of the angular term.
        gamma: decay of the angular term.

    Source: Stillinger and Weber, Phys. Rev. B 31, 5262 (1985), eqs. 2.3 to 2.7; checked against a plain
    numpy evaluation of those equations (tests/oracles_manybody.py).
    """

    epsilon: float = eqx.field(static=True, default=2.1683)
    sigma: float = eqx.field(static=True, default=2.0951)
    a: float = eqx.field(static=True, default=1.80)
    A: float = eqx.field(static=True, default=7.049556277)
    B: float = eqx.field(static=True, default=0.6022245584)
    strength: float = eqx.field(static=True, default=21.0)
    gamma: float = eqx.field(static=True, default=1.20)
    pbc: tuple[bool, bool, bool] = eqx.field(static=True, default=(True, True, True))
    name: str = eqx.field(static=True, default="stillinger-weber")
    format: Format = eqx.field(static=True, default="dense")
    smoothness: Smoothness = eqx.field(static=True, default=Smoothness(math.inf, 0.0, 0.0))
    sources: tuple[str, ...] = eqx.field(
        static=True, default=("F. H. Stillinger and T. A. Weber, Phys. Rev. B 31, 5262 (1985)",)
    )

    @property
    def r_cut(self) -> Any:
        """a sigma, length."""
        return self.a * self.sigma

    def energy(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, ""]:
        """Potential energy, energy units of epsilon; see ManyBody.energy."""
        unit = _UNIT[str(jnp.dtype(positions.dtype))]
        vector = displacement(cell, self.pbc)

        def apart(Ra, Rb, **_):
            # a padded slot may be the atom itself; at distance zero jax-md's derivatives by sigma, A and B
            # are NaN, and its mask comes after
            d = vector(Ra, Rb) * unit
            return jnp.where(jnp.all(d == 0), 2 * self.r_cut * unit, d)

        # numbers stay Python floats here: nothing on this path downcasts them, and they take R's dtype
        _, total = upstream().energy.stillinger_weber_neighbor_list(
            apart,
            1.0,
            sigma=self.sigma * unit,
            A=self.A,
            B=self.B,
            lam=self.strength,
            gamma=self.gamma,
            epsilon=self.epsilon,
            cutoff=self.r_cut * unit,
            neighbor_list_fn=lambda *_, **__: None,
        )
        # jax-md mixes dtypes; the result has the dtype of the positions all the same
        with standard_promotion():
            return total(positions, neighbor)
