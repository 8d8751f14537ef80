"""The contract of a contact model: from a state and a decider to the next state and its record."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from jaxtyping import Array, Bool, Int

from mdnum.ball.integrators import Balls, Integrator, Rounding
from mdnum.ball.state import Record
from mdnum.precision.policy import RolePrecision


class Motion(NamedTuple):
    """What a contact model is given for one step.

    Attributes:
        y, v, carried: height, velocity and the acceleration that velocity Verlet carries, in the dtype of
            arithmetic.
        free: acceleration without contact (control minus gravity), shape (balls,).
        judge: the contact decision at a height: the world's own, or what the step was told.
        told: iterations the step was told to make, or None.
        integrator, policy, rounding: of the world.
        history: whether solvers keep the residual of every decision.
    """

    y: Balls
    v: Balls
    carried: Balls
    free: Balls
    judge: Callable[[Balls], Bool[Array, "balls"]]
    told: Int[Array, "..."] | None
    integrator: Integrator
    policy: RolePrecision
    rounding: Rounding
    history: bool


class Moved(NamedTuple):
    """The next height, velocity and carried acceleration, and the record of how they came about."""

    y: Balls
    v: Balls
    a: Balls
    record: Record


class Contact(Protocol):
    """What happens at the floor."""

    def move(self, motion: Motion) -> Moved:
        """One step."""
        ...

    def acceleration(
        self, y: Balls, v: Balls, free: Balls, contact: Bool[Array, "balls"], r: Rounding
    ) -> Balls:
        """Acceleration of a state, for schemes that carry it."""
        ...
