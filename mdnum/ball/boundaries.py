"""Where along a parameter the decisions of a rollout change, to the last bit.

Between two boundaries a rollout is one program and its loss is smooth. At a boundary an iteration count or a
contact changes between two adjacent floats, and the loss and its gradient may jump.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from mdnum.ball.contacts import Projection
from mdnum.ball.problem import START, Problem, loss_of
from mdnum.ball.rollout import BallRun, first_difference
from mdnum.errors import InputError
from mdnum.precision.ulp import neighbor, ordinal


@dataclass(frozen=True)
class Side:
    """The program on one side of a boundary.

    Attributes:
        at: the parameter, as the float next to the boundary.
        loss, gradient: of the rollout there; the gradient is along the parameter, with decisions held.
        iterations: of the step whose decision changes (of its ball, where each has its own).
        contact: the contact decision of that step and ball.
        residual: at the stop decision that changes; NaN for a contact.
        margin: of the decision that changes: threshold minus residual, or minus the height.
    """

    at: float
    loss: float
    gradient: float
    iterations: int
    contact: bool
    residual: float
    margin: float


@dataclass(frozen=True)
class Boundary:
    """Two adjacent floats with different programs, and the decision that makes the difference.

    Attributes:
        below, above: the two sides; above.at is the float after below.at.
        channel: "stop" or "contact".
        step: of the first decision that differs, from 1.
        iteration: of the stop decision that differs; -1 for a contact.
        ball: whose decision it is; -1 where it is the batch's.
        evaluations: rollouts by the compiled program that it took, those of the annotation included.
    """

    below: Side
    above: Side
    channel: str
    step: int
    iteration: int
    ball: int
    evaluations: int

    @property
    def jump(self) -> float:
        """Loss above minus loss below."""
        return self.above.loss - self.below.loss

    @property
    def words(self) -> str:
        """The boundary in one sentence."""
        who = "" if self.ball < 0 else f" of ball {self.ball}"
        if self.channel == "contact":
            verb = "touches" if self.above.contact else "misses"
            what = f"ball {self.ball} {verb} the floor in step {self.step}"
        else:
            what = (
                f"the solver{who} in step {self.step} makes {self.above.iterations} iterations "
                f"instead of {self.below.iterations}"
            )
        return f"from {self.above.at!r} on {what}"


@dataclass(frozen=True)
class BoundaryMap:
    """Loss, gradient and programs along a parameter.

    Attributes:
        name: the parameter.
        at: the grid, shape (points,).
        loss, gradient: on the grid, from the vectorized program.
        program: on the grid, a number for each distinct sequence of decisions, in order of appearance.
        iterations: solver iterations of the whole rollout, over all balls, on the grid.
        boundaries: in the order of the parameter.
        evaluations: single rollouts made by bisection.
    """

    name: str
    at: Float[np.ndarray, "points"]
    loss: Float[np.ndarray, "points"]
    gradient: Float[np.ndarray, "points"]
    program: Int[np.ndarray, "points"]
    iterations: Int[np.ndarray, "points"]
    boundaries: tuple[Boundary, ...]
    evaluations: int


def boundaries(
    problem: Problem, name: str, lower: float, upper: float, *, points: int = 129, most: int = 64
) -> BoundaryMap:
    """Every change of program along a parameter, as far as a grid can tell, each to adjacent floats.

    The grid is evaluated at once by a vectorized program. Bisection is by a single compiled program, the one
    that simulates, because a vectorized one may put a boundary some floats elsewhere. A cell whose ends have
    the same decisions may hide two boundaries that cancel; a finer grid finds them.

    Args:
        name: a parameter, or "y0" or "v0" (which then move the whole batch to that value).
        lower, upper: the interval; both belong to it.
        points: of the grid.
        most: give up beyond this many boundaries.

    Raises:
        InputError: an empty interval, or more boundaries than `most`.

    Error: none in a boundary: the decisions on its two sides differ and the sides are adjacent floats.
    """
    if not lower < upper or points < 2:
        raise InputError(
            f"there is nothing between {lower!r} and {upper!r} on {points} points",
            remedy="Give lower < upper and at least 2 points.",
        )
    line = _Line(problem, name)
    grid = np.unique(np.linspace(lower, upper, points).astype(line.dtype))
    loss, slope, contact, iterations = line.grid(grid)
    keys = [contact[row].tobytes() + iterations[row].tobytes() for row in range(len(grid))]
    known: dict[bytes, int] = {}
    program = np.array([known.setdefault(key, len(known)) for key in keys])
    found: list[Boundary] = []
    places = ordinal(grid)
    for row in np.flatnonzero(program[1:] != program[:-1]):
        spent = line.evaluations
        for low, high in line.edges(int(places[row]), int(places[row + 1])):
            if len(found) == most:
                raise InputError(
                    f"more than {most} boundaries between {lower!r} and {upper!r}",
                    remedy="Look at a shorter interval, or raise `most`.",
                )
            found.append(line.annotate(low, high, spent))
            spent = line.evaluations
    total = iterations.reshape(len(grid), -1).sum(axis=1)
    return BoundaryMap(
        name, grid.astype(np.float64), loss, slope, program, total, tuple(found), line.evaluations
    )


class _Line:
    """Rollouts of one problem along one parameter, addressed by the ordinal of a float."""

    def __init__(self, problem: Problem, name: str):
        problem.values([name])
        self.problem, self.name = problem, name
        if name in START:
            role = "state"
        else:
            role = "decision" if name in ("tol", "enter") else "arithmetic"
        self.dtype = problem.world.policy.dtype(role)
        self.balls = np.atleast_1d(np.asarray(problem.y0)).shape
        self.evaluations = 0
        self._runs: dict[int, BallRun] = {}

    def value(self, place: int) -> Any:
        """The float of an ordinal."""
        return neighbor(np.zeros((), self.dtype), place, self.dtype)

    def at(self, place: int) -> Problem:
        """The problem at a float."""
        value = self.value(place)
        if self.name in START:
            return replace(self.problem, **{self.name: np.full(self.balls, value)})
        return self.problem.with_values({self.name: value})

    def run(self, place: int) -> BallRun:
        """The rollout at a float, by the single compiled program."""
        if place not in self._runs:
            self.evaluations += 1
            self._runs[place] = self.at(place).run(keep=False)
        return self._runs[place]

    def key(self, place: int) -> bytes:
        """Everything that the rollout at a float decided."""
        run = self.run(place)
        return run.contact.tobytes() + run.iterations.tobytes()

    def edges(self, low: int, high: int) -> list[tuple[int, int]]:
        """Pairs of adjacent ordinals between two whose programs differ, every one that bisection meets."""
        if self.key(low) == self.key(high):
            return []
        if high - low == 1:
            return [(low, high)]
        middle = (low + high) // 2
        return self.edges(low, middle) + self.edges(middle, high)

    def grid(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Loss, gradient, contacts and iterations at many floats by one vectorized program."""
        problem = self.problem
        world, steps, loss = problem.world, problem.steps, problem.loss
        y0, v0 = (np.asarray(getattr(problem, start), np.float64) for start in START)
        y0 = np.broadcast_to(y0, self.balls).copy()
        out = _grid(jnp.asarray(values), world, jnp.asarray(y0), jnp.asarray(v0), self.name, steps, loss)
        return tuple(np.asarray(part) for part in out)  # type: ignore[return-value]

    def annotate(self, low: int, high: int, spent: int) -> Boundary:
        """What differs between two adjacent floats."""
        problems = [self.at(place) for place in (low, high)]
        self.evaluations += 2
        runs = [problem.run(history=True) for problem in problems]
        first = first_difference(*runs)
        assert first.fork is not None  # their keys differ
        row, stop = first.fork - 1, first.channel == "stop"
        counts = [_of(run.iterations[row], first.ball) for run in runs]
        iteration = min(counts) if stop else -1
        sides = []
        for problem, run, count, place, margin in zip(
            problems, runs, counts, (low, high), first.margins, strict=True
        ):
            # told what the run decided, so that loss and gradient belong to this side for certain
            loss, slope = problem.value_and_grad([self.name], jax.tree.map(jnp.asarray, run.told()))
            residual, margin = _stop(run, row, first.ball, iteration, margin) if stop else (np.nan, margin)
            touches = bool(run.contact[row, max(first.ball, 0)])
            gradient = slope[self.name]
            sides.append(
                Side(float(self.value(place)), loss, gradient, count, touches, residual, float(margin))
            )
        below, above = sides
        spent = self.evaluations - spent
        return Boundary(below, above, first.channel, first.fork, iteration, first.ball, spent)


def _of(values: Any, ball: int) -> int:
    values = np.asarray(values)
    return int(values[ball] if values.ndim else values)


def _stop(run: BallRun, row: int, ball: int, iteration: int, margin: float) -> tuple[float, float]:
    """Residual and margin at the stop decision of an iteration."""
    if run.history is not None and ball < 0 and isinstance(run.world.contact, Projection):
        residual = float(run.history[row, iteration])
        rule = run.world.contact.stop
        first = jnp.asarray(run.history[row, 0])
        threshold = float(rule.threshold(first, jnp.asarray(iteration)))
        return residual, threshold - residual
    ended, of = float(_pick(run.residual[row], ball)), float(_pick(run.margin[row], ball))
    # residual and margin add up to the threshold
    return ended + of - margin, margin


def _pick(values: Any, ball: int) -> Any:
    values = np.asarray(values)
    return values[ball] if values.ndim else values


@eqx.filter_jit
def _grid(values, world, y0, v0, name, steps, loss):
    def one(value):
        def scalar(value):
            if name in START:
                filled = jnp.broadcast_to(value, y0.shape)
                start = (filled, v0) if name == "y0" else (y0, filled)
                return loss_of(world, *start, steps, loss)
            return loss_of(world.with_values({name: value}), y0, v0, steps, loss)

        cost, slope = jax.value_and_grad(scalar)(value)
        given = world if name in START else world.with_values({name: value})
        start = {"y0": y0, "v0": v0} | ({name: value} if name in START else {})
        state = given.start(jnp.broadcast_to(start["y0"], y0.shape), start["v0"])

        def step(state, _):
            after, record = given.advance(state)
            return after, (record.contact, record.solve.iterations)

        _, (contact, iterations) = lax.scan(step, state, None, length=steps)
        return cost, slope, contact, iterations

    return jax.vmap(one)(values)
