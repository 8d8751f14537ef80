"""Steps of one run in order, in the labels and axes of another, with the flips among them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mdnum.numerics import Ledger
from mdnum.rollout.compared import in_user_order
from mdnum.rollout.crossing import Flips
from mdnum.rollout.engine import FAILURES, Engine, Segment, Start, first_state
from mdnum.rollout.flips import Ambiguous, PairRecorder, decided_pairs
from mdnum.rollout.frame import Frame
from mdnum.rollout.pins import Pins
from mdnum.systems.build import Simulation


@dataclass(frozen=True)
class Rows:
    """Some steps of one run, in the labels and the frame of the first run.

    Attributes:
        first: step of the first row.
        x, v: wrapped positions and full-step velocities, shape (rows, 3, atoms), float64.
        energy: total energy, shape (rows,).
        failed: "blow-up", "runaway", or "" .
        nearest: smallest |margin| of any listed pair, in the quantity's space, shape (rows,); None for a run
            whose decisions are not its own.
    """

    first: int
    x: Float[np.ndarray, "rows 3 atoms"]
    v: Float[np.ndarray, "rows 3 atoms"]
    energy: Float[np.ndarray, "rows"]
    failed: str = ""
    nearest: Float[np.ndarray, "rows"] | None = None

    def __len__(self) -> int:
        return len(self.x)

    def cut(self, count: int) -> tuple[Rows, Rows]:
        """The first rows, and the rest."""
        near, rest = (None, None) if self.nearest is None else np.split(self.nearest, [count])
        return (
            Rows(self.first, self.x[:count], self.v[:count], self.energy[:count], "", near),
            Rows(self.first + count, self.x[count:], self.v[count:], self.energy[count:], self.failed, rest),
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
        frame: Frame | None = None,
        *,
        flips: bool = True,
        listener: Callable[[Segment], None] | None = None,
        pins: Pins | None = None,
    ):
        self.simulation = simulation
        self.frame = frame or Frame.same(simulation.atoms)
        self.start = start or first_state(simulation)
        self._engine = Engine(simulation, last, start=self.start, pins=pins)
        self._segments = self._engine.segments()
        self._recorder = PairRecorder(simulation) if flips else None
        self._listener = listener
        self._ahead: list[Rows] = []
        self._flips: list[Flips] = []
        self._doubts: list[Ambiguous] = []
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

    def until(self, last: int) -> tuple[Rows | None, Flips]:
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
        every = Flips.joined(self._flips)
        self._flips = [every.where(every.step > last)]
        return (joined(taken) if taken else None), every.where(every.step <= last)

    def doubts(self, last: int) -> Ambiguous:
        """The ambiguous decisions up to a step that were not yet asked for, in the first run's labels."""
        every = Ambiguous.joined(self._doubts)
        taken = every.where(every.step <= last)
        self._doubts = [every.where(every.step > last)]
        i, j = np.divmod(self.frame.keys_of(taken.i, taken.j), self.simulation.atoms)
        return taken._replace(i=i, j=j)


def _flips_of(ledger: Ledger, frame: Frame) -> Flips:
    """The columns that a comparison needs, in the labels of the first run."""
    keys = frame.keys_of(ledger.subject[:, 0], ledger.subject[:, 1])
    return Flips(ledger.step, keys, ledger.entered, ledger.margin, ledger.bound)


def rows_of(segment: Segment, frame: Frame, failed: str) -> Rows:
    """A segment's rows in the user's order of atoms."""
    x, v = (in_user_order(segment.rows_of(name), segment.table.order) for name in ("x", "v"))
    energy = segment.rows_of("potential") + segment.rows_of("kinetic")
    nearest = segment.rows_of("nearest").astype(np.float64)
    return Rows(segment.first, frame.positions(x), frame.vectors(v), energy, failed, nearest)
