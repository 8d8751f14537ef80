"""Differentiation of all operations of the steps in reverse mode, like `jax.grad` of the run.

A chunk is a scan over steps with one neighbor list. Chunks of steps limit the memory that reverse mode needs.
A chunk ends early if the neighbor list must be rebuilt. The host then builds the list at the present
positions. The states between chunks are stored. If memory is insufficient, every second state is dropped. The
steps between the remaining states are then run again.

The differentiated program may round differently and then make other decisions. If decisions differ, the
gradient belongs to another trajectory. All states and decisions are therefore compared with those of an
ordinary run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt8

from mdnum.errors import NumericalError
from mdnum.gradients import parameters
from mdnum.gradients.losses import LossContext, LossFrame
from mdnum.gradients.parameters import Cotangents, onto_start, quantities, with_quantities
from mdnum.gradients.problem import Method, Problem, Progress, independent, rounded
from mdnum.gradients.tape import KEPT, RunTape, fingerprint, frame_of, in_box, no_sums, surroundings
from mdnum.md.cell import Cell
from mdnum.md.decide import Tables
from mdnum.md.integrators import by_atom, one_step, unsorted
from mdnum.md.neighbors import PairTable, check_radius
from mdnum.rollout.engine import first_state
from mdnum.rollout.flips import fingerprint_of_bits

#: Largest number of steps of a chunk.
CHUNK = 16
#: Approximate limit on the bytes that the reverse function of a chunk stores, and the estimated bytes per
#: slot of a list and step.
_CHUNK_BYTES, _PER_SLOT = 2**28, 256


class Inputs(NamedTuple):
    """All inputs with respect to which a loss can be differentiated."""

    model: Any  # the quantities of the force
    numbers: Any  # those of the integrator
    # x, v: wrapped positions and velocities of step 0, user's order
    x: Float[Array, "3 atoms"]
    v: Float[Array, "3 atoms"]
    scale: Float[Array, ""]  # a common factor of the frame that a loss compares with, 1


class StepEnds(NamedTuple):
    """Differentiable state between two steps. Atoms are in the user's order, velocities at half steps."""

    x: Float[Array, "3 atoms"]
    v: Float[Array, "3 atoms"]
    total: Any
    extra: Any
    matrix: Float[Array, "3 3"]  # lattice vectors


class RunConstants(NamedTuple):
    """Constants of a run that are not differentiated. Force parameters are in `Inputs`."""

    force: Any
    integrator: Any
    masses: Float[Array, "atoms"]
    # half the skin, radius of the list
    half_skin: Float[Array, ""]
    r_list: Float[Array, ""]
    loss: Any
    around: LossContext
    # lattice vectors taken off the positions of step 0. The rest as in a rollout
    images: Int[Array, "3 atoms"]


class Place(NamedTuple):
    """State that is not differentiated but needed to continue: integers and the neighbor list."""

    step: Int[Array, ""]  # the step whose forces come next
    images: Int[Array, "3 atoms"]  # lattice vectors taken off so far
    home: Float[Array, "3 atoms"]  # wrapped positions at which the list was built
    cell: Cell  # the box there
    built: Int[Array, ""]  # at which step
    extra: Any  # the integers of the extra state


class ChunkRecord(NamedTuple):
    """Status, states and decisions of each step in a chunk."""

    place: Place  # where it ended
    rows: Int[Array, ""]  # steps done
    finite: Bool[Array, ""]  # whether all numbers were
    # x, v, bits: of each step, in the list's order, as a rollout records them
    x: Float[Array, "chunk 3 atoms"]
    v: Float[Array, "chunk 3 atoms"]
    bits: UInt8[Array, "chunk words atoms"]


@partial(jax.jit, static_argnames=("rule",))
def chunk(
    inputs: Inputs,
    between: StepEnds,
    fixed: RunConstants,
    place: Place,
    limit: Int[Array, ""],
    seen: Bool[Array, "chunk"],
    tables: Tables,
    rule: tuple[int, int, bool],
) -> tuple[StepEnds, ChunkRecord]:
    """Run a chunk of steps with one neighbor list. The first two arguments are differentiable.

    Args:
        limit: largest number of steps. seen: which of the chunk's steps the loss uses.
        rule: every, delay and check of the rebuild rule.
    """
    every, delay, check = rule
    order, scale = tables.order, inputs.scale
    dtype = between.x.dtype
    force = with_quantities(fixed.force, inputs.model)
    integrator = eqx.combine(inputs.numbers, eqx.filter(fixed.integrator, eqx.is_inexact_array, inverse=True))
    moves, template = integrator.moves_cell, place.cell
    first = replace(template, matrix=between.matrix)
    masses = fixed.masses[order]
    home = place.home[:, order]
    around = fixed.around._replace(timestep=integrator.timestep)
    matrix = fixed.around.matrix * scale
    whole = inputs.x * scale.astype(dtype) + (matrix.T @ fixed.images.astype(matrix.dtype)).astype(dtype)
    nan = jnp.full((), jnp.nan)
    origin = LossFrame(jnp.zeros((), jnp.int64), whole, inputs.v, nan, nan)

    def used_up(x, cell, step):
        x, cell = lax.stop_gradient((x, cell))
        if moves:
            largest = cell.spent(x, template, home, fixed.r_list)
        else:
            largest = cell.astype(dtype).farthest(x - home)
        age = step - place.built
        allowed = (age >= delay) & (age % every == 0)
        return allowed & (largest > fixed.half_skin) if check else allowed

    def observe(total, row):
        *row, matrix = row
        seen = fixed.loss.observe(frame_of(row, order, matrix), origin, in_box(around, matrix))
        return jax.tree.map(jnp.add, total, seen)

    def act(carry, see):
        step, x, v, images, extra, matrix, total, _, finite, rows = carry
        cell = template.spanned(matrix) if moves else first
        made = replace(force, cell=cell)(x, tables, decisions=True, tensor=integrator.anisotropic)
        end = one_step(integrator, cell, masses, order, step, x, v, extra, made)
        potential = jnp.sum(made.energy, dtype=jnp.float64)
        row = step, x, end.v, images, potential, made.virial, cell.matrix
        total = lax.cond(see, observe, lambda total, _: total, total, row)
        assert made.decisions is not None
        row = (x, end.v, made.decisions.bits)
        images = images + lax.stop_gradient(end.images).astype(jnp.int32)
        finite = finite & jnp.isfinite(potential) & jnp.isfinite(jnp.sum(jnp.square(end.v)))
        step = step + 1
        at = step, end.x, end.kicked, images, end.ahead, end.cell.matrix if moves else matrix
        return (*at, total, used_up(end.x, end.cell, step), finite, rows + 1), row

    nothing = jax.eval_shape(force.decide, between.x, tables).bits

    def skip(carry, see):
        still = jnp.zeros_like(between.x)
        return carry, (still, still, jnp.zeros(nothing.shape, nothing.dtype))

    def one(carry, see):
        *_, due, finite, rows = carry
        return lax.cond(~due & finite & (rows < limit), act, skip, carry, see)

    extra = by_atom(lambda a: a[..., order], eqx.combine(between.extra, place.extra))
    start = (place.step, between.x[:, order], between.v[:, order], place.images[:, order], extra)
    # a box that does not move is no part of what the loop carries
    start += (between.matrix if moves else (), between.total, jnp.zeros((), bool), jnp.ones((), bool))
    start += (jnp.zeros((), jnp.int64),)
    (step, x, v, images, extra, matrix, *rest), (xs, vs, bits) = lax.scan(one, start, seen)
    total, due, finite, rows = rest
    matrix: Any = matrix if moves else between.matrix
    x, v, images = (unsorted(part, order) for part in (x, v, images))
    extra, whole = eqx.partition(by_atom(lambda a: unsorted(a, order), extra), eqx.is_inexact_array)
    cell = jax.tree.map(partial(jnp.where, due), template.spanned(matrix), template) if moves else template
    home, built = jnp.where(due, x, place.home), jnp.where(due, step, place.built)
    record = ChunkRecord(Place(step, images, home, cell, built, whole), rows, finite, xs, vs, bits)
    return StepEnds(x, v, total, extra, matrix), lax.stop_gradient(record)


@partial(jax.jit, static_argnames=("rule",))
def keep(inputs, between, *rest, rule):
    """Return the final state of a chunk, its vector-Jacobian product (`jax.vjp`), and its record."""
    return jax.vjp(lambda *given: chunk(*given, *rest, rule), inputs, between, has_aux=True)


@jax.jit
def pull(back, onto_between: StepEnds, onto_inputs: Inputs) -> tuple[StepEnds, Inputs]:
    """Propagate cotangents backward through a chunk. Sum the cotangents of the inputs."""
    by_inputs, by_between = back(onto_between)
    return by_between, jax.tree.map(jnp.add, onto_inputs, by_inputs)


class Snapshot(NamedTuple):
    """State between two chunks. `slots` is the capacity of the neighbor list (0 for default)."""

    between: StepEnds
    place: Place
    slots: int


class ChunkedProgram:
    """A simulation with a loss, run in chunks that JAX can differentiate."""

    def __init__(self, problem: Problem):
        simulation = problem.simulation
        self.problem, self.simulation = problem, simulation
        state, rule = first_state(simulation).state, simulation.rule
        self.rule = (rule.every, rule.delay, rule.check)
        self.fixed = RunConstants(
            simulation.force, simulation.integrator, jnp.asarray(simulation.masses),
            jnp.asarray(rule.skin / 2), jnp.asarray(simulation.r_cut + rule.skin), problem.loss,
            surroundings(simulation), state.images,
        )  # fmt: skip
        numbers = eqx.filter(simulation.integrator, eqx.is_inexact_array)
        self.inputs = Inputs(quantities(simulation.force), numbers, state.x, state.v, jnp.ones(()))
        origin = LossFrame(state.step, state.x, state.v, jnp.zeros(()), jnp.zeros(()))
        # the sums are kept as numbers; what the loss makes of them comes last
        total = no_sums(problem.loss, origin, self.fixed.around)
        extra, whole = eqx.partition(state.extra, eqx.is_inexact_array)
        cell, zero = state.cells[0].astype(np.float64), jnp.zeros((), jnp.int64)
        between = StepEnds(state.x, state.v, total, extra, jnp.asarray(cell.matrix))
        self.start = Snapshot(between, Place(zero, state.images, state.x, cell, zero, whole), 0)
        self._verlet = simulation.verlet_list()
        # the list in use, by the step at which it was built and its capacity
        self._used: tuple[tuple[int, int], tuple[PairTable, Tables]] | None = None
        slots = self.list_of(self.start)[0].slots
        # other potentials may have a term for every two neighbors of an atom
        row = slots * (1 if simulation.pairwise else slots) * simulation.atoms * _PER_SLOT
        # a power of two: each length is compiled for
        self.chunk = min(CHUNK, 1 << max(0, (_CHUNK_BYTES // row).bit_length() - 1))
        looked = problem.loss.looks_at(np.arange(problem.steps + 1), problem.steps)
        self._seen = np.concatenate([looked, np.zeros(self.chunk, bool)])
        self.frames = int(looked.sum())

    def forward(self, at: Snapshot, rows: int | None = None) -> Snapshot:
        """Run one chunk of at most `rows` steps without computing a derivative."""
        between, record = chunk(*self._arguments(at, rows), rule=self.rule)
        if not bool(record.finite):
            raise NumericalError(
                f"the differentiated run blew up at step {int(record.place.step) - 1}",
                remedy="Use a smaller time step, or starting positions without overlapping atoms",
            )
        return Snapshot(between, record.place, self.list_of(at)[0].slots)

    def keep(self, at: Snapshot, rows: int) -> tuple[ChunkRecord, Any]:
        """Run one chunk of steps; return its record and its vector-Jacobian product (`jax.vjp`)."""
        _, back, record = keep(*self._arguments(at, rows), rule=self.rule)
        return record, back

    def list_of(self, at: Snapshot) -> tuple[PairTable, Tables]:
        """Return the neighbor list of a snapshot."""
        key = (int(at.place.built), at.slots)
        if self._used is None or self._used[0] != key:
            self._verlet.slots = at.slots
            home = np.asarray(at.place.home, np.float64).T.copy()
            cell, simulation = jax.tree.map(np.asarray, at.place.cell), self.simulation
            check_radius(cell, simulation.r_cut, simulation.rule.skin)
            table = self._verlet.build(home, cell)
            self._used = (key, (table, self.simulation.tables(table)))
        return self._used[1]

    def cotangents(self, start: StepEnds, inputs: Inputs) -> Cotangents:
        """Convert cotangents of `Inputs` and initial state to derivatives."""
        numbers, x, v = onto_start(self.simulation, self.start.between, start.extra)
        inputs = inputs._replace(numbers=jax.tree.map(jnp.add, inputs.numbers, numbers))
        start = start._replace(x=start.x + x, v=start.v + v)
        x = np.asarray(inputs.x + start.x, np.float64)
        v = np.asarray(inputs.v + start.v, np.float64)
        whole = [(start.x, self.inputs.x), (start.matrix, self.start.between.matrix)]
        stretched = sum(float(np.sum(np.asarray(a, np.float64) * np.asarray(b))) for a, b in whole)
        scale, none = float(inputs.scale) + stretched, np.zeros(len(self.simulation.decider.r_cut))
        return Cotangents(inputs.model, inputs.numbers, x, v, scale, none)

    def _arguments(self, at: Snapshot, rows: int | None) -> tuple[Any, ...]:
        step = int(at.place.step)
        limit = min(self.chunk, self.problem.steps + 1 - step) if rows is None else rows
        seen = jnp.asarray(self._seen[step : step + self.chunk])
        limit = jnp.asarray(limit, jnp.int64)
        return self.inputs, at.between, self.fixed, at.place, limit, seen, self.list_of(at)[1]


@dataclass(frozen=True)
class Unrolled(Method):
    """Gradient method: derivative of all operations of the time steps, computed by JAX in reverse mode."""

    # bytes of states that are kept, evenly spread; those between two of them are made again
    budget: int = KEPT

    name = "unrolled"
    description = "the derivative of the steps that ran, by JAX, in its own forward pass"

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        if problem.simulation.fixed_point is not None:
            return "a fixed-point integer state has no derivative; the method reversible is for it"
        return rounded(problem.simulation)

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None):
        simulation, last = problem.simulation, problem.steps
        tell = progress or (lambda done, steps, phase: None)
        program = ChunkedProgram(problem)
        size = sum(leaf.nbytes for leaf in jax.tree.leaves(program.start[:2]))
        room = max(1, self.budget // size)
        at, ends, kept, hop = program.start, [0], [program.start], 1
        while ends[-1] <= last:
            at = program.forward(at)
            ends.append(int(at.place.step))
            if (len(ends) - 1) % hop == 0 and ends[-1] <= last:
                kept.append(at)
            if len(kept) > room:
                kept, hop = kept[::2], 2 * hop
            tell(ends[-1] - 1, last, "run")
        count = chunks_run = len(ends) - 1
        value, by_total = jax.value_and_grad(lambda total: problem.loss.value(total, program.frames))(
            at.between.total
        )
        onto = jax.tree.map(jnp.zeros_like, at.between)._replace(total=by_total)
        inputs = jax.tree.map(jnp.zeros_like, program.inputs)
        own: Marks = {}
        for block in reversed(range(len(kept))):
            first, states = block * hop, [kept.pop()]
            chunks = range(first, min(first + hop, count))
            for k in chunks[:-1]:
                states.append(program.forward(states[-1], ends[k + 1] - ends[k]))
            chunks_run += 2 * len(chunks) - 1
            for k in reversed(chunks):
                at = states.pop()
                record, back = program.keep(at, ends[k + 1] - ends[k])
                rows = range(int(record.rows))
                own.update(marks(ends[k], rows, record.x, record.v, record.bits, program.list_of(at)[0]))
                onto, inputs = pull(back, onto, inputs)
                tell(last - ends[k], last, "reverse pass")
        parts = program.cotangents(onto, inputs)
        gradient = {name: parameters.gradient(simulation, parts, name) for name in names}
        run: Marks = {}
        tape = RunTape(
            simulation, problem.loss, last, budget=0,
            each=lambda one: run.update(marks(one.first, range(one.rows), one.x, one.v, one.bits, one.table)),
        )  # fmt: skip
        details = {
            "steps linearized together": program.chunk, "chunks": count, "chunks run": chunks_run,
            "primal": {"value of the run": tape.value, **departure(run, own)},
        }  # fmt: skip
        notes = independent(problem, gradient, saltation=False)
        return self.result(float(value), gradient, notes, details)


#: Digests of the state and of the pairs inside, by step, independent of the order of atoms and lists.
Marks = dict[int, tuple[bytes, tuple[int, int]]]


def marks(first: int, rows: range, x, v, bits, table: PairTable) -> Iterator[tuple[int, Any]]:
    """Yield (step, hashes of state and decisions) for steps with one neighbor list."""
    x, v, bits = (np.asarray(part) for part in (x, v, bits))
    for row in rows:
        state = fingerprint(table.order, x[row], v[row])
        yield first + row, (state, fingerprint_of_bits(bits[row], table.index, table.order))


def departure(run: Mapping[int, Any], other: Mapping[int, Any]) -> dict[str, int | None]:
    """Return the first step at which states differ, and the first at which decisions differ."""
    both = sorted(run.keys() & other.keys())
    different = [[step for step in both if run[step][k] != other[step][k]] for k in (0, 1)]
    state, decision = (steps[0] if steps else None for steps in different)
    return {"steps compared": both[-1] if both else -1, "first state": state, "first decision": decision}
