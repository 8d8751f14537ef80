"""What a step of the ball is made from, what it decides, and what it leaves on record."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int


class BallState(NamedTuple):
    """A batch of balls between two steps.

    Attributes:
        step: number of steps made.
        y: heights above the floor, m, shape (balls,).
        v: velocities, upward positive, m/s, shape (balls,).
        a: accelerations that velocity Verlet carries from one step to the next, m/s², shape (balls,).
        touching: the contact decision of the step before, shape (balls,); what hysteresis looks back to.
    """

    step: Int[Array, ""]
    y: Float[Array, "balls"]
    v: Float[Array, "balls"]
    a: Float[Array, "balls"]
    touching: Bool[Array, "balls"]


class BallDecisions(NamedTuple):
    """Everything that a step decides; or what is imposed on a step, in part or in whole.

    Attributes:
        contact: whether each ball is in contact, shape (balls,). Integers may be imposed instead: 0 or 1,
            and a negative number where the step is to decide by itself.
        iterations: iterations of the step's solver, shape () where one rule stops it for all balls,
            (balls,) where each ball has its own; impacts located in the step for an event-located one. A
            negative number, imposed, leaves it to the step.
    """

    contact: Bool[Array, "balls"] | Int[Array, "balls"]
    iterations: Int[Array, "..."]


class Reason(IntEnum):
    """What ended the solver of a step."""

    NONE = 0
    TOLERANCE = 1
    CAP = 2
    FIXED = 3
    NOT_FINITE = 4
    REST = 5

    @property
    def word(self) -> str:
        """As people read it."""
        return self.name.lower().replace("_", " ")


class Solve(NamedTuple):
    """The record of one iterative solve; shape () where one rule stops all balls, else (balls,).

    Attributes:
        iterations: how often it went on.
        reason: a `Reason`.
        residual: the residual at the last decision.
        margin: threshold minus residual there: positive where the residual was low enough to stop.
        before: the margin of the decision before, which was to go on; -inf where there was none.
        history: residual at every decision, NaN where none was made, shape (max_iter + 1,), or (0,) unless
            it was asked for; the largest over the balls where each ball has its own.
    """

    iterations: Int[Array, "..."]
    reason: Int[Array, "..."]
    residual: Float[Array, "..."]
    margin: Float[Array, "..."]
    before: Float[Array, "..."]
    history: Float[Array, "decisions"]


class BallRecord(NamedTuple):
    """What a step leaves.

    Attributes:
        height: what the contact decision compared with zero, m, shape (balls,).
        contact: the decision, shape (balls,).
        left: penetration that the contact model left, m, shape (balls,); carries derivatives.
        solve: of the step's solver.
    """

    height: Float[Array, "balls"]
    contact: Bool[Array, "balls"]
    left: Float[Array, "balls"]
    solve: Solve

    @property
    def decisions(self) -> BallDecisions:
        """What the step decided, to be imposed on another."""
        return BallDecisions(self.contact, self.solve.iterations)
