"""Running balls: a compiled loop in chunks, and the record on the host."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from mdnum.ball.contacts import Penalty
from mdnum.ball.state import BallDecisions, BallState, Reason
from mdnum.ball.world import World
from mdnum.errors import InputError
from mdnum.numerics.events import Ledger, changes_in_time
from mdnum.numerics.rounding import gamma

#: Balls times steps that leave the device at once.
_CHUNK = 2**21


@dataclass(frozen=True)
class BallRun:
    """A finished rollout; row s of what belongs to a step is the step that made state s + 1.

    Attributes:
        world: the program.
        steps, balls: of the rollout.
        y, v: heights (m) and velocities (m/s), shape (steps + 1, balls), in the dtype of the state; only
            the first and the last row where states were not kept.
        height: what each contact decision compared with zero, shape (steps, balls), or empty.
        contact: the decisions, shape (steps, balls).
        iterations, reason, residual, margin, before: of the step's solver (see `state.Solve`), shape
            (steps,) where one rule stops all balls, else (steps, balls).
        history: residual at every stop decision, shape (steps, max_iter + 1), or None.
        contacts: every contact flip; the subject is the ball, the margin minus the height. Its jump is the
            change of mechanical energy per mass over the step in which an impact or a projection resets the
            velocity, and 0 for a penalty, whose energy is continuous.
    """

    world: World
    steps: int
    balls: int
    y: Float[np.ndarray, "rows balls"]
    v: Float[np.ndarray, "rows balls"]
    height: Float[np.ndarray, "kept balls"]
    contact: Bool[np.ndarray, "steps balls"]
    iterations: Int[np.ndarray, "steps ..."]
    reason: Int[np.ndarray, "steps ..."]
    residual: Float[np.ndarray, "steps ..."]
    margin: Float[np.ndarray, "steps ..."]
    before: Float[np.ndarray, "steps ..."]
    history: Float[np.ndarray, "steps decisions"] | None
    contacts: Ledger

    @property
    def kept(self) -> bool:
        """Whether every state is there."""
        return len(self.y) == self.steps + 1

    @property
    def h(self) -> float:
        """Time step, s."""
        return float(self.world.integrator.h)

    @cached_property
    def time(self) -> Float[np.ndarray, "times"]:
        """Time of each state, s, shape (steps + 1,)."""
        return np.arange(self.steps + 1) * self.h

    @cached_property
    def first_contact(self) -> Int[np.ndarray, "balls"]:
        """The step (from 1) of each ball's first contact decision that was yes; -1 where there was none."""
        touched = self.contact.any(axis=0)
        return np.where(touched, self.contact.argmax(axis=0) + 1, -1)

    @property
    def final(self) -> tuple[np.ndarray, np.ndarray]:
        """Height and velocity at the end."""
        return self.y[-1], self.v[-1]

    @cached_property
    def energy(self) -> Float[np.ndarray, "rows balls"]:
        """Mechanical energy per mass, (m/s)², of each state that was kept."""
        return energy(self.world, self.y, self.v)

    def ended(self) -> dict[str, int]:
        """How many solves ended for which reason."""
        codes, counts = np.unique(self.reason, return_counts=True)
        return {Reason(code).word: int(n) for code, n in zip(codes, counts, strict=True)}

    def decisions(self) -> BallDecisions:
        """The decisions of all steps, to be imposed on another rollout."""
        return BallDecisions(self.contact, self.iterations)  # type: ignore[arg-type]


def energy(world: World, y: np.ndarray, v: np.ndarray) -> Float[np.ndarray, "..."]:
    """Mechanical energy per mass, (m/s)²: kinetic, gravity, and the spring of a penalty contact.

    Error: evaluated in float64; a softplus contact is counted as the spring it approximates.
    """
    y, v = np.asarray(y, np.float64), np.asarray(v, np.float64)
    total = float(world.gravity) * y + 0.5 * v * v
    if isinstance(world.contact, Penalty):
        total = total + 0.5 * float(world.contact.k) * np.minimum(y, 0.0) ** 2
    return total


def simulate(
    world: World,
    start: BallState,
    steps: int,
    *,
    history: bool = False,
    keep: bool = True,
    imposed: BallDecisions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BallRun:
    """Advance a batch of balls and record every decision.

    Args:
        world: the program.
        start: from `world.start`.
        steps: steps to make.
        history: keep the residual of every stop decision too.
        keep: keep every state; otherwise the first and the last, and the flips.
        imposed: decisions of every step to act on instead of the world's own, leading axis steps.
        progress: called with the steps made and asked for.

    Returns:
        the record, on the host.

    Raises:
        InputError: steps below 1.
    """
    if steps < 1:
        raise InputError(f"steps = {steps}; expected at least 1")
    balls = start.y.shape[0]
    chunk = max(1, min(steps, _CHUNK // max(balls, 1)))
    parts: list[dict[str, np.ndarray]] = [{"y": np.asarray(start.y)[None], "v": np.asarray(start.v)[None]}]
    ledgers: list[dict[str, np.ndarray]] = []
    state, made, before = start, 0, np.asarray(start.touching)
    while made < steps:
        length = min(chunk, steps - made)
        given = None if imposed is None else jax.tree.map(lambda x: x[made : made + length], imposed)  # noqa: B023
        state, out = _chunk(world, state, given, length, history)
        rows = {name: np.asarray(value) for name, value in out.items()}
        ledgers.append(_flips(world, made, before, parts[-1]["y"][-1], parts[-1]["v"][-1], rows))
        before = rows["contact"][-1]
        if not keep:
            rows |= {"y": rows["y"][-1:], "v": rows["v"][-1:], "height": rows["height"][:0]}
        parts.append(rows)
        made += length
        if progress is not None:
            progress(made, steps)
    whole: dict[str, Any] = {
        name: np.concatenate([part[name] for part in parts if name in part]) for name in parts[-1]
    }
    if not keep:
        whole |= {name: whole[name][[0, -1]] for name in ("y", "v")}
    flips = {name: np.concatenate([one[name] for one in ledgers]) for name in ledgers[0]}
    velocity = flips.pop("velocity")
    contacts = Ledger(channel="contact", **flips, extra={"velocity": velocity})
    return BallRun(world=world, steps=steps, balls=balls, **{"history": None, **whole}, contacts=contacts)


@eqx.filter_jit
def _chunk(world: World, state: BallState, imposed: Any, length: int, history: bool) -> Any:
    def step(state, given):
        after, record = world.advance(state, imposed=given, history=history)
        solve = record.solve
        row = {
            "y": after.y,
            "v": after.v,
            "height": record.height,
            "contact": record.contact,
            "iterations": solve.iterations,
            "reason": solve.reason,
            "residual": solve.residual,
            "margin": solve.margin,
            "before": solve.before,
        }
        return after, row | ({"history": solve.history} if history else {})

    return lax.scan(step, state, imposed, length=length)


def _flips(
    world: World,
    made: int,
    before: np.ndarray,
    y: np.ndarray,
    v: np.ndarray,
    rows: dict[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """The rows of the ledger of one chunk.

    Args:
        made: steps made before it.
        before: contact decisions ahead of it.
        y, v: the state ahead of it.
        rows: its record.
    """
    contact = rows["contact"]

    def packed(bits: np.ndarray) -> np.ndarray:
        return np.packbits(bits, axis=-1, bitorder="little")[..., None]

    row, ball, _, now = changes_in_time(packed(before), packed(contact))
    height = rows["height"][row, ball].astype(np.float64)
    first = row == 0
    y_old = np.where(first, y[ball], rows["y"][row - 1, ball]).astype(np.float64)
    v_old = np.where(first, v[ball], rows["v"][row - 1, ball]).astype(np.float64)
    bound = height_bound(world, y_old, v_old)
    entered = now == 1
    y_new, v_new = rows["y"][row, ball], rows["v"][row, ball]
    jump = energy(world, y_new, v_new) - energy(world, y_old, v_old)
    resets = entered & (not isinstance(world.contact, Penalty))
    lift = 0.0 if world.lift is None else float(world.lift)
    return {
        "step": row + made + 1,
        "subject": ball[:, None],
        "entered": entered,
        # a contact that ends was decided against the threshold for leaving
        "margin": np.where(entered, 0.0, lift) - height,
        "bound": bound,
        "jump": np.where(resets, jump, 0.0),
        "velocity": v_old,
    }


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
