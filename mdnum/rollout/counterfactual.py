"""Counterfactual runs, with their own arithmetic but the cutoff decisions of another run."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from mdnum.errors import InputError
from mdnum.md.neighbors import PairTable
from mdnum.md.potentials import pair_type
from mdnum.rollout.compared import ReferenceFrame, in_user_order, overridden
from mdnum.rollout.engine import Engine, Segment, Start
from mdnum.rollout.epoch import EpochRecord, EpochState, empty_record, run_epoch
from mdnum.rollout.tracks import Rows, taken
from mdnum.systems.simulation import Simulation


class Counterfactual:
    """A run with its own arithmetic and the cutoff decisions of another run (the leader).

    The run's own decisions are also computed. Differences from the leader's decisions are counted. The object
    is called with each segment of the leader's run. The method `until` returns the simulated time steps.

    Args:
        simulation: the run whose arithmetic is used.
        leader: the run whose decisions are imposed.
        start: initial state; by default the simulation's own start.
        frame: mapping of this run's atoms and axes to those of the leader.
        guard: largest distance, length, of a pair with an imposed different decision from its cutoff. The run
            ends at larger distances, because rounding could not have changed such a decision.

    Attributes:
        failed: one of `FAILURES` if the run failed, else empty.

    Raises:
        InputError: a potential is many-body, so decisions cannot be imposed on its energy function.
    """

    def __init__(
        self,
        simulation: Simulation,
        leader: Simulation,
        start: Start | None = None,
        frame: ReferenceFrame | None = None,
        guard: float | None = None,
    ):
        if not simulation.imposable or not leader.imposable:
            raise InputError(
                "pair decisions cannot be imposed on a many-body potential",
                remedy="Compare the two runs without a counterfactual run",
            )
        self.simulation, self.guard, self.failed = simulation, guard, ""
        self._ahead: list[Rows] = []
        self._over = False
        self._engine = Engine(simulation, 0, start=start)
        self.state: EpochState = self._engine.start.state
        # with the same kind of list the leader's own lists serve, and its rebuilds with them
        self.frame = frame or ReferenceFrame.same(simulation.atoms)
        self._shares = self.frame.is_same and simulation.lists == leader.lists
        self._flat = self._program(shared=self._shares)
        self._own: tuple[PairTable, Any, int] | None = None
        self._led: PairTable | None = None
        self._r_cut = _by_species(simulation)
        self._record: EpochRecord | None = None

    def __call__(self, segment: Segment) -> None:
        """Simulate the steps of a segment with the leader's decisions, and store the results."""
        if self._over:
            return
        rows = self.follow(segment)
        beyond = np.asarray(rows.furthest) > (np.inf if self.guard is None else self.guard)
        if beyond.any() or self.failed:
            self._over = True
            rows, _ = rows.cut(int(beyond.argmax()) if beyond.any() else len(rows))
        if len(rows):
            self._ahead.append(rows)

    def until(self, last: int) -> Rows | None:
        """Return new simulated steps up to `last`, or None if none are left."""
        return taken(self._ahead, last)

    def follow(self, segment: Segment) -> Rows:
        """Simulate the steps of a segment with the leader's decisions, and return the results."""
        parts: list[Rows] = []
        row = 0
        while row < segment.rows and not self.failed:
            parts.append(self._stretch(segment, row))
            row += len(parts[-1])
        return Rows.joined(parts)

    def _stretch(self, segment: Segment, row: int) -> Rows:
        simulation, dtype = self.simulation, self.simulation.policy.dtype("state")
        imposed = jnp.asarray(segment.record.bits)
        if row:
            # of the same shape, so that nothing is compiled anew; what comes around is never reached
            imposed = jnp.roll(imposed, -row, axis=0)
        if self._shares:
            table, home, built = segment.table, segment.home, segment.built
            if self._led is not table:
                self._led, self._tables = table, simulation.tables(table)
            tables = self._tables
        else:
            table, home, built, tables, place = self._list(segment)
            imposed = _mapped(imposed, place, simulation.channels)
        held, self._record = self._record, None
        if held is None or held.bits.shape != imposed.shape:
            moves = simulation.integrator.moves_cell
            held = empty_record(
                imposed.shape[0], imposed.shape[1], simulation.atoms, dtype, True, cells=moves
            )
        leaves, structure = self._flat
        numbers = jnp.asarray(built, jnp.int64), jnp.asarray(segment.last, jnp.int64), jnp.asarray(False)
        home = jnp.asarray(home, dtype)
        outcome, record = run_epoch(leaves, structure, tables, self.state, home, *numbers, held, imposed)
        count, due, _, _ = np.asarray(outcome.flags).tolist()
        self.state = outcome.state
        self.failed = self._engine.failure(outcome)
        if due and not self._shares:
            self._own = None
        first = segment.first + row
        x, v = (np.asarray(getattr(record, name))[:count] for name in "xv")
        energy = (np.asarray(record.potential) + np.asarray(record.kinetic))[:count]
        own, theirs = (np.asarray(bits)[:count] for bits in (record.bits, imposed))
        cells = record.boxes(count, simulation.pbc)
        boxes = cells or (simulation.cell,)
        noted = overridden(boxes, own, theirs, table, x, simulation.species, self._r_cut)
        # copies: the record is filled anew by the next stretch
        x, v = (in_user_order(part, table.order) for part in (x, v))
        self._record = record
        own = Rows(first, x, v, energy, simulation.cell, self.failed, None, cells, *noted)
        return own.seen_by(self.frame)

    def _program(self, *, shared: bool) -> tuple[tuple[Array, ...], Any]:
        program = self._engine.program
        if shared:
            # the leader says when a list is used up
            program = replace(program, half_skin=jnp.asarray(np.inf, jnp.float64), check=True)
        leaves, structure = jax.tree.flatten(program)
        return tuple(leaves), structure

    def _list(self, segment: Segment):
        """Return this run's neighbor list, and the position of its pairs in the leader's list."""
        simulation = self.simulation
        if self._own is None:
            home, cell = self.state.x, jax.tree.map(np.asarray, self.state.cells[0])
            self._own = simulation.verlet_list().build(home.T, cell), home, int(self.state.step)
            self._led = None
        table, home, built = self._own
        if self._led is not segment.table:
            self._led = segment.table
            self._place = jnp.asarray(_places(table, segment.table, self.frame.labels))
            self._tables = simulation.tables(table)
        return table, home, built, self._tables, self._place


def _by_species(simulation: Simulation) -> Float[np.ndarray, "channels species species"]:
    """Return the cutoff radius (length) for each pair of species and group of terms."""
    radii = np.array(simulation.decider.r_cut).reshape(simulation.channels, -1)
    count = len(simulation.symbols)
    if radii.shape[1] == 1:
        return np.repeat(radii, count * count).reshape(-1, count, count)
    first, second = np.indices((count, count))
    return radii[:, pair_type(first, second, count)]


def _places(
    table: PairTable, led: PairTable, labels: Int[np.ndarray, "atoms"]
) -> Int[np.ndarray, "slots atoms"]:
    """Return the position of each pair of a neighbor list in another list."""
    atoms = len(labels)
    slot, column = np.nonzero(led.index < atoms)
    keys = led.order[column].astype(np.int64) * atoms + led.order[led.index[slot, column]]
    flat = slot * atoms + column
    order = np.argsort(keys)
    keys, flat = keys[order], flat[order]
    named = labels[table.order].astype(np.int64)
    wanted = named[None, :] * atoms + np.append(named, 0)[table.index]
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    found = (keys[at] == wanted) & (table.index < atoms)
    return np.where(found, flat[at], led.index.size).astype(np.int32)


@partial(jax.jit, static_argnames="channels")
def _mapped(
    bits: UInt8[Array, "rows words atoms"], place: Int[Array, "slots atoms"], channels: int = 1
) -> UInt8[Array, "rows own atoms"]:
    """Rearrange packed decisions from the order of one neighbor list to that of another."""
    rows, _, atoms = bits.shape
    shift = jnp.arange(8, dtype=jnp.uint8)[None, None, :, None]
    each = ((bits[:, :, None, :] >> shift) & jnp.uint8(1)).reshape(rows * channels, -1)
    each = jnp.concatenate([each, jnp.zeros((rows * channels, 1), jnp.uint8)], axis=1)
    taken = each[:, place].reshape(rows, -1, 8, atoms)
    return jnp.sum(taken << shift, axis=2, dtype=jnp.uint8)
