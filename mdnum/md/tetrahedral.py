"""Stillinger-Weber and Tersoff potentials of tetrahedral semiconductors."""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.md.jaxmd import displacement, neighbor_vectors, standard_promotion, upstream
from mdnum.md.manybody import ManyBody, Smoothness

# jax_md.quantity adds a length of 1e-7 to both lengths before it divides by them, which bends every cosine by
# 1e-7 and the forces of rattled silicon by 3e-7. In units of 2^-24 Å it is 6e-15 Å, below rounding, and a
# power of two costs no digit. (Not more: jax-md also takes two neighbors closer than 1e-5 of that unit for
# one.)
_UNIT = 2.0**24


class StillingerWeber(ManyBody):
    """Two- and three-body potential for tetrahedral semiconductors.

    All derivatives are continuous at the cutoff. Flips change neither energy nor forces.

    The implementation was checked against a plain numpy evaluation (tests/support/oracles_manybody.py).
    Source: Stillinger and Weber, Phys. Rev. B 31, 5262 (1985), eqs. 2.3 to 2.7.
    """

    epsilon: float = eqx.field(static=True, default=2.1683)  # energy scale, energy
    sigma: float = eqx.field(static=True, default=2.0951)  # length scale, length
    a: float = eqx.field(static=True, default=1.80)  # cutoff in sigma
    # A, B: strength of the pair term and of its repulsion (p = 4, q = 0)
    A: float = eqx.field(static=True, default=7.049556277)
    B: float = eqx.field(static=True, default=0.6022245584)
    strength: float = eqx.field(static=True, default=21.0)  # lambda, of the angular term
    gamma: float = eqx.field(static=True, default=1.20)  # decay of the angular term
    name: str = eqx.field(static=True, kw_only=True, default="stillinger-weber")
    smoothness: Smoothness = eqx.field(static=True, kw_only=True, default=Smoothness(math.inf, 0.0, 0.0))
    sources: tuple[str, ...] = eqx.field(
        static=True, kw_only=True, default=("F. H. Stillinger and T. A. Weber, Phys. Rev. B 31, 5262 (1985)",)
    )

    @property
    def r_cut(self) -> Any:
        """Cutoff radius (a length), the product of a and sigma."""
        return self.a * self.sigma

    def energy(self, positions, neighbor, cell):
        vector = displacement(cell, self.pbc)

        def apart(Ra, Rb, **_):
            # a padded slot may be the atom itself; at distance zero jax-md's derivatives by sigma, A and B
            # are NaN, and its mask comes after
            d = vector(Ra, Rb) * _UNIT
            return jnp.where(jnp.all(d == 0), 2 * self.r_cut * _UNIT, d)

        # numbers stay Python floats here: nothing on this path downcasts them, and they take R's dtype
        _, total = upstream().energy.stillinger_weber_neighbor_list(
            apart, 1.0, sigma=self.sigma * _UNIT, A=self.A, B=self.B, lam=self.strength, gamma=self.gamma,
            epsilon=self.epsilon, cutoff=self.r_cut * _UNIT, neighbor_list_fn=lambda *_, **__: None,
        )  # fmt: skip
        # jax-md mixes dtypes; the result has the dtype of the positions all the same
        with standard_promotion():
            return total(positions, neighbor)


# --- tersoff's bond-order potential, written out because jax-md's cannot be mended from outside -------

# exp() of more than this is clipped, at the value LAMMPS and ASE chose
_LARGEST_EXPONENT = 69.0776


class Tersoff(ManyBody):
    """Bond-order potential for one element. The default constants are set T3 for silicon, Si(C).

    Energy and force are zero at r_cut = R + D. The derivative of the force jumps there. If the bond order
    depends only on the crossing atom, it varies as (r_cut - r)^(2n). For n < 1, the force then has an
    infinite derivative (in dilute silicon, not in the crystal).

    The implementation was checked against ase.calculators.tersoff and a plain numpy evaluation
    (tests/support/oracles_manybody.py). Source: Tersoff, Phys. Rev. B 38, 9902 (1988), eqs. 1 to 3 and table
    I, in LAMMPS's notation.
    """

    # A, B: repulsion and attraction, energy
    A: float = eqx.field(static=True, default=1830.8)
    B: float = eqx.field(static=True, default=471.18)
    # lambda1, lambda2, lambda3: decay of repulsion, attraction and of the bond order, 1/length
    lambda1: float = eqx.field(static=True, default=2.4799)
    lambda2: float = eqx.field(static=True, default=1.7322)
    lambda3: float = eqx.field(static=True, default=1.7322)
    m: int = eqx.field(static=True, default=3)  # exponent of the bond order's distance term, 1 or 3
    # beta, n: bond order
    beta: float = eqx.field(static=True, default=1.0999e-6)
    n: float = eqx.field(static=True, default=0.78734)
    # c, d, h: angle; gamma: factor of the angular function
    c: float = eqx.field(static=True, default=1.0039e5)
    d: float = eqx.field(static=True, default=16.218)
    h: float = eqx.field(static=True, default=-0.59826)
    gamma: float = eqx.field(static=True, default=1.0)
    # R, D: middle and half width of the taper, length
    R: float = eqx.field(static=True, default=2.85)
    D: float = eqx.field(static=True, default=0.15)
    name: str = eqx.field(static=True, kw_only=True, default="tersoff")
    smoothness: Smoothness = eqx.field(static=True, kw_only=True, default=Smoothness(1, 0.0, 0.0))
    sources: tuple[str, ...] = eqx.field(
        static=True, kw_only=True, default=("J. Tersoff, Phys. Rev. B 38, 9902 (1988), set Si(C)",)
    )

    def __post_init__(self) -> None:
        if self.m not in (1, 3):
            raise InputError(f"the exponent m of the Tersoff potential is {self.m}; expected 1 or 3")

    @property
    def r_cut(self) -> Any:
        """Cutoff radius R + D, length."""
        return self.R + self.D

    def taper(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the taper: 1 up to R - D, then a squared sine that is 0 at R + D."""
        # (1 - sin(pi x / 2)) / 2 with x = (r - R) / D, in the form that does not cancel where it vanishes
        inward = jnp.clip((self.r_cut - r) / (2 * self.D), 0.0, 1.0)
        return jnp.sin(0.5 * np.pi * inward) ** 2

    def energy(self, positions, neighbor, cell):
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


# --- named sets of constants: a system file's `parameters` --------------------------------------------

_SETS: dict[str, tuple[Any, dict[str, dict[str, Any]]]] = {
    "stillinger-weber": (StillingerWeber, {"Si": {}}),
    # set Si(C), "T3"; of the multicomponent paper lambda3 = 0, and three constants rounded otherwise
    "tersoff": (Tersoff, {"Si": {}, "Si-1989": {
        "lambda3": 0.0, "beta": 1.1000e-6, "d": 16.217, "h": -0.59825,
        "sources": ("J. Tersoff, Phys. Rev. B 39, 5566 (1989), table I, silicon",),
    }}),
}  # fmt: skip


def named(
    kind: str, parameters: str = "Si", pbc: tuple[bool, bool, bool] = (True, True, True)
) -> StillingerWeber | Tersoff:
    """Return the potential "stillinger-weber" or "tersoff" with named constants.

    Raises:
        InputError: there is no set of constants with this name.
    """
    made, sets = _SETS[kind]
    if parameters not in sets:
        known = f"{'sets are' if len(sets) > 1 else 'set is'} {' and '.join(sets)}"
        raise InputError(f"{kind} has no parameter set called {parameters!r}; the available {known}")
    return made(**sets[parameters], pbc=pbc)
