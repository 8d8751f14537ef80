"""Past the distances that are scanned closely: where an interaction that is felt there ends, if it does.

A few places in each of some geometric intervals tell a smooth decay from one that breaks off: the force
through them is a polynomial to many digits, and its work is what the energy changes by, or something lies
between.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

from mdnum.audit.base import Subject
from mdnum.audit.curve import Curve
from mdnum.audit.ends import end_of, with_end
from mdnum.audit.jumps import find_jumps
from mdnum.audit.probes import Pair
from mdnum.audit.subject import CalculatorError, only_trying
from mdnum.audit.threshold import Threshold, at_jump

_RATIO = 1.15
"""Of the two ends of an interval."""

_MOST = 20
"""Intervals."""

_WIDEST = 120.0
"""Within a cell it is not looked further, in the unit of length: the cell has to have room."""

_NODES = np.cos(np.pi * np.arange(8, -1, -1) / 8)
"""Places in an interval of -1 to 1 (Chebyshev-Lobatto): its ends are shared with the next."""

_SMOOTH = 1e-6
"""Of the force, and of the energy's change: the highest terms of a smooth decay are far below (1e-10)."""

_NARROW = 0.6
"""An interval in which something lies is halved to this width, and then scanned."""

_NOTHING = 1e-7
"""Of kT: where no more than this is left to be lost, it is not looked further."""


@dataclass(frozen=True)
class Beyond:
    """What was found past the scan.

    Attributes:
        thresholds: changes and the end, by distance.
        edge: (last distance at which the two feel one another, next one), None without an end.
        reached: the farthest distance that was asked about, length.
        force: there, eV/Å.
        left: energy that is lost beyond it, as it decays there, eV; inf where it does not decay.
        nodes: distances asked about in all intervals.
        energies: there, eV.
        forces: there, eV/Å.
    """

    thresholds: tuple[Threshold, ...]
    edge: tuple[float, float] | None
    reached: float
    force: float
    left: float
    nodes: Float[np.ndarray, "nodes"]
    energies: Float[np.ndarray, "nodes"]
    forces: Float[np.ndarray, "nodes"]


def beyond(
    subject: Subject,
    pair: Pair,
    start: float,
    noise: Float[np.ndarray, "2"],
    step: float,
    calls: float,
) -> Beyond | None:
    """Look outward from a distance, as far as something is left that could be lost at a cutoff.

    Args:
        subject: the calculator.
        pair: two that still feel one another at the farthest distance of the scan.
        start: where the scan ended, length.
        noise: of energy and force, that is no feeling.
        step: of a scan, where something lies.
        calls: see `find_jumps`.

    Returns:
        what was found; None where no place could be asked about: in a periodic cell, where images of the two
        come near, or where the calculator fails.
    """
    if pair.periodic:
        return None
    curve = (replace(pair, box=2.5 * _WIDEST) if pair.box else pair).curve(subject)
    farthest = min(start * _RATIO**_MOST, _WIDEST) if pair.box else start * _RATIO**_MOST
    low, found, asked = start, [], [np.array([])]
    edge: tuple[float, float] | None = None
    left, force = np.inf, 0.0
    while low * _RATIO <= farthest:
        high = low * _RATIO
        nodes = _at(low, high)
        try:
            with only_trying(subject):
                forces = curve.many(nodes)[1]
                alive = _alive(curve, high, noise)
                if not alive(high) and not alive(_RATIO * high):
                    edge = _edge(nodes, alive)
                    for one, other in _rough(curve, low, edge[0] if edge else low, noise):
                        found += _jumps(pair, curve, one, other, step, calls)
                    break
                for one, other in _rough(curve, low, high, noise):
                    found += _jumps(pair, curve, one, other, step, calls)
        except CalculatorError:
            break
        asked.append(nodes)
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
            found = with_end(pair, curve, edge, found, max(low - 0.5, start))
        else:
            edge, left = None, 0.0
    nodes = np.unique(np.concatenate(asked))[1:]
    energies, forces = curve.many(nodes) if len(nodes) else np.zeros((2, 0))
    return Beyond(tuple(found), edge, reached, force, left, nodes, energies, forces)


def _at(low: float, high: float) -> Float[np.ndarray, "nodes"]:
    nodes = 0.5 * (low + high) + 0.5 * (high - low) * _NODES
    nodes[0], nodes[-1] = low, high
    return nodes


def _alive(curve: Curve, far: float, noise: Float[np.ndarray, "2"]) -> Callable[[float], bool]:
    gone = curve(_RATIO * far)[0]

    def alive(distance: float) -> bool:
        energy, force = curve(distance)
        return abs(force) > noise[1] or abs(energy - gone) > noise[0]

    return alive


def _edge(nodes: Float[np.ndarray, "nodes"], alive: Callable[[float], bool]) -> tuple[float, float] | None:
    return end_of(nodes, alive) if alive(float(nodes[0])) else None


def _rough(
    curve: Curve, low: float, high: float, noise: Float[np.ndarray, "2"]
) -> Iterator[tuple[float, float]]:
    """Narrow parts of an interval in which the force is no smooth decay, or the energy is not its work."""
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
    if np.abs(terms[-3:]).max() > _SMOOTH * np.abs(terms).max() + 4 * noise[1]:
        return False
    integral = chebyshev.chebint(terms)
    work = 0.5 * (high - low) * float(chebyshev.chebval(1.0, integral) - chebyshev.chebval(-1.0, integral))
    change = float(energies[-1] - energies[0])
    return abs(change + work) <= _SMOOTH * max(abs(change), abs(work)) + 4 * noise[0]


def _jumps(pair: Pair, curve: Curve, low: float, high: float, step: float, calls: float) -> list[Threshold]:
    jumps, _ = find_jumps(curve, low - 4 * step, high + 4 * step, step, calls=calls)
    return [at_jump(pair, jump) for jump in jumps]


def _left(nodes: Float[np.ndarray, "nodes"], forces: Float[np.ndarray, "nodes"]) -> float:
    """Energy that a power of the distance loses from the last place on; inf where it falls too slowly."""
    first, last = abs(float(forces[0])), abs(float(forces[-1]))
    if not last or not first:
        return np.inf
    power = -np.log(last / first) / np.log(nodes[-1] / nodes[0]) - 1.0
    return float(last * nodes[-1] / power) if power > 0.05 else np.inf


def _expected(curve: Curve, place: float) -> float:
    """The force at a place by the power of the distance with which it falls a little before."""
    near, far = place - 0.5, place - 0.25
    first, last = (abs(curve(one)[1]) for one in (near, far))
    if not first or not last:
        return 0.0
    return last * (last / first) ** (np.log(place / far) / np.log(far / near))
