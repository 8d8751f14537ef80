"""Where along a number of a system the decisions of a run change, to the last bit.

Between two boundaries a run is one smooth function of the number. At a boundary a pair is decided otherwise
between two adjacent floats, and everything after it may jump.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from mdnum.errors import InputError
from mdnum.forks.confirm import digests_elsewhere
from mdnum.forks.dials import checked, dial
from mdnum.forks.histories import Loss, margin, squared_displacement
from mdnum.forks.line import Line
from mdnum.forks.piecewise import Boundary, BoundaryMap, Interval, Side
from mdnum.precision.ulp import ordinal
from mdnum.systems.build import build
from mdnum.systems.load import System, load

Progress = Callable[[int, int, dict[str, Any]], None]

#: Boundaries that are searched for, unless more are asked for: as many as a figure can name.
MOST = 24


def boundaries(
    system: System | str,
    key: str,
    low: float,
    high: float,
    steps: int | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    cells: int = 64,
    most: int = MOST,
    loss: Loss = squared_displacement,
    confirm: bool = True,
    progress: Progress | None = None,
) -> BoundaryMap:
    """Changes of history along a number, as far as a grid can tell, each to adjacent floats.

    The interval is run on a grid. A cell whose ends differ is bisected until its ends are adjacent floats; a
    half that differs too is searched as well, from the lowest float on: where there are more than asked for,
    those left lie above all that were found. All runs are by the program that a user runs (for the cutoff
    radius: by its twin that is given the radius), and both sides of every boundary are run again by a fresh
    process.

    Args:
        system: a loaded system, or a name or path to load.
        key: the number (see dials.dial).
        low, high: the interval, in the units of the system's file; both belong to it.
        steps: last step; default the system's own.
        overrides: as for `load`, where a name or path is given.
        cells: of the grid. With at least as many as there are floats, all are run.
        most: stop after this many boundaries; what is left is told as unresolved.
        loss: of the final state, called with the simulation, unwrapped positions and velocities.
        confirm: whether to run both sides of every boundary in a fresh process.
        progress: called with what is done of what there is to do, and figures: the phase, what is counted.

    Raises:
        InputError: no such number, an empty interval, or values that make no sense.

    Error: none in a boundary: its sides are adjacent floats, and their runs decided differently.
    """
    if not isinstance(system, System):
        system = load(system, overrides, world="md")
    if cells < 1 or most < 1:
        raise InputError(f"cells = {cells} and most = {most}; expected at least 1")
    simulation = build(system)
    last = system.spec.dynamics.steps if steps is None else steps
    if last < 1:
        raise InputError(f"steps = {last}; expected at least 1")
    one = dial(simulation, key)
    checked(one, low, high)
    for end in (low, high):
        one.turn(simulation, end)
    line = Line(simulation, one, last, loss)
    places = _grid(low, high, cells)
    pending: list[tuple[int, int]] = []
    for k, place in enumerate(places):
        _tell(progress, k, len(places), "running a grid", "runs")
        line.digest(place)
    for a, b in pairwise(places):
        if line.digest(a) != line.digest(b):
            heapq.heappush(pending, (a, b))
    found: list[tuple[int, int]] = []
    while pending and len(found) < most:
        _tell(progress, len(found), min(most, len(found) + len(pending)), "bisecting", "boundaries")
        a, b = heapq.heappop(pending)
        found.append(_bisect(line, a, b, pending))
    found.sort()
    annotated = []
    for k, pair in enumerate(found):
        _tell(progress, k, len(found), "looking at both sides", "boundaries")
        annotated.append(_annotated(line, pair))
    bounds = [boundary for boundary in annotated if boundary is not None]
    return _mapped(line, _confirmed(system, line, bounds, progress) if confirm and bounds else bounds)


def _confirmed(
    system: System, line: Line, found: list[Boundary], progress: Progress | None
) -> list[Boundary]:
    """The same boundaries, compared with what a fresh process finds on either side."""
    sides = [side for boundary in found for side in (boundary.below, boundary.above)]
    digests = digests_elsewhere(
        system,
        line.dial.key,
        line.steps,
        [side.at for side in sides],
        lambda done: _tell(progress, done, len(sides), "confirming in a fresh process", "runs"),
        # each side is another compiled program then, and compiling is what takes the time
        processes=2 if line.dial.compiles else 1,
    )
    same = [side.digest == digest for side, digest in zip(sides, digests, strict=True)]
    return [
        replace(boundary, confirmed=below and above)
        for boundary, below, above in zip(found, same[::2], same[1::2], strict=True)
    ]


def _tell(progress: Progress | None, done: int, total: int, phase: str, unit: str) -> None:
    if progress is not None:
        progress(done, total, {"phase": phase, "unit": unit})


def _grid(low: float, high: float, cells: int) -> list[int]:
    """Ordinals of the grid's floats: evenly spread, or all of them."""
    first, final = (int(place) for place in ordinal(np.array([low, high])))
    if final - first <= cells:
        return list(range(first, final + 1))
    return sorted({int(place) for place in ordinal(np.linspace(low, high, cells + 1))})


def _bisect(line: Line, a: int, b: int, pending: list[tuple[int, int]]) -> tuple[int, int]:
    """Adjacent ordinals between two whose histories differ; the halves not followed go to `pending`."""
    while b - a > 1:
        middle = (a + b) // 2
        here = line.digest(middle)
        if here == line.digest(a):
            a = middle
            continue
        if here != line.digest(b):
            heapq.heappush(pending, (middle, b))
        b = middle
    return a, b


def _annotated(line: Line, pair: tuple[int, int]) -> Boundary | None:
    """What differs between two adjacent floats; None where it is a run that fails, not a decision."""
    runs = [line.run(place) for place in pair]
    step = runs[0].first_difference(runs[1])
    assert step is not None  # their digests differ
    if any(len(run.marks) <= step for run in runs):
        return None
    looks = [line.look(place, step) for place in pair]
    simulations = [line.at(place) for place in pair]
    atoms = line.simulation.atoms
    differing = np.setxor1d(looks[0].pairs, looks[1].pairs, assume_unique=True)
    pairs = [divmod(int(key), atoms) for key in differing]
    margins = [
        [margin(simulation, seen.x, i, j) for simulation, seen in zip(simulations, looks, strict=True)]
        for i, j in pairs
    ]
    nearest = min(range(len(pairs)), key=lambda k: max(abs(m) for m in margins[k]))
    i, j = pairs[nearest]
    sides = [
        Side(
            line.value(place),
            run.digest,
            line.known[place].loss,
            run.energy,
            margins[nearest][k],
            bool(np.isin(differing[nearest], looks[k].pairs)),
        )
        for k, (place, run) in enumerate(zip(pair, runs, strict=True))
    ]
    kind = int(line.simulation.type_of(np.array([i]), np.array([j]))[0])
    apart = float(np.sqrt(np.max(np.sum((runs[1].x - runs[0].x) ** 2, axis=1))))
    below, above = sides
    bound = float(simulations[0].decider.bounds_at(looks[0].x.T[None])[0, kind])
    return Boundary(below, above, step, i, j, bound, len(pairs) - 1, apart, None)


def _mapped(line: Line, found: list[Boundary]) -> BoundaryMap:
    """Everything that was run, put in order."""
    places = sorted(line.known)
    values = [line.value(place) for place in places]
    points = [line.known[place] for place in places]
    numbers: dict[str, int] = {}
    edges = [k for k in range(1, len(places)) if points[k].digest != points[k - 1].digest]
    intervals = []
    for first, end in zip([0, *edges], [*edges, len(places)], strict=True):
        digest = points[first].digest
        inner = np.diff(values[first:end])
        gap = float(inner.max()) if len(inner) else float(np.spacing(values[first]))
        intervals.append(
            Interval(
                values[first],
                values[end - 1],
                numbers.setdefault(digest, len(numbers)),
                digest,
                points[first].loss,
                points[end - 1].loss,
                end - first,
                gap,
            )
        )
    known = {boundary.below.at for boundary in found}
    unresolved = tuple((values[k - 1], values[k]) for k in edges if values[k - 1] not in known)
    return BoundaryMap(
        line.dial.key,
        line.steps,
        values[0],
        values[-1],
        tuple(intervals),
        tuple(found),
        unresolved,
        len(places) == places[-1] - places[0] + 1,
        max(interval.gap for interval in intervals),
        len(line.known),
        np.array(values),
        np.array([point.loss for point in points]),
        np.array([point.energy for point in points]),
        sum(bool(point.failed) for point in points),
    )
