"""Steps of one run in order, in the labels and axes of another, with the flips among them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from mdnum.errors import InputError
from mdnum.md.cell import Cell
from mdnum.md.ledger import FlipTable
from mdnum.md.neighbors import PairTable
from mdnum.md.potentials import pair_type
from mdnum.rollout.compared import Apart, PairFlips, ReferenceFrame, in_user_order
from mdnum.rollout.engine import FAILURES, Engine, Segment, Start, first_state
from mdnum.rollout.epoch import EpochRecord, EpochState, Pins, empty_record, run_epoch
from mdnum.rollout.flips import AmbiguousPairs, PairRecorder, decided_pairs
from mdnum.systems.simulation import Simulation


@dataclass(frozen=True)
class Rows:
    """Some steps of one run, in the labels and the frame of the first run."""

    first: int  # step of the first row
    # x, v: wrapped positions and full-step velocities, shape (rows, 3, atoms), float64
    x: Float[np.ndarray, "rows 3 atoms"]
    v: Float[np.ndarray, "rows 3 atoms"]
    energy: Float[np.ndarray, "rows"]  # total energy, shape (rows,)
    failed: str = ""  # "blow-up", "runaway", or ""
    # smallest |margin| of any listed pair, in the quantity's space, shape (rows,); None for a run whose
    # decisions are not its own
    nearest: Float[np.ndarray, "rows"] | None = None
    cells: tuple[Cell, ...] = ()  # the box of each row; none where all have that of the simulation

    def __len__(self) -> int:
        return len(self.x)

    def cut(self, count: int) -> tuple[Rows, Rows]:
        """The first rows, and the rest."""
        near, rest = (None, None) if self.nearest is None else np.split(self.nearest, [count])
        x, v, energy, cells = self.x, self.v, self.energy, self.cells
        return (
            Rows(self.first, x[:count], v[:count], energy[:count], "", near, cells[:count]),
            Rows(self.first + count, x[count:], v[count:], energy[count:], self.failed, rest, cells[count:]),
        )


def joined(parts: list[Rows]) -> Rows:
    """Consecutive rows as one."""
    if len(parts) == 1:
        return parts[0]
    nearest = [part.nearest for part in parts if part.nearest is not None]
    return Rows(
        parts[0].first,
        np.concatenate([part.x for part in parts]),
        np.concatenate([part.v for part in parts]),
        np.concatenate([part.energy for part in parts]),
        parts[-1].failed,
        np.concatenate(nearest) if len(nearest) == len(parts) else None,
        tuple(cell for part in parts for cell in part.cells),
    )


class Track:
    """One run, read forward.

    Args:
        simulation: the run.
        last: last step.
        start: where it begins; default the system's own start.
        frame: how its atoms and axes are those of the first run.
        flips: whether to read its flips.
        listener: called with each segment as it is read, while its decisions are still on the device.
        pins: decisions that it is told.
    """

    def __init__(
        self,
        simulation: Simulation,
        last: int,
        start: Start | None = None,
        frame: ReferenceFrame | None = None,
        *,
        flips: bool = True,
        listener: Callable[[Segment], None] | None = None,
        pins: Pins | None = None,
    ):
        self.simulation = simulation
        self.frame = frame or ReferenceFrame.same(simulation.atoms)
        self.start = start or first_state(simulation)
        self._engine = Engine(simulation, last, start=self.start, pins=pins)
        self._segments = self._engine.segments()
        self._recorder = PairRecorder(simulation) if flips else None
        self._listener = listener
        self._ahead: list[Rows] = []
        self._flips = [PairFlips.none()]
        self._doubts = [AmbiguousPairs.none()]
        self.first_pairs: Int[np.ndarray, "pairs"] | None = None
        self.failed = ""

    def segment(self) -> Segment | None:
        """The next stretch of this run, its rows and flips kept for `until`; None at the end."""
        segment = next(self._segments, None)
        if segment is None:
            return None
        if self._listener is not None:
            self._listener(segment)
        if self._recorder is not None:
            if self.first_pairs is None:
                self.first_pairs = self.frame.keys(decided_pairs(self.simulation, segment, 0))
            self._flips.append(_flips_of(self._recorder.flips(segment), self.frame))
            self._doubts.append(self._recorder.doubtful(segment))
        failed = segment.closes if segment.closes in FAILURES else ""
        self.failed = failed or ""
        self._ahead.append(rows_of(segment, self.frame, self.failed))
        return segment

    @property
    def ready(self) -> int:
        """The last step that has been read."""
        return self._ahead[-1].first + len(self._ahead[-1]) - 1

    def until(self, last: int) -> tuple[Rows | None, PairFlips]:
        """The rows not yet handed out up to a step, and the flips among them; fewer where the run ends."""
        while not self._ahead or self._ahead[-1].first + len(self._ahead[-1]) - 1 < last:
            if self.segment() is None:
                break
        taken: list[Rows] = []
        while self._ahead and self._ahead[0].first <= last:
            rows = self._ahead.pop(0)
            if rows.first + len(rows) - 1 > last:
                rows, rest = rows.cut(last - rows.first + 1)
                self._ahead.insert(0, rest)
            taken.append(rows)
        every = PairFlips.concatenate(self._flips)
        self._flips = [every[every.step > last]]
        return (joined(taken) if taken else None), every[every.step <= last]

    def doubts(self, last: int) -> AmbiguousPairs:
        """The ambiguous decisions up to a step that were not yet asked for, in the first run's labels."""
        every = AmbiguousPairs.concatenate(self._doubts)
        taken = every[every.step <= last]
        self._doubts = [every[every.step > last]]
        i, j = np.divmod(self.frame.keys_of(taken.i, taken.j), self.simulation.atoms)
        return replace(taken, i=i, j=j)


def _flips_of(ledger: FlipTable, frame: ReferenceFrame) -> PairFlips:
    """The columns that a comparison needs, in the labels of the first run."""
    keys = frame.keys_of(ledger.i, ledger.j)
    return PairFlips(ledger.step, keys, ledger.entered, ledger.margin, ledger.bound)


def rows_of(segment: Segment, frame: ReferenceFrame, failed: str) -> Rows:
    """A segment's rows in the user's order of atoms."""
    x, v = (in_user_order(segment.rows_of(name), segment.table.order) for name in ("x", "v"))
    energy = segment.rows_of("potential") + segment.rows_of("kinetic")
    nearest = segment.rows_of("nearest").astype(np.float64)
    x, v = frame.positions(x), frame.vectors(v)
    return Rows(segment.first, x, v, energy, failed, nearest, segment.cells)


# --- A run with its own arithmetic and another run's decisions: the counterfactual --------------------


@dataclass(frozen=True)
class Overridden:
    """Decisions that a handed run would have made otherwise, at each step."""

    count: Int[np.ndarray, "rows"]  # how many pairs, shape (rows,)
    # the largest distance of any of them from its cutoff, length, shape (rows,)
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
        frame: ReferenceFrame | None = None,
    ):
        if not simulation.pairwise or not leader.pairwise:
            raise InputError(
                "a many-body potential cannot be told its pairs",
                remedy="Compare the two runs without a counterfactual",
            )
        self.simulation = simulation
        self._engine = Engine(simulation, 0, start=start)
        self.state: EpochState = self._engine.start.state
        # with the same kind of list the leader's own lists serve, and its rebuilds with them
        self.frame = frame or ReferenceFrame.same(simulation.atoms)
        self._shares = self.frame.is_same and simulation.lists == leader.lists
        self._flat = self._program(shared=self._shares)
        self._own: tuple[PairTable, Any, int] | None = None
        self._led: PairTable | None = None
        self._apart = Apart(simulation.cell)
        self._r_cut = _by_species(simulation)
        self._record: EpochRecord | None = None
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
            table, home, built = segment.table, segment.home, segment.built
            if self._led is not table:
                self._led, self._tables = table, simulation.tables(table)
            tables = self._tables
        else:
            table, home, built, tables, place = self._list(segment)
            told = _mapped(told, place, simulation.channels)
        held, self._record = self._record, None
        if held is None or held.bits.shape != told.shape:
            moves = simulation.integrator.moves_cell
            held = empty_record(told.shape[0], told.shape[1], simulation.atoms, dtype, True, cells=moves)
        leaves, structure = self._flat
        numbers = jnp.asarray(built, jnp.int64), jnp.asarray(segment.last, jnp.int64), jnp.asarray(False)
        home = jnp.asarray(home, dtype)
        outcome, record = run_epoch(leaves, structure, tables, self.state, home, *numbers, held, told)
        count, due, finite, runaway = np.asarray(outcome.flags).tolist()
        self.state = outcome.state
        self.failed = "" if finite and not runaway else "runaway" if finite else "blow-up"
        if due and not self._shares:
            self._own = None
        first = segment.first + row
        x, v = (np.asarray(getattr(record, name))[:count] for name in "xv")
        energy = (np.asarray(record.potential) + np.asarray(record.kinetic))[:count]
        own, theirs = (np.asarray(bits)[:count] for bits in (record.bits, told))
        cells = record.boxes(count, simulation.pbc)
        distances = Apart(*cells) if cells else self._apart
        note = Overridden(*distances.overridden(own, theirs, table, x, simulation.species, self._r_cut))
        # copies: the record is filled anew by the next stretch
        x, v = (in_user_order(part, table.order) for part in (x, v))
        self._record = record
        x, v = self.frame.positions(x), self.frame.vectors(v)
        return Rows(first, x, v, energy, self.failed, cells=cells), note

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
    """The cutoff of each channel and pair of species, length."""
    radii = np.array(simulation.decider.r_cut).reshape(simulation.channels, -1)
    count = len(simulation.symbols)
    if radii.shape[1] == 1:
        return np.repeat(radii, count * count).reshape(-1, count, count)
    first, second = np.indices((count, count))
    return radii[:, pair_type(first, second, count)]


def _places(
    table: PairTable, led: PairTable, labels: Int[np.ndarray, "atoms"]
) -> Int[np.ndarray, "slots atoms"]:
    """For each slot of a list where the same directed pair stands in another list; its size for nowhere."""
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
    """The decisions of one list in the slots of another."""
    rows, _, atoms = bits.shape
    shift = jnp.arange(8, dtype=jnp.uint8)[None, None, :, None]
    each = ((bits[:, :, None, :] >> shift) & jnp.uint8(1)).reshape(rows * channels, -1)
    each = jnp.concatenate([each, jnp.zeros((rows * channels, 1), jnp.uint8)], axis=1)
    taken = each[:, place].reshape(rows, -1, 8, atoms)
    return jnp.sum(taken << shift, axis=2, dtype=jnp.uint8)
