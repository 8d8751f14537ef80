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


def law(r: float) -> tuple[float, float, float]:
    """Lennard-Jones: energy, force and second derivative."""
    s = (SIGMA / r) ** 6
    return (
        4 * EPSILON * (s * s - s),
        24 * EPSILON * (2 * s * s - s) / r,
        24 * EPSILON * (26 * s * s - 7 * s) / r**2,
    )


def switch(r: float, order: int) -> tuple[float, float]:
    """1 to 0 between R_ON and R_CUT with `order` continuous derivatives, and its derivative."""
    t = (r - R_ON) / (R_CUT - R_ON)
    if order == 1:
        return 1 - t * t * (3 - 2 * t), -6 * t * (1 - t) / (R_CUT - R_ON)
    return 1 - t**3 * (10 - 15 * t + 6 * t * t), -30 * t * t * (1 - t) ** 2 / (R_CUT - R_ON)


def hard(r: float) -> tuple[float, float]:
    return law(r)[:2] if r < R_CUT else (0.0, 0.0)


def including(r: float) -> tuple[float, float]:
    """The same with the cutoff itself inside."""
    return law(r)[:2] if r <= R_CUT else (0.0, 0.0)


def squared(r: float) -> tuple[float, float]:
    """Decided on squares, as most codes do."""
    return law(r)[:2] if r * r < R_CUT * R_CUT else (0.0, 0.0)


def shifted(r: float) -> tuple[float, float]:
    return (law(r)[0] - law(R_CUT)[0], law(r)[1]) if r < R_CUT else (0.0, 0.0)


def force_shifted(r: float) -> tuple[float, float]:
    energy, force, _ = law(R_CUT)
    if r >= R_CUT:
        return 0.0, 0.0
    return law(r)[0] - energy + force * (r - R_CUT), law(r)[1] - force


def switched(order: int) -> Callable[[float], tuple[float, float]]:
    def of(r: float) -> tuple[float, float]:
        energy, force, _ = law(r)
        if r <= R_ON or r >= R_CUT:
            return (energy, force) if r <= R_ON else (0.0, 0.0)
        s, slope = switch(r, order)
        return energy * s, force * s - energy * slope

    return of


def endless(r: float) -> tuple[float, float]:
    return law(r)[:2]


class Pairwise(Calculator):
    """A sum over pairs, nearest images only; atoms have an energy of their own, as in many models.

    Args:
        pair: energy and force of a distance.
        own: energy of an atom, eV.
        single: round positions, energy and forces to float32.
    """

    implemented_properties = ["energy", "forces"]  # noqa: RUF012

    def __init__(self, pair: Callable[[float], tuple[float, float]], own: float = 0.0, single: bool = False):
        super().__init__()
        self.pair, self.own, self.single = pair, own, single

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        assert isinstance(atoms, Atoms)
        vectors, distances = self.geometry(atoms)
        kept = self.kept(distances)
        energy, forces = self.own * len(atoms), np.zeros((len(atoms), 3))
        for i, j in np.argwhere(kept):
            one, force = self.pair(float(distances[i, j]))
            energy += 0.5 * one
            along = 0.5 * force * vectors[i, j] / distances[i, j]
            forces[j] += along
            forces[i] -= along
        if self.single:
            energy, forces = float(np.float32(energy)), forces.astype(np.float32)
        self.results = {"energy": energy, "forces": forces}

    def geometry(self, atoms: Atoms) -> tuple[np.ndarray, np.ndarray]:
        positions = atoms.positions.astype(np.float32 if self.single else np.float64).astype(np.float64)
        vectors = positions[None] - positions[:, None]
        if atoms.pbc.any():
            lengths = atoms.cell.lengths()
            vectors -= lengths * np.round(vectors / lengths)
        return vectors, np.sqrt((vectors**2).sum(axis=2))

    def kept(self, distances: np.ndarray) -> np.ndarray:
        return ~np.eye(len(distances), dtype=bool)


class Capped(Pairwise):
    """The same with at most so many neighbors each: the nearest, or the first in the order of the atoms."""

    def __init__(self, most: int, by: str, **options):
        super().__init__(soft, **options)
        self.most, self.by = most, by

    def kept(self, distances: np.ndarray) -> np.ndarray:
        inside = (distances < R_CUT) & ~np.eye(len(distances), dtype=bool)
        if self.by == "nearest":
            ranked = np.where(inside, distances, np.inf).argsort(axis=1, kind="stable").argsort(axis=1)
            return inside & (ranked < self.most)
        return inside & (np.cumsum(inside, axis=1) <= self.most)


def soft(r: float) -> tuple[float, float]:
    """Repulsive without a wall, gone at R_CUT with three continuous derivatives."""
    t = r / R_CUT
    if t >= 1:
        return 0.0, 0.0
    return (1 - t) ** 4, 4 * (1 - t) ** 3 / R_CUT


class Angles(Pairwise):
    """A smooth pair law, and a constant for every angle whose two sides are shorter than a length."""

    side = 4.05

    def calculate(self, atoms=None, properties=None, system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        assert isinstance(atoms, Atoms)
        near = (self.geometry(atoms)[1] < self.side).sum(axis=1) - 1
        self.results["energy"] += 1e-3 * float((near * (near - 1) / 2).sum())


def subject(make: Callable[[], object], atoms: Atoms | None = None) -> CalculatorSubject:
    """A subject in a crystal of argon that is large enough for nearest images."""
    if atoms is None:
        atoms = bulk("Ar", "fcc", a=4.7, cubic=True).repeat(3)
        atoms.rattle(0.05, seed=1)
    return CalculatorSubject("planted", make, atoms, kT=KT)


def pair_subject(pair: Callable[[float], tuple[float, float]], **options) -> CalculatorSubject:
    """Two argon atoms under a law."""
    return subject(lambda: Pairwise(pair, **options), Atoms("Ar2", [(0, 0, 0), (4, 0, 0)]))
