"""A bouncing ball in integers: quantized state whose events are exact.

Heights and velocities are multiples of a unit, every increment is an integer product shifted right, and the
contact decision compares an integer with zero. Nothing is rounded as a float is, so no order of operations,
no fused multiply-add and no batch can change a bit; and because each half of a step adds what the other half
holds fixed, the run can be taken back step by step, exactly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from mdnum.errors import InputError

#: Binary digits of the constants after the point.
_SHIFT = 24


class LatticeState(NamedTuple):
    """Height and velocity of every ball, in units of the lattice (m and m/s)."""

    y: Int[Array, "balls"]
    v: Int[Array, "balls"]


class LatticeBall(eqx.Module):
    """Balls on a spring floor (semi-implicit Euler) with an integer state.

    Attributes:
        h: time step, s, in 2^-24.
        push: h k, 1/s, in 2^-24.
        kick: what gravity and control add to the velocity in each step, in units, shape (steps,).
        bits: the unit is 2^-bits m (and m/s).
    """

    h: Int[Array, ""]
    push: Int[Array, ""]
    kick: Int[Array, "steps"]
    bits: int = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        k: float,
        h: float,
        control: Float[np.ndarray, "steps"],
        gravity: float = 9.81,
        bits: int = 32,
        largest: float = 16.0,
        deepest: float = 1.0,
    ) -> LatticeBall:
        """A program for as many steps as there are controls.

        Args:
            k: stiffness, 1/s².
            h: time step, s.
            control: acceleration added in each step, m/s².
            gravity: m/s².
            bits: the unit is 2^-bits m.
            largest, deepest: speeds (m/s) and penetrations (m) up to these are sure not to overflow.

        Raises:
            InputError: an int64 cannot hold the products.
        """
        constants = {"h": round(h * 2**_SHIFT), "push": round(h * k * 2**_SHIFT)}
        for name, limit in (("h", largest), ("push", deepest)):
            constant = constants[name]
            if constant < 1:
                raise InputError(f"{name} is below the lattice's 2^-{_SHIFT}", remedy="Give a larger one.")
            if constant * limit * 2**bits >= 2**63:
                raise InputError(
                    f"{bits} bits and numbers up to {limit:g} overflow 64 bits", remedy="Give fewer bits."
                )
        kick = np.rint((np.asarray(control) - gravity) * h * 2**bits).astype(np.int64)
        cast = {name: jnp.asarray(constant, jnp.int64) for name, constant in constants.items()}
        return cls(**cast, kick=jnp.asarray(kick), bits=bits)

    def start(self, y: Any, v: Any = 0.0) -> LatticeState:
        """Heights (m) and velocities (m/s), rounded to the lattice."""
        y = np.atleast_1d(np.asarray(y, np.float64))
        units = (np.rint(q * 2.0**self.bits).astype(np.int64) for q in (y, np.broadcast_to(v, y.shape)))
        return LatticeState(*(jnp.asarray(q) for q in units))

    def meters(self, y: Int[Any, "..."]) -> Float[np.ndarray, "..."]:
        """Lattice units as m (or m/s)."""
        return np.asarray(y).astype(np.float64) * 2.0**-self.bits

    def _pull(self, y, step):
        return self.kick[step] - jnp.where(y < 0, (y * self.push) >> _SHIFT, 0)

    def step(self, state: LatticeState, step: Int[Array, ""]) -> LatticeState:
        """From the state at a step to the next: first the velocity, then the height."""
        v = state.v + self._pull(state.y, step)
        return LatticeState(state.y + ((v * self.h) >> _SHIFT), v)

    def back(self, state: LatticeState, step: Int[Array, ""]) -> LatticeState:
        """The state at a step from the next one, exactly."""
        y = state.y - ((state.v * self.h) >> _SHIFT)
        return LatticeState(y, state.v - self._pull(y, step))

    def run(self, start: LatticeState) -> tuple[LatticeState, Bool[Array, "steps balls"]]:
        """All steps: the last state, and whether each step's ball was in contact when it began."""
        return _forward(self, start)

    def rewind(self, end: LatticeState) -> LatticeState:
        """All steps back: the state that `run` started from."""
        return _backward(self, end)


@eqx.filter_jit
def _forward(ball: LatticeBall, start: LatticeState):
    def advance(state, step):
        return ball.step(state, step), state.y < 0

    return lax.scan(advance, start, jnp.arange(ball.kick.shape[0]))


@eqx.filter_jit
def _backward(ball: LatticeBall, end: LatticeState) -> LatticeState:
    return lax.fori_loop(
        0, ball.kick.shape[0], lambda k, state: ball.back(state, ball.kick.shape[0] - 1 - k), end
    )
