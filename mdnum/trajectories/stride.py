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
from mdnum.trajectories.history import History

# share of the flips below which those that a stride of 2 loses are too few to see a trend in
_FEW = 5e-3
# ratio of successive losses, from one doubling of the stride to the next, above which they do not die out
# when the stride is halved again and again: Brownian motion crosses a threshold infinitely often
_DIES_OUT = 0.9


@dataclass(frozen=True)
class Strides:
    """Flips that are left when only every so manieth frame is looked at; sums over parts of the pairs add up.

    Attributes:
        stride: 1, 2, 4, ...
        flips: of the frames 0, stride, 2 stride, ...
        of: flips of all frames, as far as these reach.
    """

    stride: Int[np.ndarray, "strides"]
    flips: Int[np.ndarray, "strides"]
    of: Int[np.ndarray, "strides"]

    @classmethod
    def of_history(cls, history: History, strides: Sequence[int]) -> Strides:
        """Counts them: of the flips of a pair between two frames that are kept, an odd one is left."""
        pair, kept, total = history.pair, [], []
        for stride in strides:
            reach = (history.frames - 1) // stride * stride
            seen = history.frame <= reach
            block = -(-history.frame[seen] // stride)
            new = np.flatnonzero(
                np.concatenate([[True], (np.diff(block) != 0) | (np.diff(pair[seen]) != 0)])[: len(block)]
            )
            sizes = np.diff(np.append(new, len(block)))
            kept.append(int(np.count_nonzero(sizes % 2)))
            total.append(len(block))
        return cls(np.array(strides, np.int64), np.array(kept, np.int64), np.array(total, np.int64))

    def __add__(self, other: Strides) -> Strides:
        return Strides(self.stride, self.flips + other.flips, self.of + other.of)

    @property
    def share(self) -> Float[np.ndarray, "strides"]:
        """Share of the flips that are left at each stride; nan where there were none."""
        return np.divide(self.flips, self.of, out=np.full(len(self.of), np.nan), where=self.of > 0)


@dataclass(frozen=True)
class Between:
    """An estimate of what is missing between the frames, as shares of all flips that happened.

    Attributes:
        lost: the estimate; None where the numbers do not tell.
        low, high: what two ways of carrying the losses on give; None where `lost` is.
        doubled: share that every second frame alone would lose.
        says: where it comes from, in words.
    """

    lost: float | None
    low: float | None
    high: float | None
    doubled: float
    says: str


def doublings(frames: int) -> list[int]:
    """Strides 1, 2, 4, ... that leave at least four intervals."""
    strides = [1]
    while (frames - 1) // (2 * strides[-1]) >= 4:
        strides.append(2 * strides[-1])
    return strides


def between_frames(found: Strides) -> Between | None:
    """What lies between the frames, from how the flips thin out when frames are left out.

    Going from stride 2 to 1 brought some flips back, going from 4 to 2 some others. Where the first are fewer
    by a factor q, halving the stride for ever brings back a geometric series of them. In a liquid q itself
    falls with the stride, from about 1 where motion looks Brownian to 1/4 where atoms fly straight, so that q
    held fixed says too much (high), and q that falls on as from one doubling to the next too little (low).

    Returns:
        None with fewer than three strides, or no flips.

    Error: in a Lennard-Jones liquid, and in sums of a few oscillations, the truth is between the two, and
        the estimate is within a factor of 3 of it (tests/trajectories/test_stride.py); neither is a bound.
    """
    if len(found.stride) < 3 or tuple(found.stride[:3]) != (1, 2, 4) or not found.of.all():
        return None
    shares = found.share[:4]
    losses = -np.diff(shares)
    near, far = float(losses[0]), float(losses[1])
    if near <= 0:
        return Between(0.0, 0.0, 0.0, 0.0, "looking at every second frame alone loses no flip")
    said = (
        f"looking at every second frame alone loses {_percent(1 - shares[1])} of the flips, at every fourth "
        f"{_percent(1 - shares[2])}"
    )
    if near < _FEW:
        # straight flight, and too few to see a trend in: in proportion to the stride, or to its square
        return Between(_share(near), _share(near / 3), _share(2 * near), near, said)
    q = near / far if far > 0 else math.inf
    trend = min(q / (far / float(losses[2])), 1.0) if len(losses) > 2 and losses[2] > 0 and far > 0 else 1.0
    low = _series(near, q * trend, trend)
    if q >= _DIES_OUT or low is None:
        return Between(None, None, None, near, f"{said}: that does not die out as the stride is halved")
    high = near * q / (1 - q)
    said = f"{said}, carried on to ever shorter strides"
    return Between(_share(math.sqrt(low * high)), _share(low), _share(high), near, said)


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


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


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
