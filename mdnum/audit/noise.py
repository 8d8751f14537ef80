"""How far a calculator's answers scatter for reasons of rounding alone: measured, not assumed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from ase import Atoms
from jaxtyping import Float

from mdnum.audit.base import Subject, again
from mdnum.audit.ledger import no_rounding
from mdnum.audit.subject import CalculatorError

#: Å between the points of the line along which noise is measured: a smooth function's fourth difference over
#: it is below 1e-16 eV for any chemistry, while even single precision tells neighboring points apart.
_SPACING = 1e-5
_POINTS = 9
#: Å by which atoms are moved from where they were given, so that no distance sits on a threshold by design.
RATTLE = 0.03
#: Atoms below which symmetry may hide the noise.
FEW = 8
#: Å between the points of the line along which steps are looked for, the wider ones where nothing moves.
_STEP_SPACINGS = (1e-4, 1.6e-3, 2.5e-2)
_STEP_POINTS = 17
#: Places at which a value stays what it was, from which one that moves elsewhere goes in steps; and the share
#: of the forces that do, from which forces do.
_STAYS, _STAIRS = 3, 0.1

#: Of an energy: noise that rounding explains, of doubles and of numbers of single precision.
_QUIET, _QUIET_SINGLE = 1e-11, 1e-6
#: A line that is so much quieter than another has no threshold on it; rounding differs by less between lines.
_QUIETER = 1e-3


@dataclass(frozen=True)
class Noise:
    """What an answer may differ by without anything being wrong.

    Attributes:
        energy: standard deviation, eV.
        force: standard deviation of a component, of the atom that scatters most, eV/Å.
        typical: the same of the median component.
    """

    energy: float
    force: float
    typical: float = 0.0


def along_a_line(subject: Subject, atoms: Atoms, rng: np.random.Generator) -> Noise:
    """Noise from differences of high order over equally spaced points: what is smooth drops out of them.

    Args:
        subject: the calculator.
        atoms: where; no threshold nearby.
        rng: picks the line.

    Source:
        J. J. Moré and S. M. Wild, Estimating computational noise, SIAM J. Sci. Comput. 33, 1292 (2011).
    """
    line = direction(len(atoms), rng)
    places = [displaced(atoms, (at - _POINTS // 2) * _SPACING * line) for at in range(_POINTS)]
    energies, forces = [], []
    for there in places:
        energies.append(subject.energy(there))
        forces.append(subject.forces(there))
    energy = float(_scatter(np.array(energies)[:, None])[0])
    scatters = _scatter(np.array(forces).reshape(_POINTS, -1))
    force = float(np.max(scatters))
    if no_rounding(energy, energies[0], force, np.array(forces), subject.kT):
        # by chance, or by a threshold: the point that sticks out is asked again
        worst = np.array(forces).reshape(_POINTS, -1)[:, np.argmax(scatters)]
        for at in {_odd_one(np.array(energies)), _odd_one(worst)}:
            again(subject, places[at], energies[at], forces[at])
    # values that round to the same number at every point still carry the rounding of one operation
    floor = np.finfo(float).eps
    return Noise(
        max(energy, floor * max(abs(value) for value in energies)),
        max(force, floor * float(np.max(np.abs(forces)))),
        float(np.median(scatters)),
    )


@dataclass(frozen=True)
class Steps:
    """Whether answers go in steps, along a line on which smooth ones change from point to point.

    Attributes:
        energy: the size of a step, eV; 0 where there are none.
        force: of a force component, eV/Å.
        share: of force components that go in steps, of those that change at all.
        length: of the line, Å.
        energies: eV.
        forces: eV/Å.
    """

    energy: float
    force: float
    share: float
    length: float
    energies: Float[np.ndarray, "points"]
    forces: Float[np.ndarray, "points components"]


def steps(subject: Subject, atoms: Atoms) -> Steps:
    """Steps of energies and forces: values that stay the same to the last bit and then change.

    A double, or a number of single precision, of something smooth is another one 1e-4 Å further on. Points
    at which nothing at all has changed do not count: a calculator that has kept an answer looks like that.

    Args:
        subject: the calculator.
        atoms: where the line begins.
    """
    known = getattr(subject, "known", {})
    key = ("steps", atoms.positions.tobytes(), atoms.cell.array.tobytes())
    if key in known:
        return known[key]
    line = direction(len(atoms), np.random.default_rng(len(atoms)))
    for spacing in _STEP_SPACINGS:
        there = [displaced(atoms, k * spacing * line) for k in range(_STEP_POINTS)]
        answers = [(subject.energy(one), subject.forces(one).ravel()) for one in there]
        energies = np.array([energy for energy, _ in answers])
        forces = np.array([force for _, force in answers])
        moved = (np.diff(energies) != 0) | (np.diff(forces, axis=0) != 0).any(axis=1)
        changes = np.diff(forces, axis=0)[moved]
        alive, felt = np.any(changes != 0, axis=0), np.any(forces != 0, axis=0)
        if (np.ptp(energies) > 0 and 2 * np.sum(alive) >= np.sum(felt)) or not felt.any():
            break
    stairs = alive & (np.sum(changes == 0, axis=0) >= _STAYS)
    share = float(np.sum(stairs) / np.sum(alive)) if alive.any() else 0.0
    sizes = np.abs(changes[:, stairs])
    force = float(np.median(sizes[sizes > 0])) if share > _STAIRS else 0.0
    climbs = np.abs(np.diff(energies)[moved])
    stays = np.sum(climbs == 0) >= _STAYS and climbs.any()
    energy = float(np.median(climbs[climbs > 0])) if stays else 0.0
    if not np.ptp(energies):
        # as large as what the forces say it should have changed by, at least
        along = forces @ line.ravel()
        work = spacing * np.cumsum(0.5 * (along[1:] + along[:-1]))
        energy = float(np.ptp(np.append(work, 0.0)))
    length = (_STEP_POINTS - 1) * spacing
    known[key] = Steps(energy, force, share, length, energies, forces)
    return known[key]


def _scatter(values: Float[np.ndarray, "points columns"]) -> Float[np.ndarray, "columns"]:
    """Standard deviation of the noise in each column, the middle one of three orders of difference."""
    found = []
    for order in (4, 5, 6):
        difference = np.diff(values, n=order, axis=0)
        weight = math.factorial(order) ** 2 / math.factorial(2 * order)
        found.append(np.sqrt(weight * np.mean(difference**2, axis=0)))
    return np.median(found, axis=0)


def _odd_one(values: Float[np.ndarray, "points"]) -> int:
    """The point without which the others are closest to a parabola."""
    at = np.arange(len(values)) - len(values) // 2
    # of values that are all large, what they have in common has no digits to spare
    values = values - np.median(values)
    left = []
    for k in range(len(values)):
        rest, others = np.delete(at, k), np.delete(values, k)
        left.append(np.sum((others - np.polyval(np.polyfit(rest, others, 2), rest)) ** 2))
    return int(np.argmin(left))


def under_jitter(
    subject: Subject, atoms: Atoms, size: float, rng: np.random.Generator, draws: int = 4
) -> Noise:
    """The largest change of energy and of a force component when all atoms are moved by `size` at random.

    Rounding coordinates of another image or of a turned structure moves atoms like this.

    Args:
        subject: the calculator.
        atoms: where.
        size: Å, of the order of an ulp of the largest coordinate.
        rng: draws the moves.
        draws: how many are tried.
    """
    energy, forces = subject.energy(atoms), subject.forces(atoms)
    worst_energy = worst_force = 0.0
    for _ in range(draws):
        there = displaced(atoms, size * rng.uniform(-1, 1, (len(atoms), 3)))
        found, felt = subject.energy(there), subject.forces(there)
        change, force = abs(found - energy), float(np.max(np.abs(felt - forces), initial=0.0))
        # either answer may be the one that sticks out
        if no_rounding(change, energy, force, forces, subject.kT) and not again(subject, there, found, felt):
            again(subject, atoms, energy, forces)
        worst_energy, worst_force = max(worst_energy, change), max(worst_force, force)
    return Noise(worst_energy, worst_force)


def settled(
    subject: Subject, rng: np.random.Generator, tries: int = 5, at_least: int = 1
) -> tuple[Atoms, Noise]:
    """The structure with its atoms moved a little, away from any threshold, and the noise there.

    In a perfect crystal a whole shell of neighbors can sit on a cutoff; a check that is not about
    thresholds must not stand on one. A step of the energy inside the line shows as noise, so the quietest
    of a few draws is taken.

    Args:
        subject: the calculator.
        rng: draws the moves.
        tries: how many structures are looked at.
        at_least: atoms; a smaller cell is repeated, where it repeats.
    """
    given = roomy(subject.atoms, at_least)
    # several checks ask with the same seed: what the first was told is known
    known = getattr(subject, "known", {})
    key = ("settled", tries, len(given), str(rng.bit_generator.state))
    if key in known:
        there, noise, rng.bit_generator.state = known[key]
        return there.copy(), noise
    best: tuple[Atoms, Noise] | None = None
    for _ in range(tries):
        there = displaced(given, RATTLE * rng.uniform(-1, 1, (len(given), 3)))
        noise = along_a_line(subject, there, rng)
        if best is None or noise.energy < _QUIETER * best[1].energy:
            best = there, noise
        # quiet enough to be rounding; where it is not, a threshold on the line looks like noise as well
        energy = subject.energy(there)
        single = float(np.float32(energy)) == energy
        if noise.energy < (_QUIET_SINGLE if single else _QUIET) * max(1.0, abs(energy)):
            break
    assert best is not None
    there, noise = best
    noise = louder(noise, _of_more_atoms(subject, there, rng))
    # what goes in steps may not move at all on so short a line
    stairs = steps(subject, there)
    noise = louder(noise, Noise(0.5 * stairs.energy, 0.5 * stairs.force))
    known[key] = there.copy(), noise, rng.bit_generator.state
    return there, noise


def roomy(atoms: Atoms, at_least: int) -> Atoms:
    """A structure of so many atoms or more, repeated along its periodic axes; itself where none repeats."""
    if len(atoms) >= at_least or not len(atoms) or not atoms.pbc.any():
        return atoms
    times = math.ceil((at_least / len(atoms)) ** (1 / int(atoms.pbc.sum())))
    return atoms.repeat(np.where(atoms.pbc, times, 1))


def of_all_kinds(count: int) -> list[int]:
    """Numbers below count in an order in which a few tell of the beginning, the middle and the end."""
    return [place for first in range(4) for place in range(first, count, 4)]


def louder(one: Noise, other: Noise) -> Noise:
    """The larger of two, each part by itself."""
    return Noise(max(one.energy, other.energy), max(one.force, other.force), max(one.typical, other.typical))


def _of_more_atoms(subject: Subject, atoms: Atoms, rng: np.random.Generator) -> Noise:
    """Noise of a supercell where there are few atoms: terms that cancel by symmetry leave no trace."""
    if len(atoms) >= FEW or not atoms.pbc.any():
        return Noise(0.0, 0.0)
    many = roomy(atoms, FEW)
    many.positions += RATTLE * rng.uniform(-1, 1, many.positions.shape)
    try:
        return along_a_line(subject, many, rng)
    except CalculatorError:
        return Noise(0.0, 0.0)


def direction(atoms: int, rng: np.random.Generator) -> Float[np.ndarray, "atoms 3"]:
    """A random displacement of all atoms, the furthest by 1."""
    drawn = rng.standard_normal((atoms, 3))
    return drawn / np.max(np.linalg.norm(drawn, axis=1))


def displaced(atoms: Atoms, by: Float[np.ndarray, "atoms 3"]) -> Atoms:
    """A copy with every atom moved.

    Args:
        atoms: left as it is.
        by: Å.
    """
    there = atoms.copy()
    there.positions += by
    return there
