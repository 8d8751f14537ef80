"""How a program of the ball, and its derivative, approach the exact motion as the step shrinks.

Errors of one ball jump about with the phase at which its impacts fall into the steps; the root mean square
over a batch of starts does not, and then the order of a scheme is a slope.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from mdnum.ball.exact import ExactImpact, ExactPenalty
from mdnum.ball.world import World
from mdnum.errors import InputError
from mdnum.events.saltation import carry


@dataclass(frozen=True)
class Convergence:
    """Errors at one time for several step sizes.

    Attributes:
        h: time steps, s, shape (sizes,).
        value: root mean square error of the height over the batch, m, shape (sizes,).
        slope: that of its derivative, shape (sizes,).
        largest: the largest derivative that the program gave, by magnitude, shape (sizes,).
    """

    h: Float[np.ndarray, "sizes"]
    value: Float[np.ndarray, "sizes"]
    slope: Float[np.ndarray, "sizes"]
    largest: Float[np.ndarray, "sizes"]

    def order(self, of: str = "value") -> float:
        """The exponent p of error ~ h^p: the slope of a straight line through the logarithms."""
        return float(np.polyfit(np.log(self.h), np.log(getattr(self, of)), 1)[0])


def converge(
    world: World,
    exact: Callable[[float], ExactImpact | ExactPenalty],
    y0: Float[np.ndarray, "balls"],
    time: float,
    counts: Sequence[int],
    *,
    name: str = "y0",
    saltation: bool = False,
) -> Convergence:
    """Run a batch to the same time with several step sizes and compare with the exact motion.

    Args:
        world: the program; its time step is replaced.
        exact: from a height at the start to the motion that the program approaches.
        y0: heights at the start, m.
        time: when heights are compared, s.
        counts: numbers of steps.
        name: what heights are differentiated by.
        saltation: carry the tangent through impacts with the saltation matrix instead of differentiating
            the steps.
    """
    known = [exact(float(y)).height(time) for y in y0]
    heights = np.array([float(one.value) for one in known])
    slopes = np.array([float(one.gradient[name]) for one in known])
    errors = []
    for count in counts:
        here = world.with_values({"h": time / count})
        y, dy = (saltated if saltation else arrive)(here, jnp.asarray(y0), count, name)
        off = (np.asarray(y) - heights, np.asarray(dy) - slopes)
        errors.append([*(np.sqrt(np.mean(x**2)) for x in off), np.max(np.abs(np.asarray(dy)))])
    return Convergence(time / np.asarray(counts, np.float64), *np.array(errors).T)


def arrive(world: World, y0: Float[Array, "balls"], steps: int, name: str) -> tuple[Array, Array]:
    """Heights after a number of steps and the derivative of the program by a parameter, by forward mode.

    One compilation serves all step sizes and numbers of steps.
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


def saltated(world: World, y0: Float[Array, "balls"], steps: int, name: str) -> tuple[Array, Array]:
    """Heights after a number of steps and the derivative of the motion that the steps imitate.

    For an impact reset at the end of a step. Between impacts the tangent is that of the flight; at an impact
    it is multiplied by the saltation matrix there, with the speed that the program itself arrived with.

    Raises:
        InputError: for another parameter than y0 or v0.
    """
    if name not in ("y0", "v0"):
        raise InputError(f"saltation along {name!r}; expected y0 or v0")
    return _saltated(world, y0, jnp.asarray(steps), name)


@eqx.filter_jit
def _saltated(world: World, y0: Array, steps: Array, name: str) -> tuple[Array, Array]:
    h, g, e = world.value("h"), world.gravity, world.value("restitution")
    zero, one = jnp.zeros_like(y0), jnp.ones_like(y0)
    reset = jnp.stack([jnp.stack([one, zero], -1), jnp.stack([zero, -e * one], -1)], -2)
    normal = jnp.stack([one, zero], -1)

    def step(_, carried):
        state, dy, dv = carried
        after, record = world.advance(state)
        speed = state.v - h * g
        before = jnp.stack([speed, -g * one], -1)
        later = jnp.stack([-e * speed, -g * one], -1)
        tangent = jnp.stack([dy + h * dv, dv], -1)
        through = carry(tangent, reset, before, later, normal)
        tangent = jnp.where(record.contact[:, None], through, tangent)
        return after, tangent[:, 0], tangent[:, 1]

    start = (world.start(y0, 0.0), one * float(name == "y0"), one * float(name == "v0"))
    state, dy, _ = lax.fori_loop(0, steps, step, start)
    return state.y, dy
