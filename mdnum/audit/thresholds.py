"""Find the distance thresholds of a calculator's pair interactions from energies and forces.

Two atoms approach each other until their energy is 1000 kT. Thresholds among many atoms (of angles or numbers
of neighbors) are found by surroundings.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

from mdnum.audit.base import CalculatorError, Progress, Ways, idle
from mdnum.audit.curve import (
    SMOOTH,
    Curve,
    Jump,
    bisect,
    decay_power,
    find_jumps,
    grid,
    measure,
    scatter,
    slope,
    smallest_steps,
)
from mdnum.audit.noise import digits
from mdnum.audit.structures import FARTHEST, Pair, coarse_scan, pairs
from mdnum.audit.subject import CalculatorSubject

STEP = 0.025  # spacing of a scan, in the unit of length. Two thresholds closer than this may be taken for one
#: For walking all pairs, each of which has its share: some 600 go into a scan, 100 to 300 into each place
#: that stands out of it. A pair whose share is less than the fewest is not walked.
_CALLS, _FEWEST_CALLS, WALKING_CALLS = 4200, 900, 4700
STEPS = 2.5  # of answers that are rounded to decimals: a jump of so many steps is more than rounding
_COSTLY = 1000.0  # distances are walked down to where two particles cost so many kT
BESIDE = 0.35  # so near to a known threshold another may be hidden, length: what a scan compares with
_ROUNDING = 1e-15  # of the energy of two particles of several atoms, and of all forces on them
_KNOTS = 3  # more jumps of a third derivative than these are the knots of a table
SMOOTHEST = 6  # orders above this are reported as this one: that smooth or smoother
_LOST = 0.01  # so near to its end a smooth force may be lost in rounding, length
_HAIR = 3e-8  # of a distance: a force that would be 0 so little further on is no jump where it ends
_RATIO, _MOST = 1.15, 20  # past the scan: ratio of the two ends of an interval, and how many intervals
_WIDEST = 120.0  # within a cell the search does not go further, length: the cell has to have room
_NODES = np.cos(np.pi * np.arange(8, -1, -1) / 8)  # places in -1 to 1 (Chebyshev-Lobatto), ends shared
_SMOOTH_TERMS = 1e-6  # of the force, and the energy's change: a smooth decay's highest terms are far below
_NARROW = 0.6  # an interval in which something lies is halved to this width, and then scanned
_NOTHING = 1e-7  # of kT: where no more than this is left to be lost, the search ends


@dataclass(frozen=True)
class PairThreshold:
    """A distance at which the energy or a derivative jumps, or the interaction ends."""

    radius: float  # the distance, length
    species: tuple[str, str]  # of the two atoms (of the reference atoms of two molecules)
    order: int  # the lowest derivative of the energy that jumps, 0 for the energy itself; 6 or smoother is 6
    # of energy (eV), force along the line (eV/Å) and curvature (eV/Å²): beyond minus before
    jumps: tuple[float, float, float]
    inside: float  # the last distance before it that gives another answer
    outside: float  # the first one beyond it; the next double where a value jumps
    dies: bool  # whether the two do not interact beyond it
    located: float  # error of radius, length
    # jump of the third derivative, eV/Å³, where that is the lowest and was measured; else 0
    third: float = 0.0


@dataclass(frozen=True)
class Beyond:
    """Thresholds of a pair interaction at distances beyond the range of the scan."""

    thresholds: tuple[PairThreshold, ...]  # changes and the end, by distance
    # (last distance at which the two feel one another, next one), None without an end
    edge: tuple[float, float] | None
    reached: float  # the farthest distance that was asked about, length
    force: float  # there, eV/Å
    left: float  # energy that is lost beyond it, as it decays there, eV; inf where it does not decay


@dataclass(frozen=True)
class PairWalk:
    """Result of moving two particles toward each other."""

    pair: Pair
    thresholds: tuple[PairThreshold, ...]  # by distance
    distance: Float[np.ndarray, "points"]  # those of the scan, length
    energy: Float[np.ndarray, "points"]  # against far apart, eV
    force: Float[np.ndarray, "points"]  # that drives them apart, eV/Å
    cutoff: float | None  # distance beyond which they do not interact; None if they still do at the farthest
    left_out: int  # places that stood out of the scan and were not zoomed into
    calls: int  # places at which the calculator was asked
    # of energies (eV) and forces (eV/Å) that are rounded to decimals, else 0; no jump below a few of them is
    # reported
    quantum: tuple[float, float] = (0.0, 0.0)
    # places at which the third derivative jumps, where they are too many for thresholds (a table with cubic
    # splines between its points); else 0
    knots: int = 0
    # (from, to, half, all): between these distances, length, but not beside thresholds, a step of the force
    # above `all`, eV/Å, is found, and one above `half` at half of them; None without a scan
    steps: tuple[float, float, float, float] | None = None
    # what was found past the scan, where the two still feel one another at its end
    further: Beyond | None = None
    scanned: float = FARTHEST  # the farthest distance of the scan, length


@dataclass(frozen=True)
class PairWalks:
    """Results of moving two particles toward each other, for every pair of species."""

    walks: tuple[PairWalk, ...]  # one for each pair that was walked
    ways: Ways  # all pairs that there are to walk, and what was left out
    # pairs of species of the structure without a walk of their own, "Cu-Zr" say; none where whole molecules
    # were walked, whose atoms are not asked about one by one
    not_walked: tuple[str, ...] = ()


def find_thresholds(subject: CalculatorSubject) -> list[PairThreshold]:
    """Return all distance thresholds of a calculator. The scan is made only once."""
    if "thresholds" not in subject.known:  # a resumed audit knows them without a walk
        subject.known["thresholds"] = [one for walk in walk_pairs(subject).walks for one in walk.thresholds]
    return subject.known["thresholds"]


def walk_pairs(subject: CalculatorSubject, progress: Progress = idle) -> PairWalks:
    """Scan every pair of species once over a range of distances."""
    if "walks" not in subject.known:
        with subject.meter.apart(WALKING_CALLS):
            subject.known["walks"] = _walked(subject, progress)
    return subject.known["walks"]


def _walked(subject: CalculatorSubject, progress: Progress) -> PairWalks:
    found, skipped = pairs(subject)
    # those beyond the most frequent ones are skipped already
    ways = Ways(skipped, possible=sum(what.startswith("pair ") for what, _ in skipped))
    calls = _CALLS

    def walked(numbered: tuple[int, Pair]) -> PairWalk | None:
        nonlocal calls
        k, pair = numbered
        if calls < _FEWEST_CALLS:
            ways.skip(f"pair {pair.name}", f"{_CALLS:,} calls were used up by other pairs")
            ways.asked -= 1
            return None
        made = walk(subject, pair, calls=max(calls // (len(found) - k), _FEWEST_CALLS))
        calls -= made.calls
        return made

    asked = ways.each(
        subject, list(enumerate(found)), lambda numbered: f"pair {numbered[1].name}", walked, progress,
        "walking pairs", unit="pairs", tolerant=True,
    )  # fmt: skip
    walks = [one for one in asked.values() if one is not None]
    known = {frozenset(one.pair.species) for one in walks}
    species = combinations_with_replacement(sorted(set(subject.atoms.get_chemical_symbols())), 2)
    not_walked = tuple("-".join(two) for two in species if frozenset(two) not in known)
    if any(one.pair.moves == "molecule" for one in walks):
        not_walked = ()
    return PairWalks(tuple(walks), ways, not_walked)


def walk(subject: CalculatorSubject, pair: Pair, calls: float = np.inf) -> PairWalk:
    """Scan the energy and force of one pair over a range of distances.

    Args:
        calls: number of calls after which only the most prominent point of the scan is examined.

    Raises:
        CalculatorError: the calculator fails at distances at which it worked before.
    """
    curve, kT = pair.curve(subject), subject.kT
    coarse, far = coarse_scan(subject, curve)
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
    edge = None if alive(far) else _end_of(coarse, alive)
    if edge is None and not alive(float(coarse[-2])):
        end = near  # nothing anywhere
    else:
        end = edge[1] if edge else min(far, 15.0)
    thresholds: list[PairThreshold] = []
    left_out, smallest = 0, None
    margin = 8 * STEP
    distance = np.append(coarse[coarse >= near][:12], near + margin)
    if end > near + 12 * STEP:
        jumps, left_out = find_jumps(curve, near + margin, end + margin, STEP, calls=calls)
        thresholds = [_at_jump(pair, jump) for jump in jumps]
        smallest = smallest_steps(curve, near + margin, end + margin, STEP)
        scanned = grid(near + margin, end + margin, STEP)
        distance = np.append(coarse[(coarse >= near) & (coarse < near + margin)], scanned)
    knots = sum(one.order == SMOOTH for one in thresholds)
    knots = knots if knots > _KNOTS else 0
    if knots:
        thresholds, left_out = [one for one in thresholds if one.order < SMOOTH], 0
    if edge is not None:
        thresholds = _with_end(pair, curve, edge, thresholds, near)
    further = None
    if edge is None and alive(far):
        further = _beyond(subject, pair, end + margin, noise, calls)
    if further:
        thresholds += further.thresholds
    if pair.moves == "atom":
        thresholds = [one for one in thresholds if not _of_others(pair, one, thresholds)]
    values = curve.many(distance)
    # forces are sums over the atoms of a particle
    quantum = digits(values[0]).quantum, len(pair.second) * digits(values[1]).quantum
    if any(quantum):
        # nearly all that stands out of such a curve is a step of rounding
        thresholds, left_out = [kept for one in thresholds if (kept := _above(one, quantum))], 0
    ended = edge is not None or (further is not None and further.edge is not None)
    known = [one.radius for one in thresholds]
    seen = None if smallest is None else _seen(*smallest, end, STEPS * quantum[1], known)
    return PairWalk(
        pair, tuple(sorted(thresholds, key=lambda one: one.radius)), distance, values[0] - energy_far,
        values[1], thresholds[-1].radius if ended and thresholds else None, left_out, len(curve.known),
        quantum, knots, seen, further, float(distance[-1]),
    )  # fmt: skip


def _at_jump(pair: Pair, jump: Jump) -> PairThreshold:
    return PairThreshold(
        jump.high if jump.exact else jump.at, pair.species, jump.order,
        (jump.energy, jump.force, jump.curvature), jump.low, jump.high, False,
        jump.high - jump.low, jump.third,
    )  # fmt: skip


def _seen(
    places: Float[np.ndarray, "intervals"],
    steps: Float[np.ndarray, "intervals"],
    end: float,
    rounding: float,
    known: Sequence[float],
) -> tuple[float, float, float, float] | None:
    """Return the range of scanned distances, and median and maximum of detection limits for force jumps.

    Distances beyond the end of the interaction are omitted. Distances close to a known threshold are also
    omitted. A second threshold would be hidden there.
    """
    felt = places < end
    for radius in known:
        felt &= np.abs(places - radius) > BESIDE
    if not felt.any():
        return None
    visible = np.maximum(steps[felt], rounding)
    if visible.min() < np.finfo(float).tiny / np.finfo(float).eps:
        return None  # a force that is 0 to the last bit has no noise to measure
    return float(places[felt][0]), float(places[felt][-1]), float(np.median(visible)), float(visible.max())


def _above(threshold: PairThreshold, quantum: tuple[float, float]) -> PairThreshold | None:
    """Return a threshold if its jump exceeds rounding errors, or the interaction ends there."""
    large = any(abs(jump) > STEPS * size for jump, size in zip(threshold.jumps[:2], quantum, strict=True))
    if threshold.order <= 1 and large:
        return threshold
    return replace(threshold, order=SMOOTHEST, jumps=(0.0, 0.0, 0.0)) if threshold.dies else None


def _of_others(pair: Pair, threshold: PairThreshold, thresholds: Sequence[PairThreshold]) -> bool:
    """Return whether other atoms of the particles cross another threshold at this distance."""
    others = pair.others(threshold.radius)
    radii = [one.radius for one in thresholds if one is not threshold]
    return len(others) > 0 and any(np.abs(others - radius).min() < 1e-5 for radius in radii)


# -- the end of an interaction ---------------------------------------------------------------------


def _end_of(
    coarse: Float[np.ndarray, "points"], alive: Callable[[float], bool]
) -> tuple[float, float] | None:
    """Return the largest distance with an interaction, and the next larger double. None if there is none.

    A smooth switching function may round to zero before its end. The search continues if there is an
    interaction at a larger distance.
    """
    last = next((k for k in range(len(coarse) - 2, -1, -1) if alive(float(coarse[k]))), None)
    if last is None:
        return None
    low, high = float(coarse[last]), float(coarse[last + 1])
    top = high
    for _ in range(20):
        low, high = bisect(alive, low, high)
        beyond = [low + (top - low) * 0.5**power for power in range(1, 40)]
        felt = [place for place in beyond if place > high and alive(place)]
        if not felt:
            return low, high
        low, high = max(felt), top
    return low, high


def _with_end(
    pair: Pair, curve: Curve, edge: tuple[float, float], found: list[PairThreshold], near: float
) -> list[PairThreshold]:
    """Return the thresholds of a pair, including the measured end of the interaction."""
    inner = [one.radius for one in found if one.radius < edge[0] - 1e-3]
    room = min(edge[0] - max([near, *inner]), 0.5)
    jump = measure(curve, *edge, room, exact=True)
    if jump.order == 1:
        # where a switch is left out once it rounds to 0, that is the square root of a rounding before its end
        steepness, error = slope(curve, jump.low, -1, room, 0.0)
        left = abs(jump.force / steepness) if abs(steepness) > error else np.inf
        if left < _HAIR * max(abs(jump.low), 1.0):
            jump = replace(jump, order=2, force=0.0)
    order, radius = jump.order, edge[1]
    power = decay_power(curve, edge[1], room) if order >= 2 else None
    if power is not None:
        order = int(np.clip(round(power) + 1, 2, SMOOTHEST))
        if order > SMOOTH - 1:  # it may have been lost in rounding before its end
            radius = max(_root(curve, edge[1], room, round(power)), edge[1])
    jumps = (jump.energy, jump.force, jump.curvature if order <= SMOOTH - 1 else 0.0)
    located = max(radius - edge[0], edge[1] - edge[0])
    # what the scan took for a threshold of its own there is this one
    same = [one for one in found if abs(one.radius - edge[1]) <= 1e-3]
    # of a third derivative that jumps it knows the place better: the force was lost in rounding before
    better = [one for one in found if one.order == SMOOTH and -1e-3 < one.radius - edge[1] < _LOST]
    third = 0.0
    if order >= SMOOTH and better:
        same += better
        order, third = SMOOTH, better[-1].third
        if better[-1].radius - edge[1] > better[-1].located:
            radius, located = better[-1].radius, better[-1].located
    last = PairThreshold(radius, pair.species, order, jumps, *edge, True, located, third)
    return [one for one in found if one not in same] + [last]


def _root(curve: Curve, edge: float, room: float, power: int) -> float:
    """Use a power law of the force to find where an interaction ends.

    If the last distance with a nonzero force agrees with the power law, that distance is returned. The last
    distance is more exact, unless rounding made the force zero.
    """
    places = edge - room * np.array([0.02, 0.01, 0.005])
    far, near, nearer = np.abs(curve.many(places)[1]) ** (1.0 / power)
    if not far > near > nearer:
        return edge
    first = places[1] + near * (places[1] - places[0]) / (far - near)
    root = places[2] + nearer * (places[2] - places[1]) / (near - nearer)
    if abs(root - edge) <= 3 * abs(root - first):
        return edge
    return float(root) if abs(root - edge) < 1e-3 * max(room, 1.0) else edge


# -- past the scan: a few places in each of some geometric intervals tell a smooth decay, through which the
# force is a polynomial to many digits and its work what the energy changes by, from one that breaks off


def _beyond(
    subject: CalculatorSubject, pair: Pair, start: float, noise: Float[np.ndarray, "2"], calls: float
) -> Beyond | None:
    """Search for a cutoff beyond the scan, until the rest of the pair energy is negligible.

    The result is None if periodic images are too close, or if the calculator fails.
    """
    if pair.periodic:
        return None
    curve = (replace(pair, box=2.5 * _WIDEST) if pair.box else pair).curve(subject)
    farthest = min(start * _RATIO**_MOST, _WIDEST) if pair.box else start * _RATIO**_MOST
    low, found = start, []
    edge: tuple[float, float] | None = None
    left, force = np.inf, 0.0
    while low * _RATIO <= farthest:
        high = low * _RATIO
        nodes = _at(low, high)
        try:
            with subject.trying():
                forces = curve.many(nodes)[1]
                gone = curve(_RATIO * high)[0]

                def alive(distance: float, gone: float = gone) -> bool:
                    energy, force = curve(distance)
                    return abs(force) > noise[1] or abs(energy - gone) > noise[0]

                ended = not alive(high) and not alive(_RATIO * high)
                if ended and alive(float(nodes[0])):
                    edge = _end_of(nodes, alive)
                for one, other in _rough(curve, low, (edge[0] if edge else low) if ended else high, noise):
                    jumps, _ = find_jumps(curve, one - 4 * STEP, other + 4 * STEP, STEP, calls=calls)
                    found += [_at_jump(pair, jump) for jump in jumps]
                if ended:
                    break
        except CalculatorError:
            break
        low, force = high, float(forces[-1])
        left = _left(nodes, forces)
        if left < _NOTHING * subject.kT:
            break
    if low == start and edge is None:
        return None
    reached = low
    if edge is not None:
        reached = edge[1]
        # a decay that gets lost in rounding has no end there
        if _expected(curve, edge[0]) > 4 * noise[1]:
            found = _with_end(pair, curve, edge, found, max(low - 0.5, start))
        else:
            edge, left = None, 0.0
    return Beyond(tuple(found), edge, reached, force, left)


def _at(low: float, high: float) -> Float[np.ndarray, "nodes"]:
    nodes = 0.5 * (low + high) + 0.5 * (high - low) * _NODES
    nodes[0], nodes[-1] = low, high
    return nodes


def _rough(
    curve: Curve, low: float, high: float, noise: Float[np.ndarray, "2"]
) -> Iterator[tuple[float, float]]:
    """Yield narrow intervals in which the force is not smooth or contradicts the energy."""
    if high <= low or _smooth(curve, low, high, noise):
        return
    if high - low < _NARROW:
        yield low, high
        return
    middle = 0.5 * (low + high)
    yield from _rough(curve, low, middle, noise)
    yield from _rough(curve, middle, high, noise)


def _smooth(curve: Curve, low: float, high: float, noise: Float[np.ndarray, "2"]) -> bool:
    energies, forces = curve.many(_at(low, high))
    terms = chebyshev.chebfit(_NODES, forces, len(_NODES) - 1)
    if np.abs(terms[-3:]).max() > _SMOOTH_TERMS * np.abs(terms).max() + 4 * noise[1]:
        return False
    integral: Any = chebyshev.chebint(terms)
    work = 0.5 * (high - low) * float(chebyshev.chebval(1.0, integral) - chebyshev.chebval(-1.0, integral))
    change = float(energies[-1] - energies[0])
    return abs(change + work) <= _SMOOTH_TERMS * max(abs(change), abs(work)) + 4 * noise[0]


def _left(nodes: Float[np.ndarray, "nodes"], forces: Float[np.ndarray, "nodes"]) -> float:
    """Return the power-law energy change from the last distance to infinity. inf if the change diverges."""
    first, last = abs(float(forces[0])), abs(float(forces[-1]))
    if not last or not first:
        return np.inf
    power = -np.log(last / first) / np.log(nodes[-1] / nodes[0]) - 1.0
    return float(last * nodes[-1] / power) if power > 0.05 else np.inf


def _expected(curve: Curve, place: float) -> float:
    """Extrapolate the force by a power law fitted at smaller distances."""
    near, far = place - 0.5, place - 0.25
    first, last = (abs(curve(one)[1]) for one in (near, far))
    if not first or not last:
        return 0.0
    return last * (last / first) ** (np.log(place / far) / np.log(far / near))
