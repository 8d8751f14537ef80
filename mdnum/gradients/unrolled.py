"""Reverse mode by JAX itself, through the program's own steps: what `jax.grad` of a rollout gives.

A chunk is a fixed number of steps with one list, as a scan, so that reverse mode has a bound on what it
keeps. What ends a list's life in a rollout ends the chunk early here: the rest of its steps do nothing. The
host makes the next list at the positions that this program has reached. States between chunks are kept while
memory lasts; where it does not, what lies between is run again from the binomial places for them.

Decisions are made by the program that is differentiated. Reverse mode needs another forward pass than a run
does, and a compiler is free to round it otherwise; where it does, the gradient belongs to a trajectory that
nobody simulated, so every step's state and decisions are compared with those of the run.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import comb
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt8, UInt64

from mdnum.errors import NumericalError
from mdnum.gradients import parameters
from mdnum.gradients.losses import LossContext, LossFrame
from mdnum.gradients.parameters import Cotangents, quantities, with_quantities
from mdnum.gradients.problem import Method, Problem, Progress, independent, rounded
from mdnum.gradients.tape import RunTape, surroundings
from mdnum.md.decide import Tables
from mdnum.md.neighbors import PairTable
from mdnum.rollout.engine import first_state

#: Steps of a chunk, at most.
CHUNK = 16
#: Bytes that the reverse function of a chunk may keep by a rough count, and what it keeps for each slot of a
#: list and step by that count.
_CHUNK_BYTES, _PER_SLOT = 2**28, 256
#: Share of the free memory that may be planned with.
_SHARE = 0.5
_UNSIGNED = {8: jnp.uint64, 4: jnp.uint32, 2: jnp.uint16}


class Inputs(NamedTuple):
    """Everything that a rollout can be differentiated by.

    Attributes:
        model: the quantities of the force. numbers: those of the integrator.
        x, v: wrapped positions and velocities of step 0, user's order.
        scale: a common factor of the box and of all positions, 1.
    """

    model: Any
    numbers: Any
    x: Float[Array, "3 atoms"]
    v: Float[Array, "3 atoms"]
    scale: Float[Array, ""]


class StepEnds(NamedTuple):
    """What one step hands to the next and a derivative goes through, user's order.

    Attributes:
        x: wrapped positions. v: half-kicked velocities. total: sums of the loss.
    """

    x: Float[Array, "3 atoms"]
    v: Float[Array, "3 atoms"]
    total: Any


class RunConstants(NamedTuple):
    """What does not change along a run and is not differentiated.

    Attributes:
        force, integrator: of the rollout; their quantities are replaced by those of the inputs.
        masses: user's order. half_skin: length. loss, around: the loss and its surroundings.
        images: lattice vectors taken off the positions of step 0.
    """

    force: Any
    integrator: Any
    masses: Float[Array, "atoms"]
    half_skin: Float[Array, ""]
    loss: Any
    around: LossContext
    images: Int[Array, "3 atoms"]


class Place(NamedTuple):
    """Where a chunk begins, as far as that has no derivative.

    Attributes:
        step: the step whose forces come next.
        images: lattice vectors taken off so far, user's order.
        home: wrapped positions at which the list was built, user's order. built: at which step.
        limit: steps that may be done. seen: which of the chunk's steps the loss looks at.
    """

    step: Int[Array, ""]
    images: Int[Array, "3 atoms"]
    home: Float[Array, "3 atoms"]
    built: Int[Array, ""]
    limit: Int[Array, ""]
    seen: Bool[Array, "chunk"]


class ChunkRecord(NamedTuple):
    """What a chunk leaves beside its end.

    Attributes:
        rows: steps done. due: whether the list is used up. finite: whether all numbers were.
        images: lattice vectors taken off at the end, user's order.
        x, v, bits: of each step, in the list's order, as a rollout records them.
    """

    rows: Int[Array, ""]
    due: Bool[Array, ""]
    finite: Bool[Array, ""]
    images: Int[Array, "3 atoms"]
    x: Float[Array, "chunk 3 atoms"]
    v: Float[Array, "chunk 3 atoms"]
    bits: UInt8[Array, "chunk words atoms"]


@partial(jax.jit, static_argnames=("rule",))
def chunk(
    inputs: Inputs,
    between: StepEnds,
    fixed: RunConstants,
    place: Place,
    tables: Tables,
    rule: tuple[int, int, bool],
) -> tuple[StepEnds, ChunkRecord]:
    """Some steps with one list; differentiable by its first two arguments.

    Args:
        rule: every, delay and check of the rebuild rule.
    """
    every, delay, check = rule
    order = tables.order
    dtype = between.x.dtype
    matrix = jnp.asarray(fixed.force.cell.matrix) * inputs.scale
    force = with_quantities(fixed.force, inputs.model)
    force = replace(force, cell=replace(force.cell, matrix=matrix))
    integrator = eqx.combine(inputs.numbers, eqx.filter(fixed.integrator, eqx.is_inexact_array, inverse=True))
    cell = force.cell.astype(dtype)
    masses = fixed.masses[order]
    mass_row = masses.astype(dtype)
    half = (0.5 * integrator.timestep).astype(dtype)
    home = place.home[:, order]
    scale = inputs.scale
    around = fixed.around._replace(
        matrix=fixed.around.matrix * scale,
        volume=fixed.around.volume * scale**3,
        timestep=integrator.timestep,
    )
    origin = LossFrame(
        jnp.zeros((), jnp.int64),
        inputs.x * scale.astype(dtype) + (matrix.T @ fixed.images.astype(matrix.dtype)).astype(dtype),
        inputs.v,
        jnp.full((), jnp.nan),
        jnp.full((), jnp.nan),
    )

    def unsorted(a):
        return jnp.zeros_like(a).at[:, order].set(a)

    def used_up(x, step):
        d = lax.stop_gradient(cell).minimum_image(*(lax.stop_gradient(x) - home))
        largest = jnp.sqrt(jnp.max(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])).astype(jnp.float64)
        age = step - place.built
        allowed = (age >= delay) & (age % every == 0)
        return allowed & (largest > fixed.half_skin) if check else allowed

    def observe(total, step, x, v, images, potential, virial):
        whole = x + (matrix.T @ images.astype(matrix.dtype)).astype(dtype)
        frame = LossFrame(step, unsorted(whole), unsorted(v), potential, virial)
        return jax.tree.map(jnp.add, total, fixed.loss.observe(frame, origin, around))

    def act(carry, see):
        step, x, v, images, total, _, finite, rows = carry
        made = force(x, tables, decisions=True)
        acceleration = made.force.astype(dtype) / mass_row
        second = jnp.where(step == 0, jnp.zeros((), dtype), half)
        v = v + second * acceleration
        potential = jnp.sum(made.energy, dtype=jnp.float64)
        total = lax.cond(
            see, observe, lambda total, *_: total, total, step, x, v, images, potential, made.virial
        )
        assert made.decisions is not None
        row = (x, v, made.decisions.bits)
        after, kicked, _ = integrator.drift(x, v + half * acceleration, masses, step, order)
        wrapped, n = cell.wrap(*after)
        images = images + lax.stop_gradient(jnp.stack(n)).astype(jnp.int32)
        x = jnp.stack(wrapped)
        finite = finite & jnp.isfinite(potential) & jnp.isfinite(jnp.sum(jnp.square(v)))
        step = step + 1
        return (step, x, kicked, images, total, used_up(x, step), finite, rows + 1), row

    words, atoms = tables.index.shape[0], order.shape[0]

    def skip(carry, see):
        nothing = jnp.zeros((3, atoms), dtype)
        return carry, (nothing, nothing, jnp.zeros((words, atoms), jnp.uint8))

    def one(carry, see):
        *_, due, finite, rows = carry
        return lax.cond(~due & finite & (rows < place.limit), act, skip, carry, see)

    start = (
        place.step,
        between.x[:, order],
        between.v[:, order],
        place.images[:, order],
        between.total,
        jnp.zeros((), bool),
        jnp.ones((), bool),
        jnp.zeros((), jnp.int64),
    )
    (_, x, v, images, total, due, finite, rows), (xs, vs, bits) = lax.scan(one, start, place.seen)
    record = ChunkRecord(rows, due, finite, unsorted(images), xs, vs, bits)
    return StepEnds(unsorted(x), unsorted(v), total), lax.stop_gradient(record)


@partial(jax.jit, static_argnames=("rule",))
def keep(inputs, between, fixed, place, tables, rule):
    """A chunk, its reverse function with everything that it keeps, and its record."""
    return jax.vjp(
        lambda inputs, between: chunk(inputs, between, fixed, place, tables, rule),
        inputs,
        between,
        has_aux=True,
    )


@jax.jit
def pull(back, onto_between: StepEnds, onto_inputs: Inputs) -> tuple[StepEnds, Inputs]:
    """Cotangents through the reverse function of a chunk; those of the inputs are added up."""
    by_inputs, by_between = back(onto_between)
    return by_between, jax.tree.map(jnp.add, onto_inputs, by_inputs)


class Snapshot(NamedTuple):
    """Where the program can be continued.

    Attributes:
        between: what has a derivative.
        step, built: next step, and step at which its list was built.
        images: user's order. home: wrapped positions at which the list was built.
        slots: capacity of the list; 0 lets the density decide.
    """

    between: StepEnds
    step: int
    built: int
    images: Int[Array, "3 atoms"]
    home: Float[Array, "3 atoms"]
    slots: int


class ChunkedProgram:
    """The program of a problem, chunk by chunk.

    Args:
        problem: the loss of a rollout.
        chunk: steps of a chunk; None: the number that does not keep too much.
    """

    def __init__(self, problem: Problem, chunk: int | None = None):
        simulation = problem.simulation
        self.problem, self.simulation = problem, simulation
        state = first_state(simulation).state
        rule = simulation.rule
        self.rule = (rule.every, rule.delay, rule.check)
        self.fixed = RunConstants(
            simulation.force,
            simulation.integrator,
            jnp.asarray(simulation.masses),
            jnp.asarray(rule.skin / 2, jnp.float64),
            problem.loss,
            surroundings(simulation),
            state.images,
        )
        numbers = eqx.filter(simulation.integrator, eqx.is_inexact_array)
        self.inputs = Inputs(quantities(simulation.force), numbers, state.x, state.v, jnp.ones(()))
        origin = LossFrame(state.step, state.x, state.v, jnp.zeros(()), jnp.zeros(()))
        shapes = jax.eval_shape(problem.loss.observe, origin, origin, self.fixed.around)
        total = jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), shapes)
        # the sums are kept as numbers; what the loss makes of them comes last
        between = StepEnds(state.x * self.inputs.scale.astype(state.x.dtype), state.v, total)
        self.start = Snapshot(between, 0, 0, state.images, between.x, 0)
        self._verlet = simulation.verlet_list()
        # snapshots of one list share the array of the positions at which it was built
        self._used: tuple[Any, int, tuple[PairTable, Tables]] | None = None
        if chunk is None:
            slots = self.list_of(self.start)[0].slots
            # other potentials may have a term for every two neighbors of an atom
            row = slots * (1 if simulation.pairwise else slots) * simulation.atoms * _PER_SLOT
            # a power of two: each length is compiled for
            chunk = min(CHUNK, 1 << max(0, (_CHUNK_BYTES // row).bit_length() - 1))
        self.chunk = chunk
        looked = problem.loss.looks_at(np.arange(problem.steps + 1), problem.steps)
        self._seen = np.concatenate([looked, np.zeros(chunk, bool)])
        self.frames = int(looked.sum())

    def forward(self, at: Snapshot, rows: int | None = None) -> Snapshot:
        """One chunk on, without a derivative; of at most `rows` steps."""
        return self._after(at, *chunk(*self._arguments(at, rows), rule=self.rule))

    def keep(self, at: Snapshot, rows: int) -> tuple[ChunkRecord, Any]:
        """One chunk's record and its reverse function."""
        _, back, record = keep(*self._arguments(at, rows), rule=self.rule)
        return record, back

    def list_of(self, at: Snapshot) -> tuple[PairTable, Tables]:
        """The list that is in use at a snapshot."""
        if self._used is None or self._used[0] is not at.home or self._used[1] != at.slots:
            self._verlet.slots = at.slots
            table = self._verlet.build(np.asarray(at.home, np.float64).T.copy(), self.simulation.cell)
            self._used = (at.home, at.slots, (table, self.simulation.tables(table)))
        return self._used[2]

    def value(self, total) -> Array:
        """The loss, from its sums."""
        return self.problem.loss.value(total, self.frames)

    def cotangents(self, start: StepEnds, inputs: Inputs) -> Cotangents:
        """Derivatives by what a rollout is made of, from those of the inputs and of the first positions."""
        x = np.asarray(inputs.x + start.x, np.float64)
        v = np.asarray(inputs.v + start.v, np.float64)
        scale = float(inputs.scale) + float(
            np.sum(np.asarray(start.x, np.float64) * np.asarray(self.inputs.x))
        )
        none = np.zeros(self.simulation.pair_types)
        return Cotangents(inputs.model, inputs.numbers, x, v, scale, none)

    def _arguments(self, at: Snapshot, rows: int | None) -> tuple[Any, ...]:
        _, tables = self.list_of(at)
        limit = min(self.chunk, self.problem.steps + 1 - at.step) if rows is None else rows
        place = Place(
            jnp.asarray(at.step, jnp.int64),
            at.images,
            at.home,
            jnp.asarray(at.built, jnp.int64),
            jnp.asarray(limit, jnp.int64),
            jnp.asarray(self._seen[at.step : at.step + self.chunk]),
        )
        return self.inputs, at.between, self.fixed, place, tables

    def _after(self, at: Snapshot, between: StepEnds, record: ChunkRecord) -> Snapshot:
        step, slots = at.step + int(record.rows), self.list_of(at)[0].slots
        if not bool(record.finite):
            raise NumericalError(
                f"the program that is differentiated blew up at step {step - 1}",
                remedy="Use a smaller time step, or a start without overlapping atoms",
            )
        built, home = (step, between.x) if bool(record.due) else (at.built, at.home)
        return Snapshot(between, step, built, record.images, home, slots)


@dataclass(frozen=True)
class Unrolled(Method):
    """The derivative of the steps that ran, by JAX.

    Attributes:
        snapshots: states that may be kept beside the first; None: as many as there is memory for.
        chunk: steps that are linearized together; None: up to 16, as memory has it.
        compare: whether to make the run as well and report where this program departs from it.
    """

    snapshots: int | None = None
    chunk: int | None = None
    compare: bool = True

    name = "unrolled"
    description = "the derivative of the steps that ran, by JAX, in its own forward pass"

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        if problem.simulation.lattice is not None:
            return "a fixed-point integer state has no derivative; the method reversible is for it"
        return rounded(problem.simulation)

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None):
        simulation, last = problem.simulation, problem.steps
        program = ChunkedProgram(problem, self.chunk)
        size = sum(leaf.nbytes for leaf in jax.tree.leaves(program.start[:1] + program.start[3:5]))
        room = max(1, free() // size) if self.snapshots is None else self.snapshots
        at, ends, kept = program.start, [0], [program.start]
        while at.step <= last:
            at = program.forward(at)
            ends.append(at.step)
            if len(kept) <= room:
                kept.append(at)
            if progress is not None:
                progress(at.step - 1, last, "run")
        count = chunks_run = len(ends) - 1
        if len(kept) <= count:
            # not all of them: places that need the fewest chunks run again
            kept = kept[:1]
        stack = [(k, state) for k, state in enumerate(kept[:count])]
        value, by_total = jax.value_and_grad(program.value)(at.between.total)
        nothing = jnp.zeros_like(at.between.x)
        onto, inputs = StepEnds(nothing, nothing, by_total), jax.tree.map(jnp.zeros_like, program.inputs)
        own = Fingerprints(last)
        for k in reversed(range(count)):
            while stack[-1][0] < k:
                j, here = stack[-1]
                hop = ahead(k + 1 - j, room + 1 - len(stack))
                for m in range(j, j + hop):
                    here = program.forward(here, ends[m + 1] - ends[m])
                chunks_run += hop
                stack.append((j + hop, here))
            _, here = stack.pop()
            record, back = program.keep(here, ends[k + 1] - ends[k])
            chunks_run += 1
            if self.compare:
                own.add(ends[k], int(record.rows), record.x, record.v, record.bits, program.list_of(here)[1])
            onto, inputs = pull(back, onto, inputs)
            if progress is not None:
                progress(last - ends[k], last, "reverse pass")
        parts = program.cotangents(onto, inputs)
        details: dict[str, Any] = {"steps linearized together": program.chunk, "chunks": count}
        details["chunks run"] = chunks_run
        gradient = {name: parameters.gradient(simulation, parts, name) for name in names}
        notes = independent(problem, gradient, saltation=False)
        if self.compare:
            run = Fingerprints(last)
            tape = RunTape(
                simulation, problem.loss, last, budget=0,
                each=lambda one: run.add(
                    one.first, one.rows, one.x, one.v, one.bits, simulation.tables(one.table)
                ),
            )  # fmt: skip
            details["primal"] = {"value of the run": tape.value, **run.departure(own)}
        return self.result(float(value), gradient, notes, details)


def ahead(length: int, room: int) -> int:
    """How many chunks ahead the next state is kept, so that the fewest are run again.

    Args:
        length: chunks to reverse.
        room: states that may still be kept.

    Source: Griewank & Walther, Revolve, ACM Trans. Math. Softw. 26 (2000) 19.
    """
    if room < 1:
        return length - 1
    # with the state at the start there is one more
    states, repeats = room + 1, 1
    while comb(states + repeats, states) < length:
        repeats += 1
    # as far ahead as one repeat less allows, and no nearer to the end than one state less allows
    near, far = comb(states + repeats - 2, states - 1), comb(states + repeats - 1, states)
    return max(1, min(far, length - near))


def free() -> int:
    """Memory that may be planned with, bytes.

    The kernel's estimate of what can be had without swapping, or the limit of the container where that is
    less.
    """
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        amount = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        amount = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    group = Path("/sys/fs/cgroup")
    try:
        limit, used = ((group / name).read_text().strip() for name in ("memory.max", "memory.current"))
    except OSError:
        limit = used = "max"
    if limit != "max":
        amount = min(amount, int(limit) - int(used))
    return int(_SHARE * max(amount, 0))


class Fingerprints:
    """Of the states and decisions of one program, step by step, whatever the order of atoms and lists.

    Args:
        steps: last step.
    """

    def __init__(self, steps: int):
        self.state, self.decision = (np.zeros(steps + 1, np.uint64) for _ in range(2))
        self.known = np.zeros(steps + 1, bool)

    def add(self, first: int, rows: int, x, v, bits, tables: Tables) -> None:
        """Some steps with one list.

        Args:
            first, rows: first step and the number in use of those given.
            x, v: in the order of the list, shape (room, 3, atoms). bits: packed decisions.
        """
        state, decision = _of_rows(jnp.asarray(x), jnp.asarray(v), jnp.asarray(bits), tables)
        here = slice(first, first + rows)
        self.state[here], self.decision[here] = np.asarray(state)[:rows], np.asarray(decision)[:rows]
        self.known[here] = True

    def departure(self, other: Fingerprints) -> dict[str, int | None]:
        """First steps at which another program has another bit in its state, and other pairs inside."""
        both = self.known & other.known

        def first(different: np.ndarray) -> int | None:
            return int(np.argmax(different)) if different.any() else None

        return {
            "steps compared": int(np.flatnonzero(both)[-1]) if both.any() else -1,
            "first state": first(both & (self.state != other.state)),
            "first decision": first(both & (self.decision != other.decision)),
        }


@jax.jit
def _of_rows(
    x: Float[Array, "rows 3 atoms"],
    v: Float[Array, "rows 3 atoms"],
    bits: UInt8[Array, "rows words atoms"],
    tables: Tables,
) -> tuple[UInt64[Array, "rows"], UInt64[Array, "rows"]]:
    atoms = x.shape[-1]
    order = tables.order.astype(jnp.uint64)
    ends = jnp.append(order, jnp.zeros((), jnp.uint64))[tables.index]
    pairs = _mixed(order * jnp.uint64(atoms) + ends)
    places = jnp.arange(6, dtype=jnp.uint64)[:, None] * jnp.uint64(atoms) + order
    shifts = jnp.arange(8, dtype=jnp.uint8)[:, None]

    def one(row):
        x, v, bits = row
        words = lax.bitcast_convert_type(jnp.concatenate([x, v]), _UNSIGNED[x.dtype.itemsize])
        state = jnp.sum(_mixed(_mixed(words.astype(jnp.uint64)) + places))
        inside = (bits[:, None, :] >> shifts) & jnp.uint8(1) == 1
        return state, jnp.sum(jnp.where(inside, pairs, jnp.zeros((), jnp.uint64)))

    return lax.map(one, (x, v, bits))


def _mixed(words: UInt64[Array, "..."] | Int[Array, "..."]) -> UInt64[Array, "..."]:
    """Every bit of the result depends on every bit of the word (splitmix64; Steele, Lea & Flood 2014)."""
    z = words + jnp.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> jnp.uint64(30))) * jnp.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> jnp.uint64(27))) * jnp.uint64(0x94D049BB133111EB)
    return z ^ (z >> jnp.uint64(31))
