"""Thresholds among many: triples and whole surroundings walked through what two atoms alone have shown.

What jumps for two atoms may jump otherwise among many (an embedding, an angle, a cap), and what is smooth
for two may not be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ase import Atoms
from ase.neighborlist import neighbor_list

from mdnum.audit.base import TIME_UP, Progress, Subject, TimeUp, meter_of
from mdnum.audit.jumps import SMOOTH, Jump, find_jumps, locate, measure
from mdnum.audit.probes import Pair, molecules, whole
from mdnum.audit.routes import Crossing, Route
from mdnum.audit.subject import CalculatorError
from mdnum.audit.threshold import Threshold
from mdnum.audit.thresholds import STEP, STEPS, walk_pairs

_SIDE = 1e-7
"""Half the stretch around an expected crossing in which it is located, length."""

_MOST_CROSSINGS = 2
"""Crossings of one threshold that are measured, each by another atom."""

_CROSSINGS = 4
"""Crossings of known thresholds in the structure that are measured, by 170 calls or so each."""

_ROUTES = 2
"""Through the structure, scanned for unknown thresholds by 430 calls or so each."""

_CUT_OUT = 40
"""Atoms of the structure that are kept where there are many."""

_MANY = 500
"""Atoms from which a part of the structure is walked through, and not all of it."""

_MOST_TRIPLES = 4
_LENGTH = 0.6
"""Of a route through the structure, length."""


@dataclass(frozen=True)
class Event:
    """A place on a route at which something jumps.

    Attributes:
        route: its name.
        at: place along it, length.
        jump: what jumps there; the force is the one along the route.
        force: largest change of the force on any atom, eV/Å.
        threshold: the pair threshold that explains it, None if none does.
        distance: at which the pair is then; nan without one.
        ties: (atom, k) whose k-th and next neighbors are equally far there.
    """

    route: str
    at: float
    jump: Jump
    force: float
    threshold: Threshold | None
    distance: float
    ties: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Surroundings:
    """What walks through surroundings told.

    Attributes:
        events: places at which something jumps.
        measured: crossings of known thresholds that were measured.
        routes: names of routes that were scanned for unknown ones.
        expected: crossings of known thresholds on those routes.
        skipped: (what, why).
        atoms: in the structure that was walked through; a part of the subject's where that has many.
        asked: crossings and routes that were walked, those on which the calculator failed included.
        possible: all of them.
    """

    events: tuple[Event, ...]
    measured: int
    routes: tuple[str, ...]
    expected: int
    skipped: tuple[tuple[str, str], ...]
    atoms: int
    asked: int = 0
    possible: int = 0


def walk_surroundings(
    subject: Subject, progress: Progress | None = None, crossings: int = _CROSSINGS, routes: int = _ROUTES
) -> Surroundings:
    """Walk triples, and atoms of the structure, through the known thresholds and look for unknown ones.

    Args:
        subject: the calculator and its structure.
        progress: called now and then.
        crossings: of known thresholds in the structure that are measured.
        routes: through the structure on which others are looked for.
    """
    walks = walk_pairs(subject).walks
    thresholds = [one for walk in walks for one in walk.thresholds if one.order < SMOOTH or one.dies]
    quantum = max((one.quantum for one in walks), default=(0.0, 0.0))
    single = bool(walks) and walks[0].pair.moves == "atom"
    atoms = subject.atoms
    groups = _groups(atoms, single)
    subject.forces(atoms)
    events: list[Event] = []
    skipped: list[tuple[str, str]] = []
    if len(atoms) > _MANY and walks:
        atoms = _cut_out(atoms, groups, walks[0].pair)
        groups = _groups(atoms, single)
        try:
            subject.forces(atoms)
        except CalculatorError as error:
            skipped.append((f"{_CUT_OUT} atoms cut out of the structure", error.message))
            atoms, groups = subject.atoms, _groups(subject.atoms, single)
    targeted = _targeted(atoms, thresholds, groups)
    if len(targeted) > crossings:
        more = len(targeted) - crossings
        skipped.append((f"{more} more crossings of known thresholds", f"{crossings} were measured"))
        targeted = targeted[:crossings]
    triples = _triples(subject) if single else []
    random = _random(atoms, groups, routes)
    total = len(targeted) + len(triples) + len(random)
    asked = 0
    for k, (route, crossing) in enumerate(targeted):
        if progress:
            progress(k, total, {"phase": "walking through the structure", "unit": "ways"})
        try:
            with meter_of(subject).limited():
                event = _at_crossing(subject, route, crossing)
            events += [] if _rounded(event, quantum) else [event]
        except CalculatorError as error:
            skipped.append((route.name, error.message))
        except TimeUp:
            skipped.append((route.name, TIME_UP))
            continue
        asked += 1
    measured = asked
    scanned: list[str] = []
    expected = 0
    for k, (route, low, high) in enumerate([*triples, *random]):
        if progress:
            progress(len(targeted) + k, total, {"phase": route.name, "unit": "ways"})
        try:
            with meter_of(subject).limited():
                found, known = _scanned(subject, route, thresholds, low, high)
        except TimeUp:
            skipped.append((route.name, TIME_UP))
            continue
        except CalculatorError as error:
            skipped.append((route.name, error.message))
            asked += 1
            continue
        asked += 1
        scanned.append(route.name)
        events += [one for one in found if not _rounded(one, quantum)]
        expected += known
    return Surroundings(
        tuple(events), measured, tuple(scanned), expected, tuple(skipped), len(atoms), asked, total
    )


def _groups(atoms: Atoms, single: bool) -> list[np.ndarray]:
    """What moves together: single atoms, or molecules where the calculator takes nothing less."""
    if single:
        return [np.array([k]) for k in range(len(atoms))]
    return molecules(atoms)


def _cut_out(atoms: Atoms, groups: Sequence[np.ndarray], pair: Pair) -> Atoms:
    """The groups nearest to the first, in one piece, in the surroundings of a pair; their order is kept."""
    center = _lead(atoms, groups[0])
    offsets = atoms.get_distances(center, np.arange(len(atoms)), mic=bool(atoms.pbc.any()), vector=True)
    nearest = np.argsort([np.linalg.norm(offsets[_lead(atoms, group)]) for group in groups])
    count = max(_CUT_OUT // max(len(groups[0]), 1), 4)
    chosen = [groups[k] for k in sorted(nearest[:count])]
    parts = [whole(atoms, group) for group in chosen]
    for part, group in zip(parts, chosen, strict=True):
        part.positions += offsets[_lead(atoms, group)] + pair.box / 2
    cut = Atoms(cell=[pair.box] * 3 if pair.box else None, pbc=pair.periodic)
    for part in parts:
        cut += part
    return cut


def _lead(atoms: Atoms, group: np.ndarray) -> int:
    return int(group[np.argmax(atoms.get_masses()[group])])


def _targeted(
    atoms: Atoms, thresholds: Sequence[Threshold], groups: Sequence[np.ndarray]
) -> list[tuple[Route, Crossing]]:
    """For each threshold, a few pairs of the structure near it, moved through it along their line."""
    of_lead = {_lead(atoms, group): group for group in groups}
    symbols = np.array(atoms.get_chemical_symbols())
    ranked: list[tuple[int, Route, Crossing]] = []
    for threshold in thresholds:
        first, second, distance, vector = neighbor_list("ijdD", atoms, threshold.radius + 1.0)
        one, other = threshold.species
        fits = (symbols[first] == one) & (symbols[second] == other) & (first != second)
        fits &= np.isin(first, list(of_lead)) & np.isin(second, list(of_lead))
        used: set[int] = set()
        for k in np.argsort(np.abs(distance - threshold.radius)):
            if not fits[k] or int(first[k]) in used or abs(distance[k] - threshold.radius) > 1.0:
                continue
            used.add(int(first[k]))
            direction = vector[k] / distance[k]
            route = Route(
                f"atom {first[k]} ({one}) toward {second[k]} ({other})",
                atoms, of_lead[int(first[k])], int(first[k]), direction,
            )  # fmt: skip
            crossing = Crossing(float(distance[k] - threshold.radius), int(second[k]), threshold)
            ranked.append((len(used), route, crossing))
            if len(used) == _MOST_CROSSINGS:
                break
    # the first of every threshold before the second of any
    return [(route, crossing) for _, route, crossing in sorted(ranked, key=lambda one: one[0])]


def _at_crossing(subject: Subject, route: Route, crossing: Crossing) -> Event:
    """What jumps where a known threshold is crossed, to the last representable place if a value does."""
    curve = route.curve(subject)
    low, high = crossing.at - _SIDE, crossing.at + _SIDE
    exact = crossing.threshold.order < 2
    if exact:
        low, high = locate(curve, crossing.threshold.order, low, high)
    jump = measure(curve, low, high, STEP, exact, curved=not exact)
    return _event(subject, route, jump, crossing)


def _event(subject: Subject, route: Route, jump: Jump, crossing: Crossing | None) -> Event:
    change = subject.forces(route.at(jump.high)) - subject.forces(route.at(jump.low))
    return Event(
        route.name, jump.at, jump, float(np.linalg.norm(change, axis=1).max()),
        crossing.threshold if crossing else None,
        crossing.threshold.radius if crossing else float("nan"),
        () if crossing else tuple(route.ties(jump.at)),
    )  # fmt: skip


def _scanned(
    subject: Subject, route: Route, thresholds: Sequence[Threshold], low: float, high: float
) -> tuple[list[Event], int]:
    """Unknown thresholds on a route, and how many known ones it crosses."""
    curve = route.curve(subject)
    crossings = route.crossings(thresholds, low - 1.0, high + 1.0)
    inside = [one for one in crossings if low <= one.at <= high]
    # crowded routes in finer steps, so that what lies between two crossings is seen
    step = float(np.clip((high - low) / (10 * len(inside) + 1), STEP / 10, STEP))
    jumps, _ = find_jumps(curve, low, high, step, most=6, expected=[one.at for one in crossings])
    unknown = [
        jump for jump in jumps if jump.order < SMOOTH and not any(_explains(one, jump) for one in crossings)
    ]
    return [_event(subject, route, jump, None) for jump in unknown], len(inside)


def _explains(crossing: Crossing, jump: Jump) -> bool:
    near = max(1e-6, 10 * crossing.threshold.located, jump.high - jump.low)
    return abs(jump.at - crossing.at) < near


def _triples(subject: Subject) -> list[tuple[Route, float, float]]:
    """A third atom brought toward one of a bonded pair, beside their line: (route, from, to)."""
    found: list[tuple[Route, float, float]] = []
    for walk in walk_pairs(subject).walks[:_MOST_TRIPLES]:
        lowest = int(np.argmin(walk.energy))
        bond = float(walk.distance[lowest])
        end = min((walk.cutoff or 8.0) + bond, 12.0)
        one, other = walk.pair.species
        side = np.radians(110.0)
        atoms = Atoms(
            [one, other, other],
            [(0, 0, 0), (bond * np.cos(side), bond * np.sin(side), 0), (0, 0, 0)],
        )
        if walk.pair.box:
            atoms.set_cell([walk.pair.box] * 3)
            atoms.positions += walk.pair.box / 2  # what lies outside of a box may be lost
        atoms.pbc = walk.pair.periodic
        route = Route(
            f"a third atom ({other}) toward {one}-{other}", atoms, np.array([2]), 2, np.array([1.0, 0.0, 0.0])
        )
        low = max(float(walk.distance[0]), 0.8 * bond) + 6 * STEP
        found.append((route, low, end))
    return found


def _random(atoms: Atoms, groups: Sequence[np.ndarray], count: int) -> list[tuple[Route, float, float]]:
    """Routes of so many atoms in arbitrary directions."""
    rng = np.random.default_rng(0)
    found: list[tuple[Route, float, float]] = []
    for k in rng.permutation(len(groups))[:count]:
        direction = rng.normal(size=3)
        lead = _lead(atoms, groups[k])
        name = f"atom {lead} ({atoms.get_chemical_symbols()[lead]}) in some direction"
        route = Route(name, atoms, groups[k], lead, direction / np.linalg.norm(direction))
        found.append((route, -_LENGTH / 2, _LENGTH / 2))
    return found


def unexplained(events: Sequence[Event]) -> list[Event]:
    """Events that no pair threshold explains and that jump beyond doubt."""
    return [one for one in events if one.threshold is None and one.jump.order < SMOOTH]


def _rounded(event: Event, quantum: tuple[float, float]) -> bool:
    """Whether an event is no more than a step of answers that are rounded to decimals."""
    if not any(quantum):
        return False
    return event.jump.order > 1 or (
        abs(event.jump.energy) <= STEPS * quantum[0] and event.force <= STEPS * quantum[1]
    )
