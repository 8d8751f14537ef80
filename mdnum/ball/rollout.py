"""Simulation of bouncing balls, records of runs, and comparison of two runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from mdnum.ball.step import BallDecisions, BallState, EventLocated, ImplicitMidpoint, Penalty, Projection
from mdnum.ball.stopping import Reason
from mdnum.ball.world import World
from mdnum.bits import changes_in_time
from mdnum.errors import InputError, expect_at_least
from mdnum.numerics.events import Ledger
from mdnum.numerics.forked import check_not_forked
from mdnum.numerics.rounding import gamma
from mdnum.plain import result

_CHUNK = 2**21  # balls times steps that leave the device at once


@result
class BallRun:
    """Record of a finished run. Row s of per-step arrays belongs to the step from state s to s + 1.

    Attributes:
        world: the bouncing-ball model that was simulated.
        steps, balls: number of steps and of balls.
        y, v: heights (m) and velocities (m/s), shape (steps + 1, balls), in the dtype of the state; only the
            first and the last state if states were not kept.
        height: height that each contact decision compared with zero, shape (steps, balls), or empty.
        contact: the contact decisions, shape (steps, balls).
        iterations, reason, residual, margin, before: results of the step's solver (see `stopping.Solve`),
            shape (steps,) if one rule stops all balls, else (steps, balls).
        history: residual at every stop decision, shape (steps, max_iter + 1), or None.
        contacts: ledger of all contact flips: the subject is the ball, the margin is minus the height. The
            jump is the change of mechanical energy per mass in the step in which an impact or a projection
            resets the velocity; it is 0 for a penalty, whose energy is continuous.
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
        """True if the states of all time steps were kept."""
        return len(self.y) == self.steps + 1

    @property
    def h(self) -> float:
        """Time step, s."""
        return float(self.world.integrator.h)

    @cached_property
    def time(self) -> Float[np.ndarray, "times"]:
        """Time (s) of each state, shape (steps + 1,)."""
        return np.arange(self.steps + 1) * self.h

    @cached_property
    def first_contact(self) -> Int[np.ndarray, "balls"]:
        """Step (from 1) at which each ball first touches the floor. -1 if a ball never does."""
        touched = self.contact.any(axis=0)
        return np.where(touched, self.contact.argmax(axis=0) + 1, -1)

    @cached_property
    def energy(self) -> Float[np.ndarray, "rows balls"]:
        """Mechanical energy per mass, (m/s)², of each kept state."""
        return energy(self.world, self.y, self.v)

    def ended(self) -> dict[str, int]:
        """Number of iterative solves that ended for each reason."""
        codes, counts = np.unique(self.reason, return_counts=True)
        return {Reason(code).word: int(n) for code, n in zip(codes, counts, strict=True)}

    def decisions(self) -> BallDecisions:
        """Return the decisions of all steps, which can be imposed on another run."""
        return BallDecisions(self.contact, self.iterations)  # type: ignore[arg-type]


def energy(world: World, y: np.ndarray, v: np.ndarray) -> Float[np.ndarray, "..."]:
    """Compute kinetic, gravitational and spring energy per mass, (m/s)².

    Error: the energy is computed in float64. A softplus contact counts as a linear spring.
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
    """Run a simulation of balls, and record every decision.

    Args:
        start: start state, made by `world.start`.
        history: whether to keep also the residual of every stop decision.
        keep: whether to keep every state; otherwise only the first and last states and the flips are kept.
        imposed: decisions of every step (first axis: steps) that replace the model's own decisions.
        progress: called with the numbers of steps made and requested.

    Returns:
        the record of the run.

    Raises:
        InputError: the number of steps is below 1.
    """
    check_not_forked()
    expect_at_least(1, steps=steps)
    balls = start.y.shape[0]
    chunk = max(1, min(steps, _CHUNK // max(balls, 1)))
    # one compiled program for runs that decide by themselves, under pins, and under another's decisions
    own = undecided(world, start, steps) if imposed is None else imposed
    imposed = BallDecisions(np.asarray(own.contact, np.int8), np.asarray(own.iterations, np.int32))  # type: ignore[arg-type]
    parts: list[dict[str, np.ndarray]] = [{"y": np.asarray(start.y)[None], "v": np.asarray(start.v)[None]}]
    ledgers: list[dict[str, np.ndarray]] = []
    state, made, before = start, 0, np.asarray(start.touching)
    while made < steps:
        length = min(chunk, steps - made)
        given = [x[made : made + length] for x in imposed]
        state, out = _chunk(world, state, BallDecisions(*given), length, history)
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


#: Shape of the counts of a step, by the structure of a world and the number of balls.
_COUNTS: dict[tuple[Any, int], tuple[int, ...]] = {}


def undecided(world: World, start: BallState, steps: int) -> BallDecisions:
    """Return arrays in which no decision is imposed (-1)."""
    kind = jax.tree.structure(world), len(start.y)
    if kind not in _COUNTS:
        solve = eqx.filter_eval_shape(lambda world, start: world.advance(start)[1].solve, world, start)
        _COUNTS[kind] = solve.iterations.shape
    contact = np.broadcast_to(np.int8(-1), (steps, len(start.y)))
    return BallDecisions(contact, np.broadcast_to(np.int32(-1), (steps, *_COUNTS[kind])))  # type: ignore[arg-type]


@eqx.filter_jit
def _chunk(world: World, state: BallState, imposed: Any, length: int, history: bool) -> Any:
    def step(state, given):
        after, record = world.advance(state, imposed=given, history=history)
        row = {"y": after.y, "v": after.v, "height": record.height, "contact": record.contact}
        solve = record.solve._asdict()
        if not history:
            del solve["history"]
        return after, row | solve

    return lax.scan(step, state, imposed, length=length)


def _flips(world: World, made: int, before, y, v, rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Find all changes of contact decisions in a group of steps."""
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
    """Return a bound (m) on the rounding error of the height in a contact decision.

    The height is computed with four roundings from the previous state.

    Args:
        y, v: height (m) and velocity (m/s) of the previous state.
    """
    y, v = np.asarray(y, np.float64), np.asarray(v, np.float64)
    h, free = float(world.integrator.h), abs(float(world.gravity))
    return gamma(4, world.policy.dtype("arithmetic")) * (np.abs(y) + h * np.abs(v) + h * h * free)


def residual_bound(world: World, residual: Any, terms: int) -> Any:
    """Return a bound on the rounding error of a residual, in the unit of the residual.

    The terms of a residual have one sign, so the relative error is at most Higham's gamma_n.

    Args:
        residual: residual that a stop decision compares with its threshold.
        terms: number of balls in the residual; 1 if each ball has its own residual.
    """
    return gamma(max(terms - 1, 1), world.policy.dtype("accumulate")) * residual


# --- two rollouts side by side -------------------------------------------------------------------------


class CrossDecision(NamedTuple):
    """A contact or stop decision that differs between two runs."""

    step: int  # from 1
    channel: str  # "contact" or "stop"
    ball: int  # whose; -1 for a count that all balls share
    # a, b: what each run decided: whether the ball touches, or how many iterations
    a: int
    b: int
    # margin_a, margin_b: minus the height, or tolerance minus residual at the decision at which one run
    # stopped and the other did not; NaN where a run made no such decision
    margin_a: float
    margin_b: float
    # bound_a, bound_b: on the rounding error of what was compared
    bound_a: float
    bound_b: float

    @property
    def run(self) -> str:
        """Name of the run (A or B) with the contact or the earlier stop."""
        return "A" if (self.a > self.b) == (self.channel == "contact") else "B"


@dataclass(frozen=True)
class BallDifference:
    """Steps at which two runs first differ, and differences of the heights."""

    seed: int | None  # first step whose state bits differ (0: the start itself); None where none do
    fork: int | None  # first step whose decisions differ; None where none do
    channel: str  # "contact" or "stop", whichever differs at the fork; "" without one
    ball: int  # the first ball whose decision differs there; -1 where the decision is the batch's
    # the deciding margin in the first and in the second run (see `CrossDecision`)
    margins: tuple[float, float]
    # number of steps whose iteration counts differ; 0 where the runs count other things (impacts, iterations
    # of one solver or another, nothing)
    iterations_differ: int
    contacts_differ: int  # number of contact decisions that differ
    # largest |difference| of heights at each step, m, shape (steps + 1,); empty where states were not kept
    separation: Float[np.ndarray, "times"]


def first_difference(a: BallRun, b: BallRun) -> BallDifference:
    """Find the steps at which states and decisions of two runs first differ.

    Raises:
        InputError: the runs have different lengths or numbers of balls.
    """
    if (a.steps, a.balls) != (b.steps, b.balls):
        raise InputError(
            f"run A has {a.steps} steps and {a.balls} balls; run B has {b.steps} steps and {b.balls} balls",
            remedy="Compare runs with the same numbers of steps and balls",
        )
    separation, seed = np.zeros(0), None
    if a.kept and b.kept:
        y, v = (np.stack([getattr(run, name).astype(np.float64) for run in (a, b)]) for name in "yv")
        separation = np.max(np.abs(y[0] - y[1]), axis=1)
        bits = np.any((y[0] != y[1]) | (v[0] != v[1]), axis=1)
        seed = int(bits.argmax()) if bits.any() else None
    contact, stops = a.contact != b.contact, _unequal_counts(a, b, a.steps)
    steps = np.flatnonzero(contact.any(axis=1) | stops.any(axis=1))
    if not len(steps):
        return BallDifference(seed, None, "", -1, (np.nan, np.nan), 0, 0, separation)
    first = cross_decisions(a, b, int(steps[0]) + 1)[0]
    return BallDifference(
        seed, first.step, first.channel, first.ball, (first.margin_a, first.margin_b),
        int(stops.any(axis=1).sum()), int(contact.sum()), separation,
    )  # fmt: skip


def cross_decisions(a: BallRun, b: BallRun, last: int | None = None) -> list[CrossDecision]:
    """List all decisions that differ between two runs, by step. Contacts precede stops.

    Args:
        a, b: the two runs; margins and bounds of contacts are NaN if their states were not kept.
        last: the last step to compare; default all.
    """
    rows = a.steps if last is None else last
    row, ball = np.nonzero(a.contact[:rows] != b.contact[:rows])
    columns: list[Any] = [row + 1, np.full(len(row), "contact"), ball]
    columns += [run.contact[row, ball].astype(np.int64) for run in (a, b)]
    unknown = np.full(len(row), np.nan)
    kept = a.kept and b.kept
    columns += [-run.height[row, ball].astype(np.float64) if kept else unknown for run in (a, b)]
    columns += [
        height_bound(run.world, run.y[row, ball], run.v[row, ball]) if kept else unknown for run in (a, b)
    ]
    found = [CrossDecision(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]
    found += _stops(a, b, rows)
    return sorted(found, key=lambda flip: (flip.step, flip.channel == "stop", flip.ball))


def _stops(a: BallRun, b: BallRun, rows: int) -> list[CrossDecision]:
    """List the steps at which the solvers of two runs made different numbers of iterations."""
    row, ball = np.nonzero(_unequal_counts(a, b, rows))
    if a.iterations.ndim == b.iterations.ndim == 1:
        ball = np.full(len(row), -1)
    made = [_at(run.iterations, row, ball).astype(np.int64) for run in (a, b)]
    fewer = np.minimum(*made)
    margins, bounds = [], []
    for run, count in zip((a, b), made, strict=True):
        stopped, before, residual = (
            _at(values, row, ball).astype(np.float64) for values in (run.margin, run.before, run.residual)
        )
        # the decision at which one went on and the other did not is on record in the run that stopped, and
        # in the other if it stopped at the next
        margin = np.where(count == fewer, stopped, np.where(count == fewer + 1, before, np.nan))
        margins.append(margin)
        compared = np.abs(residual + stopped - margin)
        terms = 1 if run.iterations.ndim == 2 else run.balls
        bounds.append(residual_bound(run.world, np.where(np.isfinite(compared), compared, 0.0), terms))
    columns = (row + 1, np.full(len(row), "stop"), ball, *made, *margins, *bounds)
    return [CrossDecision(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]


def _solving(run: BallRun, rows: int) -> np.ndarray:
    """Return, for each step and ball, whether solver iterations can move the ball."""
    if isinstance(run.world.contact, Projection):
        return run.contact[:rows]
    return np.ones((rows, run.balls), bool)


def _at(values: np.ndarray, row: np.ndarray, ball: np.ndarray) -> np.ndarray:
    return values[row] if values.ndim == 1 else values[row, ball]


def overridden(
    run: BallRun, last: int | None = None
) -> tuple[Int[np.ndarray, "times"], Float[np.ndarray, "times"]]:
    """Count the imposed decisions that the run would have made differently.

    Args:
        run: a run with imposed decisions.
        last: the last step to compare; default all.

    Returns:
        the number at each step 0..last, and the largest |height - threshold| (m) of these contacts, or 0.
    """
    rows = run.steps if last is None else last
    # as it is compared: in the dtype of decisions
    height = run.height[:rows].astype(run.world.policy.dtype("decision")).astype(np.float64)
    before = np.vstack([np.asarray(run.y[:1] < 0), run.contact[:rows][:-1]]) if rows else run.contact[:0]
    lift = 0.0 if run.world.lift is None else float(run.world.lift)
    threshold = np.where(before, lift, 0.0)
    own = np.where(before & (lift > 0), height <= lift, height < 0)
    against = own != run.contact[:rows]
    far = np.where(against, np.abs(height - threshold), 0.0)
    margin, earlier = run.margin[:rows].astype(np.float64), run.before[:rows].astype(np.float64)
    # it would have stopped just where it was made to if it went on before and stops there
    solved = np.isfinite(run.residual[:rows].astype(np.float64))
    held = (margin > 0) & (earlier <= 0)
    world = run.world
    rule = getattr(world.contact, "stop", None) or getattr(world.integrator, "stop", None)
    if rule is not None:
        held |= (run.iterations[:rows] >= rule.max_iter) & (earlier <= 0)
    if solved.ndim == 2:
        solved &= _solving(run, rows)
    stops = (solved & ~held).reshape(rows, -1).sum(axis=1)
    return np.r_[0, against.sum(axis=1) + stops], np.r_[0.0, far.max(axis=1, initial=0.0)]


def _unequal_counts(a: BallRun, b: BallRun, rows: int) -> np.ndarray:
    """Return a mask of the steps, or steps and balls, with different iteration counts."""
    counts = [run.iterations.reshape(run.steps, -1)[:rows] for run in (a, b)]
    differ = counts[0] != counts[1]
    if _counted(a) != _counted(b):
        # impacts are no iterations, and a run without a solver has stopped none: nothing to compare
        return np.zeros_like(differ)
    if a.iterations.ndim == b.iterations.ndim == 1:
        return differ
    return differ & (_solving(a, rows) | _solving(b, rows))


def _counted(run: BallRun) -> str:
    """Return the kind of iteration that a run counts, such as "impacts"."""
    contact, scheme = run.world.contact, run.world.integrator
    if isinstance(scheme, EventLocated):
        return "impacts"
    if isinstance(contact, Projection):
        return "iterations of a projection"
    if isinstance(contact, Penalty) and isinstance(scheme, ImplicitMidpoint):
        return "iterations of Newton's method"
    return "nothing"
