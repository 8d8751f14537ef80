"""Statistics of contact durations and of pairs that flip.

Three quantities describe the durations of contacts:

- The **lifetime** is estimated from contacts whose beginning was observed. Contacts after the last frame are
  right-censored (Kaplan, Meier, J. American Statistical Association 53, 457, 1958).
- The **mean by rate** is the contact time per observed contact end. The mean by rate is the mean lifetime if
  contacts end at a constant rate.
- The **residence** is the fraction of pairs that stay in contact during a lag (Impey, Madden and McDonald, J.
  Phys. Chem. 87, 5071, 1983). Long contacts are sampled more often, so the residence differs from the
  lifetime.

Durations are numbers of frames. Counts for disjoint subsets of the pairs can be added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mdnum.compiled import njit
from mdnum.md.ledger import Columns
from mdnum.trajectories.history import Contacts, History, Strides, Sums, contacts, doublings, mended
from mdnum.trajectories.topology import AtomTable

#: Largest number of contacts from which the fraction of returning pairs is computed.
_AGAIN_STAYS = 200_000
_BUSIEST = 500
_POINTS = 160
_CLASSES = 60


@dataclass(frozen=True)
class Durations(Sums):
    """Histograms of contact durations: entry n counts the contacts of n frames."""

    seen: Int[np.ndarray, "lengths"]  # seen to begin and to end
    goes_on: Int[np.ndarray, "lengths"]  # seen to begin, but not to end (censored on the right)
    older: Int[np.ndarray, "lengths"]  # seen to end, but not to begin (censored on the left)
    throughout: Int[np.ndarray, "lengths"]  # inside from the first frame to the last

    @classmethod
    def of(cls, stays: Contacts, frames: int) -> Durations:
        """Count contacts by duration, for a trajectory with the given number of frames."""
        kinds = [(b, e) for b in (stays.began, ~stays.began) for e in (stays.ended, ~stays.ended)]
        return cls(*(np.bincount(stays.length[b & e], minlength=frames + 1) for b, e in kinds))

    @property
    def all(self) -> Int[np.ndarray, "lengths"]:
        """Histogram of the durations of all contacts, completely observed or not."""
        return self.seen + self.goes_on + self.older + self.throughout

    @property
    def followed(self) -> Int[np.ndarray, "lengths"]:
        """Histogram of the observed durations of contacts whose beginning was observed, in frames."""
        # one that goes on after n frames was seen to survive n - 1 times
        return self.seen + np.append(self.goes_on[1:], 0)

    @property
    def exposure(self) -> int:
        """Number of pairs in contact at a frame and examined at the next, summed over frames."""
        length = np.arange(len(self.seen))
        # a stay of n frames that goes on after the last one has been examined again n - 1 times
        whole, cut = self.seen + self.older, self.goes_on + self.throughout
        return int(whole @ length + cut @ np.maximum(length - 1, 0))

    @property
    def leaves(self) -> int:
        """Number of contacts whose end was observed."""
        return int(self.seen.sum() + self.older.sum())


@dataclass(frozen=True)
class Survival:
    """Fraction of contacts that last longer than n frames."""

    frames: Int[np.ndarray, "points"]  # lengths at which some ended, from 1, rising
    share: Float[np.ndarray, "points"]  # still inside after that many frames
    error: Float[np.ndarray, "points"]  # its standard error (Greenwood)
    at_risk: Int[np.ndarray, "points"]  # contacts followed for at least that long
    longest: int  # frames for which any was followed: nothing is known beyond

    def at(self, share: float) -> int | None:
        """Return the shortest duration that at most a fraction `share` of contacts exceeds, or None."""
        below = np.flatnonzero(self.share <= share)
        return int(self.frames[below[0]]) if len(below) else None

    @property
    def mean(self) -> float:
        """Area below the survival curve: a lower bound of the mean duration, in frames."""
        edges = np.concatenate([[0], self.frames, [self.longest]])
        return float(np.sum(np.diff(edges) * np.concatenate([[1.0], self.share])))


def survival(found: Durations) -> Survival:
    """Compute the product-limit estimate of contact survival from contacts whose beginning was observed.

    Contacts of the first frame are excluded, as their age is unknown.
    """
    followed, points = found.followed, np.flatnonzero(found.seen)
    at_risk = np.cumsum(followed[::-1])[::-1][points]
    risk, gone = at_risk.astype(np.float64), found.seen[points].astype(np.float64)
    share = np.cumprod(1.0 - gone / risk)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(risk > gone, gone / (risk * (risk - gone)), 0.0)
    lasted = np.flatnonzero(followed)
    longest = int(lasted[-1]) if len(lasted) else 0
    return Survival(points, share, share * np.sqrt(np.cumsum(terms)), at_risk, longest)


def mean_by_rate(found: Durations) -> tuple[float, float]:
    """Return contact time per contact end (frames), and its error. inf if no contact ended.

    The standard error is valid for independent contact ends. Repeated crossings make the standard error too
    small.
    """
    if not found.leaves:
        return float("inf"), float("nan")
    mean = found.exposure / found.leaves
    return mean, mean / float(np.sqrt(found.leaves))


def residence(found: Durations, pairs: Int[np.ndarray, "frames"]) -> Float[np.ndarray, "frames"]:
    """Return, by lag, the fraction of pairs that stay in contact without a break.

    Lags begin at 0. Each fraction is an average over first frames. nan if no pair is in contact. `pairs` is
    the number of pairs inside the cutoff at each frame.
    """
    count, lags = found.all, np.arange(len(pairs))
    stays = np.cumsum(count[::-1])[::-1]
    frames = np.cumsum((count * np.arange(len(count)))[::-1])[::-1]
    # a stay of n frames holds n - t pairs of frames that are t apart
    kept = np.array([frames[t + 1] - t * stays[t + 1] if t + 1 < len(count) else 0 for t in lags], float)
    asked = np.cumsum(pairs).astype(float)[::-1]
    return np.divide(kept, asked, out=np.full(len(pairs), np.nan), where=asked > 0)


def again(stays: Contacts, lags: Int[np.ndarray, "lags"], frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Count pairs that are in contact at a frame and at a later frame.

    The first array divided by the second is the residence with interruptions. Counts for disjoint sets of
    pairs can be added. Lags are between 0 and frames - 1.

    Returns:
        two arrays by lag, summed over frames: numbers of pairs inside at both frames, and at the first frame.
    """
    both, once = np.zeros(len(lags), np.int64), np.zeros(len(lags), np.int64)
    pairs = np.append(np.flatnonzero(_new_pairs(stays)), len(stays))
    _again(pairs, stays.begin, stays.end, lags, frames, both, once)
    return both, once


@njit
def _again(pairs, begin, end, lags, frames, both, once):
    for place in range(lags.shape[0]):
        lag = lags[place]
        for pair in range(pairs.shape[0] - 1):
            later = pairs[pair]
            for stay in range(pairs[pair], pairs[pair + 1]):
                low, high = begin[stay] + lag, end[stay] + lag
                once[place] += max(0, min(end[stay], frames - lag) - begin[stay])
                # the next one begins after this one's end
                while later < pairs[pair + 1] and end[later] <= low:
                    later += 1
                other = later
                while other < pairs[pair + 1] and begin[other] < high:
                    both[place] += min(end[other], high) - max(begin[other], low)
                    other += 1


def _new_pairs(stays: Contacts) -> np.ndarray:
    """Return True for each contact that is the first contact of its pair."""
    changed = [np.diff(column) != 0 for column in (stays.i, stays.j, stays.rank)]
    return np.concatenate([[True], np.any(changed, axis=0)])[: len(stays)]


# ---- who flips


@dataclass(frozen=True)
class Classes:
    """Classes of atoms: the class of each atom, and the class names."""

    of: Int[np.ndarray, "atoms"]
    names: Sequence[str]

    @classmethod
    def by(cls, words: np.ndarray) -> Classes:
        """Classify atoms by label: atoms with equal labels are in the same class."""
        names, index = np.unique(words.astype(str), return_inverse=True)
        return cls(index.reshape(-1), [str(one) for one in names])


@dataclass(frozen=True)
class Labels:
    """Classes of atoms by species, residue name and residue."""

    species: Classes
    residue_names: Classes | None
    residues: Classes | None

    @classmethod
    def of(cls, table: AtomTable) -> Labels:
        """Build the classes of atoms from a table of atoms."""
        if not any(table.residue_names):
            return cls(Classes.by(table.species), None, None)
        first = np.unique(table.residues, return_index=True)[1]
        # residues are numbered from 0 without gaps in a topology
        words = [f"{table.residue_names[at]} {table.residue_ids[at]}" for at in first]
        return cls(Classes.by(table.species), Classes.by(table.residue_names), Classes(table.residues, words))


@dataclass(frozen=True)
class ClassTally(Sums):
    """Numbers of flips and of frames in contact for each class pair."""

    _common = ("names",)

    names: tuple[str, ...]  # of the classes
    entered: Int[np.ndarray, "classes classes"]  # flips by class of the first and of the second atom
    left: Int[np.ndarray, "classes classes"]
    inside: Int[np.ndarray, "classes classes"]  # pairs inside, summed over frames
    exposure: Int[np.ndarray, "classes classes"]  # as of `Durations`

    @classmethod
    def of(cls, stays: Contacts, classes: Classes, frames: int, directed: bool = False) -> ClassTally:
        """Count flips and frames in contact by the classes of both atoms.

        Directed rules count i -> j and j -> i separately. For other rules, the lower class index comes first.
        """
        first, second = classes.of[stays.i], classes.of[stays.j]
        if not directed:
            first, second = np.minimum(first, second), np.maximum(first, second)
        size = len(classes.names)
        code = first.astype(np.int64) * size + second
        exposed = np.where(stays.end < frames, stays.length, stays.length - 1)
        # sums of integers below 2**53 are exact in float64
        summed = (
            np.bincount(code, weights, minlength=size**2).astype(np.int64).reshape(size, size)
            for weights in (stays.began, stays.ended, stays.length, exposed)
        )
        return cls(tuple(classes.names), *summed)

    @property
    def mean_stay(self) -> Float[np.ndarray, "classes classes"]:
        """Frames in contact per contact end, for each class pair. nan if no contact ended."""
        none = np.full(self.left.shape, np.nan)
        return np.divide(self.exposure, self.left, out=none, where=self.left > 0)

    def rows(self) -> list[dict[str, Any]]:
        """Return table rows for class pairs with contacts, most flips first."""
        stay = self.mean_stay
        rows = [
            {
                "first": self.names[a], "second": self.names[b], "entered": int(self.entered[a, b]),
                "left": int(self.left[a, b]), "inside": int(self.inside[a, b]), "stay": float(stay[a, b]),
            }
            for a, b in zip(*np.nonzero(self.inside), strict=True)
        ]  # fmt: skip
        return sorted(rows, key=lambda row: (-row["entered"] - row["left"], -row["inside"]))[:_CLASSES]


@dataclass(frozen=True)
class Chatter(Sums):
    """Histograms of the time between a flip and its reversal."""

    inside: Int[np.ndarray, "lengths"]  # visits inside by their length in frames, 0 to the window
    outside: Int[np.ndarray, "lengths"]  # excursions outside by their length
    flips: int  # all flips

    @classmethod
    def of(cls, history: History, window: int) -> Chatter:
        """Count flips that are reversed within `window` frames."""
        pair = history.pair
        same = pair[1:] == pair[:-1]
        apart, from_inside = np.diff(history.frame)[same], history.entered[:-1][same]
        short = apart <= window
        inside, outside = (
            np.bincount(apart[one & short], minlength=window + 1) for one in (from_inside, ~from_inside)
        )
        return cls(inside, outside, len(history.frame))

    @property
    def window(self) -> int:
        """Length of the time window, in frames, in which reversed flips are counted."""
        return len(self.inside) - 1

    @property
    def undone(self) -> int:
        """Number of flips that the same pair reversed within the time window."""
        return int(self.inside.sum() + self.outside.sum())


@dataclass(frozen=True)
class Busiest(Columns):
    """Pairs with the largest numbers of flips, in descending order."""

    i: Int[np.ndarray, "pairs"]  # the pairs
    j: Int[np.ndarray, "pairs"]
    rank: Int[np.ndarray, "pairs"]
    flips: Int[np.ndarray, "pairs"]  # of each
    inside: Int[np.ndarray, "pairs"]  # frames inside

    @classmethod
    def of(cls, history: History, stays: Contacts, most: int = _BUSIEST) -> Busiest:
        """Return the pairs of a history with the largest numbers of flips."""
        # stays are in the order of the history's pairs, of which some were never inside
        inside = np.zeros(len(history), np.int64)
        ever = history.inside | (history.flips > 0)
        inside[ever] = np.bincount(np.cumsum(_new_pairs(stays)) - 1, stays.length) if len(stays) else 0
        return cls(history.i, history.j, history.rank, history.flips, inside).first(most)

    def first(self, most: int = _BUSIEST) -> Busiest:
        """Return the first `most` pairs, excluding pairs without flips."""
        order = np.lexsort((self.rank, self.j, self.i, -self.flips))[:most]
        order = order[self.flips[order] > 0]
        return self[order]

    def __add__(self, other: Busiest) -> Busiest:
        """Return the pairs with the most flips from two tables without common pairs."""
        return Busiest.concatenate([self, other]).first()


@dataclass(frozen=True)
class Residues(Sums):
    """Numbers of flips within each group of atoms (such as a residue), and with other atoms."""

    between: Int[np.ndarray, "groups"]
    within: Int[np.ndarray, "groups"]

    @classmethod
    def of(cls, history: History, classes: Classes) -> Residues:
        """Count flips by the groups to which both atoms of a pair belong."""
        first, second, flips = classes.of[history.i], classes.of[history.j], history.flips
        own, count = first == second, len(classes.names)
        between = (np.bincount(one[~own], flips[~own], count) for one in (first, second))
        within = np.bincount(first[own], flips[own], count)
        return cls(sum(between, np.zeros(count)).astype(np.int64), within.astype(np.int64))


# ---- all of it


@dataclass(frozen=True)
class AgainSums(Sums):
    """Counts of pairs in contact at two frames (see `again`)."""

    both: Int[np.ndarray, "lags"]
    once: Int[np.ndarray, "lags"]
    stays: int


@dataclass(frozen=True)
class Statistics(Sums):
    """All statistics of the pairs that one membership rule defines."""

    durations: Durations  # of contacts, and of contacts whose short gaps are overlooked
    intermittent: Durations
    by_species: ClassTally  # None for residues where the file has none
    by_residue_name: ClassTally | None
    residues: Residues | None
    chatter: Chatter
    strides: Strides
    busiest: Busiest
    pairs: int  # that flipped
    images: int  # pairs through further images of an atom
    again: AgainSums

    @classmethod
    def of(
        cls, history: History, labels: Labels, directed: bool, window: int, before: Statistics | None = None
    ) -> tuple[Statistics, Contacts]:
        """Add statistics of `history` to `before`. Return the sum and the contacts in `history`.

        A flip reversed within `window` frames is counted as chatter. A contact with a gap of up to `window`
        frames counts as one contact.
        """
        frames, stays = history.frames, contacts(history)
        named, residues = labels.residue_names, labels.residues
        some, among = stays, -(-len(stays) // _AGAIN_STAYS)
        if before is not None and before.again.stays >= _AGAIN_STAYS // 2:
            # one part of the pairs is a sample of all of them, and enough
            some = stays[:0]
        elif among > 1:
            # all stays of some of the pairs: enough for an average, however many there are
            mine = (stays.i.astype(np.int64) * 7 + stays.j * 13) % among == 0
            some = stays[mine]
        counted = cls(
            durations=Durations.of(stays, frames),
            intermittent=Durations.of(mended(stays, window), frames),
            by_species=ClassTally.of(stays, labels.species, frames, directed),
            by_residue_name=None if named is None else ClassTally.of(stays, named, frames, directed),
            residues=None if residues is None else Residues.of(history, residues),
            chatter=Chatter.of(history, window),
            strides=Strides.of_history(history, doublings(frames)),
            busiest=Busiest.of(history, stays),
            pairs=int(np.count_nonzero(history.flips)),
            images=int(np.count_nonzero((history.rank > 0) | (history.i == history.j))),
            again=AgainSums(*again(some, lags_of(frames), frames), len(some)),
        )
        return counted if before is None else before + counted, stays

    def curves(self, pairs: Int[np.ndarray, "frames"], interval: float) -> dict[str, np.ndarray]:
        """Return survival and residence by lag. `pairs` is the number of contacts at each frame.

        `interval` is the time between frames, nan if unknown.
        """
        lags = lags_of(len(pairs))
        left, loose = survival(self.durations), survival(self.intermittent)

        def at(curve: Survival, values: np.ndarray, start: float) -> np.ndarray:
            place = np.searchsorted(curve.frames, lags, side="right") - 1
            known = np.where(place >= 0, np.concatenate([values, [start]])[place], start)
            return np.where(lags <= curve.longest, known, np.nan)

        risk, none = np.cumsum(self.durations.followed[::-1])[::-1], np.full(len(lags), np.nan)
        return {
            "frames": lags, "time": lags * interval, "at_risk": risk[np.minimum(lags, len(risk) - 1)],
            "survival": at(left, left.share, 1.0), "error": at(left, left.error, 0.0),
            "intermittent": at(loose, loose.share, 1.0), "residence": residence(self.durations, pairs)[lags],
            "again": np.divide(self.again.both, self.again.once, out=none, where=self.again.once > 0),
        }  # fmt: skip


@dataclass(frozen=True)
class Lifetime:
    """Measures of contact lifetimes, in frames. Unknown measures are None."""

    followed: int  # contacts seen to begin
    median: int | None  # frames after which so many are over
    quarter_gone: int | None
    three_quarters_gone: int | None
    mean: float | None  # the area below the curve: less than the mean where some are left at its end
    mean_is_whole: bool
    longest: int  # frames for which any was followed
    mean_by_rate: float  # see `mean_by_rate`
    mean_by_rate_error: float
    leaves: int

    @classmethod
    def of(cls, durations: Durations) -> Lifetime:
        """Compute lifetimes from the histograms of contact durations."""
        left, any_left = survival(durations), bool(durations.seen.any())
        return cls(
            int(durations.seen.sum() + durations.goes_on.sum()), left.at(0.5), left.at(0.75), left.at(0.25),
            left.mean if any_left else None, any_left and bool(left.share[-1] == 0.0), left.longest,
            *mean_by_rate(durations), durations.leaves,
        )  # fmt: skip


def lags_of(frames: int) -> Int[np.ndarray, "lags"]:
    """Return lags of correlation functions, in frames, with increasing spacing."""
    if frames < 2:
        return np.zeros(1, np.int64)
    return np.unique(np.concatenate([[0], np.round(np.geomspace(1, frames - 1, _POINTS))]).astype(np.int64))
