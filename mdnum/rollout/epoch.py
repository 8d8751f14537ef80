"""The compiled loop over time steps with one neighbor list (an epoch)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt8

from mdnum.md.cell import Cell
from mdnum.md.decide import Changes, Tables, zeros
from mdnum.md.integrators import Integrator, by_atom, one_step, unsorted
from mdnum.md.neighbors import PairTable
from mdnum.md.pairforce import Forces


@dataclass(frozen=True)
class Pin:
    """Cutoff decisions that are imposed on one pair of atoms."""

    # i, j: the pair, i < j; to i the number of atoms is added for each channel before that of the decision
    i: int
    j: int
    # first, last: steps at which it is told
    first: int
    last: int
    changes: tuple[int, ...] = ()  # steps at which what it is told changes, ascending
    inside: bool = False  # what it is told before the first of them

    def at(self, steps: Int[np.ndarray, "steps"]) -> Bool[np.ndarray, "steps"]:
        """Return the imposed decision at each step. True means inside the cutoff."""
        turned = np.searchsorted(np.asarray(self.changes, np.int64), steps, side="right")
        return (turned % 2 == 1) ^ self.inside


@dataclass(frozen=True)
class Pins:
    """Cutoff decisions that are imposed on selected pairs of atoms."""

    pins: Sequence[Pin]

    def rows(
        self, table: PairTable, first: int, count: int, channels: int = 1
    ) -> tuple[UInt8[np.ndarray, "rows words atoms"], UInt8[np.ndarray, "rows words atoms"]]:
        """Return imposed decisions at consecutive steps as bits, with a mask.

        Pairs outside the neighbor list can have no imposed decision.

        Args:
            table: the neighbor list.
            first: step of the first row.
            count: number of rows.
            channels: number of decisions per pair.
        """
        atoms = len(table.order)
        shape = (count, channels * table.slots // 8, atoms)
        told, where = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        steps = np.arange(first, first + count)
        index = table.index.reshape(-1, atoms)
        for pin in self.pins:
            held = (steps >= pin.first) & (steps <= pin.last)
            if not held.any():
                continue
            inside = pin.at(steps)
            channel, i = divmod(pin.i, atoms)
            for atom, other in ((i, pin.j), (pin.j, i)):
                column = table.place[atom]
                for slot in np.flatnonzero(index[:, column] == table.place[other]) + channel * table.slots:
                    bit = np.uint8(1 << (slot % 8))
                    where[held, slot // 8, column] |= bit
                    told[held & inside, slot // 8, column] |= bit
        return told, where


# --- the life of one Verlet list: a jitted loop that advances with fixed pairs and records as it goes -


class EpochProgram(eqx.Module):
    """Constant data of a run: force function, integrator, masses and limits."""

    force: eqx.Module  # PairForce or ManyBodyForce: forces and decisions over a list, in the box of a row
    integrator: Integrator  # between force evaluations
    masses: Float[Array, "atoms"]  # shape (atoms,), in the user's order
    half_skin: Float[Array, ""]  # half the skin, length
    r_list: Float[Array, ""]  # radius of the list, length
    r_cut: Float[Array, ""]  # largest cutoff, length
    # every, delay: when the list may be rebuilt (RebuildRule)
    every: int = eqx.field(static=True)
    delay: int = eqx.field(static=True)
    check: bool = eqx.field(static=True)  # whether a rebuild needs an atom to have moved by half the skin
    record: bool = eqx.field(static=True)  # whether decisions leave the loop
    # whether they do so row by row, with positions; else as changes from one row to the next
    rows: bool = eqx.field(static=True, default=True)
    most: int = eqx.field(static=True, default=0)  # changes of one row that there is room for, without rows
    inputs: bool = eqx.field(static=True, default=False)  # whether rows have what their step was made of


class EpochState(NamedTuple):
    """State of a run between two force evaluations, in the user's order of atoms."""

    step: Int[Array, ""]  # the step whose forces come next
    x: Float[Array, "3 atoms"]  # wrapped positions at that step, shape (3, atoms)
    # velocities after the first half kick (at step 0: the initial velocities), shape (3, atoms)
    v: Float[Array, "3 atoms"]
    images: Int[Array, "3 atoms"]  # lattice vectors taken off by wrapping so far, shape (3, atoms)
    x_before: Float[Array, "3 atoms"]  # positions of the step before, shape (3, atoms)
    heat: Float[Array, ""]  # energy taken up from the thermostat so far
    extra: Any = ()  # of the integrator, as `Integrator.init` makes it
    # the box, float64; where the integrator moves it, also those of the step before and of the list's build
    cells: tuple[Cell, ...] = ()


class StepInputs(NamedTuple):
    """Inputs of a time step that are needed only for derivatives."""

    v: Float[Array, "3 atoms"]  # velocities that lead there, as the step before left them
    extra: Any  # the extra state then
    force: Float[Array, "3 atoms"]  # energy/length, in the dtype of the state
    tensor: Float[Array, "3 3"] | None  # as `Forces.tensor`


class EpochRecord(NamedTuple):
    """Record with one row per time step. Atoms are in the order of the neighbor list."""

    # x, v: positions and full-step velocities, shape (rows, 3, atoms), or (rows, 3, 0) without rows
    x: Float[Array, "rows 3 atoms"]
    v: Float[Array, "rows 3 atoms"]
    images: Int[Array, "rows 3 atoms"]  # shape (rows, 3, atoms), int32, or none
    bits: UInt8[Array, "rows words atoms"]  # decisions, shape (rows, words, atoms), or none
    # potential, kinetic, virial, heat: energies, shape (rows,); heat taken up so far
    potential: Float[Array, "rows"]
    kinetic: Float[Array, "rows"]
    virial: Float[Array, "rows"]
    heat: Float[Array, "rows"]
    work: Float[Array, "rows"]  # energy that the box has given so far
    # nearest: smallest |margin|; moved: `Cell.spent` since the list was built; of shape (rows,)
    nearest: Float[Array, "rows"]
    moved: Float[Array, "rows"]
    inside: Float[Array, "rows"]  # how many decisions are yes, without rows; shape (rows,)
    cell: Float[Array, "rows vectors 3"]  # lattice vectors, shape (rows, 3, 3), or (rows, 0, 3) of one box
    changes: Changes | None = None  # of decisions from row to row, instead of rows
    inputs: Any = ()  # `StepInputs` of each row, where they were asked for

    def boxes(self, rows: int, pbc: tuple[bool, bool, bool]) -> tuple[Cell, ...]:
        """Return the boxes of the first `rows` steps. Empty if the box is constant."""
        if not self.cell.size:
            return ()
        return tuple(Cell.create(one, pbc) for one in np.asarray(self.cell)[:rows])


_NUMBERS = ("potential", "kinetic", "virial", "heat", "work", "nearest", "moved", "inside")


class EpochOutcome(NamedTuple):
    """State, status flags and cutoff decisions at the end of the compiled loop."""

    state: EpochState  # where to go on
    # four numbers that travel together: how many rows were recorded; whether the list must be rebuilt before
    # the next forces; whether every number so far was finite; and whether an atom has just moved by more than
    # a lattice vector in one step, or the box has become narrower than twice the cutoff, so that forces there
    # would mean nothing and decisions would no longer be exact
    flags: Int[Array, "4"]
    # largest displacement since the list was built (see `Cell.spent`), at the step that comes next, length
    moved: Float[Array, ""]
    # decisions of the list at the step before, for the count check and the first flips of a new list; where
    # they were not asked for, those that were held. None without recording.
    before: UInt8[Array, "words atoms"] | None
    inside: Int[Array, ""]  # how many of those are yes
    # how far an atom came at most from the step before to the first row, as `moved`, length
    leap: Float[Array, ""]
    held: UInt8[Array, "words atoms"] | None = None  # decisions at the last row, None with rows


def empty_record(
    rows: int,
    words: int,
    atoms: int,
    dtype,
    record: bool,
    changes: int | None = None,
    cells: bool = False,
    inputs: Any = (),
) -> EpochRecord:
    """Allocate the record of an epoch. If `record` is False, arrays with one entry per atom are empty.

    Args:
        changes: number of changes of decisions to allocate in place of rows of decisions and positions.
        cells: whether each row has its own box.
        inputs: `StepInputs` of any step, if they are to be recorded.
    """
    record = record and changes is None
    shape = (rows, 3, atoms) if record else (rows, 3, 0)
    return EpochRecord(
        x=zeros(shape, dtype),
        v=zeros(shape, dtype),
        images=zeros(shape, np.int32),
        bits=zeros((rows, words, atoms if record else 0), np.uint8),
        **{name: zeros(rows, np.float64) for name in _NUMBERS},
        cell=zeros((rows, 3 * cells, 3), np.float64),
        changes=None if changes is None else Changes.empty(changes, dtype),
        inputs=jax.tree.map(lambda one: zeros((rows, *one.shape), one.dtype), inputs),
    )


def write_row(record: EpochRecord, row, **values) -> EpochRecord:
    """Write the values of one time step into a record."""

    def put(column, value):
        return lax.dynamic_update_index_in_dim(column, jnp.asarray(value, column.dtype), row, 0)

    changed = {name: jax.tree.map(put, getattr(record, name), value) for name, value in values.items()}
    return record._replace(**changed)


def over_rows(
    step: Callable[[Any, Any], tuple[Any, Any]], carry: Any, rows: Any, used: Any, *, backward: bool = False
) -> tuple[Any, Any]:
    """Scan like `jax.lax.scan`, but only over the first `used` rows.

    Buffers have the size of the longest segment, so that one function is compiled. A loop over the whole
    buffer would mostly visit empty rows. Outputs for unused rows of the buffers are zero.
    """
    first = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), rows)
    _, out = jax.eval_shape(step, carry, first)
    room = jax.tree.leaves(rows)[0].shape[0]
    outputs = jax.tree.map(lambda leaf: jnp.zeros((room, *leaf.shape), leaf.dtype), out)

    def body(k, both):
        carry, outputs = both
        at = used - 1 - k if backward else k
        row = jax.tree.map(lambda leaf: lax.dynamic_index_in_dim(leaf, at, keepdims=False), rows)
        carry, new = step(carry, row)
        return carry, jax.tree.map(
            lambda all, one: lax.dynamic_update_index_in_dim(all, one, at, 0), outputs, new
        )

    return lax.fori_loop(0, used, body, (carry, outputs))


# the record is donated: two of them take turns, and no epoch pays for clearing one
# flattening a program's many leaves anew costs a small system more than its step: it is done once
@partial(jax.jit, static_argnames=("structure",), donate_argnames=("record",))
def run_epoch(
    leaves: tuple[Array, ...],
    structure: Any,
    tables: Tables,
    state: EpochState,
    reference: Float[Array, "3 atoms"],
    built: Int[Array, ""],
    last: Int[Array, ""],
    look_back: Bool[Array, ""],
    record: EpochRecord,
    told: UInt8[Array, "rows words atoms"] | None = None,
    pinned: UInt8[Array, "rows words atoms"] | None = None,
    held: UInt8[Array, "words atoms"] | None = None,
) -> tuple[EpochOutcome, EpochRecord]:
    """Integrate until the skin is used up, the record is full or the run ends.

    Args:
        leaves, structure: the program, flattened by jax.tree.flatten.
        tables: the neighbor list.
        state: state of the rollout, in the user's order of atoms.
        reference: wrapped positions at which the list was built, in the user's order of atoms.
        built: step at which the list was built.
        last: last step to evaluate.
        look_back: whether to evaluate also the decisions of the previous step with this list.
        record: rows to fill; donated.
        told: imposed decisions of each row, which replace the computed decisions; computed decisions are
            still recorded. Only for pair potentials.
        pinned: slots of each row at which decisions are imposed; None for all slots.
        held: decisions for this list at the previous step, if not evaluated again; required without rows.
    """
    program: EpochProgram = jax.tree.unflatten(structure, leaves)
    order = tables.order
    dtype = state.x.dtype
    x, v, images = state.x[:, order], state.v[:, order], state.images[:, order]
    home = reference[:, order]
    masses, integrator = program.masses[order], program.integrator
    moves, one_box = integrator.moves_cell, state.cells[0].astype(dtype)
    force_in: Any = partial(replace, program.force)  # type: ignore[arg-type]

    def spent(cell, x, reference_cell, reference):
        if moves:
            return cell.spent(x, reference_cell, reference, program.r_list)
        return one_box.farthest(x - reference)

    before, inside = None, jnp.zeros((), jnp.int64)
    if program.record:
        shape = jax.eval_shape(program.force.decide, x, tables).bits.shape  # type: ignore[attr-defined]
        before = lax.cond(
            look_back,
            lambda x: force_in(cell=state.cells[moves]).decide(x, tables).bits,
            lambda x: jnp.zeros(shape, jnp.uint8) if held is None else held,
            state.x_before[:, order],
        )
        # each pair has two decisions that are yes
        inside = jnp.sum(jnp.bitwise_count(before), dtype=jnp.int64)

    def body(carry):
        step, x, v, images, _, heat, extra, cells, row, _, _, _, largest, record, earlier = carry
        cell, home_cell = (cells or state.cells)[0], state.cells[-1]
        given = {} if told is None else {"given": told[row]}
        if pinned is not None:
            given["where"] = pinned[row]
        made: Forces = force_in(cell=cell)(
            x, tables, decisions=program.record, tensor=integrator.anisotropic, **given
        )
        end = one_step(integrator, cell, masses, order, step, x, v, extra, made)
        given_heat, given_work = integrator.exchanged(end.extra, end.at)
        potential = jnp.sum(made.energy, dtype=jnp.float64)
        kinetic = integrator.kinetic(end.v, masses)
        values = {
            "potential": potential,
            "kinetic": kinetic,
            "virial": made.virial,
            "heat": heat + given_heat,
            "work": given_work,
            "moved": largest,
        }
        if moves:
            values["cell"] = cell.matrix
        if program.inputs:
            values["inputs"] = StepInputs(v, extra, made.force.astype(dtype), made.tensor)
        if program.record:
            d = made.decisions
            assert d is not None
            values["nearest"] = d.nearest
            if program.rows:
                values |= {"x": x, "v": end.v, "images": images, "bits": d.bits}
            else:
                changes, earlier = record.changes.noted(earlier, d.bits, tables, x, end.v, row, program.most)
                values["inside"] = changes.count[2]
                record = record._replace(changes=changes)
        record = write_row(record, row, **values)
        finite = jnp.isfinite(potential) & jnp.isfinite(kinetic)
        runaway = jnp.max(jnp.abs(end.images)) > 1
        if moves:
            runaway |= end.cell.is_narrow(program.r_cut)
        images = images + end.images.astype(jnp.int32)
        step = step + 1
        largest = spent(end.cell, end.x, home_cell, home)
        age = step - built
        allowed = (age >= program.delay) & (age % program.every == 0)
        due = allowed & (largest > program.half_skin) if program.check else allowed
        ended = due, finite, runaway, largest
        if moves:
            cells = end.cell, cell, jax.tree.map(partial(jnp.where, due), end.cell, home_cell)
        at = step, end.x, end.kicked, images, x, heat + end.heat, end.ahead, cells
        return *at, row + 1, *ended, record, earlier

    def go_on(carry):
        step, _, _, _, _, _, _, _, row, due, finite, runaway, _, record, _ = carry
        more = (step <= last) & (row < record.potential.shape[0]) & ~due & finite & ~runaway
        if record.changes is not None:
            more &= record.changes.count[0] + program.most <= len(record.changes.pairs)
        if integrator.pause is None:
            return more
        return more & ((row == 0) | (step % integrator.pause != 0))

    extra, no, yes = by_atom(lambda a: a[..., order], state.extra), jnp.zeros((), bool), jnp.ones((), bool)
    begun = state.step, x, v, images, state.x_before[:, order], state.heat, extra
    # a box that does not move is no part of what the loop carries
    begun += (state.cells if moves else (),)
    empty = record if record.changes is None else record._replace(changes=record.changes.emptied())
    row, largest = jnp.zeros((), jnp.int64), spent(state.cells[0], x, state.cells[-1], home)
    carry = (*begun, row, no, yes, no, largest, empty, None if program.rows else before)
    done = lax.while_loop(go_on, body, carry)
    end, (rows, due, finite, runaway, largest, record, earlier) = EpochState(*done[:8]), done[8:]

    placed = {name: unsorted(getattr(end, name), order) for name in ("x", "v", "images", "x_before")}
    extra = by_atom(lambda a: unsorted(a, order), end.extra)
    end = end._replace(**placed, extra=extra, cells=end.cells or state.cells)
    flags = jnp.stack([rows, due.astype(rows.dtype), finite.astype(rows.dtype), runaway.astype(rows.dtype)])
    # seen from the positions now, at which a new list is built
    leap = spent(state.cells[moves], state.x_before, state.cells[0], state.x)
    return EpochOutcome(end, flags, largest, before, inside, leap, earlier), record
