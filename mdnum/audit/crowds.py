"""Neighbors added until something drops: a cap on how many are kept, or a choice of the k nearest.

A center is crowded, and one more atom is brought from outside to inside past all its neighbors. Where it is
exactly as far as the k-th of them, a calculator that keeps k neighbors exchanges one for the other, and
something jumps; where it keeps the first k in its own order, a permutation of the atoms does the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import TIME_UP, Progress, TimeUp
from mdnum.audit.pairs import Pair
from mdnum.audit.subject import CalculatorError, CalculatorSubject, only_trying
from mdnum.audit.thresholds import STEPS, PairWalk, walk_pairs

#: Neighbors of the crowded center; radius graphs are cut at 32 by habit, and at 50, 100 or 120 elsewhere.
_MOST = 160
#: Of which a calculator that refuses more is given.
_FEWEST = 4
#: The crowd is between these fractions of the cutoff.
_NEAR, _FAR = 0.5, 0.94
#: How far to either side of a tie is asked, the second for calculators that compute in float32.
_SIDES = (1e-9, 1e-6)
_SURE = 30.0
_WITHOUT_CUTOFF = 6.0
#: With how many neighbors ties are tried, three calls each; the share of one of several species is less.
_TIES = 160
#: Ties that are tried in any case.
_HABITUAL = (12, 16, 20, 24, 30, 32, 40, 48, 50, 60, 64, 80, 96, 100, 120, 128, 150, 200, 250, 256)


@dataclass(frozen=True)
class Crowd:
    """A center with many neighbors, none as far as another, and what came of crowding it.

    Attributes:
        species: of all atoms.
        radius: cutoff that the crowd is inside of, length.
        neighbors: how many neighbors the center got.
        kept: how many of them the calculator keeps, None where no exchange showed.
        energy: jump at the exchange, eV; 0 without one.
        force: largest jump of a force there, eV/Å.
        distance: from the center at which the exchange takes place; nan without one.
        order_from: number of neighbors at which the order of atoms starts to matter, None if it never does.
        order_energy: how much it changes the energy then, eV.
        order_force: how much it changes a force, eV/Å.
        jumps: (k, largest force jump) for each tie with the k-th neighbor that was tried.
    """

    species: str
    radius: float
    neighbors: int
    kept: int | None
    energy: float
    force: float
    distance: float
    order_from: int | None
    order_energy: float
    order_force: float
    jumps: tuple[tuple[int, float], ...]


def crowd(
    subject: CalculatorSubject, progress: Progress, skipped: list[tuple[str, str]], most: int = _MOST
) -> list[Crowd]:
    """Crowd an atom of each species that the calculator takes alone.

    Args:
        skipped: gets what was not asked, and why.
        most: neighbors given to the center.

    Returns:
        one for each species of the structure; none for a calculator that takes no single atoms.
    """
    found: list[Crowd] = []
    alike = [
        walk
        for walk in walk_pairs(subject).walks
        if walk.pair.species[0] == walk.pair.species[1] and walk.pair.moves == "atom"
    ]
    for k, walk in enumerate(alike):
        progress(k, len(alike), {"phase": f"crowding {walk.pair.species[0]}"})
        fewest = max(most // 8, _FEWEST)
        for count in sorted({max(most // part, fewest) for part in (1, 2, 4, 8)}, reverse=True):
            # some refuse what is too dense for them
            try:
                with only_trying(subject), subject.meter.limited():
                    found.append(_crowded(subject, walk, count, _TIES // len(alike)))
                break
            except CalculatorError:
                continue
            except TimeUp:
                skipped.append((f"crowding {walk.pair.species[0]}", TIME_UP))
                break
    return found


def cluster(pair: Pair, radius: float, count: int) -> tuple[Atoms, Float[np.ndarray, "neighbors"]]:
    """A center at the origin and count atoms around it at different distances: (atoms, distances).

    The neighbors fill the shell evenly (a golden spiral in angle, equal volumes in distance), so that no two
    are as near to one another as chance would put them. Sorted by distance, the center first.
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
    atoms = Atoms([pair.species[0]] * (count + 1), positions)
    if pair.box:
        atoms.set_cell([pair.box] * 3)
        atoms.positions += pair.box / 2
    atoms.pbc = pair.periodic
    return atoms, distance


def gap(atoms: Atoms) -> Float[np.ndarray, "3"]:
    """The direction from the center that stays farthest from every neighbor."""
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

    def walker(place: float) -> Atoms:
        return atoms + Atoms([walk.pair.species[0]], [atoms.positions[0] + place * direction])

    def resolved(side: float) -> bool:
        """Whether the calculator tells two places this near apart, wherever they are."""
        return not any(
            (subject.forces(walker(place - side)) == subject.forces(walker(place + side))).all()
            for place in between[:: max(len(distances) // 6, 1)]
        )

    side = next((one for one in _SIDES if resolved(one)), _SIDES[-1])

    def change(place: float) -> tuple[float, Float[np.ndarray, "atoms"]]:
        """Changes from place - side to place + side that a smooth function has not.

        (|change of the energy beyond the force's work|, for each atom |change of its force beyond the change
        over the next stretch of that length|).
        """
        near, far, farther = (walker(place + times * side) for times in (-1, 1, 3))
        before, after, later = subject.forces(near), subject.forces(far), subject.forces(farther)
        work = float((before[-1] + after[-1]) @ direction) * side
        energy = abs(subject.energy(far) - subject.energy(near) + work)
        return energy, np.linalg.norm((after - before) - (later - after), axis=1)

    quiet = [change(place) for place in between[:: max(count // 10, 1)]]
    # a force's change and that of its change are four roundings of each of three components
    noise_energy = max(max(energy for energy, _ in quiet), 1e-14, 4 * quantum[0] / _SURE)
    # an atom that its neighbors press hard has forces with more rounding in them than another
    forces = np.linalg.norm(subject.forces(walker(float(between[0]))), axis=1)
    rounding = 2.0**-50 if side == _SIDES[0] else 2.0**-21
    floor = np.maximum(rounding * np.maximum(forces, np.median(forces)), 1e-14)
    floor = np.maximum(floor, 4 * np.sqrt(3) * quantum[1] / _SURE)
    noise_force = np.maximum(np.max([force for _, force in quiet], axis=0), floor)
    jumps: list[tuple[int, float]] = []
    over: list[tuple[int, float, float]] = []
    for k, place in enumerate(distances):
        if k >= ties and k + 1 not in _HABITUAL:
            continue
        energy, force = change(place)
        jumps.append((k + 1, float(force.max())))
        sure = force > _SURE * noise_force
        if energy > _SURE * noise_energy or sure.any():
            over.append((k + 1, energy, float(force[sure].max()) if sure.any() else 0.0))
    kept, energy, force = max(over, key=lambda one: (one[2], one[1])) if over else (None, 0.0, 0.0)
    if energy <= _SURE * noise_energy:  # the force alone jumped
        energy = 0.0
    return Crowd(
        walk.pair.species[0], radius, count, kept, energy, force,
        float(distances[kept - 1]) if kept else float("nan"),
        *_order(subject, walk, radius, count), tuple(jumps),
    )  # fmt: skip


def _order(
    subject: CalculatorSubject, walk: PairWalk, radius: float, most: int
) -> tuple[int | None, float, float]:
    """(fewest neighbors at which permuting atoms changes anything, by how much energy, and force)."""
    low = 1
    for count in [count for count in (4, 16, 64) if count < most] + [most]:
        changed = _permuted(subject, walk, radius, count)
        if changed is None:
            low = count
            continue
        high = count
        while high - low > 1:
            middle = (low + high) // 2
            fewer = _permuted(subject, walk, radius, middle)
            if fewer is None:
                low = middle
            else:
                high, changed = middle, fewer
        return high, *changed
    return None, 0.0, 0.0


def _permuted(
    subject: CalculatorSubject, walk: PairWalk, radius: float, count: int
) -> tuple[float, float] | None:
    """Changes of energy and force with the order of atoms; None if another order of sums explains them."""
    atoms, _ = cluster(walk.pair, radius, count)
    energy, forces = subject.energy(atoms), subject.forces(atoms)
    rng = np.random.default_rng(2)
    worst = np.zeros(2)
    for order in (np.arange(count + 1)[::-1], rng.permutation(count + 1), rng.permutation(count + 1)):
        other = atoms.copy()[order]
        assert isinstance(other, Atoms)
        apart = np.abs(subject.forces(other) - forces[order]).max()
        worst = np.maximum(worst, [abs(subject.energy(other) - energy), apart])
    # terms are at most as large as their sum is where the crowd repels; rounding of float32 is allowed
    total = np.abs(forces).sum()
    scale = np.array([total * np.ptp(atoms.positions, axis=0).max() + abs(energy), total])
    changed = (worst > np.maximum(1e-6 * scale, STEPS * np.array(walk.quantum))).any()
    return (float(worst[0]), float(worst[1])) if changed else None
