"""Flips that happened and reverted between two frames: not in the file, but it can tell their number.

Two estimates that know nothing of one another:

- **from the frames themselves**: every second frame alone would have lost a share of the flips; how that
  share grows with the stride is carried on to what lies between the frames that there are;
- **from velocities**, where the file has them: atoms that fly on straight for a moment cross their thresholds
  at a rate, the flux of pairs, which is what a run that looks at every instant would record.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mdnum.trajectories.frame import Frame
from mdnum.trajectories.history import History, Sums

# share of the flips below which those that a stride of 2 loses are too few to see a trend in
_FEW = 5e-3
# ratio of successive losses, from one doubling of the stride to the next, above which they do not die out
# when the stride is halved again and again: Brownian motion crosses a threshold infinitely often
_DIES_OUT = 0.9


@dataclass(frozen=True)
class Strides(Sums):
    """Flips that are left when only every nth frame is examined.

    Attributes:
        doubtful: of those that are left out, flips that the rounding of the file may have made.
    """

    _common = ("stride",)

    stride: Int[np.ndarray, "strides"]  # 1, 2, 4,
    flips: Int[np.ndarray, "strides"]  # of the frames 0, stride, 2 stride,
    of: Int[np.ndarray, "strides"]  # flips of all frames, as far as these reach
    doubtful: Int[np.ndarray, "strides"]

    @classmethod
    def of_history(cls, history: History, strides: Sequence[int]) -> Strides:
        """Counts them: of the flips of a pair between two frames that are kept, an odd one is left."""
        pair, counts = history.pair, []
        for stride in strides:
            reach = (history.frames - 1) // stride * stride
            seen = history.frame <= reach
            block = -(-history.frame[seen] // stride)
            new = np.flatnonzero(
                np.concatenate([[True], (np.diff(block) != 0) | (np.diff(pair[seen]) != 0)])[: len(block)]
            )
            sizes = np.diff(np.append(new, len(block)))
            unsure = np.add.reduceat(history.ambiguous[seen].astype(np.int64), new) if len(new) else sizes
            left_out = sizes // 2 * 2
            counts.append((len(block) - left_out.sum(), len(block), np.minimum(left_out, unsure).sum()))
        kept, total, doubtful = np.array(counts, np.int64).reshape(-1, 3).T
        return cls(np.array(strides, np.int64), kept, total, doubtful)

    @property
    def share(self) -> Float[np.ndarray, "strides"]:
        """Share of the flips that are left at each stride; nan where there were none."""
        return np.divide(self.flips, self.of, out=np.full(len(self.of), np.nan), where=self.of > 0)


@dataclass(frozen=True)
class MissingFlips:
    """An estimate of what is missing between the frames, as shares of all flips that happened.

    Attributes:
        reason: "none_lost", "few" (too few lost to see a trend), "trend"; or why there is no number:
            "rounding" (the file's digits may have made them), "brownian" (losses do not die out).
    """

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
        the estimate is within a factor of 3 of it (tests/trajectories/test_stride.py); neither is a bound.
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
    """(low, high) of the flips that are missing; None where their number does not come to an end.

    Args:
        lost: flips that each doubling of the stride leaves out, two or three numbers.
    """
    near, far = float(lost[0]), float(lost[1])
    if far <= 0 or near / far >= _DIES_OUT:
        return None
    q = near / far
    high = near * q / (1 - q)
    trend = q * float(lost[2]) / far if len(lost) > 2 and lost[2] > 0 else 1.0
    low = _series(near, q * trend, trend) if trend < 1 else min(near / 3, high)
    return None if low is None else (low, high)


def _series(first: float, q: float, trend: float) -> float | None:
    """first (q + q q' + q q' q'' + ...), with q' = trend q and so on; None where it does not converge."""
    total, term = 0.0, first
    for _ in range(200):
        term *= q
        total += term
        q *= trend
        if term < 1e-6 * total:
            return total
    return None


def _share(missing: float) -> float:
    """Of all flips, those missing, from those missing for each flip in the file."""
    return missing / (1 + missing)


def crossings(frame: Frame, count: Callable[[Frame, Frame], int], move: float) -> tuple[int, float] | None:
    """Decisions that come out differently when all atoms fly on straight for a moment.

    Args:
        frame: with velocities.
        count: flips between two frames, by the rule at hand.
        move: root mean square displacement in that moment, length: small beside the distance over which a
            path bends, large enough that many pairs cross.

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
