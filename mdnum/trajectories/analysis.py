"""Flips as an MDAnalysis analysis: `NeighborFlips(universe, r_cut=8.5).run().results.flips`.

Frames may be spread over processes. A flip belongs to two frames, so that a process whose frames begin in the
middle looks at the frame before its first one too: nothing is lost between two parts, and the results are
those of one process to the last bit. What two parts found at the frame that both looked at is compared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from MDAnalysis.analysis.base import AnalysisBase
from MDAnalysis.analysis.results import Results, ResultsGroup
from MDAnalysis.core.universe import Universe

from mdnum.errors import InputError
from mdnum.trajectories.asked import (
    bound_of,
    group_of,
    in_any_pair,
    indices_of,
    refuse_backward,
    refuse_kept_transformations,
    refuse_strangers,
    rules_of,
)
from mdnum.trajectories.boxes import Boxes
from mdnum.trajectories.checked import FrameError, check_frame
from mdnum.trajectories.far import smallest_radius
from mdnum.trajectories.frame import Frame
from mdnum.trajectories.joined import Part, RuleResult, joined
from mdnum.trajectories.ledger import Flips
from mdnum.trajectories.mdanalysis_source import (
    READING_FAILS,
    first_line,
    frame_of,
    labels_of,
    table_of,
)
from mdnum.trajectories.resolution import SAMPLE, Resolution, infer_from
from mdnum.trajectories.rules import Rule
from mdnum.trajectories.source import UnreadableFrame
from mdnum.trajectories.tails import left_over, refuse_cut_text
from mdnum.trajectories.tracker import Tracker
from mdnum.trajectories.xtc import XtcFile, opened


@dataclass(frozen=True)
class _Failure:
    """Why a part ended before its last frame.

    Attributes:
        frame: its number in the file.
        message: what was seen.
        read: whether reading failed, rather than what was read being wrong.
    """

    frame: int
    message: str
    read: bool


@dataclass
class _Looked:
    """Frames of a trajectory one after the other, each looked at before the library reads it."""

    analysis: NeighborFlips
    numbers: np.ndarray

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[Any]:
        for number in self.numbers:
            yield self.analysis.timestep(int(number))


class NeighborFlips(AnalysisBase):
    """Which pairs entered or left a cutoff between the frames of a trajectory.

    After `run`, `results` has for one rule all that `RuleResult` has (`flips`, `pairs`, `near`, `min_margin`,
    `initial`, `last`), and for several the same in each of `results.rules`; `results.resolution` says how
    finely the file tells where atoms are and `results.bound` what that does to a distance, per frame.
    `frames` and `times` are those of the frames looked at; `Flips.frame` counts among them.

    When a frame cannot be read or holds what cannot be right, the results of the frames before it are kept
    and the error names it.

    Args:
        universe_or_atomgroup: atoms of which pairs are made.
        r_cut: the cutoff, Å; {("O", "H"): 2.5} for pairs of species; a list of them for several at once.
        other: with it, pairs of one atom of each group; atoms may be in both.
        rule: any membership rule or several, in the place of r_cut or beside it.
        bound: how far a distance can be off, Å; None for what the resolution of the file gives.
        verbose: show progress.

    Raises:
        InputError: an empty or changing group, groups of two universes, no rule or none that can be, a
            species that no atom has, a bound below 0.

    Error: MDAnalysis hands coordinates over in float32; from there on everything is float64.
    """

    _analysis_algorithm_is_parallelizable = True

    @classmethod
    def get_supported_backends(cls) -> tuple[str, ...]:
        """Where frames can be spread to."""
        return ("serial", "multiprocessing", "dask")

    def __init__(
        self,
        universe_or_atomgroup: Any,
        r_cut: Any = None,
        *,
        other: Any = None,
        rule: Rule | Sequence[Rule] | None = None,
        bound: float | None = None,
        verbose: bool = False,
    ):
        everything = isinstance(universe_or_atomgroup, Universe)
        group = group_of(universe_or_atomgroup.atoms if everything else universe_or_atomgroup, "atoms")
        super().__init__(group.universe.trajectory, verbose=verbose)
        self._first = None if everything and other is None else indices_of(group)
        self._second = None
        if other is not None:
            second = group_of(other, "other")
            if second.universe is not group.universe:
                raise InputError(
                    "the two groups belong to two universes", remedy="Select both from one universe"
                )
            self._second = indices_of(second)
        self.rules = rules_of(r_cut, rule)
        self._radius = smallest_radius(self.rules)
        self._species = None
        if any(one.needs_species for one in self.rules):
            self._species = [str(one) for one in table_of(group.universe.atoms).species]
            refuse_strangers(self.rules, self._species)
        self._seen = in_any_pair(self._first, self._second)
        self._bound = bound_of(bound)
        self._resolution: Resolution | None = None
        self._pbc: np.ndarray | None = None
        self._numbers = np.zeros(0, np.int64)
        self._at = 0
        self._trackers: list[Tracker] = []
        self._boxes: Boxes | None = None
        self._labels: Callable[[int], np.ndarray | None] | None = None
        self._names: np.ndarray | None = None
        self._guard: XtcFile | None = None
        self._opened = False
        self._done, self._reading = 0, True
        self._to_the_end = False

    def run(self, *args: Any, **kwargs: Any) -> NeighborFlips:
        """As MDAnalysis's: start, stop, step, frames, verbose, backend, n_workers, n_parts.

        Raises:
            InputError: the frames asked for go backward or one is there twice; other processes cannot have a
                transformation of the trajectory.
            UnreadableFrame: a frame cannot be read; `results`, `frames` and `times` have those before it.
            FrameError: likewise, a frame that holds what cannot be right.
        """
        super().run(*args, **kwargs)
        failure = self.results.failure
        if failure is not None:
            kind = UnreadableFrame if failure.read else FrameError
            where = getattr(self._trajectory, "filename", None)
            raise kind(
                failure.message,
                frame=failure.frame,
                where=str(where) if where is not None else "the trajectory",
                remedy=f"The results of the {len(self.frames):,} frames before it are kept",
            )
        return self

    def _configure_backend(self, backend: Any, *args: Any, **kwargs: Any) -> Any:
        """MDAnalysis's, which ends at a transformation that is a plain function."""
        if backend != "serial":
            refuse_kept_transformations(self._trajectory, backend)
        return super()._configure_backend(backend, *args, **kwargs)

    def _setup_computation_groups(
        self,
        n_parts: int,
        start: Any = None,
        stop: Any = None,
        step: Any = None,
        frames: Any = None,
    ) -> list[np.ndarray]:
        """MDAnalysis's, and what all parts must agree on: done once, before frames are spread."""
        groups = super()._setup_computation_groups(n_parts, start, stop, step, frames)
        # who names the frames gets those
        self._to_the_end = frames is None and (stop is None or stop > len(self._trajectory))
        self._numbers = np.concatenate([one[:, 1] for one in groups]).astype(np.int64)
        refuse_backward(self._numbers)
        sample = []
        for number in self._numbers[:SAMPLE]:
            try:
                sample.append(self._frame(self.timestep(int(number))))
            except READING_FAILS:
                # met again in its turn, and told there
                break
        if sample:
            self._resolution = infer_from(sample, 32, _format(self._trajectory))
            self._pbc = sample[0].box.pbc
        self._let_go()
        return groups

    def _prepare_sliced_trajectory(self, slicer: Any) -> None:
        super()._prepare_sliced_trajectory(slicer)
        if isinstance(slicer, np.ndarray):
            self._sliced_trajectory = _Looked(self, slicer)

    def timestep(self, number: int) -> Any:
        """MDAnalysis's timestep of a frame, once it is known that reading it does not end the process."""
        if not self._opened:
            self._guard, self._boxes = opened(self._trajectory), Boxes(self._trajectory)
            self._labels = labels_of(self._trajectory)
            self._names = self._labels(0)
            self._opened = True
        if self._guard is not None:
            self._guard.check(number)
        refuse_cut_text(self._trajectory, number)
        return self._trajectory[number]

    def _let_go(self) -> None:
        """Leaves files that were opened: an open file does not go to another process."""
        self._guard, self._boxes, self._opened = None, None, False
        self._labels = None

    def _compute(self, indexed_frames: np.ndarray, verbose: Any = None, **kwargs: Any) -> NeighborFlips:
        self._at = int(indexed_frames[0, 0]) if len(indexed_frames) else 0
        self._done, self._reading = 0, True
        self.results = Results(failures=[None])
        try:
            super()._compute(indexed_frames, verbose, **kwargs)
        except FrameError as error:
            self._stopped(_Failure(error.frame, error.message, False))
        except READING_FAILS as error:
            if not self._reading:
                raise
            # reading the frame before the first of this part has failed where done is -1
            number = int(self._numbers[self._at + self._done])
            self._stopped(_Failure(number, f"frame {number} cannot be read ({first_line(error)})", True))
        for part, tracker in zip(self.results.parts[0], self._trackers, strict=True):
            part.last = tracker.members() if part.pairs else None
        # what a process sends back is what it found, not what it needed for that
        self._trackers = []
        self._let_go()
        # where one process computes several parts, each has to be an object of its own
        return copy(self)

    def _stopped(self, failure: _Failure) -> None:
        self.results.failures = [failure]
        done = max(self._done, 0)
        self.frames, self.times = self.frames[:done], self.times[:done]

    def _prepare(self) -> None:
        self._trackers = [
            Tracker(rule, self._first, self._second, self._species, self._bound or 0.0) for rule in self.rules
        ]
        self.results.parts = [[Part() for _ in self.rules]]
        self.results.bounds = [[]]
        if self._at:
            self._done = -1
            self._before(self.timestep(int(self._numbers[self._at - 1])))
            self._done = 0

    def _before(self, ts: Any) -> None:
        """Looks at the frame before the first of this part."""
        self._reading = False
        frame = self._checked(ts)
        bound = self._bound_at(frame)
        for part, tracker in zip(self.results.parts[0], self._trackers, strict=True):
            self._stepped(tracker, frame, bound)
            part.before = tracker.members()
        self._reading = True

    def _single_frame(self) -> None:
        self._reading = False
        frame = self._checked(self._ts)
        bound = self._bound_at(frame)
        flips = [self._stepped(tracker, frame, bound) for tracker in self._trackers]
        for part, tracker, rows in zip(self.results.parts[0], self._trackers, flips, strict=True):
            if len(rows):
                part.flips.append(rows)
            if self._at == 0 and self._done == 0:
                part.initial = tracker.members()
            part.pairs.append(tracker.pairs)
            part.near.append(tracker.near)
            part.min_margin.append(tracker.min_margin)
        self.results.bounds[0].append(bound)
        self._done += 1
        self._reading = True

    def _stepped(self, tracker: Tracker, frame: Frame, bound: float) -> Flips:
        try:
            # a margin among the nearest is the difference of two distances
            return tracker.step(frame, bound=bound * (1 + tracker.rule.directed))
        except InputError as error:
            raise FrameError(
                f"frame {frame.index}: {error.message}", frame=frame.index, remedy=error.remedy or ""
            ) from error

    def _checked(self, ts: Any) -> Frame:
        frame = self._frame(ts)
        check_frame(frame, self._seen, self._pbc, None, self._names, radius=self._radius, bits=32)
        return frame

    def _frame(self, ts: Any) -> Frame:
        assert self._boxes is not None and self._labels is not None
        return frame_of(ts, int(ts.frame), self._boxes, labels=self._labels(int(ts.frame)))

    def _bound_at(self, frame: Frame) -> float:
        if self._bound is not None or self._resolution is None:
            return self._bound or 0.0
        return self._resolution.bound(frame, self._seen)

    def _get_aggregator(self) -> ResultsGroup:
        flat = ResultsGroup.flatten_sequence
        return ResultsGroup(lookup={"parts": flat, "bounds": flat, "failures": flat})

    def _conclude(self) -> None:
        results = self.results
        failures = list(results.failures)
        failed = [k for k, one in enumerate(failures) if one is not None]
        # parts after the one that failed are of frames after a frame that nobody knows
        kept = failed[0] + 1 if failed else len(failures)
        done = sum(len(one) for one in results.bounds[:kept])
        self.frames, self.times = self.frames[:done], self.times[:done]
        found = [
            joined(rule, [part[k] for part in results.parts[:kept]]) for k, rule in enumerate(self.rules)
        ]
        bound = np.array([value for one in results.bounds[:kept] for value in one], np.float64)
        for name in ("parts", "bounds", "failures"):
            del results[name]
        results.failure = failures[failed[0]] if failed else self._behind_the_last()
        results.rules, results.bound, results.resolution = found, bound, self._resolution
        if len(found) == 1:
            for one in fields(RuleResult):
                results[one.name] = getattr(found[0], one.name)

    def _behind_the_last(self) -> _Failure | None:
        """A frame behind the last one that the library has, which it leaves out."""
        rest = left_over(self._trajectory) if self._to_the_end and len(self._numbers) else None
        if rest is None:
            return None
        count = int(self._trajectory.n_frames)
        return _Failure(count, f"frame {count} cannot be read ({rest})", True)


def _format(trajectory: Any) -> str:
    word = trajectory.format
    return str(word if isinstance(word, str) else word[0])
