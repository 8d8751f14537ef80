"""One atom or molecule moved through others along a straight line, and whose distances change on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from ase import Atoms
from jaxtyping import Float, Int

from mdnum.audit.base import Subject
from mdnum.audit.curve import Curve
from mdnum.audit.threshold import Threshold

_TIED = 1e-6
"""Two distances this near to one another are tied, length."""


@dataclass(frozen=True)
class Crossing:
    """A place on a route at which a distance passes a threshold.

    Attributes:
        at: along the route, length.
        other: the atom whose distance it is.
        threshold: which is passed.
    """

    at: float
    other: int
    threshold: Threshold


@dataclass(frozen=True)
class Route:
    """A structure in which some atoms move along a line.

    Attributes:
        name: in words.
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

    def curve(self, subject: Subject) -> Curve:
        """Energy, and force along the line on what moves."""

        def at(along: float) -> tuple[float, float]:
            atoms = self.at(along)
            energy = subject.energy(atoms)
            return energy, float((subject.forces(atoms)[self.moving] @ self.direction).sum())

        return Curve(at)

    def crossings(self, thresholds: Sequence[Threshold], low: float, high: float) -> list[Crossing]:
        """Every place between low and high at which the lead's distance to an atom passes a threshold.

        The distance along a line is a hyperbola, so the places are roots of a quadratic.
        """
        found: list[Crossing] = []
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
                        found.append(Crossing(float(root), other, threshold))
        return sorted(found, key=lambda one: one.at)

    def _others(self, reach: float) -> list[tuple[int, Float[np.ndarray, "3"]]]:
        """(atom, vector from the lead to it or an image) within reach, without those that move along."""
        atoms = self.atoms
        cell = np.asarray(atoms.cell)
        counts = [0, 0, 0]
        if atoms.pbc.any():
            heights = 1.0 / np.linalg.norm(np.linalg.inv(np.asarray(atoms.cell.complete())), axis=0)
            counts = [
                int(np.ceil(reach / h)) + 1 if yes else 0 for h, yes in zip(heights, atoms.pbc, strict=True)
            ]
        shifts = np.array(list(product(*(range(-n, n + 1) for n in counts)))) @ cell
        rest = np.setdiff1d(np.arange(len(atoms)), self.moving)
        vectors = atoms.positions[rest][:, None] - atoms.positions[self.lead] + shifts[None]
        near = np.linalg.norm(vectors, axis=2) < reach
        return [(int(rest[a]), vectors[a, b]) for a, b in np.argwhere(near)]

    def ties(self, along: float) -> list[tuple[int, int]]:
        """(atom, k) where, at a place, an atom's k-th and (k+1)-th neighbors are equally far."""
        atoms = self.at(along)
        distances = atoms.get_all_distances(mic=bool(atoms.pbc.any()))
        found: list[tuple[int, int]] = []
        for center, row in enumerate(distances):
            others = np.sort(np.delete(row, center))
            for k in np.flatnonzero(np.diff(others) < _TIED):
                if center == self.lead or abs(others[k] - row[self.lead]) < _TIED:
                    found.append((center, int(k) + 1))
        return found
