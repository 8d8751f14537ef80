"""What a rollout is judged by: a scalar of the trajectory, added up step by step."""

from __future__ import annotations

from typing import Any, Protocol

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mdnum.ball.state import BallState, Record


class Loss(Protocol):
    """A sum over steps and a term of the end; both shape (), in the dtype they are given."""

    def step(self, state: BallState, record: Record, dtype: Any) -> Float[Array, ""]:
        """What the step that made this state adds."""
        ...

    def end(self, state: BallState, steps: int, total: Float[Array, ""]) -> Float[Array, ""]:
        """The loss, from the sum over steps and the last state."""
        ...


class FinalHeight(eqx.Module):
    """Mean height at the end, m; with a target the mean squared distance to it, m²."""

    target: float | None = eqx.field(static=True, default=None)

    def step(self, state, record, dtype):
        """Nothing."""
        return jnp.zeros((), dtype)

    def end(self, state, steps, total):
        """The mean over the batch."""
        y = state.y.astype(total.dtype)
        if self.target is None:
            return jnp.mean(y, dtype=total.dtype)
        return jnp.mean((y - self.target) ** 2, dtype=total.dtype)


class MeanHeight(eqx.Module):
    """Height averaged over balls and steps, m."""

    def step(self, state, record, dtype):
        """The mean over the batch."""
        return jnp.mean(state.y.astype(dtype), dtype=dtype)

    def end(self, state, steps, total):
        """Divided by the number of steps."""
        return total / max(steps, 1)


class ResidualPenetration(eqx.Module):
    """What the contact model leaves of the penetration, summed over steps, averaged over balls.

    Attributes:
        power: 2 for squares, m²; 1 for the penetration itself, m.
    """

    power: int = eqx.field(static=True, default=2)

    def step(self, state, record, dtype):
        """The mean of |p|^power over the batch."""
        left = record.left.astype(dtype)
        return jnp.mean(left if self.power == 1 else left**self.power, dtype=dtype)

    def end(self, state, steps, total):
        """The sum over steps."""
        return total


BY_NAME: dict[str, type] = {
    "final-height": FinalHeight,
    "mean-height": MeanHeight,
    "residual-penetration": ResidualPenetration,
}
