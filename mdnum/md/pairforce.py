"""Pair forces from a neighbor list that contains each pair twice.

Every pair is evaluated twice, once for each atom. Each atom sums over its neighbors in a fixed order, without
scattered writes. On a CPU in double precision, one compiled loop (`md.kernel`) computes the forces. On other
devices, XLA evaluates one group of neighbor slots at a time. Decisions are packed into bits, so that
temporary arrays fit in the cache. For 32,000 atoms, evaluating all slots at once takes ten times as long.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial, reduce
from operator import add, mul
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Real, UInt8

from mdnum.errors import InputError
from mdnum.md import foreign, kernel
from mdnum.md.cell import Cell
from mdnum.md.cutoffs import AtCutoff
from mdnum.md.decide import (
    GROUP,
    Decisions,
    PairDecider,
    SlotJudge,
    Tables,
    displacements,
    halves_of,
    unpacked,
)
from mdnum.md.integrators import Integrator, one_step
from mdnum.md.potentials import Channels, CutPotential, of_type
from mdnum.numerics import PrecisionPolicy
from mdnum.numerics.exact import fence, rounded, zero_bits
from mdnum.numerics.reductions import Reduction, Sequential

# beyond, choosing each constant of a pair by its type takes longer than gathering it
_FEW_TYPES = 6


class Forces(NamedTuple):
    """Result of one force evaluation: forces, energies, virial and decisions."""

    force: Float[Array, "3 atoms"]  # energy/length, shape (3, atoms)
    # energy of each atom, half of its pairs' (or, where a potential has no such division, the total on the
    # first atom), shape (atoms,)
    energy: Float[Array, "atoms"]
    virial: Float[Array, ""]  # sum over pairs of r_ij · F_ij, energy
    decisions: Decisions | None  # None where they were not asked for
    # sum over pairs of r_ij ⊗ F_ij, shape (3, 3): minus the derivative of the energy by strain; None where it
    # was not asked for
    tensor: Float[Array, "3 3"] | None = None


class PairForce(eqx.Module):
    """Forces and pair decisions of a pair potential with a cutoff."""

    model: CutPotential  # the potential with its cutoff
    cell: Cell  # the box; that of a row in a rollout
    zero: Int[Array, ""]  # an integer zero that XLA must not know (see precision.exact)
    # of the pair decision, by pair type, in the dtype and space that it compares in
    thresholds: Real[Array, "types"]
    decider: PairDecider = eqx.field(static=True)  # its convention
    policy: PrecisionPolicy = eqx.field(static=True)  # dtype by role
    reduction: Reduction = eqx.field(static=True, default=Sequential())  # order of the sum over neighbors

    @classmethod
    def create(cls, model: Any, cell: Cell, decider: PairDecider, policy, reduction) -> PairForce:
        """Make the force object. Parameters and box get the dtypes of the policy."""
        return cls(
            model.astype(policy.dtype("force")),
            cell.astype(np.float64),
            zero_bits(policy.dtype("decision")),
            decider.values(),
            decider.convention,
            policy,
            reduction,
        )

    @property
    def law(self) -> CutPotential | Guarded:
        """The potential in the force dtype. 16-bit results are rounded at every operation."""
        model = self.model.typed
        return Guarded(model, self.zero, rounded) if self._short else model

    @property
    def _short(self) -> bool:
        return self.policy.dtype("force").itemsize == 2

    def _in_force_dtype(self, x: Any) -> Float[Array, "..."]:
        """Round a number to the force dtype. XLA computes 16-bit types in a wider format."""
        x = x.astype(self.policy.dtype("force"))
        return fence(x, self.zero) if self._short else x

    def judge(self, positions: Float[Array, "3 atoms"]) -> SlotJudge:
        """Return the pair decisions at the given positions, as a `SlotJudge`."""
        return SlotJudge(self.decider, self.thresholds, self.cell, self.zero, positions)

    def decide(self, positions: Float[Array, "3 atoms"], tables: Tables) -> Decisions:
        """Return the decisions of a neighbor list at given positions, without computing forces."""
        if self.in_one_loop(tables):

            def pair(own, other, types, near=False):
                return (self._geometry(own, other, types, near)[4],)

            columns, near = positions.astype(np.float64), self._near(pair, False)
            made = kernel.over_pairs(pair, columns, tables, margins=self._inside, near=near)
            if made is not None and made.decisions is not None:
                return made.decisions
        return self.judge(positions).decide(tables)

    @property
    def _inside(self) -> str:
        """Comparison (">" or ">=") of the margin with 0 that is true inside the cutoff."""
        return ">=" if self.decider.compare.endswith("<=") else ">"

    def _near(self, pair: Callable[..., Any], tensor: bool) -> kernel.Shortcut | None:
        """Return a pair function without minimum image. None if it saves no time."""
        if not any(self.cell.pbc) or (self.cell.orthorhombic and not tensor):
            return None

        def far(own, other, *_):
            d = [b - a for a, b in zip(own[:3], other[:3], strict=True)]
            return d[0] * d[0] + d[1] * d[1] + d[2] * d[2] >= self.cell.nearby2

        return kernel.Shortcut(far, partial(pair, near=True))

    def _geometry(self, own, other, types, near: bool):
        """Return displacement, difference of positions, squared distance, decision and margin of a pair.

        Args:
            near: True if the difference of positions is known to be the minimum image.
        """
        apart = [b - a for a, b in zip(own, other, strict=True)]
        d = apart if near else self.cell.minimum_image(*apart)
        r2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        quantity = jnp.sqrt(r2) if self.decider.space == "r" else r2
        # compared as what is recorded: once for both, and differences of unequal numbers are not zero
        margin = of_type(self.thresholds, types) - quantity
        return d, apart, r2, margin >= 0 if self._inside == ">=" else margin > 0, margin

    def __call__(
        self,
        positions: Float[Array, "3 atoms"],
        tables: Tables,
        *,
        decisions: bool,
        tensor: bool = False,
        given: UInt8[Array, "words atoms"] | None = None,
        where: UInt8[Array, "words atoms"] | None = None,
    ) -> Forces:
        """Return the forces at sorted and wrapped positions.

        Args:
            positions: shape (3, atoms), length, in the order of the tables.
            tables: the list.
            decisions, tensor: True to return decisions or the virial tensor; forces have the same bits either
                way.
            given: imposed decisions, packed like the returned decisions, which always follow from the
                positions, so that both can be compared.
            where: slots (as bits) in which decisions are imposed; in all other slots, decisions follow from
                positions.
        """
        if self.in_one_loop(tables):
            made = _in_one_loop(self, positions, tables, given, where, decisions=decisions, tensor=tensor)
            if made is not None:
                return made
        return self.in_blocks(positions, tables, given, where, decisions=decisions, tensor=tensor)

    def in_one_loop(self, tables: Tables) -> bool:
        """True if `kernel.over_pairs` can be used: in double precision, for few pair types, on a CPU."""
        roles = ("force", "decision", "accumulate")
        wide = {self.policy.geometry, *map(self.policy.dtype, roles)} == {np.dtype(np.float64)}
        few = tables.types is None or self.model.pair_types <= _FEW_TYPES
        return wide and few and self.reduction == Sequential() and foreign.known()

    def _terms(self, tensor: bool) -> Callable[..., tuple[Float[Array, "..."], ...]]:
        """Return a function that computes force, energy and virial of a pair.

        Args:
            tensor: True for a virial with six components, in Voigt order.
        """
        law, exactly = self.law, self._in_force_dtype
        at = law.at_cutoff()

        def terms(d, r2, inside, types, *weights):
            # the argument is masked, not only the result: a padded slot may be at distance zero
            r2 = exactly(jnp.where(inside, r2, jnp.ones((), r2.dtype)))
            energy, slope = law.evaluate(r2, types, at, *weights)
            energy, slope = jnp.where(inside, energy, 0), jnp.where(inside, slope, 0)
            pull = slope + slope
            forces = [exactly(pull * exactly(c)) for c in d]
            virial = [forces[a] * exactly(d[b]) for a, b in VOIGT] if tensor else [pull * r2]
            return *forces, exactly(energy), *map(exactly, virial)

        return terms

    def weights(self, tables: Tables) -> list[Float[Array, "atoms"]]:
        """Weights of the atoms for all weighted terms, in the neighbor table's order of atoms."""
        return [one[tables.order] for one in self.model.weights if one is not None]

    def in_blocks(
        self,
        positions: Float[Array, "3 atoms"],
        tables: Tables,
        given: UInt8[Array, "words atoms"] | None = None,
        where: UInt8[Array, "words atoms"] | None = None,
        *,
        decisions: bool,
        tensor: bool = False,
    ) -> Forces:
        """Return the same forces as `__call__`, for any precision and device."""
        judge, terms_of = self.judge(positions), self._terms(tensor)
        geometry, accumulate = self.policy.geometry, self.policy.dtype("accumulate")
        same = self.policy.dtype("decision") == geometry
        cell = self.cell.astype(geometry)
        components, weights = tuple(positions.astype(geometry)), self.weights(tables)

        def block(carry, listed):
            totals, nearest = carry
            (j, types), told, pinned = listed
            d, quantity, inside, threshold = judge.group(j, types)
            bits = None
            if decisions:
                bits, nearest = judge.tally(nearest, quantity, inside, threshold)
            if told is not None:
                inside = imposed(inside, told, pinned)
            d = d if same else displacements(components, cell, j)
            if same and self.decider.space == "r2":
                r2 = quantity
            else:
                r2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
            others = factors(self.model, (w * w.at[j].get(mode="promise_in_bounds") for w in weights))
            terms = [term.astype(accumulate) for term in terms_of(d, r2, inside, types, *others)]
            summed = [
                self.reduction.within(total, list(term)) for total, term in zip(totals, terms, strict=True)
            ]
            totals = tuple(total for total, _ in summed)
            return (totals, nearest), (bits, tuple(later for _, later in summed))

        start = ((jnp.zeros(judge.atoms, accumulate),) * (10 if tensor else 5), judge.start())
        told, pinned = (None if bits is None else halves_of(bits) for bits in (given, where))
        (totals, nearest), (halves, later) = lax.scan(block, start, (tables.groups(), told, pinned))
        sums = [self.reduction.finish(total, blocks) for total, blocks in zip(totals, later, strict=True)]
        return _forces(sums, judge.finish(nearest, halves) if decisions else None)


class ChannelForce(PairForce):
    """Forces of potential terms that have different cutoff radii.

    The decisions of all terms are concatenated along the first array axis.
    """

    model: Channels  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def parts(self) -> list[PairForce]:
        """Pair forces of the potential terms, with one object for each cutoff radius."""
        thresholds = self.thresholds.reshape(len(self.model.parts), -1)
        rest = self.cell, self.zero
        return [
            PairForce(model, *rest, own, self.decider, self.policy, self.reduction)
            for model, own in zip(self.model.parts, thresholds, strict=True)
        ]

    def split(self, bits: UInt8[Array, "words atoms"] | None) -> Sequence[Any]:
        """Split concatenated decisions into one array for each cutoff radius."""
        parts = len(self.model.parts)
        return [None] * parts if bits is None else jnp.split(bits, parts)

    def decide(self, positions, tables):
        return _joined([part.decide(positions, tables) for part in self.parts])

    def __call__(self, positions, tables, *, decisions, tensor=False, given=None, where=None):
        made = [
            part(positions, tables, decisions=decisions, tensor=tensor, given=told, where=pinned)
            for part, told, pinned in zip(self.parts, self.split(given), self.split(where), strict=True)
        ]
        parts = [(*one[:3], one.tensor) if tensor else one[:3] for one in made]
        force, energy, virial, *rest = (reduce(add, rows) for rows in zip(*parts, strict=True))
        joined = _joined([one.decisions for one in made]) if decisions else None
        return Forces(force, energy, virial, joined, *rest)

    def judge(self, positions):
        raise InputError(
            "the terms of the potential have different cutoff radii, so a pair of atoms can be "
            "inside one cutoff and outside another",
            remedy="Give all terms of the potential the same cutoff radius",
        )


def _joined(parts: Sequence[Any]) -> Decisions:
    bits, nearest = zip(*parts, strict=True)
    return Decisions(jnp.concatenate(bits), reduce(jnp.minimum, nearest))


def factors(model: CutPotential, products: Iterable[Any]) -> list[tuple[Any, ...]]:
    """Return the weight factors of pairs for each potential term. Empty if no term has weights.

    Args:
        products: products of the weights of both atoms, for terms with weights.
    """
    each = iter(products)
    return [tuple(None if one is None else next(each) for one in model.weights)] if model.weights else []


def _forces(sums: Sequence[Float[Array, "..."]], decisions: Decisions | None) -> Forces:
    """Return forces from sums that count every pair for both of its atoms."""
    fx, fy, fz, energy, *virial = sums
    half = jnp.asarray(0.5, energy.dtype)
    summed = [-jnp.sum(half * one, dtype=jnp.float64) for one in virial]
    tensor = symmetric(summed) if len(summed) > 1 else None
    return Forces(jnp.stack([fx, fy, fz]), half * energy, reduce(add, summed[:3]), decisions, tensor)


@eqx.filter_custom_jvp
def _in_one_loop(force: PairForce, positions, tables: Tables, given, where, *, decisions: bool, tensor: bool):
    """Compute pair forces in one compiled loop. Return None if the compiled loop cannot be used."""
    terms_of = force._terms(False)

    def pair(own, other, types, *bits, near=False):
        d, apart, r2, inside, margin = force._geometry(own[:3], other[:3], types, near)
        if bits:
            inside = bits[0] if where is None else jnp.where(bits[1], bits[0], inside)
        others = factors(force.model, map(mul, own[3:], other[3:]))
        # a slot of padding is nowhere, and no number times nothing is no number
        located = [jnp.where(inside, c, 0) for c in d]
        terms = list(terms_of(located, r2, inside, types, *others))
        if tensor:
            # only the share of lattice vectors in the virial: see `_virial`
            shift = [jnp.where(inside, a - b, 0) for a, b in zip(apart, d, strict=True)]
            terms[4:] = [] if near else [terms[a] * shift[b] for a, b in VOIGT]
        return (*terms, margin) if decisions else tuple(terms)

    flags = [one for one in (given, where) if one is not None]
    columns, margins = positions.astype(np.float64), force._inside if decisions else None
    if rows := force.weights(tables):
        columns = jnp.concatenate([columns, jnp.stack(rows)])
    made = kernel.over_pairs(
        pair, columns, tables, flags=flags, margins=margins, inverses=True, potential=force.model.potential,
        near=force._near(pair, tensor), totals=len(VOIGT) * tensor,
    )  # fmt: skip
    if made is None:
        return None
    virial = _virial(made, columns[:3]) if tensor else tuple(made.sums[4:])
    return _forces((*made.sums[:4], *virial), made.decisions)


def _virial(made: kernel.PairSums, x: Float[Array, "3 atoms"]) -> list[Float[Array, ""]]:
    """Return the sum of force times displacement over all pairs, in Voigt order. Each pair counts twice.

    The displacement of a pair is x_j - x_i minus lattice vectors. The virial sums force times position over
    atoms. For pairs across a boundary, the loop adds force times lattice vectors.
    """
    return list(-2 * products(made.sums, x) - made.totals)


@_in_one_loop.def_jvp
def _in_one_loop_jvp(primals, tangents, *, decisions: bool, tensor: bool):
    # values as everywhere; their derivative by the loop that jax can differentiate
    made = _in_one_loop(*primals, decisions=decisions, tensor=tensor)
    if made is None:
        return None, None
    blocks = partial(PairForce.in_blocks, decisions=decisions, tensor=tensor)
    _, moved = eqx.filter_jvp(blocks, primals, tangents)
    return made, moved


def imposed(
    inside: Bool[Array, "4 atoms"], given: UInt8[Array, "atoms"], where: UInt8[Array, "atoms"] | None
) -> Bool[Array, "4 atoms"]:
    """Return imposed pair decisions where given, and computed decisions (`inside`) elsewhere.

    With a simple mask, a step takes 2.2 times as long as without imposed decisions. With this function, a
    step takes 1.2 times as long.

    Args:
        where: slots in which decisions are imposed; None for all.
    """
    shift = jnp.arange(GROUP, dtype=jnp.uint8)[:, None]
    other = inside ^ ((given[None, :] >> shift) & jnp.uint8(1) == 1)
    return inside ^ (other if where is None else other & unpacked(where))


class Guarded(eqx.Module):
    """A potential with cutoff, in arithmetic modified by `how` (rounded or reproducible)."""

    model: CutPotential
    zero: Int[Array, ""]
    how: Callable[..., Any] = eqx.field(static=True)

    def at_cutoff(self) -> AtCutoff:
        """Return the constants of the potential at its cutoff."""
        return self.how(self.model.at_cutoff, self.zero)()

    def evaluate(self, r2, types, at: AtCutoff):
        """Return energy and slope of the potential for pairs."""
        return self.how(self.model.evaluate, self.zero)(r2, types, at)


VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


def products(a: Float[Array, "_ atoms"], b: Float[Array, "_ atoms"]) -> Float[Array, "6"]:
    """Return the six sums over atoms of a_i b_j, in Voigt order.

    XLA computes eight partial sums at a time with vector instructions. For 4,000 atoms, partial sums take a
    third of the time of a sequential sum.
    """
    pieces = [jnp.pad(one[:3], ((0, 0), (0, -one.shape[1] % 8))).reshape(3, 8, -1) for one in (a, b)]
    sums = [reduce(add, (pieces[0][i, k] * pieces[1][j, k] for k in range(8))) for i, j in VOIGT]
    return jnp.stack(sums).sum(axis=1)


def symmetric(components: Iterable[Float[Array, ""]]) -> Float[Array, "3 3"]:
    """Return the symmetric matrix with the six given components in Voigt order."""
    xx, yy, zz, yz, xz, xy = components
    return jnp.stack([jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])])


# --- the general path: any energy function over a neighbor list, told which pairs are inside ----------


class ManyBodyForce(eqx.Module):
    """Forces from an energy function over a jax-md neighbor list, by automatic differentiation."""

    potential: Any  # energy(positions (atoms, 3), neighbor, cell (3, 3)) -> energy, with `format`
    # cell, zero, thresholds, decider, policy: as in PairForce. The energy is evaluated in the force's dtype,
    # but for numbers that its function holds
    cell: Cell
    zero: Int[Array, ""]
    thresholds: Float[Array, "types"]
    decider: PairDecider = eqx.field(static=True)
    policy: PrecisionPolicy = eqx.field(static=True)

    @classmethod
    def create(cls, potential, cell: Cell, decider: PairDecider, policy: PrecisionPolicy) -> ManyBodyForce:
        """Make the force object, with parameters in the force dtype."""
        zero, dtype = zero_bits(policy.dtype("decision")), policy.dtype("force")
        if dtype != np.float64:
            potential = jax.tree.map(lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a, potential)
        return cls(potential, cell.astype(np.float64), zero, decider.values(), decider.convention, policy)

    def decide(self, positions: Float[Array, "3 atoms"], tables: Tables) -> Decisions:
        """Return the decisions of a neighbor list at given positions."""
        return SlotJudge(self.decider, self.thresholds, self.cell, self.zero, positions).decide(tables)

    def __call__(
        self,
        positions: Float[Array, "3 atoms"],
        tables: Tables,
        *,
        decisions: bool,
        tensor: bool = False,
        given: UInt8[Array, "words atoms"] | None = None,
        where: UInt8[Array, "words atoms"] | None = None,
    ) -> Forces:
        """Return forces as `PairForce` does. The total energy is assigned to the first atom."""
        made = self.decide(positions, tables)
        bits = made.bits if given is None else given
        if given is not None and where is not None:
            bits = made.bits ^ ((made.bits ^ given) & where)
        total, slope, strain = self._differentiate(positions, tables, bits)
        return Forces(
            -slope.T.astype(self.policy.dtype("accumulate")),
            jnp.zeros(positions.shape[1], jnp.float64).at[0].set(total),
            -jnp.trace(strain).astype(jnp.float64),
            made if decisions else None,
            -0.5 * (strain + strain.T).astype(jnp.float64) if tensor else None,
        )

    def neighbors(
        self, positions: Float[Array, "3 atoms"], tables: Tables, bits: UInt8[Array, "words atoms"]
    ) -> Any:
        """Return the neighbor list for the energy function, with pairs inside the cutoff only."""
        from mdnum.md import jaxmd

        own, atoms = self.potential, positions.shape[1]
        x, edges = self.placed(positions.T.astype(self.dtype), tables), tables.edges
        names = jnp.append(tables.order, atoms).astype(jnp.int32)
        itself = jnp.arange(atoms, dtype=jnp.int32)
        if own.format == "dense":
            edges = tables.index.reshape(-1, atoms).T if edges is None else edges
            inside = (bits.T[:, :, None] >> jnp.arange(8, dtype=jnp.uint8)) & jnp.uint8(1) == 1
            idx = jnp.where(inside.reshape(edges.shape), edges, atoms).astype(jnp.int32)
            if own.labeled:
                idx = jnp.zeros_like(idx).at[tables.order].set(names[idx])
            idx = jnp.concatenate([idx, itself[:, None]], axis=1) if own.self_edges else idx
            return jaxmd.listed(idx, x, own.format)
        assert edges is not None, "an energy over edges needs them in its tables"
        _, first, slot = edges
        byte = bits.at[slot // 8, first].get(mode="fill", fill_value=0)
        inside = (byte >> (slot % 8).astype(jnp.uint8)) & jnp.uint8(1) == 1
        ends = jnp.where(inside, edges[:2], atoms)
        if own.labeled:
            # where a pair is listed once, its smaller label comes first
            ends = jnp.sort(names[ends], axis=0) if own.format == "ordered-sparse" else names[ends]
        ends = jnp.concatenate([ends, jnp.tile(itself, (2, 1))], axis=1) if own.self_edges else ends
        return jaxmd.listed(ends, x, own.format)

    @property
    def dtype(self) -> np.dtype:
        """Data type of the positions that the energy function receives."""
        return self.policy.dtype("force")

    def placed(self, x: Float[Array, "atoms 3"], tables: Tables) -> Float[Array, "atoms 3"]:
        """Reorder the positions from sorted order to the atom order of the energy function."""
        # an energy that takes all atoms for alike sees the table's sorted order
        return jnp.zeros_like(x).at[tables.order].set(x) if self.potential.labeled else x

    def energy_of(
        self, tables: Tables, neighbor: Any, potential: Any = None
    ) -> Callable[[Any, Any, Any], Float[Array, ""]]:
        """Return the energy as a function of sorted positions, lattice vectors and deformation."""
        own = self.potential if potential is None else potential
        return lambda x, matrix, by: own.deformed(self.placed(x, tables), neighbor, matrix, by)

    def _differentiate(self, positions, tables: Tables, bits):
        """Return the energy and its derivatives with respect to positions and strain."""
        neighbor = self.neighbors(lax.stop_gradient(positions), tables, bits)
        energy_of, matrix = self.energy_of(tables, neighbor), self.cell.matrix.astype(self.dtype)
        unit = jnp.eye(3, dtype=self.dtype)

        def energy(x, strain):
            return energy_of(x, matrix, unit + strain).astype(jnp.float64)

        x = positions.T.astype(self.dtype)
        total, (slope, strain) = jax.value_and_grad(energy, argnums=(0, 1))(x, jnp.zeros_like(unit))
        return total, slope, strain


# --- one step of molecular dynamics that is told its decisions: the contract of mdnum.program ---------


class MdState(NamedTuple):
    """State of a simulation between two force evaluations, in the neighbor table's order of atoms."""

    step: Int[Array, ""]  # the step whose forces come next
    x: Float[Array, "3 atoms"]  # wrapped positions at that step, shape (3, atoms)
    # velocities after the first half kick (at step 0: the initial velocities), shape (3, atoms)
    v: Float[Array, "3 atoms"]
    extra: Any = ()  # of the integrator


class PairDynamics(eqx.Module):
    """Dynamics on a fixed neighbor list with imposed decisions.

    The class is used to replay decisions, and for gradients at fixed decisions. A normal run makes the same
    time steps in compiled blocks.
    """

    force: PairForce  # the pair force
    integrator: Integrator  # between force evaluations
    masses: Float[Array, "atoms"]  # in the order of the tables, shape (atoms,)
    tables: Tables  # the list

    def margins(self, state: MdState) -> Float[Array, "groups 4 atoms"]:
        """Return the margin (threshold minus r or r²) of each slot. -inf for padding slots."""
        judge = self.force.judge(state.x)
        index, types = self.tables.groups()

        def margin(j, kinds):
            _, quantity, _, threshold = judge.group(j, kinds)
            return jnp.where(j < judge.atoms, threshold - quantity, -jnp.inf)

        groups = [margin(index[g], None if types is None else types[g]) for g in range(index.shape[0])]
        return jnp.stack(groups)

    def decide(self, state: MdState) -> UInt8[Array, "words atoms"]:
        """Return the decisions of the neighbor list at the present positions."""
        return self.force.decide(state.x, self.tables).bits

    def step(self, state: MdState, decisions: UInt8[Array, "words atoms"]) -> MdState:
        """Make one time step with the given decisions on pairs."""
        made = self.force(state.x, self.tables, decisions=False, given=decisions)
        order, cell = self.tables.order, self.force.cell
        end = one_step(self.integrator, cell, self.masses, order, *state, made)
        return MdState(state.step + 1, end.x, end.kicked, end.ahead)
