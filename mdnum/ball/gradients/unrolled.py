"""Derivatives of the program that ran: through its iterations, or with every decision pinned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from mdnum.ball.gradients.base import Gradient, differentiate, evaluate, origin, start_of, used
from mdnum.ball.problem import START, Problem
from mdnum.ball.rollout import BallRun
from mdnum.ball.state import Decisions
from mdnum.numerics.scaling import check_scale


@dataclass(frozen=True)
class Unrolled:
    """The derivative of the operations that ran, iteration by iteration.

    Attributes:
        loss_scale: the reverse pass starts with it instead of 1 and the derivative is divided by it, so that
            a narrow dtype does not lose it below its smallest number (`mdnum.numerics.scaling`); a power of
            two.
    """

    loss_scale: float = 1.0

    name = "unrolled"
    says = "The derivative of the iterations that ran; decisions are held, a solver's tolerance is in it."

    def __call__(self, problem: Problem, names: Sequence[str], run: BallRun | None = None) -> Gradient:
        """The derivative, by reverse mode.

        Args:
            run: of this problem, where there already is one.

        Error: rounding of the reverse pass in the dtypes of the policy.
        """
        run = problem.run(keep=False) if run is None else run
        value, slopes, marks = scaled(problem, names, None, self.loss_scale)
        depends, why = used(problem, names, slopes, run, marks)
        details = {"iterations": int(run.iterations.sum()), "loss_scale": self.loss_scale}
        return Gradient(self.name, self.says, value, slopes, depends, why, details)


@dataclass(frozen=True)
class Frozen:
    """The derivative of the program whose decisions and iteration counts are told from a recording.

    The pinned program has no branches left, so finite differences of it exist; in float64 they are taken as
    a check.

    Attributes:
        check: whether to take them.
    """

    check: bool = True

    name = "frozen"
    says = "The derivative of a program without branches, told the decisions and counts of a recorded run."

    def __call__(self, problem: Problem, names: Sequence[str]) -> Gradient:
        """The derivative, by reverse mode, with central differences of the pinned program beside it.

        Error: of the derivative, rounding; of the differences, about u^(2/3) relative.
        """
        run = problem.run(keep=False)
        told = run.told()
        told = type(told)(jnp.asarray(told.contact), jnp.asarray(told.iterations))
        value, slopes, marks = scaled(problem, names, told)
        details: dict = {"decisions": int(run.contact.size), "iterations": int(run.iterations.sum())}
        if self.check and problem.world.policy.arithmetic == "float64":
            details["finite_difference"] = pinned_differences(problem, names, told)
        depends, why = used(problem, names, slopes, run, marks)
        return Gradient(self.name, self.says, value, slopes, depends, why, details)


class Scaled(NamedTuple):
    """A loss, its derivative by name, and whether the run used each name."""

    value: float
    slopes: dict[str, float]
    marks: np.ndarray


def scaled(
    problem: Problem, names: Sequence[str], told: Decisions | None = None, scale: float = 1.0
) -> Scaled:
    """Loss and reverse-mode derivative under loss scaling.

    Args:
        told: decisions to act on, or None.
        scale: a power of two.

    Raises:
        InputError: it is not.
    """
    values, start = origin(problem, names), start_of(problem)
    check_scale(scale)
    factor = jnp.asarray(scale, jnp.float64)
    made, marks = differentiate(
        values, problem.world, *start, told, problem.steps, problem.loss, tuple(names), factor
    )
    slopes = {name: float(made.gradient[name]) for name in names}
    return Scaled(float(made.value), slopes, np.asarray(marks))


def pinned_differences(problem: Problem, names: Sequence[str], told) -> dict[str, float]:
    """Central differences of the loss with all decisions told.

    Error: about u^(2/3), relative to the loss over the size of the parameter.
    """
    at, start = origin(problem, names), start_of(problem)
    found = {}
    for name in names:
        size = float(np.max(np.abs(getattr(problem, name)))) if name in START else abs(float(at[name]))
        width = 6e-6 * (size or 1.0)

        def loss(shift: float, name: str = name) -> float:
            values = at | {name: at[name] + shift}
            return float(evaluate(values, problem.world, *start, told, problem.steps, problem.loss))

        found[name] = (loss(width) - loss(-width)) / (2 * width)
    return found
