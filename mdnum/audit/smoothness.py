"""Smoothness: pairs, triples and whole surroundings walked through every threshold that is found."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from mdnum.audit import crowd_words
from mdnum.audit import smoothness_words as words
from mdnum.audit.base import Curve, Part, Progress, Subject, TimeUp, meter_of
from mdnum.audit.environments import Surroundings, walk_surroundings
from mdnum.audit.provoke import Crowd, crowd
from mdnum.audit.threshold import Threshold
from mdnum.audit.thresholds import PairWalk, PairWalks, walk_pairs

_ULPS = 12
"""Representable distances shown on either side of a jump."""

_DRAWN = 4


class Smoothness:
    """Is the energy smooth wherever atoms can go, and if not, where, to what order and by how much?

    Args:
        neighbors: how many a crowded center gets.
        routes: through the structure, on which unknown thresholds are looked for.
    """

    name = "smoothness"

    def __init__(self, neighbors: int = 160, routes: int = 2):
        self.neighbors = neighbors
        self.routes = routes

    def __call__(self, subject: Subject, progress: Progress | None = None) -> Part:
        """Walk and crowd.

        Raises:
            CalculatorError: the calculator fails on its own structure.
        """
        began = time.perf_counter()
        walks = walk_pairs(subject, progress)
        if not walks.walks and meter_of(subject).deadline.passed:
            raise TimeUp
        around = walk_surroundings(subject, progress, routes=self.routes)
        late: list[tuple[str, str]] = []
        crowds = crowd(subject, progress, self.neighbors, late)
        units = crowd_words.units_of(subject)
        skipped = [*walks.skipped, *around.skipped, *late]
        if not crowds and not late:
            skipped.append(
                ("caps on the number of neighbors", "the calculator takes no crowd of single atoms")
            )
        return Part(
            name="smoothness",
            title="Smoothness",
            says=words.summary(walks, around, crowds, subject.kT, units),
            findings=words.findings(walks, around, crowds, subject.kT, units),
            tables=_tables(walks, around, crowds, subject.kT, units),
            curves=_curves(walks, crowds, subject, units),
            numbers=_numbers(walks, around, crowds, subject.kT),
            skipped=skipped,
            seconds=time.perf_counter() - began,
            asked=walks.possible - walks.left + around.asked + len(crowds),
            possible=walks.possible + around.possible + len(crowds) + len(late),
        )


SMOOTHNESS_CHECKS = (Smoothness,)


def _tables(
    walks: PairWalks, around: Surroundings, crowds: Sequence[Crowd], kT: float, units: crowd_words.Words
) -> dict[str, list[dict[str, Any]]]:
    return {
        "Thresholds found by walking pairs": [
            {
                "pair": crowd_words.together("-".join(one.species)),
                f"distance ({units.length})": words.place(one),
                "what": "the end" if one.dies else "a change",
                "first to jump": crowd_words.together(words.ORDERS[one.order]),
                f"energy ({units.small})": one.jumps[0] * units.scale if one.order == 0 else 0.0,
                "in kT": abs(one.jumps[0]) / kT if one.order == 0 else 0.0,
                f"force ({units.force})": one.jumps[1] if one.order <= 1 else 0.0,
                f"curvature ({units.curvature})": one.jumps[2] if one.order <= 2 else 0.0,
                f"third derivative ({units.third})": one.third or None,
                "last before": repr(one.inside),
                "first beyond": repr(one.outside),
            }
            for walk in walks.walks
            for one in walk.thresholds
        ],
        "The same among the others of the structure, and what only shows there": [
            {
                "moved": crowd_words.together(one.route),
                f"pair distance ({units.length})": f"{one.distance:.10g}" if one.threshold else "none fits",
                "first to jump": crowd_words.together(words.order_of(one)),
                f"energy ({units.small})": one.jump.energy * units.scale if one.jump.order == 0 else 0.0,
                "in kT": abs(one.jump.energy) / kT if one.jump.order == 0 else 0.0,
                f"largest force ({units.force})": one.force if one.jump.order <= 1 else 0.0,
                f"curvature ({units.curvature})": one.jump.curvature if one.jump.order == 2 else None,
            }
            for one in around.events
        ],
        "How closely pairs were looked at": [
            {
                "pair": crowd_words.together("-".join(walk.pair.species)),
                f"from ({units.length})": walk.steps[0],
                f"to ({units.length})": walk.steps[1],
                f"a step of the force is seen from ({units.force})": walk.steps[3],
                f"over half of the way from ({units.force})": walk.steps[2],
            }
            for walk in walks.walks
            if walk.steps
        ],
        "Crowded atoms": [
            {
                "element": one.species,
                "neighbors given": one.neighbors,
                f"within ({units.length})": one.radius,
                "nearest that are kept": one.kept,
                "order of atoms matters from": one.order_from,
                f"energy ({units.small})": max(one.energy, one.order_energy) * units.scale,
                f"force ({units.force})": max(one.force, one.order_force),
            }
            for one in crowds
        ],
    }


def _numbers(walks: PairWalks, around: Surroundings, crowds: Sequence[Crowd], kT: float) -> dict[str, Any]:
    thresholds = [one for walk in walks.walks for one in walk.thresholds]
    steps = [abs(one.jumps[0]) for one in thresholds if one.order == 0]
    steps += [abs(one.jump.energy) for one in around.events if one.jump.order == 0]
    forces = [abs(one.jumps[1]) for one in thresholds if one.order <= 1]
    forces += [one.force for one in around.events if one.jump.order <= 1]
    forces += [max(one.force, one.order_force) for one in crowds]
    cutoffs = {"-".join(walk.pair.species): walk.cutoff for walk in walks.walks}
    orders = [one.order for one in thresholds] + [one.jump.order for one in around.events]
    return {
        "pairs": len(walks.walks),
        "pairs_not_walked": list(walks.not_walked),
        "thresholds": len(thresholds),
        "cutoffs": cutoffs,
        "order": min(orders, default=None),
        "largest_energy_jump": max(steps, default=0.0),
        "largest_energy_jump_kT": max(steps, default=0.0) / kT if kT else None,
        "largest_force_jump": max(forces, default=0.0),
        "force_steps_seen": max((walk.steps[3] for walk in walks.walks if walk.steps), default=None),
        "crossings_measured": around.measured,
        "routes": len(around.routes),
        "unexplained": sum(one.threshold is None for one in around.events),
        "neighbors_kept": min((one.kept for one in crowds if one.kept), default=None),
        "order_matters_from": min((one.order_from for one in crowds if one.order_from), default=None),
        "neighbors_tried": max((one.neighbors for one in crowds), default=0),
    }


def _curves(
    walks: PairWalks, crowds: Sequence[Crowd], subject: Subject, units: crowd_words.Words
) -> list[Curve]:
    found: list[Curve] = []
    for walk in walks.walks[:_DRAWN]:
        found.append(_energies(walk, subject.kT, units))
        sharp = [one for one in walk.thresholds if one.order <= 1]
        found += [_close_up(walk, one, subject, units) for one in sharp[:1]]
    for one in crowds:
        if one.kept:
            found.append(
                Curve(
                    f"{one.species} with {one.neighbors} neighbors: what jumps when another passes the k-th",
                    "k",
                    f"largest jump of a force ({units.force})",
                    np.array([float(k) for k, _, _ in one.jumps]),
                    {"force": np.array([force for _, _, force in one.jumps])},
                    {"kept": float(one.kept)},
                )
            )
    return found


def _energies(walk: PairWalk, kT: float, units: crowd_words.Words) -> Curve:
    """The energy of two, where it is small enough to see what happens at the thresholds."""
    depth = max(-float(walk.energy.min()), 2 * kT)
    shown = walk.energy < 2 * depth
    from_here = len(shown) - int(np.argmin(shown[::-1])) if not shown.all() else 0
    marks = {
        f"{words.kind(one)} at {one.radius:.6g} {units.length}": one.radius for one in walk.thresholds[-4:]
    }
    return Curve(
        f"Two particles: {walk.pair.name}",
        f"distance ({units.length})",
        f"energy ({units.energy})",
        walk.distance[from_here:],
        {"energy": walk.energy[from_here:]},
        marks,
    )


def _close_up(walk: PairWalk, threshold: Threshold, subject: Subject, units: crowd_words.Words) -> Curve:
    """Energy or force at the last representable distances before a jump and the first ones beyond it."""
    curve = walk.pair.curve(subject)
    below, above = [threshold.inside], [threshold.outside]
    for _ in range(_ULPS - 1):
        below.append(float(np.nextafter(below[-1], -np.inf)))
        above.append(float(np.nextafter(above[-1], np.inf)))
    values = curve.many([*below[::-1], *above])
    row = threshold.order
    what = f"energy ({units.energy})" if row == 0 else f"force ({units.force})"
    return Curve(
        f"{walk.pair.name} at {threshold.outside!r} {units.length}, distance by representable distance",
        "representable distances from the jump",
        what,
        np.concatenate([-np.arange(_ULPS, 0, -1.0), np.arange(_ULPS * 1.0)]),
        {what.split(" ")[0]: values[row] - (values[0, -1] if row == 0 else 0.0)},
    )
