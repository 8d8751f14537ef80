"""What a table of flips says: chatter, stays, the busiest pairs, margins in units of rounding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

Flips = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Stays:
    """How long pairs keep a decision, in steps, between two flips of the same pair.

    Attributes:
        inside: from entering to leaving.
        outside: from leaving to entering again.
    """

    inside: Int[np.ndarray, "stays"]
    outside: Int[np.ndarray, "stays"]

    @property
    def all(self) -> Int[np.ndarray, "stays"]:
        """Both."""
        return np.concatenate([self.inside, self.outside])

    def undone_within(self, steps: int) -> int:
        """Chatter: flips that the same pair takes back within so many steps."""
        return int(np.count_nonzero(self.inside <= steps) + np.count_nonzero(self.outside <= steps))


@dataclass(frozen=True)
class PairCounts:
    """Pairs by the number of their flips, most first."""

    i: Int[np.ndarray, "pairs"]
    j: Int[np.ndarray, "pairs"]
    flips: Int[np.ndarray, "pairs"]


def stays(flips: Flips) -> Stays:
    """Residence times of pairs on either side of the cutoff.

    The stay before a pair's first flip and after its last one are not seen whole and not counted,
    so that long stays are underrepresented in a run that is not much longer than they are.
    """
    order = _by_pair(flips)
    key = _pair_key(flips)[order]
    step, entered = flips["step"][order], flips["entered"][order]
    same = key[1:] == key[:-1]
    length = (step[1:] - step[:-1])[same]
    began_inside = entered[:-1][same]
    return Stays(inside=length[began_inside], outside=length[~began_inside])


def alternates(flips: Flips) -> bool:
    """Whether every pair's flips enter and leave in turn: one that does not has a flip missing."""
    order = _by_pair(flips)
    key, entered = _pair_key(flips)[order], flips["entered"][order]
    return not np.any((key[1:] == key[:-1]) & (entered[1:] == entered[:-1]))


def busiest_pairs(flips: Flips) -> PairCounts:
    """The pairs that flipped, those that did so most often first."""
    key, counts = np.unique(_pair_key(flips), return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return PairCounts(i=key[order] >> 32, j=key[order] & 0xFFFFFFFF, flips=counts[order])


def margins_in_bounds(flips: Flips) -> Float[np.ndarray, "flips"]:
    """|margin| of each flip over its rounding bound: at most 1 is ambiguous.

    A bound of zero (an exact comparison) makes any margin but zero infinitely safe.
    """
    margin, bound = np.abs(flips["margin"]), flips["bound"]
    ratio = np.full(margin.shape, np.inf)
    np.divide(margin, bound, out=ratio, where=bound > 0)
    ratio[(bound == 0) & (margin == 0)] = 0.0
    return ratio


def expected_ambiguous(ratio: Float[np.ndarray, "flips"]) -> float:
    """Flips one expects within their rounding bound, were the margins spread evenly near zero.

    They are where atoms move freely through the cutoff. The density is taken from the lower
    quarter of the margins; many more ambiguous flips than this mean that something holds pairs
    at the cutoff, a crystal's shell for example.

    Args:
        ratio: what `margins_in_bounds` gave.
    """
    ratio = ratio[np.isfinite(ratio)]
    if len(ratio) < 4:
        return 0.0
    quarter = np.quantile(ratio, 0.25)
    return float(0.25 * len(ratio) / quarter) if quarter > 0 else float(len(ratio))


def closest(ratio: Float[np.ndarray, "flips"], most: int) -> Int[np.ndarray, "nearest"]:
    """Rows of the flips nearest to their threshold, in units of rounding, nearest first."""
    if len(ratio) > most:
        rows = np.argpartition(ratio, most)[:most]
    else:
        rows = np.arange(len(ratio))
    return rows[np.argsort(ratio[rows], kind="stable")]


def algebra_holds(series: Mapping[str, np.ndarray]) -> Bool[np.ndarray, "steps"]:
    """At each step, whether pairs inside = pairs inside at the start + entered - left."""
    pairs = series["pairs"]
    net = np.cumsum(series["entered"].astype(np.int64) - series["left"])
    return pairs == pairs[0] + net - net[0]


def flips_match_series(series: Mapping[str, np.ndarray], flips: Flips) -> Bool[np.ndarray, "steps"]:
    """At each step, whether the table of flips has as many as the series counted there."""
    first, size = series["step"][0], len(series["step"])
    entered = np.bincount(flips["step"][flips["entered"]] - first, minlength=size)[:size]
    left = np.bincount(flips["step"][~flips["entered"]] - first, minlength=size)[:size]
    return (entered == series["entered"]) & (left == series["left"])


def _pair_key(flips: Flips) -> Int[np.ndarray, "flips"]:
    return (flips["i"].astype(np.int64) << 32) | flips["j"].astype(np.int64)


def _by_pair(flips: Flips) -> Int[np.ndarray, "flips"]:
    # flips are written in the order of their steps, which a stable sort keeps within each pair
    return np.argsort(_pair_key(flips), kind="stable")
