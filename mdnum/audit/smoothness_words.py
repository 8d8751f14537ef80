"""What the walks through thresholds found, in words: findings with evidence and remedy, and a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mdnum.audit.base import Subject
from mdnum.audit.environments import Event, Surroundings, unexplained
from mdnum.audit.provoke import Crowd
from mdnum.audit.thresholds import PairWalk, PairWalks, Threshold
from mdnum.references.findings import finding
from mdnum.units import METAL

ORDERS = (
    "energy", "force", "curvature", "third derivative", "fourth derivative", "fifth derivative",
    "none up to the fifth",
)  # fmt: skip

_LARGE = 1e-3
"""An energy jump above this many kT is an error: a thousand of them in one direction make one kT."""

_SMALL = 1e-7
"""One below this many kT is told, and no more."""

_SMALL_FORCE = 1e-5
"""A force jump below this many kT per unit of length is told, and no more."""

_STEEP = 5.0
"""A switch whose curvature is this many times that of the well is what limits the time step."""


@dataclass(frozen=True)
class Words:
    """Names of units.

    Attributes:
        scale: from the energy unit to the one that jumps are told in.
    """

    length: str
    energy: str
    small: str
    scale: float
    force: str
    curvature: str


def units_of(subject: Subject) -> Words:
    """How to name what a subject's numbers are in."""
    units = getattr(subject, "units", METAL)
    small, scale = ("meV", 1e3) if units.energy == "eV" else (units.energy, 1.0)
    energy, length = units.energy, units.length
    return Words(length, energy, small, scale, f"{energy}/{length}", f"{energy}/{length}²")


def kind(threshold: Threshold) -> str:
    """What a threshold is, in a few words."""
    return "the interaction ends" if threshold.dies else "the law changes"


def place(threshold: Threshold) -> str:
    """Its distance, with as many digits as are known."""
    if threshold.located < 1e-12:
        return repr(threshold.radius)
    digits = int(np.clip(np.ceil(-np.log10(threshold.located)), 1, 15))
    return f"{threshold.radius:.{digits}f}"


def summary(walks: PairWalks, around: Surroundings, crowds: Sequence[Crowd], kT: float, units: Words) -> str:
    """One or two sentences with the numbers."""
    thresholds = [one for walk in walks.walks for one in walk.thresholds]
    found = f"Walking {len(walks.walks)} pairs of species found {_count(len(thresholds), 'threshold')}"
    if len(walks.walks) == 1:
        one = walks.walks[0].pair.name.split("-")[0]
        found = f"Walking two {one} found {_count(len(thresholds), 'threshold')}"
    if not walks.walks:
        found = "No two particles could be walked by themselves"
    cutoffs = sorted({f"{walk.cutoff:.6g}" for walk in walks.walks if walk.cutoff})
    if cutoffs:
        found += f" (interactions end at {', '.join(cutoffs)} {units.length})"
    worst = _worst(walks, around)
    if worst is None:
        tail = "nothing jumps that could be told from rounding"
    else:
        order, energy, force = worst
        tail = f"the lowest derivative that jumps is the {ORDERS[order]}"
        if order == 0:
            tail = (
                f"the energy jumps by up to {energy * units.scale:.3g} {units.small} ({energy / kT:.2g} kT)"
            )
        elif order == 1:
            tail = f"the energy is continuous and the force jumps by up to {force:.3g} {units.force}"
    caps = [one for one in crowds if one.kept or one.order_from]
    if caps:
        kept = min(one.kept or (one.order_from or 1) - 1 for one in caps)
        tail += f"; an atom keeps {kept} neighbors and drops the rest"
    elif crowds:
        tail += f"; {max(one.neighbors for one in crowds)} neighbors at once are all kept"
    return f"{found}; {tail}."


def _worst(walks: PairWalks, around: Surroundings) -> tuple[int, float, float] | None:
    """(lowest order that jumps, largest energy jump, largest force jump), None where nothing does."""
    seen = [(one.order, one.jumps[0], one.jumps[1]) for walk in walks.walks for one in walk.thresholds]
    seen += [(one.jump.order, one.jump.energy, one.force) for one in around.events]
    seen = [one for one in seen if one[0] <= 5]
    if not seen:
        return None
    energy = max((abs(one[1]) for one in seen if one[0] == 0), default=0.0)
    force = max((abs(one[2]) for one in seen if one[0] <= 1), default=0.0)
    return min(one[0] for one in seen), energy, force


def findings(
    walks: PairWalks, around: Surroundings, crowds: Sequence[Crowd], kT: float, units: Words
) -> list[dict[str, str]]:
    """Findings by severity of what they mean for a run and for a derivative."""
    found = [*_pair_findings(walks, around, kT, units)]
    found += _unexplained(around, kT, units)
    found += [one for crowded in crowds for one in _caps(crowded, kT, units)]
    found += [one for walk in walks.walks for one in _reach(walk, units)]
    return found


def _pair_findings(walks: PairWalks, around: Surroundings, kT: float, units: Words) -> list[dict[str, str]]:
    found: list[dict[str, str]] = []
    thresholds = [one for walk in walks.walks for one in walk.thresholds]
    steps = [one for one in thresholds if one.order == 0]
    if steps:
        worst = max(steps, key=lambda one: abs(one.jumps[0]))
        inside = _among(around, steps)
        size = max([abs(worst.jumps[0]), *(abs(one.jump.energy) for one in inside)]) / kT
        severity = "error" if size > _LARGE else "warning" if size > _SMALL else "info"
        among = ""
        if inside:
            most = max(inside, key=lambda one: abs(one.jump.energy))
            among = (
                f" Among the others of the structure it is {abs(most.jump.energy) * units.scale:.3g} "
                f"{units.small} ({abs(most.jump.energy) / kT:.2g} kT)."
            )
        found.append(
            finding(
                "ENERGY_JUMP",
                severity,
                "the energy jumps at a cutoff" if worst.dies else "the energy jumps within the range",
                f"Two {'-'.join(worst.species)} at {worst.inside!r} and at {worst.outside!r} "
                f"{units.length}, the "
                f"next representable distance, differ by {worst.jumps[0] * units.scale:.6g} {units.small} "
                f"({abs(worst.jumps[0]) / kT:.2g} kT); the force jumps by {worst.jumps[1]:.4g} {units.force}."
                f"{among} {_others(steps, worst, units)}No force stands for this energy: every crossing "
                "changes "
                "the energy of a run, and no derivative through the run sees the crossing.",
                "Shift the energy and the force to zero at the cutoff, or switch the interaction off over "
                "the "
                "last part of its range.",
            )
        )
    bends = [one for one in thresholds if one.order == 1]
    if bends:
        worst = max(bends, key=lambda one: abs(one.jumps[1]))
        size = abs(worst.jumps[1]) / kT
        found.append(
            finding(
                "FORCE_JUMP",
                "warning" if size > _SMALL_FORCE else "info",
                "the force jumps at a cutoff" if worst.dies else "the force jumps within the range",
                f"Between two {'-'.join(worst.species)} at {worst.inside!r} and at {worst.outside!r} "
                f"{units.length} the force jumps by {worst.jumps[1]:.6g} {units.force}, the energy by no "
                "more than "
                f"rounding. {_others(bends, worst, units)}A run keeps its energy; a derivative through it "
                "misses "
                "a term at every crossing, an error that a smaller time step does not lessen.",
                "Switch the interaction off smoothly, or take derivatives that know of events "
                "(`mdnum grad` adds the term).",
            )
        )
    curved = [one for one in thresholds if one.order == 2]
    if curved:
        worst = max(curved, key=lambda one: abs(one.jumps[2]))
        found.append(
            finding(
                "CURVATURE_JUMP",
                "info",
                "the curvature jumps: energy and force are continuous",
                f"Between two {'-'.join(worst.species)} at {place(worst)} {units.length} the second "
                f"derivative of the energy jumps by {worst.jumps[2]:.4g} {units.curvature}. "
                f"{_others(curved, worst, units)}Runs and first derivatives are fine; vibrations and "
                "second derivatives are not, and an "
                "integrator of fourth order or higher loses its order here.",
                "Use a switch with two continuous derivatives if second derivatives are needed.",
            )
        )
    return found


def _others(same: Sequence[Threshold], worst: Threshold, units: Words) -> str:
    rest = [one for one in same if one is not worst]
    if not rest:
        return ""
    listed = ", ".join(f"{'-'.join(one.species)} {one.radius:.6g} {units.length}" for one in rest[:4])
    more = f" and {len(rest) - 4} more" if len(rest) > 4 else ""
    return f"So do {listed}{more}. "


def _among(around: Surroundings, thresholds: Sequence[Threshold]) -> list[Event]:
    return [one for one in around.events if one.threshold in thresholds and one.jump.order == 0]


def _unexplained(around: Surroundings, kT: float, units: Words) -> list[dict[str, str]]:
    events = unexplained(around.events)
    sharp = [one for one in events if one.jump.order <= 1]
    found: list[dict[str, str]] = []
    if sharp:
        worst = max(sharp, key=lambda one: (one.force, abs(one.jump.energy)))
        size = abs(worst.jump.energy) / kT if worst.jump.order == 0 else 0.0
        tie = ""
        if worst.ties:
            center, k = worst.ties[0]
            tie = f" There the {k}-th and the next neighbor of atom {center} are equally far."
        found.append(
            finding(
                "JUMP_AMONG_MANY",
                "error" if size > _LARGE else "warning",
                "something jumps among many atoms where no pair threshold is",
                f"On the way of {worst.route}, at {worst.at:.12g} {units.length}, the energy jumps by "
                f"{worst.jump.energy * units.scale:.4g} {units.small} and a force by {worst.force:.4g} "
                f"{units.force}; no distance is at a threshold that two atoms alone show.{tie} "
                f"{_count(len(sharp), 'such place')} on {_count(len(around.routes), 'route')}.",
                "Look for what depends on three atoms or on a number of neighbors: an angle's own cutoff, "
                "a cap, "
                "a choice of the nearest.",
            )
        )
    bent = [one for one in events if one.jump.order == 2]
    if bent:
        worst = max(bent, key=lambda one: abs(one.jump.curvature))
        found.append(
            finding(
                "CURVATURE_JUMP_AMONG_MANY",
                "info",
                "the curvature jumps among many atoms where no pair threshold is",
                f"On the way of {worst.route}, at {worst.at:.8g} {units.length}, by "
                f"{worst.jump.curvature:.4g} "
                f"{units.curvature}. {_count(len(bent), 'such place')}.",
                "Nothing to do for runs and first derivatives.",
            )
        )
    return found


def _caps(one: Crowd, kT: float, units: Words) -> list[dict[str, str]]:
    found: list[dict[str, str]] = []
    if one.kept:
        found.append(
            finding(
                "NEIGHBOR_CAP",
                "error",
                f"only the {one.kept} nearest neighbors are kept",
                f"An atom of {one.species} was given {one.neighbors} neighbors within {one.radius:.6g} "
                f"{units.length}. When another comes nearer than the {one.kept}-th of them (at "
                f"{one.distance:.6g} {units.length}), a force jumps by {one.force:.4g} {units.force} and the "
                f"energy by {one.energy * units.scale:.3g} {units.small} ({one.energy / kT:.2g} kT): "
                "neighbors "
                "inside the cutoff are dropped, and which ones changes abruptly.",
                f"Raise the cap above the most neighbors that ever come within {one.radius:.4g} "
                f"{units.length}, and "
                "make exceeding it an error.",
            )
        )
    if one.order_from:
        found.append(
            finding(
                "NEIGHBOR_CAP_BY_ORDER",
                "error",
                f"from {one.order_from} neighbors on, the energy depends on the order of the atoms",
                f"With {one.order_from} atoms of {one.species} around another within {one.radius:.6g} "
                f"{units.length}, permuting the atoms changes the energy by up to "
                f"{one.order_energy * units.scale:.4g} {units.small} ({one.order_energy / kT:.2g} kT) and "
                "a force "
                f"by {one.order_force:.4g} {units.force}; with {one.order_from - 1} it does not. Some "
                "neighbors "
                "are dropped, by their place in a list.",
                "Raise the largest number of neighbors, and make exceeding it an error.",
            )
        )
    return found


def _reach(walk: PairWalk, units: Words) -> list[dict[str, str]]:
    found: list[dict[str, str]] = []
    if walk.cutoff is None and np.abs(walk.energy).max() > 0:
        found.append(
            finding(
                "NO_CUTOFF",
                "info",
                f"{walk.pair.name} interact at every distance tried",
                f"At 30 {units.length} the two still feel one another: there is no cutoff to be crossed.",
            )
        )
    steep = _steepness(walk)
    if steep is not None and steep[0] > _STEEP:
        found.append(
            finding(
                "STEEP_SWITCH",
                "warning",
                "the interaction is switched off so steeply that it is nearly a step",
                f"Near {steep[1]:.4g} {units.length} the curvature of two {walk.pair.name} is "
                f"{steep[0]:.2g} times "
                "that at the bottom of their well: atoms that pass there feel a spring that much stiffer, "
                "and "
                "forces that no bond explains.",
                "Switch over a wider range, or choose a time step for this curvature.",
            )
        )
    if walk.left_out:
        found.append(
            finding(
                "MANY_KINKS",
                "info",
                "more places stand out than were looked at",
                f"Along {walk.pair.name}, {walk.left_out} more places stood out of the scan; a table that is "
                "interpolated with corners looks like this.",
            )
        )
    return found


def _steepness(walk: PairWalk) -> tuple[float, float] | None:
    """(largest curvature beyond the well over that at its bottom, where); None without a well."""
    curvature = -np.gradient(walk.force, walk.distance)
    bottom = int(np.argmin(walk.energy))
    if walk.energy[bottom] >= 0 or bottom < 2 or curvature[bottom] <= 0:
        return None
    # at a place where the force jumps, a difference is no curvature
    sharp = [one.radius for one in walk.thresholds if one.order <= 1]
    width = 2 * (walk.distance[1] - walk.distance[0])
    beyond = walk.distance > 1.1 * walk.distance[bottom]
    for radius in sharp:
        beyond &= np.abs(walk.distance - radius) > width
    if not beyond.any():
        return None
    worst = int(np.argmax(np.where(beyond, np.abs(curvature), 0.0)))
    return float(abs(curvature[worst]) / curvature[bottom]), float(walk.distance[worst])


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")
