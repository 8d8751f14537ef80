"""A run recorded for gradients: its time steps, in forward or reverse order, and sums for the loss.

Recorded stretches of steps are kept in memory up to the memory limit. Other stretches are computed again from
the state at their first step. Repeated steps agree with the first run bit for bit. A run in fixed-point
numbers need not be stored. The reversed run must lead back to exactly the initial state.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from mdnum.errors import NumericalError
from mdnum.gradients.losses import NOT_REAL, Loss, LossContext, LossFrame
from mdnum.md.cell import Cell
from mdnum.md.integrators import unsorted, without_kick
from mdnum.md.ledger import FlipTable
from mdnum.md.neighbors import PairTable
from mdnum.rollout.backward import BackwardRun, Stretched
from mdnum.rollout.engine import FAILURES, NARROW, Engine, Segment, Start, first_state, resume_point, room_for
from mdnum.rollout.epoch import over_rows
from mdnum.rollout.flips import PairRecorder
from mdnum.systems.simulation import Simulation

#: Largest number of bytes of recorded stretches in a tape.
KEPT = 2**29
#: Number of states whose digests a reversed run stores, so that the step at which it fails can be found.
_FINGERPRINTS = 256


@dataclass(frozen=True)
class TapeStretch:
    """States and cutoff decisions of successive steps with one neighbor list, in its atom order."""

    # first, rows: its first step and the number of rows in use; those beyond are void
    first: int
    rows: int
    # x, v: wrapped positions and velocities
    x: Float[np.ndarray, "room 3 atoms"]
    v: Float[np.ndarray, "room 3 atoms"]
    images: Int[np.ndarray, "room 3 atoms"]  # lattice vectors taken off so far
    bits: np.ndarray  # decisions
    x_before: Float[np.ndarray, "3 atoms"]  # positions of the step before
    # potential, virial: by row
    potential: Float[np.ndarray, "room"]
    virial: Float[np.ndarray, "room"]
    cell: Float[np.ndarray, "room vectors 3"]  # lattice vectors, where they move
    inputs: Any  # `StepInputs`, where the integrator is no linear kick and drift; else ()
    # the box of the step before, where it moves
    cell_before: Cell
    table: PairTable  # the list
    ledger: FlipTable | None = None  # its flips; None where they were not asked for

    @property
    def nbytes(self) -> int:
        """Memory that the recorded stretch of steps uses, in bytes."""
        kept = ([getattr(self, name) for name in _COLUMNS], self.x_before, self.table.index)
        return sum(array.nbytes for array in jax.tree.leaves(kept))

    def cut(self, room: int | None = None) -> TapeStretch:
        """Return a copy with `room` rows. The default is one row for each recorded step."""

        def copied(rows: np.ndarray) -> np.ndarray:
            kept = np.zeros((room or self.rows, *rows.shape[1:]), rows.dtype)
            kept[: self.rows] = rows[: self.rows]
            return kept

        return replace(self, **{name: jax.tree.map(copied, getattr(self, name)) for name in _COLUMNS})

    def roomy(self) -> TapeStretch:
        """Return a copy padded to a standard number of steps, for fewer compilations."""
        columns = jax.tree.leaves([getattr(self, name) for name in _COLUMNS])
        per_row = sum(column[0].nbytes for column in columns)
        return self.cut(room_for(self.rows - 1, per_row))

    @property
    def steps(self) -> Int[np.ndarray, "room"]:
        """Step number that belongs to each row of the recorded arrays."""
        return self.first + np.arange(len(self.x))

    @property
    def columns(self):
        """Recorded arrays: step, x, v, images, potential, virial, cell, and the inputs of steps."""
        return (self.steps, *(getattr(self, name) for name in ("x", "v", "images", *_COLUMNS[4:])))

    def cell_of(self, row: int, cell: Cell) -> Cell:
        """Return the simulation box at a row. Row -1 is the step before the first row.

        Args:
            cell: the box of a run whose box does not move.
        """
        if not self.cell.size:
            return cell
        return self.cell_before if row < 0 else Cell.create(self.cell[row], cell.pbc)


#: Columns of a record that are stored in a tape.
_COLUMNS = ("x", "v", "images", "bits", "potential", "virial", "cell", "inputs")


def stretch_of(segment: Segment, start: Start, ledger: FlipTable | None = None) -> TapeStretch:
    """Copy the record of a segment, because its memory is reused."""
    columns: dict[str, Any] = {name: getattr(segment.record, name) for name in _COLUMNS}
    x_before = np.asarray(start.state.x_before)[:, segment.table.order]
    before = jax.tree.map(np.asarray, start.state.cells[len(start.state.cells) > 1])
    made = TapeStretch(
        segment.first, segment.rows, **jax.tree.map(np.asarray, columns), x_before=x_before,
        cell_before=before, table=segment.table, ledger=ledger,
    )  # fmt: skip
    return made.roomy()


class Pace(NamedTuple):
    """Number of steps between the frames that a loss uses, and the step of the first frame."""

    between: Int[Array, ""]  # steps from one frame to the next; 0 where they are not a series at equal times
    first: Int[Array, ""]  # step of the first frame

    def share(self, step: Int[Array, ""], timestep: Float[Array, ""]) -> Float[Array, ""]:
        """Return the number of the loss's frames per unit of time near a step."""
        within = (self.between > 0) & (step > self.first - self.between)
        time = jnp.maximum(self.between, 1).astype(jnp.float64) * timestep.astype(jnp.float64)
        return jnp.where(within, 1 / time, 0.0)


def pace_of(loss: Loss, steps: int) -> Pace:
    """Return the number of steps between the frames that a loss uses."""
    seen = np.flatnonzero(loss.looks_at(np.arange(steps + 1), steps))
    spacings = np.unique(np.diff(seen))
    between = int(spacings[0]) if len(spacings) == 1 else 0
    return Pace(jnp.asarray(between), jnp.asarray(int(seen[0]) if len(seen) else 0))


class RunTape:
    """A recorded run, its flips, and the value of the loss.

    Args:
        steps: last step. flips: whether to write the ledger too.
        budget: bytes of recorded stretches that are kept; the others are run again when needed.
        each: called with every stretch when it is complete.

    Raises:
        NumericalError: the run blew up.
    """

    def __init__(
        self,
        simulation: Simulation,
        loss: Loss,
        steps: int,
        *,
        flips: bool = False,
        budget: int = KEPT,
        each: Callable[[TapeStretch], None] | None = None,
        progress: Callable[[int, int], None] | None = None,
    ):
        self.simulation, self.loss, self.steps, self.flips = simulation, loss, steps, flips
        self.budget, self._each = budget, each
        self.start = first_state(simulation)
        self.around = surroundings(simulation)
        self.pace = pace_of(loss, steps)
        self.origin = frame_of_start(self.start, simulation)
        self.total: Any = no_sums(loss, self.origin, self.around)
        if jnp.iscomplexobj(jax.eval_shape(lambda total: loss.value(total, 1), self.total)):
            raise loss.wrong(*NOT_REAL)
        self.frames = self.held = 0
        self._recorder = PairRecorder(simulation) if flips else None
        # stretches that are kept; of others what it takes to run them again
        self._made: list[TapeStretch | tuple[Start, FlipTable | None]] = []
        inputs = without_kick(simulation.integrator) is not None
        self._engine = Engine(simulation, steps, start=self.start, inputs=inputs)
        self._begin()
        for segment in self._engine.segments():
            if segment.closes in FAILURES:
                remedy = "Use a smaller time step, or a start without overlapping atoms"
                if segment.closes == NARROW:
                    remedy = "Use a larger system, a smaller skin, or fewer steps"
                message = f"the run ended with a {segment.closes} at step {segment.last}"
                raise NumericalError(message, remedy=remedy)
            self._add(segment)
            if progress is not None:
                progress(segment.last, steps)
        self.value = float(self.loss.value(self.total, self.frames))

    def _begin(self) -> None:
        self._next = self.start

    def _add(self, segment: Segment) -> None:
        skin = self.simulation.rule.skin
        if segment.closes == "displacement" and segment.moved > skin:
            raise NumericalError(
                f"the neighbor list may miss pairs at step {segment.last}: since its last rebuild an atom "
                f"has moved {segment.moved:.3g}, more than the skin of {skin:.3g}",
                remedy="Use a wider skin, or a smaller time step if atoms move that far in one step",
            )
        ledger = None if self._recorder is None else self._recorder.flips(segment)
        stretch = stretch_of(segment, self._next, ledger)
        self._observe(stretch)
        if self._each is not None:
            self._each(stretch)
        packed = stretch.cut()
        kept = self.held + packed.nbytes <= self.budget
        self._made.append(packed if kept else (self._next, ledger))
        self.held += packed.nbytes if kept else 0
        self._next = resume_point(segment)

    @property
    def replayed(self) -> int:
        """Number of stretches that a reverse pass runs again, because they were not stored."""
        return sum(isinstance(one, tuple) for one in self._made)

    @property
    def jumps_unseen(self) -> tuple[float, float]:
        """Derivatives of the loss with respect to energy and virial. (0, 0) for equally spaced frames.

        For losses of a single frame, gradients omit jumps of energy and virial at flips.
        """
        if int(self.pace.between) > 0:
            return 0.0, 0.0

        def at(potential, virial):
            frame = self.origin._replace(potential=potential, virial=virial)
            return self.loss.value(self.loss.observe(frame, frame, self.around), 1)

        one = jnp.ones((), jnp.float64)
        potential, virial = jax.grad(at, argnums=(0, 1))(one, one)
        energy, force = (bool(np.any(jump)) for jump in self.simulation.jumps())
        # the virial jumps where the force does
        return float(potential) * energy, float(virial) * force

    def __len__(self) -> int:
        return len(self._made)

    def _whole(self, one: TapeStretch | tuple[Start, FlipTable | None]) -> TapeStretch:
        return stretch_of(self._engine.again(one[0]), *one) if isinstance(one, tuple) else one.roomy()

    def backward(self) -> Iterator[TapeStretch]:
        """Yield the recorded stretches of steps, from last to first."""
        return map(self._whole, reversed(self._made))

    def forward(self) -> Iterator[TapeStretch]:
        """Yield the recorded stretches of steps, from first to last."""
        return map(self._whole, self._made)

    def seen(self, stretch: TapeStretch) -> Bool[np.ndarray, "room"]:
        """Return for each step of a stretch whether the loss uses it."""
        steps = stretch.steps
        return self.loss.looks_at(steps, self.steps) & (np.arange(len(steps)) < stretch.rows)

    def _observe(self, stretch: TapeStretch) -> None:
        seen = self.seen(stretch)
        self.frames += int(seen.sum())
        if seen.any():
            self.total = _summed(
                self.loss, self.total, stretch.columns, stretch.rows, seen, self.origin, self.around,
                stretch.table.order,
            )  # fmt: skip


class ReversibleTape(RunTape):
    """A completed run in fixed-point numbers, which is reversed instead of stored.

    The method `backward` reverses the steps with new neighbor lists. `backward` raises NumericalError if a
    state differs from the forward run.

    Attributes:
        baths: bits that a thermostat's friction discarded, by step; only this memory grows with the run.
        stretches: number of stretches reversed so far.
    """

    def _begin(self) -> None:
        self.baths: dict[int, np.ndarray] = {}
        self.stretches = 0
        self._every = max(1, self.steps // _FINGERPRINTS)
        self._prints: dict[int, bytes] = {}
        self._end = self.start.state

    def _add(self, segment: Segment) -> None:
        steps = np.arange(segment.first, segment.last + 1)
        if self.loss.looks_at(steps, self.steps).any():
            self._observe(stretch_of(segment, self.start))
        x, v, images = (segment.rows_of(name) for name in ("x", "v", "images"))
        for row in np.flatnonzero(steps % self._every == 0):
            self._prints[int(steps[row])] = fingerprint(segment.table.order, x[row], v[row], images[row])
        state, period = segment.state, self.simulation.propagator.pause
        if period is not None and int(state.step) % int(period) == 0:
            self.baths[int(state.step)] = np.array(state.extra.value)
        self._end = state

    def __len__(self) -> int:
        return self.stretches

    @property
    def nbytes(self) -> int:
        """Memory (bytes) that stores the bits discarded by friction. The memory grows with each step."""
        return sum(bath.nbytes for bath in self.baths.values())

    def forward(self) -> Iterator[TapeStretch]:
        """Run the steps again, because states were not stored. Yield the stretches in order."""
        return RunTape(self.simulation, self.loss, self.steps, flips=self.flips).forward()

    def backward(self) -> Iterator[TapeStretch]:
        # the initial bath is empty
        baths = {**self.baths, 0: np.zeros((3, self.simulation.atoms), np.int64)}
        way = BackwardRun(self.simulation, self._end, baths)
        self.stretches = 0
        for made in way.stretches():
            self._compare(made)
            self.stretches += 1
            columns: Any = {name: getattr(made.record, name) for name in _COLUMNS}
            yield TapeStretch(
                made.first, made.rows, **columns, x_before=made.x_before,
                cell_before=self.simulation.cell, table=made.table,
            )  # fmt: skip
        # the first state, every bit of it
        for name in ("x", "v", "images"):
            a, b = (np.asarray(getattr(state, name)) for state in (self.start.state, way.back))
            if not np.array_equal(a, b):
                self._astray(0, min(self._every, self.steps))

    def _compare(self, made: Stretched) -> None:
        """Compare hashes of the reversed states with those of the forward run."""
        for row in range(made.rows - 1, -1, -1):
            step, record = made.first + row, made.record
            if step % self._every:
                continue
            here = fingerprint(made.table.order, record.x[row], record.v[row], record.images[row])
            if here != self._prints[step]:
                self._astray(step, min(step + self._every, self.steps))

    def _astray(self, step: int, last: int) -> None:
        where = f"at step {step}" if last - step <= 1 else f"between steps {step} and {last}"
        raise NumericalError(
            f"positions or velocities of the reversed run differ from those of the forward run {where}",
            remedy="Rebuild the neighbor list more often (neighbors.rebuild): pairs may have been missed",
            where=self.simulation.name,
        )


def fingerprint(order, *parts) -> bytes:
    """Return a hash of a state in the user's order of atoms. The sign of a zero is ignored."""
    digest = hashlib.blake2b(digest_size=8)
    for part in map(np.asarray, parts):
        out = np.empty_like(part)
        out[:, order] = part
        digest.update((out + out.dtype.type(0)).tobytes())
    return digest.digest()


def listed(simulation: Simulation, table: PairTable) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each listed pair once: indices of both atoms in the list's order, and pair type."""
    first, second, i, j = table.listed(simulation.channels)
    return first, second, np.asarray(simulation.type_of(i, j), np.int64)


def frame_of(row, order: Int[Array, "atoms"], matrix: Float[Array, "3 3"]) -> LossFrame:
    """Convert a recorded step to a `LossFrame`. Positions are unwrapped. Atoms are in the user's order."""
    step, x, v, images, potential, virial = row[:6]
    whole = x + (matrix.T @ images.astype(matrix.dtype)).astype(x.dtype)
    return LossFrame(step, unsorted(whole, order), unsorted(v, order), potential, virial)


def seen_in(row, order: Int[Array, "atoms"], origin: LossFrame, around: LossContext):
    """Return the arguments of `Loss.observe` for a step: frame, first frame and context."""
    around = in_box(around, row[6]) if row[6].size else around
    return frame_of(row, order, around.matrix), origin, around


@jax.jit
def _summed(loss, total, rows, used, seen, origin, around, order):
    def step(total, row):
        row, see = row

        def add(total):
            part = loss.observe(*seen_in(row, order, origin, around))
            return jax.tree.map(jnp.add, total, part)

        return lax.cond(see, add, lambda total: total, total), None

    return over_rows(step, total, (rows, seen), used)[0]


def in_box(around: LossContext, matrix: Float[Array, "3 3"]) -> LossContext:
    """Return the context of a loss (masses, box, constants) with changed lattice vectors."""
    volume = jnp.abs(jnp.dot(matrix[0], jnp.cross(matrix[1], matrix[2])))
    return around._replace(matrix=matrix, volume=jnp.where(around.volume > 0, volume, 0.0))


def surroundings(simulation: Simulation) -> LossContext:
    """Return the context of a loss: masses, initial box, constants and time step."""
    cell = simulation.cell
    volume = cell.volume if all(simulation.pbc) else 0.0
    parts = (
        simulation.masses, np.asarray(cell.matrix), volume, simulation.units.k_B,
        simulation.integrator.timestep, simulation.units.time_factor,
    )  # fmt: skip
    return LossContext(*(jnp.asarray(part, jnp.float64) for part in parts))


def no_sums(loss: Loss, origin: LossFrame, around: LossContext) -> Any:
    """Return the initial sums of a loss, which are zeros."""
    shapes = jax.eval_shape(loss.observe, origin, origin, around)
    return jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), shapes)


def frame_of_start(start: Start, simulation: Simulation) -> LossFrame:
    """Return the frame of step 0. Energies are NaN, because they are not yet known."""
    state = start.state
    matrix = jnp.asarray(np.asarray(simulation.cell.matrix), jnp.float64)
    whole = state.x + (matrix.T @ state.images.astype(matrix.dtype)).astype(state.x.dtype)
    nan = jnp.full((), jnp.nan, jnp.float64)
    return LossFrame(state.step, whole, state.v, nan, nan)
