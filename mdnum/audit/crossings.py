"""Flips of a run at the thresholds that were found, and what each did to the energy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import Subject
from mdnum.audit.nve import Run, at
from mdnum.audit.threshold import Threshold
from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.rules import SpeciesCutoffs
from mdnum.trajectories.tracker import Tracker

#: Å before and after a crossing at which the energy is asked for.
_BESIDE = 1e-7


@dataclass(frozen=True)
class Crossing:
    """A pair that crossed a threshold between two steps.

    Attributes:
        step: after it; the step before is one less.
        i, j, rank: the pair, as in `mdnum.trajectories.ledger.Flips`.
        entered: whether it is inside afterwards.
        threshold: its place among the thresholds.
        distance: at `step`, Å.
        margin: at `step`, Å.
        share: of the step's straight way at which the distance is the threshold's.
        slack: of the way to stay clear of it on either side.
    """

    step: int
    i: int
    j: int
    rank: int
    entered: bool
    threshold: int
    distance: float
    margin: float
    share: float
    slack: float


def crossings(run: Run, like: Atoms, thresholds: Sequence[Threshold]) -> list[Crossing]:
    """All flips of a run, in the order of steps and of their places on the way.

    Args:
        run: with positions of every step.
        like: species and cell.
        thresholds: any number for each pair of species.
    """
    box = Box(np.asarray(like.cell.array, np.float64), np.asarray(like.pbc, bool))
    species = like.get_chemical_symbols()
    found = []
    for level in _levels(thresholds, set(species)):
        radii = {thresholds[at].species: thresholds[at].radius for at in level}
        places = {frozenset(thresholds[at].species): at for at in level}
        tracker = Tracker(SpeciesCutoffs(radii), species=species)
        for step, positions in enumerate(run.positions):
            flips = tracker.step(Frame(step, float(step), positions, box))
            # the flips of one pair one way, by place on the way: which image a rank means does not matter
            taken: dict[tuple[int, int, bool], list[tuple[float, float]]] = {}
            for row in range(len(flips)):
                i, j, entered = int(flips.i[row]), int(flips.j[row]), bool(flips.entered[row])
                place = places[frozenset((species[i], species[j]))]
                if (i, j, entered) not in taken:
                    taken[i, j, entered] = _ways(
                        run.positions[step - 1], positions, i, j, entered, thresholds[place], box
                    )
                ways = taken[i, j, entered]
                share, slack = ways.pop(0) if ways else (0.5, 1e-3)
                found.append(
                    Crossing(
                        step, i, j, int(flips.rank[row]), entered, place,
                        float(flips.distance[row]), float(flips.margin[row]), share, slack,
                    )
                )  # fmt: skip
    return sorted(found, key=lambda one: (one.step, one.share))


def _levels(thresholds: Sequence[Threshold], species: set[str]) -> list[list[int]]:
    """Thresholds in groups that have one for a pair of species at most: a rule has no room for more."""
    levels: list[list[int]] = []
    for place, one in enumerate(thresholds):
        if not set(one.species) <= species:
            continue
        key = frozenset(one.species)
        for level in levels:
            if all(frozenset(thresholds[other].species) != key for other in level):
                level.append(place)
                break
        else:
            levels.append([place])
    return levels


def _ways(
    before: Float[np.ndarray, "atoms 3"],
    after: Float[np.ndarray, "atoms 3"],
    i: int,
    j: int,
    entered: bool,
    threshold: Threshold,
    box: Box,
) -> list[tuple[float, float]]:
    """Where on the way of a step images of a pair cross a threshold one way, and what to stay clear of there.

    Ranks name images by their distance: which image a flip belongs to is not told, those that cross are.
    """
    end = _images(after[j] - after[i], threshold.radius, box)
    way = (after[j] - after[i]) - (before[j] - before[i])
    start = end - way
    square = threshold.radius**2
    inside = np.sum(start**2, axis=1) < square, np.sum(end**2, axis=1) < square
    crossing = (inside[1] & ~inside[0]) if entered else (inside[0] & ~inside[1])
    length = float(np.linalg.norm(way))
    slack = float(np.clip(max(_BESIDE, 3 * threshold.located) / length if length else 1.0, 1e-9, 1e-3))
    return sorted((_root(one, way, square), slack) for one in start[crossing])


def _root(start: Float[np.ndarray, "3"], way: Float[np.ndarray, "3"], square: float) -> float:
    """The share s in [0, 1] at which |start + s way|² passes a value."""
    a, b, c = float(way @ way), 2 * float(start @ way), float(start @ start) - square
    inside = b * b - 4 * a * c
    if a == 0 or inside < 0:
        return 0.5
    # the form without cancellation
    q = -0.5 * (b + np.copysign(np.sqrt(inside), b))
    roots = [q / a, c / q if q else 0.0]
    return float(np.clip(min(roots, key=lambda one: abs(one - 0.5)), 0.0, 1.0))


def _images(vector: Float[np.ndarray, "3"], radius: float, box: Box) -> Float[np.ndarray, "images 3"]:
    """The periodic images of a vector that may be as long as a radius, and some more."""
    if not box.periodic:
        return vector[None]
    rows = box.matrix[box.pbc]
    shares = np.rint(np.linalg.lstsq(rows.T, vector, rcond=None)[0])
    base = vector - shares @ rows
    # distance between the planes of the cell: one over the length of a reciprocal vector
    widths = 1 / np.linalg.norm(np.linalg.pinv(rows), axis=0)
    reach = [range(-int(radius / width) - 2, int(radius / width) + 3) for width in widths]
    return base + np.array(list(product(*reach)), np.float64) @ rows


@dataclass(frozen=True)
class Account:
    """What became of the energy in one step.

    Attributes:
        jumps: of the energy at each crossing, in their order, eV; 0 where the energy does not jump.
        rest: change of the energy that neither a jump nor the work of the forces explains, eV.
    """

    jumps: tuple[float, ...]
    rest: float


def account(
    subject: Subject,
    run: Run,
    like: Atoms,
    step: int,
    crossed: Sequence[Crossing],
    thresholds: Sequence[Threshold],
    smooth: int = 2,
) -> Account:
    """Work of the forces along the straight way of a step, in pieces between its crossings.

    Args:
        subject: another object than the run's; asked three times for each crossing and once more.
        run: the run.
        like: species and cell.
        step: at its end.
        crossed: those of this step, by their share.
        thresholds: as `crossings` was given them.
        smooth: order from which a threshold is passed without care: 2, for Simpson's rule takes a kink in the
            force's slope as it takes the fourth power of the step; or 1 where there are too many kinks of the
            force, which are as often on one side of the middle as on the other.

    Error:
        Simpson's rule on the way of one step, fifth power of its length; the calculator's noise.
    """
    start, way = run.positions[step - 1], run.positions[step] - run.positions[step - 1]

    def asked(share: float) -> tuple[float, float]:
        """Energy, and force along the way."""
        there = at(like, start + share * way)
        return subject.energy(there), float(np.sum(subject.forces(there) * way))

    left = 0.0, (float(run.potential[step - 1]), float(np.sum(run.forces[step - 1] * way)))
    end = 1.0, (float(run.potential[step]), float(np.sum(run.forces[step] * way)))
    jumps, rest = [], 0.0
    for one in crossed:
        order = thresholds[one.threshold].order
        if order >= smooth:
            jumps.append(0.0)
            continue
        below, above = max(one.share - one.slack, left[0]), min(one.share + one.slack, 1.0)
        before = (below, asked(below)) if below > left[0] else left
        after = (above, asked(above)) if above < 1.0 else end
        rest += _piece(left, before, asked)
        # what the smooth forces do between the two places is no jump
        mean = 0.5 * (before[1][1] + after[1][1])
        change = after[1][0] - before[1][0] + mean * (after[0] - before[0])
        jumps.append(change if order == 0 else 0.0)
        rest += 0.0 if order == 0 else change
        left = after
    return Account(tuple(jumps), rest + _piece(left, end, asked))


def _piece(first, last, asked) -> float:
    """Energy gained plus work done between two places, 0 where the forces have this energy."""
    width = last[0] - first[0]
    if width <= 0:
        return 0.0
    middle = asked(0.5 * (first[0] + last[0]))[1]
    work = width * (first[1][1] + 4 * middle + last[1][1]) / 6
    return last[1][0] - first[1][0] + work
