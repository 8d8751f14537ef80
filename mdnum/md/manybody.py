"""What every many-body potential offers: an energy over a neighbor list, and what follows from it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.md.jaxmd import Format, NeighborList, displacement, neighbor_vectors, standard_promotion, upstream


@dataclass(frozen=True)
class Smoothness:
    """What happens to the energy when a pair crosses r_cut.

    Attributes:
        order: continuous derivatives of the energy at r_cut: -1 where the energy itself jumps, 0 where only
            the force does, math.inf where every derivative vanishes.
        energy_jump: largest jump of the energy at one crossing, energy.
        force_jump: largest jump of a force at one crossing, energy/length.
    """

    order: float
    energy_jump: float
    force_jump: float


class Described(Protocol):
    """The attributes of every potential here, beside the methods of ManyBody.

    A protocol and not abstract fields, because some are computed from the constants.

    Attributes:
        name: as in a system file.
        r_cut: longest interaction radius, length.
        format: the neighbor list format that energy takes.
        pbc: which axes are periodic.
        smoothness: at r_cut.
        sources: papers of the form and its constants.
    """

    @property
    def name(self) -> str: ...
    @property
    def r_cut(self) -> float: ...
    @property
    def format(self) -> Format: ...
    @property
    def pbc(self) -> tuple[bool, bool, bool]: ...
    @property
    def smoothness(self) -> Smoothness: ...
    @property
    def sources(self) -> tuple[str, ...]: ...


class ManyBody(eqx.Module):
    """A potential whose energy is not a sum over pairs; it has the attributes of Described.

    Decisions are made outside: the list handed in holds the pairs that count, and an entry replaced by the
    number of atoms is a pair that does not. Every potential also tests r < r_cut itself, so that a list with
    a skin gives the same energy.
    """

    def energy(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, ""]:
        """Potential energy; differentiable with respect to positions and cell.

        Args:
            positions: length; they need not lie in the cell.
            neighbor: a list in this potential's format, both directions, no atom its own neighbor.
            cell: lattice vectors as rows, length.
        """
        raise NotImplementedError(f"{type(self).__name__} defines no energy")

    def forces(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, "atoms 3"]:
        """Minus the gradient of the energy, energy/length."""
        return -jax.grad(self.energy)(positions, neighbor, cell)

    def evaluate(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> tuple[Float[Array, ""], Float[Array, "atoms 3"], Float[Array, "3 3"]]:
        """Energy, forces and stress in one pass.

        Returns:
            energy; forces (atoms, 3); stress (3, 3), energy/length³ in ASE's sign: (1/V) dE/d(strain),
            positive where the cell wants to shrink. It means something only for a cell with a volume.
        """
        identity = jnp.eye(3, dtype=positions.dtype)

        def strained(points: Array, strain: Array) -> Array:
            # the symmetric part alone: the energy does not see rotations, its rounding does
            map_ = identity + 0.5 * (strain + strain.T)
            return self.energy(points @ map_, neighbor, cell.astype(points.dtype) @ map_)

        zero = jnp.zeros((3, 3), positions.dtype)
        energy, (slope, virial) = jax.value_and_grad(strained, argnums=(0, 1))(positions, zero)
        return energy, -slope, virial / jnp.abs(jnp.linalg.det(cell)).astype(positions.dtype)


# --- stillinger and Weber's silicon, through jax-md's energy function ---------------------------------

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


# --- tersoff's bond-order potential, written out because jax-md's cannot be mended from outside -------

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


# --- any jax-md energy function over a neighbor list, as a many-body potential ------------------------


class Wrapped(ManyBody):
    """A jax-md energy function with the attributes that mdnum needs beside it."""

    energy_fn: Callable[..., Array] = eqx.field(static=True)
    r_cut: float = eqx.field(static=True)
    format: Format = eqx.field(static=True)
    pbc: tuple[bool, bool, bool] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    smoothness: Smoothness = eqx.field(static=True)
    sources: tuple[str, ...] = eqx.field(static=True)

    def energy(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, ""]:
        """Potential energy, in the units of the function wrapped; see ManyBody.energy."""
        return self.energy_fn(positions, neighbor, cell=cell)

    def check_cell(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> None:
        """Raise if the function does not follow the cell it is given.

        jax_md.space's own displacements swallow the keyword and keep the box they were made with: energies
        look right and stresses are silently wrong. Shifting one atom by a lattice vector of a slightly
        larger cell must not change the energy in that cell.

        Raises:
            InputError: it does not.
        """
        larger = cell * 1.03125
        axis = next((axis for axis in range(3) if self.pbc[axis]), None)
        if axis is None:
            return
        points = np.asarray(positions)
        moved = points.copy()
        moved[0] += np.asarray(larger)[axis]
        here = float(self.energy(jnp.asarray(points), neighbor, larger))
        there = float(self.energy(jnp.asarray(moved), neighbor, larger))
        if not abs(here - there) <= 1e-6 * max(abs(here), 1.0):
            raise InputError(
                f"{self.name}: the energy function ignores the cell it is given (a move by a lattice vector "
                f"changes the energy from {here:g} to {there:g})",
                remedy="build it on mdnum.md.jaxmd.displacement instead of a space of jax_md.space",
            )


def from_jax_md(
    energy_fn: Callable[..., Array],
    r_cut: float,
    format: Format = "dense",
    *,
    pbc: tuple[bool, bool, bool] = (True, True, True),
    name: str = "jax-md",
    smoothness: Smoothness | None = None,
    sources: tuple[str, ...] = (),
) -> Wrapped:
    """Wrap a jax-md energy function `energy_fn(positions, neighbor, cell=...)`.

    Build it on `mdnum.md.jaxmd.displacement(cell, pbc)` and hand its constants in as
    `mdnum.md.jaxmd.scalar(...)`: anything else becomes float32 in silence. The function must test r < r_cut
    itself, or its energy depends on when the list was built.

    Args:
        energy_fn: the second of the pair that jax-md's `*_neighbor_list` functions return.
        r_cut: longest interaction radius, length.
        format: neighbor list format that it takes.
        smoothness: at r_cut; if not given, nothing is promised (order -1, jumps unknown: NaN).
    """
    if not (np.isfinite(r_cut) and r_cut > 0):
        raise InputError(f"an interaction radius above 0 is needed; got {r_cut}")
    unknown = Smoothness(-1, float("nan"), float("nan"))
    return Wrapped(
        energy_fn=jax.named_call(energy_fn, name=name),
        r_cut=float(r_cut),
        format=format,
        pbc=pbc,
        name=name,
        smoothness=unknown if smoothness is None else smoothness,
        sources=sources,
    )


# --- potentials that are no sum over pairs: Stillinger-Weber, Tersoff, embedded atom ------------------

_PERIODIC = (True, True, True)


def stillinger_weber(parameters: str = "Si", pbc: tuple[bool, bool, bool] = _PERIODIC) -> StillingerWeber:
    """Stillinger-Weber with a named set of constants (a system file's `parameters`).

    Raises:
        InputError: no such set.
    """
    if parameters != "Si":
        raise InputError(f"no Stillinger-Weber constants called {parameters!r}; known is Si")
    return StillingerWeber(pbc=pbc)


def tersoff(parameters: str = "Si", pbc: tuple[bool, bool, bool] = _PERIODIC) -> Tersoff:
    """Tersoff with a named set of constants: Si (1988, set Si(C), "T3") or Si-1989.

    Raises:
        InputError: no such set.
    """
    if parameters == "Si":
        return Tersoff(pbc=pbc)
    if parameters == "Si-1989":
        return silicon_1989(pbc)
    raise InputError(f"no Tersoff constants called {parameters!r}; known are Si and Si-1989")
