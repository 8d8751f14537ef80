"""Steps and flips of a run, in the labels and axes of another run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mdnum.md.cell import Cell
from mdnum.rollout.compared import PairFlips, ReferenceFrame, in_user_order
from mdnum.rollout.engine import FAILURES, Engine, Segment, Start, first_state
from mdnum.rollout.epoch import Pins
from mdnum.rollout.flips import AmbiguousPairs, PairRecorder, decided_pairs
from mdnum.systems.simulation import Simulation


@dataclass(frozen=True)
class Rows:
    """Consecutive time steps of a run, in the labels of the first run."""

    first: int  # step of the first row
    # x, v: wrapped positions and full-step velocities, shape (rows, 3, atoms), float64
    x: Float[np.ndarray, "rows 3 atoms"]
    v: Float[np.ndarray, "rows 3 atoms"]
    energy: Float[np.ndarray, "rows"]  # total energy, shape (rows,)
    box: Cell  # at step 0
    failed: str = ""  # "blow-up", "runaway", or ""
    # of a run whose decisions are its own: smallest |margin| of any listed pair, in the quantity's space
    nearest: Float[np.ndarray, "rows"] | None = None
    cells: tuple[Cell, ...] = ()  # the box of each row; none where all have the first
    # of one whose decisions are imposed: pairs that it would have decided otherwise, and the largest distance
    # of any of them from its cutoff, length
    overridden: Int[np.ndarray, "rows"] | None = None
    furthest: Float[np.ndarray, "rows"] | None = None

    def __len__(self) -> int:
        return len(self.x)

    @property
    def last(self) -> int:
        """Time step of the last row."""
        return self.first + len(self) - 1

    @property
    def boxes(self) -> tuple[Cell, ...]:
        """Simulation box of each row."""
        return self.cells or (self.box,) * len(self)

    def seen_by(self, frame: ReferenceFrame) -> Rows:
        """Return the time steps with the atom labels and axes of another run."""
        if frame.is_same:
            return self
        by = np.array([self.box.deformation(cell) for cell in self.cells]) if self.cells else None
        x, v = frame.positions(self.x, by), frame.vectors(self.v)
        return replace(self, x=x, v=v, cells=frame.boxes(self.cells, self.box))

    def cut(self, count: int) -> tuple[Rows, Rows]:
        """Split time steps into the first `count` steps and the rest."""

        def part(rows: slice, **changed: Any) -> Rows:
            columns = {name: getattr(self, name) for name in _COLUMNS}
            kept = {name: column[rows] for name, column in columns.items() if column is not None}
            return replace(self, **kept, cells=self.cells[rows], **changed)

        return part(slice(count), failed=""), part(slice(count, None), first=self.first + count)

    @classmethod
    def joined(cls, parts: list[Rows]) -> Rows:
        """Concatenate groups of consecutive time steps."""
        if len(parts) == 1:
            return parts[0]
        columns = {name: [getattr(part, name) for part in parts] for name in _COLUMNS}
        whole = {
            name: None if any(one is None for one in column) else np.concatenate(column)
            for name, column in columns.items()
        }
        cells = tuple(cell for part in parts for cell in part.cells)
        one = parts[-1]
        return cls(first=parts[0].first, box=one.box, failed=one.failed, cells=cells, **whole)  # type: ignore[arg-type]


_COLUMNS = ("x", "v", "energy", "nearest", "overridden", "furthest")


def taken(ahead: list[Rows], last: int) -> Rows | None:
    """Remove and return the recorded time steps up to `last`. None if there are none."""
    parts: list[Rows] = []
    while ahead and ahead[0].first <= last:
        rows = ahead.pop(0)
        if rows.last > last:
            rows, rest = rows.cut(last - rows.first + 1)
            ahead.insert(0, rest)
        parts.append(rows)
    return Rows.joined(parts) if parts else None


class Track:
    """Reader that returns the time steps and flips of a run in order.

    Args:
        simulation: the run.
        last: last step.
        start: initial state; by default the system's own start.
        frame: mapping of this run's atoms and axes to those of the first run.
        flips: whether to compute the flips of the run.
        listener: called with each segment that is read, while its decisions are still on the device.
        pins: decisions imposed on the run.
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
        """Read the next time steps of the run. None at its end."""
        segment = next(self._segments, None)
        if segment is None:
            return None
        if self._listener is not None:
            self._listener(segment)
        if self._recorder is not None:
            if self.first_pairs is None:
                self.first_pairs = self.frame.keys(decided_pairs(self.simulation, segment, 0))
            made = self._recorder.flips(segment)
            keys = self.frame.keys_of(made.i, made.j)
            self._flips.append(PairFlips(made.step, keys, made.entered, made.margin, made.bound))
            self._doubts.append(self._recorder.doubtful(segment))
        self.failed = segment.closes if segment.closes in FAILURES else ""
        self._ahead.append(rows_of(self.simulation, segment, self.frame, self.failed))
        return segment

    @property
    def ready(self) -> int:
        """Number of the last time step that has been read."""
        return self._ahead[-1].last

    def until(self, last: int) -> Rows | None:
        """Return the time steps up to `last` that have not been returned yet. None if there are none."""
        while not self._ahead or self.ready < last:
            if self.segment() is None:
                break
        return taken(self._ahead, last)

    def flips(self, last: int) -> PairFlips:
        """Return the flips up to step `last` that have not been returned yet."""
        every = PairFlips.concatenate(self._flips)
        self._flips = [every[every.step > last]]
        return every[every.step <= last]

    def doubts(self, last: int) -> AmbiguousPairs:
        """Return the ambiguous decisions up to step `last` that have not been returned yet."""
        every = AmbiguousPairs.concatenate(self._doubts)
        taken = every[every.step <= last]
        self._doubts = [every[every.step > last]]
        i, j = np.divmod(self.frame.keys_of(taken.i, taken.j), self.simulation.atoms)
        return replace(taken, i=i, j=j)


def rows_of(simulation: Simulation, segment: Segment, frame: ReferenceFrame, failed: str) -> Rows:
    """Convert recorded time steps to the user's order of atoms, labels and axes."""
    x, v = (in_user_order(segment.rows_of(name), segment.table.order) for name in ("x", "v"))
    energy = segment.rows_of("potential") + segment.rows_of("kinetic")
    nearest = segment.rows_of("nearest").astype(np.float64)
    rows = Rows(segment.first, x, v, energy, simulation.cell, failed, nearest, segment.cells)
    return rows.seen_by(frame)
