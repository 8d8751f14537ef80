"""The reverse pass of any conservative force, by forward over reverse differentiation of its energy.

The transpose of a force is its own Jacobian-vector product: one tangent through one gradient of the energy,
whatever the energy is. No tape of a step is kept, and the pairs are those that the run acted on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, UInt8

from mdnum.errors import InputError
from mdnum.gradients.pairs import FORCE, MODEL, SCALE, PairCotangents
from mdnum.gradients.parameters import quantities, with_quantities
from mdnum.md.decide import PairDecider, Tables
from mdnum.md.jaxmd import Format, NeighborList
from mdnum.md.manybody import ManyBody, Smoothness
from mdnum.md.manyforce import ManyBodyForce
from mdnum.md.verlet import check_radius
from mdnum.precision import PrecisionPolicy
from mdnum.systems.build import Simulation


def pull_back(
    force: ManyBodyForce,
    x: Float[Array, "3 atoms"],
    tables: Tables,
    bits: UInt8[Array, "words atoms"],
    onto_force: Float[Array, "3 atoms"],
    onto_energy: Float[Array, ""],
    onto_virial: Float[Array, ""],
    wanted: frozenset[str] = frozenset(),
) -> PairCotangents:
    """The transpose of one evaluation of forces, energy and virial at given decisions.

    As `mdnum.gradients.pairs.pull_back`, for an energy that is no sum over pairs.

    Args:
        force: of a many-body potential.
        x: sorted, wrapped positions, length, shape (3, atoms).
        tables: the list.
        bits: the decisions that were acted on, packed.
        onto_force: cotangent of the forces, shape (3, atoms).
        onto_energy, onto_virial: cotangents of the potential energy and of the virial.
        wanted: of MODEL, SCALE and FORCE; what is not wanted comes back as zeros.
    """
    values = quantities(force)
    neighbor = force.neighbors(lax.stop_gradient(x), tables, bits)
    matrix = jnp.asarray(force.cell.matrix)
    w, virial = onto_force.T.astype(jnp.float64), onto_virial.astype(jnp.float64)

    def energy(x, values, scale):
        other: Any = with_quantities(force, values)
        return other.potential.energy(x * scale, neighbor, matrix * scale)

    at = (x.T.astype(jnp.float64), values, jnp.ones((), jnp.float64))
    still = jax.tree.map(jnp.zeros_like, values)
    if MODEL in wanted:
        slope = jax.grad(energy, argnums=(0, 1, 2))
        (by_x, by_model, by_scale), (bend_x, bend_model, bend_scale) = jax.jvp(slope, at, (w, still, virial))
        model = jax.tree.map(lambda bend, one: onto_energy * one - bend, bend_model, by_model)
    else:
        slope = jax.grad(lambda x, scale: energy(x, values, scale), argnums=(0, 1))
        (by_x, by_scale), (bend_x, bend_scale) = jax.jvp(slope, (at[0], at[2]), (w, virial))
        model = still
    # forces on atoms that are measured in units of the box shrink with the square of its scale
    scale = 2 * jnp.sum(w * by_x) - bend_scale + (onto_energy - virial) * by_scale
    return PairCotangents(
        (onto_energy * by_x - bend_x).T.astype(x.dtype),
        model,
        scale if SCALE in wanted else jnp.zeros_like(scale),
        -by_x.T.astype(x.dtype) if FORCE in wanted else jnp.zeros_like(x),
    )


class EnergyFunction(ManyBody):
    """An energy with parameters in any pytree, over a neighbor list of jax-md.

    Attributes:
        parameters: a pytree of arrays; each is a parameter `potential.parameters...` by its path.
        function: (parameters, positions (atoms, 3), neighbor, cell (3, 3)) to energy, length and energy units
            of the system. It must test r < r_cut itself.
        r_cut: longest interaction radius, length.
        format: the neighbor list format that it takes.
        pbc: which axes are periodic.
        name: for messages. smoothness: at r_cut. sources: papers.
    """

    parameters: Any
    function: Callable[..., Array] = eqx.field(static=True)
    r_cut: float = eqx.field(static=True)
    format: Format = eqx.field(static=True, default="dense")
    pbc: tuple[bool, bool, bool] = eqx.field(static=True, default=(True, True, True))
    name: str = eqx.field(static=True, default="energy function")
    smoothness: Smoothness = eqx.field(static=True, default=Smoothness(-1, float("nan"), float("nan")))
    sources: tuple[str, ...] = eqx.field(static=True, default=())

    def energy(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, ""]:
        """Potential energy; see ManyBody.energy."""
        return self.function(self.parameters, positions, neighbor, cell)


def with_potential(simulation: Simulation, potential: ManyBody) -> Simulation:
    """The system with another potential: any energy over a neighbor list, such as one of jax-md's.

    Args:
        simulation: the system as objects; in float64.
        potential: an `EnergyFunction`, or one of `mdnum.md.manybody`.

    Raises:
        InputError: its radius and the skin do not fit the box, or the system is not in float64 throughout.
    """
    if simulation.policy != PrecisionPolicy():
        raise InputError(
            "many-body potentials are evaluated in float64 only", remedy="Remove the [precision] table"
        )
    radius = float(potential.r_cut)  # type: ignore[attr-defined]
    check_radius(simulation.cell, radius, simulation.rule.skin)
    decider = PairDecider((radius,), "r <", "float64", simulation.decider.reach)
    return replace(simulation, model=potential, decider=decider)
