"""The same question on the bouncing ball: did the decision that differed cause the split?

A ball's run is short enough to be kept whole, so the counterfactual is told the first run's decisions all at
once. Dates, growth and verdict are those of the molecular dynamics (mdnum.events.forks).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Shaped

from mdnum.ball.limits import spacing
from mdnum.ball.problem import Problem
from mdnum.ball.rollout import BallRun, first_difference, simulate
from mdnum.ball.state import BallState, Decisions
from mdnum.ball.world import World
from mdnum.errors import InputError
from mdnum.events.chance import Delay
from mdnum.events.forks import Dates, Growth, Verdict, growth, judge, split_of
from mdnum.events.shares import Cell, Share, shares, table
from mdnum.forks.bounce.cross import Differing, differing, overridden
from mdnum.forks.bounce.twin import BallTwin, as_in_a, in_order, told
from mdnum.forks.words import repeats_asked

#: The split tolerance as a share of the largest start height (or of the largest one, from the floor).
SPLIT = 0.01
#: A counterfactual ends when a contact it is told is so many tolerances from the floor.
_GUARD = 3.0
#: Repeats are perturbed by what a choice does within so many steps, and by so many tolerances at most.
_SOON = 100
_LARGEST_NUDGE = 1e-3


@dataclass(frozen=True)
class BallDecision:
    """The decision at the fork.

    Attributes:
        channel: "contact" or "stop".
        step: of the fork.
        ball: whose; -1 where the decision is the batch's.
        a, b: what each run decided: whether the ball touches, or how many iterations.
        margins: by run, "A" and "B": minus the height (m) or tolerance minus residual; NaN where a run made
            no such decision.
        bounds: by run, on the rounding error of what was compared.
        separation: largest difference of heights at the step before, m.
        also: further decisions that differ at this step.
    """

    channel: str
    step: int
    ball: int
    a: int
    b: int
    margins: dict[str, float]
    bounds: dict[str, float]
    separation: float
    also: int

    @property
    def run(self) -> str:
        """The run that decided yes: in which the ball touches, or the solver stops first."""
        return "A" if (self.a > self.b) == (self.channel == "contact") else "B"

    @property
    def ambiguous_in(self) -> list[str]:
        """Runs in which rounding alone could have decided otherwise."""
        return [name for name, bound in self.bounds.items() if bound > 0 and abs(self.margins[name]) <= bound]


@dataclass(frozen=True)
class BallFork:
    """What became of two rollouts of a ball.

    Attributes:
        twin: the pair.
        steps: steps that were compared.
        asked: steps that were asked for.
        tolerance: of the split, m.
        dates: seed, fork and split.
        decision: the first that differs; None without one.
        series: arrays by step 0..steps: "step"; largest separations of heights (m) from A of "B", "B|A" (B's
            arithmetic under A's decisions), "A|B from A" and "B 1", ... (B again, start perturbed), and from
            B of "A|B" and "B|A from B";
            "cross", decisions that differ; "overridden" and "furthest" (m) of B|A; energies per mass
            (m²/s²), the mean over the balls: "energy A", "energy B", "energy B|A".
        crossed: every decision that differs.
        growth: of the separations "B" and "B|A".
        splits: first step beyond the tolerance by separation; None where there is none.
        table: splits of either arithmetic under either decisions.
        shares: what the decisions and what the arithmetic contributed to the split.
        verdict: on the decisions that differ.
        repeats: when each repeat splits, free and under A's decisions.
        failed: runs that ended in a "blow-up", with which the comparison ends; where only one of them does,
            that is the fork at the latest.
        runs: A, B and the counterfactuals by name, with every state.
    """

    twin: BallTwin
    steps: int
    asked: int
    tolerance: float
    dates: Dates
    decision: BallDecision | None
    series: dict[str, Shaped[np.ndarray, "rows"]]
    crossed: Differing
    growth: dict[str, Growth]
    splits: dict[str, int | None]
    table: tuple[Cell, ...]
    shares: tuple[Share, ...]
    verdict: Verdict
    repeats: tuple[Delay, ...]
    failed: dict[str, str]
    runs: dict[str, BallRun]


def fork(
    twin: BallTwin,
    steps: int | None = None,
    *,
    split: float | None = None,
    repeats: int | None = None,
    counterfactual: bool = True,
    seed: int = 0,
    progress: Callable[[int, int, dict[str, Any]], None] | None = None,
) -> BallFork:
    """Run two programs of a ball and judge what the decisions that differ had to do with their split.

    Args:
        twin: the programs.
        steps: steps to make; default those of A.
        split: separation that counts as split, m; default 1 % of the largest start height.
        repeats: runs of B at most whose start is perturbed by as much as the two runs differ at first, each
            free and under A's decisions; default 15. They are made where the runs split either way, until the
            verdict is clear.
        counterfactual: run B under A's decisions, and A under B's.
        seed: of the perturbations.
        progress: called with runs done times steps, of how many, and a dictionary with the phase.

    Raises:
        InputError: a number out of range, or programs that decide different things (another kind of
            contact), so that one cannot be told the other's decisions.
    """
    a, b = _same_kind(twin)
    steps = a.steps if steps is None else steps
    if steps < 1:
        raise InputError(f"steps = {steps}; expected at least 1")
    most = repeats_asked(repeats, counterfactual)
    count = 2 + 2 * counterfactual
    done = 0

    def run(problem: Problem, given: Decisions | None = None, start: BallState | None = None) -> BallRun:
        nonlocal done
        begin = problem.world.start(problem.y0, problem.v0) if start is None else start
        made = simulate(problem.world, begin, steps, told=given)
        done += 1
        if progress is not None:
            progress(done * steps, count * steps, {"phase": "run"})
        return made

    run_a = run(a)
    pins = told(twin.pins, run_a)
    run_b = as_in_a(run(b, pins), twin.order)
    last, failed = _ends(run_a, run_b)
    tolerance = SPLIT * _height(run_a, last) if split is None else split
    if not 0 < tolerance < np.inf:
        raise InputError(f"split = {tolerance:g}; expected a height above 0")
    series: dict[str, np.ndarray] = {"step": np.arange(last + 1), "B": _apart(run_a, run_b, last)}
    crossed = differing(run_a, run_b, last)
    found = first_difference(run_a, run_b)
    at = int(crossed.step[0]) if len(crossed) else None
    if at is None and len(failed) == 1:
        # that one run can go on and the other cannot is a fork if anything is
        at = last
    begun = found.seed if found.seed is not None and found.seed <= last else None
    ended = None
    if not len(crossed) and len(failed) == 1:
        # one of them has no state after it: no bit can be the same
        begun = last if begun is None else begun
        ((name, word),) = failed.items()
        ended = (
            f"run {name} ended in a {word} after step {last} and run {'B' if name == 'A' else 'A'} did not"
        )
    dates = Dates(begun, at, split_of(series["B"], tolerance))
    series["cross"] = crossed.by_step(last)
    runs = {"A": run_a, "B": run_b}
    handed = None
    if counterfactual:
        runs["B|A"] = as_in_a(run(b, in_order(run_a.told(), twin.order)), twin.order)
        runs["A|B"] = run(a, run_b.told())
        series["overridden"], series["furthest"] = overridden(runs["B|A"], last)
        handed = _apart(run_a, runs["B|A"], last)
        _guard(handed, series["furthest"], tolerance)
        series |= {"B|A": handed, "A|B": _apart(run_b, runs["A|B"], last)}
        series["A|B from A"] = _apart(run_a, runs["A|B"], last)
        series["B|A from B"] = np.where(np.isnan(handed), np.nan, _apart(run_b, runs["B|A"], last))
    for name in ("A", "B", "B|A"):
        if name in runs:
            series[f"energy {name}"] = runs[name].energy[: last + 1].mean(axis=1)
    verdict = judge(dates, series["B"], handed, tolerance, (), most, ended=ended)
    delays: list[Delay] = []
    starts: list[BallState] = []
    while wanted := verdict.wanted:
        if not starts:
            assert dates.fork is not None
            begins = dates.fork if begun is None else begun
            starts = _nudged(b, _seed_size(series["B"], begins, dates.fork, tolerance), most, seed)
        count += 2 * wanted
        for start in starts[len(delays) : len(delays) + wanted]:
            again = as_in_a(run(b, pins, start), twin.order)
            under = as_in_a(run(b, in_order(run_a.told(), twin.order), start), twin.order)
            kept = _apart(run_a, under, last)
            _guard(kept, overridden(under, last)[1], tolerance)
            series[f"B {len(delays) + 1}"] = free = _apart(run_a, again, last)
            delays.append(Delay.of(free, kept, tolerance))
        verdict = judge(dates, series["B"], handed, tolerance, delays, most)
    names = [name for name in series if name in ("B", "B|A", "A|B")]
    splits = {name: split_of(series[name], tolerance) for name in names}
    rates = {name: growth(series[name], tolerance) for name in ("B", "B|A") if name in series}
    apart = {name: values for name, values in series.items() if name[0] in "AB"}
    cells = table(apart, tolerance)
    return BallFork(
        twin=twin,
        steps=last,
        asked=steps,
        tolerance=tolerance,
        dates=dates,
        decision=_decision(crossed, series["B"]),
        series=series,
        crossed=crossed,
        growth=rates,
        splits=splits,
        table=cells,
        shares=shares(cells, rates["B"].rate),
        verdict=verdict,
        repeats=tuple(delays),
        failed=failed,
        runs=runs,
    )


def _same_kind(twin: BallTwin) -> tuple[Problem, Problem]:
    """Both programs, the balls of B in their own order.

    Raises:
        InputError: they decide different things.
    """
    a, b = twin.a, twin.b
    kinds = [type(one.world.contact).__name__ for one in (a, b)]
    if kinds[0] != kinds[1] or (a.world.lift is None) != (b.world.lift is None):
        raise InputError(
            f"{kinds[0]} and {kinds[1]} decide different things",
            remedy="Compare programs with one kind of contact",
        )
    if np.size(a.y0) != np.size(b.y0):
        raise InputError(f"{np.size(a.y0)} balls and {np.size(b.y0)}", remedy="Compare as many balls")
    return a, b


def _apart(one: BallRun, other: BallRun, last: int) -> Float[np.ndarray, "times"]:
    """Largest difference of heights at each step, m; infinite where one of them is no number."""
    y = [run.y[: last + 1].astype(np.float64) for run in (one, other)]
    with np.errstate(invalid="ignore"):
        off = np.abs(y[0] - y[1])
    return np.where(np.isfinite(off), off, np.inf).max(axis=1)


def _height(run: BallRun, last: int) -> float:
    """The largest start height, m; of balls that start on the floor, the largest that they reach."""
    y = np.abs(run.y[: last + 1].astype(np.float64))
    return float(y[0].max()) or float(y.max()) or 1.0


def _ends(a: BallRun, b: BallRun) -> tuple[int, dict[str, str]]:
    """The last step at which both runs are finite, and which of them is not after it."""
    ends = {}
    for name, run in (("A", a), ("B", b)):
        fine = np.isfinite(run.y.astype(np.float64)) & np.isfinite(run.v.astype(np.float64))
        broken = ~fine.all(axis=1)
        if broken.any():
            ends[name] = int(broken.argmax()) - 1
    last = min([a.steps, *ends.values()])
    if last < 0:
        raise InputError("a start height is not finite in this precision", remedy="Use a wider dtype")
    return last, {name: "blow-up" for name, end in ends.items() if end == last}


def _guard(handed: np.ndarray, furthest: np.ndarray, tolerance: float) -> None:
    """Ends a counterfactual (with NaN) after the step at which it is told a contact far from the floor."""
    beyond = furthest > _GUARD * tolerance
    if beyond.any():
        handed[int(beyond.argmax()) + 1 :] = np.nan


def _seed_size(free: np.ndarray, begins: int, at: int, tolerance: float) -> float:
    """How far apart the runs are, m, soon after their bits differ and before their decisions do."""
    size = float(free[begins : min(begins + _SOON, at)].max(initial=0.0))
    return min(size, _LARGEST_NUDGE * tolerance)


def _nudged(problem: Problem, size: float, count: int, seed: int) -> list[BallState]:
    """Starts as far from B's as a size says, at least an ulp."""
    rng = np.random.default_rng(seed)
    y = np.asarray(np.atleast_1d(problem.y0), np.float64)
    size = max(size, spacing(float(np.abs(y).max()), problem.world.policy.state))
    starts = []
    for _ in range(count):
        moved = y + size * rng.uniform(-1, 1, y.shape)
        starts.append(problem.world.start(jnp.asarray(moved), jnp.asarray(problem.v0)))
    return starts


def _decision(crossed: Differing, free: np.ndarray) -> BallDecision | None:
    if not len(crossed):
        return None
    step = int(crossed.step[0])
    return BallDecision(
        channel=str(crossed.channel[0]),
        step=step,
        ball=int(crossed.ball[0]),
        a=int(crossed.a[0]),
        b=int(crossed.b[0]),
        margins={"A": float(crossed.margin_a[0]), "B": float(crossed.margin_b[0])},
        bounds={"A": float(crossed.bound_a[0]), "B": float(crossed.bound_b[0])},
        separation=float(free[step - 1]),
        also=int(np.count_nonzero(crossed.step == step)) - 1,
    )


def between(
    a: World, b: World, start_a: BallState, start_b: BallState | None = None, steps: int = 1000
) -> BallTwin:
    """A twin of two worlds and their starts, for programs that no system file describes.

    Args:
        a, b: the worlds.
        start_a, start_b: where they begin; the second defaults to the first's heights and velocities.
        steps: steps to make.
    """
    start_b = start_a if start_b is None else start_b

    def problem(world: World, start: BallState) -> Problem:
        return Problem(world, np.asarray(start.y, np.float64), np.asarray(start.v, np.float64), steps)

    return BallTwin(problem(a, start_a), problem(b, start_b), "two programs")


def reordered(problem: Problem, order: tuple[int, ...]) -> Problem:
    """The same balls in another order."""
    index = list(order)
    moved = {}
    for name in ("y0", "v0"):
        value = np.asarray(getattr(problem, name))
        moved[name] = value[index] if value.ndim == 1 and value.size > 1 else value
    return replace(problem, **moved)
