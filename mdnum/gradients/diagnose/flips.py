"""Contribution of each flip to a gradient, and parameter values at which decisions change.

The contribution of a flip to a gradient is a product of two factors. The first factor is the derivative of
the loss with respect to the cutoff distance of this flip alone. The effect of later flips is included. The
second factor is the derivative of cutoff distance minus pair distance, at fixed decisions. The contributions
of single flips add up to that of all flips.

A decision boundary lies between two adjacent floats of a parameter. Pair decisions differ between the two
floats. Between two boundaries, decisions are constant. Loss and gradient are smooth. Gradients on both sides
show whether an optimizer step across a boundary is useful.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mdnum.errors import InputError, NumericalError
from mdnum.forks.boundaries import NumberLine
from mdnum.gradients import parameters
from mdnum.gradients.parameters import columns_of, directions
from mdnum.gradients.problem import Problem, Progress, in_phase
from mdnum.gradients.recorded import GUARD, MOST, ReversePass, joined, passed, tape_of
from mdnum.gradients.tangents import by_column, tangents
from mdnum.gradients.tape import listed
from mdnum.md.cell import HostCell
from mdnum.program import Number
from mdnum.rollout.program import MdProgram
from mdnum.systems.simulation import Simulation

SMOOTH, ENTERS, LEAVES = "smooth", "pair enters", "pair leaves"
#: Distance from the parameter within which a boundary is searched for, as a share of its value.
REACH = 0.01
#: First shift if no forecast is available, as a share of the parameter, and the factor by which it grows.
_FIRST, _FACTOR = 1e-12, 8.0


@dataclass(frozen=True)
class FlipTerms:
    """Contributions of all flips to each derivative, largest first.

    Columns are named by scalar parameters and single array entries, such as "potential.sigma[1]".
    """

    # a row for each flip: `step`, `i` < `j`, `entered`, `margin`, `bound` and `ambiguous` of the decision,
    # `radial_speed` (negative where the pair enters), `weight` (derivative of the loss by the cutoff of this
    # one crossing), `grazing` (slower than the guard and left out: its weight is what it would have been) and
    # `contribution.<number>`, which sum to event-aware minus symmetric
    table: dict[str, np.ndarray]
    # flips, grazing: how many
    flips: int
    grazing: int
    smooth: dict[str, float]  # the gradient with decisions held fixed, by number
    total: dict[str, float]  # with the flips
    share: dict[str, dict[str, float]]  # of the total, by number, then SMOOTH, ENTERS and LEAVES
    half: dict[str, int]  # number of flips, heaviest first, that have half of the weight of all, by number
    skipped: dict[str, int]  # number of entries of parameters that have too many of them for contributions


def flips(
    problem: Problem,
    names: Sequence[str],
    *,
    guard: float = GUARD,
    made: ReversePass | None = None,
    progress: Progress | None = None,
) -> FlipTerms:
    """Compute the contribution of each flip to a gradient. Sort flips by contribution.

    Args:
        problem: of a pair potential. names: parameters, full or short names.
        guard: radial speed below which a crossing grazes, as a share of the rms radial speed of a pair.
        made: the event-aware reverse pass, if already made; its guard is then used.

    Raises:
        InputError: a parameter does not exist, the potential is no pair potential, or all parameters have too
            many entries.

    Error: that of the event-aware gradient.
    """
    simulation = problem.simulation
    full = parameters.resolve(simulation, names)
    sizes = {name: int(np.prod(parameters.value(simulation, name).shape)) for name in full}
    skipped = {name: size for name, size in sizes.items() if size > MOST}
    kept = [name for name in full if name not in skipped]
    if not kept:
        raise InputError(
            f"the parameter {', '.join(full)} has {sizes[full[0]]} entries, too many to compute how "
            "much the flips contribute to each derivative",
            remedy="Give a scalar parameter",
        )
    if made is None:
        made = passed(problem, full, guard=guard, progress=progress)
    columns = columns_of(simulation, kept)
    numbers = [str(column) for column in columns]
    moved: list[np.ndarray] = []
    total: Any = None
    for part in tangents(made.tape, kept, guard=made.guard, progress=in_phase(progress, "tangents")):
        assert part.dr is not None and part.dr_cut is not None
        moved.append(part.dr_cut - part.dr)
        total = part.total
    met = made.crossings[::-1]
    weight, grazing, speed = (joined(met, name) for name in ("weight", "grazing", "speed"))
    names = ("step", "i", "j", "entered", "margin", "bound", "ambiguous")
    known = {name: joined(met, name, ledger=True) for name in names}
    each = np.where(grazing[:, None], 0.0, weight[:, None] * np.concatenate(moved))
    # the largest share of what flips add to any of the numbers, so that numbers in other units do not vanish
    sums = np.abs(each).sum(axis=0)
    order = np.argsort(-np.max(np.abs(each) / np.where(sums > 0, sums, 1), axis=1), kind="stable")
    table = {
        **known, **simulation.terms_of(joined(met, "kind")),
        "radial_speed": np.where(np.isinf(speed), 0.0, speed), "weight": weight, "grazing": grazing,
    }  # fmt: skip
    table |= {f"contribution.{number}": each[:, k] for k, number in enumerate(numbers)}
    entered = known["entered"]
    smooth = dict(zip(numbers, by_column(made.tape, total).tolist(), strict=True))
    # a scalar has the empty index
    whole = {str(one): float(np.asarray(made.gradient[one.name])[one.index]) for one in columns}
    share, half = {}, {}
    for k, number in enumerate(numbers):
        parts = (smooth[number], float(each[entered, k].sum()), float(each[~entered, k].sum()))
        size = whole[number] or float("nan")
        share[number] = dict(zip((SMOOTH, ENTERS, LEAVES), (part / size for part in parts), strict=True))
        heaviest = np.cumsum(np.sort(np.abs(each[:, k]))[::-1])
        half[number] = int(np.searchsorted(heaviest, 0.5 * heaviest[-1])) + 1 if heaviest[-1:].any() else 0
    return FlipTerms(
        {name: values[order] for name, values in table.items()},
        len(order), int(grazing.sum()), smooth, whole, share, half, skipped,
    )  # fmt: skip


@dataclass(frozen=True)
class DecisionEdge:
    """Nearest parameter value at which a decision changes, with gradients on both sides."""

    side: str  # "below" or "above"
    runs: int  # that the search took
    found: bool = False  # whether there is one within reach
    # inside, beyond: adjacent floats; the run at `inside` decides as the one asked about, that at `beyond`
    # does not
    inside: float = float("nan")
    beyond: float = float("nan")
    distance: float = float("nan")  # from the parameter's value to `inside`, in its units
    # step, i, j: the first decision that differs
    step: int = -1
    i: int = -1
    j: int = -1
    terms: str = ""  # whose decision it is, where a potential has several terms
    # value_inside, value_beyond: the loss on either side
    value_inside: float = float("nan")
    value_beyond: float = float("nan")
    # gradient_inside, gradient_beyond: derivative by this parameter, by method
    gradient_inside: dict[str, float] = field(default_factory=dict)
    gradient_beyond: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class DecisionEdges:
    """Nearest values below and above a parameter's value at which a decision changes."""

    name: str
    value: float
    below: DecisionEdge
    above: DecisionEdge


def edges(
    problem: Problem, name: str, *, reach: float = REACH, progress: Progress | None = None
) -> DecisionEdges:
    """Find the nearest decision boundaries of a parameter, below and above its value.

    Tangents predict the parameter shift at which a decision first changes. Runs near this shift are compared
    until two adjacent floats have different decisions.

    Args:
        problem: of a pair potential. name: a parameter of one entry.
        reach: search range, as a share of the parameter's value.

    Raises:
        InputError: a parameter does not exist, has several entries, or is 0. NumericalError: the run blew up.

    Error: none in a boundary. The absence of another boundary in between is as certain as the prediction:
    pairs of boundaries that cancel can be hidden between two runs with the same decisions.
    """
    (full,) = parameters.resolve(problem.simulation, [name])
    here = parameters.value(problem.simulation, full)
    if here.shape:
        raise InputError(
            f"decision boundaries are located by varying one number, but {full} has {here.size} entries",
            remedy="Give a scalar parameter",
        )
    value = float(here)
    if value == 0 or not 0 < reach < 1:
        raise InputError(
            f"the parameter {full} is {value:g} and reach is {reach:g}; expected a parameter other "
            "than 0, and a reach between 0 and 1"
        )
    program = MdProgram(problem.simulation)

    def at(q: float) -> MdProgram:
        return MdProgram(parameters.with_values(program.simulation, {full: q}))

    number = Number(full, value, "", at, True)
    line = NumberLine(program, number, problem.steps, lambda *_: 0.0)
    ahead = _forecast(problem, full, progress)
    below, above = (_edge(problem, line, value, sign, ahead[sign], reach, progress) for sign in (-1, 1))
    return DecisionEdges(full, value, below, above)


def _forecast(problem: Problem, name: str, progress: Progress | None) -> dict[int, float]:
    """Predict the smallest parameter shifts, up and down, at which a pair crosses r_cut."""
    if name == "box.scale":
        # the images move too, which these differences of positions leave out
        return {-1: np.inf, 1: np.inf}
    simulation = problem.simulation
    tape = tape_of(problem, True)
    cell, radii = HostCell(simulation.cell), np.asarray(simulation.decider.r_cut)
    nearest = {-1: np.inf, 1: np.inf}
    along = np.asarray(directions(simulation, columns_of(simulation, [name])).r_cut)[0]
    followed = tangents(tape, [name], states=True, progress=in_phase(progress, "tangents"))
    for part in followed:
        stretch, moved = part.stretch, part.x
        assert moved is not None
        first, second, kind = listed(simulation, stretch.table)
        radius = radii[kind]
        for row in range(stretch.rows):
            x, dx = stretch.x[row].astype(np.float64), moved[row, 0].astype(np.float64)
            apart = np.stack(cell.displacement(x[:, first].T, x[:, second].T))
            r = np.sqrt(np.sum(apart * apart, axis=0))
            rate = along[kind] - np.sum(apart * (dx[:, second] - dx[:, first]), axis=0) / r
            with np.errstate(divide="ignore", invalid="ignore"):
                shift = -(radius - r) / rate
            for sign in nearest:
                ahead = shift[(shift * sign > 0) & np.isfinite(shift)] * sign
                if len(ahead):
                    nearest[sign] = min(nearest[sign], float(ahead.min()))
    return nearest


def _edge(
    problem: Problem, line: NumberLine, value: float, sign: int, ahead: float, reach: float,
    progress: Progress | None,
) -> DecisionEdge:  # fmt: skip
    side, name = "above" if sign > 0 else "below", line.number.key
    before, end = len(line.known), reach * abs(value)

    def digest(place: int) -> str:
        if progress is not None:
            done = len(line.known) - before
            progress(done, max(done + 1, 40), f"{name}: boundary {side}")
        return line.digest(place)

    (home,) = line.places([value])
    own = digest(home)
    shift = 1.25 * ahead if np.isfinite(ahead) and ahead < end else _FIRST * abs(value)
    inside, beyond = home, home
    while beyond == home:
        shift = min(shift, end)
        (place,) = line.places([value + sign * shift])
        place = home + sign if place == home else place
        if digest(place) != own:
            beyond = place
        elif shift >= end:
            return DecisionEdge(side, len(line.known) - before)
        else:
            inside, shift = place, shift * _FACTOR
    while abs(beyond - inside) > 1:
        middle = (inside + beyond) // 2
        inside, beyond = (middle, beyond) if digest(middle) == own else (inside, middle)
    # the first decision that differs: of the pair that is nearest to its threshold on both sides
    found = line.boundary(inside, beyond)
    near, far = (line.value(place) for place in (inside, beyond))
    if found is None:
        raise NumericalError(f"the run with {name} = {far!r} blew up")
    i, j = found.subject
    value_near, gradient_near = _gradients(problem, line.at(inside).simulation, name)
    value_far, gradient_far = _gradients(problem, line.at(beyond).simulation, name)
    return DecisionEdge(
        side, len(line.known) - before, True, near, far, abs(near - value), found.step, i, j, found.terms,
        value_near, value_far, gradient_near, gradient_far,
    )  # fmt: skip


def _gradients(problem: Problem, simulation: Simulation, name: str) -> tuple[float, dict[str, float]]:
    """Return the loss and its derivative by two gradient methods."""
    there = Problem(simulation, problem.loss, problem.steps)
    tape = tape_of(there, True)
    found = {
        word: float(passed(there, [name], saltation=saltation, tape=tape).gradient[name])
        for word, saltation in (("symmetric", False), ("event-aware", True))
    }
    return tape.value, found
