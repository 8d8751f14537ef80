"""One step of molecular dynamics that is told its decisions: the contract of mdnum.dynamics, met by pairs."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from mdnum.md.decide import SlotJudge, Tables
from mdnum.md.integrators import Integrator
from mdnum.md.pairforce import PairForce


class MdState(NamedTuple):
    """Between two force evaluations, in the order of the tables.

    Attributes:
        step: the step whose forces come next.
        x: wrapped positions at that step, shape (3, atoms).
        v: velocities after the first half kick (at step 0: the initial velocities), shape (3, atoms).
    """

    step: Int[Array, ""]
    x: Float[Array, "3 atoms"]
    v: Float[Array, "3 atoms"]


class PairDynamics(eqx.Module):
    """Pairs of a fixed list that flip when they are told to.

    For replays (one run handed the decisions of another) and for gradients at fixed decisions. A rollout
    does the same in its compiled epochs, where the decisions are the list's own.

    Attributes:
        force: the pair force.
        integrator: between force evaluations.
        masses: in the order of the tables, shape (atoms,).
        tables: the list.
    """

    force: PairForce
    integrator: Integrator
    masses: Float[Array, "atoms"]
    tables: Tables

    def margins(self, state: MdState) -> Float[Array, "groups 4 atoms"]:
        """Threshold minus quantity of every slot, positive inside; -inf for padding."""
        judge = SlotJudge(self.force.decider, self.force.cell, self.force.zero, state.x)
        index, types = self.tables.groups()

        def margin(j, kinds):
            _, quantity, _, threshold = judge.group(j, kinds)
            return jnp.where(j < judge.atoms, threshold - quantity, -jnp.inf)

        groups = [margin(index[g], None if types is None else types[g]) for g in range(index.shape[0])]
        return jnp.stack(groups)

    def decide(self, state: MdState) -> UInt8[Array, "words atoms"]:
        """The list's own decisions."""
        return self.force.decide(state.x, self.tables).bits

    def step(self, state: MdState, decisions: UInt8[Array, "words atoms"]) -> MdState:
        """Forces from the pairs that are decided to be inside, both half kicks, and the drift."""
        dtype = state.x.dtype
        made = self.force(state.x, self.tables, decisions=False, given=decisions)
        acceleration = made.force.astype(dtype) / self.masses.astype(dtype)
        half = (0.5 * self.integrator.timestep).astype(dtype)
        mass_row = self.masses.astype(dtype)
        second_half = jnp.where(state.step == 0, jnp.zeros((), dtype), half)
        v = self.integrator.kick(state.v, second_half, acceleration, mass_row)
        v = self.integrator.kick(v, half, acceleration, mass_row)
        x, v, _ = self.integrator.drift(state.x, v, self.masses, state.step, self.tables.order)
        wrapped, _ = self.force.cell.astype(dtype).wrap(*x)
        return MdState(state.step + 1, jnp.stack(wrapped), v)
