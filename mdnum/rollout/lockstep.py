"""Two runs side by side, and counterfactuals that have the arithmetic of one and the decisions of the other.

Each free run is the run that it would be alone, bit for bit: its own lists, its own compiled epochs. What is
shared is the clock. Decisions are compared through the flips of both runs, so the cost does not depend on
how many pairs there are, and nothing of the past is kept but the pairs that differ now.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from mdnum.program import PairRows
from mdnum.rollout.compared import Apart, CrossFlip, CrossRecorder, ReferenceFrame, differ
from mdnum.rollout.engine import Segment, Start
from mdnum.rollout.flips import AmbiguousPairs
from mdnum.rollout.tracks import Handed, Overridden, Rows, Track, joined
from mdnum.systems.simulation import Simulation


def lockstep(
    a: Simulation,
    b: Simulation,
    last: int,
    *,
    start_a: Start | None = None,
    start_b: Start | None = None,
    frame: ReferenceFrame | None = None,
    handed: bool = True,
    back: bool = False,
    guard: float | None = None,
) -> Iterator[PairRows]:
    """Advance both runs, and what is compared with them, a stretch of A's steps at a time.

    Args:
        a, b: the two programs.
        last: last step.
        start_a, start_b: where they begin; default their systems' own starts.
        frame: how B's atoms and axes are A's.
        handed: whether to run B's arithmetic under A's decisions, "B|A".
        back: whether to run A's arithmetic under B's decisions too, "A|B".
        guard: length; a counterfactual ends when a decision it is told is further than this from its
            cutoff: it would no longer be a decision that rounding could have changed.

    Raises:
        InputError: a counterfactual of many-body potentials was asked for.
    """
    frame = frame or ReferenceFrame.same(a.atoms)
    forward = Counterfactual(Handed(b, a, start_b, frame), guard) if handed else None
    backward = Counterfactual(Handed(a, b, start_a, frame.inverse), guard) if back else None
    leader = Track(a, last, start_a, listener=forward)
    follower = Track(b, last, start_b, frame, listener=backward)
    cell_a = Apart(a.cell)
    crossing: CrossRecorder | None = None
    while leader.segment() is not None:
        end = leader.ready
        rows_a, flips_a = leader.until(end)
        rows_b, flips_b = follower.until(end)
        assert rows_a is not None
        opening: list[CrossFlip] = []
        if crossing is None:
            assert leader.first_pairs is not None and follower.first_pairs is not None
            crossing = CrossRecorder(leader.first_pairs, follower.first_pairs, a.atoms)
            opening = crossing.opening()
        cross, flips = crossing.take(rows_a.first, len(rows_a), flips_a, flips_b)
        separation = {"B": apart(cell_a, rows_a, rows_b)}
        energy = {"A": rows_a.energy, "B": _energy(rows_a, rows_b)}
        failed = {"A": leader.failed, "B": follower.failed}
        overridden: dict[str, np.ndarray] = {}
        furthest: dict[str, np.ndarray] = {}
        own: dict[str, Rows | None] = {}
        for name, told in (("B|A", forward), ("A|B", backward)):
            if told is None:
                continue
            rows, note = told.until(end)
            own[name] = rows
            energy[name] = _energy(rows_a, rows)
            overridden[name], furthest[name] = (_padded(x, rows_a) for x in (note.count, note.furthest))
            failed[name] = told.failed
        # in the labels and axes of the run whose decisions it acts on; distances do not mind
        if forward is not None:
            rows = own["B|A"]
            separation["B|A"] = apart(cell_a, rows_a, rows)
            separation["B|A from B"] = _padded(apart(cell_a, rows_b, rows), rows_a)
        if backward is not None:
            rows = None if own["A|B"] is None else _in_frame(own["A|B"], frame)
            separation["A|B"] = _padded(apart(cell_a, rows_b, rows), rows_a)
            separation["A|B from A"] = apart(cell_a, rows_a, rows)
        nearest = {"A": _nearest(a, rows_a, rows_a), "B": _nearest(b, rows_b, rows_a)}
        bound = {"A": _bound(a, rows_a, ReferenceFrame.same(a.atoms)), "B": _bound(b, rows_b, frame)}
        doubts = {"A": leader.doubts(end), "B": follower.doubts(end)}
        ambiguous = {
            name: np.where(np.isnan(nearest[name]), np.nan, _per_row(doubts[name], rows_a)) for name in doubts
        }
        yield PairRows(
            rows_a.first,
            separation,
            _bits_differ(rows_a, rows_b),
            energy,
            cross,
            [*opening, *flips] if opening else flips,
            overridden,
            furthest,
            nearest,
            {name: _padded(values, rows_a) for name, values in bound.items()},
            ambiguous,
            doubts,
            failed,
        )
        if follower.failed or leader.failed:
            return


class Counterfactual:
    """A handed run that listens to its leader and keeps what it did until it is asked for.

    Args:
        run: the handed run.
        guard: length; it ends when a decision that it is told is further than this from its cutoff.
    """

    def __init__(self, run: Handed, guard: float | None):
        self._run = run
        self._guard = guard
        self._rows: list[Rows] = []
        self._notes: list[Overridden] = []
        self._over = False

    @property
    def failed(self) -> str:
        """ "blow-up" or "runaway" where it ended that way."""
        return self._run.failed

    def __call__(self, segment: Segment) -> None:
        """Act on the decisions of a stretch of the leader's run."""
        if self._over:
            return
        rows, note = self._run.follow(segment)
        beyond = note.furthest > self._guard if self._guard is not None else np.zeros(len(rows), bool)
        if beyond.any() or self._run.failed:
            self._over = True
            keep = int(beyond.argmax()) if beyond.any() else len(rows)
            rows, _ = rows.cut(keep)
            note = Overridden(note.count[:keep], note.furthest[:keep])
        self._rows.append(rows)
        self._notes.append(note)

    def until(self, last: int) -> tuple[Rows | None, Overridden]:
        """The steps up to one that were not yet asked for; none after it was ended."""
        taken, notes = [], []
        while self._rows and self._rows[0].first <= last:
            rows, note = self._rows.pop(0), self._notes.pop(0)
            count = min(len(rows), last - rows.first + 1)
            if count < len(rows):
                rows, rest = rows.cut(count)
                self._rows.insert(0, rest)
                self._notes.insert(0, Overridden(note.count[count:], note.furthest[count:]))
                note = Overridden(note.count[:count], note.furthest[:count])
            if len(rows):
                taken.append(rows)
                notes.append(note)
        if not taken:
            return None, Overridden(np.zeros(0, np.int64), np.zeros(0))
        return joined(taken), Overridden.joined(notes)


def _in_frame(rows: Rows, frame: ReferenceFrame) -> Rows:
    return replace(rows, x=frame.positions(rows.x), v=frame.vectors(rows.v), nearest=None)


def apart(cell: Apart, a: Rows | None, b: Rows | None) -> Float[np.ndarray, "rows"]:
    """Largest distance between the same atoms of two runs at each step; NaN where the second has ended.

    Nearest images are those of the first run's boxes.
    """
    out = np.full(0 if a is None else len(a), np.nan)
    if a is not None and b is not None:
        count = min(len(a), len(b))
        cell = Apart(*a.cells[:count]) if a.cells[:count] else cell
        out[:count] = cell(a.x[:count], b.x[:count])
    return out


def _bits_differ(a: Rows, b: Rows | None) -> np.ndarray:
    out = np.ones(len(a), bool)
    if b is not None:
        count = min(len(a), len(b))
        out[:count] = differ(a.v[:count], b.v[:count], differ(a.x[:count], b.x[:count]))
    return out


def _energy(a: Rows, other: Rows | None) -> Float[np.ndarray, "rows"]:
    return np.full(len(a), np.nan) if other is None else _padded(other.energy, a)


def _per_row(doubts: AmbiguousPairs, rows: Rows) -> Int[np.ndarray, "rows"]:
    return np.bincount(doubts.step - rows.first, minlength=len(rows))


def _nearest(run: Simulation, rows: Rows | None, clock: Rows) -> Float[np.ndarray, "rows"]:
    """The smallest |margin| of each step as a length: at least so far is every pair from its cutoff."""
    if rows is None or rows.nearest is None:
        return np.full(len(clock), np.nan)
    margin = rows.nearest
    if run.decider.space == "r2":
        # |r - R| = |r² - R²| / (r + R); from outside, and for the longest cutoff, it is the smallest
        longest = max(run.decider.r_cut)
        with np.errstate(invalid="ignore"):
            length = margin / (np.sqrt(longest**2 + margin) + longest)
        # a step without a pair has nothing near
        margin = np.where(np.isinf(margin), np.inf, length)
    return _padded(margin, clock)


def _bound(run: Simulation, rows: Rows | None, frame: ReferenceFrame) -> Float[np.ndarray, "rows"]:
    """The largest rounding bound of any pair type at each step of a run as a length."""
    if rows is None:
        return np.zeros(0)
    slope = 2.0 * np.array(run.decider.r_cut) if run.decider.space == "r2" else 1.0
    return (run.decider.bounds_at(frame.inverse.positions(rows.x)) / slope).max(axis=1)


def _padded(values: np.ndarray, rows: Rows) -> np.ndarray:
    out = np.full(len(rows), np.nan)
    count = min(len(values), len(rows))
    out[:count] = values[:count]
    return out
