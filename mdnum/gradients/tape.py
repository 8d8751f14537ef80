"""The forward run as a gradient needs it: every stretch of steps, last first, and the sums of the loss.

Stretches are kept as they were recorded while memory lasts, and made again from their first states where it
does not. Made again they have the same bits: the same compiled program, started from the same state, with
the same list.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from mdnum.errors import NumericalError
from mdnum.events import Ledger
from mdnum.gradients.loops import over_rows
from mdnum.gradients.losses import Frame, Loss, Surroundings
from mdnum.md.verlet import PairTable
from mdnum.rollout.engine import FAILURES, Engine, Segment, Start, first_state, resume_point
from mdnum.rollout.flips import PairRecorder
from mdnum.systems.build import Simulation

#: Bytes of recorded stretches that a tape keeps.
KEPT = 2**29
#: Fewest rows that a stretch is kept with.
_LEAST_ROOM = 16


@dataclass(frozen=True)
class Stretch:
    """Some steps of one list, in the order of its atoms.

    Attributes:
        first, rows: its first step and how many there are.
        x, v: wrapped positions and velocities, shape (room, 3, atoms); rows beyond the used ones are void.
        images: lattice vectors taken off so far, same shape.
        bits: decisions, shape (room, words, atoms).
        before: decisions of this list at the step before, shape (words, atoms).
        x_before: positions of the step before, shape (3, atoms).
        potential, virial: shape (room,).
        table: the list.
        ledger: its flips; None where they were not asked for.
    """

    first: int
    rows: int
    x: Float[np.ndarray, "room 3 atoms"]
    v: Float[np.ndarray, "room 3 atoms"]
    images: Int[np.ndarray, "room 3 atoms"]
    bits: np.ndarray
    before: np.ndarray
    x_before: Float[np.ndarray, "3 atoms"]
    potential: Float[np.ndarray, "room"]
    virial: Float[np.ndarray, "room"]
    table: PairTable
    ledger: Ledger | None = None

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        kept = (self.x, self.v, self.images, self.bits, self.before, self.x_before, self.table.index)
        return sum(array.nbytes for array in kept)

    @property
    def steps(self) -> Int[np.ndarray, "room"]:
        """Step of each row."""
        return self.first + np.arange(len(self.x))


def stretch_of(segment: Segment, start: Start, ledger: Ledger | None = None) -> Stretch:
    """A copy of what a segment recorded; the segment's own record is used again.

    Args:
        segment: as the engine hands it out.
        start: where it began.
        ledger: its flips.
    """
    record, order = segment.record, segment.table.order
    assert segment.before is not None
    # the record has room for the longest stretch; powers of two, so that not every length is compiled for
    room = min(len(record.x), max(_LEAST_ROOM, 1 << (segment.rows - 1).bit_length()))

    def kept(column) -> np.ndarray:
        whole = np.asarray(column)
        copy = np.zeros((room, *whole.shape[1:]), whole.dtype)
        copy[: segment.rows] = whole[: segment.rows]
        return copy

    return Stretch(
        segment.first,
        segment.rows,
        kept(record.x),
        kept(record.v),
        kept(record.images),
        kept(record.bits),
        np.array(segment.before),
        np.asarray(start.state.x_before)[:, order],
        kept(record.potential),
        kept(record.virial),
        segment.table,
        ledger,
    )


class Pace(NamedTuple):
    """How often a loss looks.

    Attributes:
        between: steps from one frame to the next; 0 where they are not a series at equal times.
        first: step of the first frame.
    """

    between: Int[Array, ""]
    first: Int[Array, ""]

    def share(self, step: Int[Array, ""], timestep: Float[Array, ""]) -> Float[Array, ""]:
        """Frames per time around a step: by how many of them a jump just before this step comes earlier when
        it comes earlier by a time; on average, as a step decides when a frame is taken."""
        within = (self.between > 0) & (step > self.first - self.between)
        time = jnp.maximum(self.between, 1).astype(jnp.float64) * timestep.astype(jnp.float64)
        return jnp.where(within, 1 / time, 0.0)


def pace_of(loss: Loss, steps: int) -> Pace:
    """How often a loss looks at a run of so many steps."""
    seen = np.flatnonzero(loss.looks_at(np.arange(steps + 1), steps))
    apart = np.unique(np.diff(seen))
    between = int(apart[0]) if len(apart) == 1 else 0
    return Pace(jnp.asarray(between), jnp.asarray(int(seen[0]) if len(seen) else 0))


class Tape:
    """A run that has been made, and its loss.

    Args:
        simulation: the system as objects, with a pair potential.
        loss: what is evaluated along the way.
        steps: last step.
        flips: whether to write the ledger too.
        budget: bytes of recorded stretches that are kept; the rest is made again when it is asked for.
        each: called with every stretch when it has been made.
        progress: called with the step reached and the last step.

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
        each: Callable[[Stretch], None] | None = None,
        progress: Callable[[int, int], None] | None = None,
    ):
        self.simulation, self.loss, self.steps = simulation, loss, steps
        self.start = first_state(simulation)
        self.around = surroundings(simulation)
        self.pace = pace_of(loss, steps)
        self.origin = frame_of_start(self.start, simulation)
        recorder = PairRecorder(simulation) if flips else None
        self._starts: list[Start] = []
        self._ledgers: list[Ledger | None] = []
        self._kept: dict[int, Stretch] = {}
        self._engine = Engine(simulation, steps, start=self.start)
        self.total: Any = None
        self.frames = 0
        start, held = self.start, 0
        for segment in self._engine.segments():
            self._starts.append(start)
            if segment.closes in FAILURES:
                raise NumericalError(
                    f"the run ended in a {segment.closes} at step {segment.last}",
                    remedy="Use a smaller time step, or a start without overlapping atoms",
                )
            if segment.closes == "displacement" and segment.moved > simulation.rule.skin:
                raise NumericalError(
                    f"a list missed pairs at step {segment.last}: an atom moved {segment.moved:.3g} since it "
                    f"was built, and the skin is {simulation.rule.skin:.3g}",
                    remedy="Use a smaller time step if one step moves atoms that far, else a wider skin",
                )
            self._ledgers.append(None if recorder is None else recorder.flips(segment))
            stretch = stretch_of(segment, start, self._ledgers[-1])
            self._observe(stretch)
            if each is not None:
                each(stretch)
            if held + stretch.nbytes <= budget:
                self._kept[len(self._starts) - 1] = stretch
                held += stretch.nbytes
            start = resume_point(segment)
            if progress is not None:
                progress(segment.last, steps)
        self.held = held
        self.value = float(self.loss.value(self.total, self.frames))

    @property
    def replayed(self) -> int:
        """Stretches that are made again in a reverse pass."""
        return len(self._starts) - len(self._kept)

    @property
    def jumps_unseen(self) -> bool:
        """Whether the loss looks at energy or virial in single frames: where they jump with a flip, so does
        the loss, and no slope stands for that. In frames at equal times it is part of the average."""
        if int(self.pace.between) > 0:
            return False

        def at(potential, virial):
            frame = self.origin._replace(potential=potential, virial=virial)
            return self.loss.value(self.loss.observe(frame, frame, self.around), 1)

        one = jnp.ones((), jnp.float64)
        return any(float(slope) != 0 for slope in jax.grad(at, argnums=(0, 1))(one, one))

    def __len__(self) -> int:
        return len(self._starts)

    def backward(self) -> Iterator[Stretch]:
        """The stretches, last first."""
        for k in reversed(range(len(self._starts))):
            yield self._kept[k] if k in self._kept else self._again(k)

    def forward(self) -> Iterator[Stretch]:
        """The stretches, first one first."""
        for k in range(len(self._starts)):
            yield self._kept[k] if k in self._kept else self._again(k)

    def _again(self, k: int) -> Stretch:
        start = self._starts[k]
        return stretch_of(self._engine.again(start), start, self._ledgers[k])

    def seen(self, stretch: Stretch) -> Bool[np.ndarray, "room"]:
        """Rows that the loss looks at."""
        steps = stretch.steps
        return self.loss.looks_at(steps, self.steps) & (np.arange(len(steps)) < stretch.rows)

    def _observe(self, stretch: Stretch) -> None:
        seen = self.seen(stretch)
        self.frames += int(seen.sum())
        if self.total is None:
            shapes = jax.eval_shape(self.loss.observe, self.origin, self.origin, self.around)
            self.total = jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), shapes)
        if seen.any():
            self.total = _summed(
                self.loss,
                self.total,
                rows_of(stretch),
                stretch.rows,
                seen,
                self.origin,
                self.around,
                stretch.table.order,
            )


def rows_of(stretch: Stretch):
    """Columns of a stretch as a loss needs them."""
    return (stretch.steps, stretch.x, stretch.v, stretch.images, stretch.potential, stretch.virial)


def unsorted(a: Float[Any, "*rest atoms"], order: Int[Any, "atoms"]) -> Float[Array, "*rest atoms"]:
    """An array over the atoms of a list, in the user's order."""
    return jnp.zeros_like(a).at[..., order].set(a)


def frame_of(row, order: Int[Array, "atoms"], matrix: Float[Array, "3 3"]) -> Frame:
    """A row in the user's order, without the faces of the box."""
    step, x, v, images, potential, virial = row
    whole = x + (matrix.T @ images.astype(matrix.dtype)).astype(x.dtype)
    return Frame(step, unsorted(whole, order), unsorted(v, order), potential, virial)


@jax.jit
def _summed(loss, total, rows, used, seen, origin, around, order):
    def step(total, row):
        row, see = row

        def add(total):
            part = loss.observe(frame_of(row, order, around.matrix), origin, around)
            return jax.tree.map(jnp.add, total, part)

        return lax.cond(see, add, lambda total: total, total), None

    return over_rows(step, total, (rows, seen), used)[0]


def surroundings(simulation: Simulation) -> Surroundings:
    """Masses and box of a simulation."""
    cell = simulation.cell
    volume = cell.volume if all(simulation.pbc) else 0.0
    return Surroundings(
        jnp.asarray(simulation.masses, jnp.float64),
        jnp.asarray(np.asarray(cell.matrix), jnp.float64),
        jnp.asarray(volume, jnp.float64),
        jnp.asarray(simulation.units.k_B, jnp.float64),
        jnp.asarray(simulation.integrator.timestep, jnp.float64),
        jnp.asarray(simulation.units.time_factor, jnp.float64),
    )


def frame_of_start(start: Start, simulation: Simulation) -> Frame:
    """The frame of step 0; its energies are not known yet, and a loss has no use for them there."""
    state = start.state
    matrix = jnp.asarray(np.asarray(simulation.cell.matrix), jnp.float64)
    whole = state.x + (matrix.T @ state.images.astype(matrix.dtype)).astype(state.x.dtype)
    nan = jnp.full((), jnp.nan, jnp.float64)
    return Frame(state.step, whole, state.v, nan, nan)
