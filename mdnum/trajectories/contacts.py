"""Every stay of a pair inside its threshold: when it began and ended, and which of the two was not seen."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Int

from mdnum.trajectories.history import History


@dataclass(frozen=True)
class Contacts:
    """Stays inside, sorted by (i, j, rank, begin).

    The frames say no more than that a pair was inside at `begin`, ..., `end - 1`: it entered some time
    between the frames `begin - 1` and `begin`, and it may have been outside for a while between two frames.

    Attributes:
        i, j, rank: the pair; see `mdnum.trajectories.ledger.Members`.
        begin: first frame inside, a position among the frames looked at.
        end: first frame outside again; the number of frames where that was not seen.
        began: whether the pair was seen to enter. If not the stay is censored on the left: it is older than
            it looks.
        ended: whether it was seen to leave. If not the stay is censored on the right: it goes on.
    """

    i: Int[np.ndarray, "stays"]
    j: Int[np.ndarray, "stays"]
    rank: Int[np.ndarray, "stays"]
    begin: Int[np.ndarray, "stays"]
    end: Int[np.ndarray, "stays"]
    began: Bool[np.ndarray, "stays"]
    ended: Bool[np.ndarray, "stays"]

    def __len__(self) -> int:
        return len(self.i)

    @property
    def length(self) -> Int[np.ndarray, "stays"]:
        """Frames inside."""
        return self.end - self.begin


def contacts(history: History) -> Contacts:
    """The stays inside of every pair.

    Raises:
        ValueError: flips of a pair do not enter and leave in turn (see `History.broken`).
    """
    if len(history.broken()):
        raise ValueError("flips are missing: a pair enters while inside, or leaves while outside")
    pair = history.pair
    there, stayed = np.flatnonzero(history.inside), np.flatnonzero(history.last)
    enters, leaves = history.entered, ~history.entered
    # a pair inside at the first frame has one begin more, before its others; one inside at the last, one end
    begin_pair = np.concatenate([there, pair[enters]])
    begin = np.concatenate([np.zeros(len(there), np.int64), history.frame[enters]])
    end_pair = np.concatenate([pair[leaves], stayed])
    end = np.concatenate([history.frame[leaves], np.full(len(stayed), history.frames)])
    first, second = (np.argsort(one, kind="stable") for one in (begin_pair, end_pair))
    of = begin_pair[first]
    return Contacts(
        history.i[of],
        history.j[of],
        history.rank[of],
        begin[first],
        end[second],
        first >= len(there),
        second < len(pair) - int(np.count_nonzero(enters)),
    )


def mended(stays: Contacts, gap: int) -> Contacts:
    """Intermittent contacts: stays of a pair that are at most so many frames apart count as one.

    Args:
        gap: frames outside that are overlooked; 0 changes nothing.
    """
    if gap < 1 or not len(stays):
        return stays
    same = np.all([column[1:] == column[:-1] for column in (stays.i, stays.j, stays.rank)], axis=0)
    joined = same & (stays.begin[1:] - stays.end[:-1] <= gap)
    heads = np.flatnonzero(np.concatenate([[True], ~joined]))
    tails = np.flatnonzero(np.concatenate([~joined, [True]]))
    values = {one.name: getattr(stays, one.name)[heads] for one in fields(Contacts)}
    return Contacts(**{**values, "end": stays.end[tails], "ended": stays.ended[tails]})
