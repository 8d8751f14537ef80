"""A trajectory read once: every frame checked, every flip handed on as it is found."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Int

from mdnum.errors import InputError
from mdnum.trajectories.compare import displacements
from mdnum.trajectories.frame import Frame, checked, leap, smallest_radius
from mdnum.trajectories.history import crossings
from mdnum.trajectories.ledger import FlipTable, Members
from mdnum.trajectories.resolution import Resolution
from mdnum.trajectories.rules import Capped, CutoffRule, Rule, SpeciesCutoffs
from mdnum.trajectories.tracker import Tracker
from mdnum.trajectories.trajectory import Trajectory

#: Indices of the atoms on either side of a pair; None for all.
Groups = tuple[Int[np.ndarray, "first"] | None, Int[np.ndarray, "second"] | None]
#: Takes rows of a table: its name and equally long columns.
Sink = Callable[[str, dict[str, Any]], None]

# frames at which the flux through the threshold is measured from velocities
_FLUX_FRAMES = 12
# displacement for that, as a share of the usual distance of neighbors: small beside the way to a turn
_FLUX_MOVE = 2e-3


def atoms_of(groups: Groups) -> Int[np.ndarray, "atoms"] | None:
    """The atoms that are on any side; None for all."""
    some = [one for one in groups if one is not None]
    return np.unique(np.concatenate(some)) if some else None


class NeighborCounts:
    """How many neighbors each atom of the first group has, kept up to date by the flips.

    Attributes:
        seen: by number of neighbors, atoms and frames at which an atom had as many.
    """

    def __init__(self, members: Members, atoms: int, groups: Groups, directed: bool):
        self._sides = [None if one is None else np.isin(np.arange(atoms), one) for one in groups]
        self._atoms = np.arange(atoms) if groups[0] is None else np.asarray(groups[0])
        self._directed, self._now = directed, np.zeros(atoms, np.int64)
        self.seen = np.zeros(1, np.int64)
        self._add(members.i, members.j, np.ones(len(members)))

    def step(self, flips: FlipTable) -> None:
        """After the flips of a frame."""
        self._add(flips.i, flips.j, np.where(flips.entered, 1.0, -1.0))

    def _add(self, i: np.ndarray, j: np.ndarray, sign: np.ndarray) -> None:
        first, second = self._sides
        for one, other in ((i, j),) if self._directed else ((i, j), (j, i)):
            # between two groups an atom of the first counts those of the second
            counts = sign if first is None or second is None else sign * (first[one] & second[other])
            self._now += np.bincount(one, counts, len(self._now)).astype(np.int64)

    def count(self) -> tuple[int, float, int]:
        """(fewest, mean, most) over the atoms at this frame, which is added to what was seen."""
        numbers = self._now[self._atoms]
        here = np.bincount(numbers)
        self.seen = np.pad(self.seen, (0, max(len(here) - len(self.seen), 0)))
        self.seen[: len(here)] += here
        return int(numbers.min()), float(numbers.mean()), int(numbers.max())


@dataclass
class Followed:
    """One rule on its way through the frames.

    Attributes:
        flux: (flips, moment) at frames whose velocities were used.
        reach: the usual distance of a pair at the threshold, length; nan where there was none.
    """

    rule: Rule
    tracker: Tracker  # of it
    neighbors: NeighborCounts | None = None  # known from the first frame on
    flux: list[tuple[int, float]] = field(default_factory=list)
    reach: float = float("nan")
    ranked: bool = False  # whether it is mostly the order of distances that decides there, and no radius


@dataclass
class Pass:
    """What came of reading a trajectory.

    Attributes:
        stopped: what was wrong with the frame after the last one, if the file did not come to its end.
        moved: root mean square displacement between frames over what the velocities say; nan without.
        leaps: (number of the frame, atom, how far) of what no atom does between two frames.
    """

    rules: list[Followed]
    frames: int = 0  # examined
    stopped: InputError | None = None
    moved: float = float("nan")
    leaps: list[tuple[int, int, float]] = field(default_factory=list)


def follow(
    trajectory: Trajectory, rules: Sequence[Rule], groups: Groups, resolution: Resolution, sink: Sink
) -> Iterator[Pass]:
    """Reads the frames once, handing flips, frames and the first members on as they come.

    Yields the same `Pass` after each frame, and can be left then. Memory is that of one frame and the
    trackers', however many frames there are. A frame that cannot be read or used ends it; what came before
    stays.

    Args:
        resolution: of the file.
        sink: takes rows of "members", "flips" and "frames".

    Raises:
        InputError: the first frame cannot be read or used: there is nothing to keep.
    """
    species = [str(one) for one in trajectory.species]
    found = Pass([Followed(rule, Tracker(rule, *groups, species)) for rule in rules])
    atoms, last, start = atoms_of(groups), None, None
    frames = checked(
        trajectory.frames(), atoms, str(trajectory.path), radius=smallest_radius(rules), bits=trajectory.bits
    )
    # frames whose velocities are used: spread over the file, or ever fewer if its end is not known
    count, measured = trajectory.count, {0, *(2**n for n in range(_FLUX_FRAMES - 1))}
    if count is not None:
        measured = set(np.linspace(0, count - 1, min(_FLUX_FRAMES, count)).astype(int).tolist())
    while True:
        try:
            frame = next(frames, None)
            if frame is None:
                break
            bound = resolution.bound(frame)
            # every rule first: a frame that one of them refuses is not in the ledger of another; a margin
            # among the nearest is the difference of two distances
            stepped = [one.tracker.step(frame, bound * (1 + one.rule.directed)) for one in found.rules]
        except InputError as error:
            if not found.frames:
                raise
            found.stopped = error
            if not hasattr(error, "frame"):
                # a rule that refuses a frame does not know its number
                message = f"frame {found.frames} of those examined: {error.message}"
                found.stopped = InputError(message, remedy=error.remedy, where=error.where)
            yield found
            return
        if start is None:
            start = frame
        elif found.frames == 1:
            found.moved = _moved(start, frame)
        if last is not None and (far := leap(last, frame, atoms)) is not None:
            found.leaps.append((frame.index, *far))
        last = frame
        for number, (one, new) in enumerate(zip(found.rules, stepped, strict=True)):
            _hand_on(sink, number, one, new, frame, found.frames, (trajectory.atoms, groups))
            if found.frames in measured:
                _measure_flux(one, frame, groups, species)
        found.frames += 1
        yield found
    if not found.frames:
        raise InputError(
            "no frame is left of what was asked for", remedy="Ask for others", where=str(trajectory.path)
        )


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
    """(where pairs come and go, whether their order decides there).

    The radius of a rule, the largest of several; of one that counts neighbors, how far the last of them is.
    """
    if isinstance(rule, CutoffRule):
        return rule.radius, False
    if isinstance(rule, SpeciesCutoffs):
        return max(rule.radii.values()), False
    if not len(members):
        return (rule.radius if isinstance(rule, Capped) else float("nan")), False
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


def _moved(start: Frame, end: Frame) -> float:
    """Root mean square displacement over what the velocities of the first frame say; nan without them.

    Near 1 where frames are so close that atoms fly straight, below it where they turn around in between.
    Above it the velocities do not belong to the positions, or are in another unit.
    """
    if start.velocities is None or not end.time > start.time:
        return float("nan")
    expected = float(np.sqrt(np.mean(start.velocities**2))) * (end.time - start.time)
    moved = float(np.sqrt(np.mean(displacements(start, end) ** 2)))
    return moved / expected if expected > 0 else float("nan")
