"""Reverse-mode derivatives of a simulation at its recorded states and decisions.

With jax.value_and_grad, the forward pass rounds differently from an ordinary run. After some thousand steps,
forward pass and run make different decisions. This module therefore records an ordinary run first.

A conservative force is a gradient, so its Jacobian J is symmetric. For a pair potential, J times a vector is
a sum over neighbors, like the forces. For other energies, J times a vector is a directional derivative of the
forces. Reverse mode therefore needs no record of the operations within a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from operator import add
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, UInt8

from mdnum.errors import InputError
from mdnum.gradients.crossings import Crossings, crossings, of_energy, onto_crossings
from mdnum.gradients.losses import LossFrame
from mdnum.gradients.parameters import Cotangents, onto_start, quantities, with_quantities
from mdnum.gradients.tape import RunTape, TapeStretch, frame_of, in_box
from mdnum.md import kernel
from mdnum.md.decide import Tables, halves_of, unpacked
from mdnum.md.integrators import Integrator, by_atom, one_step, unsorted
from mdnum.md.pairforce import ChannelForce, Forces, ManyBodyForce, PairForce, factors
from mdnum.md.potentials import Channels, of_type
from mdnum.rollout.epoch import over_rows

#: Gradients that a reverse pass can compute in addition to those with respect to positions: the parameters of
#: the potential, a common factor of all distances, the forces themselves (for derivatives with respect to
#: numbers of the integrator), weights of atoms, and a strain of all distances, which a changing box needs.
MODEL, SCALE, FORCE, WEIGHT, STRAIN = "model", "scale", "force", "weight", "strain"
ALL = frozenset((MODEL, SCALE, FORCE, WEIGHT))


class ForceCotangents(NamedTuple):
    """Derivatives of the loss (cotangents) with respect to the inputs of one force evaluation."""

    x: Float[Array, "3 atoms"]  # on the positions
    model: Any  # on the parameters, a pytree of arrays like theirs; zeros where it was not asked for
    # on a common factor of all distances (the box and everything in it), at 1; with STRAIN on a strain of
    # them, shape (3, 3)
    strain: Float[Array, "*axes"]
    force: Float[Array, "3 atoms"]  # the forces themselves, energy/length


def pull_back(
    force: PairForce | ManyBodyForce,
    x: Float[Array, "3 atoms"],
    tables: Tables,
    bits: UInt8[Array, "words atoms"],
    onto_force: Float[Array, "3 atoms"],
    onto_energy: Float[Array, ""],
    onto_virial: Float[Array, "*axes"],
    wanted: frozenset[str] = frozenset(),
) -> ForceCotangents:
    """Propagate cotangents backward through one evaluation of forces, energy and virial.

    Args:
        x: sorted, wrapped positions, length. bits: the packed decisions that this evaluation used.
        onto_force, onto_energy: cotangents of the forces and of the potential energy.
        onto_virial: cotangent of the virial, or of its tensor, shape (3, 3) and symmetric.
        wanted: derivatives to compute, of MODEL, SCALE, FORCE, WEIGHT and STRAIN; others are returned as 0.

    Error: one rounding error per pair, in the dtype of the force; sums are taken slot by slot.
    """
    if isinstance(force, ChannelForce):
        each = zip(force.parts, force.split(bits), strict=True)
        made = [
            pull_back(part, x, tables, own, onto_force, onto_energy, onto_virial, wanted)
            for part, own in each
        ]
        on_x, model, strain, whole = zip(*made, strict=True)
        return ForceCotangents(reduce(add, on_x), Channels(model), reduce(add, strain), reduce(add, whole))
    of = _of_pairs if isinstance(force, PairForce) else _of_energy
    return of(force, x, tables, bits, onto_force, onto_energy, onto_virial, wanted)


def _of_pairs(force, x, tables, bits, onto_force, onto_energy, onto_virial, wanted) -> ForceCotangents:
    dtype = force.policy.dtype("force")
    cell = force.cell.astype(dtype)
    columns = jnp.concatenate(
        [x.astype(dtype), onto_force.astype(dtype), *(w[None] for w in force.weights(tables))]
    )
    energy, virial = onto_energy.astype(dtype), onto_virial.astype(dtype)
    cut = force.model.cutoff

    def pieces(model):
        # the parameters of a pair type, those that all share, and what the end is made of
        return (*model.typed.potential.split(), model.at_cutoff())

    (own, shared, at), back_to_model = jax.vjp(pieces, force.model)
    model, types_of = force.model.typed, force.model.pair_types
    of_shared = MODEL in wanted and bool(jax.tree.leaves(shared))

    def distances(d, dw, inside):
        # the argument is masked, not only the result: a padded slot may be at distance zero
        r2 = jnp.where(inside, d[0] * d[0] + d[1] * d[1] + d[2] * d[2], jnp.ones((), dtype))
        return r2, jnp.where(inside, d[0] * dw[0] + d[1] * dw[1] + d[2] * dw[2], 0)

    def virials(d, r2):
        """Return d·V·d for the pair vector d and the virial's cotangent V; also V·d if V is a tensor."""
        if not virial.ndim:
            return virial * r2, None
        turned = [reduce(add, (virial[a, b] * d[b] for b in range(3))) for a in range(3)]
        return reduce(add, (d[a] * turned[a] for a in range(3))), turned

    def through(r2, along, inside, types, weights):
        """Return a function that computes energy and du/d(r²) of each neighbor slot. Also return slot
        parameters, and the cotangents of energy and du/d(r²).
        """
        # each slot has parameters of its own, so that no sum over slots stands inside the loop
        slots = jax.tree.map(lambda leaf: jnp.broadcast_to(of_type(leaf, types), r2.shape), (own, at))

        def ended(r2, slots, shared, weights=weights):
            potential, end = slots
            u, s = eqx.combine(potential, shared).evaluate(r2)
            return cut.cut(r2, u, s, end, *weights)

        onto = jnp.where(inside, 0.5 * energy, 0), -jnp.where(inside, along, 0)
        return ended, slots, onto

    def with_shared(r2, along, inside, types, weights):
        """Compute du/d(r²), and cotangents of r², slot parameters and shared parameters. One reverse pass
        computes all cotangents. For a neural network, one pass is cheaper than two.
        """
        ended, slots, onto = through(r2, along, inside, types, weights)

        def in_a_row(r2, slots, shared):
            # a sum over one axis of slots is a product of matrices, and one over two takes 1.2 times as long
            row, slots, others = jax.tree.map(jnp.ravel, (r2, slots, weights))
            made = ended(row, slots, shared, others)
            return jax.tree.map(lambda part: part.reshape(r2.shape), made)

        (_, slope), back = jax.vjp(in_a_row, r2, slots, shared)
        return slope, *back(onto)

    def onto_weights(r2, along, inside, types, weights, others):
        """Compute the cotangents of the atoms' weights from each neighbor slot."""
        onto = jnp.where(inside, energy, 0), -2 * jnp.where(inside, along, 0)
        by = jax.vjp(lambda *weights: model.evaluate(r2, types, at, *weights), *weights)[1](onto)
        return [leaf * w for leaf, w in zip(jax.tree.leaves(by), others, strict=True)]

    def terms(d, dw, inside, types) -> tuple[list[Array], Any]:
        """Return each neighbor slot's contributions to the cotangents. The order is positions, forces, box
        scale, pair-type parameters. Also return each block's contributions for shared parameters.
        """
        weights, several = factors(model, dw[3:]), len(dw[3:]) // 2
        r2, along = distances(d, dw, inside)
        own_virial, turned = virials(d, r2)
        whole = along + own_virial
        by_slot = by_shared = None
        if of_shared:
            slope, by_r2, by_slot, by_shared = with_shared(r2, whole, inside, types, weights)
            slope = jnp.where(inside, slope, 0)
            # the reverse pass had all of it but the r² in the virial
            rest = jnp.where(inside, by_r2, 0) - (0 if turned else virial * slope)
        else:
            (_, slope), (_, bend) = jax.jvp(
                lambda q: model.evaluate(q, types, at, *weights), (r2,), (jnp.ones_like(r2),)
            )
            slope, bend = jnp.where(inside, slope, 0), jnp.where(inside, bend, 0)
            # derivative by r² of what this slot adds to energy and virial
            of_virial = bend * own_virial if turned else virial * (bend * r2 + slope)
            rest = energy * (0.5 * slope) - of_virial - bend * along
            if MODEL in wanted:
                ended, slots, onto = through(r2, whole, inside, types, weights)
                by_slot = jax.vjp(lambda slots: ended(r2, slots, shared), slots)[1](onto)[0]
        pull, twist = slope + slope, 4 * rest
        if turned:
            dw = [one + 2 * other for one, other in zip(dw[:3], turned, strict=True)] + list(dw[3:])
        made = [pull * dw[c] - twist * d[c] for c in range(3)]
        if FORCE in wanted:
            made += [pull * d[c] for c in range(3)]
        if STRAIN in wanted:
            made += [d[a] * (2 * rest * d[b] - slope * dw[b]) for a in range(3) for b in range(3)]
        elif SCALE in wanted:
            made += [2 * r2 * rest - slope * (along + 2 * own_virial if turned else along)]
        if MODEL in wanted:
            made += [
                leaf if types is None else jnp.where(types == kind, leaf, 0)
                for leaf in jax.tree.leaves(by_slot)
                for kind in range(types_of)
            ]
        if WEIGHT in wanted and weights:
            made += onto_weights(r2, whole, inside, types, weights, dw[3 + several :])
        return made, by_shared

    one_loop = force.in_one_loop(tables) and not of_shared
    sums, onto_shared = _summed(terms, columns, cell, tables, bits, one_loop)
    sums = list(sums)
    on_x = jnp.stack(sums[:3]).astype(x.dtype)
    made = jnp.stack(sums[3:6]).astype(x.dtype) if FORCE in wanted else jnp.zeros_like(x)
    del sums[: 6 if FORCE in wanted else 3]
    strain = jnp.zeros((), dtype)
    if STRAIN in wanted:
        strain = jnp.stack([jnp.sum(sums.pop(0)) for _ in range(9)]).reshape(3, 3)
    elif SCALE in wanted:
        strain = jnp.sum(sums.pop(0))
    onto_model, onto_weight = jax.tree.map(jnp.zeros_like, (force.model, model.weights))
    if WEIGHT in wanted and onto_weight:
        places = jax.tree.structure(onto_weight)
        each = [unsorted(sums.pop(), tables.order) for _ in range(places.num_leaves)]
        onto_weight = jax.tree.unflatten(places, each[::-1])
    if MODEL in wanted:
        flat = jnp.stack([jnp.sum(total) for total in sums]).reshape(-1, types_of)
        onto_own, onto_at = jax.tree.unflatten(jax.tree.structure((own, at)), list(flat))
        (onto_model,) = back_to_model((onto_own, onto_shared if of_shared else shared, onto_at))
    return ForceCotangents(on_x, replace(onto_model, weights=onto_weight), strain, made)


def _differences(cell, own, other):
    """Return differences of positions and vectors, products of weights, and weights of atom 2."""
    d = [b - a for a, b in zip(own[:6], other[:6], strict=True)]
    products = (a * b for a, b in zip(own[6:], other[6:], strict=True))
    return [*cell.minimum_image(*d[:3]), *d[3:], *products, *other[6:]]


def _summed(terms, columns, cell, tables: Tables, bits, in_one_loop: bool):
    """Sum the contributions of all neighbor slots for each atom. Sum shared parameters over all atoms."""

    def pair(own, other, types, inside):
        # padding is nowhere
        d = [jnp.where(inside, c, 0) for c in _differences(cell, own, other)]
        return terms(d[:3], d[3:], inside, types)[0]

    made = kernel.over_pairs(pair, columns, tables, flags=(bits,)) if in_one_loop else None
    if made is not None:
        return made.sums, None
    index, types = tables.groups()
    d = [jax.ShapeDtypeStruct(index.shape[1:], columns.dtype)] * (2 * len(columns) - 6)
    inside = jax.ShapeDtypeStruct(index.shape[1:], np.bool_)
    first, whole = jax.eval_shape(terms, d[:3], d[3:], inside, None if types is None else types[0])
    nothing = jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), whole)
    start = (jnp.zeros_like(columns[0]),) * len(first), nothing
    own = tuple(columns)

    def group(sums, slots):
        j, types, told = slots
        d = _differences(cell, own, [c.at[j].get(mode="promise_in_bounds") for c in own])
        added, block = terms(d[:3], d[3:], unpacked(told), types)
        return (_added(sums[0], added), jax.tree.map(jnp.add, sums[1], block)), None

    return lax.scan(group, start, (*tables.groups(), halves_of(bits)))[0]


def _added(totals: tuple[Array, ...], terms: list[Array]) -> tuple[Array, ...]:
    """Add the terms of four neighbor slots in a fixed order. The compiler can then vectorize over atoms."""
    out = []
    for total, term in zip(totals, terms, strict=True):
        for k in range(term.shape[0]):
            total = total + term[k]
        out.append(total)
    return tuple(out)


def _of_energy(force, x, tables, bits, onto_force, onto_energy, onto_virial, wanted) -> ForceCotangents:
    values = quantities(force)
    neighbor, dtype = force.neighbors(lax.stop_gradient(x), tables, bits), force.dtype
    matrix = jnp.asarray(force.cell.matrix).astype(dtype)
    unit = jnp.eye(3, dtype=dtype)
    w, virial = onto_force.T.astype(dtype), onto_virial.astype(dtype) * (1 if onto_virial.ndim else unit)

    def energy(x, values, by):
        other: Any = with_quantities(force, values)
        return force.energy_of(tables, neighbor, other.potential)(x, matrix, by)

    at = (x.T.astype(dtype), values, unit)
    still = jax.tree.map(jnp.zeros_like, values)
    if MODEL in wanted:
        slope = jax.grad(energy, argnums=(0, 1, 2))
        (by_x, by_model, by_strain), (bend_x, bend_model, bend) = jax.jvp(slope, at, (w, still, virial))
        model = jax.tree.map(
            lambda bend, one: (onto_energy * one - bend).astype(one.dtype), bend_model, by_model
        )
    else:
        slope = jax.grad(lambda x, by: energy(x, values, by), argnums=(0, 1))
        (by_x, by_strain), (bend_x, bend) = jax.jvp(slope, (at[0], at[2]), (w, virial))
        model = still
    # forces and the virial belong to the places after the strain, and the slopes to those before
    strain = onto_energy * by_strain - bend + w.T @ by_x - by_strain @ virial
    if STRAIN not in wanted:
        strain = jnp.trace(strain) if SCALE in wanted else jnp.zeros((), dtype)
    return ForceCotangents(
        (onto_energy * by_x - bend_x).T.astype(x.dtype),
        model,
        strain.astype(dtype),
        -by_x.T.astype(x.dtype) if FORCE in wanted else jnp.zeros_like(x),
    )


class AdjointCarry(NamedTuple):
    """Cotangents that a reverse pass propagates from each step to the preceding step.

    A trace is an `AdjointCarry` with the cotangents at every step, but without those of the first frame. Row
    k contains the cotangents of positions and half-kicked velocities at the beginning of step first + k. Row
    k excludes cutoff crossings that lead to the state at step first + k. Atoms in a trace are in the order of
    the neighbor list. Unused rows at the end of a trace are undefined.
    """

    x: Float[Array, "3 atoms"]  # cotangent of the positions at the step that comes next in time
    v: Float[Array, "3 atoms"]  # of the half-kicked velocities that lead there
    extra: Any  # of what of the extra state is no integer
    # of the lattice vectors there; where the box does not move, of a common factor of them alone
    matrix: Float[Array, "3 3"]
    # model, integrator: of parameters, so far
    model: Any
    integrator: Any
    # of the frame of step 0 where the loss compares with it, user's order
    origin: tuple[Float[Array, "3 atoms"], Float[Array, "3 atoms"]]
    r_cut: Float[Array, "types"]  # of the cutoffs by the times of flips, so far
    # of potential energy and virial in the frame that the loss looks at next in time
    frame: tuple[Float[Array, ""], Float[Array, ""]]


def reverse(
    tape: RunTape,
    *,
    wanted: frozenset[str] = ALL,
    saltation: bool = False,
    guard: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[TapeStretch, AdjointCarry], None] | None = None,
) -> tuple[Cotangents, list[Crossings]]:
    """Compute derivatives of the loss of a recorded run with respect to its inputs.

    Args:
        wanted: derivatives to compute beyond the start: MODEL, SCALE, FORCE (the integrator's numbers),
            WEIGHT.
        saltation: whether to add the effect of every flip through the time at which the flip happens.
        guard: radial speed, length per internal time, below which a flip counts as grazing and adds nothing.
        watch: called with every stretch, last first, and the cotangents carried at its steps.

    Returns:
        The derivatives, and the crossings of every stretch of steps with their weights, last stretch first.

    Raises:
        InputError: saltation was requested for a many-body potential that makes its own decisions.

    Error: a rounding error times the growth of the adjoint; no truncation error, for the program as it ran.
    """
    back = StretchReversal(tape, wanted, guard if saltation else None)
    found: list[Crossings] = []
    for stretch in tape.backward():
        weights, trace = back.through(stretch)
        if watch is not None:
            watch(stretch, trace)
        if back.met is not None:
            found.append(back.met.weighed(weights))
        if progress is not None:
            progress(tape.steps - stretch.first, tape.steps)
    return back.cotangents(), found


class StretchReversal:
    """State of a reverse pass through a recorded run (see `reverse`).

    Attributes:
        carry: the cotangents at the current step, atoms in the user's order. guard: radial speed below which
            flips are grazing; None if the contribution of flips is not included.
        met: the crossings of the stretch of steps that was transposed last.
    """

    def __init__(self, tape: RunTape, wanted: frozenset[str], guard: float | None):
        simulation = tape.simulation
        force: Any = simulation.force
        if guard is not None and not simulation.imposable:
            raise InputError(
                "the gradient can include the effect of flips only for a pair potential, with an energy that "
                "is a sum over the pairs of the neighbor list",
                remedy="For a many-body potential, use the “symmetric” gradient method",
                where=simulation.name,
            )
        if simulation.integrator.moves_cell:
            wanted |= {SCALE, STRAIN}
            force = replace(force, cell=tape.start.state.cells[0])
        self.tape, self.wanted, self.guard, self.force = tape, wanted, guard, force
        self.onto_total = jax.grad(lambda total: tape.loss.value(total, tape.frames))(tape.total)
        nothing = jnp.zeros((3, simulation.atoms), simulation.policy.dtype("state"))
        numbers = eqx.filter(simulation.integrator, eqx.is_inexact_array)
        extra = eqx.filter(tape.start.state.extra, eqx.is_inexact_array)
        model, integrator, extra = jax.tree.map(jnp.zeros_like, (quantities(force), numbers, extra))
        if simulation.fixed_point is not None:
            # a bath of integers is put aside, and not differentiated
            extra = ()
        zero, matrix = jnp.zeros((), jnp.float64), jnp.zeros((3, 3), jnp.float64)
        r_cut = jnp.zeros(len(simulation.decider.r_cut), jnp.float64)
        self.met: Crossings | None = None
        self.carry = AdjointCarry(
            nothing, nothing, extra, matrix, model, integrator, (nothing, nothing), r_cut, (zero, zero)
        )

    def arguments(self, stretch: TapeStretch) -> tuple[Any, ...]:
        """Return the arguments of `transposed` for a stretch of steps with one neighbor list."""
        simulation, order = self.tape.simulation, stretch.table.order
        self.met = None if self.guard is None else crossings(simulation, stretch, self.guard)
        tape, tables = self.tape, simulation.tables(stretch.table)
        looking = (tape.loss, tape.origin, tape.around, self.onto_total, tape.pace)
        crossed = None if self.met is None else self.met.rows(len(stretch.x))
        return (
            self.force, simulation.integrator, simulation.masses[order], tables, stretch.columns,
            stretch.bits, stretch.rows, tape.seen(stretch), looking, crossed, self.carry, self.wanted,
        )  # fmt: skip

    def through(self, stretch: TapeStretch) -> tuple[Float[np.ndarray, "room most"], AdjointCarry]:
        """Return the cotangents of every step, and the weights of the cutoff crossings."""
        self.carry, (weights, trace) = transposed(*self.arguments(stretch))
        return np.asarray(weights), trace

    def cotangents(self) -> Cotangents:
        """Return the derivatives of the loss after the reverse pass."""
        simulation, carry, start = self.tape.simulation, self.carry, self.tape.start.state
        through = carry.integrator, carry.x, carry.v
        if jax.tree.leaves(carry.extra):
            through = jax.tree.map(jnp.add, through, onto_start(simulation, start, carry.extra))
        integrator, *at = through
        by_x, by_v, whole, turned = (np.asarray(part, np.float64) for part in (*at, *carry.origin))
        # the box, and all that is in it
        scale = float(np.sum(by_x * np.asarray(start.x)) + np.sum(whole * np.asarray(self.tape.origin.x)))
        scale += float(np.sum(np.asarray(carry.matrix) * np.asarray(self.force.cell.matrix)))
        r_cut = np.asarray(carry.r_cut)
        return Cotangents(carry.model, integrator, by_x + whole, by_v + turned, scale, r_cut)


@partial(jax.jit, static_argnames=("wanted",))
def transposed(
    force: PairForce | ManyBodyForce,
    integrator: Integrator,
    masses: Float[Array, "atoms"],
    tables,
    rows,
    bits,
    used,
    seen,
    looking,
    crossed,
    carry: AdjointCarry,
    wanted: frozenset[str],
):
    """Propagate cotangents backward through a stretch of steps with one neighbor list.

    The function returns the cotangents at the first step, one weight per cutoff crossing, and the cotangents
    at every step. JAX transposes the part of a step between two force evaluations. The derivative of a step
    with a linear `KickDrift` integrator does not depend on the forces. Forces are then not recorded. For
    derivatives with respect to integrator parameters, `pull_back` computes the forces.
    """
    loss, origin, around, onto_total, pace = looking
    order, moves = tables.order, integrator.moves_cell
    # carried from list to list in the user's order
    extra = by_atom(lambda part: part[..., order], carry.extra)
    carry = carry._replace(x=carry.x[:, order], v=carry.v[:, order], extra=extra)
    dtype = rows[1].dtype
    numbers, rest = eqx.partition(integrator, eqx.is_inexact_array)
    inverse, axes = jnp.asarray(force.cell.inverse), max(1, sum(force.cell.pbc))

    def box(matrix):
        return force.cell.spanned(matrix) if moves else replace(force.cell, matrix=matrix)

    def advance(numbers, x, v, extra, made, matrix, whole, number):
        end = one_step(
            eqx.combine(numbers, rest), box(matrix), masses, order, number, x, v,
            eqx.combine(extra, whole), made, wrap=SCALE in wanted,
        )  # fmt: skip
        ahead = eqx.filter(end.ahead, eqx.is_inexact_array)
        return end.x, end.kicked, ahead, end.cell.matrix, end.v

    def look(row):
        """Convert cotangents of the observations to cotangents of a frame and of the first frame."""

        def seen_at(x, v, potential, virial, origin, timestep, *box):
            here = (in_box(around, *box) if box else around)._replace(timestep=timestep)
            frame = frame_of((row[0], x, v, row[3], potential, virial), order, here.matrix)
            return loss.observe(frame, LossFrame(origin_step, origin[0], origin[1], nan, nan), here)

        nan, origin_step = origin.potential, origin.step
        given: tuple[Any, ...] = row[1], row[2], row[4], row[5], (origin.x, origin.v), around.timestep
        given += ((row[6] if moves else around.matrix),) if SCALE in wanted else ()
        return jax.vjp(seen_at, *given)[1](onto_total)

    def blind(row):
        return jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), jax.eval_shape(look, row))

    def step(carry: AdjointCarry, given):
        row, told, see, span = given
        number, x, v, inputs = row[0], row[1], row[2], row[7]
        half = (0.5 * integrator.timestep).astype(dtype)
        second = jnp.where(number == 0, jnp.zeros((), dtype), half)
        matrix = row[6] if moves else jnp.asarray(force.cell.matrix)
        extra, whole, forces = (), (), Forces(jnp.zeros_like(x), jnp.zeros(0), row[5], None)
        if inputs:
            v, forces = inputs.v, forces._replace(force=inputs.force, tensor=inputs.tensor)
            extra, whole = eqx.partition(inputs.extra, eqx.is_inexact_array)
        loss_x, loss_v, onto_potential, onto_virial, onto_origin, onto_time, *onto_matrix = lax.cond(
            see, look, blind, row
        )
        onto = carry.x, carry.v, carry.extra, carry.matrix, loss_v

        def of_state(x, v, extra, forces, matrix):
            return advance(numbers, x, v, extra, forces, matrix, whole, number)

        onto_x, onto_v, onto_extra, onto_forces, by_matrix = jax.vjp(of_state, x, v, extra, forces, matrix)[
            1
        ](onto)
        # what the integrator makes of the virial, beside the loss
        squeeze, pressing = None, onto_virial
        if inputs:
            squeeze = onto_forces.virial
            if inputs.tensor is not None:
                tensor = onto_forces.tensor
                squeeze, pressing = 0.5 * (tensor + tensor.T) + squeeze * jnp.eye(3), onto_virial * jnp.eye(3)
            pressing = pressing + squeeze
        here = replace(force, cell=box(matrix)) if moves else force
        made = pull_back(here, x, tables, told, onto_forces.force, onto_potential, pressing, wanted)
        model, numbers_bar, onto_box = carry.model, carry.integrator, carry.matrix
        if wanted & {MODEL, WEIGHT}:
            model = jax.tree.map(jnp.add, model, made.model)
        if FORCE in wanted:
            if not inputs:
                forces = forces._replace(force=made.force)
                v = v - second * (made.force / masses.astype(dtype))
            _, back = jax.vjp(
                lambda numbers: advance(numbers, x, v, extra, forces, matrix, whole, number), numbers
            )
            (by_numbers,) = back(onto)
            by_numbers = eqx.tree_at(
                lambda one: one.timestep,
                by_numbers,
                by_numbers.timestep + onto_time.astype(by_numbers.timestep.dtype),
            )
            numbers_bar = jax.tree.map(jnp.add, numbers_bar, by_numbers)
        if SCALE in wanted:
            # a strain moves positions with the box: what is left when these have theirs belongs to the box
            at, by_x = x.astype(jnp.float64), made.x.astype(jnp.float64)
            onto_box = by_matrix + onto_matrix[0]
            if moves:
                onto_box += here.cell.inverse.T @ (made.strain.astype(jnp.float64) - at @ by_x.T)
            else:
                onto_box += inverse.T * ((made.strain.astype(jnp.float64) - jnp.sum(at * by_x)) / axes)
        potential = jnp.where(see, onto_potential.astype(jnp.float64), carry.frame[0])
        virial = jnp.where(see, onto_virial.astype(jnp.float64), carry.frame[1])
        started = jax.tree.map(jnp.add, carry.origin, onto_origin)
        onto_x = onto_x + loss_x + made.x
        after = AdjointCarry(
            onto_x, onto_v, onto_extra, onto_box, model, numbers_bar, started, carry.r_cut,
            (potential, virial),
        )  # fmt: skip
        trace = after._replace(origin=(), extra=())
        weights = jnp.zeros(0)
        if crossed is not None:
            met = crossed.row(span, x.shape[1])
            share = pace.share(number, integrator.timestep)
            sums = (share * after.frame[0], share * after.frame[1])
            # a jump of the virial that comes earlier acts on the box for a longer part of the step
            squeeze = None if squeeze is None else squeeze / integrator.timestep
            pull = None
            if isinstance(here, ManyBodyForce):
                onto = (after.v + half * after.x) / masses.astype(dtype)
                pull = of_energy(here, tables, told, met, span[1], x, (onto, *sums), squeeze)
            push, weights, by_radius, by_matrix = onto_crossings(
                met, after.x, after.v, sums, masses, integrator.timestep, carry.r_cut.shape[0], pull, squeeze
            )
            after = after._replace(
                x=after.x + push,
                v=after.v - half * push,
                matrix=after.matrix + by_matrix if SCALE in wanted else after.matrix,
                r_cut=after.r_cut + by_radius,
            )
        return after, (weights, trace)

    spans = None if crossed is None else crossed.spans
    carry, by_row = over_rows(step, carry, (rows, bits, seen, spans), used, backward=True)
    x, v = unsorted(carry.x, order), unsorted(carry.v, order)
    extra = by_atom(lambda part: unsorted(part, order), carry.extra)
    return carry._replace(x=x, v=v, extra=extra), by_row
