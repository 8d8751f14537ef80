"""Few bits in an input, a parameter or the state: which of them changes the contact history?"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from mdnum.ball import Penalty, SemiImplicitEuler, World
from mdnum.errors import InputError
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

#: Binary digits of the constants after the point.
_SHIFT = 24


@jax.custom_jvp
def quantize(
    x: Float[Array, "..."],
    scale: Float[Array, ""],
    lowest: Float[Array, ""],
    highest: Float[Array, ""],
) -> Float[Array, "..."]:
    """Return the multiple of scale nearest to x, clamped to the range from lowest * scale to highest * scale.

    The derivative is 1 inside the range, and 0 where the value is clamped. Error: at most scale/2 inside the
    range, plus one rounding.
    """
    return jnp.clip(jnp.rint(x / jnp.broadcast_to(scale, x.shape)), lowest, highest) * scale


@quantize.defjvp
def _quantize_jvp(primals, tangents):
    x, scale, lowest, highest = primals
    inside = (x >= lowest * scale) & (x <= highest * scale)
    return quantize(*primals), jnp.where(inside, tangents[0], jnp.zeros_like(x))


class LatticeState(NamedTuple):
    """Height and velocity of every ball, as integers in units of the fixed-point state (m and m/s)."""

    y: Int[Array, "balls"]
    v: Int[Array, "balls"]


class LatticeBall(eqx.Module):
    """Balls on a spring floor (semi-implicit Euler) with an integer state.

    Attributes:
        h: time step, s, in units of 2^-24.
        push: h k, 1/s, in units of 2^-24.
        kick: change of the velocity by gravity and control in each step, in fixed-point units, shape
        (steps,).
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
        """Create the balls for a run with one step per control acceleration.

        Args:
            k: stiffness, 1/s².
            h: time step, s.
            control: acceleration added in each step, m/s².
            gravity: m/s².
            bits: the unit is 2^-bits m.
            largest, deepest: speeds (m/s) and penetrations (m) up to these values cannot overflow.

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
        """Return the state for heights (m) and velocities (m/s), rounded to fixed-point numbers."""
        y = np.atleast_1d(np.asarray(y, np.float64))
        units = (np.rint(q * 2.0**self.bits).astype(np.int64) for q in (y, np.broadcast_to(v, y.shape)))
        return LatticeState(*(jnp.asarray(q) for q in units))

    def meters(self, y: Int[Any, "..."]) -> Float[np.ndarray, "..."]:
        """Convert fixed-point units to m (or m/s)."""
        return np.asarray(y).astype(np.float64) * 2.0**-self.bits

    def _pull(self, y, step):
        return self.kick[step] - jnp.where(y < 0, (y * self.push) >> _SHIFT, 0)

    def step(self, state: LatticeState, step: Int[Array, ""]) -> LatticeState:
        """Return the state after one step: first the velocity changes, then the height."""
        v = state.v + self._pull(state.y, step)
        return LatticeState(state.y + ((v * self.h) >> _SHIFT), v)

    def back(self, state: LatticeState, step: Int[Array, ""]) -> LatticeState:
        """Return the state before one step, exactly."""
        y = state.y - ((state.v * self.h) >> _SHIFT)
        return LatticeState(y, state.v - self._pull(y, step))

    def run(self, start: LatticeState) -> tuple[LatticeState, Bool[Array, "steps balls"]]:
        """Make all steps; return the last state, and the contacts at the beginning of each step."""
        return _forward(self, start)

    def rewind(self, end: LatticeState) -> LatticeState:
        """Reverse all steps; return the initial state of `run`."""
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


H, STEPS, BALLS, K = 0.01, 3000, 16, 2000.37
BITS = (8, 12, 16, 20, 24, 28)
#: What a format of so many bits has to cover: |height| m, |velocity| m/s, |control| m/s², stiffness 1/s².
SPAN = {"y": 8.0, "v": 16.0, "input": 8.0, "parameter": 4096.0}
#: Growth of a separation is read off between these two sizes, m.
SMALL, LARGE = 1e-11, 1e-4


def control() -> np.ndarray:
    """Return the accelerations that shake the balls, m/s², so that initial heights are forgotten."""
    return 5.0 * np.sin(7.0 * np.arange(STEPS) * H)


def world(shaken: np.ndarray, k: float = K) -> World:
    """Return the world of undamped balls on springs."""
    return World.create(Penalty(k), SemiImplicitEuler(H), control=shaken)


def heights() -> np.ndarray:
    """Return the initial heights of the balls, m."""
    return np.linspace(0.6, 1.1, BALLS)


def rounded(x: Any, bits: int, span: float) -> np.ndarray:
    """Return numbers from -span to span, rounded to a number of bits."""
    return np.asarray(np.rint(np.asarray(x) / (2 * span / 2**bits)) * (2 * span / 2**bits))


@eqx.filter_jit
def roll(world: World, y0: Any, scales: Any, half: Any):
    """Return heights and contacts of every step; with half > 0 the state is rounded in each step."""

    def snap(x, scale):
        return jnp.where(half > 0, quantize(x, scale, -half, half - 1), x)

    def step(state, _):
        state, record = world.advance(state)
        state = state._replace(y=snap(state.y, scales[0]), v=snap(state.v, scales[1]))
        return state, (state.y, record.contact)

    return lax.scan(step, world.start(y0), length=STEPS)[1]


def bounced(world: World, y0: np.ndarray, bits: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return heights and contacts, with the state rounded to a number of bits (0 for no rounding)."""
    scales = jnp.asarray([2 * SPAN[name] / 2.0**bits for name in ("y", "v")])
    half = jnp.asarray(2.0 ** (bits - 1) if bits else 0.0)
    y, contact = roll(world, jnp.asarray(y0), scales, half)
    return np.asarray(y), np.asarray(contact)


def horizon(contact: np.ndarray, reference: np.ndarray) -> float:
    """Return the median over balls of the first step with a different contact, at most STEPS."""
    differ = contact != reference
    return float(np.median(np.where(differ.any(axis=0), differ.argmax(axis=0), STEPS)))


def run() -> Demo:
    """Measure the horizon over the number of bits, and compare with an integer state."""
    shaken, y0 = control(), heights()
    plain = world(shaken)
    reference, contact = bounced(plain, y0)
    found: dict[str, list[float]] = {"state": [], "parameter": [], "input": []}
    flips: dict[str, list[float]] = {name: [] for name in found}
    for bits in BITS:
        runs = {
            "state": bounced(plain, y0, bits)[1],
            "parameter": bounced(plain.with_values({"k": rounded(K, bits, SPAN["parameter"])}), y0)[1],
            "input": bounced(world(rounded(shaken, bits, SPAN["input"])), y0)[1],
        }
        for name, seen in runs.items():
            found[name].append(horizon(seen, contact))
            flips[name].append(float((seen != contact).mean()))
    per_bit = float(np.polyfit(BITS, found["state"], 1)[0])
    doubling = _doubling(reference, bounced(plain, y0 * (1 + 2.0**-48))[0])
    lattice = LatticeBall.create(K, H, shaken, bits=32)
    start = lattice.start(y0)
    end, integer = lattice.run(start)
    back = lattice.rewind(end)
    returned = all(np.array_equal(a, b) for a, b in zip(start, back, strict=True))
    alone = [np.asarray(lattice.run(lattice.start(y))[1])[:, 0] for y in y0[:2]]
    same = all(np.array_equal(a, np.asarray(integer)[:, k]) for k, a in enumerate(alone))
    own = horizon(np.asarray(integer), contact)
    at = BITS.index(16)
    return Demo(
        title="Quantize inputs, not the state",
        question=(
            "An input, a parameter or the state is stored in b bits. For how many steps are the "
            "contacts unchanged?"
        ),
        result=(
            f"With 16 bits the contacts are correct for {found['state'][at]:.0f} steps if the state "
            f"is quantized, and for {found['parameter'][at]:.0f} steps if the stiffness is."
        ),
        answer=(
            f"With 16 bits in the state the first contact differs after {found['state'][at]:.0f} steps, in "
            f"the input after {found['input'][at]:.0f}, in the stiffness after "
            f"{found['parameter'][at]:.0f} (medians of {BALLS} balls). Every further bit of the state "
            f"adds about {per_bit:.0f} steps; a separation doubles in {doubling:.0f} steps. A run with an "
            f"integer state also separates from float64, but its events are exact: {STEPS} steps and "
            f"their reversal return every bit."
        ),
        numbers={
            "state_horizon_16_bits": found["state"][at],
            "input_horizon_16_bits": found["input"][at],
            "parameter_horizon_16_bits": found["parameter"][at],
            "steps_per_bit": per_bit,
            "steps_per_doubling": doubling,
            "state_horizons": dict(zip(BITS, found["state"], strict=True)),
            "lattice_returns": returned,
            "lattice_horizon": own,
        },
        checks=[
            Claim(
                "the horizon of a quantized state grows with every four bits",
                found["state"],
                "increasing",
                bool((np.diff(found["state"]) > 0).all()),
            ),
            Claim(
                "the horizon grows by a doubling time per bit",
                [per_bit, doubling],
                "within a factor of 2",
                0.5 < per_bit / doubling < 2.0,
            ),
            Claim(
                "up to 24 bits, quantizing the state has the largest effect",
                [found[name][:-1] for name in found],
                "state before input and parameter",
                all(
                    a < min(b, c)
                    for a, b, c in zip(*(found[n][:-1] for n in ("state", "parameter", "input")), strict=True)
                ),
            ),
            Claim("the integer state returns", returned, "every bit", returned),
            Claim("a ball alone has the bits that it has in a batch", same, "True", same),
        ],
        tables=[
            table(
                f"first step with another contact, of {STEPS}",
                ("bits", "state", "stiffness", "input"),
                tuple(zip(BITS, found["state"], found["parameter"], found["input"], strict=True)),
            ),
            table(
                "contact decisions that differ, per step and ball",
                ("bits", "state", "stiffness", "input"),
                tuple(zip(BITS, flips["state"], flips["parameter"], flips["input"], strict=True)),
            ),
        ],
        plots=[_horizons(found, doubling)],
        in_md=(
            "A table of ε and σ in few bits is harmless, but positions in few bits are not; with "
            "integer positions the neighbor decision is exact."
        ),
        data={"bits": list(BITS), "horizons": found, "flips": flips},
    )


def _doubling(a: np.ndarray, b: np.ndarray) -> float:
    """Return the doubling time of a separation in steps, from a linear fit of its logarithm."""
    largest = np.maximum.accumulate(np.abs(a - b), axis=0)
    # the mean over the balls of the logarithm, as a Lyapunov exponent is one
    mean = np.log2(np.maximum(largest, 2.0**-60)).mean(axis=1)
    within = np.flatnonzero((mean > np.log2(SMALL)) & (mean < np.log2(LARGE)))
    return float(1 / np.polyfit(within, mean[within], 1)[0])


def _horizons(found: dict[str, list[float]], doubling: float) -> Plot:
    bits = np.array(BITS, float)
    guide = found["state"][0] + (bits - bits[0]) * doubling
    return Plot(
        "long-contacts",
        title="Steps for which the contacts agree with float64",
        x_label="bits",
        y_label="first step with another contact",
        series=(
            Series("state", bits, np.array(found["state"]), "line+points", "bad"),
            Series("stiffness", bits, np.array(found["parameter"]), "line+points", "second"),
            Series("input", bits, np.array(found["input"]), "line+points", "first"),
            Series("one doubling per bit", bits, guide, role="muted", dashed=True),
        ),
        caption="The state is rounded in every step, so one more bit adds only the time in which a "
        "separation doubles.",
        horizontals=((float(STEPS), "end of the run"),),
    )
