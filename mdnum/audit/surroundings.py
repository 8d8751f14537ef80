"""Search for discontinuities of the energy of many atoms.

In a many-body potential, the interaction of a pair depends on other atoms. The energy may jump at a distance
at which two isolated atoms have a smooth energy. Therefore, atoms and triples of atoms are moved through all
pair thresholds and other distances. To detect a limit on the number of neighbors, an atom is moved past the
neighbors of a crowded atom. If only k neighbors are kept, the energy or a force jumps when the moving atom
replaces the k-th neighbor. If only the first k neighbors of the list are kept, reordering the atoms reveals
the limit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from ase import Atoms
from ase.neighborlist import neighbor_list
from jaxtyping import Float, Int

from mdnum.audit.base import CalculatorError, Progress, Ways
from mdnum.audit.curve import SMOOTH, Curve, Jump, find_jumps, locate, measure
from mdnum.audit.noise import digits, in_order
from mdnum.audit.structures import Pair, exchanged, molecules, whole
from mdnum.audit.subject import CalculatorSubject, differences
from mdnum.audit.thresholds import STEP, STEPS, PairThreshold, PairWalk, walk_pairs

_SIDE = 1e-7  # half the stretch around an expected crossing in which it is located, length
_MOST_CROSSINGS = 2  # crossings of one threshold that are measured, each by another atom
_CROSSINGS = 4  # crossings of known thresholds in the structure that are measured, by 170 calls or so each
_ROUTES = 2  # through the structure, scanned for unknown thresholds by 430 calls or so each
_CUT_OUT, _MANY = 40, 500  # of a structure of more atoms than the second, so many are walked through
_MOST_TRIPLES = 4
_LENGTH = 0.6  # of a route through the structure, length
_TIED = 1e-6  # so near to where two neighbors change places they are tied, length
_MOST = 160  # neighbors of the crowded center; radius graphs are cut at 32 by habit, and at 50, 100 or 120
_FEWEST = 4  # of which a calculator that refuses more is given
_NEAR, _FAR = 0.5, 0.94  # the crowd is between these fractions of the cutoff
#: Displacement to either side of a tie, in ulps of the largest coordinate in float32, because some
#: calculators sort neighbors by distances in float32.
_SIDE_OF_TIE = 4.0
_SURE = 30.0
_WITHOUT_CUTOFF = 6.0
_TIES = 160  # neighbors for which ties are tried, by three calls each; of several species, a share
#: Number of ties that are always tested.
_HABITUAL = (12, 16, 20, 24, 30, 32, 40, 48, 50, 60, 64, 80, 96, 100, 120, 128, 150, 200, 250, 256)


class RouteCrossing(NamedTuple):
    """A point on a route at which the moving atom crosses a threshold distance."""

    at: float
    threshold: PairThreshold


@dataclass(frozen=True)
class Route:
    """A structure in which one or several atoms move along a straight line."""

    name: str
    atoms: Atoms  # the structure at 0
    moving: Int[np.ndarray, "moving"]  # atoms that move together
    lead: int  # the one of them whose distances are watched
    direction: Float[np.ndarray, "3"]  # unit vector

    def at(self, along: float) -> Atoms:
        """Return the structure with its moving atoms displaced along the route."""
        atoms = self.atoms.copy()
        atoms.positions[self.moving] += along * self.direction
        return atoms

    def curve(self, subject: CalculatorSubject) -> Curve:
        """Energy along the route, and the force on the moving atoms along the route."""

        def at(along: float) -> tuple[float, float]:
            energy, forces = subject.both(self.at(along))
            return energy, float((forces[self.moving] @ self.direction).sum())

        return Curve(at)

    def crossings(self, thresholds: Sequence[PairThreshold], low: float, high: float) -> list[RouteCrossing]:
        """Return the points between `low` and `high` at which a threshold is crossed.

        The crossings are roots of quadratic equations.
        """
        found: list[RouteCrossing] = []
        symbols = np.array(self.atoms.get_chemical_symbols())
        for threshold in thresholds:
            reach = threshold.radius + max(abs(low), abs(high))
            first, second, vectors = neighbor_list("ijD", self.atoms, reach)
            near = (first == self.lead) & ~np.isin(second, self.moving)
            one, other = threshold.species
            wanted = {one: other, other: one}.get(symbols[self.lead])
            for vector in vectors[near & (symbols[second] == wanted)]:
                toward = float(vector @ self.direction)
                rest = toward**2 - float(vector @ vector) + threshold.radius**2
                roots = (toward - np.sqrt(rest), toward + np.sqrt(rest)) if rest > 0 else ()
                found += [RouteCrossing(float(root), threshold) for root in roots if low < root < high]
        return sorted(found, key=lambda one: one.at)

    def ties(self, along: float) -> tuple[tuple[int, int], ...]:
        """Return (atom, k) for each atom whose k-th and (k+1)-th neighbors exchange their ranks."""
        return exchanged(self.at(along - _TIED), self.at(along + _TIED))


@dataclass(frozen=True)
class Event:
    """A point on a route at which the energy or a derivative jumps."""

    route: str  # its name
    at: float  # place along it, length
    jump: Jump  # what jumps there; the force is the one along the route
    force: float  # largest change of the force on any atom, eV/Å
    threshold: PairThreshold | None  # the pair threshold that explains it, None if none does
    ties: tuple[tuple[int, int], ...]  # (atom, k) whose k-th and next neighbors are equally far there


@dataclass(frozen=True)
class EnvironmentWalks:
    """Energy and force jumps found by moving atoms through many-atom environments."""

    events: tuple[Event, ...]  # places at which something jumps
    measured: int  # crossings of known thresholds that were measured
    routes: tuple[str, ...]  # names of routes that were scanned for unknown ones

    @property
    def unexplained(self) -> list[Event]:
        """Jumps that are larger than the noise and that no pair threshold explains."""
        return [one for one in self.events if one.threshold is None and one.jump.order < SMOOTH]

    @property
    def lower(self) -> list[Event]:
        """Threshold crossings at which the energy of many atoms is less smooth than that of two."""
        return [one for one in self.events if one.threshold and one.jump.order < min(one.threshold.order, 2)]


def walk_surroundings(
    subject: CalculatorSubject,
    progress: Progress,
    ways: Ways,
    crossings: int = _CROSSINGS,
    routes: int = _ROUTES,
) -> EnvironmentWalks:
    """Move atoms and triples of atoms through known pair thresholds. Search for unknown ones.

    Args:
        crossings: number of crossings of known thresholds that are measured in the structure.
        routes: number of routes through the structure on which unknown thresholds are searched.
    """
    walks = walk_pairs(subject).walks
    thresholds = [one for walk in walks for one in walk.thresholds if one.order < SMOOTH or one.dies]
    quantum = max((one.quantum for one in walks), default=(0.0, 0.0))
    single = bool(walks) and walks[0].pair.moves == "atom"
    atoms = subject.atoms
    subject.forces(atoms)
    if len(atoms) > _MANY and walks:
        atoms = _cut_out(atoms, _groups(atoms, single), walks[0].pair)
        try:
            subject.forces(atoms)
        except CalculatorError as error:
            ways.skip(f"{_CUT_OUT} atoms cut out of the structure", error.message)
            atoms = subject.atoms
    groups = _groups(atoms, single)
    targeted = _targeted(atoms, thresholds, groups)
    if len(targeted) > crossings:
        more = len(targeted) - crossings
        ways.skip(f"{more} more crossings of known thresholds", f"{crossings} were measured")
        targeted = targeted[:crossings]
    triples = _triples(subject) if single else []
    scans = [*triples, *_random(atoms, groups, routes)]
    routed: list[tuple[Any, ...]] = [*targeted, *scans]

    def walked(way: tuple[Any, ...]) -> list[Event]:
        return [_at_crossing(subject, *way)] if len(way) == 2 else _scanned(subject, thresholds, *way)

    before, phase = ways.asked, "walking through the structure"
    found = ways.each(subject, routed, lambda way: way[0].name, walked, progress, phase, tolerant=True)
    return EnvironmentWalks(
        tuple(one for events in found.values() for one in events if not _rounded(one, quantum)),
        min(ways.asked - before, len(targeted)),
        tuple(routed[place][0].name for place in found if place >= len(targeted)),
    )


def _groups(atoms: Atoms, single: bool) -> list[np.ndarray]:
    """Return the groups of atoms that move together: single atoms or whole molecules."""
    return [np.array([k]) for k in range(len(atoms))] if single else molecules(atoms)


def _cut_out(atoms: Atoms, groups: Sequence[np.ndarray], pair: Pair) -> Atoms:
    """Return a cluster of the groups nearest to the first group, in the cell of a pair scan."""
    center = _lead(atoms, groups[0])
    offsets = atoms.get_distances(center, np.arange(len(atoms)), mic=bool(atoms.pbc.any()), vector=True)
    nearest = np.argsort([np.linalg.norm(offsets[_lead(atoms, group)]) for group in groups])
    count = max(_CUT_OUT // max(len(groups[0]), 1), 4)
    cut = pair.surrounded(Atoms())
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
    """Return a few routes for each threshold. On each route, a near pair crosses the threshold."""
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
            ranked.append((len(used), route, RouteCrossing(at, threshold)))
            if len(used) == _MOST_CROSSINGS:
                break
    # the first of every threshold before the second of any
    return [(route, crossing) for _, route, crossing in sorted(ranked, key=lambda one: one[0])]


def _at_crossing(subject: CalculatorSubject, route: Route, crossing: RouteCrossing) -> Event:
    """Measure the jump at a known threshold. Locate a jump of energy or force exactly."""
    curve, side = route.curve(subject), max(_SIDE, 3 * crossing.threshold.located)
    # what is smooth for two may jump among others: the lowest derivative that does, whatever the threshold
    for row in range(2):
        low, high = locate(curve, row, crossing.at - side, crossing.at + side)
        jump = measure(curve, low, high, STEP, exact=True, curved=False)
        if jump.order <= row:
            return _event(subject, route, jump, crossing)
    low, high = crossing.at - _SIDE, crossing.at + _SIDE
    jump = measure(curve, low, high, STEP, exact=False)
    return _event(subject, route, replace(jump, order=max(jump.order, 2)), crossing)


def _event(
    subject: CalculatorSubject, route: Route, jump: Jump, crossing: RouteCrossing | None = None
) -> Event:
    change = subject.forces(route.at(jump.high)) - subject.forces(route.at(jump.low))
    return Event(
        route.name, jump.at, jump, float(np.linalg.norm(change, axis=1).max()),
        crossing and crossing.threshold, () if crossing else route.ties(jump.at),
    )  # fmt: skip


def _scanned(
    subject: CalculatorSubject, thresholds: Sequence[PairThreshold], route: Route, low: float, high: float
) -> list[Event]:
    """Search a route for thresholds that scans of atom pairs did not find."""
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
    """Return (route, start, end) for atoms that approach two bonded atoms from the side."""
    found: list[tuple[Route, float, float]] = []
    for walk in walk_pairs(subject).walks[:_MOST_TRIPLES]:
        bond = float(walk.distance[int(np.argmin(walk.energy))])
        end = min((walk.cutoff or 8.0) + bond, 12.0)
        one, other = walk.pair.species
        side = np.radians(110.0)
        beside = (bond * np.cos(side), bond * np.sin(side), 0)
        # what lies outside of a box may be lost
        atoms = walk.pair.surrounded(Atoms([one, other, other], [(0, 0, 0), beside, (0, 0, 0)]), middle=True)
        name = f"a third atom ({other}) toward {one}-{other}"
        route = Route(name, atoms, np.array([2]), 2, np.array([1.0, 0.0, 0.0]))
        found.append((route, max(float(walk.distance[0]), 0.8 * bond) + 6 * STEP, end))
    return found


def _random(atoms: Atoms, groups: Sequence[np.ndarray], count: int) -> list[tuple[Route, float, float]]:
    """Return (route, start, end) for routes of randomly chosen atoms in random directions."""
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
    """Return whether a jump is due to the few decimals of a calculator's results."""
    if not any(quantum):
        return False
    small = abs(event.jump.energy) <= STEPS * quantum[0] and event.force <= STEPS * quantum[1]
    return event.jump.order > 1 or small


# -- crowds ----------------------------------------------------------------------------------------


class CrowdOrder(NamedTuple):
    """Changes of energy and forces when a dense cluster is reordered."""

    # number of neighbors at which it starts to matter, None if it never does
    start: int | None = None
    energy: float = 0.0  # how much it changes the energy then, eV; 0 within rounding
    force: float = 0.0  # how much it changes a force, eV/Å; 0 within rounding
    # whether it is the number within reach: with one of them out of reach, the order does not matter
    by_number: bool = False


@dataclass(frozen=True)
class Crowd:
    """A central atom with many neighbors, and the jumps when it gains another neighbor."""

    species: str  # of all atoms
    radius: float  # cutoff that the crowd is inside of, length
    neighbors: int  # how many neighbors the center got
    kept: int | None  # how many of them the calculator keeps, None where no exchange showed
    energy: float  # jump at the exchange, eV; 0 without one
    force: float  # largest jump of a force there, eV/Å
    distance: float  # from the center at which the exchange takes place; nan without one
    # whether it is their number: with one of the others out of reach, the same place shows no jump
    by_number: bool
    order: CrowdOrder


def crowd(subject: CalculatorSubject, progress: Progress, ways: Ways, most: int = _MOST) -> list[Crowd]:
    """Give one atom of each species many neighbors.

    Args:
        most: number of neighbors of the central atom.

    Returns:
        a result for each species of the structure; none for a calculator that does not support single atoms.
    """
    alike = [
        walk
        for walk in walk_pairs(subject).walks
        if walk.pair.species[0] == walk.pair.species[1] and walk.pair.moves == "atom"
    ]
    fewest = max(most // 8, _FEWEST)

    def crowded(walk: PairWalk) -> Crowd | None:
        for count in sorted({max(most // part, fewest) for part in (1, 2, 4, 8)}, reverse=True):
            # some refuse what is too dense for them
            with contextlib.suppress(CalculatorError), subject.trying():
                return _crowded(subject, walk, count, _TIES // len(alike))
        return None

    name = lambda walk: f"crowding {walk.pair.species[0]}"  # noqa: E731
    found = ways.each(subject, alike, name, crowded, progress, "crowding atoms", unit="elements")
    return [one for one in found.values() if one]


def cluster(pair: Pair, radius: float, count: int) -> tuple[Atoms, Float[np.ndarray, "neighbors"]]:
    """Return a central atom at the origin, `count` neighbors, and their distances.

    The neighbors are evenly spread in angle (golden spiral) and in volume. Random positions would put some
    neighbors too close together. The central atom is first. The neighbors are sorted by distance.
    """
    k = np.arange(count)
    share = (k + 0.5) / count
    distance = radius * (_NEAR**3 + (_FAR**3 - _NEAR**3) * share) ** (1 / 3)
    # neighbors in distance are put far apart in angle
    spread = np.argsort(np.random.default_rng(0).random(count))
    height = 1 - 2 * (spread + 0.5) / count
    angle = np.pi * (3 - np.sqrt(5)) * spread
    flat = np.sqrt(1 - height**2)
    directions = np.column_stack([flat * np.cos(angle), flat * np.sin(angle), height])
    positions = np.vstack([np.zeros(3), distance[:, None] * directions])
    return pair.surrounded(Atoms([pair.species[0]] * (count + 1), positions), middle=True), distance


def gap(atoms: Atoms) -> Float[np.ndarray, "3"]:
    """Return the direction from the central atom that is farthest from all neighbors."""
    tried = np.random.default_rng(1).normal(size=(2000, 3))
    tried /= np.linalg.norm(tried, axis=1)[:, None]
    offsets = atoms.positions[1:] - atoms.positions[0]
    units = offsets / np.linalg.norm(offsets, axis=1)[:, None]
    return tried[np.argmin((tried @ units.T).max(axis=1))]


def _crowded(subject: CalculatorSubject, walk: PairWalk, count: int, ties: int) -> Crowd:
    radius, quantum = walk.cutoff or _WITHOUT_CUTOFF, walk.quantum
    atoms, distances = cluster(walk.pair, radius, count)
    direction = gap(atoms)
    between = 0.5 * (distances[1:] + distances[:-1])

    def walker(place: float, without: int | None = None) -> Atoms:
        others = atoms if without is None else atoms[np.arange(count + 1) != without]
        return others + Atoms([walk.pair.species[0]], [atoms.positions[0] + place * direction])

    side = _SIDE_OF_TIE * float(np.spacing(np.float32(max(np.abs(atoms.positions).max(), radius))))

    def change(place: float, without: int | None = None) -> tuple[float, Float[np.ndarray, "atoms"]]:
        """Return the jumps of energy and forces as an atom moves from `place - side` to `place + side`.

        The energy jump is the energy change plus the work of the force. The force jump is the change of force
        minus the mean change of the two adjacent intervals. Both are absolute values.
        """
        first, before = subject.both(walker(place - side, without))
        second, after = subject.both(walker(place + side, without))
        earlier, later = (subject.forces(walker(place + 3 * one * side, without)) for one in (-1, 1))
        energy = abs(second - first + float((before[-1] + after[-1]) @ direction) * side)
        return energy, np.linalg.norm(1.5 * (after - before) - 0.5 * (later - earlier), axis=1)

    quiet = [change(place) for place in between[:: max(count // 10, 1)]]
    # a force's change beyond its neighbors' is some four roundings of each of three components
    noise_energy = max(max(energy for energy, _ in quiet), 1e-14, 4 * quantum[0] / _SURE)
    # an atom that its neighbors press hard has forces with more rounding in them than another
    forces = np.linalg.norm(subject.forces(walker(float(between[0]))), axis=1)
    rounding = 2.0**-21 if digits(forces).bits <= 24 else 2.0**-50
    floor = np.maximum(rounding * np.maximum(forces, np.median(forces)), 1e-14)
    floor = np.maximum(floor, 4 * np.sqrt(3) * quantum[1] / _SURE)
    noise_force = np.maximum(np.max([force for _, force in quiet], axis=0), floor)
    over: list[tuple[int, float, float]] = []
    for k, place in enumerate(distances):
        if k >= ties and k + 1 not in _HABITUAL:
            continue
        energy, force = change(place)
        sure = force > _SURE * noise_force
        if energy > _SURE * noise_energy or sure.any():
            over.append((k + 1, energy, float(force[sure].max()) if sure.any() else 0.0))
    kept, energy, force = max(over, key=lambda one: (one[2], one[1])) if over else (None, 0.0, 0.0)
    if energy <= _SURE * noise_energy:  # the force alone jumped
        energy = 0.0
    by_number = False
    if kept is not None:
        place = float(distances[kept - 1])
        if not 0.5 * force <= change(place)[1].max() <= 2 * force and force:
            kept, energy, force = None, 0.0, 0.0  # by chance, which repeats tell
        elif kept > 1:
            fewer = change(place, without=1)
            floor = np.delete(noise_force, 1)
            by_number = fewer[0] <= _SURE * noise_energy and not (fewer[1] > _SURE * floor).any()
    return Crowd(
        walk.pair.species[0], radius, count, kept, energy, force,
        float(distances[kept - 1]) if kept else float("nan"), by_number,
        _order(subject, walk, radius, count),
    )  # fmt: skip


def _order(subject: CalculatorSubject, walk: PairWalk, radius: float, most: int) -> CrowdOrder:
    """Find the smallest number of neighbors at which the order of atoms matters."""
    low, high, changed = 1, None, (0.0, 0.0)
    larger = iter([*(count for count in (4, 16, 64) if count < most), most])
    while count := next(larger, None) if high is None else (low + high) // 2 * (high - low > 1):
        found = _permuted(subject, walk, radius, count)
        if found is None:
            low = count
        else:
            high, changed = count, found
    if high is None:
        return CrowdOrder()
    # what comes and goes is no order; what stays when one neighbor is out of reach is not their number
    if _permuted(subject.fresh(), walk, radius, high) is None:
        return CrowdOrder()
    alone = walk.cutoff is not None and _permuted(subject, walk, radius, high, aside=True) is None
    return CrowdOrder(high, *changed, alone)


def _permuted(
    subject: CalculatorSubject, walk: PairWalk, radius: float, count: int, aside: bool = False
) -> tuple[float, float] | None:
    """Return the changes of energy and force when atoms are reordered. None if rounding explains the changes.

    If `aside` is true, the last neighbor is moved until it interacts with no atom.
    """
    atoms, _ = cluster(walk.pair, radius, count)
    if aside:
        atoms.positions[-1] += 3 * (atoms.positions[-1] - atoms.positions[0])
    energy, forces = subject.both(atoms)
    rng = np.random.default_rng(2)
    worst = np.zeros(2)
    for order in (np.arange(count + 1)[::-1], rng.permutation(count + 1), rng.permutation(count + 1)):
        worst = np.maximum(worst, differences((energy, forces), in_order(subject, atoms, order)))
    # terms are at most as large as their sum is where the crowd repels; rounding of float32 is allowed
    total = np.abs(forces).sum()
    scale = np.array([total * np.ptp(atoms.positions, axis=0).max() + abs(energy), total])
    changed = worst > np.maximum(1e-6 * scale, STEPS * np.array(walk.quantum))
    if not changed.any():
        return None
    # the same order again: what differs then as well is no order
    again = np.array(differences((energy, forces), subject.fresh().both(atoms)))
    if (again[changed] > 0.1 * worst[changed]).any():
        subject.again(atoms, energy, forces)
        return None
    return tuple(np.where(changed, worst, 0.0).tolist())
