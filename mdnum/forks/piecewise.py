"""A run as a piecewise function of a number: intervals of one history, and the boundaries between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Side:
    """A run on one side of a boundary.

    Attributes:
        at: the number, as the float next to the boundary.
        digest: of its decisions.
        loss, energy: at its last step.
        margin: of the pair whose decision changes, at that step, in the quantity's space.
        inside: that decision.
    """

    at: float
    digest: str
    loss: float
    energy: float
    margin: float
    inside: bool


@dataclass(frozen=True)
class Boundary:
    """Two adjacent floats with different histories, and the decision that makes the difference.

    Attributes:
        below, above: the two sides; above.at is the float after below.at.
        step: of the first decision that differs.
        i, j: its pair, i < j.
        bound: on the rounding error of its margin.
        also: further pairs that differ first at this step.
        apart: largest distance of an atom between the two final states, length.
        confirmed: whether a fresh process found the same history on either side; None where none was asked.
    """

    below: Side
    above: Side
    step: int
    i: int
    j: int
    bound: float
    also: int
    apart: float
    confirmed: bool | None

    @property
    def jump(self) -> float:
        """Loss above minus loss below."""
        return self.above.loss - self.below.loss

    @property
    def words(self) -> str:
        """The boundary in one sentence."""
        verb = "is inside" if self.above.inside else "is outside"
        return f"from {self.above.at!r} on pair {self.i}-{self.j} {verb} at step {self.step}"


@dataclass(frozen=True)
class Interval:
    """A stretch of the number on which every run made had one history.

    Attributes:
        low, high: its ends; both were run.
        history: a number for each distinct history of a map, in order of appearance.
        digest: of it.
        loss_low, loss_high: at the ends.
        runs: how many were made here.
        gap: the longest stretch between two of them: two boundaries closer than this may hide there. One ulp
            where every float was run.
    """

    low: float
    high: float
    history: int
    digest: str
    loss_low: float
    loss_high: float
    runs: int
    gap: float


@dataclass(frozen=True)
class BoundaryMap:
    """A run as a piecewise function of a number.

    Attributes:
        key: the number.
        steps: last step of every run.
        low, high: the interval that was searched.
        intervals: with one history each, in order.
        boundaries: between them, in order.
        unresolved: stretches whose ends have different histories but were not searched to the last bit, and
            adjacent floats where a run fails on one side before any pair is decided otherwise.
        complete: whether every float of the interval was run, so that nothing can hide.
        resolution: the longest stretch between two runs of one history; a pair of boundaries within it that
            cancel each other may be missed.
        evaluations: runs made to find them.
        at, loss, energy: of every run made, in order; at its last step.
        failed: runs among them that ended in a blow-up or a runaway.
    """

    key: str
    steps: int
    low: float
    high: float
    intervals: tuple[Interval, ...]
    boundaries: tuple[Boundary, ...]
    unresolved: tuple[tuple[float, float], ...]
    complete: bool
    resolution: float
    evaluations: int
    at: np.ndarray
    loss: np.ndarray
    energy: np.ndarray
    failed: int

    @property
    def histories(self) -> int:
        """How many distinct histories were seen."""
        return len({interval.digest for interval in self.intervals})

    @property
    def words(self) -> str:
        """The map in one sentence, with what it cannot know."""
        text = (
            f"{_many(len(self.boundaries), 'boundary', 'boundaries')} and "
            f"{_many(self.histories, 'history', 'histories')} of {self.steps} steps between "
            f"{self.key} = {self.low!r} and {self.high!r}"
        )
        if self.unresolved:
            more = _many(len(self.unresolved), "more stretch holds", "more stretches hold")
            text += f"; {more} boundaries that were not searched for"
        if self.complete:
            return text + "; every float was run"
        return text + f"; pairs of boundaries closer than {self.resolution:.2g} may be missed"


def _many(count: int, one: str, more: str) -> str:
    return f"{count} {one if count == 1 else more}"
