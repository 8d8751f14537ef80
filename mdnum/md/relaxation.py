"""Going downhill to the nearest minimum with jax-md's FIRE, for preparing systems."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError, NumericalError
from mdnum.md.jaxmd import standard_promotion, upstream

# FIRE adds 1e-6 to |F|² and so stops mixing below forces of 1e-3; forces and masses scaled by a power of
# two give the same motion with that floor at 1e-9
_FIRE_SCALE = 2.0**20


@dataclass(frozen=True)
class Relaxed:
    """Where a relaxation ended.

    Attributes:
        positions: (atoms, 3), length; not folded back into the cell.
        steps: FIRE steps taken.
        force_max: largest force on an atom at the end, force.
        converged: whether force_max is within the tolerance asked for.
    """

    positions: np.ndarray
    steps: int
    force_max: float
    converged: bool


def relax(
    energy_or_force_fn: Callable[..., Array],
    positions: Float[Array | np.ndarray, "atoms 3"],
    *,
    neighbors: Callable[[np.ndarray], Any] | None = None,
    skin: float | None = None,
    mass: float | np.ndarray = 1.0,
    max_steps: int = 5_000,
    force_tolerance: float = 1e-6,
    dt_start: float = 0.1,
    dt_max: float = 0.4,
) -> Relaxed:
    """Go downhill to the nearest minimum with jax-md's FIRE.

    Args:
        energy_or_force_fn: `fn(positions)`, or `fn(positions, neighbor=...)` where neighbors is given;
            returns an energy (scalar) or forces (atoms, 3).
        positions: start, length.
        neighbors: builds a list from positions on the host, with the skin included.
        skin: length; the list is rebuilt once an atom has moved half of it. Needed with neighbors.
        mass: per atom or one for all; only the path depends on it.
        max_steps: FIRE steps at most.
        force_tolerance: stop when no atom feels more than this, force.
        dt_start, dt_max: first and largest time step, internal time.

    Raises:
        InputError: neighbors without a positive skin.
        NumericalError: forces are not finite.

    Source: Bitzek et al., Phys. Rev. Lett. 97, 170201 (2006), as coded in jax_md.minimize.fire_descent.
    """
    minimize = upstream().minimize
    if neighbors is not None and not (skin is not None and skin > 0):
        raise InputError("a relaxation over a neighbor list needs a skin above 0", remedy="give skin=")

    def scaled(points: Array, **kwargs: Any) -> Array:
        return energy_or_force_fn(points, **kwargs) * _FIRE_SCALE

    init, apply = minimize.fire_descent(scaled, lambda R, dR, **_: R + dR, dt_start=dt_start, dt_max=dt_max)

    def largest(state: Any) -> Array:
        return jnp.sqrt(jnp.max(jnp.sum(state.force**2, axis=-1))) / _FIRE_SCALE

    @jax.jit
    def start(points: Array, masses: Array, kwargs: dict[str, Any]) -> Any:
        # FIRE stores its time step as float16 (the smallest type that "fits" 0.1) and would step in it
        state = init(points, mass=masses, **kwargs)
        return state.set(dt=jnp.asarray(dt_start, points.dtype), alpha=jnp.asarray(0.1, points.dtype))

    @jax.jit
    def epoch(state: Any, steps: Array, reference: Array, kwargs: dict[str, Any]) -> tuple[Any, Array]:
        def going(carry: tuple[Any, Array]) -> Array:
            now, done = carry
            moved = jnp.max(jnp.sum((now.position - reference) ** 2, axis=-1))
            fresh = True if skin is None else moved <= (0.5 * skin) ** 2
            return (done < max_steps) & (largest(now) > force_tolerance) & fresh

        def step(carry: tuple[Any, Array]) -> tuple[Any, Array]:
            return apply(carry[0], **kwargs), carry[1] + 1

        return jax.lax.while_loop(going, step, (state, steps))

    points = jnp.asarray(positions, jnp.float64)
    masses = jnp.broadcast_to(jnp.asarray(mass, jnp.float64) * _FIRE_SCALE, (len(points),))
    kwargs = {} if neighbors is None else {"neighbor": neighbors(np.asarray(points))}
    with standard_promotion():
        state = start(points, masses, kwargs)
        steps = jnp.zeros((), jnp.int32)
        while True:
            reference, before = state.position, int(steps)
            state, steps = epoch(state, steps, reference, kwargs)
            if neighbors is not None and int(steps) > before:
                kwargs = {"neighbor": neighbors(np.asarray(state.position))}
                # the step that used the skin up saw the old list; its force is taken again on the new one
                state = state.set(force=start(state.position, masses, kwargs).force)
            force_max = float(largest(state))
            if not np.isfinite(force_max):
                raise NumericalError(
                    "forces are not finite during the relaxation", where=f"step {int(steps)}"
                )
            if force_max <= force_tolerance or int(steps) >= max_steps:
                break
    return Relaxed(np.asarray(state.position), int(steps), force_max, force_max <= force_tolerance)
