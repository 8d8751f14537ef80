"""Where exactly a neighbor search stops counting: its effective cutoff, to the last bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy import ndarray

from mdnum.references.finders import Finder
from mdnum.references.oracle import exactly_inside

_NEARBY = 3  # ulps either side of r_cut in which oriented pairs are placed


@dataclass(frozen=True)
class EffectiveCutoff:
    """The cutoff a search acts on, when asked for r_cut.

    Attributes:
        finder: name of the search.
        r_cut: the cutoff asked for.
        last_counted: largest distance along x at which the pair is still counted.
        ulps: last_counted - r_cut in units of r_cut's last place; -1 for an exact "<", 0 for an exact "<=".
        comparison: "<" or "<=", with "in float32" where the numbers are cast to it; else "rounded".
        oriented: pairs placed within 3 ulps of r_cut in random directions.
        disagree: those of them decided otherwise than real arithmetic does with r < r_cut.
    """

    finder: str
    r_cut: float
    last_counted: float
    ulps: int
    comparison: str
    oriented: int
    disagree: int

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def effective_cutoff(
    finder: Finder, r_cut: float, *, periodic: bool = True, oriented: int | None = None, seed: int = 0
) -> EffectiveCutoff:
    """Bisect two-atom configurations to the last double that finder counts as inside r_cut.

    The two atoms differ along x only and the first has x = 0, so their distance is the coordinate itself
    and nothing is lost before the search sees it: what is measured is the search alone. In a periodic box
    (5 r_cut wide) its own wrapping counts too.

    Args:
        finder: the search.
        r_cut: the cutoff to ask for.
        periodic: in a periodic box, as in a simulation; else free atoms.
        oriented: how many randomly oriented pairs to place within 3 ulps of r_cut; default what the
            search can afford.
        seed: of the orientations.
    Error: none, doubles are walked over one by one in the end; it assumes that a search which counts a
        distance counts the smaller ones (checked at relative distances of 1e-5).
    """
    oriented = finder.affords if oriented is None else oriented
    low, high = r_cut * (1 - 1e-5), r_cut * (1 + 1e-5)
    if not _counts(finder, low, r_cut, periodic) or _counts(finder, high, r_cut, periodic):
        return EffectiveCutoff(finder.name, r_cut, float("nan"), 0, "not a cutoff", 0, 0)
    first, last = _bracket(lambda place: _counts(finder, _double(place), r_cut, periodic), _ordinal(r_cut))
    while last - first > 1:
        middle = (first + last) // 2
        if _counts(finder, _double(middle), r_cut, periodic):
            first = middle
        else:
            last = middle
    ulps = first - _ordinal(r_cut)
    disagree = sum(
        _counts_pair(finder, pair, r_cut, periodic)
        != exactly_inside(pair, np.zeros((3, 3)), 0, 1, (0, 0, 0), r_cut)
        for pair in borderline_pairs(r_cut, oriented, seed)
    )
    comparison = {-1: "<", 0: "<="}.get(ulps, "rounded")
    if comparison == "rounded" and finder.unit_roundoff > 2.0**-30:
        step = int(np.float32(_double(first)).view(np.int32)) - int(np.float32(r_cut).view(np.int32))
        comparison = {-1: "< in float32", 0: "<= in float32"}.get(step, comparison)
    return EffectiveCutoff(finder.name, r_cut, _double(first), ulps, comparison, oriented, disagree)


def borderline_pairs(r_cut: float, count: int, seed: int) -> ndarray:
    """Randomly oriented pairs within 3 ulps of r_cut: (count, 2, 3); the first atom is the origin."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    length = r_cut + rng.uniform(-_NEARBY, _NEARBY, size=(count, 1)) * np.spacing(r_cut)
    return np.stack([np.zeros((count, 3)), length * direction], axis=1)


def _bracket(counts: Callable[[int], bool], start: int) -> tuple[int, int]:
    """Two places among the doubles, the first counted and the second not, by doubling steps away from start.

    Most searches stop within an ulp of what they were asked for, so this ends after two or three calls.
    """
    step = 1
    if counts(start):
        while counts(start + step):
            step *= 2
        return start + step // 2, start + step
    while not counts(start - step):
        step *= 2
    return start - step, start - step // 2


def _counts(finder: Finder, distance: float, r_cut: float, periodic: bool) -> bool:
    return _counts_pair(finder, np.array([[0.0, 0.0, 0.0], [distance, 0.0, 0.0]]), r_cut, periodic)


def _counts_pair(finder: Finder, positions: ndarray, r_cut: float, periodic: bool) -> bool:
    cell = np.eye(3) * (5.0 * r_cut if periodic else 0.0)
    return len(finder.pairs(positions, cell, np.full(3, periodic), r_cut)[0]) > 0


def _ordinal(x: float) -> int:
    """Place of a positive double among the doubles."""
    return int(np.float64(x).view(np.int64))


def _double(ordinal: int) -> float:
    return float(np.int64(ordinal).view(np.float64))
