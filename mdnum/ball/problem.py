"""A bouncing-ball simulation with a loss, as a differentiable function of named parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from mdnum.ball.rollout import BallRun, simulate
from mdnum.ball.step import BallDecisions, BallRecord, BallState
from mdnum.ball.world import World
from mdnum.numerics.formats import check_scale, scaled_gradient

START = ("y0", "v0")  # parameters of the start rather than of the world; a value moves the whole batch


class BallLoss(Protocol):
    """Protocol of a ball's loss: a sum over steps and a final term."""

    def step(self, state: BallState, record: BallRecord, dtype: Any) -> Float[Array, ""]:
        """Return the contribution of one time step to the loss."""
        ...

    def end(self, state: BallState, steps: int, total: Float[Array, ""]) -> Float[Array, ""]:
        """Compute the loss from the sum over time steps and the final state."""
        ...


class FinalHeight(eqx.Module):
    """Loss: the mean final height (m), or the mean squared distance from a target (m²)."""

    target: float | None = eqx.field(static=True, default=None)

    def step(self, state, record, dtype):
        """Return zero, because only the final state contributes to the loss."""
        return jnp.zeros((), dtype)

    def end(self, state, steps, total):
        """Return the mean final height, or the mean squared distance from the target."""
        y = state.y.astype(total.dtype)
        if self.target is None:
            return jnp.mean(y, dtype=total.dtype)
        return jnp.mean((y - self.target) ** 2, dtype=total.dtype)


class MeanHeight(eqx.Module):
    """Loss: the height (m), averaged over balls and time steps."""

    def step(self, state, record, dtype):
        """Return the height averaged over all balls."""
        return jnp.mean(state.y.astype(dtype), dtype=dtype)

    def end(self, state, steps, total):
        """Return the sum over steps divided by the number of steps."""
        return total / max(steps, 1)


class ResidualPenetration(eqx.Module):
    """Loss: the penetration that remains after each step, summed over steps."""

    power: int = eqx.field(static=True, default=2)  # 2 for squares, m²; 1 for the penetration itself, m

    def step(self, state, record, dtype):
        """Return the mean of |penetration|^power over all balls."""
        left = record.left.astype(dtype)
        return jnp.mean(left if self.power == 1 else left**self.power, dtype=dtype)

    def end(self, state, steps, total):
        """Return the remaining penetration, summed over steps."""
        return total


@dataclass(frozen=True)
class BallProblem:
    """A differentiable bouncing-ball problem."""

    world: World  # the program
    y0: Any  # heights at the start, m, a number or shape (balls,)
    v0: Any = 0.0  # velocities at the start, m/s, a number or shape (balls,)
    steps: int = 100  # steps to make
    loss: BallLoss = field(default_factory=FinalHeight)  # of the rollout

    def with_values(self, values: Mapping[str, Any]) -> BallProblem:
        """Return the problem with other values of parameters, initial heights or initial velocities."""
        start = {name: values[name] for name in START if name in values}
        rest = {name: value for name, value in values.items() if name not in START}
        return replace(self, world=self.world.with_values(rest), **start)

    def values(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the current values of named parameters.

        Raises:
            InputError: a parameter does not exist.
        """
        return {
            name: jnp.asarray(getattr(self, name)) if name in START else jnp.asarray(self.world.value(name))
            for name in names
        }

    def value(
        self, overrides: Mapping[str, Any] | None = None, imposed: BallDecisions | None = None
    ) -> float:
        """Compute the loss. Other parameter values do not need another compilation.

        Args:
            imposed: decisions of every step (first axis: steps) that replace the model's own decisions.
        """
        problem = self.with_values(overrides or {})
        return float(_loss(problem.bare, problem.world, *problem.start_arrays, imposed))

    def origin(self, names: Sequence[str]) -> dict[str, Array]:
        """Return the arguments of `loss_at`: parameter values, and 0 for y0 and v0.

        Raises:
            InputError: a parameter does not exist.
        """
        return {
            name: jnp.zeros((), jnp.float64) if name in START else jnp.asarray(self.world.value(name))
            for name in names
        }

    def value_and_grad(
        self, names: Sequence[str], imposed: BallDecisions | None = None, scale: float = 1.0
    ) -> tuple[float, dict[str, float]]:
        """Compute the loss and its derivatives through all solver iterations.

        Args:
            names: names of parameters; y0 and v0 are common displacements of all balls.
            imposed: decisions of every step (first axis: steps) that replace the model's own decisions.
            scale: factor of the loss in the reverse pass (`mdnum.numerics.formats`), a power of two.

            Error: rounding errors of the reverse pass in the dtypes of the policy.
        """
        check_scale(scale)
        made = _value_and_grad(
            self.bare, self.origin(names), self.world, *self.start_arrays, imposed, jnp.asarray(scale)
        )
        return float(made.value), {name: float(made.gradient[name]) for name in names}

    def run(self, **options: Any) -> BallRun:
        """Run the simulation of the problem; for options see `simulate`."""
        return simulate(self.world, self.world.start(self.y0, self.v0), self.steps, **options)

    @property
    def bare(self) -> tuple[int, BallLoss]:
        """The number of time steps and the loss of the problem."""
        return self.steps, self.loss

    @property
    def start_arrays(self) -> tuple[Array, Array]:
        """Initial heights, shape (balls,), and velocities, shape () or (balls,), as floating-point arrays."""
        y = jnp.atleast_1d(jnp.asarray(self.y0))
        y = y if jnp.issubdtype(y.dtype, jnp.floating) else y.astype(jnp.float64)
        return y, jnp.asarray(self.v0).astype(y.dtype)


def loss_of(
    world: World,
    y0: Float[Array, "balls"],
    v0: Float[Array, "..."],
    steps: int,
    loss: BallLoss,
    imposed: BallDecisions | None = None,
) -> Float[Array, ""]:
    """Compute the loss of a simulation as a differentiable function.

    Args:
        imposed: decisions of every step (first axis: steps) to impose; None for the model's own decisions.

    Returns:
        the loss in the dtype of its role.
    """
    dtype = world.policy.dtype("loss")

    def step(carry, given):
        state, total = carry
        state, record = world.advance(state, imposed=given)
        return (state, total + loss.step(state, record, dtype)), None

    start = (world.start(y0, v0), jnp.zeros((), dtype))
    (state, total), _ = lax.scan(step, start, imposed, length=steps)
    return loss.end(state, steps, total)


def loss_at(bare, world, y0, v0, values, imposed):
    """Compute the loss for given values of the parameters.

    Args:
        bare: number of steps, and loss.
        values: parameter values by name; for y0 and v0, displacements of the start (`BallProblem.origin`).
    """
    world = world.with_values({name: value for name, value in values.items() if name not in START})
    y0, v0 = (
        old + jnp.asarray(values[name]).astype(old.dtype) if name in values else old
        for name, old in zip(START, (y0, v0), strict=True)
    )
    return loss_of(world, y0, v0, *bare, imposed=imposed)


@eqx.filter_jit
def _loss(bare, world, y0, v0, imposed):
    return loss_of(world, y0, v0, *bare, imposed=imposed)


@eqx.filter_jit
def _value_and_grad(bare, values, world, y0, v0, imposed, scale):
    return scaled_gradient(lambda given: loss_at(bare, world, y0, v0, given, imposed), scale, values)


def arrive(world: World, y0: Float[Array, "balls"], steps: int, name: str) -> tuple[Array, Array]:
    """Compute final heights and their derivatives with respect to one parameter.

    The compiled function is used for any time step and number of steps.
    """
    return _arrive(world, y0, jnp.asarray(steps), name)


@eqx.filter_jit
def _arrive(world: World, y0: Array, steps: Array, name: str) -> tuple[Array, Array]:
    def run(value):
        here = world if name in ("y0", "v0") else world.with_values({name: value})
        start = here.start(y0 + value if name == "y0" else y0, value if name == "v0" else 0.0)
        return lax.fori_loop(0, steps, lambda _, state: here.advance(state)[0], start).y

    value = jnp.zeros(()) if name in ("y0", "v0") else jnp.asarray(world.value(name))
    return jax.jvp(run, (value,), (jnp.ones_like(value),))
