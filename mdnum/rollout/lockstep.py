"""Simultaneous simulation of two runs, and of each run with the other's cutoff decisions.

Each run without imposed decisions equals a single run bit for bit. Neighbor lists and compiled loops are
separate. The comparison of the two runs uses only changes of cutoff decisions. Only pairs with different
decisions are stored.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from mdnum.program import PairRows
from mdnum.rollout.compared import CrossFlip, CrossRecorder, differ, separations, strains
from mdnum.rollout.counterfactual import Counterfactual
from mdnum.rollout.flips import AmbiguousPairs
from mdnum.rollout.tracks import Rows, Track
from mdnum.systems.simulation import Simulation


def lockstep(leader: Track, follower: Track, imposed: Mapping[str, Counterfactual]) -> Iterator[PairRows]:
    """Advance two runs, and copies with imposed decisions, in groups of steps.

    Args:
        leader, follower: the runs A and B; the counterfactual with the decisions of a run is its listener.
        imposed: the requested counterfactuals: "B|A" has B's arithmetic and A's decisions, "A|B" the reverse.
    """
    tracks = {"A": leader, "B": follower}
    runs: dict[str, Track | Counterfactual] = {**tracks, **imposed}
    a = leader.simulation
    crossing: CrossRecorder | None = None
    while leader.segment() is not None:
        end = leader.ready
        rows = {name: run.until(end) for name, run in runs.items()}
        clock, rows_b = rows["A"], rows["B"]
        assert clock is not None
        opening: list[CrossFlip] = []
        if crossing is None:
            assert leader.first_pairs is not None and follower.first_pairs is not None
            crossing = CrossRecorder(leader.first_pairs, follower.first_pairs, a.atoms)
            opening = crossing.opening()
        cross, flips = crossing.take(clock.first, len(clock), leader.flips(end), follower.flips(end))
        separation = {"B": separation_of(clock, rows_b)}
        # in the labels and axes of the run whose decisions it acts on; distances do not mind
        if "B|A" in rows:
            separation["B|A"] = separation_of(clock, rows["B|A"])
            separation["B|A from B"] = _padded(separation_of(rows_b, rows["B|A"]), clock)
        if "A|B" in rows:
            under_b = None if rows["A|B"] is None else rows["A|B"].seen_by(follower.frame)
            separation["A|B"] = _padded(separation_of(rows_b, under_b), clock)
            separation["A|B from A"] = separation_of(clock, under_b)
        nearest = {name: _nearest(track.simulation, rows[name], clock) for name, track in tracks.items()}
        doubts = {name: track.doubts(end) for name, track in tracks.items()}
        yield PairRows(
            clock.first,
            separation,
            _bits_differ(clock, rows_b),
            {
                name: clock.energy if name == "A" else _column(one, "energy", clock)
                for name, one in rows.items()
            },
            cross,
            [*opening, *flips] if opening else flips,
            {name: _column(rows[name], "overridden", clock) for name in imposed},
            {name: _column(rows[name], "furthest", clock) for name in imposed},
            nearest,
            {name: _padded(_bound(track, rows[name]), clock) for name, track in tracks.items()},
            {
                name: np.where(np.isnan(nearest[name]), np.nan, _per_row(doubt, clock))
                for name, doubt in doubts.items()
            },
            doubts,
            {name: run.failed for name, run in runs.items()},
            strain={
                name: strain_of(clock, rows[name])
                for name in ("B", "B|A")
                if name in rows and rows_b is not None and _differ(clock, rows_b)
            },
        )
        if follower.failed or leader.failed:
            return


def beside(
    leader: Track, runs: Sequence[Track | Counterfactual]
) -> Iterator[list[Float[np.ndarray, "rows"]]]:
    """Yield the largest distance of an atom from its position in `leader`, for each run and step."""
    while leader.segment() is not None:
        rows = leader.until(end := leader.ready)
        yield [separation_of(rows, run.until(end)) for run in runs]


def separation_of(a: Rows | None, b: Rows | None) -> Float[np.ndarray, "rows"]:
    """Return, by step, the largest distance between an atom's positions in two runs. NaN after run b ended.

    Positions are scaled to the box of the first run. Distances are minimum-image distances in this box.
    """
    out = np.full(0 if a is None else len(a), np.nan)
    if a is not None and b is not None:
        rows = min(len(a), len(b))
        boxes = (a.boxes[:rows], b.boxes[:rows]) if _differ(a, b) else (a.cells[:rows] or (a.box,), ())
        out[:rows] = separations(boxes[0], a.x[:rows], b.x[:rows], boxes[1])
    return out


def strain_of(a: Rows, b: Rows | None) -> Float[np.ndarray, "rows"]:
    """Return the strain between the boxes of two runs at each step. NaN after run b has ended."""
    out = np.full(len(a), np.nan)
    if b is not None:
        rows = min(len(a), len(b))
        out[:rows] = strains(a.boxes[:rows], b.boxes[:rows])
    return out


def _differ(a: Rows, b: Rows) -> bool:
    """Return True if the boxes of two runs can differ from each other."""
    return bool(a.cells or b.cells) or not np.array_equal(a.box.matrix, b.box.matrix)


def _bits_differ(a: Rows, b: Rows | None) -> np.ndarray:
    out = np.ones(len(a), bool)
    if b is not None:
        rows = min(len(a), len(b))
        out[:rows] = differ(a.x[:rows], b.x[:rows]) | differ(a.v[:rows], b.v[:rows])
        if _differ(a, b):
            boxes = zip(a.boxes[:rows], b.boxes[:rows], strict=True)
            out[:rows] |= np.array([not np.array_equal(one.matrix, other.matrix) for one, other in boxes])
    return out


def _column(rows: Rows | None, name: str, clock: Rows) -> Float[np.ndarray, "rows"]:
    return _padded(np.zeros(0) if rows is None else getattr(rows, name), clock)


def _per_row(doubts: AmbiguousPairs, rows: Rows) -> Int[np.ndarray, "rows"]:
    return np.bincount(doubts.step - rows.first, minlength=len(rows))


def _nearest(run: Simulation, rows: Rows | None, clock: Rows) -> Float[np.ndarray, "rows"]:
    """Return a lower bound on |pair distance - cutoff radius| at each step."""
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


def _bound(track: Track, rows: Rows | None) -> Float[np.ndarray, "rows"]:
    """Return the largest bound on the rounding error of a pair distance at each step."""
    if rows is None:
        return np.zeros(0)
    decider = track.simulation.decider
    slope = 2.0 * np.array(decider.r_cut) if decider.space == "r2" else 1.0
    return (decider.bounds_at(track.frame.inverse.positions(rows.x)) / slope).max(axis=1)


def _padded(values: np.ndarray, rows: Rows) -> np.ndarray:
    out = np.full(len(rows), np.nan)
    count = min(len(values), len(rows))
    out[:count] = values[:count]
    return out
