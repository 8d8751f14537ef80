"""Many-body potentials: energies over a neighbor list. Forces and stress are their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mdnum.md.jaxmd import NeighborList


@dataclass(frozen=True)
class Smoothness:
    """Smoothness at r_cut of the energy as a function of a pair distance."""

    # continuous derivatives of the energy at r_cut: -1 where the energy itself jumps, 0 where only the force
    # does, math.inf where every derivative vanishes
    order: float
    energy_jump: float  # largest jump of the energy at one crossing, energy
    force_jump: float  # largest jump of a force at one crossing, energy/length


#: Smoothness about which nothing is known.
_UNKNOWN = Smoothness(-1, float("nan"), float("nan"))


class ManyBody(eqx.Module):
    """Base class of potentials whose energy is not a sum over pairs.

    In a run, the neighbor list contains only pairs inside the cutoff. Neighbor indices equal to the number of
    atoms are padding. Every potential also tests r < r_cut, so a neighbor list may have a skin.

    Attributes:
        pbc: which axes are periodic.
        name: name in a system file.
        format: neighbor list format that `energy` accepts; "any" before the trial calls.
        smoothness: smoothness of the energy at r_cut.
        sources: references for the functional form and its constants.
        r_cut: longest interaction radius, length; a field, or computed from the constants.
        trusts_list: whether the energy includes every listed pair near r_cut, so that imposed decisions take
            effect.
        labeled: whether the function distinguishes atoms by their index in the structure (stored species or
            charges), so that it must be called with atoms in the order of the structure.
        self_edges: whether each atom is listed as its own neighbor.
        compare: comparison that defines "inside".
    """

    pbc: tuple[bool, bool, bool] = eqx.field(static=True, kw_only=True, default=(True, True, True))
    name: str = eqx.field(static=True, kw_only=True, default="")
    format: Any = eqx.field(static=True, kw_only=True, default="dense")
    smoothness: Smoothness = eqx.field(static=True, kw_only=True, default=_UNKNOWN)
    sources: tuple[str, ...] = eqx.field(static=True, kw_only=True, default=())
    trusts_list: bool = eqx.field(static=True, kw_only=True, default=False)
    labeled: bool = eqx.field(static=True, kw_only=True, default=False)
    self_edges: bool = eqx.field(static=True, kw_only=True, default=False)
    compare: str = eqx.field(static=True, kw_only=True, default="r <")

    def energy(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, ""]:
        """Return the potential energy, which is differentiable with respect to positions and cell.

        Args:
            positions: positions, length; they may be outside the cell.
            neighbor: a list in the format of this potential, with both directions, and no atom as its own
                neighbor.
            cell: lattice vectors as rows, length.
        """
        raise NotImplementedError(f"{type(self).__name__} defines no energy")

    def deformed(
        self,
        positions: Float[Array, "atoms 3"],
        neighbor: NeighborList,
        cell: Float[Array, "3 3"],
        deformation: Float[Array, "3 3"],
    ) -> Float[Array, ""]:
        """Return the energy after a deformation of positions and lattice vectors (rows)."""
        return self.energy(positions @ deformation, neighbor, cell @ deformation)

    def forces(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, "atoms 3"]:
        """Return the forces, the negative gradient of the energy, in energy/length."""
        return -jax.grad(self.energy)(positions, neighbor, cell)

    def evaluate(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> tuple[Float[Array, ""], Float[Array, "atoms 3"], Float[Array, "3 3"]]:
        """Return energy, forces and stress, computed in one pass.

        Returns:
            energy; forces (atoms, 3); stress (3, 3), energy/length³ in ASE's sign: (1/V) dE/d(strain),
            positive if the cell tends to shrink. The stress is meaningful only for a cell with a volume.
        """
        identity = jnp.eye(3, dtype=positions.dtype)

        def strained(points: Array, strain: Array) -> Array:
            # the symmetric part alone: the energy does not see rotations, its rounding does
            deformation = identity + 0.5 * (strain + strain.T)
            return self.deformed(points, neighbor, cell.astype(points.dtype), deformation)

        zero = jnp.zeros((3, 3), positions.dtype)
        energy, (slope, virial) = jax.value_and_grad(strained, argnums=(0, 1))(positions, zero)
        return energy, -slope, virial / jnp.abs(jnp.linalg.det(cell)).astype(positions.dtype)


def leaves_by_path(potential: Any) -> dict[str, Any]:
    """Return the arrays of a potential by their paths, such as "pair.values"."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(potential)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def quantities_of(potential: Any) -> dict[str, Any]:
    """Return all numerical parameters of a many-body potential, arrays and constants, by name."""
    found = {name: leaf for name, leaf in leaves_by_path(potential).items() if eqx.is_inexact_array(leaf)}
    for field in fields(potential):
        value = getattr(potential, field.name)
        # constants that a formula holds; the radius of a table is where it ends, and not one of them
        if type(value) is float and field.name != "r_cut":
            found[field.name] = jnp.asarray(value, jnp.float64)
    return found


def with_quantities(potential: Any, values: Mapping[str, Any]) -> Any:
    """Return a copy of the potential with other parameter values. Also works inside jit."""
    names, tree = list(leaves_by_path(potential)), jax.tree.structure(potential)
    leaves = [values.get(name, leaf) for name, leaf in zip(names, jax.tree.leaves(potential), strict=True)]
    whole = jax.tree.unflatten(tree, leaves)
    # constants are static fields, so that a module would warn of an array; here they only live for a trace
    out = object.__new__(type(potential))
    for field in fields(potential):
        static = field.name in values and field.name not in names
        object.__setattr__(out, field.name, values[field.name] if static else getattr(whole, field.name))
    return out
