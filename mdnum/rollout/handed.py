"""A run with its own arithmetic and another run's decisions: the counterfactual.

Nothing of a whole run is taped: the leader's decisions are handed over a stretch at a time, while they are
still on the device.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from mdnum.errors import InputError
from mdnum.md.potentials import pair_type
from mdnum.md.verlet import PairTable
from mdnum.rollout.compared import Apart, in_user_order
from mdnum.rollout.engine import Engine, Segment, Start
from mdnum.rollout.epoch import Record, State, empty_record, run_epoch
from mdnum.rollout.frame import Frame
from mdnum.rollout.tracks import Rows, joined
from mdnum.systems.build import Simulation


@dataclass(frozen=True)
class Overridden:
    """Decisions that a handed run would have made otherwise, at each step.

    Attributes:
        count: how many pairs, shape (rows,).
        furthest: the largest distance of any of them from its cutoff, length, shape (rows,).
    """

    count: Int[np.ndarray, "rows"]
    furthest: Float[np.ndarray, "rows"]

    @classmethod
    def joined(cls, parts: list[Overridden]) -> Overridden:
        """Consecutive steps as one."""
        return cls(
            np.concatenate([part.count for part in parts]), np.concatenate([part.furthest for part in parts])
        )


class Handed:
    """A run that makes no pair decisions of its own: it acts on those of another run, step by step.

    Its own decisions are computed all the same, and counted where they differ.

    Args:
        simulation: whose arithmetic.
        leader: whose decisions.
        start: where it begins; default the simulation's own start.
        frame: how its atoms and axes are the leader's.

    Raises:
        InputError: many-body potentials decide inside their energy function and cannot be told.
    """

    def __init__(
        self,
        simulation: Simulation,
        leader: Simulation,
        start: Start | None = None,
        frame: Frame | None = None,
    ):
        if not simulation.pairwise or not leader.pairwise:
            raise InputError(
                "a many-body potential cannot be told its pairs",
                remedy="Compare the two runs without a counterfactual",
            )
        self.simulation = simulation
        self._engine = Engine(simulation, 0, start=start)
        self.state: State = self._engine.start.state
        # with the same kind of list the leader's own lists serve, and its rebuilds with them
        self.frame = frame or Frame.same(simulation.atoms)
        self._shares = self.frame.is_same and simulation.lists == leader.lists
        self._flat = self._program(shared=self._shares)
        self._own: tuple[PairTable, Any, int] | None = None
        self._led: PairTable | None = None
        self._apart = Apart(simulation.cell)
        self._r_cut = _by_species(simulation)
        self._record: Record | None = None
        self.failed = ""

    def follow(self, segment: Segment) -> tuple[Rows, Overridden]:
        """The steps of a stretch of the leader's run, under its decisions."""
        parts: list[Rows] = []
        notes: list[Overridden] = []
        row = 0
        while row < segment.rows and not self.failed:
            rows, note = self._stretch(segment, row)
            parts.append(rows)
            notes.append(note)
            row += len(rows)
        return joined(parts), Overridden.joined(notes)

    def _stretch(self, segment: Segment, row: int) -> tuple[Rows, Overridden]:
        simulation, dtype = self.simulation, self.simulation.policy.dtype("state")
        told = jnp.asarray(segment.record.bits)
        if row:
            # of the same shape, so that nothing is compiled anew; what comes around is never reached
            told = jnp.roll(told, -row, axis=0)
        if self._shares:
            table, reference, built = segment.table, segment.reference, segment.built
            if self._led is not table:
                self._led, self._tables = table, simulation.tables(table)
            tables = self._tables
        else:
            table, reference, built, tables, place = self._list(segment)
            told = _mapped(told, place)
        held, self._record = self._record, None
        if held is None or held.bits.shape != told.shape:
            held = empty_record(told.shape[0], told.shape[1], simulation.atoms, dtype, True)
        leaves, structure = self._flat
        outcome, record = run_epoch(
            leaves,
            structure,
            tables,
            self.state,
            jnp.asarray(reference.T, dtype),
            jnp.asarray(built, jnp.int64),
            jnp.asarray(segment.last, jnp.int64),
            jnp.asarray(False),
            held,
            told,
        )
        count, due, finite, runaway = np.asarray(outcome.flags).tolist()
        self.state = outcome.state
        self.failed = "" if finite and not runaway else "runaway" if finite else "blow-up"
        if due and not self._shares:
            self._own = None
        first = segment.first + row
        x, v = (np.asarray(getattr(record, name))[:count] for name in "xv")
        energy = (np.asarray(record.potential) + np.asarray(record.kinetic))[:count]
        note = Overridden(
            *self._apart.overridden(
                np.asarray(record.bits)[:count],
                np.asarray(told)[:count],
                table,
                x,
                simulation.species,
                self._r_cut,
            )
        )
        # copies: the record is filled anew by the next stretch
        x, v = (in_user_order(part, table.order) for part in (x, v))
        self._record = record
        return Rows(first, self.frame.positions(x), self.frame.vectors(v), energy, self.failed), note

    def _program(self, *, shared: bool) -> tuple[tuple[Array, ...], Any]:
        program = self._engine.program
        if shared:
            # the leader says when a list is used up
            program = replace(program, half_skin=jnp.asarray(np.inf, jnp.float64), check=True)
        leaves, structure = jax.tree.flatten(program)
        return tuple(leaves), structure

    def _list(self, segment: Segment):
        """This run's own list, and where the leader's decision of each of its slots stands."""
        simulation = self.simulation
        if self._own is None:
            reference = np.asarray(self.state.x, np.float64).T.copy()
            table = simulation.verlet_list().build(reference, simulation.cell)
            self._own = table, reference, int(self.state.step)
            self._led = None
        table, reference, built = self._own
        if self._led is not segment.table:
            self._led = segment.table
            self._place = jnp.asarray(_places(table, segment.table, self.frame.labels))
            self._tables = simulation.tables(table)
        return table, reference, built, self._tables, self._place


def _by_species(simulation: Simulation) -> Float[np.ndarray, "species species"]:
    """The cutoff of each pair of species, length."""
    radii = np.array(simulation.decider.r_cut)
    count = len(simulation.system.species)
    if len(radii) == 1:
        return np.full((count, count), radii[0])
    first, second = np.indices((count, count))
    return radii[pair_type(first, second, count)]


def _places(
    table: PairTable, led: PairTable, labels: Int[np.ndarray, "atoms"]
) -> Int[np.ndarray, "slots atoms"]:
    """For each slot of a list where the same directed pair stands in another list; its size for nowhere.

    Args:
        labels: atom b of the first list is atom labels[b] of the other.
    """
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


@jax.jit
def _mapped(
    bits: UInt8[Array, "rows words atoms"], place: Int[Array, "slots atoms"]
) -> UInt8[Array, "rows own atoms"]:
    """The decisions of one list in the slots of another."""
    rows, words, atoms = bits.shape
    shift = jnp.arange(8, dtype=jnp.uint8)[None, None, :, None]
    each = ((bits[:, :, None, :] >> shift) & jnp.uint8(1)).reshape(rows, words * 8 * atoms)
    each = jnp.concatenate([each, jnp.zeros((rows, 1), jnp.uint8)], axis=1)
    taken = each[:, place].reshape(rows, -1, 8, atoms)
    return jnp.sum(taken << shift, axis=2, dtype=jnp.uint8)
