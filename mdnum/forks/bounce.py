"""The same question on the bouncing ball: did the decision that differed cause the split?

A ball's run is short enough to be kept whole, so the counterfactual is told the first run's decisions all at
once. Dates, growth and verdict are those of the molecular dynamics (mdnum.events.forks).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mdnum.ball.compare import Difference, first_difference
from mdnum.ball.rollout import BallRun, simulate
from mdnum.ball.state import BallState
from mdnum.ball.world import World
from mdnum.errors import InputError
from mdnum.events.forks import Dates, Verdict, judge, split_of


@dataclass(frozen=True)
class BallFork:
    """What became of two rollouts of a ball.

    Attributes:
        dates: seed, fork and split.
        difference: the first decision that differs.
        free, handed, back: largest separation of heights from the first rollout at each step, m, of the
            second rollout, of the second program under the first one's decisions, and (from the second
            rollout) of the first program under the second one's; shape (steps + 1,).
        tolerance: of the split, m.
        verdict: on the decisions that differed.
    """

    dates: Dates
    difference: Difference
    free: Float[np.ndarray, "times"]
    handed: Float[np.ndarray, "times"]
    back: Float[np.ndarray, "times"]
    tolerance: float
    verdict: Verdict


def fork(
    a: World,
    b: World,
    start_a: BallState,
    start_b: BallState | None = None,
    steps: int = 1000,
    *,
    split: float | None = None,
    repeats: int = 4,
    seed: int = 0,
) -> BallFork:
    """Run two programs of a ball and judge what the decisions that differ had to do with their split.

    Args:
        a, b: the programs.
        start_a, start_b: where they begin; the second defaults to the first's heights and velocities.
        steps: steps to make.
        split: separation that counts as split, m; default 1 % of the largest start height.
        repeats: runs of B whose start is perturbed by as much as the two runs differ before their fork.
        seed: of the perturbations.

    Raises:
        InputError: the programs decide different things (another kind of contact), so that one cannot be told
            the other's decisions.
    """
    if type(a.contact) is not type(b.contact) or (a.lift is None) != (b.lift is None):
        raise InputError(
            f"{type(a.contact).__name__} and {type(b.contact).__name__} decide different things",
            remedy="Compare programs with one kind of contact",
        )
    start_b = b.start(start_a.y, start_a.v) if start_b is None else start_b
    run_a, run_b = simulate(a, start_a, steps), simulate(b, start_b, steps)
    difference = first_difference(run_a, run_b)
    tolerance = 0.01 * float(np.max(np.abs(run_a.y[0]))) if split is None else split
    if not tolerance > 0:
        raise InputError(f"split = {tolerance:g}; expected a height above 0")
    handed = _apart(run_a, simulate(b, start_b, steps, told=run_a.told()))
    back = _apart(run_b, simulate(a, start_a, steps, told=run_b.told()))
    free = difference.separation
    dates = Dates(difference.seed, difference.fork, split_of(free, tolerance))
    chance = []
    if dates.fork is not None:
        # as far apart as the two are when they still decide alike
        size = max(float(free[max(0, dates.fork - 1)]), float(np.spacing(np.abs(run_b.y[0]).max())))
        for start in _nudged(b, start_b, size, repeats, seed):
            late = split_of(_apart(run_a, simulate(b, start, steps)), tolerance)
            if late is not None:
                chance.append(late)
    verdict = judge(dates, free, handed, tolerance, chance)
    return BallFork(dates, difference, free, handed, back, tolerance, verdict)


def _apart(one: BallRun, other: BallRun) -> Float[np.ndarray, "times"]:
    return np.max(np.abs(one.y.astype(np.float64) - other.y.astype(np.float64)), axis=1)


def _nudged(world: World, start: BallState, size: float, count: int, seed: int) -> list[Any]:
    rng = np.random.default_rng(seed)
    y, v = np.asarray(start.y, np.float64), np.asarray(start.v)
    return [
        world.start(jnp.asarray(y + size * rng.uniform(-1, 1, y.shape)), jnp.asarray(v)) for _ in range(count)
    ]
