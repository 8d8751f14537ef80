"""Bouncing-ball simulation with the interface `Program`, by which two runs are compared."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mdnum.ball.limits import spacing
from mdnum.ball.problem import START, BallProblem
from mdnum.ball.rollout import BallRun, CrossDecision, cross_decisions, overridden, simulate, undecided
from mdnum.ball.step import BallDecisions, Projection
from mdnum.ball.world import PARAMETERS
from mdnum.errors import InputError
from mdnum.numerics.events import Ledger
from mdnum.program import Decision, DecisionHistory, Differing, Number, PairRows


@dataclass(frozen=True)
class ImposedDecision:
    """A single decision that is imposed on a run."""

    channel: Literal["contact", "stop"]
    step: int  # from 1
    ball: int  # whose; -1 for the count that all balls share
    value: int  # whether it touches (0 or 1), or how many iterations it makes


@dataclass(frozen=True)
class BallProgram:
    """A bouncing-ball run: model, initial state and steps."""

    problem: BallProblem  # the program
    # its balls are those of the other program in this order; None where they are the same
    order: tuple[int, ...] | None = None
    pins: tuple[ImposedDecision, ...] = ()  # decisions that are imposed on it
    _runs: dict[int, BallRun] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def size(self) -> int:
        """Number of balls."""
        return int(np.size(self.problem.y0))

    @property
    def steps(self) -> int:
        """Number of time steps in the system file."""
        return self.problem.steps

    @property
    def timestep(self) -> float:
        """Time step, s."""
        return float(self.problem.world.integrator.h)

    @property
    def scale(self) -> float:
        """Largest initial height (m). Largest height in the run if all balls start on the floor."""
        start = self.problem.world.start(self.problem.y0, self.problem.v0)
        height = float(np.abs(np.asarray(start.y, np.float64)).max())
        if height:
            return height
        heights = np.abs(self.run(self.steps).y.astype(np.float64))
        return float(heights[np.isfinite(heights).all(axis=1)].max()) or 1.0

    @property
    def ulp(self) -> float:
        """One ulp of the largest initial height, m."""
        return spacing(float(np.abs(np.asarray(self.problem.y0)).max()), self.problem.world.policy.state)

    @property
    def streams(self) -> bool:
        """Whether runs can be continued. Always False: the number of steps is fixed."""
        return False

    @property
    def imposable(self) -> None:
        """Reason why decisions cannot be imposed. Always None: every decision can be imposed."""
        return None

    def check(self, other: BallProgram) -> None:
        """Raise an error if two programs cannot be compared.

        Raises:
            InputError: the kinds of decisions or the numbers of balls differ.
        """
        kinds = [type(one.problem.world.contact).__name__ for one in (self, other)]
        if kinds[0] != kinds[1] or (self.problem.world.lift is None) != (other.problem.world.lift is None):
            raise InputError(
                f"the runs have contact models {kinds[0]} and {kinds[1]}, whose decisions cannot be compared",
                remedy="Compare only runs with the same kind of contact model",
            )
        if self.size != other.size:
            raise InputError(
                f"the two runs have {self.size} and {other.size} balls",
                remedy="Compare runs with the same number of balls",
            )

    def run(self, steps: int, decisions: BallDecisions | None = None) -> BallRun:
        """Run the simulation. In the result, balls are in the order of the other run.

        Args:
            decisions: decisions imposed on the balls in that order; None for the program's own decisions and
                pins.
        """
        if decisions is None and steps in self._runs:
            return self._runs[steps]
        problem, index = self.problem, None if self.order is None else list(self.order)
        if decisions is None:
            imposed = self._pinned(steps)
        elif index is None:
            imposed = decisions
        else:
            counts = decisions.iterations
            counts = counts[:, index] if counts.ndim == 2 else counts
            imposed = BallDecisions(decisions.contact[:, index], counts)
        run = simulate(problem.world, problem.world.start(problem.y0, problem.v0), steps, imposed=imposed)
        run = run if index is None else _reordered(run, np.asarray(index))
        if decisions is None:
            self._runs[steps] = run
        return run

    def _pinned(self, steps: int) -> BallDecisions | None:
        """Return imposed decisions as arrays (-1: not imposed). None if no decision is imposed."""
        if not self.pins:
            return None
        world = self.problem.world
        start = world.start(self.problem.y0, self.problem.v0)
        imposed = BallDecisions(*map(np.array, undecided(world, start, steps)))  # type: ignore[arg-type]
        for pin in self.pins:
            if pin.step > steps:
                continue
            decided = imposed.contact if pin.channel == "contact" else imposed.iterations
            # the last of one column is all that there is: a count that all balls share is that of ball -1
            decided.reshape(steps, -1)[pin.step - 1, pin.ball] = pin.value
        return imposed

    def lockstep(
        self, other: BallProgram, last: int, *, forward: bool, back: bool, guard: float | None
    ) -> Iterator[PairRows]:
        """Compare two runs at all steps at which both are finite (see `Program.lockstep`)."""
        asked = last
        runs = {"A": self.run(asked), "B": other.run(asked)}
        a, b = runs.values()
        last, failed = _ends(a, b)
        flips = cross_decisions(a, b, last)
        separation = {"B": _apart(a, b, last)}
        y, v = (np.stack([getattr(run, name)[: last + 1] for run in (a, b)]) for name in "yv")
        overridden_count: dict[str, np.ndarray] = {}
        furthest: dict[str, np.ndarray] = {}
        if forward:
            runs["B|A"] = other.run(asked, a.decisions())
            overridden_count["B|A"], furthest["B|A"] = overridden(runs["B|A"], last)
            separation["B|A"] = _guarded(_apart(a, runs["B|A"], last), furthest["B|A"], guard)
            from_b = _apart(b, runs["B|A"], last)
            separation["B|A from B"] = np.where(np.isnan(separation["B|A"]), np.nan, from_b)
        if back:
            runs["A|B"] = self.run(asked, b.decisions())
            separation["A|B"] = _apart(b, runs["A|B"], last)
            separation["A|B from A"] = _apart(a, runs["A|B"], last)
        steps = np.array([flip.step for flip in flips], np.int64)
        yield PairRows(
            first=0,
            separation=separation,
            bits=((y[0] != y[1]) | (v[0] != v[1])).any(axis=1),
            energy={name: run.energy[: last + 1].mean(axis=1) for name, run in runs.items() if name != "A|B"},
            cross=np.bincount(steps, minlength=last + 1)[: last + 1],
            flips=flips,
            overridden=overridden_count,
            furthest=furthest,
            failed=failed,
            runs=runs,
        )

    def repeats(
        self, others: Sequence[BallProgram], last: int, tolerance: float, guard: float
    ) -> list[tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]]:
        """Compute the distance of each perturbed run from this run (see `Program.repeats`)."""
        # of the number of steps that was run before: another one would be another compiled program
        steps = min((known for known in self._runs if known >= last), default=last)
        a = self.run(steps)
        found = []
        for other in others:
            under = other.run(steps, a.decisions())
            separation = _guarded(_apart(a, under, last), overridden(under, last)[1], guard)
            found.append((_apart(a, other.run(steps), last), separation))
        return found

    def nudged(self, size: float, count: int, seed: int) -> list[BallProgram]:
        """Return programs whose initial heights are changed randomly by at most max(`size`, `ulp`)."""
        rng = np.random.default_rng(seed)
        y = np.asarray(np.atleast_1d(self.problem.y0), np.float64)
        size = max(size, self.ulp)
        moved = [y + size * rng.uniform(-1, 1, y.shape) for _ in range(count)]
        return [replace(self, problem=replace(self.problem, y0=y0)) for y0 in moved]

    def decision(self, other: BallProgram, flips: Sequence[CrossDecision], separation: float) -> Decision:
        """Return the first differing decision of two runs. Within one step, contacts precede stops."""
        first = flips[0]
        return Decision(
            channel=first.channel,
            step=first.step,
            subject=() if first.ball < 0 else (first.ball,),
            run=first.run,
            entered=True,
            a=first.a,
            b=first.b,
            margins={"A": first.margin_a, "B": first.margin_b},
            bounds={"A": first.bound_a, "B": first.bound_b},
            separation=separation,
            also=len(flips) - 1,
        )

    def number(self, key: str) -> Number:
        """Find a parameter by its full key, the last word of the key, or its model name.

        Raises:
            InputError: the parameter does not exist.
        """
        word = key.rpartition(".")[2]
        word = next((name for name, row in PARAMETERS.items() if word in row.get("words", ())), word)
        problem, world = self.problem, self.problem.world
        if word not in START and not world.has(word):
            known = ", ".join([*world.parameters, *START])
            raise InputError(f"{key!r} is not a parameter that can be varied", remedy=f"Use one of {known}")

        def at(value: float) -> BallProgram:
            filled = np.full(np.atleast_1d(np.asarray(problem.y0)).shape, value)
            moved = problem.with_values({word: filled if word in START else value})
            return replace(self, problem=moved)

        values = np.unique(np.asarray(problem.values([word])[word], np.float64))
        is_gain = word == "k" and isinstance(world.contact, Projection)
        return Number(
            key=word,
            value=float(values[0]) if len(values) == 1 else None,
            unit="" if is_gain else PARAMETERS[word].get("unit", ""),
            at=at,
            positive=word not in ("y0", "v0", "gravity"),
            zero=True,
            dtype=world.policy.dtype(PARAMETERS[word].get("role", "arithmetic")),
        )

    def history(self, steps: int, loss: Callable[..., float] | None = None) -> DecisionHistory:
        """Return all decisions and the loss of a run (see `Program.history`)."""
        problem = replace(self.problem, steps=steps)
        run = problem.run(keep=False)
        contact, counts = run.contact, run.iterations.reshape(steps, -1)
        marks = [
            hashlib.blake2b(touches.tobytes() + count.tobytes(), digest_size=8).digest()
            for touches, count in zip(contact, counts, strict=True)
        ]
        digest = hashlib.blake2b(contact.tobytes() + run.iterations.tobytes(), digest_size=16).hexdigest()
        value, _ = problem.value_and_grad([], jax.tree.map(jnp.asarray, run.decisions()))
        x = run.y[-1].astype(np.float64)
        every = np.frombuffer(b"".join(marks), np.uint64)
        return DecisionHistory(every, digest, x, value, float("nan"), "", first=1)

    def differing(self, other: BallProgram, steps: int, step: int, key: str) -> Differing:
        """Return the first differing decision at a step, and the loss gradients of both runs."""
        problems = [replace(one.problem, steps=steps) for one in (self, other)]
        runs = [problem.run(history=True) for problem in problems]
        flips = [flip for flip in cross_decisions(runs[0], runs[1], step) if flip.step == step]
        first = flips[0]
        if first.channel == "stop" and first.ball < 0:
            margins = [
                _stop_margin(run, step - 1, min(first.a, first.b), margin)
                for run, margin in zip(runs, (first.margin_a, first.margin_b), strict=True)
            ]
            flips[0] = first._replace(margin_a=margins[0], margin_b=margins[1])
        name = self.number(key).key
        gradients = tuple(
            problem.value_and_grad([name], jax.tree.map(jnp.asarray, run.decisions()))[1][name]
            for problem, run in zip(problems, runs, strict=True)
        )
        return Differing(self.decision(other, flips, float("nan")), gradients)


def _stop_margin(run: BallRun, row: int, iteration: int, margin: float) -> float:
    """Return the margin of a stop decision: threshold minus residual."""
    if run.history is None or not isinstance(run.world.contact, Projection):
        return margin
    rule = run.world.contact.stop
    first = jnp.asarray(run.history[row, 0])
    return float(rule.threshold(first, jnp.asarray(iteration))) - float(run.history[row, iteration])


def _reordered(run: BallRun, order: Int[np.ndarray, "balls"]) -> BallRun:
    """Return a run with its balls in the order of the other run."""
    place = np.argsort(order)
    columns = ("y", "v", "height", "contact", "iterations", "reason", "residual", "margin", "before")
    arrays = {name: getattr(run, name) for name in columns}
    turned = {
        name: values[:, place] for name, values in arrays.items() if values.ndim == 2 and values.shape[1] > 0
    }
    flips: Ledger = run.contacts
    ball = order[flips.subject[:, 0]]
    rows = np.lexsort((ball, flips.step))
    names = ("step", "entered", "margin", "bound", "jump")
    contacts = replace(
        flips,
        subject=ball[rows, None],
        **{name: getattr(flips, name)[rows] for name in names},
        extra={name: values[rows] for name, values in flips.extra.items()},
    )
    return replace(run, **turned, contacts=contacts)


def _apart(one: BallRun, other: BallRun, last: int) -> Float[np.ndarray, "times"]:
    """Return the largest height difference of two runs at each step, m. Infinity if a run blew up."""
    y = [run.y[: last + 1].astype(np.float64) for run in (one, other)]
    with np.errstate(invalid="ignore"):
        off = np.abs(y[0] - y[1])
    return np.where(np.isfinite(off), off, np.inf).max(axis=1)


def _ends(a: BallRun, b: BallRun) -> tuple[int, dict[str, str]]:
    """Return the last step at which both states are finite, and how each run ends."""
    ends = {}
    for name, run in (("A", a), ("B", b)):
        finite = np.isfinite(run.y.astype(np.float64)) & np.isfinite(run.v.astype(np.float64))
        broken = ~finite.all(axis=1)
        if broken.any():
            ends[name] = int(broken.argmax()) - 1
    last = min([a.steps, *ends.values()])
    if last < 0:
        raise InputError("an initial height or velocity overflows its dtype", remedy="Use a wider dtype")
    return last, {name: "blow-up" if ends.get(name) == last else "" for name in "AB"}


def _guarded(separation: np.ndarray, furthest: np.ndarray, guard: float | None) -> np.ndarray:
    """Set distances between runs to NaN after a contact is imposed far from the floor."""
    beyond = furthest > (np.inf if guard is None else guard)
    if beyond.any():
        separation[int(beyond.argmax()) + 1 :] = np.nan
    return separation
