"""Estimate of the flips missed because a pair returns across its threshold between frames.

Missed flips are those found only if every time step is examined. docs/lost-flips.md describes the four
estimates: thinning, persistence, velocities and flux. The estimates by thinning and persistence are
extrapolated to shorter frame intervals t. The assumed laws for the rate of observed flips are (1 +
(t/τ)^p)^(-s/p). The exponent p is 2 for smooth motion and 1 for abrupt velocity changes. The exponent s is
1/2 for diffusion and 1 for atoms that stay at their sites. The estimate is the mean over all laws that fit
the data.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mdnum.trajectories.frame import Frame
from mdnum.trajectories.history import Strides
from mdnum.trajectories.lattice import shortest
from mdnum.trajectories.resolution import Resolution, unrounded

# the family: exponents p and s, and the frames' distance over τ
_P = np.linspace(0.8, 2.4, 9)[:, None, None]
_S = np.array([0.4, 0.5, 0.6, 0.75, 1.0, 1.25])[:, None]
_X = np.geomspace(1e-3, 1e3, 140)
# at strides 1, 2, 4, 8: the logarithm of what is left, what each doubling takes, and the odds of being lost
_LEFT = np.array([-(_S / _P) * np.log1p((k * _X) ** _P) for k in (1, 2, 4, 8)])
_TAKEN, _LOST = -np.diff(_LEFT, axis=0), np.log(-np.expm1(_LEFT[0])) - _LEFT[0]
# a priori: smooth paths are more usual, and frames many τ apart the rarer the further
_RARE = 3 * np.log1p(_X / 3) - 2 * np.log(_P)
# errors of the laws for what a doubling takes, relative; the least that persistence resolves
_LAW, _LEAST = {"thinning": 0.10, "persistence": 0.05}, 3e-4
# errors of each estimate, in the logarithm of its odds; of a share by velocities, absolute; and of those by
# displacements where atoms stay at their places, so that pairs are not spread evenly around the threshold
_OWN = {"thinning": 0.25, "persistence": 0.40, "velocities": 0.35, "flux": 0.25}
_BY_VELOCITIES, _BOUND = 2e-3, 0.8
# standard deviations on either side; what a disagreement of the estimates adds; a range that is no answer
_WIDE, _DISAGREE, _NO_ANSWER = 2.0, 0.75, 0.5
# an estimate below it may be of a file that holds every step; crossings below which they are no rate
_MAYBE_NONE, _CROSSED = 0.02, 20

#: Logarithm of the odds of a share, and its standard deviation.
Estimate = tuple[float, float]


@dataclass(frozen=True)
class FrameMotion:
    """Root mean square displacements of the atoms between frames."""

    growth: tuple[float, float, float]  # displacement in 1, 2 and 4 frames over that many times the one in 1
    step: float  # displacement of a pair in a frame, along an axis, length
    moved: float  # displacement in a frame over what velocities say; nan without them
    atoms: int  # from which it was found

    @classmethod
    def of(
        cls,
        sample: Sequence[Frame],
        resolution: Resolution,
        first: Int[np.ndarray, "first"] | None = None,
        second: Int[np.ndarray, "second"] | None = None,
        *,
        timed: bool = True,
    ) -> FrameMotion | None:
        """Measure displacements between frames. None for too few frames or hardly any motion."""
        sides = [slice(None) if one is None else one for one in (first, first if second is None else second)]
        atoms, grid = min(len(sample[0].positions[side]) for side in sides), resolution.usual_step(sample[0])
        pairs = list(pairwise(sample))
        moves = np.array([shortest(b.positions - a.positions, b.box)[0] for a, b in pairs])
        if len(moves) < 4 or not atoms or not grid > 0 or not np.isfinite(moves).all():
            return None

        def variance(ways: Float[np.ndarray, "ways atoms 3"]) -> float:
            """Return the variance of displacements along one axis, without the mean motion."""
            free = ways - ways.mean(axis=1, keepdims=True)
            return float(np.mean([(free[:, side] ** 2).mean() for side in sides]))

        sums = [[moves[at : at + lag].sum(axis=0) for at in range(len(moves) - lag + 1)] for lag in (1, 2, 4)]
        one, two, four = (math.sqrt(unrounded(variance(np.array(ways)), grid)) for ways in sums)
        if not min(one, two, four) > grid:
            return None
        flown = [a.velocities * (b.time - a.time) for a, b in pairs if a.velocities is not None]
        timed = timed and len(flown) == len(pairs) and all(b.time > a.time for a, b in pairs)
        moved = one / math.sqrt(said) if timed and (said := variance(np.array(flown))) > 0 else math.nan
        return cls((1.0, two / one / 2, four / one / 4), math.sqrt(2) * one, moved, atoms)


@dataclass(frozen=True)
class LostFlips:
    """Estimate of the flips missed between frames, as a fraction of the true number of flips."""

    # "none_lost" (every second frame alone would lose no flip), "estimate"; or why there is no number:
    # "rounding" (the file's digits may have made what thinning loses), "open" (too wide a range fits)
    reason: str
    doubled: float  # share that every second frame alone would lose, and every fourth
    fourth: float
    rounded: float  # share of the first that the rounding of the file may have made
    parts: Mapping[str, Estimate]  # what it is made from
    lost: float | None = None  # the estimate; None where the numbers do not tell
    low: float | None = None  # its range: the truth was in it in more than 9 of 10 planted files
    high: float | None = None


def lost_flips(
    found: Strides, motion: FrameMotion | None = None, flux: Any = None, reach: float = math.nan
) -> LostFlips | None:
    """Estimate the missed flips. None without flips or for fewer than three frame intervals.

    Args:
        found: number of flips found at each stride.
        motion: motion of the atoms that form pairs.
        flux: number of crossings by velocities, "crossed", and the fraction that is "lost"; or None.
        reach: threshold distance, in length units; nan if there is none.
    """
    if len(found.stride) < 3 or tuple(found.stride[:3]) != (1, 2, 4) or not found.of.all():
        return None
    of, (near, fourth) = int(found.of[1]), (found.share[0] - found.share[1:3]).tolist()
    seen = (near, fourth, float(found.doubtful[1] / of))
    # where atoms stay at their places the same pairs come back: a doubled stride shows half of the flips
    halved = np.max(-np.diff(np.log2(found.share[found.flips > 10])), initial=0.0)
    parts = {} if motion is None else _of_motion(motion, reach, _BOUND * np.clip(5 * halved - 4, 0.0, 1.0))
    if near <= 0 or 2 * found.doubtful[1] <= found.of[1] - found.flips[1]:
        parts["thinning"] = _of_thinning(found)
    if flux is not None and flux["lost"] is not None and flux["crossed"] >= _CROSSED:
        parts |= _odds("flux", flux["lost"], (1 - flux["lost"]) * math.sqrt(2 / flux["crossed"]))
    if not parts:
        return LostFlips("rounding", *seen, parts)
    mean, error = np.array(list(parts.values())).T
    error = np.hypot(error, [_OWN[name] for name in parts])
    weight = error**-2 / np.sum(error**-2)
    middle = float(weight @ mean)
    wide = _WIDE * math.sqrt(1 / np.sum(error**-2) + _DISAGREE * float(weight @ (mean - middle) ** 2))
    low, lost, high = _share(middle - wide), _share(middle), _share(middle + wide)
    # a flip that is lost comes with the one that reverses it: what chance does to their number in this file
    low, high = max(low - 2 * math.sqrt(2 * low / of), 0.0), min(high + 2 * math.sqrt(2 * high / of), 0.999)
    if near <= 0:
        # 3 events or fewer are not seen in one case of 20; each is two flips
        return LostFlips("none_lost", *seen, parts, 0.0, 0.0, max(high, 12 / (of + 12)))
    if high - low > _NO_ANSWER:
        return LostFlips("open", *seen, parts)
    return LostFlips("estimate", *seen, parts, lost, low if lost > _MAYBE_NONE else 0.0, high)


def _of_motion(motion: FrameMotion, reach: float, bound: float) -> dict[str, Estimate]:
    """Estimate missed flips from the persistence of displacements and, if known, from velocities."""
    taken, few = -np.diff(np.log(motion.growth)), 1 / math.sqrt(motion.atoms)
    found = {"persistence": _carried_on(taken, np.hypot((_LAW["persistence"] + few) * taken, _LEAST))}
    if math.isfinite(motion.moved):
        found |= _odds("velocities", 1 - motion.moved, _BY_VELOCITIES + few * abs(1 - motion.moved))
    # a straight path that cuts a sphere short is in and out within a frame
    short = min((motion.step / reach) ** 2 / 3, 0.9) if reach > 0 else 0.0
    for name, (odds, error) in found.items():
        share = _share(odds)
        found[name] = (_log_odds(share + short - share * short), math.hypot(error, bound))
    return found


def _of_thinning(found: Strides) -> Estimate:
    left = np.maximum(found.flips[:4] / found.of[:4], 1e-9)
    taken = -np.diff(np.log(left))
    # a flip that is left out comes with the one that reverses it; neighbors do so together
    events = np.maximum(-np.diff(left) * found.of[1 : len(left)] / 2, 1.0)
    chance = 2 * np.sqrt(2 * events) / np.maximum(found.flips[1 : len(left)], 1)
    unsure = np.diff(found.doubtful[: len(left)] / found.of[: len(left)])
    return _carried_on(taken, np.sqrt((_LAW["thinning"] * taken) ** 2 + chance**2 + unsure**2 + 1e-8))


def _carried_on(taken: Float[np.ndarray, "doublings"], error: Float[np.ndarray, "doublings"]) -> Estimate:
    """Estimate the fraction of missed flips from the flips found if frames are skipped."""
    misfit = sum(((law - one) / off) ** 2 for law, one, off in zip(_TAKEN, taken, error, strict=False))
    weight = np.exp(np.min(misfit) / 2 - misfit / 2 - _RARE)
    mean = float(np.average(_LOST, weights=weight))
    return mean, math.sqrt(float(np.average((_LOST - mean) ** 2, weights=weight)))


def _odds(name: str, share: float, error: float) -> dict[str, Estimate]:
    return {name: (_log_odds(share), error / (share * (1 - share)))} if error < share < 1 else {}


def _log_odds(share: float) -> float:
    return math.log(share / (1 - share))


def _share(odds: float) -> float:
    return 1 / (1 + math.exp(-odds))
