"""Stiffness: a stable contact whose trajectory looks correct while its derivative grows without bound."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from mdnum.ball.exact import ExactPenalty
from mdnum.ball.step import (
    BallDecisions,
    BallVerlet,
    ExplicitEuler,
    ImplicitMidpoint,
    Penalty,
    SemiImplicitEuler,
)
from mdnum.ball.world import World
from mdnum.errors import InputError
from mdnum.numerics.roles import RolePrecision
from mdnum.verbs.demos import Claim, Demo, Plot, Region, Series, Table, table

SCHEMES = {
    "explicit-euler": ExplicitEuler,
    "semi-implicit-euler": SemiImplicitEuler,
    "velocity-verlet": BallVerlet,
    "implicit-midpoint": ImplicitMidpoint,
}

#: What the classes of a map mean.
WORDS = ("both bounded", "forward bounded, gradient not", "forward not bounded")

#: How far off a ball that is held in contact gets before it is said to run away.
GROWTH = 1000.0

Numbers = float | Float[np.ndarray, "..."]


def step_matrix(scheme: str, z: Numbers, zeta: Numbers = 0.0) -> Float[np.ndarray, "... 2 2"]:
    """Return the matrix of one step of the contact phase, for the state (sqrt(k) y, v).

    For velocity Verlet v is the velocity at the half step, from which the damping force is computed; the
    steps then equal those of semi-implicit Euler in the other order.

    Args:
        scheme: a name in SCHEMES.
        z: h sqrt(k).
        zeta: damping ratio, damping / (2 sqrt(k)).
    """
    z, zeta = np.broadcast_arrays(np.asarray(z, np.float64), np.asarray(zeta, np.float64))
    d, one = 2 * zeta * z, np.ones_like(z)
    if scheme == "explicit-euler":
        rows = ((one, z), (-z, 1 - d))
    elif scheme == "semi-implicit-euler":
        rows = ((1 - z * z, z * (1 - d)), (-z, 1 - d))
    elif scheme == "velocity-verlet":
        rows = ((one, z), (-z, 1 - d - z * z))
    elif scheme == "implicit-midpoint":
        # (1 - A/2)^-1 (1 + A/2) with A = [[0, z], [-z, -d]]
        below = 1 + d / 2 + z * z / 4
        rows = ((1 + d / 2 - z * z / 4, z), (-z, 1 - d / 2 - z * z / 4))
        rows = tuple(tuple(x / below for x in row) for row in rows)
    else:
        raise InputError(f"unknown scheme {scheme!r}", remedy=f"There are {', '.join(SCHEMES)}")
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def spectral_radius(scheme: str, z: Numbers, zeta: Numbers = 0.0) -> Float[np.ndarray, "..."]:
    """Return the largest magnitude of the eigenvalues of a contact step; at most 1 if stable."""
    return np.asarray(np.max(np.abs(np.linalg.eigvals(step_matrix(scheme, z, zeta))), axis=-1))


def limit(scheme: str, zeta: float = 0.0) -> float:
    """Return the largest h sqrt(k) with a stable contact, in closed form; infinite for the implicit midpoint.

    The limit follows from the conditions |trace| <= 1 + det and det <= 1 on the characteristic polynomial.
    """
    step_matrix(scheme, 0.0)
    if zeta < 0:
        raise InputError(f"zeta = {zeta}; expected 0 or more")
    if scheme == "implicit-midpoint":
        return float("inf")
    if scheme == "explicit-euler":
        return 2 * zeta if zeta <= 1 else 2 / (zeta + float(np.sqrt(zeta * zeta - 1)))
    return 2 / (zeta + float(np.sqrt(1 + zeta * zeta)))


def bounce_growth(
    scheme: str, z: float, zeta: float = 0.0, flight_steps: int = 90, phases: int = 64
) -> float:
    """Return the expected growth of derivatives in one bounce: the mean of log(spectral radius).

    The mean is over the phase of the step in which the ball enters the floor. For each phase the contact
    steps are counted, and their matrix is multiplied by the matrix of the flight. Gravity during contact is
    neglected.

    Args:
        flight_steps: steps between contacts, 2 s / (g h).
        phases: phases of the entry, equally spaced.

    Returns:
        growth exponent per bounce (natural logarithm); infinite if the ball never leaves the floor.
    """
    step = step_matrix(scheme, z, zeta)
    flight = np.array([[1.0, z * flight_steps], [0.0, 1.0]])
    x, v = -(np.arange(phases) + 0.5) / phases * z, -np.ones(phases)
    product = np.broadcast_to(np.eye(2), (phases, 2, 2))
    # half a turn is pi / z steps; twice that is forever
    for _ in range(int(2 * np.pi / z) + 4):
        inside = x < 0
        if not np.any(inside):
            break
        moved = step @ np.stack([x, v])
        x, v = np.where(inside, moved[0], x), np.where(inside, moved[1], v)
        product = np.where(inside[:, None, None], step @ product, product)
    if np.any(x < 0):
        return float("inf")
    return float(np.mean(np.log(np.max(np.abs(np.linalg.eigvals(flight @ product)), axis=-1))))


@dataclass(frozen=True)
class StabilityMap:
    """Energies and derivatives of balls over h sqrt(k) and damping ratio, up to several numbers of steps.

    Attributes:
        scheme: name.
        z: h sqrt(k), shape (columns,).
        zeta: damping ratio, shape (rows,).
        steps: steps at which the largest values so far were recorded, shape (times,).
        energy: largest E / E(0) so far, shape (times, rows, columns).
        gradient: largest |dy / dy0| so far, same shape; infinite after a value that is not finite.
        exact: largest |dy / dy0| so far of the exact undamped motion, over all columns, shape (times,).
        forward_bound, gradient_bound: bounds above which a value counts as "not bounded".
    """

    scheme: str
    z: Float[np.ndarray, "columns"]
    zeta: Float[np.ndarray, "rows"]
    steps: Int[np.ndarray, "times"]
    energy: Float[np.ndarray, "times rows columns"]
    gradient: Float[np.ndarray, "times rows columns"]
    exact: Float[np.ndarray, "times"]
    forward_bound: float
    gradient_bound: float

    @property
    def kind(self) -> Int[np.ndarray, "times rows columns"]:
        """Class of each cell, an index into WORDS."""
        # a comparison with NaN is no, and no is not bounded
        forward = self.energy <= self.forward_bound
        gradient = self.gradient <= self.gradient_bound
        return np.where(forward, np.where(gradient, 0, 1), 2)


def measure(
    scheme: str,
    z: Float[np.ndarray, "columns"],
    zeta: Float[np.ndarray, "rows"] | None = None,
    *,
    steps: int = 2000,
    times: int = 20,
    h: float = 0.01,
    starts: tuple[float, ...] = (1.0, 1.013, 0.991, 1.029),
    gravity: float = 9.81,
    forward_bound: float = 10.0,
    gradient_bound: float = 1e6,
) -> StabilityMap:
    """Drop balls for each stiffness and damping, and record their energies and derivatives.

    A single initial height may lie in an interval in which nothing grows, so several balls are dropped and
    the largest values are kept.

    Args:
        scheme: a name in SCHEMES.
        z: h sqrt(k).
        zeta: damping ratios; only 0 when None.
        steps: number of steps, a multiple of times.
        times: number of times at which the largest values so far are recorded.
        h: time step, s.
        starts: initial heights, m.
        gravity: m/s².
        forward_bound: bound on E / E(0).
        gradient_bound: bound on |dy / dy0|.

    Error: the derivative is that of the program, by forward mode; the bounds are orders of magnitude away
    from typical values.
    """
    zeta = np.zeros(1) if zeta is None else np.asarray(zeta, np.float64)
    z = np.asarray(z, np.float64)
    if steps % times:
        raise InputError(f"steps = {steps} is no multiple of times = {times}")
    root, ratio = np.meshgrid(z / h, zeta)
    world = World.create(Penalty(1.0), SCHEMES[scheme](h), gravity)
    energy, gradient = _follow(
        world, jnp.asarray(root.ravel() ** 2), jnp.asarray(2 * ratio.ravel() * root.ravel()),
        jnp.asarray(starts), steps // times, times,
    )  # fmt: skip
    shape = (root.size, times)
    energy = np.asarray(energy).reshape(shape).T.reshape(times, len(zeta), len(z))
    gradient = np.asarray(gradient).reshape(shape).T.reshape(times, len(zeta), len(z))
    at = steps // times * np.arange(1, times + 1)
    exact = np.max([_exact(y, gravity, (x / h) ** 2, at, h) for x in z for y in starts], axis=0)
    return StabilityMap(scheme, z, zeta, at, energy, gradient, exact, forward_bound, gradient_bound)


def _exact(y0: float, gravity: float, k: float, steps: np.ndarray, h: float) -> np.ndarray:
    """Return the largest |dy/dy0| of the exact motion up to each number of steps, on a grid of times."""
    t = np.linspace(0, steps[-1] * h, 20 * len(steps) + 1)[1:]
    slope = np.abs(ExactPenalty(y0, 0.0, gravity, k).height(t).gradient["y0"])
    return np.maximum.accumulate(slope)[19::20]


@eqx.filter_jit
def _follow(
    world: World, k: Array, damping: Array, y0: Array, length: int, times: int
) -> tuple[Array, Array]:
    """Return the largest relative energy and the largest derivative, for balls y0 and each k."""

    def one(k, damping):
        here = world.with_values({"k": k, "damping": damping})

        def energy(state):
            return here.gravity * state.y + 0.5 * state.v**2 + 0.5 * k * jnp.minimum(state.y, 0.0) ** 2

        def step(carry, _):
            state, tangent, high, steep = carry

            def act(y, v, a):
                after = here.advance(state._replace(y=y, v=v, a=a))[0]
                return (after.y, after.v, after.a), after

            _, tangent, state = jax.jvp(act, (state.y, state.v, state.a), tangent, has_aux=True)
            slope = jnp.abs(tangent[0])
            # an overflow stays on record as one, also when inf - inf follows
            steep = jnp.maximum(steep, jnp.where(jnp.isfinite(slope), slope, jnp.inf))
            high = jnp.maximum(high, jnp.where(jnp.isfinite(energy(state)), energy(state), jnp.inf))
            return (state, tangent, high, steep), None

        def chunk(carry, _):
            carry, _ = lax.scan(step, carry, None, length=length)
            return carry, carry[2:]

        start, tangent = jax.jvp(here.start, (y0,), (jnp.ones_like(y0),))
        carry = (start, (tangent.y, tangent.v, tangent.a), energy(start), jnp.abs(tangent.y))
        _, (high, steep) = lax.scan(chunk, carry, None, length=times)
        return jnp.max(high / energy(start), axis=1), jnp.max(steep, axis=1)

    return jax.vmap(one)(k, damping)


def measured_limit(
    scheme: str, zeta: float = 0.0, *, dtype: str = "float64", steps: int = 2000, most: float = 4.0
) -> float:
    """Measure the largest h sqrt(k) at which the displacement of a ball held in contact stays bounded.

    Contact is imposed on the ball in every step, and the ball starts away from its equilibrium. The motion
    counts as unbounded if the displacement from equilibrium grows by a factor of `GROWTH` within the steps.
    The result is therefore slightly above the limit: by some 1e-6 for semi-implicit Euler without damping,
    whose eigenvalues separate as a square root, by some 1e-3 with damping, and by sqrt(2 log(GROWTH) / steps)
    for undamped explicit Euler, whose limit is 0.

    Args:
        dtype: dtype of all roles.
        most: upper end of the search.

    Returns:
        the limit; `most` if there is no limit below it, 0 if there is no limit above 1e-3.
    """
    low, high = 1e-3, most
    policy = RolePrecision(**dict.fromkeys(("state", "arithmetic", "decision", "accumulate", "loss"), dtype))
    # h is one, so k is z²; without gravity the equilibrium is the floor itself
    world = World.create(Penalty(1.0), SCHEMES[scheme](1.0), 0.0, policy=policy)
    for _ in range(4):
        z = np.linspace(low, high, 33)
        runs = np.asarray(_held(world, jnp.asarray(z * z), jnp.asarray(2 * zeta * z), steps))
        if not runs.any():
            return most if high == most else high
        first = int(np.argmax(runs))
        if first == 0:
            return 0.0
        low, high = float(z[first - 1]), float(z[first])
    return 0.5 * (low + high)


@eqx.filter_jit
def _held(world: World, k: Array, damping: Array, steps: int) -> Any:
    """Return for each k whether the motion of a ball held in contact is unbounded."""

    def one(k, damping):
        here = world.with_values({"k": k, "damping": damping})
        # one iteration solves the linear equation of the implicit midpoint
        imposed = BallDecisions(jnp.ones(1, bool), jnp.ones((), jnp.int32))
        # at rest it would start without any of the direction in which velocity Verlet grows
        start = here.start(-1.0 / GROWTH, -0.5 * jnp.sqrt(k) / GROWTH)
        # in contact already when it starts
        start = start._replace(a=here.contact.acceleration(
            start.y.astype(start.a.dtype), start.v.astype(start.a.dtype), jnp.zeros_like(start.a),
            imposed.contact, here.rounding,
        ))  # fmt: skip

        def step(state, _):
            state = here.advance(state, imposed=imposed)[0]
            return state, jnp.abs(state.y[0])

        _, size = lax.scan(step, start, None, length=steps)
        return ~(jnp.max(size) < 1.0)

    return jax.vmap(one)(k, damping)


H, STEPS, LONG = 0.01, 2000, 40_000
#: Steps between bounces of a ball dropped from 1 m.
FLIGHT = round(2 * math.sqrt(2 * 9.81) / (9.81 * H))
#: Stable, resonance-free, and far below the limit of 2.
QUIET = 0.6


def run() -> Demo:
    """Drop balls on floors of increasing stiffness, and record their energies and derivatives."""
    z = np.geomspace(0.02, 3.0, 48)
    zeta = np.concatenate([[0.0], np.geomspace(0.003, 1.0, 19)])
    wide = measure("semi-implicit-euler", z, zeta, steps=STEPS, times=20, h=H)
    alone = _alone("semi-implicit-euler", [1.97, 2.02])
    explicit = _alone("explicit-euler", [0.03, 0.32, 1.0])
    long = measure("semi-implicit-euler", np.array([QUIET]), steps=LONG, times=80, h=H, starts=(1.0,))
    overflow = int(long.steps[np.argmax(np.isinf(long.gradient[:, 0, 0]))])
    kinds = wide.kind[-1, 0]
    growth = np.array([bounce_growth("semi-implicit-euler", x, flight_steps=FLIGHT) for x in z])
    bounces = STEPS / (FLIGHT + np.pi / z)
    predicted = growth * bounces / math.log(10)
    measured = np.log10(wide.gradient[-1, 0])
    chaotic = (z > 0.3) & (z < 1.6)
    ratio = float(np.median(measured[chaotic] / np.maximum(predicted[chaotic], 1e-9)))
    found = {name: measured_limit(name) for name in SCHEMES}
    narrow = measured_limit("semi-implicit-euler", dtype="float32")
    first = float(z[np.argmax(kinds == 1)])
    at = int(np.argmin(abs(z - QUIET)))
    fine = float(long.energy[np.argmax(long.steps == overflow), 0, 0])
    return Demo(
        title="Stable, but not differentiable",
        question=(
            "Up to which stiffness can the trajectory of the ball be trusted, and up to which stiffness "
            "its derivative?"
        ),
        result=(
            f"At h sqrt(k) = {QUIET} the energy of the ball stays bounded, but its gradient exceeds "
            f"the range of double precision at step {overflow:,}."
        ),
        answer=(
            "Held in contact, a ball is stable under semi-implicit Euler up to h sqrt(k) = 2 (measured "
            f"{found['semi-implicit-euler']:.4f}). A bouncing ball hardly shows this limit: at 1.97 and "
            f"2.02 its energy reaches {alone[0]:.1f} and {alone[1]:.1f} times the initial energy. The "
            f"derivative does not stay bounded: from "
            f"h sqrt(k) = {first:.2f} on it exceeds {wide.gradient_bound:.0e} within {STEPS:,} steps, "
            f"where "
            f"the exact derivative is at most {wide.exact[-1]:.0f}. At {QUIET} the derivative overflows "
            f"double precision by "
            f"step {overflow:,} while the energy stays below {fine:.1f} times the initial energy."
        ),
        numbers={
            "limit": limit("semi-implicit-euler"),
            "limit_measured": found["semi-implicit-euler"],
            "limit_measured_float32": narrow,
            "energy_semi_implicit": {"1.97": alone[0], "2.02": alone[1]},
            "energy_explicit": {"0.03": explicit[0], "0.32": explicit[1], "1.0": explicit[2]},
            "first_unbounded_gradient": first,
            "gradient_exact": float(wide.exact[-1]),
            "gradient_overflows_at_step": overflow,
            "energy_at_overflow": fine,
            "growth_measured_over_predicted": ratio,
        },
        checks=(
            Claim(
                "the measured limit agrees with the eigenvalues",
                found["semi-implicit-euler"],
                "2 ± 1e-4",
                abs(found["semi-implicit-euler"] - 2) < 1e-4,
            ),
            Claim(
                "rounding does not change the limit: float32 gives the same value",
                narrow,
                "within 1e-3",
                abs(narrow - found["semi-implicit-euler"]) < 1e-3,
            ),
            Claim(
                "the energy of a bouncing ball does not show the limit: E/E(0) just below and just above",
                alone,
                "within a factor of 10 of each other",
                0.1 < alone[0] / alone[1] < 10,
            ),
            Claim(
                f"at {QUIET} the derivative overflows and the energy does not",
                [overflow, fine],
                f"before step {LONG:,}, E/E(0) below 10",
                bool(np.isinf(long.gradient[-1, 0, 0])) and fine < 10,
            ),
            Claim(
                "all three classes are there",
                sorted(set(wide.kind.ravel().tolist())),
                "[0, 1, 2]",
                set(wide.kind.ravel().tolist()) == {0, 1, 2},
            ),
            Claim(
                "the growth of the derivative agrees with the eigenvalues of a bounce",
                ratio,
                "median ratio 1 ± 0.25",
                abs(ratio - 1) < 0.25,
            ),
            Claim(
                "explicit Euler gains energy at any step",
                explicit,
                "above 1, growing with h sqrt(k)",
                1 < explicit[0] < explicit[1] < explicit[2],
            ),
        ),
        tables=(_limits(found), _energies(alone, explicit), _growth(wide, predicted, z)),
        plots=(
            Plot(
                "steps-stiffness",
                title="Steps and stiffness: semi-implicit Euler, no damping",
                x_label="h sqrt(k)",
                y_label="steps",
                x_scale="log",
                region=Region(z, wide.steps.astype(float), wide.kind[:, 0], WORDS),
                verticals=((2.0, "limit of the contact"),),
                caption="The derivative grows without bound far below the limit, and earlier on stiffer "
                "floors.",
            ),
            Plot(
                "damping-stiffness",
                title=f"Damping and stiffness, after {STEPS} steps",
                x_label="h sqrt(k)",
                y_label="damping ratio",
                x_scale="log",
                y_scale="log",
                region=Region(z, zeta[1:], wide.kind[-1, 1:], WORDS),
                series=(
                    Series(
                        "limit of the contact",
                        np.array([limit("semi-implicit-euler", float(x)) for x in zeta[1:]]),
                        zeta[1:],
                        "line",
                        "ink",
                    ),
                ),
                caption="Damping ends the bounces, and with them the growth of the derivative.",
            ),
            Plot(
                "one-ball",
                title=f"One ball at h sqrt(k) = {QUIET}",
                x_label="steps",
                y_label="largest so far",
                y_scale="log",
                series=(
                    Series(
                        "|dy/dy0|",
                        long.steps.astype(float),
                        np.where(np.isfinite(long.gradient[:, 0, 0]), long.gradient[:, 0, 0], np.nan),
                        "line",
                        "bad",
                    ),
                    Series("E / E(0)", long.steps.astype(float), long.energy[:, 0, 0], "line", "first"),
                    Series(
                        "exact |dy/dy0|", long.steps.astype(float), long.exact, "line", "ink", dashed=True
                    ),
                ),
                verticals=((float(overflow), "overflow"),),
                caption="The derivative exceeds the bounded energy by three hundred orders of magnitude.",
            ),
            Plot(
                "growth-derivative",
                title=f"Growth of the derivative in {STEPS} steps",
                x_label="h sqrt(k)",
                y_label="log10 of the largest |dy/dy0|",
                x_scale="log",
                series=(
                    Series("measured", z, measured, "points", "first"),
                    Series("eigenvalues of a bounce", z, predicted, "line", "ink", dashed=True),
                ),
                verticals=((z[at], "above"),),
                caption="At h sqrt(k) = 1 three steps are exactly half a period, and the derivative "
                "does not grow.",
            ),
        ),
        in_md=(
            "Integrators of molecular dynamics are stable up to h omega = 2 for the fastest "
            "vibration. The derivative of a liquid is lost much earlier, at any time step, because "
            "collisions separate trajectories."
        ),
        data={"z": z.tolist(), "kind": kinds.tolist()},
    )


def _alone(scheme: str, z: list[float]) -> list[float]:
    """Return the largest E / E(0) of an undamped ball dropped from 1 m, within 600 steps of 0.01 s."""
    made = measure(scheme, np.array(z), steps=600, times=1, h=H, starts=(1.0,))
    return [float(x) for x in made.energy[-1, 0]]


def _limits(found: dict[str, float]) -> Table:
    rows = [(name, limit(name), found[name], limit(name, 0.1), measured_limit(name, 0.1)) for name in SCHEMES]
    return table(
        "Largest stable h sqrt(k) of a held contact (searched up to 4; a thousandfold growth in 2,000 steps)",
        ("scheme", "eigenvalues", "measured", "eigenvalues, zeta 0.1", "measured, zeta 0.1"),
        tuple(rows),
    )


def _energies(alone: list[float], explicit: list[float]) -> Table:
    rows = [("semi-implicit-euler", z, e) for z, e in zip((1.97, 2.02), alone, strict=True)]
    rows += [("explicit-euler", z, e) for z, e in zip((0.03, 0.32, 1.0), explicit, strict=True)]
    return table(
        "Largest E / E(0) within 600 steps, from 1 m, h = 0.01 s",
        ("scheme", "h sqrt(k)", "E / E(0)"),
        tuple(rows),
    )


def _growth(wide: StabilityMap, predicted: np.ndarray, z: np.ndarray) -> Table:
    rows = [
        (
            float(z[i]),
            float(wide.energy[-1, 0, i]),
            float(wide.gradient[-1, 0, i]),
            float(predicted[i]),
            WORDS[wide.kind[-1, 0, i]],
        )
        for i in range(0, len(z), 5)
    ]
    return table(
        f"Semi-implicit Euler, undamped, {STEPS} steps, largest over four starts",
        ("h sqrt(k)", "E / E(0)", "|dy/dy0|", "predicted log10", "class"),
        tuple(rows),
    )
