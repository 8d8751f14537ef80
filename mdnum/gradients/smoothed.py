"""Differences over steps that are wider than the spacing of events, averaged over replicas.

Between two crossings that change the step at which they happen, a loss with a force jump follows the
derivative of its steps; at each of them it jumps. What the event-aware gradient predicts is the slope over
many such jumps, so a difference that shall be compared with it must reach across many of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.base import Gradient, Problem, Progress, check
from mdnum.gradients.ensemble import Estimate, Replicas
from mdnum.gradients.tape import Stretch, Tape


@dataclass(frozen=True)
class SmoothedDifferences:
    """Central differences with wide steps over replicas that share their random numbers.

    Of several steps, each twice the next, pairs are extrapolated to no step. The widest pair is taken that
    differs from no narrower one by more than twice the standard error of the difference: narrower steps
    have more of the noise of single events.

    Attributes:
        relative: the widest step as a share of the parameter.
        steps: how many steps, each half of the one before.
        replicas: the starts; a replica's start does not change with the parameter.
        count_moved: whether to count the crossings that a step moves to another step of time.
    """

    relative: float = 0.002
    steps: int = 3
    replicas: Replicas = field(default_factory=Replicas)
    count_moved: bool = True

    @property
    def name(self) -> str:
        """Its word."""
        return "smoothed-differences"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return "the mean over replicas of differences across steps wider than the spacing of events"

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Scalars that replicas share."""
        large = [name for name in names if np.ndim(parameters.value(problem.simulation, name))]
        if large:
            return f"{', '.join(large)}: a value for each shift of each entry would be needed"
        return None

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The mean by the named parameters; standard errors, steps and moved crossings are in the details."""
        names = check(self, problem, names)
        starts = self.replicas.of(problem)
        gradient: dict[str, np.ndarray] = {}
        details: dict[str, Any] = {
            "replicas": len(starts),
            "error": {},
            "each": {},
            "step": {},
            "table": {},
            "moved": {},
        }
        runs, done = 2 * self.steps * len(starts) * len(names), 0

        def told() -> None:
            nonlocal done
            done += 1
            if progress is not None:
                progress(done, runs, "differences")

        for name in names:
            here = float(parameters.value(problem.simulation, name))
            if here == 0:
                raise InputError(
                    f"{name} is 0, and a step is a share of it", remedy="Shift another parameter"
                )
            widths = self.relative * abs(here) / 2.0 ** np.arange(self.steps)
            found = np.empty((self.steps, len(starts)))
            moved = []
            for k, h in enumerate(widths):
                # all replicas at one value of the parameter: a new radius is compiled for once
                high = _values(starts, {name: here + h}, self.count_moved, told)
                low = _values(starts, {name: here - h}, self.count_moved, told)
                found[k] = [(a[0] - b[0]) / (2 * h) for a, b in zip(high, low, strict=True)]
                moved.append(_share(high, low))
            chosen, error, best = _chosen(found)
            gradient[name] = chosen.mean
            details["each"][name] = chosen.of.tolist()
            details["error"][name] = error
            details["step"][name] = float(widths[best])
            details["moved"][name] = moved[best]
            details["table"][name] = [
                [float(h), float(one.mean()), float(one.std(ddof=1) / np.sqrt(len(one))), share]
                for h, one, share in zip(widths, found, moved, strict=True)
            ]
        value = float(np.mean([one.value() for one in starts]))
        return Gradient(self.name, self.says, value, gradient, {}, details)


def _values(starts: Sequence[Problem], values: dict[str, float], flips: bool, told: Callable[[], None]):
    """The loss of every start at shifted parameters, and the set of its crossings."""
    found = []
    for start in starts:
        made = start.at(values)
        met: set[tuple[int, ...]] = set()
        tape = Tape(
            made.simulation,
            made.loss,
            made.steps,
            flips=flips,
            budget=0,
            each=lambda stretch, met=met: met.update(_crossings(stretch)),
        )
        found.append((tape.value, met))
        told()
    return found


def _crossings(stretch: Stretch) -> Iterator[tuple[int, ...]]:
    """Step and pair of every flip of a stretch; none where they were not asked for."""
    if stretch.ledger is not None:
        yield from zip(stretch.ledger.step.tolist(), *stretch.ledger.subject.T.tolist(), strict=True)


def _share(high, low) -> float | None:
    """Share of the crossings that are not in both runs at the same step; None where they were not counted."""
    total = sum(len(a[1]) + len(b[1]) for a, b in zip(high, low, strict=True))
    apart = sum(len(a[1] ^ b[1]) for a, b in zip(high, low, strict=True))
    return apart / total if total else None


def _chosen(found: Float[np.ndarray, "steps replicas"]) -> tuple[Estimate, float, int]:
    """The extrapolated derivative, its error, and which step it is from, of differences by step."""
    if len(found) == 1:
        only = Estimate.from_replicas(found[0])
        return only, float(only.error), 0
    flat = [Estimate.from_replicas((4 * fine - wide) / 3) for wide, fine in pairwise(found)]
    best, left = len(flat) - 1, 0.0
    for k, one in enumerate(flat):
        apart = [Estimate.from_replicas(other.of - one.of) for other in flat[k + 1 :]]
        if all(abs(float(other.mean)) <= 2 * float(other.error) for other in apart):
            # what the pairs differ by, beyond their noise, may be left of truncation
            best, left = k, max([abs(float(other.mean)) - float(other.error) for other in apart] + [0.0])
            break
    return flat[best], float(np.hypot(flat[best].error, left)), best
