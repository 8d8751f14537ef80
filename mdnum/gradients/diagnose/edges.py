"""The jump of a gradient across the nearest boundaries of decisions on either side of a parameter.

StepEnds two boundaries every run decides alike, and loss and gradient are smooth functions of the parameter.
At a boundary one pair is decided otherwise between two adjacent floats. A step of an optimizer that is longer
than the distance to the nearest boundary crosses into another program, and what the gradient does there says
what that is worth.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mdnum.errors import InputError, NumericalError
from mdnum.forks.boundaries import NumberLine
from mdnum.gradients import parameters
from mdnum.gradients.problem import Problem, Progress, in_phase
from mdnum.gradients.recorded import passed, tape_of
from mdnum.gradients.tangents import tangents
from mdnum.md.cell import HostCell
from mdnum.numerics.rounding import ordinal
from mdnum.program import Number
from mdnum.rollout.program import MdProgram
from mdnum.systems.build import Simulation

#: How far from the parameter a boundary is looked for, as a share of its value.
REACH = 0.01
#: First shift where no forecast is to be had, as a share of the parameter, and how it grows.
_FIRST, _FACTOR = 1e-12, 8.0


@dataclass(frozen=True)
class DecisionEdge:
    """The nearest boundary of decisions on one side of a parameter, and the gradient across it.

    Attributes:
        side: "below" or "above".
        runs: that the search took.
        found: whether one was found within reach; what follows is void where none was.
        inside, beyond: adjacent floats; the run at `inside` decides as the one asked about, that at `beyond`
            does not.
        distance: from the parameter's value to `inside`, in its units.
        step, i, j: the first decision that differs.
        value_inside, value_beyond: the loss on either side.
        gradient_inside, gradient_beyond: derivative by this parameter on either side, by method.
    """

    side: str
    runs: int
    found: bool = False
    inside: float = float("nan")
    beyond: float = float("nan")
    distance: float = float("nan")
    step: int = -1
    i: int = -1
    j: int = -1
    value_inside: float = float("nan")
    value_beyond: float = float("nan")
    gradient_inside: dict[str, float] = field(default_factory=dict)
    gradient_beyond: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class DecisionEdges:
    """The nearest boundaries of decisions below and above the value of one parameter."""

    name: str
    value: float
    below: DecisionEdge
    above: DecisionEdge


def edges(
    problem: Problem,
    name: str,
    *,
    reach: float = REACH,
    progress: Progress | None = None,
) -> DecisionEdges:
    """The nearest boundary below and above a parameter, and the gradients across them.

    Where a pair first crosses otherwise is forecast with tangents; then runs are compared, on either side,
    until two adjacent floats differ.

    Args:
        problem: the loss of a rollout of a pair potential.
        name: a parameter of one entry, full or short name.
        reach: how far to look, as a share of the parameter's value.
        progress: called with runs done, runs expected, and a phase in words.

    Raises:
        InputError: no such parameter, several entries, or a value of 0.
        NumericalError: the run blew up.

    Error: none in a boundary: its sides are adjacent floats, and their runs decide differently. That no other
        one lies between it and the parameter is as sure as the forecast: pairs of boundaries that undo one
        another can hide between two runs that decide alike.
    """
    (full,) = parameters.resolve(problem.simulation, [name])
    here = parameters.value(problem.simulation, full)
    if here.shape:
        raise InputError(
            f"{full} has {here.size} entries; boundaries lie along one number",
            remedy="Search along a parameter of one entry",
        )
    value = float(here)
    if value == 0 or not 0 < reach < 1:
        raise InputError(f"{full} = {value:g} and reach = {reach:g}; expected a number, and a share below 1")
    program = MdProgram(problem.simulation)
    line = NumberLine(program, _number(program, full, value), problem.steps, _no_loss)
    ahead = _forecast(problem, full, progress)
    below, above = (_edge(problem, line, full, value, sign, ahead[sign], reach, progress) for sign in (-1, 1))
    return DecisionEdges(full, value, below, above)


def _no_loss(*_: object) -> float:
    return 0.0


def _number(program: MdProgram, name: str, value: float) -> Number:
    """The parameter as a number that can be varied without compiling again."""
    if name == "cutoff.radius":
        return program.number(name)

    def at(q: float) -> MdProgram:
        return MdProgram(parameters.with_values(program.simulation, {name: q}))

    return Number(name, value, "", at, at, True)


def _forecast(problem: Problem, name: str, progress: Progress | None) -> dict[int, float]:
    """Shifts of the parameter, by sign, at which tangents see the first pair cross; infinite where none."""
    if name == "box.scale":
        # the images move too, which these differences of positions leave out
        return {-1: np.inf, 1: np.inf}
    simulation = problem.simulation
    tape = tape_of(problem, True)
    cell, radii = HostCell(simulation.cell), np.asarray(simulation.decider.r_cut)
    nearest = {-1: np.inf, 1: np.inf}
    along = 1.0 if name == "cutoff.radius" else 0.0
    followed = tangents(tape, [name], states=True, progress=in_phase(progress, "tangents"))
    for part in followed:
        stretch, moved = part.stretch, part.x
        assert moved is not None
        table = stretch.table
        slot, first = np.nonzero(table.index < len(table.order))
        second = table.index[slot, first]
        once = table.order[first] < table.order[second]
        first, second = first[once], second[once]
        radius = radii[simulation.type_of(table.order[first], table.order[second])]
        for row in range(stretch.rows):
            x, dx = stretch.x[row].astype(np.float64), moved[row, 0].astype(np.float64)
            apart = np.stack(cell.displacement(x[:, first].T, x[:, second].T))
            r = np.sqrt(np.sum(apart * apart, axis=0))
            rate = along - np.sum(apart * (dx[:, second] - dx[:, first]), axis=0) / r
            with np.errstate(divide="ignore", invalid="ignore"):
                shift = -(radius - r) / rate
            for sign in nearest:
                ahead = shift[(shift * sign > 0) & np.isfinite(shift)] * sign
                if len(ahead):
                    nearest[sign] = min(nearest[sign], float(ahead.min()))
    return nearest


def _edge(
    problem: Problem,
    line: NumberLine,
    name: str,
    value: float,
    sign: int,
    ahead: float,
    reach: float,
    progress: Progress | None,
) -> DecisionEdge:
    side = "above" if sign > 0 else "below"
    before = len(line.known)
    end = reach * abs(value)

    def tell() -> None:
        if progress is not None:
            done = len(line.known) - before
            progress(done, max(done + 1, 40), f"{name}: boundary {side}")

    home = int(ordinal(np.array([value]))[0])
    own = line.digest(home)
    shift = 1.25 * ahead if np.isfinite(ahead) and ahead < end else _FIRST * abs(value)
    inside, beyond = home, home
    while beyond == home:
        shift = min(shift, end)
        place = int(ordinal(np.array([value + sign * shift]))[0])
        if place == home:
            place = home + sign
        tell()
        if line.digest(place) != own:
            beyond = place
        elif shift >= end:
            return DecisionEdge(side, len(line.known) - before)
        else:
            inside, shift = place, shift * _FACTOR
    while abs(beyond - inside) > 1:
        tell()
        middle = (inside + beyond) // 2
        if line.digest(middle) == own:
            inside = middle
        else:
            beyond = middle
    step, i, j = _first(line, inside, beyond)
    near, far = (line.value(place) for place in (inside, beyond))
    value_near, gradient_near = _gradients(problem, line.at(inside).simulation, name)
    value_far, gradient_far = _gradients(problem, line.at(beyond).simulation, name)
    runs = len(line.known) - before
    return DecisionEdge(
        side, runs, True, near, far, abs(near - value), step, i, j, value_near, value_far, gradient_near,
        gradient_far,
    )  # fmt: skip


def _first(line: NumberLine, inside: int, beyond: int) -> tuple[int, int, int]:
    """The first decision that differs: the pair that is nearest to its threshold on both sides."""
    found = line.boundary(inside, beyond)
    if found is None:
        raise NumericalError(f"{line.number.key} = {line.value(beyond)!r}: the run blew up")
    i, j = found.subject
    return found.step, i, j


def _gradients(problem: Problem, simulation: Simulation, name: str) -> tuple[float, dict[str, float]]:
    """Loss and derivatives by one parameter of another simulation."""
    there = Problem(simulation, problem.loss, problem.steps)
    tape = tape_of(there, True)
    found = {
        word: float(passed(there, [name], saltation=saltation, tape=tape).gradient[name])
        for word, saltation in (("symmetric", False), ("event-aware", True))
    }
    return tape.value, found
