"""Calculators whose thresholds are known: a pair law cut, shifted, switched or capped, by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from ase import Atoms
from ase.build import bulk
from ase.calculators.calculator import Calculator, all_changes

from mdnum.audit.subject import CalculatorSubject

SIGMA, EPSILON, R_CUT, R_ON = 3.0, 0.01, 6.3, 5.1
KT = 0.0258
Law = Callable[[float], tuple[float, float]]
NOTHING = (0.0, 0.0)


def law(r: float) -> tuple[float, float, float]:
    """Lennard-Jones: energy, force and second derivative."""
    s = (SIGMA / r) ** 6
    return (
        4 * EPSILON * (s * s - s),
        24 * EPSILON * (2 * s * s - s) / r,
        24 * EPSILON * (26 * s * s - 7 * s) / r**2,
    )


def cut(inside: Callable[[float], bool]) -> Law:
    return lambda r: law(r)[:2] if inside(r) else NOTHING


endless = cut(lambda r: True)
hard = cut(lambda r: r < R_CUT)
#: The same with the cutoff itself inside.
including = cut(lambda r: r <= R_CUT)
#: Decided on squares, as most codes do.
squared = cut(lambda r: r * r < R_CUT * R_CUT)


def shifted(r: float) -> tuple[float, float]:
    return (law(r)[0] - law(R_CUT)[0], law(r)[1]) if r < R_CUT else NOTHING


def force_shifted(r: float) -> tuple[float, float]:
    energy, force, _ = law(R_CUT)
    return (law(r)[0] - energy + force * (r - R_CUT), law(r)[1] - force) if r < R_CUT else NOTHING


def switched(order: int) -> Law:
    """1 to 0 between R_ON and R_CUT with `order` continuous derivatives."""

    def of(r: float) -> tuple[float, float]:
        energy, force, _ = law(r)
        if r <= R_ON or r >= R_CUT:
            return (energy, force) if r <= R_ON else NOTHING
        t, width = (r - R_ON) / (R_CUT - R_ON), R_CUT - R_ON
        if order == 1:
            s, slope = 1 - t * t * (3 - 2 * t), -6 * t * (1 - t) / width
        else:
            s, slope = 1 - t**3 * (10 - 15 * t + 6 * t * t), -30 * t * t * (1 - t) ** 2 / width
        return energy * s, force * s - energy * slope

    return of


def soft(r: float) -> tuple[float, float]:
    """Repulsive without a wall, gone at R_CUT with three continuous derivatives."""
    t = r / R_CUT
    return ((1 - t) ** 4, 4 * (1 - t) ** 3 / R_CUT) if t < 1 else NOTHING


def stepped(pair: Law, place: float, size: float) -> Law:
    """A law with a force that is larger before a place, and an energy to it."""

    def of(r: float) -> tuple[float, float]:
        energy, force = pair(r)
        return (energy + size * (place - r), force + size) if r < place else (energy, force)

    return of


class Exact(Calculator):
    """A calculator with ASE's cache, in which a coordinate is another one where a bit differs."""

    implemented_properties = ["energy", "forces"]  # noqa: RUF012

    def check_state(self, atoms, tol=1e-15):
        # ASE's own test, of nine arrays with np.allclose, takes longer than the energy of a few atoms
        if self.atoms is None:
            return all_changes
        pairs = ((name, getattr(self.atoms, name), getattr(atoms, name)) for name in _DEPENDS)
        return [name for name, before, now in pairs if not np.array_equal(before, now)]


_DEPENDS = ("positions", "numbers", "cell", "pbc")


class Pairwise(Exact):
    """A sum over pairs, nearest images only; atoms have an energy of their own, as in many models.

    Args:
        pair: energy and force of a distance.
        own: energy of an atom, eV.
        single: round positions, energy and forces to float32.
        places: decimals to which answers are rounded.
        keep, by: neighbors that each atom keeps, "nearest" or "first" in the order of the atoms.
        side: a constant for every angle whose two sides are shorter than this.
    """

    def __init__(
        self,
        pair: Law,
        own: float = 0.0,
        single: bool = False,
        places: int | None = None,
        keep: int | None = None,
        by: str = "nearest",
        side: float = 0.0,
    ):
        super().__init__()
        self.pair, self.own, self.single, self.places = pair, own, single, places
        self.keep, self.by, self.side = keep, by, side

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        assert isinstance(atoms, Atoms)
        positions = atoms.positions.astype(np.float32 if self.single else np.float64).astype(np.float64)
        vectors = positions[None] - positions[:, None]
        if atoms.pbc.any():
            lengths = atoms.cell.lengths()
            vectors -= lengths * np.round(vectors / lengths)
        distances = np.sqrt((vectors**2).sum(axis=2))
        energy, forces = self.own * len(atoms), np.zeros((len(atoms), 3))
        for i, j in np.argwhere(self.kept(distances)):
            one, force = self.pair(float(distances[i, j]))
            energy += 0.5 * one
            along = 0.5 * force * vectors[i, j] / distances[i, j]
            forces[j] += along
            forces[i] -= along
        near = (distances < self.side).sum(axis=1) - 1
        energy += 1e-3 * float((near * (near - 1) / 2).sum()) if self.side else 0.0
        if self.single:
            energy, forces = float(np.float32(energy)), forces.astype(np.float32)
        if self.places is not None:
            energy, forces = round(energy, self.places), np.round(forces, self.places)
        self.results = {"energy": energy, "forces": forces}

    def kept(self, distances: np.ndarray) -> np.ndarray:
        if self.keep is None:
            return ~np.eye(len(distances), dtype=bool)
        inside = (distances < R_CUT) & ~np.eye(len(distances), dtype=bool)
        if self.by == "nearest":
            ranked = np.where(inside, distances, np.inf).argsort(axis=1, kind="stable").argsort(axis=1)
            return inside & (ranked < self.keep)
        return inside & (np.cumsum(inside, axis=1) <= self.keep)


class Bare(CalculatorSubject):
    """Two argon atoms under a law, asked without ASE's calculators in between."""

    def __init__(self, pair: Law, own: float = 0.0):
        atoms = Atoms("Ar2", [(0, 0, 0), (4, 0, 0)])
        super().__init__("bare", lambda: Pairwise(pair, own), atoms, kT=KT)
        self.pair, self.own = pair, own

    def energy(self, atoms) -> float:
        return 2 * self.own + self.pair(float(atoms.positions[1, 0]))[0]

    def forces(self, atoms) -> np.ndarray:
        force = self.pair(float(atoms.positions[1, 0]))[1]
        return np.array([[-force, 0.0, 0.0], [force, 0.0, 0.0]])


def subject(pair: Law = soft, atoms: Atoms | None = None, **options) -> CalculatorSubject:
    """Atoms under a law; by default a crystal of argon that is large enough for nearest images."""
    if atoms is None:
        atoms = bulk("Ar", "fcc", a=4.7, cubic=True).repeat(3)
        atoms.rattle(0.05, seed=1)
    return CalculatorSubject("planted", lambda: Pairwise(pair, **options), atoms, kT=KT)
