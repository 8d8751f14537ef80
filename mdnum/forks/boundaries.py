"""Find the two adjacent parameter values between which the decisions of a run change.

Between two boundaries, the result of a run is a smooth function of the parameter. At a boundary, decisions
differ, and every later quantity of the run may jump.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError, expect_at_least
from mdnum.forks.worlds import packed, program_of, unpacked
from mdnum.numerics.rounding import neighbor, ordinal
from mdnum.plain import result
from mdnum.program import DecisionHistory, Number, Program, Progress
from mdnum.sweeps import engines
from mdnum.systems import BallSystem, opened

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from mdnum.systems.simulation import Simulation

#: Default for the largest number of boundaries, as many as a figure can label; more for a ball, whose runs
#: are fast.
MOST, MOST_BALL = 24, 64


@dataclass(frozen=True)
class Side:
    """A run with a parameter value next to a boundary, on one side."""

    at: float  # the number, as the float next to the boundary
    digest: str  # of its decisions
    # loss, energy: at its last step; a ball's energy is not kept
    loss: float
    energy: float
    gradient: float  # of the loss along the number, decisions held; NaN of molecular dynamics
    margin: float  # of the decision that changes, in the quantity's space
    decided: int  # that decision: 0 or 1, or a number of iterations


@dataclass(frozen=True)
class Boundary:
    """Two adjacent floats with different decisions, and the first decision that differs."""

    # below, above: the two sides; above.at is the float after below.at
    below: Side
    above: Side
    channel: str  # of the first decision that differs: "pair", "contact" or "stop"
    step: int  # of it
    # labels of its pair, or of its ball; empty where one decision is the whole batch's
    subject: tuple[int, ...]
    terms: str  # whose decision it is, where a pair has one for each term of a potential
    bound: float  # on the rounding error of its margin
    also: int  # further decisions that differ first at this step
    separation: float  # largest distance between the two final states, length
    # whether a fresh process found the same history on either side; None where none was asked
    confirmed: bool | None = None

    @property
    def jump(self) -> float:
        """Loss just above the boundary minus loss just below the boundary."""
        return self.above.loss - self.below.loss


@dataclass(frozen=True)
class Interval:
    """A parameter interval in which all computed runs make the same decisions."""

    # low, high: its ends; both were run
    low: float
    high: float
    history: int  # a number for each distinct history of a map, in order of appearance
    digest: str  # of it
    # loss_low, loss_high: at the ends
    loss_low: float
    loss_high: float
    runs: int  # how many were made here
    # the longest stretch between two of them: two boundaries closer than this may hide there. One ulp where
    # every float was run
    gap: float


@result
class BoundaryMap:
    """A run as a piecewise smooth function of one parameter of its system."""

    # number, steps: that was varied, and the last step of every run
    number: Number
    steps: int
    # low, high: the interval that was searched
    low: float
    high: float
    # intervals, boundaries: with one history each and between them, in order
    intervals: tuple[Interval, ...]
    boundaries: tuple[Boundary, ...]
    # stretches whose ends have different histories but were not searched to the last bit, and adjacent floats
    # where a run fails on one side before anything is decided otherwise
    unresolved: tuple[tuple[float, float], ...]
    complete: bool  # whether every float of the interval was run, so that nothing can hide
    # the longest stretch between two runs of one history; a pair of boundaries within it that cancel each
    # other may be missed
    resolution: float
    # evaluations, failed: runs made to find them, and those that ended in a blow-up or a runaway
    evaluations: int
    # at, loss, energy: of every run made, in order; at its last step
    at: np.ndarray
    loss: np.ndarray
    energy: np.ndarray
    failed: int

    @property
    def histories(self) -> int:
        """Number of different histories (sequences of decisions) that were found."""
        return len({interval.digest for interval in self.intervals})


class NumberLine:
    """Runs of a system for different parameter values. A value is identified by its ordinal among floats.

    Args:
        program: the program with the system's own value of the parameter.
        loss: loss function of the final state, as accepted by the world's `history`.
    """

    def __init__(
        self, program: Program, number: Number, steps: int, loss: Callable[..., float] | None = None
    ):
        self.program, self.number, self.steps, self.loss = program, number, steps, loss
        #: Stored data of each run: everything except its marks and its last state.
        self.known: dict[int, DecisionHistory] = {}

    def value(self, place: int) -> float:
        """Return the float with a given ordinal."""
        return float(neighbor(np.zeros((), self.number.dtype), place, self.number.dtype))

    def places(self, values: Any) -> list[int]:
        """Return the ordinals of some floats in ascending order, without duplicates."""
        return sorted({int(place) for place in ordinal(np.asarray(values, self.number.dtype))})

    def at(self, place: int) -> Any:
        """Return the program for the parameter value with a given ordinal."""
        return self.number.at(self.value(place))

    def run(self, place: int) -> DecisionHistory:
        """Compute all decisions for the parameter value with a given ordinal."""
        history = self.at(place).history(self.steps, self.loss)
        self.known[place] = replace(history, marks=history.marks[:0], x=history.x[:0])
        return history

    def digest(self, place: int) -> str:
        """Return the digest of all decisions for the float with a given ordinal."""
        if place not in self.known:
            self.run(place)
        return self.known[place].digest

    def changes(self, a: int, b: int) -> Iterator[tuple[int, int, dict[int, DecisionHistory]]]:
        """Yield adjacent ordinals with different decisions, ascending. Also yield the runs of the search.

        A grid interval is not searched if both ends have the same history of decisions.
        """
        pending = [(a, b)]
        while pending:
            (a, b), runs = pending.pop(), dict[int, DecisionHistory]()
            while b - a > 1:
                middle = (a + b) // 2
                here = self.digest(middle)
                runs[middle] = self.known[middle]
                if here == self.digest(a):
                    a = middle
                    continue
                if here != self.digest(b):
                    pending.append((middle, b))
                b = middle
            yield a, b, runs

    def boundary(self, below: int, above: int) -> Boundary | None:
        """Find the first decision that differs between two parameter values. None if a run ends earlier."""
        places = (below, above)
        runs = [self.run(place) for place in places]
        step = runs[0].first_difference(runs[1])
        assert step is not None  # their digests differ
        if any(len(run.marks) <= step - run.first for run in runs):
            return None
        found = self.at(below).differing(self.at(above), self.steps, step, self.number.key)
        decision = found.decision
        gradients = found.gradients or (float("nan"),) * 2
        sides = [
            Side(self.value(place), run.digest, run.loss, run.energy, gradient, margin, decided)
            for place, run, gradient, margin, decided in zip(
                places, runs, gradients, decision.margins.values(), (decision.a, decision.b), strict=True
            )
        ]
        moved = (runs[1].x - runs[0].x).reshape(len(runs[0].x), -1)
        separation = float(np.sqrt(np.max(np.sum(moved**2, axis=1))))
        low, high = sides
        bound, also, subject, terms = decision.bounds["A"], decision.also, decision.subject, ""
        if decision.channel == "pair":
            pair = self.at(below).simulation.pair_of(*subject)
            subject, terms = (pair["i"], pair["j"]), pair.get("terms", "")
        return Boundary(low, high, decision.channel, step, subject, terms, bound, also, separation)


def boundaries(
    system: Simulation | BallSystem,
    key: str,
    low: float,
    high: float,
    steps: int | None = None,
    *,
    cells: int = 64,
    most: int | None = None,
    loss: Callable[..., float] | None = None,
    confirm: bool = True,
    progress: Progress | None = None,
    on: str | Executor | None = None,
    workers: int | None = None,
) -> BoundaryMap:
    """Find the parameter values at which the decisions of a run change.

    The system is run at every grid value of the parameter. A grid interval is bisected if the decisions at
    its ends differ. Bisection stops at adjacent floats. If decisions also change in the other half, that half
    is searched later. Boundaries that cancel within a grid interval are missed. The search goes from low to
    high parameter values. If there are more boundaries than requested, the highest are missing. All runs use
    the program of a normal run. A varied cutoff radius becomes an argument. A new process repeats the runs on
    both sides of every boundary.

    Args:
        steps: last step; default the system's own. For arguments not listed here see `mdnum.fork_map`.
        cells: number of grid cells. If there are no more floats than this, a run is made for every float.
        progress: called with the number of items done, their total, and a dictionary: the phase and the unit.
        on, workers: where to compute, as for `mdnum.sweep`; by default in this process.

    Raises:
        InputError: the parameter does not exist, the interval is empty, or a value is invalid.

    Error: boundaries are exact: the two sides are adjacent floats whose runs made different decisions.
    """
    most = (MOST_BALL if isinstance(system, BallSystem) else MOST) if most is None else most
    expect_at_least(1, cells=cells, most=most)
    system = opened(system)
    program = program_of(system, steps)
    last = program.steps if steps is None else steps
    expect_at_least(1, steps=last)
    line = NumberLine(program, checked(program, key, low, high), last, loss)
    places = _grid(line, low, high, cells)
    note = progress or (lambda done, total, info: None)
    with engines.requested(on, workers) as engine:
        own = line if engine is None else packed(system, line.number.key, last, loss)
        runs = engines.in_order(_run, ((own, place) for place in places), engine)
        for k, place in enumerate(places):
            note(k, len(places), {"phase": "running a grid", "unit": "runs"})
            line.known[place] = next(runs)
        unequal = [ends for ends in pairwise(places) if len({line.digest(place) for place in ends}) > 1]
        edges: list[Boundary] = []
        count = 0
        # a cell is searched here only after those below it, and then not for more boundaries than are left
        tasks = ((own, {end: line.known[end] for end in ends}, most - count) for ends in unequal)
        searched = engines.in_order(_searched, tasks, engine)
        for k in range(len(unequal)):
            if count == most:
                break
            note(count, min(most, count + len(unequal) - k), {"phase": "bisecting", "unit": "boundaries"})
            for edge, runs_made in next(searched)[: most - count]:
                line.known |= runs_made
                edges += [] if edge is None else [edge]
                count += 1
        searched.close()
    if confirm and edges:
        edges = _confirmed(system, line, edges, note)
    return _mapped(line, edges)


def _line_of(own: NumberLine | bytes) -> NumberLine:
    return _unpacked_line(own) if isinstance(own, bytes) else own


@lru_cache(1)
def _unpacked_line(data: bytes) -> NumberLine:
    system, key, steps, loss = unpacked(data)
    program = program_of(system, steps)
    return NumberLine(program, program.number(key), steps, loss)


def _run(task: tuple[NumberLine | bytes, int]) -> DecisionHistory:
    """Run the program for the parameter value that has the given ordinal."""
    line, place = _line_of(task[0]), task[1]
    line.digest(place)
    return line.known[place]


def _searched(
    task: tuple[NumberLine | bytes, dict[int, DecisionHistory], int],
) -> list[tuple[Boundary | None, dict[int, DecisionHistory]]]:
    """Find the lowest values in a grid interval at which decisions change, with the runs of each search."""
    own, ends, most = task
    line = _line_of(own)
    line.known |= ends
    return [(line.boundary(a, b), runs) for a, b, runs in islice(line.changes(*ends), most)]


def checked(program: Program, key: str, low: float, high: float) -> Number:
    """Return the parameter with the given key. Check the interval of its values.

    Raises:
        InputError: the parameter does not exist, or the interval is invalid (the message gives the reason).
    """
    number = program.number(key)
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise InputError(f"invalid interval {low!r}:{high!r}", remedy="Give two finite numbers, LOW < HIGH")
    if number.positive and (low < 0 if number.zero else low <= 0):
        raise InputError(
            f"{number.key} = {low!r}; expected a value {'of at least' if number.zero else 'above'} 0"
        )
    for end in (low, high):
        number.at(end)
    return number


def _grid(line: NumberLine, low: float, high: float, cells: int) -> list[int]:
    """Return the ordinals of the grid points, which are evenly spaced floats or all floats."""
    first, final = line.places([low, high])[0], line.places([low, high])[-1]
    if final - first <= cells:
        return list(range(first, final + 1))
    return line.places(np.linspace(low, high, cells + 1))


def _confirmed(system: Any, line: NumberLine, found: list[Boundary], note: Progress) -> list[Boundary]:
    """Mark each boundary as confirmed or not. The runs on both sides are repeated in a new process."""
    sides = [(edge.below, edge.above) for edge in found]
    values = [side.at for both in sides for side in both]
    digests = iter(digests_elsewhere(system, line.number.key, line.steps, values))
    edges = []
    for k, (edge, both) in enumerate(zip(found, sides, strict=True)):
        note(2 * k, len(values), {"phase": "confirming in a fresh process", "unit": "runs"})
        same = [next(digests) == side.digest for side in both]
        edges.append(replace(edge, confirmed=all(same)))
    return edges


def digests_elsewhere(
    system: Simulation | BallSystem, key: str, steps: int, values: Sequence[float]
) -> Iterator[str]:
    """Yield digests of all decisions of runs in a new process.

    The new process restores the system bit for bit and compiles its program again.

    Raises:
        MdnumError: the process failed.
    """
    with engines.opened(None, 1) as fresh:
        # others need cores, too
        fresh.threads = 1
        data = packed(system, key, steps)
        yield from engines.in_order(_digest, ((data, value) for value in values), fresh)


def _digest(task: tuple[bytes, float]) -> str:
    system, key, steps = unpacked(task[0])
    return program_of(system, steps).number(key).at(task[1]).history(steps).digest


def _mapped(line: NumberLine, found: list[Boundary]) -> BoundaryMap:
    """Assemble the boundary map from all runs, in ascending order of the parameter."""
    places = sorted(line.known)
    values = [line.value(place) for place in places]
    points = [line.known[place] for place in places]
    numbers: dict[str, int] = {}
    edges = [k for k in range(1, len(places)) if points[k].digest != points[k - 1].digest]
    intervals = []
    for first, end in zip([0, *edges], [*edges, len(places)], strict=True):
        digest = points[first].digest
        inner = np.diff(values[first:end])
        gap = float(inner.max()) if len(inner) else line.value(places[first] + 1) - values[first]
        number = numbers.setdefault(digest, len(numbers))
        ends = values[first], values[end - 1], number, digest, points[first].loss, points[end - 1].loss
        intervals.append(Interval(*ends, end - first, gap))
    known = {boundary.below.at for boundary in found}
    return BoundaryMap(
        line.number, line.steps, values[0], values[-1], tuple(intervals), tuple(found),
        tuple((values[k - 1], values[k]) for k in edges if values[k - 1] not in known),
        len(places) == places[-1] - places[0] + 1, max(interval.gap for interval in intervals),
        len(line.known), np.array(values), np.array([point.loss for point in points]),
        np.array([point.energy for point in points]), sum(bool(point.failed) for point in points),
    )  # fmt: skip
