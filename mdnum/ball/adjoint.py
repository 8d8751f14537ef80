"""The derivative of a loss by the state of every step: where a backward pass grows, and where it overflows.

A rollout can look fine while the derivative through it does not. The derivative by a parameter is a sum over
steps of what each passes back; this is that sum before it is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from mdnum.ball.problem import Problem


@dataclass(frozen=True)
class Profile:
    """Derivatives of a loss by the state ahead of each step.

    Attributes:
        value: the loss.
        by_height: dL/dy_t for t = 0 to steps - 1, 1/m times the loss's unit, shape (steps, balls).
        by_velocity: dL/dv_t, s/m times the loss's unit, shape (steps, balls).
    """

    value: float
    by_height: Float[np.ndarray, "steps balls"]
    by_velocity: Float[np.ndarray, "steps balls"]

    @cached_property
    def size(self) -> Float[np.ndarray, "steps"]:
        """Largest |derivative| by any ball's height or velocity, by step; not finite where one is not."""
        both = np.concatenate([np.abs(self.by_height), np.abs(self.by_velocity)], axis=1)
        return np.max(both, axis=1)

    @property
    def lost_at(self) -> int | None:
        """The last step whose derivative is not finite, which the backward pass meets first; None if none.

        From there back to step 0 nothing can be trusted.
        """
        bad = np.flatnonzero(~np.isfinite(self.size))
        return int(bad[-1]) if len(bad) else None

    @property
    def growth(self) -> float:
        """Factor by which the derivative grows from the end of the rollout to its start."""
        return float(self.size[0] / self.size[-1])


def profile(problem: Problem) -> Profile:
    """Differentiate a rollout by the state of every step, through the iterations that ran.

    Use it where a gradient is large, infinite or not a number: the steps at which the profile jumps are the
    contacts that made it so. What velocity Verlet carries from one step to the next is held fixed.

    Args:
        problem: a rollout with a loss; memory grows with steps times balls.

    Error: rounding of the reverse pass in the dtypes of the policy.
    """
    y, v = problem._start()
    state = problem.world.start(y, v)
    zeros = jnp.zeros((problem.steps, state.y.shape[0]), state.y.dtype)
    value, (by_height, by_velocity) = _profile((zeros, zeros), problem.world, state, problem.loss)
    return Profile(float(value), *(np.asarray(x, np.float64) for x in (by_height, by_velocity)))


@eqx.filter_jit
def _profile(shifts, world, state, loss):
    dtype = world.policy.dtype("loss")

    def total(shifts):
        def step(carry, shift):
            state, sum_ = carry
            dy, dv = shift
            state, record = world.advance(state._replace(y=state.y + dy, v=state.v + dv))
            return (state, sum_ + loss.step(state, record, dtype)), None

        (end, sum_), _ = lax.scan(step, (state, jnp.zeros((), dtype)), shifts)
        return loss.end(end, shifts[0].shape[0], sum_)

    return jax.value_and_grad(total)(shifts)
