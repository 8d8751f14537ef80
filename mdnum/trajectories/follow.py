"""Frame-by-frame reading of one trajectory, or of two for comparison.

Neighbor sets of two trajectories are compared completely only at the first frame. Later, only the flips
update the difference of the sets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.md.ledger import FlipTable, Members
from mdnum.reading import EarlierFramesError
from mdnum.trajectories.frame import AtomIndices, Frame, FrameCheck, leap
from mdnum.trajectories.history import crossings
from mdnum.trajectories.images import NARROW, ImageFlips
from mdnum.trajectories.lattice import Placed, lattice_of
from mdnum.trajectories.repeats import RepeatedFrames
from mdnum.trajectories.residues import ByResidue, ResidueTracker
from mdnum.trajectories.resolution import Resolution
from mdnum.trajectories.rules import CutoffRule, Rule, SpeciesCutoffs, smallest_radius
from mdnum.trajectories.search import image_distances
from mdnum.trajectories.separation import (
    FreeFlight,
    Separation,
    common_shift,
    flight_of,
    growth,
    odd_flight,
    same_lattice,
    separation,
    velocities_differ,
    velocities_of,
)
from mdnum.trajectories.tracker import Groups, Tracker, atoms_of
from mdnum.trajectories.trajectory import Trajectory
from mdnum.trajectories.unwrapping import Unwrapping

Pair = tuple[int, int, int]
#: Function that receives the name of a table and its columns of equal length.
Sink = Callable[[str, dict[str, Any]], None]

#: Largest number of rows of the table of pairs that begin to differ.
ROWS = 1_000
_FIRST = 8
# frames at which the flux through the threshold is measured from velocities
_FLUX_FRAMES = 12
# displacement for that, as a share of the usual distance of neighbors: small beside the way to a turn
_FLUX_MOVE = 2e-3
# frames whose displacements are compared with velocities
_FLIGHTS = 12
# share of the spread of displacements that a common shift explains: of one within the resolution of the
# files, and of one beside another difference
_SHIFT_ALONE, _SHIFT_MOSTLY = 0.5, 0.99
# times that differ by less than this, relative, are the same
_SAME_TIME = 1e-6


def _usable(
    files: Sequence[Trajectory],
    atoms: AtomIndices,
    rules: Sequence[Rule],
    step: Callable[..., Any],
    found: Pass | Compared,
) -> Iterator[tuple[list[Frame], Any]]:
    """Yield (next frame of each file, result of `step`) until a file ends or a frame is unusable.

    All membership rules process a frame before any results are stored. If one rule rejects a frame, no rule
    stores results of this frame.

    Raises:
        InputError: the first frame cannot be read or used, so there are no results to keep.
    """
    radius, species = smallest_radius(rules), any(rule.needs_species for rule in rules)
    streams = []
    for one in files:
        one.check = FrameCheck(atoms, str(one.path), radius, one.bits, species=species)
        one.repeats = RepeatedFrames(one.drop_repeats, one.remembered)
        streams.append(one.repeats(map(one.check, one.frames())))
    while True:
        try:
            frames = [frame for one in streams if (frame := next(one, None)) is not None]
            if len(frames) < len(files):
                break
            stepped = step(*frames)
        except InputError as error:
            if not found.frames or isinstance(error, EarlierFramesError):
                raise
            found.stopped = error
            return
        yield frames, stepped
    if not found.frames:
        where = str(files[0].path) if len(files) == 1 else None
        raise InputError("the chosen range of frames is empty", remedy="Choose other frames", where=where)


# ---- one trajectory


class NeighborCounts:
    """Number of neighbors of each atom in the first group, updated from the flips."""

    def __init__(self, members: Members, atoms: int, groups: Groups, directed: bool):
        self._sides = [None if one is None else np.isin(np.arange(atoms), one) for one in groups]
        self._atoms = None if groups[0] is None else np.asarray(groups[0])
        self._directed, self._now = directed, np.zeros(atoms, np.int64)
        # by number of neighbors, atoms and frames at which an atom had as many
        self.seen = np.zeros(1, np.int64)
        self._add(members.i, members.j, np.ones(len(members), np.int64))

    def step(self, flips: FlipTable) -> None:
        """Update the numbers of neighbors with the flips of one frame."""
        self._add(flips.i, flips.j, np.where(flips.entered, 1, -1))

    def _add(self, i: np.ndarray, j: np.ndarray, sign: np.ndarray) -> None:
        first, second = self._sides
        for one, other in ((i, j),) if self._directed else ((i, j), (j, i)):
            # between two groups an atom of the first counts those of the second
            counts = sign if first is None or second is None else sign * (first[one] & second[other])
            np.add.at(self._now, one, counts)

    def count(self) -> tuple[int, float, int]:
        """Return (fewest, mean, most) neighbors per atom at a frame. Add the frame to the histogram."""
        here = np.bincount(self._now if self._atoms is None else self._now[self._atoms])
        if len(here) > len(self.seen):
            self.seen = np.pad(self.seen, (0, len(here) - len(self.seen)))
        self.seen[: len(here)] += here
        total = int(here @ np.arange(len(here)))
        atoms = len(self._now if self._atoms is None else self._atoms)
        return int(here.nonzero()[0][0]), total / atoms, len(here) - 1


@dataclass
class Followed:
    """Tracker, neighbor counts and statistics for one membership rule."""

    rule: Rule
    tracker: Tracker | ResidueTracker  # of it
    neighbors: NeighborCounts | None = None  # known from the first frame on
    flux: list[tuple[int, float]] = field(default_factory=list)  # (flips, moment) where velocities were used
    reach: float = float("nan")  # the usual distance of a pair at the threshold, length; nan without one
    ranked: bool = False  # whether it is mostly the order of distances that decides there, and no radius
    images: ImageFlips | None = None  # where several images of an atom can be inside


@dataclass
class Pass:
    """Results of reading one trajectory."""

    rules: list[Followed]
    frames: int = 0  # examined
    stopped: InputError | None = None  # what was wrong with the frame after the last one
    flights: list[FreeFlight] = field(default_factory=list)  # from one to the next of the first frames
    # number of the frame, atom and distance of what no atom does between two frames
    leaps: list[dict[str, Any]] = field(default_factory=list)

    @property
    def odd(self) -> dict[str, Any] | None:
        """Contradiction between displacements, velocities and times, or None."""
        return odd_flight(self.flights)


def follow(
    trajectory: Trajectory, rules: Sequence[Rule], groups: Groups, resolution: Resolution, sink: Sink,
    residues: ByResidue | None = None,
) -> Iterator[Pass]:  # fmt: skip
    """Read each frame once. Pass rows of the tables "members", "flips", "frames" and "motion" to `sink`.

    If `residues` is given, pairs of residues are examined, but `groups` contains atoms. The same
    `Pass` is yielded after each frame. Iteration may stop at any frame. Memory use does not grow with the
    number of frames. Reading ends at the first unreadable or unusable frame. Earlier results are kept.

    Raises:
        InputError: the first frame cannot be read or used, so there are no results to keep.
    """
    species = [str(one) for one in trajectory.species]
    made, size = (lambda rule: Tracker(rule, *groups, species)), (trajectory.atoms, groups)
    if residues is not None:
        groups, size = residues.groups, (len(residues.table), residues.sides)
        made = partial(residues.tracker, species=species)
    found = Pass([Followed(rule, made(rule)) for rule in rules])
    atoms, last = atoms_of(groups), None
    unwrapping = Unwrapping(atoms)
    # frames whose velocities are used: spread over the file, or ever fewer if its end is not known
    count, measured = trajectory.count, {0, *(2**n for n in range(_FLUX_FRAMES - 1))}
    if count is not None:
        measured = set(np.linspace(0, count - 1, min(_FLUX_FRAMES, count)).astype(int).tolist())

    def step(frame: Frame) -> list[FlipTable]:
        bound = resolution.bound(frame)
        # a margin among the nearest is the difference of two distances
        return [one.tracker.step(frame, bound * (1 + one.rule.directed)) for one in found.rules]

    for (frame,), stepped in _usable([trajectory], atoms, rules, step, found):
        if last is not None:
            if (
                found.frames < _FLIGHTS
                # velocities are per time, and the numbers of frames are none
                and trajectory.time != "frame"
                and (flight := flight_of(last, frame, resolution.usual_step(frame))) is not None
            ):
                found.flights.append(flight)
            if (far := leap(last, frame, atoms)) is not None:
                found.leaps.append({"frame": frame.index, "atom": far[0], "distance": far[1]})
        last = frame
        if (row := unwrapping.see(frame)) is not None:
            row |= {"frame": found.frames, "number": frame.index, "time": frame.time}
            sink("motion", {name: np.array([value]) for name, value in row.items()})
        for number, (one, new) in enumerate(zip(found.rules, stepped, strict=True)):
            _hand_on(sink, number, one, new, frame, found.frames, size)
            if found.frames in measured and residues is None:
                _measure_flux(one, frame, groups, species)
        found.frames += 1
        yield found


def _hand_on(
    sink: Sink, number: int, one: Followed, flips: FlipTable, frame: Frame, at: int, size: tuple[int, Groups]
) -> None:
    """Pass the table rows of one frame and one membership rule to `sink`."""
    if one.neighbors is None:
        members = one.tracker.members()
        one.neighbors = NeighborCounts(members, *size, one.rule.directed)
        one.reach, one.ranked = _threshold(one.rule, members)
        narrow = lattice_of(frame.box).narrowest < NARROW * one.rule.reach
        if narrow and isinstance(one.tracker, Tracker) and not one.rule.directed:
            one.images = ImageFlips()
        sink("members", {"rule": np.full(len(members), number), **vars(members)})
    else:
        one.neighbors.step(flips)
    if len(flips):
        sink("flips", flips.columns(number))
    if one.images is not None and (rows := one.images.step(frame, one.tracker.members())) is not None:
        same = {"rule": number, "frame": at}
        sink("images", {**{name: np.full(len(rows["i"]), value) for name, value in same.items()}, **rows})
    fewest, mean, most = one.neighbors.count()
    entered = int(np.count_nonzero(flips.entered))
    row = {
        "rule": number, "frame": at, "number": frame.index, "time": frame.time, "pairs": one.tracker.pairs,
        "near": one.tracker.near, "entered": entered, "left": len(flips) - entered,
        "ambiguous": int(np.count_nonzero(flips.ambiguous)), "min_margin": one.tracker.min_margin,
        "fewest": fewest, "neighbors": mean, "most": most,
    }  # fmt: skip
    sink("frames", {name: np.array([value]) for name, value in row.items()})


def _threshold(rule: Rule, members: Members) -> tuple[float, bool]:
    """Return a typical threshold distance, and whether most atoms have the maximum number of neighbors."""
    if isinstance(rule, CutoffRule | SpeciesCutoffs):
        return rule.reach, False
    if not len(members):
        return rule.shortest if np.isfinite(rule.shortest) else float("nan"), False
    _, begin, counts = np.unique(members.i, return_index=True, return_counts=True)
    full = counts == rule.most
    if 2 * np.count_nonzero(full) < len(counts):
        # most have room for all that are near enough
        return rule.reach if np.isfinite(rule.reach) else float(np.median(members.distance)), False
    return float(np.median(np.maximum.reduceat(members.distance, begin)[full])), True


def _measure_flux(one: Followed, frame: Frame, groups: Groups, species: list[str]) -> None:
    if frame.velocities is None or not len(distance := one.tracker.members().distance):
        return

    def count(here: Frame, later: Frame) -> int:
        tracker = Tracker(one.rule, *groups, species)
        tracker.step(here)
        return len(tracker.step(later))

    if (found := crossings(frame, count, _FLUX_MOVE * float(np.median(distance)))) is not None:
        one.flux.append(found)


# ---- two trajectories


@dataclass
class SetDifference:
    """Pairs (i, j, rank) that are neighbors in only one of two trajectories."""

    only_a: set[Pair] = field(default_factory=set)
    only_b: set[Pair] = field(default_factory=set)
    new: list[Pair] = field(default_factory=list)  # those that came to differ at the last frame

    @classmethod
    def of(cls, a: Members, b: Members) -> SetDifference:
        """Compute the difference of two neighbor sets at the first frame."""
        columns = [(one.i.tolist(), one.j.tolist(), one.rank.tolist()) for one in (a, b)]
        first, second = (set(zip(*one, strict=True)) for one in columns)
        both = first & second
        found = cls(first - both, second - both)
        found.new = sorted(found.only_a | found.only_b)
        return found

    def __len__(self) -> int:
        return len(self.only_a) + len(self.only_b)

    def step(self, a: FlipTable, b: FlipTable) -> None:
        """Update the difference of the neighbor sets with the flips at one frame."""
        differed: dict[Pair, bool] = {}
        for flips, mine, others in ((a, self.only_a, self.only_b), (b, self.only_b, self.only_a)):
            columns = (flips.i.tolist(), flips.j.tolist(), flips.rank.tolist(), flips.entered.tolist())
            for *ids, entered in zip(*columns, strict=True):
                pair: Pair = (ids[0], ids[1], ids[2])
                differed.setdefault(pair, pair in mine or pair in others)
                # entering ends a difference where the other has the pair inside, and begins one if not
                here, there = (mine, others) if entered else (others, mine)
                if pair in there:
                    there.remove(pair)
                else:
                    here.add(pair)
        now = (pair for pair, was in differed.items() if not was)
        self.new = sorted(pair for pair in now if pair in self.only_a or pair in self.only_b)


def distances(frame: Frame, pairs: list[Pair], directed: bool = False) -> Float[np.ndarray, "pairs"]:
    """Return the distances of pairs (i, j, rank of periodic image). Missing images give inf."""
    i, j, rank = np.array(pairs, np.int64).reshape(-1, 3).T
    at = Placed(np.ascontiguousarray(frame.positions), lattice_of(frame.box), 0.0)
    return image_distances(at, np.minimum(i, j), np.maximum(i, j), rank, directed)


@dataclass
class ComparedSide:
    """One of two trajectories to compare, with its tracker, resolution and error bounds."""

    trajectory: Trajectory
    tracker: Tracker
    resolution: Resolution
    speeds: Resolution | None = None  # of velocities, where the file has them in a unit that both have
    distance_bound: float = 0.0  # how far a distance can be off at the last frame, length
    box_bound: float = 0.0  # the part of it that comes from the box, for a pair through one period
    bound: float = 0.0  # how far a margin can be off

    def step(self, frame: Frame) -> FlipTable:
        """Process the next frame of this trajectory. Return the flips since the previous frame."""
        self.distance_bound = self.resolution.bound(frame)
        self.box_bound = self.resolution.bound(frame, np.zeros(0, np.int64))
        # a margin among the nearest is the difference of two distances
        self.bound = self.distance_bound * (1 + self.tracker.rule.directed)
        return self.tracker.step(frame, bound=self.bound)

    def position_bound(self, periods: int) -> float:
        """Return the error bound of a position, up to `periods` periods of the box away."""
        # a distance has two atoms that are off
        return (self.distance_bound - self.box_bound) / 2 + max(1, periods) * self.box_bound

    def speed_bound(self, frame: Frame) -> float:
        """Return the error bound of one atom's velocity, in length per time."""
        if self.speeds is None or frame.velocities is None:
            return 0.0
        return self.speeds.bound(velocities_of(frame)) / 2


def differing_rows(
    pairs: list[Pair], difference: SetDifference, sides: Sequence[ComparedSide], frames: Sequence[Frame]
) -> dict[str, np.ndarray]:
    """Return table columns for the pairs inside the cutoff in only one trajectory.

    A pair is ambiguous if rounded coordinates may have moved the pair across the threshold.
    """
    rule = sides[0].tracker.rule
    i, j, rank = (np.array([pair[k] for pair in pairs], np.int64) for k in range(3))
    in_a = np.array([pair in difference.only_a for pair in pairs], bool)
    lengths = [distances(frame, pairs, rule.directed) for frame in frames]
    margins = [
        _thresholds(i, j, inside, rule, side) - distance
        for inside, side, distance in zip((in_a, ~in_a), sides, lengths, strict=True)
    ]
    # what has no threshold is not known to be away from it
    clear = [np.abs(margin) > side.bound for margin, side in zip(margins, sides, strict=True)]
    return {
        "i": i, "j": j, "rank": rank,
        "inside": np.where(in_a, "A", "B").astype(object),
        "distance_a": lengths[0], "distance_b": lengths[1], "margin_a": margins[0], "margin_b": margins[1],
        "bound": np.full(len(pairs), max(side.bound for side in sides)), "ambiguous": ~(clear[0] & clear[1]),
    }  # fmt: skip


def _thresholds(
    i: np.ndarray, j: np.ndarray, inside: np.ndarray, rule: Rule, side: ComparedSide
) -> Float[np.ndarray, "pairs"]:
    """Return each pair's threshold distance. For nearest-neighbor rules, the threshold depends on i."""
    if isinstance(rule, CutoffRule):
        return np.full(len(i), rule.radius)
    if isinstance(rule, SpeciesCutoffs):
        species = side.trajectory.species.astype(str)
        names = list(zip(species[i].tolist(), species[j].tolist(), strict=True))
        return np.array([rule.radii.get((a, b), rule.radii.get((b, a), np.nan)) for a, b in names], float)
    stays, enters = side.tracker.thresholds()
    return np.where(inside, stays[i], enters[i])


@dataclass
class NeighborSets:
    """Neighbor sets of one membership rule in two trajectories, and their difference."""

    rule: Rule
    sides: list[ComparedSide]
    difference: SetDifference = field(default_factory=SetDifference)
    first: dict[str, Any] | None = None  # what was seen at the first frame whose sets differ
    certain: int | None = None  # first frame at which a pair differs that no resolution could have moved
    first_pairs: list[dict[str, Any]] = field(default_factory=list)  # some of the pairs that differ there
    rows: int = 0  # pairs written to the table of those that come to differ


@dataclass
class Compared:
    """Results of a frame-by-frame comparison of two trajectories."""

    frames: int = 0
    seed: int | None = None  # first frame whose positions differ at all
    beyond: int | None = None  # first frame with an atom further apart than the resolution of both explains
    other_box: dict[str, Any] | None = None  # the boxes at the first frame at which they are not the same
    times_differ: int = 0
    # the first frame at which all atoms are shifted alike
    shift: int | None = None
    other: bool = False  # whether atoms were apart before then beyond what any shift explains
    # how velocities differ at the first frame at which they do while positions agree, and the last frame
    # at which both agree
    velocities: dict[str, Any] | None = None
    velocities_same: int | None = None
    last: Separation = field(default_factory=lambda: Separation(0.0, 0.0, 0))  # at the last frame
    stopped: InputError | None = None


def follow_both(sets: list[NeighborSets], atoms: AtomIndices, sink: Sink) -> Iterator[Compared]:
    """Read two trajectories frame by frame. Yield a `Compared` after each frame.

    Rows of the tables "apart" and "differing" are passed to the function `sink`.
    """
    found, sides = Compared(), sets[0].sides

    def step(*frames: Frame) -> list[list[FlipTable]]:
        return [[side.step(frame) for side, frame in zip(one.sides, frames, strict=True)] for one in sets]

    files, rules = [side.trajectory for side in sides], [one.rule for one in sets]
    for (a, b), flips in _usable(files, atoms, rules, step, found):
        at, before = found.frames, found.last
        now, allowed = _apart(found, a, b, atoms, sides)
        if found.seed is None and now.furthest > 0:
            found.seed = at
        if found.beyond is None and now.furthest > allowed:
            found.beyond = at
        # what a file writes less often is not missing; before its first step there may be none
        expected = all(side.speeds is not None for side in sides)
        written = a.velocities is not None and b.velocities is not None
        if expected and found.beyond is None and found.velocities is None and (written or not at):
            how = velocities_differ(a, b, atoms, sum(map(ComparedSide.speed_bound, sides, (a, b))))
            found.velocities = how and {"frame": at, **how}
            found.velocities_same = found.velocities_same if how else at
        # formats that round positions may round the box as much
        tolerance = sum(side.distance_bound for side in sides)
        if found.other_box is None and not same_lattice(a.box, b.box, tolerance):
            axes = bool((a.box.pbc != b.box.pbc).any())
            found.other_box = {"frame": at, "axes": axes, "a": a.box.plain(), "b": b.box.plain()}
        found.times_differ += int(abs(a.time - b.time) > _SAME_TIME * max(abs(a.time), abs(b.time)))
        for place, (one, new) in enumerate(zip(sets, flips, strict=True)):
            if at:
                one.difference.step(*new)
            else:
                one.difference = SetDifference.of(*(side.tracker.members() for side in one.sides))
            _sets_at(sink, place, one, at, (a, b), now, before)
        # pairs are those of the first rule
        only, tracked = sets[0].difference, [side.tracker.pairs for side in sides]
        row = {
            "frame": at, "number_a": a.index, "number_b": b.index, "time": a.time, "time_b": b.time,
            "furthest": now.furthest, "bound": allowed, "typical": now.typical, "atom": now.atom,
            **dict(zip(("shift_x", "shift_y", "shift_z"), now.shift, strict=True)),
            "pairs_a": tracked[0], "pairs_b": tracked[1],
            "only_a": len(only.only_a), "only_b": len(only.only_b),
        }  # fmt: skip
        sink("apart", {name: [value] for name, value in row.items()})
        found.last = now
        found.frames += 1
        yield found


def _apart(
    found: Compared, a: Frame, b: Frame, atoms: AtomIndices, sides: Sequence[ComparedSide]
) -> tuple[Separation, float]:
    """Return the displacements between two files without a common shift, and their error bound.

    A common shift is removed only if the shift explains nearly all of the distances. Different origins, or
    removed center-of-mass motion in one file, cause a common shift.
    """
    now = separation(a, b, atoms)
    allowed = sum(side.position_bound(now.periods) for side in sides)
    if now.furthest <= allowed or len(a.positions if atoms is None else atoms) < 4:
        return now, allowed
    rest = separation(a, b, atoms, common_shift(a, b, atoms))
    # the shift is off by as much as a position
    allowed_rest = 2 * sum(side.position_bound(rest.periods) for side in sides)
    if found.shift is None:
        found.other |= rest.furthest > allowed_rest
        # of the squares of displacements
        explained = 1 - (rest.typical / now.typical) ** 2
        if explained < (_SHIFT_ALONE if rest.furthest <= allowed_rest else _SHIFT_MOSTLY):
            return now, allowed
        # before, rounding may have hidden that it is one
        found.shift, found.beyond = found.frames, found.beyond if found.other else None
    return rest, allowed_rest


def _sets_at(
    sink: Sink,
    number: int,
    one: NeighborSets,
    at: int,
    frames: tuple[Frame, Frame],
    now: Separation,
    before: Separation,
) -> None:
    """Record the difference of two neighbor sets at a frame. Write pairs that are new in this difference."""
    difference, first = one.difference, False
    if one.certain is None and len(difference):
        # all that differ: one that came to differ within the resolution may be beyond it by now
        differing = sorted(difference.only_a | difference.only_b)
        standing = differing_rows(differing, difference, one.sides, frames)
        undecided, first = int(np.count_nonzero(standing["ambiguous"])), one.first is None
        if first:
            one.first = {
                "frame": at, "number": frames[0].index, "time": frames[0].time, "pairs": len(difference),
                "furthest": now.furthest, "typical": now.typical,
                "furthest_before": before.furthest if at else None,
                "typical_before": before.typical if at else None, "ambiguous": undecided,
            }  # fmt: skip
        if undecided < len(difference):
            one.certain = at
    if new := difference.new[: ROWS - one.rows]:
        rows = differing_rows(new, difference, one.sides, frames)
        told = {"rule": np.full(len(new), number), "frame": np.full(len(new), at), **rows}
        sink("differing", told)
        one.rows += len(new)
        if first:
            kept = range(min(len(new), _FIRST))
            one.first_pairs = [{name: values[k] for name, values in told.items()} for k in kept]


def growth_of(frames: int, one: NeighborSets, table: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return growth rates of the distance between two runs, before and after neighbor sets first differ."""
    cutoff, furthest = isinstance(one.rule, CutoffRule), float(table["furthest"].max(initial=0.0))
    limit = 0.1 * (one.rule.reach if cutoff else furthest)
    cut = frames if one.first is None else one.first["frame"]
    # up to its bound a separation may be made of rounding
    length = np.where(table["furthest"] > table["bound"], table["furthest"], 0.0)
    time = table["time"]
    seed = int(np.flatnonzero(length > 0)[0]) if length.any() else 0
    # what differs in the first frame began to before the file did
    began = float(time[0] if seed else 2 * time[0] - time[-1]), float(time[seed])
    parts = {"before": slice(None, cut + 1), "after": slice(cut, None)}
    laws = {name: growth(time[part], length[part], limit, began) for name, part in parts.items()}
    return {name: law and vars(law) for name, law in laws.items()}
