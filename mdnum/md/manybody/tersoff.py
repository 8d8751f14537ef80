"""Tersoff's bond-order potential, written out because jax-md's cannot be mended from outside.

jax-md's forces are NaN wherever an atom has a padded slot and a neighbor inside the taper: the bond order
of a padded slot is (beta * 0)^n, whose slope is infinite, and its mask comes after. Its cosines are bent by
1e-7 besides, which is the whole of its deviation from ASE (1.9e-8 of the energy).
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.md.displacement import neighbor_vectors
from mdnum.md.jaxmd import Format, NeighborList
from mdnum.md.manybody.base import ManyBody, Smoothness

# exp() of more than this is clipped, at the value LAMMPS and ASE chose
_LARGEST_EXPONENT = 69.0776


class Tersoff(ManyBody):
    """Bond-order potential for one element; the constants default to silicon, set Si(C), "T3".

    Energy and force go to zero at r_cut = R + D, the slope of the force does not: smooth to first order.
    Where the crossing atom is a bond's only third neighbor the bond order starts as (r_cut - r)^(2n), so
    for n < 1 the force is continuous but infinitely steep there (dilute silicon; not the crystal).

    Attributes:
        A, B: repulsion and attraction, energy.
        lambda1, lambda2, lambda3: decay of repulsion, attraction and of the bond order, 1/length.
        m: exponent of the bond order's distance term, 1 or 3.
        beta, n: bond order.
        c, d, h: angle; gamma: factor of the angular function.
        R, D: middle and half width of the taper, length.

    Source: Tersoff, Phys. Rev. B 38, 9902 (1988), eqs. 1 to 3 and table I, in LAMMPS's notation; checked
    against ase.calculators.tersoff and a plain numpy evaluation (tests/oracles_manybody.py).
    """

    A: float = eqx.field(static=True, default=1830.8)
    B: float = eqx.field(static=True, default=471.18)
    lambda1: float = eqx.field(static=True, default=2.4799)
    lambda2: float = eqx.field(static=True, default=1.7322)
    lambda3: float = eqx.field(static=True, default=1.7322)
    m: int = eqx.field(static=True, default=3)
    beta: float = eqx.field(static=True, default=1.0999e-6)
    n: float = eqx.field(static=True, default=0.78734)
    c: float = eqx.field(static=True, default=1.0039e5)
    d: float = eqx.field(static=True, default=16.218)
    h: float = eqx.field(static=True, default=-0.59826)
    gamma: float = eqx.field(static=True, default=1.0)
    R: float = eqx.field(static=True, default=2.85)
    D: float = eqx.field(static=True, default=0.15)
    pbc: tuple[bool, bool, bool] = eqx.field(static=True, default=(True, True, True))
    name: str = eqx.field(static=True, default="tersoff")
    format: Format = eqx.field(static=True, default="dense")
    smoothness: Smoothness = eqx.field(static=True, default=Smoothness(1, 0.0, 0.0))
    sources: tuple[str, ...] = eqx.field(
        static=True, default=("J. Tersoff, Phys. Rev. B 38, 9902 (1988), set Si(C)",)
    )

    def __post_init__(self) -> None:
        if self.m not in (1, 3):
            raise InputError(f"Tersoff's exponent m is 1 or 3; got {self.m}")

    @property
    def r_cut(self) -> Any:
        """R + D, length."""
        return self.R + self.D

    def taper(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """1 up to R - D, 0 from R + D on, a quarter sine squared between (0 at the end to the last bit)."""
        # (1 - sin(pi x / 2)) / 2 with x = (r - R) / D, in the form that does not cancel where it vanishes
        inward = jnp.clip((self.r_cut - r) / (2 * self.D), 0.0, 1.0)
        return jnp.sin(0.5 * np.pi * inward) ** 2

    def energy(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, ""]:
        """Potential energy, eV for the default constants; see ManyBody.energy."""
        idx = neighbor.idx
        vectors = neighbor_vectors(positions, idx, cell, self.pbc)
        # the argument is masked, not the result: a padded slot gets a harmless vector before any root
        listed = idx < positions.shape[0]
        apart = jnp.sum(vectors * vectors, axis=-1)
        inside = listed & (apart > 0) & (apart < self.r_cut * self.r_cut)
        r = jnp.sqrt(jnp.where(inside, apart, 1.0))
        unit = jnp.where(inside[..., None], vectors, 0.0) / r[..., None]
        weight = jnp.where(inside, self.taper(r), 0.0)

        # axes: atom i, neighbor j, neighbor k
        cosine = (
            unit[:, :, None, 0] * unit[:, None, :, 0]
            + unit[:, :, None, 1] * unit[:, None, :, 1]
            + unit[:, :, None, 2] * unit[:, None, :, 2]
        )
        off = (self.h - cosine) ** 2
        # c²/d² - c²/(d² + off) over a common denominator: the two differ in the ninth digit only
        angular = self.gamma * (1.0 + (self.c / self.d) ** 2 * off / (self.d**2 + off))
        stretch = self.lambda3 * (r[:, :, None] - r[:, None, :])
        stretch = stretch**self.m
        spread = jnp.exp(jnp.clip(stretch, -_LARGEST_EXPONENT, _LARGEST_EXPONENT))
        others = inside[:, :, None] & inside[:, None, :] & ~jnp.eye(idx.shape[1], dtype=bool)
        zeta = jnp.sum(jnp.where(others, weight[:, None, :] * angular * spread, 0.0), axis=-1)

        # a bond without third neighbors has zeta = 0, where the power has no finite slope
        bonded = zeta > 0
        crowding = (self.beta * jnp.where(bonded, zeta, 1.0)) ** self.n
        order = jnp.where(bonded, (1.0 + crowding) ** (-0.5 / self.n), 1.0)
        repulsion = self.A * jnp.exp(-self.lambda1 * r)
        attraction = self.B * jnp.exp(-self.lambda2 * r)
        return 0.5 * jnp.sum(weight * (repulsion - order * attraction))


def silicon_1989(pbc: tuple[bool, bool, bool] = (True, True, True)) -> Tersoff:
    """Silicon of the multicomponent paper: lambda3 = 0 and three constants rounded otherwise.

    Source: Tersoff, Phys. Rev. B 39, 5566 (1989), table I.
    """
    return Tersoff(
        lambda3=0.0,
        beta=1.1000e-6,
        d=16.217,
        h=-0.59825,
        pbc=pbc,
        sources=("J. Tersoff, Phys. Rev. B 39, 5566 (1989), silicon",),
    )
