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

from mdnum.ball.contacts import Penalty, Projection
from mdnum.ball.integrators import EventLocated, ImplicitMidpoint
from mdnum.ball.state import BallState, Decisions, Reason
from mdnum.ball.world import World
from mdnum.errors import InputError
from mdnum.events import Ledger, changes_in_time
from mdnum.precision.bounds import gamma

#: Balls times steps that leave the device at once.
_CHUNK = 2**21
#: Of the record, what is kept only with `keep`.
_STATES = ("y", "v", "height")


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

    def told(self) -> Decisions:
        """The decisions of all steps, to be told to another rollout."""
        return Decisions(self.contact, self.iterations)  # type: ignore[arg-type]


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
    told: Decisions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BallRun:
    """Advance a batch of balls and record every decision.

    Args:
        world: the program.
        start: from `world.start`.
        steps: steps to make.
        history: keep the residual of every stop decision too.
        keep: keep every state; otherwise the first and the last, and the flips.
        told: decisions of every step to act on instead of the world's own, leading axis steps.
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
    parts: list[dict[str, np.ndarray]] = []
    ledgers: list[dict[str, np.ndarray]] = []
    state, made = start, 0
    before = np.asarray(start.touching)
    y_rows, v_rows = [np.asarray(start.y)[None]], [np.asarray(start.v)[None]]
    while made < steps:
        length = min(chunk, steps - made)
        given = None if told is None else jax.tree.map(lambda x: x[made : made + length], told)  # noqa: B023
        state, out = _chunk(world, state, given, length, history)
        rows = {name: np.asarray(value) for name, value in out.items()}
        ledgers.append(_flips(world, made, before, y_rows[-1][-1], v_rows[-1][-1], rows))
        before = rows["contact"][-1]
        last = slice(None) if keep else slice(-1, None)
        y_rows.append(rows["y"][last])
        v_rows.append(rows["v"][last])
        parts.append({name: value for name, value in rows.items() if keep or name not in _STATES})
        made += length
        if progress is not None:
            progress(made, steps)
    if not keep:
        y_rows, v_rows = [y_rows[0], y_rows[-1]], [v_rows[0], v_rows[-1]]

    def whole(name: str) -> np.ndarray:
        return np.concatenate([part[name] for part in parts])

    return BallRun(
        world=world,
        steps=steps,
        balls=balls,
        y=np.concatenate(y_rows),
        v=np.concatenate(v_rows),
        height=whole("height") if keep else np.zeros((0, balls), y_rows[0].dtype),
        contact=whole("contact"),
        iterations=whole("iterations"),
        reason=whole("reason"),
        residual=whole("residual"),
        margin=whole("margin"),
        before=whole("before"),
        history=whole("history") if history else None,
        contacts=Ledger(
            channel="contact",
            **{name: np.concatenate([one[name] for one in ledgers]) for name in _LEDGER},
            extra={"velocity": np.concatenate([one["velocity"] for one in ledgers])},
        ),
    )


_LEDGER = ("step", "subject", "entered", "margin", "bound", "jump")


@eqx.filter_jit
def _chunk(world: World, state: BallState, told: Any, length: int, history: bool) -> Any:
    def step(state, given):
        after, record = world.advance(state, told=given, history=history)
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

    return lax.scan(step, state, told, length=length)


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


@dataclass(frozen=True)
class Difference:
    """Where two rollouts of the same length part.

    Attributes:
        seed: first step whose state bits differ (0: the start itself); None where none do.
        fork: first step whose decisions differ; None where none do.
        channel: "contact" or "stop", whichever differs at the fork; "" without one.
        ball: the first ball whose decision differs there; -1 where the decision is the batch's.
        margins: the deciding margin in the first and in the second run: for a contact minus the height, for
            a stop threshold minus residual at the decision that differed.
        iterations_differ: number of steps whose iteration counts differ; 0 where the runs count other things
            (impacts, iterations of one solver or another, nothing).
        contacts_differ: number of contact decisions that differ.
        separation: largest |difference| of heights at each step, m, shape (steps + 1,); empty where states
            were not kept.
    """

    seed: int | None
    fork: int | None
    channel: str
    ball: int
    margins: tuple[float, float]
    iterations_differ: int
    contacts_differ: int
    separation: Float[np.ndarray, "times"]


def first_difference(a: BallRun, b: BallRun) -> Difference:
    """Where two rollouts part.

    Raises:
        InputError: of other lengths or batch sizes.
    """
    if (a.steps, a.balls) != (b.steps, b.balls):
        raise InputError(
            f"the first run has {a.steps} steps of {a.balls} balls, the second {b.steps} of {b.balls}",
            remedy="Compare runs of equal size",
        )
    separation = np.zeros(0)
    seed = None
    if a.kept and b.kept:
        y = np.stack([run.y.astype(np.float64) for run in (a, b)])
        v = np.stack([run.v.astype(np.float64) for run in (a, b)])
        separation = np.max(np.abs(y[0] - y[1]), axis=1)
        apart = np.any((y[0] != y[1]) | (v[0] != v[1]), axis=1)
        seed = int(apart.argmax()) if apart.any() else None
    contact = a.contact != b.contact
    # a rule per ball and a rule for all have counts of other shapes: compare them per ball
    counts = [_per_ball(run) for run in (a, b)]
    stops = counts[0] != counts[1]
    if not counts_alike(a, b):
        # impacts are no iterations, and a run without a solver has stopped none: nothing to compare
        stops = np.zeros_like(stops)
    at = [
        int(steps.argmax()) if (steps := differ.any(axis=1)).any() else a.steps for differ in (contact, stops)
    ]
    row = min(at)
    if row == a.steps:
        return Difference(seed, None, "", -1, (np.nan, np.nan), 0, 0, separation)
    channel = "contact" if at[0] <= at[1] else "stop"
    ball = int((contact if channel == "contact" else stops)[row].argmax())
    if channel == "contact":
        margins = _contact_margin(a, row, ball), _contact_margin(b, row, ball)
    else:
        margins = _stop_margins(a, b, row, ball)
        ball = ball if a.iterations.ndim == 2 else -1
    return Difference(
        seed, row + 1, channel, ball, margins, int(stops.any(axis=1).sum()), int(contact.sum()), separation
    )


def counts_alike(a: BallRun, b: BallRun) -> bool:
    """Whether the iteration counts of two runs count the same, so that they can be compared."""
    return _counted(a) == _counted(b)


def _counted(run: BallRun) -> str:
    """What the iteration counts of a run count."""
    contact, scheme = run.world.contact, run.world.integrator
    if isinstance(scheme, EventLocated):
        return "impacts"
    if isinstance(contact, Projection):
        return "iterations of a projection"
    if isinstance(contact, Penalty) and isinstance(scheme, ImplicitMidpoint):
        return "iterations of Newton's method"
    return "nothing"


def _per_ball(run: BallRun) -> np.ndarray:
    counts = run.iterations
    return counts if counts.ndim == 2 else np.broadcast_to(counts[:, None], run.contact.shape)


def _contact_margin(run: BallRun, row: int, ball: int) -> float:
    return -float(run.height[row, ball]) if len(run.height) else np.nan


def _stop_margins(a: BallRun, b: BallRun, row: int, ball: int) -> tuple[float, float]:
    """The margins of the decision after which one run stopped and the other went on."""

    def at(run: BallRun, name: str) -> float:
        values = getattr(run, name)
        return float(values[row, ball] if values.ndim == 2 else values[row])

    counts = [int(_per_ball(run)[row, ball]) for run in (a, b)]
    shorter, longer = (a, b) if counts[0] < counts[1] else (b, a)
    # the longer run's decision at that iteration is on record if it made just one more iteration
    went_on = at(longer, "before") if abs(counts[0] - counts[1]) == 1 else np.nan
    stopped = at(shorter, "margin")
    return (stopped, went_on) if shorter is a else (went_on, stopped)
