"""Pairs that are inside in one of two trajectories only: where each is in either, and how surely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mdnum.trajectories.compare import Difference, Pair, distances, same_lattice
from mdnum.trajectories.rules import Cutoff, SpeciesCutoffs

if TYPE_CHECKING:
    from mdnum.trajectories.frame import Box, Frame
    from mdnum.trajectories.ledger import Flips
    from mdnum.trajectories.resolution import Resolution
    from mdnum.trajectories.rules import Rule
    from mdnum.trajectories.tracker import Tracker
    from mdnum.trajectories.trajectory import Trajectory


@dataclass
class Side:
    """One of the two trajectories.

    Attributes:
        distance_bound: how far a distance can be off at the last frame, length.
        box_bound: the part of it that comes from the box, for a pair through one period.
        bound: how far a margin can be off.
    """

    trajectory: Trajectory
    tracker: Tracker
    resolution: Resolution
    distance_bound: float = 0.0
    box_bound: float = 0.0
    bound: float = 0.0

    def step(self, frame: Frame) -> Flips:
        """The flips of the next frame."""
        self.distance_bound = self.resolution.bound(frame)
        self.box_bound = self.resolution.bound(frame, np.zeros(0, np.int64))
        # a margin among the nearest is the difference of two distances
        self.bound = self.distance_bound * (1 + self.tracker.rule.directed)
        return self.tracker.step(frame, bound=self.bound)

    def position_bound(self, periods: int) -> float:
        """How far one atom, seen through so many periods of the box, can be off at the last frame, length."""
        # a distance has two atoms that are off
        return (self.distance_bound - self.box_bound) / 2 + max(1, periods) * self.box_bound


def rows(
    pairs: list[Pair], difference: Difference, sides: Sequence[Side], frames: Sequence[Frame]
) -> dict[str, np.ndarray]:
    """Columns on pairs that differ: where each is inside, and by how much.

    A pair is ambiguous where its distance in either file is so close to the threshold that the positions may
    have been on its other side before they were written.
    """
    rule = sides[0].tracker.rule
    i, j, rank = (np.array([pair[k] for pair in pairs], np.int64) for k in range(3))
    in_a = np.array([pair in difference.only_a for pair in pairs], bool)
    apart = [distances(frame, pairs, rule.directed) for frame in frames]
    margins = [
        _thresholds(i, j, inside, rule, side) - distance
        for inside, side, distance in zip((in_a, ~in_a), sides, apart, strict=True)
    ]
    # what has no threshold is not known to be away from it
    clear = [np.abs(margin) > side.bound for margin, side in zip(margins, sides, strict=True)]
    return {
        "rule": np.zeros(len(pairs), np.int64),
        "i": i, "j": j, "rank": rank,
        "inside": np.where(in_a, "A", "B").astype(object),
        "distance_a": apart[0], "distance_b": apart[1], "margin_a": margins[0], "margin_b": margins[1],
        "bound": np.full(len(pairs), max(side.bound for side in sides)), "ambiguous": ~(clear[0] & clear[1]),
    }  # fmt: skip


def _thresholds(
    i: np.ndarray, j: np.ndarray, inside: np.ndarray, rule: Rule, side: Side
) -> Float[np.ndarray, "pairs"]:
    """Distance under which each pair is inside, length; that of a neighbor where it is one."""
    if isinstance(rule, Cutoff):
        return np.full(len(i), rule.radius)
    if isinstance(rule, SpeciesCutoffs):
        species = side.trajectory.species.astype(str)
        names = list(zip(species[i].tolist(), species[j].tolist(), strict=True))
        return np.array([rule.radii.get((a, b), rule.radii.get((b, a), np.nan)) for a, b in names], float)
    stays, enters = side.tracker.thresholds()
    return np.where(inside, stays[i], enters[i])


def other_box(frames: Sequence[Frame], tolerance: float) -> dict[str, Any] | None:
    """The boxes of two frames as plain values; None where they tile space in the same way.

    Args:
        tolerance: how far a lattice vector may be off, length.
    """
    one, other = (frame.box for frame in frames)
    if same_lattice(one, other, tolerance):
        return None
    return {
        "axes": bool((one.pbc != other.pbc).any()),
        "apart": float(np.abs(np.asarray(one.matrix) - np.asarray(other.matrix)).max()),
        "a": plain_box(one),
        "b": plain_box(other),
    }


def plain_box(box: Box) -> dict[str, Any]:
    """A box as plain values, for summary.json."""
    return {"matrix": np.asarray(box.matrix, float).tolist(), "pbc": np.asarray(box.pbc, bool).tolist()}
