"""Control of a simulation run.

The engine builds a neighbor list and starts the compiled loop over the steps that use this list. The engine
then yields the records of the loop. A record is yielded after the next loop has been started. The caller thus
processes a record while the device computes the next one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from mdnum.md.cell import Cell, wrap_positions
from mdnum.md.decide import Changes, Tables, zeros
from mdnum.md.neighbors import PairTable, VerletList, check_radius
from mdnum.numerics import check_not_forked
from mdnum.rollout.epoch import (
    EpochOutcome,
    EpochProgram,
    EpochRecord,
    EpochState,
    Pins,
    StepInputs,
    empty_record,
    run_epoch,
)
from mdnum.systems.simulation import Simulation

# bytes that the rows of one epoch's record may take, and the most rows; both bound memory, not accuracy
_RECORD_BYTES = 64 * 2**20
_MOST_ROWS = 128
# a record this small has its rows whatever it is for: each number of rows is another program
_SMALL_BYTES = 4 * 2**20
# of a change of a decision with both atoms' positions and velocities
_CHANGE_BYTES = 16 + 12 * 8


# how a rollout ends that should not have
NARROW = "narrow box"
FAILURES = ("blow-up", "runaway", NARROW)


@dataclass(frozen=True)
class Segment:
    """Record of consecutive time steps that use the same neighbor list."""

    first: int  # step of the first row
    rows: int  # number of rows
    record: EpochRecord  # one row per step (on the device; valid until the next segment but one is asked for)
    changes: Changes | None  # of the record, without most of the room behind them
    # decisions of this list at the step before `first`, shape (words, atoms)
    before: UInt8[Array | np.ndarray, "words atoms"] | None
    table: PairTable  # the list
    epoch: int  # number of the list's life
    built: int  # step at which the list was built
    opens: bool  # whether this is the first segment of its epoch
    # why the epoch ended with it: "displacement", "interval", "end", None, or what went wrong: "blow-up" (the
    # last row is not finite), "runaway" (what follows it is wild), "narrow box" (its list would lack pairs)
    closes: str | None
    due: bool  # the list must not be used for the step after the last row
    # largest displacement since the list was built (see `Cell.spent`), at that step, length
    moved: float
    state: EpochState  # where the rollout goes on
    home: Float[Array, "3 atoms"]  # wrapped positions at which the list was built, shape (3, atoms)
    cell: Cell  # the box of every row, on the host, unless each has its own
    start: EpochState  # where the rollout stood before
    # inside, leap: of `EpochOutcome`: decisions of `before` that are yes, and the longest way of an atom from
    # there to the first row, length
    inside: Int[Array, ""]
    leap: Float[Array, ""]
    # decisions at the last row that was made, shape (words, atoms); None with rows
    held: UInt8[Array, "words atoms"] | None
    again: Callable[[], EpochRecord]  # the record with rows, made anew where it was made without

    @property
    def last(self) -> int:
        """Time step of the last row."""
        return self.first + self.rows - 1

    def rows_of(self, name: str) -> np.ndarray:
        """Return a quantity at all steps of the segment. Unrecorded quantities are recomputed."""
        lacks = self.changes is not None and name in ("x", "v", "images", "bits")
        return np.asarray(getattr(self.again() if lacks else self.record, name))[: self.rows]

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """The simulation box at each step. The array is empty if the box is fixed."""
        return self.record.boxes(self.rows, self.cell.pbc)

    def cell_of(self, row: int) -> Cell:
        """Return the simulation box at one step of the segment."""
        return self.cells[row] if self.cells else self.cell

    @property
    def last_positions(self) -> Float[Array | np.ndarray, "3 atoms"]:
        """Return the wrapped positions at the last step, in the user's order of atoms."""
        return self.unsorted("x", self.rows - 1).T if self.closes == "blow-up" else self.state.x_before

    def unsorted(self, name: str, row: int) -> np.ndarray:
        """Return a recorded quantity at one step, shape (atoms, 3), in the user's order of atoms."""
        if name == "x" and row == 0:
            return np.asarray(self.start.x).T
        if name == "x" and row == self.rows - 1 and self.closes != "blow-up":
            return np.asarray(self.state.x_before).T
        sorted_row = self.rows_of(name)[row]
        out = np.empty((sorted_row.shape[1], 3), sorted_row.dtype)
        out[self.table.order] = sorted_row.T
        return out


@dataclass(frozen=True)
class Start:
    """Initial state of an engine: step 0 of a run, or the state of a checkpoint."""

    state: EpochState  # the state to go on from
    home: Float[Array, "3 atoms"]  # wrapped positions at which the list in use was built, shape (3, atoms)
    built: int = 0  # step at which it was built
    epoch: int = 0  # number of its life
    slots: int = 0  # its capacity; 0 lets the density decide

    @property
    def reference(self) -> Float[np.ndarray, "atoms 3"]:
        """Return the positions at which the neighbor list was built, shape (atoms, 3), float64."""
        return np.asarray(self.home, np.float64).T

    def check_box(self, simulation: Simulation, which: int = -1) -> None:
        """Raise `InputError` if the box is too narrow for the cutoff plus the skin."""
        cell = jax.tree.map(np.asarray, self.state.cells[which])
        check_radius(cell, simulation.r_cut, simulation.rule.skin)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the initial state as arrays, for storage in a checkpoint."""
        parts = self.state._asdict()
        parts |= {f"extra_{k}": leaf for k, leaf in enumerate(jax.tree.leaves(parts.pop("extra")))}
        # boxes with their inverses, as the loop had them: no others have their bits
        parts["cells"] = np.stack(jax.tree.leaves(parts["cells"]))
        arrays = {f"state_{name}": np.asarray(value) for name, value in parts.items()}
        numbers = {"built": self.built, "epoch": self.epoch, "slots": self.slots}
        return arrays | {"reference": self.reference} | {k: np.asarray(v) for k, v in numbers.items()}

    @classmethod
    def from_arrays(cls, arrays, simulation: Simulation) -> Start:
        """Restore an initial state, bit for bit, from the arrays that `to_arrays` returned."""
        places: Any = (jnp.asarray(arrays[f"state_{name}"]) for name in EpochState._fields[:-2])
        first = first_state(simulation).state
        leaves, structure = jax.tree.flatten(first.extra)
        extra = [jnp.asarray(arrays[f"state_extra_{k}"]) for k in range(len(leaves))]
        numbers, boxes = jax.tree.flatten(first.cells)
        cells: Any = jax.tree.unflatten(boxes, list(jnp.asarray(arrays.get("state_cells", numbers))))
        state = EpochState(*places)._replace(extra=jax.tree.unflatten(structure, extra), cells=cells)
        return cls(
            state,
            jnp.asarray(arrays["reference"].T, state.x.dtype),
            int(arrays["built"]),
            int(arrays["epoch"]),
            int(arrays["slots"]),
        )


def first_state(simulation: Simulation) -> Start:
    """Return the initial state of a run, with wrapped positions."""
    dtype = simulation.policy.dtype("state")
    positions, velocities = simulation.first_frame()
    wrapped, images = wrap_positions(simulation.cell, positions)
    wrapped = wrapped.astype(dtype)
    x = np.ascontiguousarray(wrapped.T)
    v, taken_off = velocities.T.astype(dtype), images.T.astype(np.int32)
    # numpy's arrays: jnp would compile a program for each
    state = EpochState(*jax.device_put((np.int64(0), x, v, taken_off, x, np.float64(0))))
    extra = simulation.propagator.init(state.x, state.v, jax.device_put(simulation.masses))
    integrator, cell = simulation.integrator, simulation.force.cell
    straight = cell.orthorhombic and integrator.keeps_angles
    cells = (replace(cell, orthorhombic=straight),) * 3 if integrator.moves_cell else (cell,)
    state = state._replace(extra=jax.device_put(jax.tree.map(np.asarray, extra)), cells=cells)
    return Start(state, state.x)


def room_for(rows: int, per_row: int) -> int:
    """Return the number of steps for which memory is allocated, a power of two of at least `rows`."""
    few = max(2, min(_MOST_ROWS, _SMALL_BYTES // per_row))
    return 1 << max(few.bit_length() - 1, rows.bit_length())


class Engine:
    """Engine that simulates a system from an initial state to a last step.

    Args:
        simulation: the system as objects.
        last: last step to evaluate.
        start: initial state; by default the system's own start.
        record: whether to record decisions and positions. Energies are always recorded; the trajectory has
            the same bits in both cases.
        rows: whether to keep decisions and positions of every step. If False, only changes of decisions are
            recorded, which in double precision takes a tenth of the memory, and `Segment.rows_of` recomputes
            a segment's steps on request.
        pins: decisions that replace the run's own decisions. The record still contains the run's own.
        inputs: whether to record also the inputs of each step that are needed for its derivatives.
    """

    def __init__(
        self,
        simulation: Simulation,
        last: int,
        *,
        start: Start | None = None,
        record: bool = True,
        rows: bool = True,
        pins: Pins | None = None,
        inputs: bool = False,
    ):
        check_not_forked()
        self.simulation = simulation
        self.last = last
        self.record = record
        self.rows = rows or not record
        self.pins = pins
        self.start = start or first_state(simulation)
        self.verlet: VerletList = simulation.verlet_list()
        self.verlet.slots = self.start.slots
        rule = simulation.rule
        lengths = rule.skin / 2, simulation.r_cut + rule.skin, simulation.r_cut
        masses, half_skin, r_list, r_cut = jax.device_put((simulation.masses, *map(np.float64, lengths)))
        self.program = EpochProgram(
            simulation.force, simulation.propagator, masses, half_skin, r_list, r_cut,
            rule.every, rule.delay, rule.check, record, self.rows, inputs=inputs,
        )  # fmt: skip
        self._moves = self.program.integrator.moves_cell
        state, tensor = self.start.state, None
        if self.program.integrator.anisotropic:
            tensor: Any = np.zeros((3, 3))
        self._inputs = StepInputs(state.v, state.extra, state.v, tensor) if inputs else ()
        self._cell = jax.tree.map(np.asarray, self.start.state.cells[0])
        # a liquid has one change for ten atoms a step; where there are more, room is doubled
        self._room_for_changes(0 if self.rows else max(64, simulation.atoms // 4))
        self._records: list[EpochRecord | None] = [None, None]
        self._unread: Array | None = None

    def _room_for_changes(self, most: int) -> None:
        self.program = replace(self.program, most=most)
        leaves, self.structure = jax.tree.flatten(self.program)
        self.leaves = tuple(leaves)

    def _room(self, words: int) -> int:
        """Return the number of steps that a record can hold, a power of two."""
        kept = self.record and self.rows
        per_row = self.simulation.atoms * (2 * 24 + 12 + words) if kept else 64
        per_row += sum(leaf.size * 8 for leaf in jax.tree.leaves(self._inputs))
        rows = max(2, min(_MOST_ROWS, _RECORD_BYTES // per_row))
        # no list is expected to live longer than the run
        return min(1 << (rows.bit_length() - 1), room_for(int(self.last + 1), per_row))

    def take(self, turn: int, words: int) -> EpochRecord:
        """Return one of two buffers for a record. The loop that fills the buffer owns it (donation)."""
        rows, held, most = self._room(words), self._records[turn], self.program.most
        self._records[turn] = None
        # as many as a list's life brings, or a large system sorts its atoms several times for one list
        changes = None if self.rows else max(6 * most, min(16 * most, _RECORD_BYTES // _CHANGE_BYTES))
        had = None if held is None or held.changes is None else len(held.changes.pairs)
        if held is not None and held.bits.shape[:2] == (rows, words) and had == changes:
            return held
        dtype = self.simulation.policy.dtype("state")
        rest = changes, self._moves, self._inputs
        return empty_record(rows, words, self.simulation.atoms, dtype, self.record, *rest)

    def give(self, turn: int, record: EpochRecord) -> None:
        """Give a record back to the engine, which uses it as a buffer."""
        self._records[turn] = record

    def segments(self) -> Iterator[Segment]:
        """Yield groups of consecutive steps (segments) until the run ends or fails."""
        here, turn, held = self.start, 0, None
        listed = self._listed(here)
        waiting: Segment | None = None
        while True:
            begun = self._advance(listed, here, held, turn)
            if waiting is not None:
                # the device is at work: the caller may read the record before this one
                yield waiting
                self._records[1 - turn] = waiting.record
            waiting, held = self._segment(listed, here, held, turn, begun)
            turn = 1 - turn
            if waiting.closes == "end" or waiting.closes in FAILURES:
                yield waiting
                return
            here = replace(here, state=waiting.state)
            if waiting.closes:
                here, held = Start(waiting.state, waiting.state.x, waiting.last + 1, here.epoch + 1), None
                listed = self._listed(here)

    def again(self, start: Start) -> Segment:
        """Recompute the steps that follow a given state. The results are identical bit for bit.

        Args:
            start: state at which a segment of this engine began (`resume_point` of the previous segment).
        """
        self.verlet.slots = start.slots
        listed = self._listed(start)
        made, _ = self._segment(listed, start, None, 0, self._advance(listed, start, None, 0))
        self._records[0] = made.record
        return made

    def _listed(self, start: Start) -> tuple[PairTable, Tables]:
        """Build the neighbor list for a state. Return the list, and its tables for the compiled loop."""
        cell = self._cell
        if self._moves:
            cell = jax.tree.map(np.asarray, start.state.cells[-1])
            start.check_box(self.simulation)
        table = self.verlet.build(start.home.T, cell)
        return table, self.simulation.tables(table)

    def _advance(self, listed: tuple[PairTable, Tables], start: Start, held, turn: int):
        """Start the compiled loop over time steps on the device.

        Args:
            held: decisions for this list at the previous step; None if the decisions must be computed.
        """
        table, tables = listed
        words = self.simulation.channels * table.slots // 8
        told = self._pinned(table, int(start.state.step), words) or (None, None)
        look_back, earlier = held is None, held
        if look_back and not self.rows:
            # the same program as without a look back, so decisions that it does not read
            if self._unread is None or len(self._unread) != words:
                self._unread = zeros((words, self.simulation.atoms), np.uint8)
            earlier = self._unread
        numbers = jax.device_put((np.int64(start.built), np.int64(self.last), np.bool_(look_back)))
        return run_epoch(
            self.leaves, self.structure, tables, start.state, start.home, *numbers, self.take(turn, words),
            *told, None if self.rows else earlier,
        )  # fmt: skip

    def _segment(
        self, listed, start: Start, held, turn: int, begun: tuple[EpochOutcome, EpochRecord]
    ) -> tuple[Segment, np.ndarray | jax.Array | None]:
        """Wait for the compiled loop. Return the recorded steps, and the decisions at the last step."""
        outcome, record = begun
        rows, rebuild, finite, _ = np.asarray(outcome.flags).tolist()
        while (changes := record.changes) is not None and finite and changes.found > len(changes.pairs):
            # a step had more changes than there was room for
            self._room_for_changes(4 * self.program.most)
            outcome, record = self._advance(listed, start, held, turn)
            rows, rebuild, finite, _ = np.asarray(outcome.flags).tolist()
        # before the next stretch is started, or a device would make that first
        changes = None if changes is None else changes.cut()
        first, table = int(start.state.step), listed[0]
        before = held if outcome.before is None or held is not None else outcome.before
        if self.rows:
            last = np.array(np.asarray(record.bits)[rows - 1]) if self.record and rows else None
        else:
            last = outcome.held
        closes = self._closes(outcome, rebuild)
        segment = Segment(
            first, rows, record, changes, before, table, start.epoch, start.built, first == start.built,
            closes, bool(rebuild), float(outcome.moved), outcome.state, start.home, self._cell,
            start.state, outcome.inside, outcome.leap, outcome.held,
            cache(partial(self._with_rows, replace(start, slots=table.slots), first + rows - 1)),
        )  # fmt: skip
        return segment, last

    def _with_rows(self, start: Start, last: int) -> EpochRecord:
        """Recompute and record every step from a state to a last step, with the same neighbor list."""
        engine = Engine(self.simulation, last, start=start, pins=self.pins)
        parts: list[list[Any]] = [
            [np.array(segment.rows_of(name)) for name in EpochRecord._fields[:-2]]
            for segment in engine.segments()
        ]
        whole: list[Any] = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        return EpochRecord(*whole)

    def _pinned(self, table: PairTable, first: int, words: int) -> tuple[UInt8[np.ndarray, "..."], ...]:
        """Return the decisions imposed on the next steps, and their mask (or empty arrays)."""
        if self.pins is None:
            return ()
        return self.pins.rows(table, first, self._room(words), self.simulation.channels)

    def failure(self, outcome: EpochOutcome) -> str:
        """Return the name of the failure that ended the run, or an empty string."""
        _, rebuild, finite, runaway = np.asarray(outcome.flags).tolist()
        if not finite:
            return "blow-up"
        if self._moves and (rebuild or runaway):
            cell, simulation = jax.tree.map(np.asarray, outcome.state.cells[0]), self.simulation
            if cell.is_narrow(simulation.r_cut + rebuild * simulation.rule.skin):
                return NARROW
        return "runaway" if runaway else ""

    def _closes(self, outcome: EpochOutcome, rebuild: int) -> str | None:
        ended = self.failure(outcome)
        if ended != "blow-up" and int(outcome.state.step) > self.last:
            return "end"
        if ended:
            return ended
        if rebuild:
            return "displacement" if self.simulation.rule.check else "interval"
        return None


def resume_point(segment: Segment) -> Start:
    """Return the state from which a run continues after a segment."""
    state, slots = segment.state, segment.table.slots
    if segment.due:
        return Start(state, state.x, segment.last + 1, segment.epoch + 1, slots)
    return Start(state, segment.home, segment.built, segment.epoch, slots)


def unwrapped(
    cell_matrix: Float[np.ndarray | Array, "3 3"],
    x: Float[np.ndarray, "atoms 3"],
    images: Int[np.ndarray, "atoms 3"],
):
    """Return unwrapped positions: wrapped positions plus the lattice vectors that wrapping removed."""
    return x + images @ np.asarray(cell_matrix)
