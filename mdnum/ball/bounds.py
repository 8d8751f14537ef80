"""How far rounding can move what a decision of the ball compares, given the state that it is made from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mdnum.precision.bounds import gamma

if TYPE_CHECKING:
    from mdnum.ball.world import World


def height_bound(
    world: World, y: Float[np.ndarray, "..."], v: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """Bound on |computed - exact| of the height that a contact decision compares, m.

    Four roundings on the way from the state before, none of which cancels more than the sum of its parts.

    Args:
        world: the program.
        y, v: height (m) and velocity (m/s) of the state before.
    """
    y, v = np.asarray(y, np.float64), np.asarray(v, np.float64)
    h, free = float(world.integrator.h), abs(float(world.gravity))
    return gamma(4, world.policy.dtype("arithmetic")) * (np.abs(y) + h * np.abs(v) + h * h * free)


def residual_bound(world: World, residual: Any, terms: int) -> Any:
    """Bound on |computed - exact| of a residual, in its own unit.

    All terms of a residual have one sign, so the error of their sum is at most gamma times the sum.

    Args:
        world: the program.
        residual: what a stop decision compares.
        terms: balls that it is a residual of; 1 where each has its own.
    """
    return gamma(max(terms - 1, 1), world.policy.dtype("accumulate")) * residual
