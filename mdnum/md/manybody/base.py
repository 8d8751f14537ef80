"""What every many-body potential offers: an energy over a neighbor list, and what follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mdnum.md.jaxmd import Format, NeighborList


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
