"""How long contacts last, where the beginning or the end of many was not seen.

Three different answers, each honest about what it is:

- the **lifetime** of a contact that was seen to begin: the product-limit estimate (Kaplan and Meier, J. Am.
  Stat. Assoc. 53, 457, 1958), which uses stays that go on after the last frame for as long as they were seen;
- the **mean by rate**: time spent inside over the number of leaves, which uses every frame of every stay,
  whether its ends were seen or not, and is the mean lifetime where pairs leave at a constant rate;
- the **residence**: of pairs found inside at some frame, the share still inside (without a break) so much
  later (Impey, Madden and McDonald, J. Phys. Chem. 87, 5071, 1983). Long stays are met more often: it is not
  the lifetime.

All in frames; times come from the frames' own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mdnum.trajectories.contacts import Contacts


@dataclass(frozen=True)
class Durations:
    """Stays counted by the number of frames they were inside for; memory does not grow with stays.

    Attributes:
        seen: by length, stays seen to begin and to end; entry n is for n frames.
        goes_on: those seen to begin, but not to end (censored on the right).
        older: those seen to end, but not to begin (censored on the left).
        throughout: those inside from the first frame to the last.
    """

    seen: Int[np.ndarray, "lengths"]
    goes_on: Int[np.ndarray, "lengths"]
    older: Int[np.ndarray, "lengths"]
    throughout: Int[np.ndarray, "lengths"]

    @classmethod
    def of(cls, stays: Contacts, frames: int) -> Durations:
        """Those of contacts over so many frames."""

        def counted(chosen: np.ndarray) -> np.ndarray:
            return np.bincount(stays.length[chosen], minlength=frames + 1)

        began, ended = stays.began, stays.ended
        return cls(
            counted(began & ended), counted(began & ~ended), counted(~began & ended), counted(~began & ~ended)
        )

    def __add__(self, other: Durations) -> Durations:
        return Durations(
            self.seen + other.seen,
            self.goes_on + other.goes_on,
            self.older + other.older,
            self.throughout + other.throughout,
        )

    @property
    def all(self) -> Int[np.ndarray, "lengths"]:
        """Stays of any kind by length."""
        return self.seen + self.goes_on + self.older + self.throughout

    @property
    def exposure(self) -> int:
        """Times that a pair inside at one frame was looked at again at the next one."""
        length = np.arange(len(self.seen))
        # a stay of n frames that goes on after the last one has been looked at again n - 1 times
        whole, cut = self.seen + self.older, self.goes_on + self.throughout
        return int(whole @ length + cut @ np.maximum(length - 1, 0))

    @property
    def leaves(self) -> int:
        """Stays seen to end."""
        return int(self.seen.sum() + self.older.sum())


@dataclass(frozen=True)
class Survival:
    """Share of contacts that last longer than so many frames, from those seen to begin.

    Attributes:
        frames: lengths at which some ended, from 1, rising.
        share: still inside after that many frames.
        error: its standard error (Greenwood).
        at_risk: contacts followed for at least that long.
        longest: frames for which any was followed: nothing is known beyond.
    """

    frames: Int[np.ndarray, "points"]
    share: Float[np.ndarray, "points"]
    error: Float[np.ndarray, "points"]
    at_risk: Int[np.ndarray, "points"]
    longest: int

    def at(self, share: float) -> int | None:
        """Frames after which at most this share is left: the median at 0.5; None if it stays above."""
        below = np.flatnonzero(self.share <= share)
        return int(self.frames[below[0]]) if len(below) else None

    @property
    def mean(self) -> float:
        """Area below the curve up to `longest`, frames: the mean, or less where some outlast that."""
        edges = np.concatenate([[0], self.frames, [self.longest]])
        heights = np.concatenate([[1.0], self.share])
        return float(np.sum(np.diff(edges) * heights))


def survival(found: Durations) -> Survival:
    """The product-limit estimate from the stays that were seen to begin.

    Stays that were there at the first frame are left out: how old they were then is not known, and long ones
    are met more often.
    """
    ends = found.seen
    # one that goes on after n frames was seen to survive n - 1 times
    followed = np.zeros_like(ends)
    followed[:-1] = found.goes_on[1:]
    at_risk = np.cumsum((ends + followed)[::-1])[::-1]
    points = np.flatnonzero(ends)
    risk, gone = at_risk[points].astype(np.float64), ends[points].astype(np.float64)
    share = np.cumprod(1.0 - gone / risk)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(risk > gone, gone / (risk * (risk - gone)), 0.0)
    error = share * np.sqrt(np.cumsum(terms))
    lasted = np.flatnonzero(ends + followed)
    longest = int(lasted[-1]) if len(lasted) else 0
    return Survival(points, share, error, at_risk[points], longest)


def mean_by_rate(found: Durations) -> tuple[float, float]:
    """(frames inside per leave, standard error), every stay counted; inf where none was seen to leave.

    The error is that of independent leaves (Poisson): chatter makes it larger.
    """
    if not found.leaves:
        return float("inf"), float("nan")
    mean = found.exposure / found.leaves
    return mean, mean / float(np.sqrt(found.leaves))


def residence(found: Durations, pairs: Int[np.ndarray, "frames"]) -> Float[np.ndarray, "frames"]:
    """Of the pairs inside at a frame, the share inside without a break until so many frames later.

    Args:
        pairs: inside at each frame.

    Returns:
        by lag from 0, averaged over all frames that leave room for it; nan where no pair was inside.
    """
    count = found.all
    lags = np.arange(len(pairs))
    stays = np.cumsum(count[::-1])[::-1]
    frames = np.cumsum((count * np.arange(len(count)))[::-1])[::-1]
    # a stay of n frames holds n - t pairs of frames that are t apart
    kept = np.array([frames[t + 1] - t * stays[t + 1] if t + 1 < len(count) else 0 for t in lags], float)
    asked = np.cumsum(pairs).astype(float)[::-1]
    return np.divide(kept, asked, out=np.full(len(pairs), np.nan), where=asked > 0)


def again(stays: Contacts, lags: Int[np.ndarray, "lags"], frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Of the pairs inside at a frame, those inside so many frames later, whatever happened between.

    The intermittent counterpart of `residence`; divide the first by the second (sums over parts of the pairs
    add up).

    Args:
        lags: frames, each from 0 to frames - 1.

    Returns:
        by lag, pairs of frames at which a pair was inside both times, and at which it was the first time.
    """
    both, once = np.zeros(len(lags), np.int64), np.zeros(len(lags), np.int64)
    if not len(stays):
        return both, once
    changed = [np.diff(column) != 0 for column in (stays.i, stays.j, stays.rank)]
    pair = np.concatenate([[0], np.cumsum(np.any(changed, axis=0))])
    # one line of time for all pairs, each with room after it for the largest lag
    room = 2 * (frames + 1)
    begin, end = pair * room + stays.begin, pair * room + stays.end
    before = np.concatenate([[0], np.cumsum(stays.length)])

    def inside_until(time: np.ndarray) -> np.ndarray:
        """Frames inside before a time, over all pairs."""
        at = np.searchsorted(begin, time, side="right")
        last = np.maximum(at - 1, 0)
        over = np.maximum(0, np.minimum(time, end[last]) - begin[last])
        return before[last] + np.where(at > 0, over, 0)

    for place, lag in enumerate(lags.tolist()):
        both[place] = int((inside_until(end + lag) - inside_until(begin + lag)).sum())
        once[place] = int(np.maximum(0, np.minimum(stays.end, frames - lag) - stays.begin).sum())
    return both, once
