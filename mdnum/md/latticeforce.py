"""Pair forces between whole numbers: decided exactly, rounded pair by pair, summed without rounding.

The force of a pair is computed in float64 from the exact integer distance, by operations that every compiler
rounds alike, and rounded to the unit of force. Seen from the other end it is the same number with the other
sign, so momentum is conserved to the last bit; and a sum of integers has no order, so neither the labels of
the atoms nor the list decide any digit.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, UInt8

from mdnum.errors import InputError
from mdnum.md.cell import Cell
from mdnum.md.cutoffs import AtCutoff
from mdnum.md.decide import Decisions, SlotJudge, Tables, displacements, halves_of, packed, unpacked
from mdnum.md.lattice import REACH_BITS, Lattice, LatticeDecider
from mdnum.md.pairforce import Forces, PairForce, other_than
from mdnum.md.potentials import CutPotential, of_type
from mdnum.numerics.exact import fence, zero_bits
from mdnum.numerics.reproducible import reproducible

# added to a double below 2^51 it leaves the nearest integer in the low bits
_ROUND = 1.5 * 2**52
_ROUND_BITS = int(np.float64(_ROUND).view(np.int64))


@jax.custom_jvp
def counted(x: Float[Array, "*shape"], zero: jax.Array) -> jax.Array:
    """The nearest integer of numbers below 2^51, plus `_ROUND_BITS`: one addition."""
    return lax.bitcast_convert_type(fence(x, zero) + _ROUND, jnp.int64)


@counted.defjvp
def _counted_jvp(primals, tangents):
    # a derivative of 0 would be taken for an answer
    raise InputError(
        "a program in whole numbers has no derivative of its own",
        where="precision.state",
        remedy="Use the method reversible or symmetric, which count a rounding as the identity",
    )


class LatticeJudge(SlotJudge):
    """Decides as `SlotJudge` does, with integers.

    Args:
        decider: the convention. cell: the box. zero: integer zero that XLA must not know.
        positions: sorted, wrapped, shape (3, atoms), length.
        lattice: the units.
    """

    def __init__(self, decider: LatticeDecider, cell: Cell, zero, positions, lattice: Lattice):
        inverse = 1 / lattice.spacing
        self.decider, self.zero, self.lattice = decider, zero, lattice
        # powers of two, so nothing is rounded but positions that were not on the lattice
        self.cell = Cell(cell.matrix * inverse, cell.inverse * lattice.spacing, cell.pbc, cell.orthorhombic)
        self.components = tuple(jnp.round(positions.astype(jnp.float64) * inverse))
        self.atoms = positions.shape[1]
        self.value = jnp.asarray(decider.limits, jnp.int64)

    def start(self) -> jax.Array:
        """An empty tally: the smallest distance from the limit of each atom, in squared spacings."""
        return jnp.full(self.atoms, jnp.iinfo(jnp.int64).max, jnp.int64)

    def group(self, j, types):
        """Displacement in spacings, squared distance, decision and limit of some neighbors of every atom."""
        d = displacements(self.components, self.cell, j)
        edge = float(2**REACH_BITS)
        # what is further away than any listed pair is outside; its square might not fit
        squares = []
        for c in d:
            whole = lax.bitcast_convert_type(jnp.clip(c, -edge, edge) + _ROUND, jnp.int64)
            # the low half is the integer: a product of two halves is one that every processor has
            whole = whole.astype(jnp.int32).astype(jnp.int64)
            squares.append(whole * whole)
        r2 = squares[0] + squares[1] + squares[2]
        limit = of_type(self.value, types)
        return d, r2, (r2 < limit) & (j < self.atoms), limit

    def tally(self, nearest, quantity, inside, threshold):
        """Decisions of a group as the low bits of a byte per atom, and the nearest margin so far."""
        bits = jnp.zeros(self.atoms, jnp.uint8)
        left = threshold - quantity
        away = jnp.maximum(left, 1 - left)
        for k in range(inside.shape[0]):
            bits = bits | (inside[k].astype(jnp.uint8) << jnp.uint8(k))
            nearest = jnp.minimum(nearest, away[k])
        return bits, nearest

    def finish(self, nearest, halves) -> Decisions:
        """The pass's decisions, two groups to a byte."""
        unit = self.lattice.spacing * self.lattice.spacing
        closest = jnp.min(nearest, initial=jnp.iinfo(jnp.int64).max)
        return Decisions(packed(halves), (closest.astype(jnp.float64) - 0.5) * unit)


class LatticeForce(PairForce):
    """Forces and decisions of a cut pair potential on a lattice.

    Attributes:
        lattice: the units.
        closest: squared distance below which a pair leaves the range of exact sums.
    """

    lattice: Lattice = eqx.field(static=True, kw_only=True)
    closest: Float[Array, ""] = eqx.field(kw_only=True)

    @classmethod
    def on(
        cls, lattice: Lattice, model: CutPotential, cell: Cell, decider, policy, reduction
    ) -> LatticeForce:
        """The parameters in float64; sums are exact, so the reduction makes no difference."""
        return cls(
            model.astype(np.float64),
            cell.astype(np.float64),
            zero_bits(np.float64),
            decider.bare,
            policy,
            reduction,
            lattice=lattice,
            closest=jnp.asarray(_closest(model, lattice), jnp.float64),
        )

    @property
    def law(self) -> Any:
        """The potential with bits that no compiler changes."""
        return _Reproducible(self.model, self.zero)

    def judge(self, positions: Float[Array, "3 atoms"]) -> LatticeJudge:
        """What decides at these positions."""
        assert isinstance(self.decider, LatticeDecider)
        return LatticeJudge(self.decider, self.cell, self.zero, positions, self.lattice)

    def decide(self, positions: Float[Array, "3 atoms"], tables: Tables) -> Decisions:
        """The decisions of a list at given positions, without forces."""
        judge = self.judge(positions)

        def block(nearest, listed):
            _, quantity, inside, threshold = judge.group(*listed)
            bits, nearest = judge.tally(nearest, quantity, inside, threshold)
            return nearest, bits

        nearest, halves = lax.scan(block, judge.start(), tables.groups())
        return judge.finish(nearest, halves)

    def __call__(
        self,
        positions: Float[Array, "3 atoms"],
        tables: Tables,
        *,
        decisions: bool,
        given: UInt8[Array, "words atoms"] | None = None,
        where: UInt8[Array, "words atoms"] | None = None,
    ) -> Forces:
        """As `PairForce`: forces that are whole multiples of the unit of force.

        Where a pair is so close that its force would leave the range of exact sums, the energy is NaN.
        """
        judge, lattice = self.judge(positions), self.lattice
        law, zero = self.law, self.zero
        at = law.at_cutoff()
        unit = lattice.spacing * lattice.spacing
        steps = lattice.spacing / lattice.force
        # what a pair outside is evaluated at
        far = max(self.decider.r_cut) ** 2

        def block(carry, listed):
            totals, nearest, close = carry
            (j, types), told, pinned = listed
            d, quantity, inside, threshold = judge.group(j, types)
            bits = None
            if decisions:
                bits, nearest = judge.tally(nearest, quantity, inside, threshold)
            if told is not None:
                asked = other_than(inside, told)
                inside = inside ^ (asked if pinned is None else asked & unpacked(pinned))
            # the argument is masked, not only the result: a padded slot may be at distance zero
            r2 = jnp.where(inside, quantity.astype(jnp.float64) * unit, far)
            energy, slope = law.evaluate(r2, types, at)
            energy, slope = jnp.where(inside, energy, 0), jnp.where(inside, slope, 0)
            pull = slope + slope
            # worked out once: each component's loop would work it out again
            force, d = lax.optimization_barrier((pull * steps, d))
            terms = (*(force * c for c in d), energy * (1 / lattice.energy), pull * r2 * (1 / lattice.energy))
            added = []
            for total, term in zip(totals, terms, strict=True):
                whole = counted(term, zero)
                for k in range(whole.shape[0]):
                    total = total + whole[k]
                added.append(total)
            for k in range(r2.shape[0]):
                close = jnp.minimum(close, r2[k])
            return (tuple(added), nearest, close), bits

        atoms = judge.atoms
        start = ((jnp.zeros(atoms, jnp.int64),) * 5, judge.start(), jnp.full(atoms, far))
        told, pinned = (None if bits is None else halves_of(bits) for bits in (given, where))
        (totals, nearest, close), halves = lax.scan(block, start, (tables.groups(), told, pinned))
        slots = tables.index.shape[0] * tables.index.shape[1]
        # of 64-bit integers the sum wraps round, and this takes off what wrapped
        excess = jnp.asarray((slots * _ROUND_BITS + 2**63) % 2**64 - 2**63, jnp.int64)
        *summed, virial = (total - excess for total in totals)
        fx, fy, fz, energy = (total.astype(jnp.float64) for total in summed)
        exact = jnp.min(close) > self.closest
        return Forces(
            jnp.stack([fx, fy, fz]) * lattice.force,
            jnp.where(exact, energy, jnp.nan) * (0.5 * lattice.energy),
            # both ends of a pair count, and a pressure may be large: summed as integers to the end
            jnp.sum(virial).astype(jnp.float64) * (-0.5 * lattice.energy),
            judge.finish(nearest, halves) if decisions else None,
        )

    def virial_tensor(self, positions: Float[Array, "3 atoms"], tables: Tables) -> Float[Array, "3 3"]:
        """As `PairForce`, in plain float64: the stress of one configuration."""
        judge = self.judge(positions)
        law, spacing = self.model, self.lattice.spacing
        at = law.at_cutoff()

        def block(totals, listed):
            j, types = listed
            d, quantity, inside, _ = judge.group(j, types)
            r2 = jnp.where(inside, quantity.astype(jnp.float64) * (spacing * spacing), 1.0)
            slope = jnp.where(inside, law.evaluate(r2, types, at)[1], 0) * (spacing * spacing)
            sums = [jnp.sum(slope * d[a] * d[b], axis=0) for a, b in _VOIGT]
            return tuple(total + q for total, q in zip(totals, sums, strict=True)), None

        start = (jnp.zeros(judge.atoms, jnp.float64),) * 6
        totals, _ = lax.scan(block, start, tables.groups())
        xx, yy, zz, yz, xz, xy = (-jnp.sum(total) for total in totals)
        return jnp.stack([jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])])


def _closest(model: CutPotential, lattice: Lattice) -> float:
    """Squared distance down to which energy, force and virial of a pair are below 2^50 units."""
    r_cut, atom = np.asarray(model.r_cut, np.float64), model.at_cutoff()
    r = r_cut * np.geomspace(1, 1e-3, 4000)[:, None]
    energy, slope = (
        np.asarray(part) for part in model.evaluate(jnp.asarray(r * r), jnp.arange(len(r_cut)), atom)
    )
    with np.errstate(over="ignore", invalid="ignore"):
        force = 2 * np.abs(slope) * r
        counts = [np.abs(energy) / lattice.energy, force / lattice.force, force * r / lattice.energy]
    beyond = ~np.all(np.stack(counts) < 2.0**50, axis=0)
    return float(np.max(np.where(beyond, r * r, 0.0)))


class _Reproducible(eqx.Module):
    """A cut potential whose results do not depend on how it is compiled."""

    model: CutPotential
    zero: Array

    def at_cutoff(self) -> AtCutoff:
        return reproducible(self.model.at_cutoff, self.zero)()

    def evaluate(self, r2, types, at: AtCutoff):
        return reproducible(self.model.evaluate, self.zero)(r2, types, at)


_VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
