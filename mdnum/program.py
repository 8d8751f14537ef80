"""Interface by which analyses run and compare simulations.

Molecular dynamics, the ball and simulations of other packages implement `Program`. A program determines every
bit of a run, including the initial state. Analyses, such as the search for forks, use only the interface
`Program`. Every time step takes pair or contact decisions as input. Decisions of one program can be imposed
on another program. The implementations are `mdnum.rollout.program.MdProgram` and
`mdnum.ball.program.BallProgram`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, Real, UInt64

#: Function that is called occasionally with (done, total, {"phase": text}).
Progress = Callable[[int, int, dict[str, Any]], None]


class Program(Protocol):
    """Protocol of a simulation that can be run, perturbed and compared.

    Attributes:
        size: number of atoms or balls.
        steps: number of steps that the system specifies.
        timestep: time step in the unit of the system file.
        scale: reference length of tolerances: the longest cutoff, or the largest initial height.
        ulp: unit in the last place of the largest initial coordinate, length (the smallest displacement).
        streams: whether runs may continue beyond the requested steps; False for runs that are stored whole.
        imposable: reason why decisions cannot be imposed on the program; None if imposing is possible.
    """

    @property
    def size(self) -> int: ...
    @property
    def steps(self) -> int: ...
    @property
    def timestep(self) -> float: ...
    @property
    def scale(self) -> float: ...
    @property
    def ulp(self) -> float: ...
    @property
    def streams(self) -> bool: ...
    @property
    def imposable(self) -> str | None: ...

    def check(self, other: Any) -> None:
        """Raise an error if two programs differ in the number of atoms or balls, or in kinds of decisions.

        Raises:
            InputError: the programs cannot be compared.
        """
        ...

    def lockstep(
        self, other: Any, last: int, *, forward: bool, back: bool, guard: float | None
    ) -> Iterator[PairRows]:
        """Run this program (A) and another program (B), and compare each step.

        Args:
            forward: whether to run also B with A's decisions imposed, "B|A".
            back: whether to run also A with B's decisions imposed, "A|B".
            guard: largest distance of an imposed different decision from its threshold, length; the run ends
                at larger distances, because rounding could not have changed such a decision.
        """
        ...

    def repeats(
        self, others: Sequence[Any], last: int, tolerance: float, guard: float
    ) -> list[tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]]:
        """Return distances of perturbed runs from this run, with and without imposed decisions.

        Args:
            others: the same program with perturbed starts.
            last: last step; runs may end earlier if all runs have split.
            tolerance: separation that counts as a split, length.
            guard: as for `lockstep`.
        """
        ...

    def nudged(self, size: float, count: int, seed: int) -> list[Any]:
        """Return programs whose initial states have random displacements of at most about `size`."""
        ...

    def decision(self, other: Any, flips: Sequence[Any], separation: float) -> Decision:
        """Return the decision that differs between two runs at their fork.

        Args:
            flips: cross-run flips of the segment of steps.
            separation: separation of the runs at the previous step, length.
        """
        ...

    def number(self, key: str) -> Number:
        """Return a numerical parameter of the system, given its key in the system file.

        Raises:
            InputError: no parameter or several parameters match; the message lists the known parameters.
        """
        ...

    def history(self, steps: int, loss: Callable[..., float] | None = None) -> DecisionHistory:
        """Return the decisions and the final state of a run."""
        ...

    def differing(self, other: Any, steps: int, step: int, key: str) -> Differing:
        """Return the decision that differs between two programs at a step."""
        ...


@dataclass(frozen=True)
class Twin:
    """Two simulations that differ in one numerical setting."""

    # a, b: the programs
    a: Any
    b: Any
    difference: str  # what differs, one line
    # keys of the system file whose values differ, with both values
    changes: Mapping[str, list[Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class PairRows:
    """Consecutive time steps of two runs that are compared step by step."""

    first: int  # step of the first row
    # largest distance between the runs, length, of "B" and "B|A" from A, of "A|B" from B, and the other way
    # around, "A|B from A" and "B|A from B"; shape (rows,), NaN where a run has ended
    separation: dict[str, Float[np.ndarray, "rows"]]
    bits: Bool[np.ndarray, "rows"]  # whether any bit of the state of A and B differs, shape (rows,)
    energy: dict[str, Float[np.ndarray, "rows"]]  # by run, shape (rows,)
    cross: Int[np.ndarray, "rows"]  # decisions in which A and B differ, shape (rows,)
    flips: Sequence[Any]  # cross-run flips of these steps, in order; each has a `step`
    # by counterfactual: decisions it would have made otherwise, shape (rows,); floats where rows after the
    # end of a run are NaN
    overridden: dict[str, Real[np.ndarray, "rows"]] = field(default_factory=dict)
    # by counterfactual: distance of the furthest of them from its threshold, length
    furthest: dict[str, Float[np.ndarray, "rows"]] = field(default_factory=dict)
    # of A and B, distance of the decision nearest to its threshold from it, length, shape (rows,)
    nearest: dict[str, Float[np.ndarray, "rows"]] = field(default_factory=dict)
    # of A and B, how far rounding can move what is compared, length, shape (rows,)
    bound: dict[str, Float[np.ndarray, "rows"]] = field(default_factory=dict)
    # of A and B, decisions that rounding could have changed, shape (rows,)
    ambiguous: dict[str, Float[np.ndarray, "rows"]] = field(default_factory=dict)
    # which ones they are: a tuple of columns, the first of them the step
    doubts: dict[str, Any] = field(default_factory=dict)
    # by run, "blow-up" or "runaway" where it ended that way, else ""
    failed: dict[str, str] = field(default_factory=dict)
    runs: dict[str, Any] = field(default_factory=dict)  # whole runs by name, where a world keeps them
    # of "B" and "B|A", the largest relative change of a length from A's box to theirs, where boxes can differ
    strain: dict[str, Float[np.ndarray, "rows"]] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """Number of recorded time steps."""
        return len(self.cross)

    def until(self, last: int) -> PairRows:
        """Return the record up to a time step."""
        rows = last - self.first + 1
        if rows >= self.rows:
            return self
        columns = (
            "separation",
            "energy",
            "overridden",
            "furthest",
            "nearest",
            "bound",
            "ambiguous",
            "strain",
        )
        cut: dict[str, Any] = {
            name: {run: values[:rows] for run, values in getattr(self, name).items()} for name in columns
        }
        # a run that failed within these rows has no separation at the last of them; A has rows up to its end
        ended = {run: np.isnan(cut["separation"].get(run, np.zeros(rows))[-1]) for run in self.failed}
        return replace(
            self,
            **cut,
            bits=self.bits[:rows],
            cross=self.cross[:rows],
            flips=[flip for flip in self.flips if flip.step <= last],
            doubts={run: doubt[doubt.step <= last] for run, doubt in self.doubts.items()},
            failed={run: word if ended[run] else "" for run, word in self.failed.items()},
        )


@dataclass(frozen=True)
class Decision:
    """The decision that differs between two runs at a fork."""

    channel: str  # "pair", "contact" or "stop"
    step: int  # of the fork
    # labels of the atoms of a pair, or of the ball; empty where one decision is the whole batch's
    subject: tuple[int, ...]
    # the run that made the decision, "A" or "B": in which the pair flipped, the ball touches, the solver
    # stops first; "start" where the runs differ from the start on
    run: str
    entered: bool  # whether the pair entered its cutoff in that run; True for a contact and a stop
    # a, b: what each run decided: 0 or 1, or a number of iterations
    a: int
    b: int
    # margins, bounds: by run, in the quantity's space; NaN where a run made no such decision
    margins: Mapping[str, float]
    bounds: Mapping[str, float]
    separation: float  # of the runs at the step before, length
    also: int  # further decisions that differ at this step

    @property
    def margin(self) -> float:
        """Margin (threshold minus quantity) in run `run`, or in run A."""
        return self.margins["A" if self.run == "start" else self.run]

    @property
    def bound(self) -> float:
        """Bound on the rounding error of `margin`."""
        return self.bounds["A" if self.run == "start" else self.run]

    @property
    def ambiguous_in(self) -> list[str]:
        """Names of the runs in which rounding alone could have reversed the decision."""
        return [name for name, bound in self.bounds.items() if bound > 0 and abs(self.margins[name]) <= bound]

    @property
    def ambiguous(self) -> bool:
        """True if rounding errors could have reversed the decision to which `margin` refers."""
        return abs(self.margin) <= self.bound


@dataclass(frozen=True)
class Number:
    """A numerical parameter of a system that can be varied."""

    key: str  # as system files have it where they do
    value: float | None  # what the system says, in the units of its file; None where a batch has several
    unit: str  # of it; empty for a pure number and where it is not known
    at: Callable[[float], Any]  # the program at another value, which is not compiled again
    positive: bool  # whether only values above 0 make sense
    zero: bool = False  # whether 0 does too
    dtype: Any = np.float64  # of the floats that the number can have


@dataclass(frozen=True)
class DecisionHistory:
    """Decisions of a run at each step, and its final state."""

    # of each step, a number that any other decisions of that step have different (up to collisions of 64
    # bits); shorter where the run failed, shape (rows,)
    marks: UInt64[np.ndarray, "rows"]
    digest: str  # all decisions in one word of 32 hexadecimal digits
    x: Float[np.ndarray, "..."]  # at the last step, unwrapped, length, shape (atoms, 3) or (balls,)
    # loss, energy: at the last step; NaN where the run failed
    loss: float
    energy: float
    failed: str  # "blow-up" or "runaway" where it ended that way, else ""
    first: int = 0  # step of the first row

    def first_difference(self, other: DecisionHistory) -> int | None:
        """Return the first step at which two runs' decisions differ, or None."""
        common = min(len(self.marks), len(other.marks))
        differ = np.flatnonzero(self.marks[:common] != other.marks[:common])
        if len(differ):
            return self.first + int(differ[0])
        return None if len(self.marks) == len(other.marks) else self.first + common


@dataclass(frozen=True)
class Differing:
    """Decision that differs between simulations with slightly different parameters."""

    # the one whose margin is closest to 0 on both sides; a, b, margins and bounds are those of the two
    # programs
    decision: Decision
    # of the loss along the number on both sides, decisions held; empty where none is taken
    gradients: tuple[float, ...] = ()
