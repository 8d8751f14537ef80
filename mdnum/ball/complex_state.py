"""A state that is complex: a rotating phasor, decisions on |z|, z/|z| and the branch cut of arg z.

Three things are different from a height. The quantity compared is a modulus, whose derivative is undefined at
zero. The argument has a cut, the negative real axis, and the sign of a zero says on which side a number is.
And a derivative by a complex number needs a convention: for a real function f of z = x + iy, `jax.grad` gives
∂f/∂x - i ∂f/∂y, whose conjugate points uphill (PyTorch gives the conjugate).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from mdnum.errors import InputError
from mdnum.events import Ledger, Threshold
from mdnum.precision.exact import fence, zero_bits
from mdnum.precision.ulp import unit_roundoff


class PhasorState(NamedTuple):
    """Phasors between two steps.

    Attributes:
        step: number of steps made.
        z: shape (phasors,).
        winding: how often each has crossed the cut counterclockwise, less the times it crossed back.
    """

    step: Int[Array, ""]
    z: Complex[Array, "phasors"]
    winding: Int[Array, "phasors"]


class PhasorDecisions(NamedTuple):
    """What a step of a phasor decides.

    Attributes:
        inside: |z| is below the radius; a phasor that is not is put back on the circle.
        crossed: +1 where the cut was crossed counterclockwise, -1 clockwise, else 0.
    """

    inside: Bool[Array, "phasors"]
    crossed: Int[Array, "phasors"]


class Phasor(eqx.Module):
    """z <- factor z, put back on a circle when it has reached it.

    Attributes:
        factor: what every step multiplies by; turns by less than half a revolution.
        radius: of the circle; infinite for none.
        zero: runtime zero that fences the products.
    """

    factor: Complex[Array, ""]
    radius: Float[Array, ""]
    zero: Int[Array, ""]

    @classmethod
    def create(cls, factor: complex, radius: float = np.inf) -> Phasor:
        """A phasor with its numbers checked.

        Raises:
            InputError: a factor that is zero, not finite or a half turn; a radius that is not positive.
        """
        if not np.isfinite(factor) or factor == 0:
            raise InputError(f"{factor} cannot turn a phasor", where="factor")
        if factor.imag == 0 and factor.real < 0:
            raise InputError(
                f"{factor} turns by half a revolution, which has no direction",
                remedy="Turn by less than half a revolution a step.",
                where="factor",
            )
        if not radius > 0:
            raise InputError(f"{radius} is not a radius", remedy="Give a positive one.", where="radius")
        zero = zero_bits(jnp.float64)
        return cls(jnp.asarray(factor, jnp.complex128), jnp.asarray(radius, jnp.float64), zero)

    def start(self, z: Any) -> PhasorState:
        """A first state at z, a complex number or several."""
        z = jnp.atleast_1d(jnp.asarray(z, jnp.complex128))
        return PhasorState(jnp.asarray(0), z, jnp.zeros(z.shape, jnp.int64))

    def margins(self, state: PhasorState) -> tuple[Float[Array, "phasors"], Float[Array, "phasors"]]:
        """radius - |z| and Im z of the number that the next step decides about: positive means yes.

        Im z is the margin to the cut (and to the positive real axis, where arg does not jump). At an exact
        zero of Im z the sign of the zero decides.
        """
        z = times(self.factor, state.z, self.zero)
        return Threshold(self.radius, "<", "|z|").margin(jnp.abs(z)), jnp.imag(z)  # type: ignore[arg-type]

    def decide(self, state: PhasorState) -> PhasorDecisions:
        """The decisions of the next step."""
        z = times(self.factor, state.z, self.zero)
        inside = Threshold(self.radius, "<", "|z|").decide(jnp.abs(z))  # type: ignore[arg-type]
        was, now = upper(state.z), upper(z)
        turn = jnp.sign(jnp.imag(self.factor)).astype(jnp.int64)
        # turning by less than half a revolution, upper to lower counterclockwise can only pass the cut
        crossed = jnp.where((turn > 0) & was & ~now, 1, jnp.where((turn < 0) & ~was & now, -1, 0))
        return PhasorDecisions(inside, crossed)

    def step(self, state: PhasorState, decisions: PhasorDecisions) -> PhasorState:
        """The next state, acting on the decisions it is told."""
        z = times(self.factor, state.z, self.zero)
        back = jnp.asarray(jnp.where(jnp.isfinite(self.radius), self.radius, 1.0), z.dtype) * direction(z)
        z = jnp.where(decisions.inside, z, back)
        return PhasorState(state.step + 1, z, state.winding + decisions.crossed)


def times(a: Complex[Array, "..."], b: Complex[Array, "..."], zero: Int[Array, ""]) -> Complex[Array, "..."]:
    """a b, rounded after every operation.

    Error: at most sqrt(5) u |a b| (Brent, Percival and Zimmermann 2007).
    """
    ar, ai, br, bi = jnp.real(a), jnp.imag(a), jnp.real(b), jnp.imag(b)
    real = fence(ar * br, zero) - fence(ai * bi, zero)
    return jax.lax.complex(real, fence(ar * bi, zero) + fence(ai * br, zero))


def upper(z: Complex[Array, "..."]) -> Bool[Array, "..."]:
    """Whether arg z is on the upper side of the cut: decided by the sign bit of Im z, so that -0 is below."""
    return ~jnp.signbit(jnp.imag(z))


def direction(z: Complex[Array, "..."] | complex, floor: float = 0.0) -> Complex[Array, "..."]:
    """z/|z| where |z| > floor, else 0, with a derivative that is finite in both cases.

    Args:
        floor: at and below it z has no direction; the decision is |z| > floor.
    """
    z = jnp.asarray(z)
    some = jnp.abs(z) > floor
    # masking the argument, not the result: the derivative of |z| at 0 is not a number
    safe = jnp.where(some, z, jnp.ones_like(z))
    return jnp.where(some, safe / jnp.abs(safe).astype(z.dtype), jnp.zeros_like(z))


def unwrapped(state: PhasorState) -> Float[Array, "phasors"]:
    """The phase without jumps: arg z + 2 pi winding."""
    return jnp.angle(state.z) + 2 * np.pi * state.winding.astype(jnp.float64)


def uphill(function: Callable[[Complex[Array, "..."]], Float[Array, ""]]) -> Callable[..., Any]:
    """The direction of steepest ascent of a real function of a complex number: conj(jax.grad(function)).

    Source: jax.grad gives ∂f/∂x - i ∂f/∂y; the conjugate, ∂f/∂x + i ∂f/∂y = 2 ∂f/∂z̄, is the direction of
    steepest ascent, and what PyTorch calls the gradient.
    """
    gradient = jax.grad(function)
    return lambda z: jnp.conj(gradient(jnp.asarray(z, jnp.complex128)))


@dataclass(frozen=True)
class PhasorRun:
    """What a phasor did.

    Attributes:
        z: shape (steps + 1, phasors).
        phase: without jumps, rad, shape (steps + 1, phasors).
        crossings: flips across the cut; step s is the decision that made state s; `entered` is True for
            counterclockwise, the margin is Im z after the step, the jump is that of arg z.
        stops: flips of the decision to stay inside the circle; the margin is radius - |z| before it was put
            back.
    """

    z: Complex[np.ndarray, "rows phasors"]
    phase: Float[np.ndarray, "rows phasors"]
    crossings: Ledger
    stops: Ledger


def rotate(phasor: Phasor, start: PhasorState, steps: int) -> PhasorRun:
    """Run phasors and keep everything, the crossings of the cut and of the circle as ledgers.

    Error: z carries at most (1 + sqrt(5) u)^steps - 1, relative; that is the bound in the ledgers.
    """
    rows = _roll(phasor, start, steps)[1]
    z = np.concatenate([np.asarray(start.z)[None], np.asarray(rows["z"])])
    winding = np.concatenate([np.asarray(start.winding)[None], np.asarray(rows["winding"])])
    crossed, inside = np.asarray(rows["crossed"]), np.asarray(rows["inside"])
    grown = np.expm1(np.arange(1, steps + 1) * np.log1p(np.sqrt(5.0) * unit_roundoff(np.float64)))
    size = np.asarray(rows["size"])
    at, who = np.nonzero(crossed)
    crossings = Ledger(
        "branch",
        at + 1,
        who[:, None],
        crossed[at, who] > 0,
        np.asarray(rows["cut"])[at, who],
        grown[at] * size[at, who],
        -2 * np.pi * crossed[at, who],
    )
    before = np.concatenate([np.ones((1, inside.shape[1]), bool), inside[:-1]])
    at, who = np.nonzero(inside != before)
    margin = np.asarray(rows["modulus"])[at, who]
    stops = Ledger(
        "circle", at + 1, who[:, None], inside[at, who], margin, grown[at] * size[at, who],
        np.zeros(len(at)),
    )  # fmt: skip
    return PhasorRun(z, np.angle(z) + 2 * np.pi * winding, crossings, stops)


@eqx.filter_jit
def _roll(phasor: Phasor, start: PhasorState, steps: int) -> tuple[PhasorState, dict[str, Array]]:
    def once(state: PhasorState, _: None) -> tuple[PhasorState, dict[str, Array]]:
        modulus, cut = phasor.margins(state)
        decisions = phasor.decide(state)
        new = phasor.step(state, decisions)
        size = jnp.abs(times(phasor.factor, state.z, phasor.zero))
        row = {"z": new.z, "size": size, "winding": new.winding, "modulus": modulus, "cut": cut}
        return new, {**row, "crossed": decisions.crossed, "inside": decisions.inside}

    return jax.lax.scan(once, start, None, length=steps)
