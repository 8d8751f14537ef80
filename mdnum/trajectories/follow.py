"""A trajectory read once, or two of the same atoms in step: frames checked, flips handed on as they come.

Neighbor sets of two are compared once, at the first frame; from there the flips of either say what becomes of
the difference, so that a frame costs what changed in it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError
from mdnum.trajectories.frame import AtomIndices, Box, Frame, FrameCheck, leap
from mdnum.trajectories.history import crossings
from mdnum.trajectories.lattice import Placed, lattice_of
from mdnum.trajectories.ledger import FlipTable, Members
from mdnum.trajectories.repeats import Repeats
from mdnum.trajectories.resolution import Resolution
from mdnum.trajectories.rules import CutoffRule, Rule, SpeciesCutoffs, smallest_radius
from mdnum.trajectories.search import image_distances
from mdnum.trajectories.tracker import Groups, Tracker, atoms_of
from mdnum.trajectories.trajectory import Trajectory

Pair = tuple[int, int, int]
#: Takes rows of a table: its name and equally long columns.
Sink = Callable[[str, dict[str, Any]], None]

#: Rows of the table of pairs that come to differ.
ROWS = 1_000
_FIRST = 8
# frames at which the flux through the threshold is measured from velocities
_FLUX_FRAMES = 12
# displacement for that, as a share of the usual distance of neighbors: small beside the way to a turn
_FLUX_MOVE = 2e-3
# frames whose displacements are compared with velocities; displacements over what those say above which they
# contradict; correlations above which they keep their directions from frame to frame, and lie along them
_FLIGHTS, _TOO_FAR, _KEPT, _ALONG = 12, 1.1, 0.8, 0.9
# last digits that a displacement has to have for its size to say something
_STEPS = 3.0
# share of the spread of displacements that a common shift explains: of one within the resolution of the
# files, and of one beside another difference
_SHIFT_ALONE, _SHIFT_MOSTLY = 0.5, 0.99
# velocities that differ by less than this share of their root mean square may have been rounded otherwise
_SAME_SPEED = 1e-4
# atoms that are examined first for whether there is a shift
_SOME = 200
# correlation from which on velocities are parallel; standard errors up to which there is none
_PARALLEL, _UNRELATED = 0.99, 4.0
# the steepest power law that is told from an exponential; how much smaller squares are of what fits better
_STEEPEST, _BETTER = 4.0, 2.0
# times that differ by less than this, relative, are the same
_SAME_TIME = 1e-6


def _usable(
    files: Sequence[Trajectory],
    atoms: AtomIndices,
    rules: Sequence[Rule],
    step: Callable[..., Any],
    found: Pass | Compared,
) -> Iterator[tuple[list[Frame], Any]]:
    """(the next frame of each file, what `step` makes of them) up to where one ends or cannot be used.

    Every rule steps before anything is handed on: a frame that one of them refuses is not in the ledger of
    another.

    Raises:
        InputError: the first frame cannot be read or used: there is nothing to keep.
    """
    radius, species = smallest_radius(rules), any(rule.needs_species for rule in rules)
    streams = []
    for one in files:
        one.check = FrameCheck(atoms, str(one.path), radius, one.bits, species=species)
        one.repeats = Repeats(one.drop_repeats)
        streams.append(one.repeats(map(one.check, one.frames())))
    while True:
        try:
            frames = [frame for one in streams if (frame := next(one, None)) is not None]
            if len(frames) < len(files):
                break
            stepped = step(*frames)
        except InputError as error:
            if not found.frames:
                raise
            found.stopped = error
            if not hasattr(error, "frame"):
                # a rule that refuses a frame does not know its number
                message = f"frame {found.frames} of those examined: {error.message}"
                found.stopped = InputError(message, remedy=error.remedy, where=error.where)
            return
        yield frames, stepped
    if not found.frames:
        where = str(files[0].path) if len(files) == 1 else None
        raise InputError("no frame is left of what was asked for", remedy="Ask for others", where=where)


# ---- one trajectory


class NeighborCounts:
    """How many neighbors each atom of the first group has, kept up to date by the flips."""

    def __init__(self, members: Members, atoms: int, groups: Groups, directed: bool):
        self._sides = [None if one is None else np.isin(np.arange(atoms), one) for one in groups]
        self._atoms = None if groups[0] is None else np.asarray(groups[0])
        self._directed, self._now = directed, np.zeros(atoms, np.int64)
        # by number of neighbors, atoms and frames at which an atom had as many
        self.seen = np.zeros(1, np.int64)
        self._add(members.i, members.j, np.ones(len(members), np.int64))

    def step(self, flips: FlipTable) -> None:
        """After the flips of a frame."""
        self._add(flips.i, flips.j, np.where(flips.entered, 1, -1))

    def _add(self, i: np.ndarray, j: np.ndarray, sign: np.ndarray) -> None:
        first, second = self._sides
        for one, other in ((i, j),) if self._directed else ((i, j), (j, i)):
            # between two groups an atom of the first counts those of the second
            counts = sign if first is None or second is None else sign * (first[one] & second[other])
            np.add.at(self._now, one, counts)

    def count(self) -> tuple[int, float, int]:
        """(fewest, mean, most) over the atoms at this frame, which is added to what was seen."""
        here = np.bincount(self._now if self._atoms is None else self._now[self._atoms])
        if len(here) > len(self.seen):
            self.seen = np.pad(self.seen, (0, len(here) - len(self.seen)))
        self.seen[: len(here)] += here
        total = int(here @ np.arange(len(here)))
        atoms = len(self._now if self._atoms is None else self._atoms)
        return int(here.nonzero()[0][0]), total / atoms, len(here) - 1


@dataclass
class Followed:
    """One rule on its way through the frames."""

    rule: Rule
    tracker: Tracker  # of it
    neighbors: NeighborCounts | None = None  # known from the first frame on
    flux: list[tuple[int, float]] = field(default_factory=list)  # (flips, moment) where velocities were used
    reach: float = float("nan")  # the usual distance of a pair at the threshold, length; nan without one
    ranked: bool = False  # whether it is mostly the order of distances that decides there, and no radius


@dataclass
class Pass:
    """What came of reading a trajectory."""

    rules: list[Followed]
    frames: int = 0  # examined
    stopped: InputError | None = None  # what was wrong with the frame after the last one
    flights: list[Flight] = field(default_factory=list)  # from one to the next of the first frames
    # (number of the frame, atom, how far) of what no atom does between two frames
    leaps: list[tuple[int, int, float]] = field(default_factory=list)


def follow(
    trajectory: Trajectory, rules: Sequence[Rule], groups: Groups, resolution: Resolution, sink: Sink
) -> Iterator[Pass]:
    """Reads the frames once, handing rows of "members", "flips" and "frames" to the sink as they come.

    Yields the same `Pass` after each frame, and can be left then. Memory is that of one frame and the
    trackers', however many frames there are. A frame that cannot be read or used ends it; what came before
    stays.

    Raises:
        InputError: the first frame cannot be read or used: there is nothing to keep.
    """
    species = [str(one) for one in trajectory.species]
    found = Pass([Followed(rule, Tracker(rule, *groups, species)) for rule in rules])
    atoms, last = atoms_of(groups), None
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
                and (flight := flight_of(last, frame, resolution.usual_step(frame))) is not None
            ):
                found.flights.append(flight)
            if (far := leap(last, frame, atoms)) is not None:
                found.leaps.append((frame.index, *far))
        last = frame
        for number, (one, new) in enumerate(zip(found.rules, stepped, strict=True)):
            _hand_on(sink, number, one, new, frame, found.frames, (trajectory.atoms, groups))
            if found.frames in measured:
                _measure_flux(one, frame, groups, species)
        found.frames += 1
        yield found


def _hand_on(
    sink: Sink, number: int, one: Followed, flips: FlipTable, frame: Frame, at: int, size: tuple[int, Groups]
) -> None:
    """Rows of one frame and rule."""
    if one.neighbors is None:
        members = one.tracker.members()
        one.neighbors = NeighborCounts(members, *size, one.rule.directed)
        one.reach, one.ranked = _threshold(one.rule, members)
        sink("members", {"rule": np.full(len(members), number), **vars(members)})
    else:
        one.neighbors.step(flips)
    if len(flips):
        sink("flips", {"rule": np.full(len(flips), number), **vars(flips)})
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
    """(where pairs come and go: a radius, or how far the last is; whether their order decides there)."""
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


class Flight(NamedTuple):
    """Displacements between two frames next to what velocities say."""

    moved: float  # root mean square displacement over that of velocities times time
    factor: float  # displacements over the mean of both velocities times time, by least squares
    parallel: float  # correlation of the two
    kept: float  # correlation of the velocities with those of the frame before


def flight_of(start: Frame, end: Frame, step: float = 0.0) -> Flight | None:
    """How displacements between two frames compare with velocities; None without either, or without motion.

    `moved` is near 1 where atoms fly straight and below it where they turn around in between: never far
    above. `factor` is near 1 as long as velocities keep their direction, whichever units they have.
    """
    if start.velocities is None or end.velocities is None or not end.time > start.time:
        return None
    u, v, moved = start.velocities, end.velocities, displacements(start, end)
    mean = (u + v) / 2 * (end.time - start.time)
    if len(u) > 3:
        # a file may have been centered since
        mean, moved = mean - np.median(mean, axis=0), moved - np.median(moved, axis=0)
    expected, size, uu, vv = (float(np.vdot(one, one)) for one in (mean, moved, u, v))
    if not min(expected, size, uu, vv) > 0:
        return None
    resolved = size > moved.size * (_STEPS * step) ** 2
    return Flight(
        resolved * float(np.sqrt(size / uu)) / (end.time - start.time),
        float(np.vdot(mean, moved)) / expected,
        float(np.vdot(mean, moved)) / float(np.sqrt(expected * size)),
        float(np.vdot(u, v)) / float(np.sqrt(uu * vv)),
    )


def odd_flight(flights: Sequence[Flight]) -> dict[str, Any] | None:
    """Whether displacements contradict velocities and times, from their medians over some frames.

    That atoms move less than their velocities say is no contradiction where they turn around between two
    frames: it is one only where velocities have kept their directions, and displacements lie along them.

    Returns:
        the factor by which they are too large (or small, below 1), and whether it is a lower bound of it;
        None where there is no contradiction.
    """
    if not flights:
        return None
    moved, factor, parallel, kept = np.median(np.array(flights), axis=0).tolist()
    if kept > _KEPT and parallel > _ALONG:
        return None if 1 / _TOO_FAR < factor < _TOO_FAR else {"factor": factor, "at_least": False}
    return {"factor": moved, "at_least": True} if moved > _TOO_FAR else None


# ---- two trajectories


@dataclass(frozen=True)
class Separation:
    """How far atoms are from where they are in another frame."""

    furthest: float  # largest displacement, length
    typical: float  # root mean square displacement, length
    atom: int  # the one that is displaced furthest
    # most lattice vectors of one kind between an atom and its nearest image: 0 where none was wrapped in one
    # of the frames only
    periods: int = 0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of all atoms alike, taken off before, length


def displacements(start: Frame, end: Frame) -> Float[np.ndarray, "atoms 3"]:
    """From one frame to another, up to lattice vectors of the second's box.

    The nearest image is found along reduced lattice vectors: for an atom that moved by less than half the
    width of the box it is the nearest of all. Where the frames repeat along different axes, only those along
    which both do have images.
    """
    return _displaced(start, end)[0]


def _displaced(
    start: Frame, end: Frame, shift: Float[np.ndarray, "3"] | float = 0.0, atoms: AtomIndices = None
) -> tuple[Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"]]:
    """(displacements less a shift, whole lattice vectors taken off)."""
    x, y = (one.positions if atoms is None else one.positions[atoms] for one in (start, end))
    moved = y - x - shift
    shared = Box(end.box.matrix, np.asarray(start.box.pbc, bool) & np.asarray(end.box.pbc, bool))
    if not shared.periodic:
        return moved, np.zeros_like(moved)
    lattice = lattice_of(shared)
    whole = np.where(lattice.periodic, np.rint(moved @ lattice.inverse), 0.0)
    return moved - whole @ lattice.vectors, whole


def same_lattice(one: Box, other: Box, tolerance: float) -> bool:
    """Whether two boxes tile space in the same way, whichever lattice vectors they name.

    A component of a lattice vector may be off by the tolerance, length.
    """
    if (np.asarray(one.pbc, bool) != np.asarray(other.pbc, bool)).any():
        return False
    rows = np.asarray(one.pbc, bool)
    a, b = np.asarray(one.matrix, np.float64)[rows], np.asarray(other.matrix, np.float64)[rows]
    if np.array_equal(a, b):
        return True
    # the vectors of one are whole combinations of the other's, and as many to a cell
    whole = np.rint(np.linalg.lstsq(a.T, b.T, rcond=None)[0].T)
    return bool(np.abs(b - whole @ a).max() <= tolerance and abs(round(np.linalg.det(whole))) == 1)


def separation(
    one: Frame, other: Frame, atoms: AtomIndices = None, shift: Float[np.ndarray, "3"] | None = None
) -> Separation:
    """The separation of two frames, less a shift; only of these atoms, where they are given."""
    moved, whole = _displaced(one, other, 0.0 if shift is None else shift, atoms)
    square = np.sum(moved**2, axis=1)
    at = int(np.argmax(square))
    return Separation(
        float(np.sqrt(square[at])),
        float(np.sqrt(square.mean())),
        at if atoms is None else int(atoms[at]),
        int(np.abs(whole).max()),
        (0.0, 0.0, 0.0) if shift is None else (float(shift[0]), float(shift[1]), float(shift[2])),
    )


def common_shift(one: Frame, other: Frame, atoms: AtomIndices = None) -> Float[np.ndarray, "3"]:
    """The displacement that most atoms have in common, up to lattice vectors, length."""
    shift = _displaced(one, other, atoms=atoms)[0][0]
    for _ in range(2):
        # nearest images about one atom lie on both sides of the box if that atom is on the other; about the
        # median they do not
        shift = shift + np.median(_displaced(one, other, shift, atoms)[0], axis=0)
    return shift


def velocities_differ(
    a: Frame, b: Frame, atoms: AtomIndices, bound: float, expected: Sequence[bool]
) -> dict[str, Any] | None:
    """How velocities of two frames differ; None where either has none, or they agree within the bound.

    Args:
        bound: how far the difference of two velocities can be off, length per time.
        expected: whether the file of each has velocities at all.

    Returns:
        the kind: "zero" (none in one, or not written yet), "common" (one vector for all atoms), "scaled",
        "drawn" (uncorrelated) or "other"; which side has none; the factor from A to B and the correlation.
    """
    rows = slice(None) if atoms is None else atoms
    u, v = (None if one.velocities is None else one.velocities[rows] for one in (a, b))
    still = [one is None or not one.any() for one in (u, v)]
    if all(still) or not all(expected):
        return None
    if any(still) or u is None or v is None:
        return {"kind": "zero", "side": "AB"[still.index(True)]}
    apart = v - u
    bound = bound + _SAME_SPEED * float(np.sqrt((u**2).sum(axis=1).mean()))
    if np.sqrt((apart**2).sum(axis=1)).max() <= bound:
        return None
    factor = float(np.vdot(u, v) / np.vdot(u, u))
    alike = float(np.vdot(u, v) / np.sqrt(np.vdot(u, u) * np.vdot(v, v)))
    rest = np.sqrt(((apart - np.median(apart, axis=0)) ** 2).sum(axis=1))
    kind = "scaled" if abs(alike) > _PARALLEL and abs(factor - 1) > 1 - _PARALLEL else "other"
    kind = "drawn" if abs(alike) * np.sqrt(u.size) < _UNRELATED else kind
    kind = "common" if len(u) > 2 and rest.max() <= 2 * bound else kind
    return {"kind": kind, "factor": factor, "correlation": alike}


@dataclass
class SetDifference:
    """Pairs (i, j, rank) that are inside in one trajectory only, carried along by the flips of both."""

    only_a: set[Pair] = field(default_factory=set)
    only_b: set[Pair] = field(default_factory=set)
    new: list[Pair] = field(default_factory=list)  # those that came to differ at the last frame

    @classmethod
    def of(cls, a: Members, b: Members) -> SetDifference:
        """At the first frame."""
        columns = [(one.i.tolist(), one.j.tolist(), one.rank.tolist()) for one in (a, b)]
        first, second = (set(zip(*one, strict=True)) for one in columns)
        both = first & second
        found = cls(first - both, second - both)
        found.new = sorted(found.only_a | found.only_b)
        return found

    def __len__(self) -> int:
        return len(self.only_a) + len(self.only_b)

    def step(self, a: FlipTable, b: FlipTable) -> None:
        """After the flips of the next frame in either."""
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
    """Distances of pairs in a frame, through the image that each names; inf where there is none, length."""
    i, j, rank = np.array(pairs, np.int64).reshape(-1, 3).T
    at = Placed(np.ascontiguousarray(frame.positions), lattice_of(frame.box), 0.0)
    return image_distances(at, np.minimum(i, j), np.maximum(i, j), rank, directed)


@dataclass(frozen=True)
class Growth:
    """How a separation grows: lines through its logarithm over time, and over the logarithm of time."""

    frames: int  # used
    rate: float  # of an exponential, per time
    r2: float  # of its line
    exponent: (
        float | None
    )  # of the power law that fits best, from its beginning; None where none is slow enough
    power_r2: float
    law: str  # "exponential" or "power", whichever leaves much less of the spread; else "either"


def growth(
    time: Float[np.ndarray, "frames"],
    length: Float[np.ndarray, "frames"],
    limit: float,
    began: tuple[float, float],
) -> Growth | None:
    """The law by which a separation grows.

    A force or a velocity that is wrong by a constant separates two runs as a low power of the time since
    then; chaos does exponentially. Lengths of 0, and those above the limit, which are no small differences
    any more, are left out.

    Args:
        began: times between which the two began to separate, where a power law begins.

    Returns:
        None with fewer than five frames.
    """
    use = (length > 0) & (length < limit) & np.isfinite(length)
    if np.count_nonzero(use) < 5 or np.ptp(time[use]) == 0:
        return None
    x, y = time[use], np.log(length[use])
    spread = max(float(np.sum((y - y.mean()) ** 2)), np.finfo(float).tiny)

    def line(x: np.ndarray) -> tuple[float, float]:
        slope, offset = np.polyfit(x, y, 1)
        return float(np.sum((y - slope * x - offset) ** 2)) / spread, float(slope)

    left, rate = line(x)
    # where a power law begins is not seen if a file has rounded it away
    longest = max(x[0] - began[0], np.finfo(float).tiny)
    ahead = longest * np.geomspace(min(max((x[0] - began[1]) / longest, 1e-3), 1.0), 1.0, 40)
    laws = [line(np.log(x - x[0] + one)) for one in ahead if x.min() == x[0] > began[0]]
    slow, exponent = min((one for one in laws if 0 < one[1] <= _STEEPEST), default=(1.0, None))
    law = "power" if slow * _BETTER < left else "either"
    law = "exponential" if exponent is None or left * _BETTER < slow else law
    return Growth(len(x), rate, 1.0 - left, exponent, 1.0 - slow, law)


@dataclass
class ComparedSide:
    """One of the two trajectories."""

    trajectory: Trajectory
    tracker: Tracker
    resolution: Resolution
    speeds: Resolution | None = None  # of velocities, where the file has them in a unit that both have
    distance_bound: float = 0.0  # how far a distance can be off at the last frame, length
    box_bound: float = 0.0  # the part of it that comes from the box, for a pair through one period
    bound: float = 0.0  # how far a margin can be off

    def step(self, frame: Frame) -> FlipTable:
        """The flips of the next frame."""
        self.distance_bound = self.resolution.bound(frame)
        self.box_bound = self.resolution.bound(frame, np.zeros(0, np.int64))
        # a margin among the nearest is the difference of two distances
        self.bound = self.distance_bound * (1 + self.tracker.rule.directed)
        return self.tracker.step(frame, bound=self.bound)

    def position_bound(self, periods: int) -> float:
        """How far one atom, seen through so many periods of the box, can be off at the last frame, length."""
        # a distance has two atoms that are off
        return (self.distance_bound - self.box_bound) / 2 + max(1, periods) * self.box_bound

    def speed_bound(self, frame: Frame) -> float:
        """How far the velocity of an atom can be off, length per time."""
        if self.speeds is None or frame.velocities is None:
            return 0.0
        return self.speeds.bound(velocities_of(frame)) / 2


def velocities_of(frame: Frame) -> Frame:
    """A frame whose positions are the velocities of another, which has them."""
    assert frame.velocities is not None
    return Frame(frame.index, frame.time, frame.velocities, Box())


def differing_rows(
    pairs: list[Pair], difference: SetDifference, sides: Sequence[ComparedSide], frames: Sequence[Frame]
) -> dict[str, np.ndarray]:
    """Columns on pairs that differ: where each is inside, and by how much.

    A pair is ambiguous where its distance in either file is so close to the threshold that the positions may
    have been on its other side before they were written.
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
    """Distance under which each pair is inside, length; that of a neighbor where it is one."""
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
    """The neighbor sets of one rule in the two trajectories."""

    rule: Rule
    sides: list[ComparedSide]
    difference: SetDifference = field(default_factory=SetDifference)
    first: dict[str, Any] | None = None  # what was seen at the first frame whose sets differ
    certain: int | None = None  # first frame at which a pair differs that no resolution could have moved
    first_pairs: list[dict[str, Any]] = field(default_factory=list)  # some of the pairs that differ there
    rows: int = 0  # pairs written to the table of those that come to differ


@dataclass
class Compared:
    """What the frames showed."""

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
    """Reads both once, in step, yielding the same `Compared` after each frame; only these atoms matter.

    The sink takes rows of "apart" and "differing".
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
        if found.beyond is None and found.velocities is None:
            expected = [side.speeds is not None for side in sides]
            kind = velocities_differ(a, b, atoms, sum(map(ComparedSide.speed_bound, sides, (a, b))), expected)
            if kind is not None:
                found.velocities = {"frame": at, **kind}
            elif all(expected):
                found.velocities_same = at
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
    """(separation, how much of it the resolution of both files explains), less a shift of all atoms alike.

    There is one where it explains nearly all: files of one run have other origins, or the motion of the
    center of mass was removed in one of them.
    """
    now = separation(a, b, atoms)
    allowed = sum(side.position_bound(now.periods) for side in sides)
    chosen = np.arange(len(a.positions)) if atoms is None else atoms
    if now.furthest <= allowed or len(chosen) < 4:
        return now, allowed
    some = chosen[:: max(len(chosen) // _SOME, 1)]
    if found.shift is None:
        explained, rest = _explained(a, b, some)
        found.other |= rest.furthest > 2 * allowed
        if explained < _SHIFT_ALONE:
            return now, allowed
    explained, rest = _explained(a, b, chosen)
    # the shift is off by as much as a position
    allowed_rest = 2 * sum(side.position_bound(rest.periods) for side in sides)
    if found.shift is None:
        if explained < (_SHIFT_ALONE if rest.furthest <= allowed_rest else _SHIFT_MOSTLY):
            return now, allowed
        # before, rounding may have hidden that it is one
        found.shift, found.beyond = found.frames, found.beyond if found.other else None
    return rest, allowed_rest


def _explained(a: Frame, b: Frame, atoms: AtomIndices) -> tuple[float, Separation]:
    """(share of the squares of displacements that a common shift explains, separation without it)."""
    rest = separation(a, b, atoms, common_shift(a, b, atoms))
    return 1.0 - (rest.typical / max(separation(a, b, atoms).typical, np.finfo(float).tiny)) ** 2, rest


def _sets_at(
    sink: Sink,
    number: int,
    one: NeighborSets,
    at: int,
    frames: tuple[Frame, Frame],
    now: Separation,
    before: Separation,
) -> None:
    """What one rule's sets show at a frame, and the pairs that are new among those that differ."""
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
    """Rates at which the separation grows before the sets differ, and from then on."""
    limit = 0.1 * (
        one.rule.radius if isinstance(one.rule, CutoffRule) else float(table["furthest"].max(initial=0.0))
    )
    cut = frames if one.first is None else one.first["frame"]
    # up to its bound a separation may be made of rounding
    length = np.where(table["furthest"] > table["bound"], table["furthest"], 0.0)
    time = table["time"]
    seed = int(np.flatnonzero(length > 0)[0]) if length.any() else 0
    # what differs in the first frame began to before the file did
    began = float(time[0] if seed else 2 * time[0] - time[-1]), float(time[seed])
    parts = {}
    for name, part in (("before", slice(None, cut + 1)), ("after", slice(cut, None))):
        law = growth(time[part], length[part], limit, began)
        parts[name] = None if law is None else vars(law)
    return parts
