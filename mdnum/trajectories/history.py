"""What every pair did over the frames: its flips, every stay inside, and what happened between two frames.

Flips that happened and reverted between two frames are not in the file, but it can tell their number, by two
estimates that know nothing of one another:

- **from the frames themselves**: every second frame alone would have lost a share of the flips; how that
  share grows with the stride is carried on to what lies between the frames that there are;
- **from velocities**, where the file has them: atoms that fly on straight for a moment cross their thresholds
  at a rate, the flux of pairs, which is what a run that looks at every instant would record.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.bits import digit_order
from mdnum.trajectories.frame import Frame
from mdnum.trajectories.ledger import Columns, FlipTable, Members

# a pair's three numbers are packed into one where they fit: sorting one column is far faster
_ROOM = 2**62
# share of the flips below which those that a stride of 2 loses are too few to see a trend in
_FEW = 5e-3
# ratio of successive losses, from one doubling of the stride to the next, above which they do not die out
# when the stride is halved again and again: Brownian motion crosses a threshold infinitely often
_DIES_OUT = 0.9


class Sums:
    """Counts of some of the pairs, to which those of others are added field by field; None stays None."""

    # what is the same for all pairs
    _common: tuple[str, ...] = ()

    def __add__(self, other: Any) -> Any:
        both = {name: (mine, getattr(other, name)) for name, mine in vars(self).items()}
        return type(self)(
            **{name: a if a is None or name in self._common else a + b for name, (a, b) in both.items()}
        )


@dataclass(frozen=True)
class History:
    """Pairs that were ever inside or flipped, each with its flips in the order of frames."""

    i: Int[np.ndarray, "pairs"]  # the pairs, sorted, each once; see `ledger.Members`
    j: Int[np.ndarray, "pairs"]
    rank: Int[np.ndarray, "pairs"]
    inside: Bool[np.ndarray, "pairs"]  # at the first frame
    rows: Int[np.ndarray, "pairs_and_one"]  # flips of pair p are rows[p] to rows[p + 1] of what follows
    frame: Int[np.ndarray, "flips"]  # position among the frames examined, from 1
    entered: Bool[np.ndarray, "flips"]  # whether the pair is inside at that frame
    ambiguous: Bool[np.ndarray, "flips"]  # whether the file's resolution may have made the flip
    frames: int  # examined

    @classmethod
    def of(
        cls,
        flips: FlipTable | Mapping[str, np.ndarray],
        first: Members | Mapping[str, np.ndarray],
        frames: int,
    ) -> History:
        """The histories behind a ledger.

        Args:
            flips: all flips of some of the pairs, in the order of frames, or their columns frame, entered, i,
                j, rank and ambiguous.
            first: those of the pairs that are inside at the first frame, or their columns i, j and rank.
            frames: frames examined, at least 1.
        """
        flips, first = (one if isinstance(one, Mapping) else vars(one) for one in (flips, first))
        starts, count = len(first["i"]), len(flips["frame"])
        columns = [np.concatenate([first[name], flips[name]]).astype(np.int64) for name in ("i", "j", "rank")]
        # first what was inside, then the flips as they came: a stable sort keeps that order in each pair
        order, new = _grouped(columns)
        pairs = np.cumsum(new) - 1
        heads = order[np.flatnonzero(new)]
        flip = order >= starts
        inside = np.zeros(len(heads), bool)
        inside[pairs[~flip]] = True
        rows = np.zeros(len(heads) + 1, np.int64)
        rows[1:] = np.cumsum(np.bincount(pairs[flip], minlength=len(heads))) if count else 0
        source = order[flip] - starts
        i, j, rank = (column[heads] for column in columns)
        frame, entered, ambiguous = (
            np.asarray(flips[name])[source] for name in ("frame", "entered", "ambiguous")
        )
        return cls(i, j, rank, inside, rows, frame, entered, ambiguous, frames)

    def __len__(self) -> int:
        return len(self.i)

    @property
    def flips(self) -> Int[np.ndarray, "pairs"]:
        """Flips of each pair."""
        return np.diff(self.rows)

    @property
    def pair(self) -> Int[np.ndarray, "flips"]:
        """The pair of each flip."""
        return np.repeat(np.arange(len(self)), self.flips)


def _grouped(columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """A stable order that sorts by all columns, and in that order which rows differ from the one before."""
    if not len(columns[0]):
        return np.zeros(0, np.int64), np.zeros(0, bool)
    sizes = [int(column.max()) + 1 for column in columns]
    if sizes[0] * sizes[1] * sizes[2] < _ROOM and min(int(column.min()) for column in columns) >= 0:
        packed = (columns[0] * sizes[1] + columns[1]) * sizes[2] + columns[2]
        room = np.empty((4, len(packed)), np.int64)
        room[0] = packed
        order = digit_order(room, len(packed), sizes[0] * sizes[1] * sizes[2])
        changed = np.diff(packed[order]) != 0
    else:
        order = np.lexsort(columns[::-1])
        changed = np.any([np.diff(column[order]) != 0 for column in columns], axis=0)
    return order, np.concatenate([[True], changed])


@dataclass(frozen=True)
class Contacts(Columns):
    """Stays inside, sorted by (i, j, rank, begin).

    The frames say no more than that a pair was inside at `begin`, ..., `end - 1`: it entered some time
    between the frames `begin - 1` and `begin`, and it may have been outside for a while between two frames.
    """

    i: Int[np.ndarray, "stays"]  # the pair; see `ledger.Members`
    j: Int[np.ndarray, "stays"]
    rank: Int[np.ndarray, "stays"]
    begin: Int[np.ndarray, "stays"]  # first frame inside, a position among the frames examined
    end: Int[np.ndarray, "stays"]  # first frame outside again; the number of frames where that was not seen
    began: Bool[np.ndarray, "stays"]  # whether it was seen to enter, else it is older (censored on the left)
    ended: Bool[np.ndarray, "stays"]  # whether it was seen to leave, else it goes on (censored on the right)

    @property
    def length(self) -> Int[np.ndarray, "stays"]:
        """Frames inside."""
        return self.end - self.begin


def contacts(history: History) -> Contacts:
    """The stays inside of every pair.

    Raises:
        ValueError: flips of a pair do not enter and leave in turn: one is missing.
    """
    room = int(np.count_nonzero(history.inside)) + int(np.count_nonzero(history.entered))
    of, begin, end = np.empty((3, room), np.int64)
    if not _stays(
        history.inside, history.rows, history.frame, history.entered, history.frames, of, begin, end
    ):
        raise ValueError("flips are missing: a pair enters while inside, or leaves while outside")
    # flips are of frames after the first
    ids, began = (history.i[of], history.j[of], history.rank[of]), begin > 0
    return Contacts(*ids, begin, end, began, end < history.frames)


@numba.njit(cache=True, nogil=True)
def _stays(inside, rows, frame, entered, frames, of, begin, end):
    """Write the pair, begin and end of each stay; whether every pair enters and leaves in turn."""
    count = 0
    for pair in range(inside.shape[0]):
        here, since = inside[pair], 0
        for at in range(rows[pair], rows[pair + 1]):
            if entered[at] == here:
                return False
            if here:
                of[count], begin[count], end[count] = pair, since, frame[at]
                count += 1
            here, since = not here, frame[at]
        if here:
            of[count], begin[count], end[count] = pair, since, frames
            count += 1
    return True


def mended(stays: Contacts, gap: int) -> Contacts:
    """Intermittent contacts: stays of a pair that are at most `gap` frames apart count as one."""
    if gap < 1 or not len(stays):
        return stays
    same = np.all([column[1:] == column[:-1] for column in (stays.i, stays.j, stays.rank)], axis=0)
    joined = same & (stays.begin[1:] - stays.end[:-1] <= gap)
    heads = np.flatnonzero(np.concatenate([[True], ~joined]))
    tails = np.flatnonzero(np.concatenate([~joined, [True]]))
    return replace(stays[heads], end=stays.end[tails], ended=stays.ended[tails])


# ---- between the frames


@dataclass(frozen=True)
class Strides(Sums):
    """Flips that are left when only every nth frame is examined."""

    _common = ("stride",)

    stride: Int[np.ndarray, "strides"]  # 1, 2, 4,
    flips: Int[np.ndarray, "strides"]  # of the frames 0, stride, 2 stride,
    of: Int[np.ndarray, "strides"]  # flips of all frames, as far as these reach
    # of those that are left out, flips that the rounding of the file may have made
    doubtful: Int[np.ndarray, "strides"]

    @classmethod
    def of_history(cls, history: History, strides: Sequence[int]) -> Strides:
        """Counts them: of the flips of a pair between two frames that are kept, an odd one is left."""
        counts = [
            _thinned(history.rows, history.frame, history.ambiguous, history.frames, n) for n in strides
        ]
        kept, total, doubtful = np.array(counts, np.int64).reshape(-1, 3).T
        return cls(np.array(strides, np.int64), kept, total, doubtful)

    @property
    def share(self) -> Float[np.ndarray, "strides"]:
        """Share of the flips that are left at each stride; nan where there were none."""
        return np.divide(self.flips, self.of, out=np.full(len(self.of), np.nan), where=self.of > 0)


@numba.njit(cache=True, nogil=True)
def _thinned(rows, frame, ambiguous, frames, stride):
    """(flips left at a stride, all flips as far as it reaches, doubtful ones among those left out)."""
    reach = (frames - 1) // stride * stride
    total, out, doubtful = 0, 0, 0
    for pair in range(rows.shape[0] - 1):
        at = rows[pair]
        while at < rows[pair + 1] and frame[at] <= reach:
            # up to the next frame that is kept
            end, first, unsure = -(-frame[at] // stride) * stride, at, 0
            while at < rows[pair + 1] and frame[at] <= end:
                unsure += ambiguous[at]
                at += 1
            left_out = (at - first) // 2 * 2
            total += at - first
            out += left_out
            doubtful += min(left_out, unsure)
    return total - out, total, doubtful


@dataclass(frozen=True)
class MissingFlips:
    """An estimate of what is missing between the frames, as shares of all flips that happened."""

    # "none_lost", "few" (too few lost to see a trend), "trend"; or why there is no number: "rounding" (the
    # file's digits may have made them), "brownian" (losses do not die out)
    reason: str
    doubled: float  # share that every second frame alone would lose, and every fourth
    fourth: float
    rounded: float  # share of the first that the rounding of the file may have made
    lost: float | None = None  # the estimate; None where the numbers do not tell
    low: float | None = None  # the range of it, never of no width; None where `lost` is
    high: float | None = None


def doublings(frames: int) -> list[int]:
    """Strides 1, 2, 4, ... that leave at least four intervals."""
    strides = [1]
    while (frames - 1) // (2 * strides[-1]) >= 4:
        strides.append(2 * strides[-1])
    return strides


def between_frames(found: Strides) -> MissingFlips | None:
    """What lies between the frames, from how the flips thin out when frames are left out.

    Going from stride 2 to 1 brought some flips back, going from 4 to 2 some others. Where the first are fewer
    by a factor q, halving the stride for ever brings back a geometric series of them. In a liquid q itself
    falls with the stride, from about 1 where motion looks Brownian to 1/4 where atoms fly straight, so that q
    held fixed says too much (high), and q that falls on as from one doubling to the next too little (low).
    Where there are too few strides to see q fall, low is that of straight flight from here on.

    Flips that the rounding of the file may have made revert just so, and say nothing of what lies between its
    frames: the range is that with and without them, and there is no number where they are half of what a
    stride of 2 leaves out. What chance does to counts is in the range, by two standard deviations.

    Returns:
        None with fewer than three strides, or no flips.

    Error: in a Lennard-Jones liquid, and in sums of a few oscillations, the truth is between the two, and
        the estimate is within a factor of 3 of it (tests/trajectories); neither is a bound.
    """
    if len(found.stride) < 3 or tuple(found.stride[:3]) != (1, 2, 4) or not found.of.all():
        return None
    shares, of = found.share[:4], int(found.of[1])
    near, second = float(shares[0] - shares[1]), float(shares[0] - shares[2])
    seen = (near, second, float(found.doubtful[1] / of))
    if near <= 0:
        # 3 events or fewer are not seen in one case of 20; each is two flips
        return MissingFlips("none_lost", *seen, 0.0, 0.0, _share(2 * 6.0 / of))
    if 2 * found.doubtful[1] > found.of[1] - found.flips[1]:
        return MissingFlips("rounding", *seen)
    lost = np.diff(-found.flips[:4] * (of / found.of[:4]))
    sure = np.maximum(lost - np.diff(found.doubtful[:4] * (of / found.of[:4])), 0.0)
    if near < _FEW:
        # straight flight, and too few to see a trend in: in proportion to the stride, or to its square
        low, high = float(sure[0]) / of / 3, 2 * (near + 2 * math.sqrt(2 * near / of))
        return MissingFlips("few", *seen, _share(near), _share(low), _share(high))
    ranges = [carried for carried in map(_carried_on, (lost, sure)) if carried is not None]
    if len(ranges) < 2:
        return MissingFlips("brownian", *seen)
    low, high = min(low for low, _ in ranges) / of, max(high for _, high in ranges) / of
    # what chance does to the counts: a flip that is left out comes with the one that reverses it
    chance = 2 * np.sqrt(2 * np.maximum(lost[:2], 2.0) / lost[:2] ** 2)
    least, most = low * max(1 - chance[0], 0.0), high * (1 + chance.sum())
    return MissingFlips("trend", *seen, _share(math.sqrt(low * high)), _share(least), _share(most))


def _carried_on(lost: Float[np.ndarray, "doublings"]) -> tuple[float, float] | None:
    """(low, high) of the flips that are missing, from those that each doubling of the stride leaves out.

    None where their number does not come to an end.
    """
    near, far = float(lost[0]), float(lost[1])
    if far <= 0 or near / far >= _DIES_OUT:
        return None
    q = near / far
    high = near * q / (1 - q)
    trend = q * float(lost[2]) / far if len(lost) > 2 and lost[2] > 0 else 1.0
    if trend >= 1:
        return min(near / 3, high), high
    # near (q + q q' + q q' q'' + ...), with q' = trend q and so on
    low, term, q = 0.0, near, q * trend
    for _ in range(200):
        term *= q
        low += term
        q *= trend
        if term < 1e-6 * low:
            return low, high
    return None


def _share(missing: float) -> float:
    """Of all flips, those missing, from those missing for each flip in the file."""
    return missing / (1 + missing)


def crossings(frame: Frame, count: Callable[[Frame, Frame], int], move: float) -> tuple[int, float] | None:
    """Decisions that come out differently when all atoms fly on straight for a moment.

    The root mean square displacement in that moment is `move`, length: small beside the distance over which a
    path bends, large enough that many pairs cross. `count` gives the flips between two frames.

    Returns:
        flips, and the moment in the unit of the velocities' time; None where no atom moves.
    """
    if frame.velocities is None:
        return None
    speed = float(np.sqrt(np.mean(np.sum(frame.velocities**2, axis=1))))
    if not (math.isfinite(speed) and speed > 0):
        return None
    moment = move / speed
    later = Frame(frame.index, frame.time + moment, frame.positions + moment * frame.velocities, frame.box)
    return count(frame, later), moment
