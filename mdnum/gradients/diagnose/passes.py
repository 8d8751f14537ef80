"""One reverse pass that several instruments watch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mdnum.gradients import parameters
from mdnum.gradients.adjoint import Trace, reverse
from mdnum.gradients.base import Problem, Progress
from mdnum.gradients.crossings import Crossings
from mdnum.gradients.parameters import Cotangents
from mdnum.gradients.symmetric import GUARD, in_phase, radial_speed, wanted
from mdnum.gradients.tape import Stretch, Tape

#: Called with every stretch of the reverse pass, last first, and what was carried at its steps.
Watch = Callable[[Stretch, Trace], None]


@dataclass(frozen=True)
class Passed:
    """A reverse pass that has been made.

    Attributes:
        tape: the run.
        parts: derivatives by all that it is made of.
        crossings: of every stretch with their weights, last stretch first; empty without saltation.
        gradient: by full name.
        guard: radial speed below which a crossing was left out, length per internal time.
    """

    tape: Tape
    parts: Cotangents
    crossings: list[Crossings]
    gradient: dict[str, Float[np.ndarray, "..."]]
    guard: float


def passed(
    problem: Problem,
    names: Sequence[str],
    *,
    saltation: bool = True,
    guard: float = GUARD,
    budget: int = 2**29,
    watches: Sequence[Watch] = (),
    tape: Tape | None = None,
    progress: Progress | None = None,
) -> Passed:
    """Run a problem and its reverse pass.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: full names of the parameters.
        saltation: whether flips count.
        guard: as a share of the rms radial speed of a pair.
        budget: bytes of the recorded run that are kept.
        watches: see `Watch`.
        tape: the run, where it has been made (with flips, if saltation is asked for).
        progress: called with the steps done, all steps, and a phase in words.

    Raises:
        InputError: no pair potential. NumericalError: the run blew up.
    """

    def watch(stretch: Stretch, trace: Trace) -> None:
        for one in watches:
            one(stretch, trace)

    simulation = problem.simulation
    if tape is None:
        tape = Tape(
            simulation,
            problem.loss,
            problem.steps,
            flips=saltation,
            budget=budget,
            progress=in_phase(progress, "run"),
        )
    speed = guard * radial_speed(simulation)
    parts, found = reverse(
        tape,
        wanted=wanted(names),
        saltation=saltation,
        guard=speed,
        progress=in_phase(progress, "reverse pass"),
        watch=watch if watches else None,
    )
    gradient = {name: parameters.gradient(simulation, parts, name) for name in names}
    return Passed(tape, parts, found, gradient, speed)
