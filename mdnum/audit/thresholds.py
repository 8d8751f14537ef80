"""Where a calculator's interactions change their program: found from its answers, never asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float

from mdnum.audit.base import TIME_UP, Progress, Subject, TimeUp, meter_of
from mdnum.audit.beyond import Beyond, beyond
from mdnum.audit.curve import Curve, grid, scatter
from mdnum.audit.digits import digits
from mdnum.audit.ends import end_of, with_end
from mdnum.audit.jumps import SMOOTH, find_jumps, smallest_steps
from mdnum.audit.probes import FARTHEST, Pair, pairs
from mdnum.audit.subject import CalculatorError, only_trying
from mdnum.audit.threshold import SMOOTHEST, Threshold, at_jump

STEP = 0.025
"""Spacing of a scan, in the unit of length. Two thresholds closer than this may be told as one."""

_CALLS = 20_000
"""For walking all pairs, each of which has its share: some 600 go into a scan, 100 to 300 into each place
that stands out of it."""

_FEWEST_CALLS = 1500
"""A pair whose share is less is not walked."""

STEPS = 2.5
"""Of answers that are rounded to decimals: a jump of so many steps is more than rounding."""

_NEAREST = 0.3
_COSTLY = 1000.0
"""Distances are walked down to where two particles cost this many kT."""

BESIDE = 0.35
"""So near to a threshold that was found a second one may be hidden, length: what a scan compares with."""

_ROUNDING = 1e-15
"""Of the energy of two particles of several atoms, and of all forces on them: what rounding may change."""

_KNOTS = 3
"""More jumps of a third derivative than these are the knots of a table."""


@dataclass(frozen=True)
class PairWalk:
    """Two particles brought from far apart to as near as they come.

    Attributes:
        pair: who they are.
        thresholds: by distance.
        distance: those of the scan, length.
        energy: against far apart, eV.
        force: that drives them apart, eV/Å.
        cutoff: distance beyond which they do not interact; None if they still do at the farthest.
        left_out: places that stood out of the scan and were not looked at closely.
        calls: places at which the calculator was asked.
        knots: places at which the third derivative jumps, where they are so many that they are no thresholds
            (a table with cubic splines between its points); else 0.
        quantum: of energies (eV) and forces (eV/Å) that are rounded to decimals; 0 where they are not. No
            jump below a few of them is told.
        further: what was found past the scan, where the two still feel one another at its end.
        scanned: the farthest distance of the scan, length.
        steps: (from, to, half, all) of the scan within the range: between these distances, length, but not
            beside thresholds, a step of the force above `all`, eV/Å, is found, and one above `half` at half
            of them; None without a scan.
    """

    pair: Pair
    thresholds: tuple[Threshold, ...]
    distance: Float[np.ndarray, "points"]
    energy: Float[np.ndarray, "points"]
    force: Float[np.ndarray, "points"]
    cutoff: float | None
    left_out: int
    calls: int
    quantum: tuple[float, float] = (0.0, 0.0)
    knots: int = 0
    steps: tuple[float, float, float, float] | None = None
    further: Beyond | None = None
    scanned: float = FARTHEST


@dataclass(frozen=True)
class PairWalks:
    """What walking pairs told.

    Attributes:
        walks: one for each pair that was walked.
        skipped: what was left out, and why.
        not_walked: pairs of species of the structure without a walk of their own, "Cu-Zr" say; none where
            whole molecules were walked, whose atoms are not asked about one by one.
        possible: pairs that there are to walk.
        left: those that were not, because the time was up or there are too many.
    """

    walks: tuple[PairWalk, ...]
    skipped: tuple[tuple[str, str], ...]
    not_walked: tuple[str, ...] = ()
    possible: int = 0
    left: int = 0


_known: WeakKeyDictionary[Any, PairWalks] = WeakKeyDictionary()


def find_thresholds(subject: Subject) -> list[Threshold]:
    """Every distance at which a pair interaction of the calculator changes its program.

    Found by walking two of each species from far apart to as near as 1000 kT lets them. What only shows
    among many (an angle's own cutoff, a cap on neighbors) is for the walks through whole environments.

    Args:
        subject: the calculator; asked once, remembered afterwards.

    Returns:
        thresholds by pair of species and distance.
    """
    return [one for walk in walk_pairs(subject).walks for one in walk.thresholds]


def walk_pairs(subject: Subject, progress: Progress | None = None) -> PairWalks:
    """Walk every pair of species through its distances; remembered for the subject."""
    if subject not in _known:
        found, skipped = pairs(subject)
        walks = []
        # those beyond the most frequent ones are told so already
        calls, left = _CALLS, sum(what.startswith("pair ") for what, _ in skipped)
        possible = len(found) + left
        for k, pair in enumerate(found):
            share = max(calls // (len(found) - k), _FEWEST_CALLS)
            if calls < _FEWEST_CALLS:
                left += 1
                skipped.append((f"pair {pair.name}", f"{_CALLS:,} calls were used up by other pairs"))
                continue
            if progress:
                progress(k, len(found), {"phase": f"walking {pair.name}", "unit": "pairs"})
            try:
                with meter_of(subject).limited():
                    walks.append(walk(subject, pair, calls=share))
                calls -= walks[-1].calls
            except CalculatorError as error:
                skipped.append((f"pair {pair.name}", error.message))
            except TimeUp:
                skipped.append((f"pair {pair.name}", TIME_UP))
                left += 1
        _known[subject] = PairWalks(tuple(walks), tuple(skipped), _not_walked(subject, walks), possible, left)
        getattr(subject, "known", {})["walks"] = _known[subject]
    return _known[subject]


def known_walks(subject: Subject) -> tuple[PairWalk, ...]:
    """Walks of pairs that were made for an earlier question; none where none was."""
    found = getattr(subject, "known", {}).get("walks")
    return found.walks if found else ()


def _not_walked(subject: Subject, walks: Sequence[PairWalk]) -> tuple[str, ...]:
    """Pairs of species of the structure that no walk was about."""
    if any(one.pair.moves == "molecule" for one in walks):
        return ()
    walked = {frozenset(one.pair.species) for one in walks}
    species = sorted(set(subject.atoms.get_chemical_symbols()))
    both = combinations_with_replacement(species, 2)
    return tuple("-".join(two) for two in both if frozenset(two) not in walked)


def rough(subject: Subject, pair: Pair) -> tuple[float | None, float | None]:
    """(where a pair stops interacting, where its energy is least), to within a coarse scan; None if never."""
    curve = pair.curve(subject)
    coarse, far = _coarse(subject, curve)
    energies, forces = curve.many(coarse)
    energies = energies - curve(far)[0]
    felt = np.flatnonzero((np.abs(energies) > 1e-12) | (np.abs(forces) > 1e-12))
    cutoff = None if len(felt) == 0 or felt[-1] >= len(coarse) - 2 else float(coarse[felt[-1] + 1])
    lowest = int(np.argmin(energies[coarse > 0.8])) + int((coarse <= 0.8).sum())
    least = float(coarse[lowest]) if energies[lowest] < -1e-9 and lowest > 0 else None
    return cutoff, least


def walk(subject: Subject, pair: Pair, step: float = STEP, calls: float = np.inf) -> PairWalk:
    """Walk one pair.

    Args:
        subject: the calculator.
        pair: who is walked.
        step: of the scan.
        calls: after so many, only the place that stands out most of the scan is looked at closely.

    Raises:
        CalculatorError: the calculator fails at distances at which it had answered before.
    """
    curve, kT = pair.curve(subject), subject.kT
    coarse, far = _coarse(subject, curve)
    energy_far = curve(far)[0]
    noise = 8 * scatter(curve, far, far, 1.0)[0]
    if len(pair.second) > 1:
        # what is within a particle is rounded otherwise where the two stand otherwise
        inside = float(np.abs(subject.forces(pair.at(far))).sum())
        noise = np.maximum(noise, _ROUNDING * np.array([4 * abs(energy_far), inside]))

    def alive(distance: float) -> bool:
        energy, force = curve(distance)
        return abs(energy - energy_far) > noise[0] or abs(force) > noise[1]

    costs = np.abs(curve.many(coarse)[0] - energy_far) > _COSTLY * kT
    near = float(coarse[np.flatnonzero(costs)[-1] + 1]) if costs[:-1].any() else float(coarse[0])
    edge = None if alive(far) else end_of(coarse, alive)
    if edge is None and not alive(float(coarse[-2])):
        end = near  # nothing anywhere
    else:
        end = edge[1] if edge else min(far, 15.0)
    thresholds: list[Threshold] = []
    left_out = 0
    smallest = None
    margin = 8 * step
    distance = np.append(coarse[coarse >= near][:12], near + margin)
    if end > near + 12 * step:
        jumps, left_out = find_jumps(curve, near + margin, end + margin, step, calls=calls)
        thresholds = [at_jump(pair, jump) for jump in jumps]
        smallest = smallest_steps(curve, near + margin, end + margin, step)
        scanned = grid(near + margin, end + margin, step)
        distance = np.append(coarse[(coarse >= near) & (coarse < near + margin)], scanned)
    thirds = sum(one.order == SMOOTH for one in thresholds)
    knots = thirds if thirds > _KNOTS else 0
    if knots:
        thresholds, left_out = [one for one in thresholds if one.order < SMOOTH], 0
    if edge is not None:
        thresholds = with_end(pair, curve, edge, thresholds, near)
    further = None
    if edge is None and alive(far):
        further = beyond(subject, pair, end + margin, noise, step, calls)
    if further:
        thresholds += further.thresholds
    thresholds = [
        one for one in thresholds if pair.moves == "molecule" or not _of_others(pair, one, thresholds)
    ]
    values = curve.many(distance)
    reach = distance[-1]
    if further:
        distance = np.append(distance, further.nodes)
        values = np.hstack([values, np.array([further.energies, further.forces])])
    quantum = _quantum(values, len(pair.second))
    if any(quantum):
        # nearly all that stands out of such a curve is a step of rounding
        thresholds, left_out = [kept for one in thresholds if (kept := _beyond(one, quantum))], 0
    ended = edge is not None or (further is not None and further.edge is not None)
    known = [one.radius for one in thresholds]
    seen = None if smallest is None else _seen(*smallest, end, STEPS * quantum[1], known)
    return PairWalk(
        pair, tuple(sorted(thresholds, key=lambda one: one.radius)), distance, values[0] - energy_far,
        values[1], thresholds[-1].radius if ended and thresholds else None, left_out, len(curve.known),
        quantum, knots, seen, further, float(reach),
    )  # fmt: skip


def _seen(
    places: Float[np.ndarray, "intervals"],
    steps: Float[np.ndarray, "intervals"],
    end: float,
    rounding: float,
    known: Sequence[float],
) -> tuple[float, float, float, float] | None:
    """(from, to, step of the force that is found at half of the places, step that is found at all).

    Beside a threshold that is known, another is hidden: those places do not count, nor do those beyond the
    end.
    """
    felt = places < end
    for radius in known:
        felt &= np.abs(places - radius) > BESIDE
    if not felt.any():
        return None
    told = np.maximum(steps[felt], rounding)
    return float(places[felt][0]), float(places[felt][-1]), float(np.median(told)), float(told.max())


def _quantum(values: Float[np.ndarray, "2 points"], summed: int) -> tuple[float, float]:
    """Steps of energies and of forces that are sums over so many atoms."""
    return digits(values[0]).quantum, summed * digits(values[1]).quantum


def _beyond(threshold: Threshold, quantum: tuple[float, float]) -> Threshold | None:
    """A threshold at which more jumps than the rounding of answers; of the last one, that it is there."""
    energy, force, _ = threshold.jumps
    rounding = STEPS * quantum[0], STEPS * quantum[1]
    if threshold.order <= 1 and (abs(energy) > rounding[0] or abs(force) > rounding[1]):
        return threshold
    return replace(threshold, order=SMOOTHEST, jumps=(0.0, 0.0, 0.0)) if threshold.dies else None


def _of_others(pair: Pair, threshold: Threshold, thresholds: Sequence[Threshold]) -> bool:
    """Whether it is companions of the two that pass another threshold there."""
    others = pair.others(threshold.radius)
    radii = [one.radius for one in thresholds if one is not threshold]
    return any(np.abs(others - radius).min() < 1e-5 for radius in radii) if len(others) else False


def _coarse(subject: Subject, curve: Curve) -> tuple[Float[np.ndarray, "points"], float]:
    """Distances from where the calculator first answers to the farthest."""
    places = np.concatenate([np.arange(_NEAREST, 3.0, 0.1), np.arange(3.0, FARTHEST + 0.1, 0.25)])
    first = len(places)
    for k in range(len(places) - 1, -1, -1):
        try:
            with only_trying(subject):
                curve(float(places[k]))
        except CalculatorError:
            break
        first = k
    if first > len(places) - 4:
        curve(float(places[-4]))  # says why
    return places[first:], float(places[-1])
