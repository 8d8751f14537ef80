"""Thresholds among many: triples and whole surroundings walked through what two atoms alone have shown.

What jumps for two atoms may jump otherwise among many (an embedding, an angle, a cap), and what is smooth
for two may not be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from ase import Atoms
from ase.neighborlist import neighbor_list
from jaxtyping import Float, Int

from mdnum.audit.base import Progress
from mdnum.audit.check import ask_each
from mdnum.audit.curve import SMOOTH, Curve, Jump, find_jumps, locate, measure
from mdnum.audit.pairs import Pair, molecules, whole
from mdnum.audit.subject import CalculatorError, CalculatorSubject
from mdnum.audit.thresholds import STEP, STEPS, PairThreshold, walk_pairs

#: Half the stretch around an expected crossing in which it is located, length.
_SIDE = 1e-7
#: Crossings of one threshold that are measured, each by another atom.
_MOST_CROSSINGS = 2
#: Crossings of known thresholds in the structure that are measured, by 170 calls or so each.
_CROSSINGS = 4
#: Through the structure, scanned for unknown thresholds by 430 calls or so each.
_ROUTES = 2
#: Of a structure of more atoms than the second, so many are kept to be walked through.
_CUT_OUT, _MANY = 40, 500
_MOST_TRIPLES = 4
#: Of a route through the structure, length.
_LENGTH = 0.6
#: Two distances this near to one another are tied, length.
_TIED = 1e-6


@dataclass(frozen=True)
class RouteCrossing:
    """A place on a route at which a distance passes a threshold.

    Attributes:
        at: along the route, length.
        other: the atom whose distance it is.
    """

    at: float
    other: int
    threshold: PairThreshold


@dataclass(frozen=True)
class Route:
    """A structure in which some atoms move along a line.

    Attributes:
        atoms: the structure at 0.
        moving: atoms that move together.
        lead: the one of them whose distances are watched.
        direction: unit vector.
    """

    name: str
    atoms: Atoms
    moving: Int[np.ndarray, "moving"]
    lead: int
    direction: Float[np.ndarray, "3"]

    def at(self, along: float) -> Atoms:
        """The structure with those atoms moved."""
        atoms = self.atoms.copy()
        atoms.positions[self.moving] += along * self.direction
        return atoms

    def curve(self, subject: CalculatorSubject) -> Curve:
        """Energy, and force along the line on what moves."""

        def at(along: float) -> tuple[float, float]:
            atoms = self.at(along)
            energy = subject.energy(atoms)
            return energy, float((subject.forces(atoms)[self.moving] @ self.direction).sum())

        return Curve(at)

    def crossings(self, thresholds: Sequence[PairThreshold], low: float, high: float) -> list[RouteCrossing]:
        """Every place between low and high at which the lead's distance to an atom passes a threshold.

        The distance along a line is a hyperbola, so the places are roots of a quadratic.
        """
        found: list[RouteCrossing] = []
        symbols = self.atoms.get_chemical_symbols()
        for threshold in thresholds:
            reach = threshold.radius + max(abs(low), abs(high))
            for other, vector in self._others(reach):
                if sorted((symbols[self.lead], symbols[other])) != sorted(threshold.species):
                    continue
                toward = float(vector @ self.direction)
                rest = toward**2 - float(vector @ vector) + threshold.radius**2
                if rest <= 0:
                    continue
                for root in (toward - np.sqrt(rest), toward + np.sqrt(rest)):
                    if low < root < high:
                        found.append(RouteCrossing(float(root), other, threshold))
        return sorted(found, key=lambda one: one.at)

    def _others(self, reach: float) -> list[tuple[int, Float[np.ndarray, "3"]]]:
        """(atom, vector from the lead to it or an image) within reach, without those that move along."""
        atoms = self.atoms
        counts = [0, 0, 0]
        if atoms.pbc.any():
            heights = 1.0 / np.linalg.norm(np.linalg.inv(np.asarray(atoms.cell.complete())), axis=0)
            counts = [
                int(np.ceil(reach / h)) + 1 if yes else 0 for h, yes in zip(heights, atoms.pbc, strict=True)
            ]
        shifts = np.array(list(product(*(range(-n, n + 1) for n in counts)))) @ atoms.cell.array
        rest = np.setdiff1d(np.arange(len(atoms)), self.moving)
        vectors = atoms.positions[rest][:, None] - atoms.positions[self.lead] + shifts[None]
        near = np.linalg.norm(vectors, axis=2) < reach
        return [(int(rest[a]), vectors[a, b]) for a, b in np.argwhere(near)]

    def ties(self, along: float) -> list[tuple[int, int]]:
        """(atom, k) where, at a place, an atom's k-th and (k+1)-th neighbors are equally far."""
        atoms = self.at(along)
        found: list[tuple[int, int]] = []
        for center, row in enumerate(atoms.get_all_distances(mic=bool(atoms.pbc.any()))):
            others = np.sort(np.delete(row, center))
            for k in np.flatnonzero(np.diff(others) < _TIED):
                if center == self.lead or abs(others[k] - row[self.lead]) < _TIED:
                    found.append((center, int(k) + 1))
        return found


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
    threshold: PairThreshold | None
    distance: float
    ties: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class EnvironmentWalks:
    """What walks through surroundings found.

    Attributes:
        events: places at which something jumps.
        measured: crossings of known thresholds that were measured.
        routes: names of routes that were scanned for unknown ones.
        skipped: (what, why).
        asked: crossings and routes that were walked, those on which the calculator failed included.
        possible: all of them.
    """

    events: tuple[Event, ...]
    measured: int
    routes: tuple[str, ...]
    skipped: tuple[tuple[str, str], ...]
    asked: int = 0
    possible: int = 0

    @property
    def unexplained(self) -> list[Event]:
        """Events that no pair threshold explains and that jump beyond doubt."""
        return [one for one in self.events if one.threshold is None and one.jump.order < SMOOTH]


def walk_surroundings(
    subject: CalculatorSubject, progress: Progress, crossings: int = _CROSSINGS, routes: int = _ROUTES
) -> EnvironmentWalks:
    """Walk triples, and atoms of the structure, through the known thresholds and search for unknown ones.

    Args:
        crossings: of known thresholds in the structure that are measured.
        routes: through the structure on which others are searched.
    """
    walks = walk_pairs(subject).walks
    thresholds = [one for walk in walks for one in walk.thresholds if one.order < SMOOTH or one.dies]
    quantum = max((one.quantum for one in walks), default=(0.0, 0.0))
    single = bool(walks) and walks[0].pair.moves == "atom"
    atoms = subject.atoms
    subject.forces(atoms)
    skipped: list[tuple[str, str]] = []
    if len(atoms) > _MANY and walks:
        atoms = _cut_out(atoms, _groups(atoms, single), walks[0].pair)
        try:
            subject.forces(atoms)
        except CalculatorError as error:
            skipped.append((f"{_CUT_OUT} atoms cut out of the structure", error.message))
            atoms = subject.atoms
    groups = _groups(atoms, single)
    targeted = _targeted(atoms, thresholds, groups)
    if len(targeted) > crossings:
        more = len(targeted) - crossings
        skipped.append((f"{more} more crossings of known thresholds", f"{crossings} were measured"))
        targeted = targeted[:crossings]
    triples = _triples(subject) if single else []
    scans = [*triples, *_random(atoms, groups, routes)]
    ways = [(route.name, lambda way=(route, hit): [_at_crossing(subject, *way)]) for route, hit in targeted]
    ways += [(scan[0].name, lambda scan=scan: _scanned(subject, thresholds, *scan)) for scan in scans]
    failed: set[int] = set()

    def note(place: int, error: CalculatorError) -> None:
        failed.add(place)
        skipped.append((ways[place][0], error.message))

    found = ask_each(subject, ways, progress, "walking through the structure", skipped, failed=note)
    asked = {*found, *failed}
    return EnvironmentWalks(
        tuple(one for events in found.values() for one in events if not _rounded(one, quantum)),
        sum(place < len(targeted) for place in asked),
        tuple(ways[place][0] for place in found if place >= len(targeted)),
        tuple(skipped),
        len(asked),
        len(ways),
    )


def _groups(atoms: Atoms, single: bool) -> list[np.ndarray]:
    """What moves together: single atoms, or molecules where the calculator takes nothing less."""
    return [np.array([k]) for k in range(len(atoms))] if single else molecules(atoms)


def _cut_out(atoms: Atoms, groups: Sequence[np.ndarray], pair: Pair) -> Atoms:
    """The groups nearest to the first, in one piece, in the surroundings of a pair; their order is kept."""
    center = _lead(atoms, groups[0])
    offsets = atoms.get_distances(center, np.arange(len(atoms)), mic=bool(atoms.pbc.any()), vector=True)
    nearest = np.argsort([np.linalg.norm(offsets[_lead(atoms, group)]) for group in groups])
    count = max(_CUT_OUT // max(len(groups[0]), 1), 4)
    cut = Atoms(cell=[pair.box] * 3 if pair.box else None, pbc=pair.periodic)
    for group in (groups[k] for k in sorted(nearest[:count])):
        part = whole(atoms, group)
        part.positions += offsets[_lead(atoms, group)] + pair.box / 2
        cut += part
    return cut


def _lead(atoms: Atoms, group: np.ndarray) -> int:
    return int(group[np.argmax(atoms.get_masses()[group])])


def _targeted(
    atoms: Atoms, thresholds: Sequence[PairThreshold], groups: Sequence[np.ndarray]
) -> list[tuple[Route, RouteCrossing]]:
    """For each threshold, a few pairs of the structure near it, moved through it along their line."""
    of_lead = {_lead(atoms, group): group for group in groups}
    symbols = np.array(atoms.get_chemical_symbols())
    ranked: list[tuple[int, Route, RouteCrossing]] = []
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
            route = Route(
                f"atom {first[k]} ({one}) toward {second[k]} ({other})",
                atoms, of_lead[int(first[k])], int(first[k]), vector[k] / distance[k],
            )  # fmt: skip
            at = float(distance[k] - threshold.radius)
            ranked.append((len(used), route, RouteCrossing(at, int(second[k]), threshold)))
            if len(used) == _MOST_CROSSINGS:
                break
    # the first of every threshold before the second of any
    return [(route, crossing) for _, route, crossing in sorted(ranked, key=lambda one: one[0])]


def _at_crossing(subject: CalculatorSubject, route: Route, crossing: RouteCrossing) -> Event:
    """What jumps where a known threshold is crossed, to the last representable place if a value does."""
    curve = route.curve(subject)
    low, high = crossing.at - _SIDE, crossing.at + _SIDE
    exact = crossing.threshold.order < 2
    if exact:
        low, high = locate(curve, crossing.threshold.order, low, high)
    jump = measure(curve, low, high, STEP, exact, curved=not exact)
    return _event(subject, route, jump, crossing)


def _event(
    subject: CalculatorSubject, route: Route, jump: Jump, crossing: RouteCrossing | None = None
) -> Event:
    change = subject.forces(route.at(jump.high)) - subject.forces(route.at(jump.low))
    return Event(
        route.name, jump.at, jump, float(np.linalg.norm(change, axis=1).max()),
        crossing.threshold if crossing else None,
        crossing.threshold.radius if crossing else float("nan"),
        () if crossing else tuple(route.ties(jump.at)),
    )  # fmt: skip


def _scanned(
    subject: CalculatorSubject, thresholds: Sequence[PairThreshold], route: Route, low: float, high: float
) -> list[Event]:
    """Unknown thresholds on a route."""
    curve = route.curve(subject)
    crossings = route.crossings(thresholds, low - 1.0, high + 1.0)
    inside = sum(low <= one.at <= high for one in crossings)
    # crowded routes in finer steps, so that what lies between two crossings is seen
    step = float(np.clip((high - low) / (10 * inside + 1), STEP / 10, STEP))
    jumps, _ = find_jumps(curve, low, high, step, most=6, expected=[one.at for one in crossings])

    def explains(crossing: RouteCrossing, jump: Jump) -> bool:
        near = max(1e-6, 10 * crossing.threshold.located, jump.high - jump.low)
        return abs(jump.at - crossing.at) < near

    return [
        _event(subject, route, jump)
        for jump in jumps
        if jump.order < SMOOTH and not any(explains(one, jump) for one in crossings)
    ]


def _triples(subject: CalculatorSubject) -> list[tuple[Route, float, float]]:
    """A third atom brought toward one of a bonded pair, beside their line: (route, from, to)."""
    found: list[tuple[Route, float, float]] = []
    for walk in walk_pairs(subject).walks[:_MOST_TRIPLES]:
        bond = float(walk.distance[int(np.argmin(walk.energy))])
        end = min((walk.cutoff or 8.0) + bond, 12.0)
        one, other = walk.pair.species
        side = np.radians(110.0)
        beside = (bond * np.cos(side), bond * np.sin(side), 0)
        atoms = Atoms([one, other, other], [(0, 0, 0), beside, (0, 0, 0)])
        if walk.pair.box:
            atoms.set_cell([walk.pair.box] * 3)
            atoms.positions += walk.pair.box / 2  # what lies outside of a box may be lost
        atoms.pbc = walk.pair.periodic
        name = f"a third atom ({other}) toward {one}-{other}"
        route = Route(name, atoms, np.array([2]), 2, np.array([1.0, 0.0, 0.0]))
        found.append((route, max(float(walk.distance[0]), 0.8 * bond) + 6 * STEP, end))
    return found


def _random(atoms: Atoms, groups: Sequence[np.ndarray], count: int) -> list[tuple[Route, float, float]]:
    """Routes of some atoms in arbitrary directions."""
    rng = np.random.default_rng(0)
    found: list[tuple[Route, float, float]] = []
    for k in rng.permutation(len(groups))[:count]:
        direction = rng.normal(size=3)
        lead = _lead(atoms, groups[k])
        name = f"atom {lead} ({atoms.get_chemical_symbols()[lead]}) in some direction"
        route = Route(name, atoms, groups[k], lead, direction / np.linalg.norm(direction))
        found.append((route, -_LENGTH / 2, _LENGTH / 2))
    return found


def _rounded(event: Event, quantum: tuple[float, float]) -> bool:
    """Whether an event is no more than a step of answers that are rounded to decimals."""
    if not any(quantum):
        return False
    small = abs(event.jump.energy) <= STEPS * quantum[0] and event.force <= STEPS * quantum[1]
    return event.jump.order > 1 or small
