"""A rollout as chunks of its differentiated program: where each begins, its list, and what it is told."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mdnum.errors import NumericalError
from mdnum.gradients.base import Problem
from mdnum.gradients.losses import Frame
from mdnum.gradients.parameters import Cotangents, quantities
from mdnum.gradients.program import Between, Fixed, Inputs, Passed, Place, chunk, keep, pull
from mdnum.gradients.tape import surroundings
from mdnum.md.decide import Tables
from mdnum.md.verlet import PairTable
from mdnum.rollout.engine import first_state

#: Steps of a chunk, at most.
CHUNK = 16
#: Bytes that the reverse function of a chunk may keep by a rough count, and what it keeps for each slot of a
#: list and step by that count.
_CHUNK_BYTES, _PER_SLOT = 2**28, 256


class Snapshot(NamedTuple):
    """Where the program can go on from.

    Attributes:
        between: what has a derivative.
        step, built: next step, and step at which its list was built.
        images: user's order. home: wrapped positions at which the list was built, shape (3, atoms).
        slots: capacity of the list; 0 lets the density decide.
    """

    between: Between
    step: int
    built: int
    images: Int[Array, "3 atoms"]
    home: Float[Array, "3 atoms"]
    slots: int

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves((self.between, self.images, self.home)))


@dataclass(frozen=True)
class Leg:
    """One chunk that has been done.

    Attributes:
        first, rows: its first step, and how many steps.
        slots: capacity of its list.
    """

    first: int
    rows: int
    slots: int


class Steps:
    """The program of a problem, chunk by chunk.

    Args:
        problem: the loss of a rollout.
        chunk: steps of a chunk; None: as many as do not keep too much.
    """

    def __init__(self, problem: Problem, chunk: int | None = None):
        simulation = problem.simulation
        self.problem, self.simulation = problem, simulation
        state = first_state(simulation).state
        rule = simulation.rule
        self.rule = (rule.every, rule.delay, rule.check)
        self.fixed = Fixed(
            simulation.force,
            simulation.integrator,
            jnp.asarray(simulation.masses),
            jnp.asarray(rule.skin / 2, jnp.float64),
            problem.loss,
            surroundings(simulation),
            state.images,
        )
        self.inputs = Inputs(
            quantities(simulation.force),
            eqx.filter(simulation.integrator, eqx.is_inexact_array),
            state.x,
            state.v,
            jnp.ones(()),
        )
        origin = Frame(state.step, state.x, state.v, jnp.zeros(()), jnp.zeros(()))
        shapes = jax.eval_shape(problem.loss.observe, origin, origin, self.fixed.around)
        total = jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), shapes)
        # the sums are kept as numbers; what the loss makes of them comes last
        between = Between(state.x * self.inputs.scale.astype(state.x.dtype), state.v, total)
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

    def forward(self, at: Snapshot, rows: int | None = None) -> tuple[Snapshot, Leg, Passed]:
        """One chunk on, without a derivative."""
        between, passed = chunk(self.inputs, at.between, self.fixed, *self.told(at, rows), rule=self.rule)
        return self._after(at, between, passed)

    def keep(self, at: Snapshot, rows: int | None = None) -> tuple[Snapshot, Leg, Passed, Any]:
        """One chunk on, and its reverse function."""
        between, back, passed = keep(
            self.inputs, at.between, self.fixed, *self.told(at, rows), rule=self.rule
        )
        return *self._after(at, between, passed), back

    def pull(self, back: Any, onto: Between, inputs: Inputs) -> tuple[Between, Inputs]:
        """Cotangents through one chunk's reverse function; those of the inputs are added up."""
        return pull(back, onto, inputs)

    @staticmethod
    def bytes_of(back: Any) -> int:
        """Memory that a reverse function holds."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves(back))

    def list_of(self, at: Snapshot) -> tuple[PairTable, Tables]:
        """The list that is in use at a snapshot."""
        if self._used is None or self._used[0] is not at.home or self._used[1] != at.slots:
            self._verlet.slots = at.slots
            table = self._verlet.build(np.asarray(at.home, np.float64).T.copy(), self.simulation.cell)
            self._used = (at.home, at.slots, (table, self.simulation.tables(table)))
        return self._used[2]

    def onto_end(self, end: Snapshot) -> Between:
        """Cotangents of the end, from the loss."""
        by_total = jax.grad(lambda total: self.problem.loss.value(total, self.frames))(end.between.total)
        nothing = jnp.zeros_like(end.between.x)
        return Between(nothing, nothing, by_total)

    def value(self, end: Snapshot) -> float:
        """The loss."""
        return float(self.problem.loss.value(end.between.total, self.frames))

    def nothing(self) -> Inputs:
        """Cotangents of the inputs before any chunk."""
        return jax.tree.map(jnp.zeros_like, self.inputs)

    def cotangents(self, start: Between, inputs: Inputs) -> Cotangents:
        """Derivatives by what a rollout is made of, from those of the inputs and of the first positions."""
        x = np.asarray(inputs.x + start.x, np.float64)
        v = np.asarray(inputs.v + start.v, np.float64)
        scale = float(inputs.scale) + float(
            np.sum(np.asarray(start.x, np.float64) * np.asarray(self.inputs.x))
        )
        none = np.zeros(self.simulation.pair_types)
        return Cotangents(inputs.model, inputs.numbers, x, v, scale, none)

    def told(self, at: Snapshot, rows: int | None = None) -> tuple[Place, Tables]:
        """What a chunk is given beside what it is differentiated by.

        Args:
            at: where it begins.
            rows: steps that it does; None: as many as a chunk has.
        """
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
        return place, tables

    def _after(self, at: Snapshot, between: Between, passed: Passed) -> tuple[Snapshot, Leg, Passed]:
        rows, due, finite = int(passed.rows), bool(passed.due), bool(passed.finite)
        leg = Leg(at.step, rows, self.list_of(at)[0].slots)
        step = at.step + rows
        if not finite:
            raise NumericalError(
                f"the program that is differentiated blew up at step {step - 1}",
                remedy="Use a smaller time step, or a start without overlapping atoms",
            )
        if due:
            return Snapshot(between, step, step, passed.images, between.x, leg.slots), leg, passed
        return Snapshot(between, step, at.built, passed.images, at.home, leg.slots), leg, passed

    def ahead(self) -> Iterator[tuple[Snapshot, Leg, Passed]]:
        """All chunks from the start, without derivatives; the snapshot is the one behind each chunk."""
        at = self.start
        while at.step <= self.problem.steps:
            at, leg, passed = self.forward(at)
            yield at, leg, passed
