"""Mistakes that look alike, one or two planted in each of several potentials, and the names they must get.

Each potential is also here without a mistake. A mistake is a class that is put before a potential.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from ase import Atoms
from ase.build import bulk
from audit.planted import Good, near

from mdnum.audit.subject import CalculatorSubject

KT = 0.01


def liquid(*krypton: int) -> Atoms:
    """Eight argon atoms in a cell of a little more than a cutoff, none where symmetry puts it."""
    atoms = bulk("Ar", "fcc", a=3.9, cubic=True).repeat((2, 1, 1))
    atoms.rattle(0.05, seed=2)
    atoms.numbers[list(krypton)] = 36
    return atoms


def slab() -> Atoms:
    atoms = liquid()
    atoms.pbc = (True, True, False)
    atoms.set_cell(atoms.cell.array * np.array([[1.0], [1.0], [3.0]]))
    return atoms


def cluster() -> Atoms:
    atoms = liquid().repeat((1, 2, 1))
    atoms.pbc, atoms.cell = False, np.zeros((3, 3))
    return atoms


# -- potentials ------------------------------------------------------------------------------------


class Potential(Good):
    """A pair potential in a window: all that is wrong with another is put before it."""

    cut = 3.4

    def shifts(self, atoms: Atoms) -> np.ndarray:
        rows = atoms.cell.array[atoms.pbc]
        if not len(rows):
            return np.zeros((1, 3))
        widths = 1 / np.linalg.norm(np.linalg.pinv(rows), axis=0)
        spans = [np.arange(-n, n + 1) for n in (self.cut / widths).astype(int) + 1]
        return np.stack(np.meshgrid(*spans, indexing="ij"), -1).reshape(-1, len(rows)) @ rows

    def pairs(self, positions, shifts, atoms):
        i, j, _, vectors = near(positions, shifts, self.cut)
        keep = self.kept(atoms, i, j, vectors)
        return i[keep], j[keep], vectors[keep]

    def kept(self, atoms: Atoms, i: np.ndarray, j: np.ndarray, vectors: np.ndarray) -> Any:
        """Which of the pairs are kept."""
        return slice(None)

    def law(self, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Energy of a pair and its derivative."""
        x2 = (r / self.cut) ** 2
        window, well = (1 - x2) ** 4, 0.9 - 1.6 * x2
        return window * well, (-8 * (1 - x2) ** 3 * well - 3.2 * window) * r / self.cut**2

    def answer(self, atoms):
        i, j, vectors = self.neighbors(atoms)
        r = np.linalg.norm(vectors, axis=1)
        energies, slopes = self.terms(len(atoms), i, j, r, vectors)
        forces = np.zeros((len(atoms), 3))
        push = (slopes / r)[:, None] * vectors
        np.add.at(forces, i, push)
        np.add.at(forces, j, -push)
        return self.extra(atoms, self.summed(energies), forces)

    def terms(self, n, i, j, r, vectors) -> tuple[np.ndarray, np.ndarray]:
        """Energies that are summed, and the derivative of their sum by each directed distance."""
        u, slope = self.law(r)
        return 0.5 * u, 0.5 * slope

    def summed(self, energies: np.ndarray) -> float:
        return float(np.sum(energies))


class Switched(Potential):
    """Lennard-Jones with a switch of two continuous derivatives."""

    cut = 4.4

    def law(self, r):
        q = (2.45 / r) ** 6
        u, du = 0.04 * (q * q - q), 0.04 * (6 * q - 12 * q * q) / r
        x = np.clip((r - 3.2) / (self.cut - 3.2), 0, 1)
        s, ds = 1 - x**3 * (10 - 15 * x + 6 * x * x), -30 * x * x * (1 - x) ** 2 / (self.cut - 3.2)
        return u * s, du * s + u * ds


class Morse(Potential):
    """Morse's potential in a window."""

    cut = 3.8

    def law(self, r):
        e = np.exp(-1.8 * (r - 2.76))
        u, du = 0.05 * (e * e - 2 * e), 0.18 * (e - e * e)
        x2 = (r / self.cut) ** 2
        window, slope = (1 - x2) ** 4, -8 * r / self.cut**2 * (1 - x2) ** 3
        return 4 * u * window, 4 * (du * window + u * slope)


class Embedded(Potential):
    """An embedding of the density beside the repulsion of pairs."""

    def terms(self, n, i, j, r, vectors):
        u, slope = self.law(r)
        x2 = (r / self.cut) ** 2
        rho, drho = (1 - x2) ** 4, -8 * r / self.cut**2 * (1 - x2) ** 3
        density = np.bincount(i, rho, n)
        energies, derivative = self.embedding(density)
        return np.concatenate([0.5 * u, energies]), 0.5 * slope + derivative[i] * drho

    def embedding(self, density: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        root = np.sqrt(density + 0.1)
        return -0.3 * (root - np.sqrt(0.1)), -0.15 / root


class Angular(Potential):
    """A term of three atoms beside that of two."""

    def extra(self, atoms, energy, forces):
        i, j, vectors = self.neighbors(atoms)
        r = np.linalg.norm(vectors, axis=1)
        for center in range(len(atoms)):
            mine = np.flatnonzero(i == center)
            d, v, ends = r[mine], vectors[mine], j[mine]
            w, dw = (1 - (d / self.cut) ** 2) ** 4, -8 * d / self.cut**2 * (1 - (d / self.cut) ** 2) ** 3
            unit = v / d[:, None]
            cos = unit @ unit.T
            off = cos + 1 / 3
            np.fill_diagonal(off, 0.0)
            # 0.05 times the sum over ordered couples of w w off²
            energy += 0.05 * float(w @ off**2 @ w)
            radial = 0.1 * dw * (off**2 @ w)
            turn = 0.2 * (
                (w[:, None] * w[None] * off) @ unit
                - ((w[:, None] * w[None] * off * cos).sum(1))[:, None] * unit
            )
            grad = radial[:, None] * unit + turn / d[:, None]
            np.add.at(forces, ends, -grad)
            forces[center] += grad.sum(axis=0)
        return super().extra(atoms, energy, forces)


POTENTIALS = (Potential, Switched, Morse, Embedded, Angular)


# -- mistakes --------------------------------------------------------------------------------------


class ByOrder(Potential):
    """Keeps the first neighbors in the order of the list."""

    most = 9

    def kept(self, atoms, i, j, vectors):
        return np.arange(len(i)) - np.searchsorted(i, i) < self.most


class Nearest(Potential):
    """Keeps the nearest neighbors."""

    most = 9
    key: Any = np.float64

    def kept(self, atoms, i, j, vectors):
        r = np.linalg.norm(vectors, axis=1).astype(self.key)
        order = np.lexsort((np.arange(len(i)), r, i))
        rank = np.empty(len(i), int)
        rank[order] = np.arange(len(i)) - np.searchsorted(i[order], i[order])
        return rank < self.most


class SingleKeys(Nearest):
    """Sorts its neighbors by distances in single precision."""

    most = 24
    key = np.float32


class SingleSum(Potential):
    """Adds up its terms one by one in single precision, in the order of the list."""

    def summed(self, energies):
        return float(np.cumsum(energies.astype(np.float32), dtype=np.float32)[-1]) if len(energies) else 0.0


class SingleSumOf(SingleSum):
    """The same, of which an exact part of the energy is added."""

    def extra(self, atoms, energy, forces):
        return super().extra(atoms, energy - np.pi * len(atoms), forces)


class WrongForce(Potential):
    """A force is wrong by its place in the list."""

    where = staticmethod(lambda n: np.arange(n) == n - 1)
    factor = 0.0

    def extra(self, atoms, energy, forces):
        energy, forces = super().extra(atoms, energy, forces)
        if len(atoms) > 1:
            forces = np.where(self.where(len(atoms))[:, None], self.factor * forces, forces)
        return energy, forces


class FirstForce(WrongForce):
    where = staticmethod(lambda n: np.arange(n) == 0)


class EighthForce(WrongForce):
    where = staticmethod(lambda n: np.arange(n) % 8 == 7)


class FourthForce(WrongForce):
    where = staticmethod(lambda n: np.arange(n) % 4 == 1)
    factor = 1.1


class LastLost(Potential):
    """The last atom takes part in nothing."""

    def kept(self, atoms, i, j, vectors):
        last = len(atoms) - 1 if len(atoms) > 2 else -1
        return (i != last) & (j != last)


class LeftHanded(Potential):
    """Wraps by an inverse whose determinant has lost its sign."""

    def positions(self, atoms):
        if not atoms.pbc.all():
            return super().positions(atoms)
        cell = atoms.cell.array
        inverse = np.linalg.inv(cell) * np.sign(np.linalg.det(cell))
        return atoms.positions - np.floor(atoms.positions @ inverse) @ cell


class LeftVolume(Potential):
    """Multiplies by a volume that has a sign, and divides by one that has none."""

    def extra(self, atoms, energy, forces):
        energy, forces = super().extra(atoms, energy, forces)
        sign = np.sign(np.linalg.det(atoms.cell.array)) if atoms.pbc.all() else 1.0
        return sign * energy, sign * forces


class Chiral(Potential):
    """Tells left from right: a triple product of three sums over an atom's neighbors."""

    def extra(self, atoms, energy, forces):
        energy, forces = super().extra(atoms, energy, forces)
        i, _, v = self.neighbors(atoms)
        r = np.linalg.norm(v, axis=1)
        w = (1 - (r / self.cut) ** 2) ** 4
        for center in range(len(atoms)):
            mine = i == center
            sums = [((w * r**power)[mine] @ v[mine]) for power in range(3)]
            energy += 1e2 * float(np.linalg.det(sums))
        return energy, forces


class Scaled(Potential):
    """Forces in another unit, nearly."""

    factor = 1.04

    def extra(self, atoms, energy, forces):
        energy, forces = super().extra(atoms, energy, forces)
        return energy, self.factor * forces


class TermMissing(Potential):
    """A repulsion that the energy alone has."""

    def extra(self, atoms, energy, forces):
        energy, forces = super().extra(atoms, energy, forces)
        _, _, v = self.neighbors(atoms)
        r = np.linalg.norm(v, axis=1)
        return energy + 0.01 * float(np.sum((1 - (r / self.cut) ** 2) ** 5)), forces


class Predicted(Potential):
    """Forces with a part that no energy has."""

    def extra(self, atoms, energy, forces):
        energy, forces = super().extra(atoms, energy, forces)
        i, _, v = self.neighbors(atoms)
        w = (1 - (np.linalg.norm(v, axis=1) / self.cut) ** 2) ** 4
        size = np.bincount(i, w, len(atoms))
        return energy, forces + 0.05 * (size * forces.T).T


class Padded(Potential):
    """Shares of a pair's energy by a denominator that is padded to some number of neighbors."""

    width = 5

    def terms(self, n, i, j, r, vectors):
        u, slope = self.law(r)
        x2 = (r / self.cut) ** 2
        s, ds = (1 - x2) ** 4, -8 * r / self.cut**2 * (1 - x2) ** 3
        e, de = np.exp(2 * s), 2 * np.exp(2 * s) * ds
        z = np.bincount(i, e, n) + np.maximum(self.width - np.bincount(i, minlength=n), 0)
        top = np.bincount(i, e * u, n)
        return 4 * top / z, 4 * ((de * u + e * slope) / z[i] - top[i] / z[i] ** 2 * de)


class PerNeighbor(Potential):
    """The mean over neighbors within the cutoff, where it should be their sum."""

    def terms(self, n, i, j, r, vectors):
        u, slope = super().terms(n, i, j, r, vectors)
        count = np.maximum(np.bincount(i, minlength=n), 1)
        return u / count[i], slope / count[i]


class Kinked(Embedded):
    """An embedding function with a kink, at a density that two atoms alone do not reach."""

    cut, kink = 4.6, 2.07

    def embedding(self, density):
        above = density > self.kink
        return -0.2 * np.where(above, density - self.kink, 0.0), -0.2 * above


class Cut(Potential):
    """An energy that does not end at 0."""

    def law(self, r):
        u, slope = super().law(r)
        return u + 0.01, slope


class Kink(Potential):
    """A force that does not end at 0."""

    def law(self, r):
        u, slope = super().law(r)
        return u + 0.01 * (r - self.cut), slope + 0.01


class NoWrap(Potential):
    """Searches one cell away, and does not wrap."""

    def positions(self, atoms):
        return atoms.positions


class GhostForces(Potential):
    """What an image feels is not given to the atom it belongs to."""

    def answer(self, atoms):
        i, j, vectors = self.neighbors(atoms)
        r = np.linalg.norm(vectors, axis=1)
        energies, slopes = self.terms(len(atoms), i, j, r, vectors)
        wrapped = self.positions(atoms)
        ghost = np.linalg.norm(vectors - (wrapped[j] - wrapped[i]), axis=1) > 1e-9
        push = (slopes / r)[:, None] * vectors
        forces = np.zeros((len(atoms), 3))
        np.add.at(forces, i, push)
        np.add.at(forces, j[~ghost], -push[~ghost])
        return self.extra(atoms, self.summed(energies), forces)


class Random(Potential):
    """Leaves a pair out now and then, whichever."""

    share = 0.2

    def __init__(self):
        super().__init__()
        self.rng = np.random.default_rng()

    def kept(self, atoms, i, j, vectors):
        if not len(i) or self.rng.random() >= self.share:
            return np.ones(len(i), bool)
        return np.arange(len(i)) != self.rng.integers(len(i))


class RandomForce(Potential):
    """One atom's force is wrong now and then."""

    def __init__(self):
        super().__init__()
        self.rng = np.random.default_rng()

    def extra(self, atoms, energy, forces):
        energy, forces = super().extra(atoms, energy, forces)
        hit = (self.rng.random() < 0.2) * (np.arange(len(forces)) == self.rng.integers(len(forces)))
        return energy, forces + 0.1 * hit[:, None]


class Appearance(Potential):
    """Parameters of species by the order in which they appear."""

    def neighbors(self, atoms):
        self.met = atoms.numbers != atoms.numbers[0]
        return super().neighbors(atoms)

    def terms(self, n, i, j, r, vectors):
        u, slope = super().terms(n, i, j, r, vectors)
        size = 1.0 + 0.1 * self.met
        return size[i] * size[j] * u, size[i] * size[j] * slope


def planted(*mistakes: type[Any], on: type[Any] = Potential, **more: Any) -> type[Any]:
    """A potential with mistakes in it."""
    name = "".join(one.__name__ for one in (*mistakes, on))
    return type(name, (*mistakes, on), more)


def subject(make: Any, atoms: Atoms | None = None) -> CalculatorSubject:
    return CalculatorSubject("planted", make, liquid() if atoms is None else atoms, kT=KT)


BY_ORDER = ("NEIGHBOR_CAP_BY_ORDER",)
#: What is planted, in which structure, and the codes under which it is listed: all of them and no other.
RIGHT = {
    **{f"{one.__name__} in a crystal": (one, liquid(), ()) for one in POTENTIALS},
    "Switched as a cluster": (Switched, cluster(), ()),
    "Potential as a slab": (Potential, slab(), ()),
    "Morse of two elements": (Morse, liquid(1, 4), ()),
}
WRONG = {
    "cap by order of 9": (planted(ByOrder), liquid(), BY_ORDER),
    "cap by order of 20": (planted(ByOrder, most=20, on=Switched), liquid(), BY_ORDER),
    "cap by order of 12, embedded": (planted(ByOrder, most=12, on=Embedded), liquid(), BY_ORDER),
    "cap by order of 60, not reached": (planted(ByOrder, most=60, on=Morse), liquid(), BY_ORDER),
    "cap of the nearest 9": (planted(Nearest), liquid(), ("NEIGHBOR_CAP",)),
    "cap of the nearest 32": (planted(Nearest, most=32, on=Switched), liquid(), ("NEIGHBOR_CAP",)),
    "cap of the nearest 12, embedded": (planted(Nearest, most=12, on=Embedded), liquid(), ("NEIGHBOR_CAP",)),
    "cap of 24, single keys": (planted(SingleKeys), liquid(), ("NEIGHBOR_CAP",)),
    "cap of 48, single keys": (planted(SingleKeys, most=48, on=Switched), liquid(), ("NEIGHBOR_CAP",)),
    "single sum": (planted(SingleSum), liquid(), ()),
    "single sum, switched, 32 atoms": (planted(SingleSum, on=Switched), liquid().repeat((1, 2, 2)), ()),
    "single sum and an exact part": (planted(SingleSumOf, on=Morse), liquid(), ()),
    "last force": (planted(WrongForce), liquid(), ("PLACE_IN_LIST",)),
    "last force, cluster": (planted(WrongForce, on=Switched), cluster(), ("PLACE_IN_LIST",)),
    "first force": (planted(FirstForce, on=Embedded), liquid(), ("PLACE_IN_LIST",)),
    "every eighth force": (planted(EighthForce), liquid().repeat((1, 2, 1)), ("PLACE_IN_LIST",)),
    "every fourth force 10 % too large": (planted(FourthForce, on=Morse), liquid(), ("PLACE_IN_LIST",)),
    "last atom lost": (planted(LastLost), liquid(), ("PLACE_IN_LIST",)),
    "left-handed wrap": (planted(LeftHanded, on=Switched), liquid(), ("LEFT_HANDED",)),
    "left-handed cells": (planted(LeftVolume, on=Switched), liquid(), ("LEFT_HANDED",)),
    "left-handed images": (planted(LeftHanded, on=Embedded), liquid(), ("LEFT_HANDED",)),
    "mirror images": (planted(Chiral), liquid(), ("MIRROR", "FORCES_NOT_GRADIENT")),
    "mirror images, cluster": (planted(Chiral), cluster(), ("MIRROR", "FORCES_NOT_GRADIENT")),
    "scaled forces": (planted(Scaled, on=Switched), liquid(), ("FORCES_NOT_GRADIENT",)),
    "forces without a term": (planted(TermMissing), liquid(), ("FORCES_NOT_GRADIENT",)),
    "forces with a curl": (planted(Predicted), liquid(), ("FORCES_NOT_GRADIENT",)),
    "padded shares": (planted(Padded), liquid(), ("CUTOFF_JUMP_AMONG_MANY",)),
    "padded shares, switched": (planted(Padded, on=Switched), liquid(), ("CUTOFF_JUMP_AMONG_MANY",)),
    "mean of neighbors": (planted(PerNeighbor), liquid(), ("CUTOFF_JUMP_AMONG_MANY",)),
    "kinked embedding": (Kinked, liquid(), ("JUMP_AMONG_MANY",)),
    "hard cutoff": (planted(Cut), liquid(), ("ENERGY_JUMP",)),
    "kinked cutoff": (planted(Kink, on=Embedded), liquid(), ("FORCE_JUMP",)),
    "no wrap": (planted(NoWrap, on=Switched), liquid(), ("IMAGES",)),
    "forces of ghosts": (planted(GhostForces), liquid(), ("IMAGES",)),
    "pairs at random": (planted(Random), liquid(), ("NOT_REPEATABLE",)),
    "forces at random": (planted(RandomForce, on=Switched), liquid(), ("NOT_REPEATABLE",)),
    "parameters by appearance": (planted(Appearance), liquid(1, 4), ("ORDER",)),
    # two at once: both by name, and what follows from them below
    "cap by order and scaled forces": (planted(ByOrder, Scaled), liquid(), BY_ORDER),
    "last force and a hard cutoff": (planted(WrongForce, Cut), liquid(), ("ENERGY_JUMP", "PLACE_IN_LIST")),
    "no wrap and a hard cutoff": (planted(NoWrap, Cut), liquid(), ("ENERGY_JUMP", "IMAGES")),
    "left-handed and a kink": (planted(LeftVolume, Kink), liquid(), ("FORCE_JUMP", "LEFT_HANDED")),
    "last force at random pairs": (planted(WrongForce, Random), liquid(), ("NOT_REPEATABLE",)),
    "single sum and last force": (planted(SingleSum, WrongForce), liquid(), ("PLACE_IN_LIST",)),
    "single sum and a cap": (planted(SingleSum, Nearest), liquid(), ("NEIGHBOR_CAP",)),
    "left-handed and mirror": (
        planted(LeftVolume, Chiral), liquid(), ("FORCES_NOT_GRADIENT", "LEFT_HANDED", "MIRROR")
    ),
}  # fmt: skip
