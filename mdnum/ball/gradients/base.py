"""What a derivative of a rollout is asked for and answered with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mdnum.ball.contacts import Projection
from mdnum.ball.gradients.dependence import dependence, follow
from mdnum.ball.problem import START, Loss, Problem, loss_of
from mdnum.ball.rollout import BallRun
from mdnum.ball.state import Decisions
from mdnum.ball.world import World
from mdnum.precision.scaling import DynamicScale, ScaleState


@dataclass(frozen=True)
class Gradient:
    """A derivative of a loss, and which derivative it is.

    Attributes:
        method: name of the method.
        says: which derivative this is, one sentence.
        value: the loss (of the program that was differentiated).
        gradient: derivative by name of the parameter; a batch moves as a whole along y0 and v0.
        depends: whether the branches and iterations that ran used the parameter on the way to the loss.
        why: the same in words.
        details: plain values that belong to the method: tolerances, counts, standard errors.
    """

    method: str
    says: str
    value: float
    gradient: dict[str, float]
    depends: dict[str, bool]
    why: dict[str, str] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)


class Method(Protocol):
    """A way to differentiate a rollout.

    Attributes:
        name: as in system files.
        says: which derivative it gives, one sentence.
    """

    @property
    def name(self) -> str:
        """As in system files."""
        ...

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        ...

    def __call__(self, problem: Problem, names: Sequence[str]) -> Gradient:
        """The derivative of the problem's loss by the named parameters.

        Raises:
            InputError: this derivative does not exist for this world, or there is no such parameter.
        """
        ...


def origin(problem: Problem, names: Sequence[str]) -> dict[str, jax.Array]:
    """Where a problem is, for `moved_loss`: parameters by value, the start by how far it is moved (0)."""
    problem.values(names)
    dtype = problem.world.policy.dtype("arithmetic")
    return {
        name: jnp.zeros((), np.float64)
        if name in START
        else jnp.asarray(problem.world.value(name)).astype(np.float64 if name in ("tol", "enter") else dtype)
        for name in names
    }


def moved_loss(
    values: Mapping[str, Any],
    world: World,
    y0: jax.Array,
    v0: jax.Array,
    told: Decisions | None,
    steps: int,
    loss: Loss,
) -> jax.Array:
    """The loss with parameters set and the start moved, everything an argument, so that no fence is folded.

    Args:
        values: as from `origin`.
        told: decisions of every step, or None for the world's own.
    """
    rest = {name: value for name, value in values.items() if name not in START}
    y, v = (
        start + jnp.asarray(values[name]).astype(start.dtype) if name in values else start
        for name, start in zip(START, (y0, v0), strict=True)
    )
    return loss_of(world.with_values(rest), y, v, steps, loss, told)


def start_of(problem: Problem) -> tuple[jax.Array, jax.Array]:
    """Heights and velocities at the start as floating arrays, shapes (balls,) and () or (balls,)."""
    y = jnp.atleast_1d(jnp.asarray(problem.y0))
    y = y if jnp.issubdtype(y.dtype, jnp.floating) else y.astype(jnp.float64)
    return y, jnp.asarray(problem.v0).astype(y.dtype)


class _Rollout(eqx.Module):
    """`moved_loss` of so many steps: equal for equal problems, so that it is compiled once."""

    steps: int = eqx.field(static=True)
    loss: Loss

    def __call__(self, values, world, y0, v0, told):
        return moved_loss(values, world, y0, v0, told, self.steps, self.loss)


@eqx.filter_jit
def evaluate(values, world, y0, v0, told, steps, loss):
    """`moved_loss`, compiled."""
    return moved_loss(values, world, y0, v0, told, steps, loss)


@eqx.filter_jit
def differentiate(values, world, y0, v0, told, steps, loss, names, scale):
    """Loss and reverse-mode derivative under loss scaling, and what the run used, as one compiled program."""
    function, rest = _Rollout(steps, loss), (world, y0, v0, told)
    state = ScaleState(scale, *(jnp.zeros((), jnp.int32),) * 2)
    # of the dynamic scale, because its factor is an argument of the program and no constant
    made, _ = DynamicScale().value_and_grad(state, lambda values: function(values, *rest), values)
    return made, follow(function, values, rest, names)


def used(
    problem: Problem,
    names: Sequence[str],
    slopes: Mapping[str, float],
    run: BallRun | None = None,
    marks: Any = None,
) -> tuple[dict[str, bool], dict[str, str]]:
    """Whether the run used each parameter on the way to the loss, and the answer in words.

    Args:
        slopes: derivatives already known.
        run: of this problem, made here when None.
        marks: what `follow` said of the names, where it was asked already.
    """
    run = problem.run(keep=False) if run is None else run
    given = (problem.world, *start_of(problem), None)
    function = _Rollout(problem.steps, problem.loss)
    answers = dependence(
        function,
        origin(problem, names),
        names,
        given,
        gradient=slopes,
        marks=marks,
        why_unused=_why(problem.world, run),
    )
    return (
        {name: answer.used for name, answer in answers.items()},
        {name: answer.says for name, answer in answers.items()},
    )


def _why(world: World, run: BallRun) -> str:
    if not run.contact.any():
        return "no ball touched the floor, and nothing else used {name}"
    if isinstance(world.contact, Projection) and not run.iterations.any():
        return "the loop ended before {name} was used"
    return "nothing that ran used {name}"
