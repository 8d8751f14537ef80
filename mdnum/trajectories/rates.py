"""Who flips: rates by pair of species or residue name, flips by residue, the busiest pairs, and chatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mdnum.trajectories.contacts import Contacts
from mdnum.trajectories.history import History


@dataclass(frozen=True)
class Tally:
    """Flips and time inside by pair of classes (species, say); sums over parts of the pairs add up.

    Attributes:
        names: of the classes.
        entered, left: flips by class of the first and of the second atom.
        inside: pairs inside, summed over frames.
        exposure: times that a pair inside at one frame was looked at again at the next one.
    """

    names: tuple[str, ...]
    entered: Int[np.ndarray, "classes classes"]
    left: Int[np.ndarray, "classes classes"]
    inside: Int[np.ndarray, "classes classes"]
    exposure: Int[np.ndarray, "classes classes"]

    @classmethod
    def of(
        cls,
        stays: Contacts,
        classes: Int[np.ndarray, "atoms"],
        names: Sequence[str],
        frames: int,
        directed: bool = False,
    ) -> Tally:
        """Counts by the classes of the two atoms.

        Args:
            classes: of each atom of the file, an index into names.
            frames: frames looked at.
            directed: whether i -> j and j -> i are two things (nearest neighbors); else both count as one,
                under the class that comes first.
        """
        first, second = classes[stays.i], classes[stays.j]
        if not directed:
            first, second = np.minimum(first, second), np.maximum(first, second)
        size = len(names)
        code = first.astype(np.int64) * size + second
        exposed = np.where(stays.end < frames, stays.length, stays.length - 1)

        def summed(weights: np.ndarray) -> np.ndarray:
            # sums of whole numbers below 2**53 are exact in float64
            return np.bincount(code, weights, minlength=size**2).astype(np.int64).reshape(size, size)

        return cls(
            tuple(names), summed(stays.began), summed(stays.ended), summed(stays.length), summed(exposed)
        )

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.names,
            self.entered + other.entered,
            self.left + other.left,
            self.inside + other.inside,
            self.exposure + other.exposure,
        )


@dataclass(frozen=True)
class Chatter:
    """Flips by how soon the same pair takes them back; sums over parts of the pairs add up.

    Attributes:
        inside: visits inside by their length in frames, 0 to the window: a pair that left so soon again.
        outside: excursions outside by their length.
        flips: all flips.
    """

    inside: Int[np.ndarray, "lengths"]
    outside: Int[np.ndarray, "lengths"]
    flips: int

    @classmethod
    def of(cls, history: History, window: int) -> Chatter:
        """Those that are taken back within a window of frames."""
        pair = history.pair
        same = pair[1:] == pair[:-1]
        apart = np.diff(history.frame)[same]
        from_inside = history.entered[:-1][same]
        short = apart <= window

        def counted(chosen: np.ndarray) -> np.ndarray:
            return np.bincount(apart[chosen & short], minlength=window + 1)

        return cls(counted(from_inside), counted(~from_inside), len(history.frame))

    def __add__(self, other: Chatter) -> Chatter:
        return Chatter(self.inside + other.inside, self.outside + other.outside, self.flips + other.flips)

    @property
    def window(self) -> int:
        """Frames within which a flip was looked for that takes another back."""
        return len(self.inside) - 1

    @property
    def undone(self) -> int:
        """Flips that the same pair takes back within the window."""
        return int(self.inside.sum() + self.outside.sum())


@dataclass(frozen=True)
class Busiest:
    """Pairs by the number of their flips, most first.

    Attributes:
        i, j, rank: the pairs.
        flips: of each.
        inside: frames inside.
    """

    i: Int[np.ndarray, "pairs"]
    j: Int[np.ndarray, "pairs"]
    rank: Int[np.ndarray, "pairs"]
    flips: Int[np.ndarray, "pairs"]
    inside: Int[np.ndarray, "pairs"]

    @classmethod
    def of(cls, history: History, stays: Contacts, most: int) -> Busiest:
        """The pairs of a history that flipped most often."""
        flips = history.flips
        order = np.lexsort((history.rank, history.j, history.i, -flips))[:most]
        order = order[flips[order] > 0]
        # stays are in the order of the history's pairs, of which some were never inside
        changed = [np.diff(column) != 0 for column in (stays.i, stays.j, stays.rank)]
        new = np.concatenate([[True], np.any(changed, axis=0)])[: len(stays)]
        inside = np.zeros(len(history), np.int64)
        ever = history.inside | (flips > 0)
        inside[ever] = np.bincount(np.cumsum(new) - 1, stays.length) if len(stays) else 0
        return cls(history.i[order], history.j[order], history.rank[order], flips[order], inside[order])

    def joined(self, other: Busiest, most: int) -> Busiest:
        """The busiest of two parts that have no pair in common."""
        columns = [
            np.concatenate([getattr(self, name), getattr(other, name)])
            for name in ("i", "j", "rank", "flips", "inside")
        ]
        order = np.lexsort((columns[2], columns[1], columns[0], -columns[3]))[:most]
        return Busiest(*(column[order] for column in columns))


def by_group(
    history: History, groups: Int[np.ndarray, "atoms"], count: int
) -> tuple[Int[np.ndarray, "groups"], Int[np.ndarray, "groups"]]:
    """Flips of each group of atoms (a residue, say): with others, and within itself.

    Args:
        groups: of each atom, 0 to count - 1.
    """
    first, second, flips = groups[history.i], groups[history.j], history.flips
    own = first == second
    between = np.bincount(first[~own], flips[~own], count) + np.bincount(second[~own], flips[~own], count)
    within = np.bincount(first[own], flips[own], count)
    return between.astype(np.int64), within.astype(np.int64)


def mean_stay(tally: Tally) -> Float[np.ndarray, "classes classes"]:
    """Frames inside per leave, by pair of classes; nan where none left."""
    return np.divide(tally.exposure, tally.left, out=np.full(tally.left.shape, np.nan), where=tally.left > 0)
