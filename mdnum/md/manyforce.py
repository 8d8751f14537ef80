"""The general path: any energy function over a neighbor list, told which pairs are inside.

The list that the energy function receives holds only the pairs that were decided to be inside its longest
interaction radius, so the recorded decision is the one it acted on.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt8

from mdnum.md.cell import Cell
from mdnum.md.decide import Decisions, PairDecider, Tables, decide_table
from mdnum.md.pairforce import Forces
from mdnum.numerics import PrecisionPolicy
from mdnum.numerics.exact import zero_bits


class ManyBodyForce(eqx.Module):
    """Forces of an energy function over a jax-md neighbor list, by automatic differentiation.

    Attributes:
        potential: energy(positions (atoms, 3), neighbor, cell (3, 3)) -> energy, with `format`.
        cell, zero, decider, policy: as in PairForce. The energy itself is always float64.
    """

    potential: eqx.Module
    cell: Cell
    zero: Int[Array, ""]
    decider: PairDecider = eqx.field(static=True)
    policy: PrecisionPolicy = eqx.field(static=True)

    @classmethod
    def create(cls, potential, cell: Cell, decider: PairDecider, policy: PrecisionPolicy) -> ManyBodyForce:
        """The box as jax arrays."""
        return cls(
            potential, cell.astype(np.float64), zero_bits(policy.dtype("decision")), decider.bare, policy
        )

    def decide(self, positions: Float[Array, "3 atoms"], tables: Tables) -> Decisions:
        """The decisions of a list at given positions."""
        return decide_table(self.decider, self.cell, self.zero, positions, tables)

    def __call__(self, positions: Float[Array, "3 atoms"], tables: Tables, *, decisions: bool) -> Forces:
        """Forces at wrapped positions; as PairForce, the whole energy counted on the first atom."""
        made = self.decide(positions, tables)
        total, slope, strain = self._differentiate(positions, tables, made)
        return Forces(
            -slope.T,
            jnp.zeros(positions.shape[1], jnp.float64).at[0].set(total),
            -jnp.trace(strain),
            made if decisions else None,
        )

    def virial_tensor(self, positions: Float[Array, "3 atoms"], tables: Tables) -> Float[Array, "3 3"]:
        """Minus the derivative of the energy by strain."""
        _, _, strain = self._differentiate(positions, tables, self.decide(positions, tables))
        return -0.5 * (strain + strain.T)

    def neighbors(
        self, positions: Float[Array, "3 atoms"], tables: Tables, bits: UInt8[Array, "words atoms"]
    ) -> Any:
        """The list that the energy function receives: the pairs that are decided to be inside, no others."""
        from mdnum.md import jaxmd

        words, slots, atoms = tables.index.shape
        shifts = jnp.arange(slots, dtype=jnp.uint8)[None, :, None]
        inside = (bits[:, None, :] >> shifts) & jnp.uint8(1) == 1
        acted_on = jnp.where(inside, tables.index, atoms).reshape(words * slots, atoms).T
        x = positions.T.astype(jnp.float64)
        return jaxmd.as_neighbor_list(acted_on, x, self.potential.format)  # type: ignore[attr-defined]

    def _differentiate(self, positions, tables: Tables, made: Decisions):
        """Energy, and its derivatives by positions and by strain."""
        neighbor = self.neighbors(lax.stop_gradient(positions), tables, made.bits)

        # the table is in sorted order and so is everything the energy function sees
        def energy(x, strain):
            deform = jnp.eye(3, dtype=jnp.float64) + strain
            return self.potential.energy(x @ deform, neighbor, self.cell.matrix @ deform)  # type: ignore[attr-defined]

        x = positions.T.astype(jnp.float64)
        total, (slope, strain) = jax.value_and_grad(energy, argnums=(0, 1))(x, jnp.zeros((3, 3), jnp.float64))
        return total, slope, strain
