"""A run in whole numbers: places, momenta and pair forces as multiples of fixed units.

All units of length, force and energy are powers of two, so a double that is a whole multiple of one of them
is that integer, exactly, and the rest of a rollout carries it as it carries any position. Sums of integers
have no order, the squared distance of a decision has no rounding, and a step that adds one integer to another
can be taken back by subtracting it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.md.cell import Cell
from mdnum.md.decide import PairDecider
from mdnum.md.potentials import CutPotential
from mdnum.numerics import Threshold

#: Listed distances are below 2^30 spacings: three of their squares fit a 64-bit integer.
REACH_BITS = 30
# steps of a thermal momentum, of a force of the scale of energy over the cutoff, and of that scale itself in
# a system of at least so many atoms
_MOMENTUM_BITS, _FORCE_BITS, _ENERGY_BITS = 44, 36, 48
_FEWEST = 1024


def power_of_two(x: float) -> float:
    """The smallest power of two that is at least x."""
    mantissa, exponent = math.frexp(x)
    return math.ldexp(1.0, exponent - 1 if mantissa == 0.5 else exponent)


@dataclass(frozen=True)
class Lattice:
    """The units in which a run counts.

    Attributes:
        spacing: of positions, length, the same along all axes.
        force: of pair forces, energy/length.
        energy: of pair energies, virials and kinetic energies.
        stretch: largest relative change of an edge of the box that made it a whole number of spacings.
    """

    spacing: float
    force: float
    energy: float
    stretch: float = 0.0

    @classmethod
    def create(
        cls,
        cell: Cell,
        r_list: float,
        model: CutPotential,
        momentum: Float[np.ndarray, "atoms"],
        kT: float,
        timestep: float,
    ) -> Lattice:
        """Units for a box, a list and a potential.

        The spacing is the finest at which squared distances of listed pairs are exact. The unit of force is
        the finest at which neither momenta nor forces leave the range of exact sums long before a run has
        blown up; with the time step it makes the unit of momentum.

        Args:
            cell: the box. r_list: radius of the neighbor lists, length.
            model: the potential with its cutoff.
            momentum: size of the momentum of each atom at the start and of a thermal one, whichever is
                larger, mass length/time.
            kT: temperature as an energy. timestep: internal time.

        Raises:
            InputError: the box is not orthorhombic, or so large that its coordinates are no longer exact.
        """
        spacing = power_of_two(1.001 * r_list / 2**REACH_BITS)
        scale = max(_depth(model), kT)
        force = scale / float(np.max(model.r_cut)) / 2**_FORCE_BITS
        force = max(force, 2 / timestep * float(np.max(momentum)) / 2**_MOMENTUM_BITS)
        energy = scale * max(len(momentum), _FEWEST) / 2**_ENERGY_BITS
        made = cls(spacing, power_of_two(force), power_of_two(energy))
        edges = np.diag(np.asarray(cell.matrix, np.float64))
        rounded = np.diag(np.asarray(made.cell(cell).matrix))
        whole = edges != 0
        stretch = float(np.max(np.abs(rounded[whole] / edges[whole] - 1), initial=0.0))
        return cls(made.spacing, made.force, made.energy, stretch)

    def cell(self, cell: Cell) -> Cell:
        """The box with edges that are whole numbers of spacings.

        Raises:
            InputError: it is not orthorhombic, or too large.
        """
        if not cell.orthorhombic:
            raise InputError(
                "a lattice of whole numbers needs a box with right angles along x, y and z",
                where="precision.state",
                remedy='Use state = "float64" for a tilted box',
            )
        matrix = np.round(np.asarray(cell.matrix, np.float64) / self.spacing)
        if np.max(np.abs(matrix)) >= 2**50:
            raise InputError("the box is too large for a lattice this fine", where="precision.state")
        made = Cell.create(matrix * self.spacing, cell.pbc)
        # an atom at the far face is at the near one: L times its inverse must not round below 1
        inverse, edges = np.array(made.inverse), np.diag(matrix * self.spacing)
        for k in range(3):
            if made.pbc[k] and edges[k] * inverse[k, k] < 1:
                inverse[k, k] = np.nextafter(inverse[k, k], np.inf)
        return eqx.tree_at(lambda one: one.inverse, made, inverse)

    def positions(self, x: Float[np.ndarray, "atoms 3"]) -> Float[np.ndarray, "atoms 3"]:
        """The nearest points of the lattice."""
        return np.round(np.asarray(x, np.float64) / self.spacing) * self.spacing

    def total(self, terms: Float[Any, "*shape"]) -> Float[Any, ""]:
        """The sum of energies, each rounded to the unit first: the same in every order (inside jit)."""
        return jnp.sum(jnp.round(terms * (1 / self.energy))) * self.energy

    def to_dict(self, timestep: float) -> dict[str, float]:
        """What a person may want to know about the units, in those of the system."""
        return {
            "spacing": self.spacing,
            "force": self.force,
            "momentum": self.force * timestep / 2,
            "energy": self.energy,
            "box_change": self.stretch,
        }


def _depth(model: CutPotential) -> float:
    """A scale of energy of a pair potential: its depth, or where it only repels, its height halfway in."""
    r_cut = np.asarray(model.r_cut, np.float64)
    r = r_cut * np.linspace(0.2, 1.0, 400)[:, None]
    energy = np.asarray(model.potential.evaluate(jnp.asarray(r * r))[0])
    depth = float(np.max(-np.where(np.isfinite(energy), energy, 0.0)))
    if depth > 0:
        return depth
    height = float(np.max(np.abs(energy[len(r) // 2])))
    return height if height > 0 else float(np.max(np.abs(energy[np.isfinite(energy)]), initial=1.0))


@dataclass(frozen=True)
class LatticeDecider(PairDecider):
    """Whether a pair is inside, as a comparison of two integers.

    The squared distance is a whole number of squared spacings. Each convention becomes `r2 < limit` with a
    whole limit; the threshold that margins are measured from lies half a step below it, so no margin is zero
    and none has a rounding error.

    Attributes:
        spacing: of the lattice, length.
    """

    spacing: float = 1.0

    @property
    def space(self) -> str:
        """Squares are compared, whatever the convention: of whole numbers that is the same."""
        return "r2"

    @property
    def limits(self) -> tuple[int, ...]:
        """Squared distances in squared spacings from which on a pair is outside, by pair type."""
        unit = Fraction(self.spacing) ** 2
        square = self.compare.startswith("r2")
        exact = [(Fraction(r * r) if square else Fraction(r) ** 2) / unit for r in self.r_cut]
        return tuple(math.floor(q) + 1 if self.compare.endswith("<=") else math.ceil(q) for q in exact)

    @property
    def thresholds(self) -> tuple[Threshold, ...]:
        """Half a squared step below the limits, as doubles."""
        unit = self.spacing * self.spacing
        return tuple(Threshold((limit - 0.5) * unit, "<", "r2") for limit in self.limits)

    @cached_property
    def bounds(self) -> tuple[float, ...]:
        """Nothing is rounded, and no margin is zero."""
        return (0.0,) * len(self.r_cut)

    def inside(self, quantity, value):
        """The decision, of integers or of what they stand for."""
        return quantity < value

    def host_squares(self, dx, dy, dz) -> Int[np.ndarray, "..."]:
        """Squared distances in squared spacings."""
        edge = float(2**REACH_BITS)
        parts = (np.round(np.asarray(c, np.float64) / self.spacing) for c in (dx, dy, dz))
        whole = [np.clip(c, -edge, edge).astype(np.int64) for c in parts]
        return whole[0] * whole[0] + whole[1] * whole[1] + whole[2] * whole[2]

    def host_quantity(self, dx, dy, dz) -> Float[np.ndarray, "..."]:
        """Squared distances, rounded once."""
        return self.host_squares(dx, dy, dz).astype(np.float64) * (self.spacing * self.spacing)

    def host_margin(self, displacement, kind) -> Float[np.ndarray, "..."]:
        """Margins, exact before they become doubles."""
        left = np.asarray(self.limits, np.int64)[kind] - self.host_squares(*displacement)
        return (left - 0.5) * (self.spacing * self.spacing)
