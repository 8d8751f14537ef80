"""A trajectory on its way into a folder: every frame looked at once, every flip written as it is seen."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.trajectories.compare import displacements
from mdnum.trajectories.frame import Box, Frame, checked, leap, smallest_radius
from mdnum.trajectories.rules import Capped, Cutoff, SpeciesCutoffs
from mdnum.trajectories.stride import crossings
from mdnum.trajectories.tracker import Tracker
from mdnum.workflow.interrupt import asked_to_stop

if TYPE_CHECKING:
    from mdnum.trajectories.ledger import Flips, Members
    from mdnum.trajectories.rules import Rule
    from mdnum.trajectories.trajectory import Trajectory

Progress = Callable[[int, int, dict[str, Any]], None]
Groups = tuple[Int[np.ndarray, "first"] | None, Int[np.ndarray, "second"] | None]

# frames at which the flux through the threshold is measured from velocities
_FLUX_FRAMES = 12
# rows that wait to be handed over together
_ROWS_HELD = 20_000
# displacement for that, as a share of the usual distance of neighbors: small beside the way to a turn
_FLUX_MOVE = 2e-3


@dataclass
class Neighbors:
    """How many neighbors each atom of the first group has, kept up to date by the flips.

    Attributes:
        now: by atom of the file.
        seen: by number of neighbors, atoms and frames at which an atom had as many.
    """

    atoms: Int[np.ndarray, "looked_at"]
    second: np.ndarray | None
    first: np.ndarray | None
    directed: bool
    now: Int[np.ndarray, "atoms"]
    seen: Int[np.ndarray, "numbers"] = field(default_factory=lambda: np.zeros(1, np.int64))

    @classmethod
    def of(cls, members: Members, atoms: int, groups: Groups, directed: bool) -> Neighbors:
        """At the first frame."""
        first, second = (None if one is None else np.isin(np.arange(atoms), one) for one in groups)
        looked_at = np.arange(atoms) if groups[0] is None else np.asarray(groups[0])
        found = cls(looked_at, second, first, directed, np.zeros(atoms, np.int64))
        found._add(members.i, members.j, np.ones(len(members)))
        return found

    def step(self, flips: Flips) -> None:
        """After the flips of a frame."""
        self._add(flips.i, flips.j, np.where(flips.entered, 1.0, -1.0))

    def _add(self, i: np.ndarray, j: np.ndarray, sign: np.ndarray) -> None:
        for one, other in ((i, j),) if self.directed else ((i, j), (j, i)):
            # between two groups an atom of the first counts those of the second
            counts = (
                sign
                if self.second is None or self.first is None
                else sign * (self.first[one] & self.second[other])
            )
            self.now += np.bincount(one, counts, len(self.now)).astype(np.int64)

    def count(self) -> tuple[int, float, int]:
        """(fewest, mean, most) over the atoms at this frame, which is added to what was seen."""
        numbers = self.now[self.atoms]
        here = np.bincount(numbers)
        if len(here) > len(self.seen):
            self.seen = np.concatenate([self.seen, np.zeros(len(here) - len(self.seen), np.int64)])
        self.seen[: len(here)] += here
        return int(numbers.min()), float(numbers.mean()), int(numbers.max())


class Rows:
    """Rows of a folder's tables, appended some hundred frames at a time: a call costs more than a row."""

    def __init__(self, folder: RunFolder):
        self._folder = folder
        self._held: dict[str, list[dict[str, np.ndarray]]] = {}
        self._count = 0

    def add(self, table: str, columns: dict[str, np.ndarray]) -> None:
        """Adds rows, equally long columns."""
        self._held.setdefault(table, []).append(columns)
        self._count += len(next(iter(columns.values())))

    def checkpoint(self, frames: int, force: bool = False) -> None:
        """Hands over what is held where it is much, or where the folder is due to be made whole."""
        due = force or self._folder.checkpoint_due()
        if due or self._count > _ROWS_HELD:
            for table, parts in self._held.items():
                joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
                self._folder.append(table, joined)
            self._held, self._count = {}, 0
        if due:
            self._folder.checkpoint({"frames": frames}, force=True)


@dataclass
class Followed:
    """One rule on its way through the frames.

    Attributes:
        rule: the membership rule.
        tracker: of it.
        neighbors: known from the first frame on.
        flux: (flips, moment) at frames whose velocities were looked at.
        reach: the usual distance of a pair at the threshold, length; nan where there was none.
        ranked: whether it is mostly the order of distances that decides there, and no radius.
    """

    rule: Rule
    tracker: Tracker
    neighbors: Neighbors | None = None
    flux: list[tuple[int, float]] = field(default_factory=list)
    reach: float = float("nan")
    ranked: bool = False


@dataclass
class Pass:
    """What came of reading a trajectory.

    Attributes:
        frames: looked at.
        times: of the first and the last one.
        stopped: what was wrong with the frame after the last one, if the file did not come to its end.
        interrupted: somebody pressed control-C, and the frames after the last one were not looked at.
        moved: root mean square displacement between frames over what the velocities say; nan without.
        leaps: (number of the frame, atom, how far) of what no atom does between two frames.
        seconds: taken.
    """

    rules: list[Followed]
    frames: int = 0
    times: tuple[float, float] = (float("nan"), float("nan"))
    stopped: InputError | None = None
    interrupted: bool = False
    moved: float = float("nan")
    leaps: list[tuple[int, int, float]] = field(default_factory=list)
    seconds: float = 0.0


def follow(
    folder: RunFolder,
    trajectory: Trajectory,
    rules: Sequence[Rule],
    groups: Groups,
    bound_of: Callable[[Frame], float],
    progress: Progress,
) -> Pass:
    """Reads the frames once, writing flips, frames and the first members as they come.

    Memory is that of one frame and the trackers', however many frames there are. A frame that cannot be read
    or used ends it, and so does control-C; what came before stays.

    Args:
        groups: indices of the atoms on either side; None for all.
        bound_of: how far a margin can be off at a frame.

    Raises:
        InputError: the first frame cannot be read or used: there is nothing to keep.
    """
    species = [str(one) for one in trajectory.species]
    made = [Followed(rule, Tracker(rule, *groups, species, 0.0)) for rule in rules]
    found, began, start = Pass(made), time.perf_counter(), Frame(0, 0.0, np.zeros((0, 3)), Box())
    atoms = (
        None if groups[0] is None else np.unique(np.concatenate([one for one in groups if one is not None]))
    )
    flips, rows = 0, Rows(folder)
    at = _sampled(trajectory.count)
    looked = checked(
        trajectory.frames(), atoms, str(trajectory.path), radius=smallest_radius(rules), bits=trajectory.bits
    )
    frames, last = iter(looked), None
    with asked_to_stop() as stop:
        while True:
            if stop() and found.frames:
                found.interrupted = True
                break
            try:
                frame = next(frames, None)
                if frame is None:
                    break
                bound = bound_of(frame)
                # every rule first: a frame that one of them refuses is not in the ledger of another; a margin
                # among the nearest is the difference of two distances
                stepped = [one.tracker.step(frame, bound=bound * (1 + one.rule.directed)) for one in made]
            except InputError as error:
                if not found.frames:
                    raise
                found.stopped = _at_frame(error, found.frames)
                break
            if found.frames == 0:
                start = frame
            elif found.frames == 1:
                found.moved = _moved(start, frame)
            if last is not None and (far := leap(last, frame, atoms)) is not None:
                found.leaps.append((frame.index, *far))
            last = frame
            for number, (one, new) in enumerate(zip(made, stepped, strict=True)):
                _write(rows, number, one, new, frame, found.frames, (trajectory.atoms, groups))
                flips += len(new)
                if found.frames in at:
                    _measure_flux(one, frame, groups, species)
            found.times = (frame.time if not found.frames else found.times[0], frame.time)
            found.frames += 1
            rows.checkpoint(found.frames)
            told = {"phase": "run", "unit": "frames", "flips": flips}
            progress(found.frames, trajectory.count or 0, told)
    found.seconds = time.perf_counter() - began
    if not found.frames:
        raise InputError(
            "no frame is left of what was asked for", remedy="Ask for others", where=str(trajectory.path)
        )
    rows.checkpoint(found.frames, force=True)
    return found


def _sampled(count: int | None) -> set[int]:
    """Frames whose velocities are looked at: spread over the file, or ever fewer if its end is not known."""
    if count is None:
        return {0, *(2**n for n in range(_FLUX_FRAMES - 1))}
    return set(np.linspace(0, count - 1, min(_FLUX_FRAMES, count)).astype(int).tolist())


def _write(
    rows: Rows,
    number: int,
    one: Followed,
    flips: Flips,
    frame: Frame,
    at: int,
    size: tuple[int, Groups],
) -> None:
    """Rows of one frame and rule."""
    if one.neighbors is None:
        members = one.tracker.members()
        one.neighbors = Neighbors.of(members, *size, one.rule.directed)
        one.reach, one.ranked = _threshold(one.rule, members)
        columns = {"i": members.i, "j": members.j, "rank": members.rank, "distance": members.distance}
        rows.add("members", {"rule": np.full(len(members), number), **columns})
    else:
        one.neighbors.step(flips)
    if len(flips):
        columns = {name: getattr(flips, name) for name in flips.__dataclass_fields__}
        rows.add("flips", {"rule": np.full(len(flips), number), **columns})
    fewest, mean, most = one.neighbors.count()
    entered = int(np.count_nonzero(flips.entered))
    row = {
        "rule": number, "frame": at, "number": frame.index, "time": frame.time, "pairs": one.tracker.pairs,
        "near": one.tracker.near, "entered": entered, "left": len(flips) - entered,
        "ambiguous": int(np.count_nonzero(flips.ambiguous)), "min_margin": one.tracker.min_margin,
        "fewest": fewest, "neighbors": mean, "most": most,
    }  # fmt: skip
    rows.add("frames", {name: np.array([value]) for name, value in row.items()})


def _threshold(rule: Rule, members: Members) -> tuple[float, bool]:
    """(where pairs come and go, whether their order decides there).

    The radius of a rule, the largest of several; of one that counts neighbors, how far the last of them is.
    """
    if isinstance(rule, Cutoff):
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
    if frame.velocities is None:
        return
    distance = one.tracker.members().distance
    if not len(distance):
        return

    def count(here: Frame, later: Frame) -> int:
        tracker = Tracker(one.rule, *groups, species, 0.0)
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
    return (
        float(np.sqrt(np.mean(displacements(start, end) ** 2))) / expected if expected > 0 else float("nan")
    )


def _at_frame(error: InputError, frames: int) -> InputError:
    """The error, naming the frame: a rule that refuses one does not know its number."""
    if hasattr(error, "frame"):
        return error
    return InputError(
        f"frame {frames} of those looked at: {error.message}", remedy=error.remedy, where=error.where
    )


def neighbor_rows(found: Pass) -> Iterator[dict[str, Any]]:
    """Rows of the table of neighbor counts, by rule."""
    for number, one in enumerate(found.rules):
        seen = one.neighbors.seen if one.neighbors is not None else np.zeros(0, np.int64)
        there = np.flatnonzero(seen)
        yield {"rule": np.full(len(there), number), "neighbors": there, "counted": seen[there]}
