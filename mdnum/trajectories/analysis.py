"""Analysis of flips as an MDAnalysis class, `NeighborFlips(universe, r_cut=8.5).run().results.flips`.

Frames may be distributed over processes. Each process also reads the frame before its first frame. The
results are bitwise those of a single process. An error is raised if two processes find different pairs at the
same frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from MDAnalysis.analysis.base import AnalysisBase
from MDAnalysis.analysis.results import Results, ResultsGroup
from MDAnalysis.core.groups import AtomGroup, UpdatingAtomGroup
from MDAnalysis.core.universe import Universe

from mdnum.errors import InputError
from mdnum.md.ledger import FlipTable, Members
from mdnum.reading import FrameError, UnreadableFrame
from mdnum.trajectories.collective import Collective
from mdnum.trajectories.frame import Box, Frame, FrameCheck
from mdnum.trajectories.history import Contacts, History, contacts
from mdnum.trajectories.lattice import shortest
from mdnum.trajectories.mdanalysis_source import LibraryFrames, left_over
from mdnum.trajectories.repeats import RepeatedFrames, digest
from mdnum.trajectories.residues import ByResidue, Occupancy, ResidueTracker
from mdnum.trajectories.resolution import FLOAT32, Resolution, infer
from mdnum.trajectories.rules import CutoffRule, Rule, SpeciesCutoffs, smallest_radius
from mdnum.trajectories.topology import AtomTable, formats_of
from mdnum.trajectories.tracker import Tracker, atoms_of
from mdnum.trajectories.trajectory import SAMPLE


@dataclass(frozen=True)
class RuleResult:
    """Pairs, flips and contacts found in a trajectory with one membership rule."""

    rule: Rule
    flips: FlipTable  # a row per decision that differs from the frame before
    pairs: Int[np.ndarray, "frames"]  # inside, per frame
    near: Int[np.ndarray, "frames"]  # pairs whose margin is within the bound: the file cannot tell them
    min_margin: Float[np.ndarray, "frames"]  # smallest |margin|, per frame, length
    initial: Members  # the pairs inside at the first frame
    last: Members  # and at the last
    contacts: Contacts  # every stay inside, with the frames at which it begins and ends
    occupancy: Occupancy  # the share of the frames that each pair was inside

    @property
    def ambiguous(self) -> float:
        """Fraction of flips that are uncertain in the file. nan without flips."""
        return float(self.flips.ambiguous.mean()) if len(self.flips) else float("nan")

    def entered(self) -> Int[np.ndarray, "frames"]:
        """Return the number of pairs that entered the cutoff at each frame."""
        return self._per_frame(self.flips.entered)

    def left(self) -> Int[np.ndarray, "frames"]:
        """Return the number of pairs that left the cutoff at each frame."""
        return self._per_frame(~self.flips.entered)

    def _per_frame(self, rows: Bool[np.ndarray, "flips"]) -> Int[np.ndarray, "frames"]:
        return np.bincount(self.flips.frame[rows], minlength=len(self.pairs)).astype(np.int64)


@dataclass
class _ProcessPart:
    """Results of one process for one membership rule."""

    flips: list[FlipTable] = field(default_factory=lambda: [FlipTable.none()])  # of frames that have any
    rows: list[tuple[int, int, float]] = field(default_factory=list)  # (pairs, near, smallest margin)
    first: Members | None = None  # the pairs inside at the first; of later parts, at the frame before it
    last: Members | None = None  # the pairs inside at its last frame; None where it has none

    def end(self, last: Members) -> None:
        """Store the pairs inside the cutoff at the last frame. Join the flips."""
        self.last, self.flips = last if self.rows else None, [FlipTable.concatenate(self.flips)]


@dataclass
class _Guarded:
    """Iterator over frames. Each frame is checked before MDAnalysis reads the frame."""

    analysis: NeighborFlips
    numbers: np.ndarray

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[Any]:
        for number in self.numbers:
            yield self.analysis.library.timestep(int(number))


class NeighborFlips(AnalysisBase):
    """MDAnalysis analysis of the pairs that enter or leave a cutoff.

    With one rule, `results` has the attributes of `RuleResult` (`flips`, `pairs`, `near`, `min_margin`,
    `initial`, `last`, `contacts`, `occupancy`). With several rules, each element of `results.rules` is a
    `RuleResult`. Tables have a method `to_pandas()`. With by="residue", the pairs are pairs of residues. `i`
    and `j` are row numbers of `results.residues`. `results.left_out` counts the excluded atoms.
    `results.resolution` is the resolution of positions in the file. `results.bound` contains the error bound
    of a distance in each frame. `results.repeats` lists the frames that repeat earlier frames (see
    `repeats.RepeatedFrames`). `results.other_box` is another possible box of the first frame (see
    `Trajectory.other_box`), or None. `frames` and `times` list the analyzed frames. `FlipTable.frame` is an
    index into `frames` and `times`.

    If a frame cannot be read or is impossible, the error names the frame. The results of all earlier frames
    are kept.

    Args:
        universe_or_atomgroup: the atoms that form pairs.
        r_cut: the cutoff, Å; {("O", "H"): 2.5} for pairs of species; a list of cutoffs for several rules.
        other: a second group; pairs then have one atom in each group, and an atom may be in both groups.
        rule: one membership rule or several, instead of r_cut or in addition to it.
        by: "residue" for contacts between residues, which last while the smallest distance is below the
            cutoff.
        hydrogens: True if hydrogens and virtual sites count in contacts between residues.
        bound: the largest error of a distance, Å; None for the value that follows from the resolution of the
            file before transformations.
        verbose: True to show progress.

    Raises:
        InputError: a group is empty or changing, the groups belong to two universes, there is no valid rule,
            no atom has a requested species, there are no residues, or the bound is negative. Without a
            bound, `run` also raises it if transformations change distances or were applied in memory.

    Error: MDAnalysis provides coordinates in float32; all later operations use float64.
    """

    _analysis_algorithm_is_parallelizable = True

    @classmethod
    def get_supported_backends(cls) -> tuple[str, ...]:
        """Return the names of the MDAnalysis backends to which frames can be distributed."""
        return ("serial", "multiprocessing", "dask")

    def __init__(
        self,
        universe_or_atomgroup: Any,
        r_cut: Any = None,
        *,
        other: Any = None,
        rule: Rule | Sequence[Rule] | None = None,
        by: str = "atom",
        hydrogens: bool = False,
        bound: float | None = None,
        verbose: bool = False,
    ):
        everything = isinstance(universe_or_atomgroup, Universe)
        group = _group_of(universe_or_atomgroup.atoms if everything else universe_or_atomgroup, "atoms")
        super().__init__(group.universe.trajectory, verbose=verbose)
        self._first = None if everything and other is None else np.unique(np.asarray(group.indices, np.int64))
        self._second = None
        if other is not None:
            second = _group_of(other, "other")
            if second.universe is not group.universe:
                raise InputError(
                    "the two groups belong to different universes", remedy="Select both from one universe"
                )
            self._second = np.unique(np.asarray(second.indices, np.int64))
        self.rules = _rules_of(r_cut, rule)
        self._species = None
        if any(one.needs_species for one in self.rules):
            self._species = [str(one) for one in AtomTable.of(group.universe.atoms).species]
            for one in self.rules:
                # refuses a species that no atom has
                one.table(self._species)
        self._residues = None
        if by == "residue":
            table, groups = AtomTable.of(group.universe.atoms), (self._first, self._second)
            self._residues = ByResidue.make(table, groups, hydrogens, self.rules)
            self._first, self._second = self._residues.groups
        elif by != "atom":
            raise InputError(f"by = {by!r}; expected 'atom' or 'residue'")
        seen = atoms_of((self._first, self._second))
        self._check = FrameCheck(seen, radius=smallest_radius(self.rules), bits=32)
        if bound is not None and not (math.isfinite(bound) and bound >= 0):
            message = f"bound = {bound!r}; expected a length of 0 or more, Å"
            raise InputError(message, remedy="Omit `bound` to use the resolution of the file's coordinates")
        self._bound = bound
        self._resolution: Resolution | None = None
        self._other_box: tuple[str, Box] | None = None
        self._numbers = np.zeros(0, np.int64)
        self._at = 0
        self._trackers: list[Tracker | ResidueTracker] = []
        self._library: LibraryFrames | None = None
        self._to_the_end = False

    def run(self, *args: Any, **kwargs: Any) -> NeighborFlips:
        """Run the analysis with MDAnalysis's arguments (start, stop, step, frames, verbose, backend, ...).

        Raises:
            InputError: the requested frames are not in ascending order, or a transformation of the trajectory
                cannot be sent to other processes.
            UnreadableFrame: a frame cannot be read; `results`, `frames` and `times` hold the earlier frames.
            FrameError: a frame contains impossible values; `results`, `frames` and `times` hold the earlier
                frames.
        """
        super().run(*args, **kwargs)
        if (failure := self.results.failure) is not None:
            remedy = f"The results of the {len(self.frames):,} frames before it are kept"
            raise type(failure)(failure.message, frame=failure.frame, where=self._where, remedy=remedy)
        return self

    def _configure_backend(self, backend: Any, *args: Any, **kwargs: Any) -> Any:
        """Configure MDAnalysis's backend; reject transformations that cannot be sent to worker processes."""
        if backend != "serial":
            for one in getattr(self._trajectory, "transformations", ()):
                if not getattr(one, "parallelizable", False):
                    name = getattr(one, "__name__", type(one).__name__)
                    raise InputError(
                        f"the transformation {name!r} of the trajectory cannot be sent to other processes, "
                        f"as {backend=} requires",
                        remedy="Use backend='serial', or derive the transformation from "
                        "MDAnalysis.transformations.TransformationBase with parallelizable=True",
                    )
        return super()._configure_backend(backend, *args, **kwargs)

    def _setup_computation_groups(
        self, n_parts: int, start: Any = None, stop: Any = None, step: Any = None, frames: Any = None
    ) -> list[np.ndarray]:
        """Split the frames into groups as MDAnalysis does."""
        groups = super()._setup_computation_groups(n_parts, start, stop, step, frames)
        # who names the frames gets those
        self._to_the_end = frames is None and (stop is None or stop > len(self._trajectory))
        self._numbers = np.concatenate([one[:, 1] for one in groups]).astype(np.int64)
        back = np.flatnonzero(np.diff(self._numbers) <= 0)
        if back.size:
            after, before = self._numbers[back[0] + 1], self._numbers[back[0]]
            message = f"the times of the frames do not increase: frame {after} after frame {before}"
            raise InputError(message, remedy="Give the frames of the trajectory in ascending order of time")
        sample, raw, changed = [], [], 0.0
        for number in self._numbers[:SAMPLE]:
            try:
                sample.append(self.library.frame(self.library.timestep(int(number)), int(number)))
            except UnreadableFrame:
                # met again in its turn, and told there
                break
            # a transformation hides the digits that were read
            raw.append(self.library.raw or sample[-1])
            changed = max(changed, _changed(raw[-1], sample[-1]))
        if sample:
            first = int(self._numbers[0])
            self._other_box = self.library.boxes.other(self.library.timestep(first), first)
            self._resolution = infer(raw, 32, formats_of(self._trajectory)[0])
            self._check.pbc = sample[0].box.pbc
            if self._bound is None and (self.library.replaced or changed > self._bound_of(sample[-1])):
                why = f"they change distances by up to {changed:.3g} Å"
                why = "they have replaced the coordinates in memory" if self.library.replaced else why
                raise InputError(
                    f"the trajectory's transformations make the resolution of coordinates unknown: {why}",
                    remedy=(
                        "Give the largest error of a distance with bound=LENGTH (0 for no error), or "
                        "remove the transformations"
                    ),
                )
        self._library = None
        return groups

    def _prepare_sliced_trajectory(self, slicer: Any) -> None:
        super()._prepare_sliced_trajectory(slicer)
        if isinstance(slicer, np.ndarray):
            self._sliced_trajectory = _Guarded(self, slicer)

    @property
    def library(self) -> LibraryFrames:
        """Reader of frames through MDAnalysis, opened at its first use in this process."""
        if self._library is None:
            self._library = LibraryFrames(self._trajectory)
            self._check.labels = self._library.labels(0)
        return self._library

    def _compute(self, indexed_frames: np.ndarray, verbose: Any = None, **kwargs: Any) -> NeighborFlips:
        self._at = int(indexed_frames[0, 0]) if len(indexed_frames) else 0
        # what it knows of earlier frames is of another part, or of another run
        self._check.collective = Collective()
        self.results = Results(failures=[None])
        try:
            super()._compute(indexed_frames, verbose, **kwargs)
        except FrameError as error:
            self.results.failures = [error.with_traceback(None)]
        for part, tracker in zip(self.results.parts[0], self._trackers, strict=True):
            part.end(tracker.members())
        # what a process sends back is what it found, not what it needed for that; an open file cannot be sent
        self._trackers = []
        self._library = None
        # where one process computes several parts, each has to be an object of its own
        return copy(self)

    def _prepare(self) -> None:
        bound = self._bound or 0.0
        self._trackers = [
            Tracker(rule, self._first, self._second, self._species, bound)
            if self._residues is None
            else self._residues.tracker(rule, self._species, bound)
            for rule in self.rules
        ]
        self.results.parts = [[_ProcessPart() for _ in self.rules]]
        self.results.bounds, self.results.digests = [[]], [[]]
        if self._at:
            # the frame before the first of this part
            self._examined(self.library.timestep(int(self._numbers[self._at - 1])))
            for part, tracker in zip(self.results.parts[0], self._trackers, strict=True):
                part.first = tracker.members()

    def _single_frame(self) -> None:
        bound, found = self._examined(self._ts)
        for part, tracker, flips in zip(self.results.parts[0], self._trackers, found, strict=True):
            if len(flips):
                part.flips.append(flips)
            part.first = tracker.members() if part.first is None else part.first
            part.rows.append((tracker.pairs, tracker.near, tracker.min_margin))
        self.results.bounds[0].append(bound)
        self.results.digests[0].append(self._digest)

    def _examined(self, ts: Any) -> tuple[float, list[FlipTable]]:
        """Return the error bound of a distance at a timestep, and the flips by rule."""
        frame = self._check(self.library.frame(ts, int(ts.frame)))
        self._digest = digest(frame)
        bound = self._bound_of(frame) if self._bound is None else self._bound
        # a margin among the nearest is the difference of two distances
        return bound, [one.step(frame, bound=bound * (1 + one.rule.directed)) for one in self._trackers]

    def _bound_of(self, frame: Frame) -> float:
        """Return the error bound of a distance in a frame, in length units."""
        if self._resolution is None:
            return 0.0
        atoms, raw = self._check.atoms, self.library.raw
        if raw is None:
            return self._resolution.bound(frame, atoms)
        # what transformations give is rounded once more
        return self._resolution.bound(raw, atoms) + FLOAT32.bound(frame, atoms)

    def _get_aggregator(self) -> ResultsGroup:
        flat = ResultsGroup.flatten_sequence
        return ResultsGroup(lookup=dict.fromkeys(("parts", "bounds", "digests", "failures"), flat))

    def _conclude(self) -> None:
        results = self.results
        failures = list(results.failures)
        failed = [k for k, one in enumerate(failures) if one is not None]
        # parts after the one that failed are of frames after a frame that nobody knows
        kept = failed[0] + 1 if failed else len(failures)
        done = sum(len(one) for one in results.bounds[:kept])
        self.frames, self.times = self.frames[:done], self.times[:done]
        parts = results.parts[:kept]
        found = [_joined(rule, [part[k] for part in parts]) for k, rule in enumerate(self.rules)]
        bound = np.array([value for one in results.bounds[:kept] for value in one], np.float64)
        repeats = RepeatedFrames()
        for number, digested in zip(self.frames, chain(*results.digests[:kept]), strict=True):
            repeats.see(int(number), digested)
        results.repeats = repeats.stretches
        results.other_box = self._other_box
        for name in ("parts", "bounds", "digests", "failures"):
            del results[name]
        results.failure = failures[failed[0]] if failed else self._behind_the_last()
        results.rules, results.bound, results.resolution = found, bound, self._resolution
        if self._residues is not None:
            results.residues, results.left_out = self._residues.names, self._residues.left_out
        if len(found) == 1:
            for name, value in vars(found[0]).items():
                results[name] = value

    @property
    def _where(self) -> str:
        return str(getattr(self._trajectory, "filename", None) or "the trajectory")

    def _behind_the_last(self) -> FrameError | None:
        """Return an error if data follow the last frame known to MDAnalysis, else None."""
        rest = left_over(self._trajectory) if self._to_the_end and len(self._numbers) else None
        count, where = int(self._trajectory.n_frames), self._where
        said = f"frame {count} cannot be read ({rest})"
        return None if rest is None else UnreadableFrame(said, frame=count, where=where)


def _changed(before: Frame, after: Frame) -> float:
    """Return the largest change that transformations make to the distance of atoms k and k + 1.

    Shifts by lattice vectors and rotations do not count as changes.
    """
    if before is after:
        return 0.0
    old, new = np.diff(before.positions, axis=0), np.diff(after.positions, axis=0)
    apart, _ = shortest(new - old, after.box)
    turned = np.abs(np.linalg.norm(new, axis=1) - np.linalg.norm(old, axis=1))
    return float(np.minimum(turned, np.linalg.norm(apart, axis=1)).max(initial=0.0))


def _joined(rule: Rule, parts: Sequence[_ProcessPart]) -> RuleResult:
    """Concatenate the results of all processes. Frame numbers start at the first frame."""
    tables, done, last = [FlipTable.none()], 0, None
    for part in parts:
        if last is not None and part.first is not None and not last.equals(part.first):
            message = f"two processes found different pairs at the same frame (number {done - 1} of all)"
            raise InputError(message, remedy="Repeat the analysis; the file changed while it was read")
        for table in part.flips:
            # a part after the first has counted the frame before its own too
            table.frame[:] += done - (done > 0)
        tables += part.flips
        done += len(part.rows)
        last = last if part.last is None else part.last
    table = FlipTable.concatenate(tables)
    rows = np.array([row for part in parts for row in part.rows], float).reshape(-1, 3)
    initial, none = parts[0].first if parts else None, Members.none()
    pairs, near = rows[:, :2].T.astype(np.int64)
    stays = contacts(History.of(table, initial or none, max(done, 1)))
    occupancy = Occupancy.of(stays, done)
    return RuleResult(rule, table, pairs, near, rows[:, 2], initial or none, last or none, stays, occupancy)


def _group_of(atoms: Any, name: str) -> AtomGroup:
    """Return the atom group. Reject empty groups, and groups that change between frames."""
    if isinstance(atoms, UpdatingAtomGroup):
        raise InputError(
            f"the group {name} changes from frame to frame, so pairs that leave the group would be counted "
            "as flips",
            remedy="Select the group with atoms.select_atoms(...) without updating=True",
        )
    if not isinstance(atoms, AtomGroup):
        raise InputError(
            f"the object is of type {type(atoms).__name__}; expected a Universe or an AtomGroup",
            remedy="Give a group of atoms, such as universe.select_atoms(...)",
        )
    if len(atoms) == 0:
        raise InputError(f"the group {name} is empty", remedy="Check the selection")
    return atoms


def _rules_of(r_cut: Any, rule: Rule | Sequence[Rule] | None) -> list[Rule]:
    """Return the membership rules that the arguments r_cut and rule of `NeighborFlips` define."""
    rules: list[Rule] = []
    if r_cut is not None:
        several = isinstance(r_cut, list | tuple) or (isinstance(r_cut, np.ndarray) and r_cut.ndim)
        rules.extend(_cutoff(one) for one in (r_cut if several else [r_cut]))
    if rule is not None:
        rules.extend(rule if isinstance(rule, Sequence) else [rule])
    if not rules:
        raise InputError(
            "no cutoff or other rule for neighbors was given",
            remedy="Give r_cut=8.5 (in Å), a list of radii, or a rule from mdnum.trajectories.rules",
        )
    for one in rules:
        if not isinstance(one, Rule):
            raise InputError(
                f"{one!r} is not a rule that decides which pairs are neighbors",
                remedy="Give CutoffRule, SpeciesCutoffs, Nearest or Capped of mdnum.trajectories.rules",
            )
    return rules


def _cutoff(value: Any) -> Rule:
    def length(one: Any) -> float:
        if isinstance(one, str | bytes):
            raise ValueError("words")
        return float(one)

    try:
        if isinstance(value, Mapping):
            return SpeciesCutoffs({pair: length(one) for pair, one in value.items()})
        return CutoffRule(length(value))
    except (TypeError, ValueError):
        message = f"r_cut = {value!r}; expected a length in Å, or lengths by pair of species"
        raise InputError(message, remedy='Give r_cut=8.5, {("O", "H"): 2.5} or a list of cutoffs') from None
