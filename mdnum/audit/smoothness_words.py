"""What the walks through thresholds found, in words: findings with evidence and remedy, and a sentence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mdnum.audit.crowd_words import Words, caps, count, reach
from mdnum.audit.environments import Event, Surroundings, unexplained
from mdnum.audit.jumps import SMOOTH
from mdnum.audit.provoke import Crowd
from mdnum.audit.threshold import Threshold
from mdnum.audit.thresholds import BESIDE, PairWalks
from mdnum.references.findings import finding

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


def kind(threshold: Threshold) -> str:
    """What a threshold is, in a few words."""
    return "the interaction ends" if threshold.dies else "the law changes"


def order_of(event: Event) -> str:
    """The lowest derivative that jumps at an event; where none up to the curvature does, that of the pair."""
    order = event.jump.order
    if order == SMOOTH and event.threshold:
        order = max(order, event.threshold.order)
    return ORDERS[order]


def two(threshold: Threshold) -> str:
    """Who passes a threshold."""
    one, other = threshold.species
    return f"two {one} atoms" if one == other else f"{one} and {other}"


def place(threshold: Threshold) -> str:
    """Its distance, with as many digits as are known."""
    if threshold.located < 1e-12:
        return repr(threshold.radius)
    digits = int(np.clip(np.ceil(-np.log10(threshold.located)), 1, 15))
    return f"{threshold.radius:.{digits}f}"


def summary(walks: PairWalks, around: Surroundings, crowds: Sequence[Crowd], kT: float, units: Words) -> str:
    """One or two sentences with the numbers."""
    thresholds = [one for walk in walks.walks for one in walk.thresholds]
    of = f" of {len(walks.walks) + len(walks.not_walked)}" if walks.not_walked else ""
    found = f"Walking {len(walks.walks)}{of} pairs of species found {count(len(thresholds), 'threshold')}"
    if len(walks.walks) == 1 and not of:
        one = walks.walks[0].pair.name.split("-")[0]
        found = f"Walking two {one} found {count(len(thresholds), 'threshold')}"
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
        if order > SMOOTH:
            tail += ", at an end (within the range a change is seen up to the third derivative)"
        if order == 0:
            tail = (
                f"the energy jumps by up to {energy * units.scale:.3g} {units.small} ({energy / kT:.2g} kT)"
            )
        elif order == 1:
            tail = f"the energy is continuous and the force jumps by up to {force:.3g} {units.force}"
    if knots := max((walk.knots for walk in walks.walks), default=0):
        tail += f"; a third derivative jumps at {knots} places or more, as between the points of a table"
    capped = [one for one in crowds if one.kept or one.order_from]
    if capped:
        kept = min(one.kept or (one.order_from or 1) - 1 for one in capped)
        tail += f"; an atom keeps {kept} neighbors and drops the rest"
    elif crowds:
        tail += f"; {max(one.neighbors for one in crowds)} neighbors at once are all kept"
    missing = f" Not walked: {', '.join(walks.not_walked)}." if walks.walks and walks.not_walked else ""
    return f"{found}; {tail}.{missing}{_least(walks, units)}"


def _least(walks: PairWalks, units: Words) -> str:
    """How small a step of the force can be that escapes."""
    seen = [walk.steps for walk in walks.walks if walk.steps]
    if not seen:
        return ""
    low, half, everywhere = (max(one[k] for one in seen) for k in (0, 2, 3))
    high = min(one[1] for one in seen)
    if not low < high:
        return ""
    known = (
        f", but for {BESIDE:g} {units.length} beside a threshold"
        if any(w.thresholds for w in walks.walks)
        else ""
    )
    return (
        f" A step of the force above {_rounded_up(everywhere)} {units.force} would have shown anywhere from "
        f"{low:.3g} to {high:.3g} {units.length}{known}; one above {_rounded_up(half)} over half of that."
    )


def _rounded_up(value: float) -> str:
    """One digit that does not promise more than is known."""
    digit = 10.0 ** np.floor(np.log10(value))
    return f"{np.ceil(value / digit) * digit:.1g}"


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
    found += _unexplained(around, kT, units, walks.not_walked)
    found += [one for crowded in crowds for one in caps(crowded, kT, units)]
    found += [one for walk in walks.walks for one in reach(walk, units, kT)]
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
                f"{_first_up(two(worst))} at {worst.inside!r} and at {worst.outside!r} "
                f"{units.length}, the "
                f"next representable distance, differ by {worst.jumps[0] * units.scale:.6g} {units.small} "
                f"({abs(worst.jumps[0]) / kT:.2g} kT); the force jumps by {worst.jumps[1]:.4g} {units.force}."
                f"{among} {_others(steps, worst, units)}No force stands for this energy: every crossing "
                "changes the energy of a run, and no derivative through the run sees the crossing.",
                "Shift the energy and the force to zero at the cutoff, or switch the interaction off over "
                "the last part of its range.",
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
                f"Between {two(worst)} at {worst.inside!r} and at {worst.outside!r} "
                f"{units.length} the force jumps by {worst.jumps[1]:.6g} {units.force}, the energy by no "
                "more than "
                f"rounding. {_others(bends, worst, units)}A run keeps its energy; a derivative through it "
                "misses a term at every crossing, an error that a smaller time step does not lessen.",
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
                f"Between {two(worst)} at {place(worst)} {units.length} the second "
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


def _unexplained(
    around: Surroundings, kT: float, units: Words, not_walked: Sequence[str]
) -> list[dict[str, str]]:
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
        if not_walked:
            tie += f" It may be a threshold of a pair that was not walked: {', '.join(not_walked)}."
        found.append(
            finding(
                "JUMP_AMONG_MANY",
                "error" if size > _LARGE else "warning",
                "something jumps among many atoms where no pair threshold is",
                f"On the way of {worst.route}, at {worst.at:.12g} {units.length}, the energy jumps by "
                f"{worst.jump.energy * units.scale:.4g} {units.small} and a force by {worst.force:.4g} "
                f"{units.force}; no distance is at a threshold that two atoms alone show.{tie} "
                f"{count(len(sharp), 'such place')} on {count(len(around.routes), 'route')}.",
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
                f"{units.curvature}. {count(len(bent), 'such place')}.",
                "Nothing to do for runs and first derivatives.",
            )
        )
    return found


def _first_up(text: str) -> str:
    return text[:1].upper() + text[1:]
