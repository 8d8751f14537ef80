"""Check the smoothness of the energy at distance thresholds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from functools import partial
from typing import Any

import numpy as np

from mdnum.audit.base import AuditCheck, Chart, CheckResult, Observed, Progress, TimeUp, finding
from mdnum.audit.curve import SMOOTH
from mdnum.audit.structures import FARTHEST
from mdnum.audit.subject import CalculatorSubject
from mdnum.audit.surroundings import Crowd, EnvironmentWalks, Event, crowd, walk_surroundings
from mdnum.audit.thresholds import BESIDE, PairThreshold, PairWalk, PairWalks, find_thresholds, walk_pairs
from mdnum.units import ENERGY, FORCE, LENGTH, Measured

ORDERS = (
    "energy", "force", "curvature", "third derivative", "fourth derivative", "fifth derivative",
    "none up to the fifth",
)  # fmt: skip
_ULPS = 12  # representable distances shown on either side of a jump
_DRAWN = 4
#: Energy jumps above the first number (in kT) are errors: a thousand of them in one direction add up to one
#: kT. Energy jumps below the second number, and force jumps below this number of kT per unit of length, are
#: information.
_LARGE, _SMALL, _SMALL_FORCE = 1e-3, 1e-7, 1e-5
_STEEP = 5.0  # a switch whose curvature is this many times that of the well is what limits the time step


#: Codes that report a jump of the energy, and a jump of the force only.
_ENERGY = ("ENERGY_JUMP", "CUTOFF_JUMP_AMONG_MANY", "JUMP_AMONG_MANY", "NEIGHBOR_CAP")
_FORCE = ("FORCE_JUMP", "NEIGHBOR_CAP_BY_ORDER", "ORDER")


class SmoothnessCheck(AuditCheck):
    """Is the energy smooth at all distances that atoms reach, and if not, which derivative jumps where?"""

    name, title, order, calls = "smoothness", "Smoothness", 50, 2100
    needed_to = ("differentiate",)
    #: Number of neighbors of a crowded central atom, and number of paths through the structure that are
    #: scanned.
    neighbors, routes = 160, 2

    def ask(self, subject: CalculatorSubject, progress: Progress) -> CheckResult:
        """Move pairs and triples of atoms through thresholds, and test atoms with many neighbors."""
        walks = walk_pairs(subject, progress)
        if not walks.walks and subject.meter.deadline.passed:
            raise TimeUp
        find_thresholds(subject)
        ways = deepcopy(walks.ways)
        left = len(ways.skipped)
        crowds = crowd(subject, progress, ways, self.neighbors)
        if not crowds and len(ways.skipped) == left:
            ways.skip("caps on the number of neighbors", "the calculator takes no crowd of single atoms")
        around = walk_surroundings(subject, progress, ways, routes=self.routes)
        kT = subject.kT
        says, numbers = figures(walks, around, crowds, kT)
        return CheckResult(
            says=says,
            findings=[
                *_jumps(walks, around, kT),
                *_at_cutoff(around, kT),
                *_among_many(around, kT, walks.not_walked),
                *_logged(subject, walks),
                *(one for crowded in crowds for one in _caps(crowded, kT)),
                *(one for walk in walks.walks for one in reach(walk, kT)),
            ],
            tables=_tables(walks, around, crowds, kT),
            charts=_charts(walks, subject),
            numbers=numbers,
            limits={
                "largest_energy_jump": (_SMALL * kT, _ENERGY),
                "largest_force_jump": (_SMALL_FORCE * kT, (*_ENERGY, *_FORCE)),
            },
            **vars(ways),
        )


def _all(walks: PairWalks) -> list[PairThreshold]:
    return [one for walk in walks.walks for one in walk.thresholds]


_energy, _length = partial(Measured, unit="energy"), partial(Measured, unit="length")


def place(threshold: PairThreshold) -> Measured:
    """Return a distance threshold with its uncertainty and its unit."""
    return _length(threshold.radius, floor=threshold.located)


def _two(threshold: PairThreshold) -> str:
    one, other = threshold.species
    return f"two {one} atoms" if one == other else f"{one} and {other}"


def figures(
    walks: PairWalks, around: EnvironmentWalks, crowds: Sequence[Crowd], kT: float
) -> tuple[tuple[list[str], dict[str, Any]], dict[str, Any]]:
    """Return the text about thresholds, its values, and numbers for the summary."""
    # (lowest derivative that jumps, jump of the energy, of the force) wherever something does
    seen = [(one.order, *one.jumps[:2]) for one in _all(walks)]
    seen += [(one.jump.order, one.jump.energy, one.force) for one in around.events]
    step = max((abs(energy) for order, energy, _ in seen if order == 0), default=0.0)
    force = max((abs(force) for order, _, force in seen if order <= 1), default=0.0)
    numbers = {
        "pairs": len(walks.walks), "pairs_not_walked": list(walks.not_walked), "thresholds": len(_all(walks)),
        "cutoffs": {"-".join(walk.pair.species): walk.cutoff for walk in walks.walks},
        "order": min((order for order, *_ in seen), default=None), "largest_energy_jump": step,
        "largest_energy_jump_kT": step / kT if kT else None,
        "largest_force_jump": max([force, *(max(one.force, one.order.force) for one in crowds)]),
        "crossings_measured": around.measured,
        "force_steps_seen": max((walk.steps[3] for walk in walks.walks if walk.steps), default=None),
        "routes": len(around.routes), "unexplained": sum(one.threshold is None for one in around.events),
        "neighbors_kept": min((one.kept for one in crowds if one.kept), default=None),
        "order_matters_from": min((one.order.start for one in crowds if one.order.start), default=None),
        "neighbors_tried": max((one.neighbors for one in crowds), default=0),
    }  # fmt: skip
    # what is smooth up to the fifth derivative is not said to jump
    order = min((order for order, *_ in seen if order <= 5), default=None)
    knots = max((walk.knots for walk in walks.walks), default=0)
    capped = [one.kept for one in crowds if one.kept and one.by_number]
    capped += [one.order.start - 1 for one in crowds if one.order.start and one.order.by_number]
    dropped = any(one.kept or one.order.start for one in crowds)
    cutoffs = sorted({f"{walk.cutoff:.6g}" for walk in walks.walks if walk.cutoff})
    worst = {None: "nothing", 0: "energy", 1: "force"}.get(order, "derivative")
    says = ["walked" if walks.walks else "not_walked"]
    values: dict[str, Any] = numbers | {
        "of": len(walks.walks) + len(walks.not_walked), "cutoffs": ", ".join(cutoffs),
        "energy": _energy(step), "kT": numbers["largest_energy_jump_kT"], "force": force,
        "kept": min(capped, default=0),
        "derivative": ORDERS[order] if order is not None else "", "not_walked": ", ".join(walks.not_walked),
        "neighbors": numbers["neighbors_tried"], "knots": knots,
    }  # fmt: skip
    says += ["ends"] if cutoffs else []
    says.append(f"jumps_{worst}" if order is None or order <= SMOOTH else "jumps_at_an_end")
    says += ["knots"] if knots else []
    says += ["capped"] if capped else ["crowded"] if crowds and not dropped else []
    says += ["missing"] if walks.walks and walks.not_walked else []
    # how small a step of the force can be that escapes
    if steps := [walk.steps for walk in walks.walks if walk.steps]:
        low, half, everywhere = (max(one[k] for one in steps) for k in (0, 2, 3))
        high = min(one[1] for one in steps)
        if low < high:
            says += ["least", "least_but"] if _all(walks) else ["least"]
            half, everywhere = _rounded_up(half), _rounded_up(everywhere)
            values |= {"low": low, "high": high, "beside": BESIDE, "half": half, "everywhere": everywhere}
    return ([f"smoothness_{one}" for one in says], values), numbers


def _rounded_up(value: float) -> float:
    """Round a detection limit upward to one significant digit."""
    digit = 10.0 ** np.floor(np.log10(value))
    return float(np.ceil(value / digit) * digit)


def _jumps(walks: PairWalks, around: EnvironmentWalks, kT: float) -> Iterator[Observed]:
    """Yield findings about thresholds, by the lowest derivative of the energy that jumps."""
    for order, code in enumerate(("ENERGY_JUMP", "FORCE_JUMP", "CURVATURE_JUMP")):
        same = [one for one in _all(walks) if one.order == order]
        if not same:
            continue
        worst = max(same, key=lambda one: abs(one.jumps[order]))
        rest = [f"{'-'.join(one.species)} {one.radius:.6g} {LENGTH}" for one in same if one is not worst]
        more = f" and {len(rest) - 4} more" if len(rest) > 4 else ""
        size, severity = abs(worst.jumps[order]) / kT, "info"
        values: dict[str, Any] = {
            "two": _two(worst), "inside": _length(worst.inside), "outside": _length(worst.outside),
            "at": place(worst), "energy": _energy(worst.jumps[0], scale=kT), "kT": size,
            "force": worst.jumps[1], "curvature": worst.jumps[2], "others": ", ".join(rest[:4]) + more,
        }  # fmt: skip
        among: list[float] = []
        if order == 0:
            events = (one for one in around.events if one.threshold in same and one.jump.order == 0)
            among = [abs(one.jump.energy) for one in events]
            most = max(among, default=0.0)
            values |= {"among": _energy(most, scale=kT), "among_kT": most / kT}
            size = max(size, most / kT)
            severity = "error" if size > _LARGE else "warning" if size > _SMALL else "info"
        elif order == 1:
            severity = "warning" if size > _SMALL_FORCE else "info"
        variants = None if worst.dies else "within", "among" if among else None, "others" if rest else None
        yield finding(code, severity, *variants, **values)


def _at_cutoff(around: EnvironmentWalks, kT: float) -> Iterator[Observed]:
    """Yield a finding if the energy of many atoms is less smooth than that of two."""
    if not around.lower:
        return
    worst = min(
        around.lower,
        key=lambda one: (one.jump.order, -abs(one.jump.energy) * (not one.jump.order), -one.force),
    )
    threshold = worst.threshold
    assert threshold is not None
    energy = abs(worst.jump.energy) if worst.jump.order == 0 else 0.0
    large = energy > _SMALL * kT or worst.force > _SMALL_FORCE * kT
    yield finding(
        "CUTOFF_JUMP_AMONG_MANY",
        "error" if energy > _LARGE * kT else "warning" if large else "info",
        None if worst.jump.order == 0 else "force",
        tests=("alone",), two=_two(threshold), at=place(threshold), route=worst.route, force=worst.force,
        energy=_energy(energy, scale=kT), kT=energy / kT, alone=ORDERS[threshold.order],
        measured=around.measured, places=len(around.lower),
    )  # fmt: skip


def _logged(subject: CalculatorSubject, walks: PairWalks) -> Iterator[Observed]:
    """Yield a finding if `energy` jumps at a threshold and `free_energy` does not. A run logs `energy`."""
    jumps: list[tuple[float, float, str, str]] = []
    for walk in walks.walks:
        for one in walk.thresholds:
            sides = [subject.energies(walk.pair.at(at)) for at in (one.inside, one.outside)]
            before, after = (np.nan if other is None else other - free for free, other in sides)
            at, by = f"{one.radius:.8g} {LENGTH}", f"{abs(after - before):.3g} {ENERGY}"
            where = f"between {walk.pair.name} at {at}, by {by}"
            jumps.append((after - before, before, walk.pair.name, where))
    kT = subject.kT
    if wrong := [one for one in jumps if abs(one[0]) > _LARGE * (kT or 1.0)]:
        change, offset, pair, _ = max(wrong, key=lambda one: abs(one[0]))
        values = {"formula": pair, "offset": offset, "change": change, "kT": abs(change) / kT if kT else None}
        places = "; ".join(where for *_, where in wrong)
        yield finding("TWO_ENERGIES", "error", "wrong", places=places, **values)


def _among_many(around: EnvironmentWalks, kT: float, not_walked: Sequence[str]) -> Iterator[Observed]:
    if sharp := [one for one in around.unexplained if one.jump.order <= 1]:
        worst = max(sharp, key=lambda one: (one.force, abs(one.jump.energy)))
        size = abs(worst.jump.energy) / kT if worst.jump.order == 0 else 0.0
        center, k = worst.ties[0] if worst.ties else (None, None)
        yield finding(
            "JUMP_AMONG_MANY", "error" if size > _LARGE else "warning",
            "tie" if worst.ties else None, "not_walked" if not_walked else None,
            route=worst.route, at=_length(worst.at), energy=_energy(worst.jump.energy), force=worst.force,
            k=k, atom=center, not_walked=", ".join(not_walked), places=len(sharp), routes=len(around.routes),
        )  # fmt: skip
    if bent := [one for one in around.unexplained if one.jump.order == 2]:
        worst = max(bent, key=lambda one: abs(one.jump.curvature))
        values = {"route": worst.route, "at": _length(worst.at), "curvature": worst.jump.curvature}
        yield finding("CURVATURE_JUMP_AMONG_MANY", "info", places=len(bent), **values)


def _caps(one: Crowd, kT: float) -> Iterator[Observed]:
    """Yield findings about atoms with many neighbors."""
    values: dict[str, Any] = {"species": one.species, "radius": one.radius}
    if one.kept:
        values |= {"kept": one.kept, "distance": one.distance, "force": one.force}
        values |= {"energy": _energy(one.energy), "kT": one.energy / kT, "neighbors": one.neighbors}
        energy = "energy" if one.energy else None
        if one.by_number:
            yield finding("NEIGHBOR_CAP", "error", energy, tests=("repeat", "in range"), **values)
        else:
            yield finding("JUMP_AMONG_MANY", "warning", "crowd", energy, **values)
    if start := one.order.start:
        values |= {"neighbors": start, "fewer": start - 1, "force": one.order.force, "slug": ""}
        values |= {"energy": _energy(one.order.energy), "kT": one.order.energy / kT}
        forces = None if one.order.energy else "forces"
        if one.order.by_number:
            tests = ("repeat", "place", "in range")
            yield finding("NEIGHBOR_CAP_BY_ORDER", "error", forces, tests=tests, **values)
        else:
            yield finding("ORDER", "error", "crowd", forces and "crowd_forces", **values)


def reach(walk: PairWalk, kT: float) -> Iterator[Observed]:
    """Yield findings on a pair: no cutoff, a steep switching function, unexamined distances."""
    further = walk.further
    if walk.cutoff is None and np.abs(walk.energy).max() > 0:
        # what was searched for an end, and no more
        how = "not_further"
        if further is not None:
            how = "lost" if not further.left else "falls" if np.isfinite(further.left) else "constant"
        yield finding(
            "NO_CUTOFF", "info", how, pair=walk.pair.name, scanned=walk.scanned, farthest=FARTHEST,
            reached=further.reached if further else None, force=abs(further.force) if further else None,
            left=further and _energy(further.left), kT=further.left / kT if further and kT else None,
        )  # fmt: skip
    steep = _steepness(walk)
    if steep is not None and steep[0] > _STEEP:
        yield finding("STEEP_SWITCH", "warning", pair=walk.pair.name, times=steep[0], at=steep[1])
    if walk.left_out:
        yield finding("MANY_KINKS", "info", pair=walk.pair.name, places=walk.left_out)


def _steepness(walk: PairWalk) -> tuple[float, float] | None:
    """Return (largest curvature / curvature at the minimum, distance of the largest curvature)."""
    curvature = -np.gradient(walk.force, walk.distance)
    bottom = int(np.argmin(walk.energy))
    if walk.energy[bottom] >= 0 or bottom < 2 or curvature[bottom] <= 0:
        return None
    width = 2 * (walk.distance[1] - walk.distance[0])
    beyond = walk.distance > 1.1 * walk.distance[bottom]
    for one in walk.thresholds:
        if one.order <= 1:  # at a place where the force jumps, a difference is no curvature
            beyond &= np.abs(walk.distance - one.radius) > width
    if not beyond.any():
        return None
    worst = int(np.argmax(np.where(beyond, np.abs(curvature), 0.0)))
    return float(abs(curvature[worst]) / curvature[bottom]), float(walk.distance[worst])


def _first_to_jump(event: Event) -> str:
    """Return the name of the lowest derivative of the energy that jumps."""
    order = event.jump.order
    return ORDERS[max(order, event.threshold.order) if order == SMOOTH and event.threshold else order]


def _tables(
    walks: PairWalks, around: EnvironmentWalks, crowds: Sequence[Crowd], kT: float
) -> dict[str, list[dict[str, Any]]]:
    thresholds = [
        {
            "pair": "-".join(one.species), f"distance ({LENGTH})": place(one).digits,
            "what": "the end" if one.dies else "a change", "first to jump": ORDERS[one.order],
            f"energy (m{ENERGY})": 1e3 * one.jumps[0] if one.order == 0 else 0.0,
            "in kT": abs(one.jumps[0]) / kT if one.order == 0 else 0.0,
            f"force ({FORCE})": one.jumps[1] if one.order <= 1 else 0.0,
            f"curvature ({FORCE}²)": one.jumps[2] if one.order <= 2 else 0.0,
            f"third derivative ({FORCE}³)": one.third or None,
            "last before": repr(one.inside), "first beyond": repr(one.outside),
        }
        for one in _all(walks)
    ]  # fmt: skip
    events = [
        {
            "moved": one.route,
            f"pair distance ({LENGTH})": f"{one.threshold.radius:.10g}" if one.threshold else "none fits",
            "first to jump": _first_to_jump(one),
            f"energy (m{ENERGY})": 1e3 * one.jump.energy if one.jump.order == 0 else 0.0,
            "in kT": abs(one.jump.energy) / kT if one.jump.order == 0 else 0.0,
            f"largest force ({FORCE})": one.force if one.jump.order <= 1 else 0.0,
            f"curvature ({FORCE}²)": one.jump.curvature if one.jump.order == 2 else None,
        }
        for one in around.events
    ]
    steps = [
        {
            "pair": "-".join(walk.pair.species), f"from ({LENGTH})": walk.steps[0],
            f"to ({LENGTH})": walk.steps[1], f"everywhere, above ({FORCE})": walk.steps[3],
            f"over half of the way, above ({FORCE})": walk.steps[2],
        }
        for walk in walks.walks
        if walk.steps
    ]  # fmt: skip
    crowded = [
        {
            "element": one.species, "neighbors given": one.neighbors, f"within ({LENGTH})": one.radius,
            "nearest that are kept": one.kept, "order of atoms matters from": one.order.start,
            f"energy (m{ENERGY})": 1e3 * max(one.energy, one.order.energy),
            f"force ({FORCE})": max(one.force, one.order.force),
        }
        for one in crowds
    ]  # fmt: skip
    return {
        "Thresholds found by walking pairs": thresholds,
        "The same among the others of the structure, and what only shows there": events,
        "Smallest step of the force that is found": steps,
        "Crowded atoms": crowded,
    }


def _charts(walks: PairWalks, subject: CalculatorSubject) -> list[Chart]:
    found: list[Chart] = []
    for walk in walks.walks[:_DRAWN]:
        found.append(_energies(walk, subject.kT))
        sharp = [one for one in walk.thresholds if one.order <= 1]
        found += [_close_up(walk, one, subject) for one in sharp[:1]]
    return found


def _energies(walk: PairWalk, kT: float) -> Chart:
    """Chart of the pair energy. Large energies are omitted, so that jumps at thresholds are visible."""
    depth = max(-float(walk.energy.min()), 2 * kT)
    shown = walk.energy < 2 * depth
    first = len(shown) - int(np.argmin(shown[::-1])) if not shown.all() else 0
    marks = {
        f"the {'interaction ends' if one.dies else 'law changes'} at {one.radius:.6g} {LENGTH}": one.radius
        for one in walk.thresholds[-4:]
    }
    title, lines = f"Two particles: {walk.pair.name}", {"energy": walk.energy[first:].tolist()}
    labels = title, f"distance ({LENGTH})", f"energy ({ENERGY})"
    return Chart(*labels, walk.distance[first:].tolist(), lines, marks)


def _close_up(walk: PairWalk, threshold: PairThreshold, subject: CalculatorSubject) -> Chart:
    """Chart of the energy or force near a jump, at adjacent floating-point distances."""
    below, above = [threshold.inside], [threshold.outside]
    for _ in range(_ULPS - 1):
        below.append(float(np.nextafter(below[-1], -np.inf)))
        above.append(float(np.nextafter(above[-1], np.inf)))
    row = threshold.order
    values = walk.pair.curve(subject).many([*below[::-1], *above])[row]
    what, unit = (("energy", ENERGY), ("force", FORCE))[row]
    return Chart(
        f"{walk.pair.name} at {threshold.outside!r} {LENGTH}, distance by representable distance",
        "representable distances from the jump",
        f"{what} ({unit})",
        [*np.arange(-_ULPS, 0.0), *np.arange(0.0, _ULPS)],
        {what: (values - (values[-1] if row == 0 else 0.0)).tolist()},
    )
