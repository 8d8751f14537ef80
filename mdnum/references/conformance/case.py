"""One question to a neighbor list: atoms in a box, once or several times in a row."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy import ndarray

from mdnum.references.oracle import PairSet

#: What a case is about, by the word it goes by; in the order in which they are asked and told.
AREAS: Mapping[str, str] = MappingProxyType(
    {
        "few": "no atom, one, two",
        "boxes": "orthorhombic, skewed, thin, huge, tiny, turned, left-handed",
        "axes": "axes that do not repeat, and what their cell vectors hold",
        "images": "cells narrower than two cutoffs: a pair counts once for each image",
        "outside": "atoms on the faces of the box, just outside it and many boxes away",
        "ties": "pairs at the cutoff and within a few ulps of it",
        "coincident": "atoms in one place, or in one place through the box",
        "crowded": "many neighbors on few atoms: capacities and caps",
        "large": "thousands of atoms with a pair set that is known in closed form",
        "random": "boxes, cutoffs and coordinates drawn at random",
        "reuse": "the same list asked again: other atoms, fewer, more, the same",
        "motion": "a list in use while atoms move",
        "wrapping": "a list in use while atoms leave the box and come back on its other side",
        "strain": "a list in use while the box changes",
        "rule": "a list in use while a pair comes inside by the smallest of motions",
    }
)

#: Areas of a list that is kept and brought up to date.
KEPT = ("motion", "wrapping", "strain", "rule")


@dataclass(frozen=True)
class Still:
    """Where the atoms are at one moment.

    Attributes:
        positions: length, shape (atoms, 3).
        cell: lattice vectors as rows, length; rows of axes that do not repeat may hold anything finite.
        fresh: a list that is kept starts anew here, rather than being brought up to date.
        skin: that it starts anew with, length; None for that of the case.
    """

    positions: ndarray
    cell: ndarray
    fresh: bool = False
    skin: float | None = None

    def __post_init__(self) -> None:
        for name in ("positions", "cell"):
            value = np.array(getattr(self, name), np.float64).reshape(-1, 3)
            value.setflags(write=False)
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class Case:
    """Atoms in a box at one moment or several, a cutoff, and what is to be learned from them.

    Attributes:
        name: what is special, in words.
        area: a key of `AREAS`.
        stills: one for a list that is asked once; the steps of a script for one that is kept.
        pbc: which axes repeat.
        r_cut: cutoff, length.
        skin: of a list that is kept, length; the largest where it changes.
        known: the pairs of a single still where they are known without a search.
        motions: how many of its steps bring a pair from beyond the list to inside the cutoff (`rule`).
    """

    name: str
    area: str
    stills: tuple[Still, ...]
    pbc: tuple[bool, bool, bool]
    r_cut: float
    skin: float = 0.0
    known: PairSet | None = field(default=None, repr=False, compare=False)
    motions: int = 0

    @property
    def atoms(self) -> int:
        """Number of atoms, the largest where it changes."""
        return max(len(still.positions) for still in self.stills)

    @property
    def steps(self) -> int:
        """Number of times that the list is asked."""
        return len(self.stills)

    def until(self, steps: int) -> Case:
        """The first steps of it."""
        return replace(self, stills=self.stills[:steps])

    def only(self, atoms: ndarray) -> Case:
        """The same with these atoms alone, in this order; a still that lacks some has the others."""
        stills = tuple(
            replace(still, positions=still.positions[atoms[atoms < len(still.positions)]])
            for still in self.stills
        )
        return replace(self, stills=stills, known=None if self.known is None else _among(self.known, atoms))

    def plain(self) -> dict[str, Any]:
        """For a table: what it is, without its coordinates."""
        return {
            "case": self.name,
            "area": self.area,
            "atoms": self.atoms,
            "steps": self.steps,
            "r_cut": float(self.r_cut),
            "skin": float(self.skin),
        }


def one(
    name: str,
    area: str,
    positions: Any,
    cell: Any = None,
    pbc: bool | Sequence[bool] = True,
    r_cut: float = 1.0,
    known: PairSet | None = None,
) -> Case:
    """A case of a single still; without a cell, free atoms."""
    axes = (bool(pbc),) * 3 if isinstance(pbc, bool | np.bool_) else tuple(bool(axis) for axis in pbc)
    if cell is None:
        cell, axes = np.zeros((3, 3)), (False, False, False)
    matrix = np.asarray(cell, np.float64)
    matrix = np.diag(matrix * np.ones(3)) if matrix.ndim < 2 else matrix
    return Case(name, area, (Still(positions, matrix),), axes, float(r_cut), known=known)  # type: ignore[arg-type]


def script(
    name: str,
    area: str,
    path: Iterable[Any],
    cell: Any,
    r_cut: float = 1.0,
    skin: float = 0.3,
    pbc: bool | Sequence[bool] = True,
) -> Case:
    """A case of several stills: positions, or (positions, cell), one after the other."""
    stills = []
    for place in path:
        positions, box = place if isinstance(place, tuple) else (place, cell)
        matrix = np.asarray(box, np.float64)
        stills.append(Still(positions, np.diag(matrix * np.ones(3)) if matrix.ndim < 2 else matrix))
    axes = (bool(pbc),) * 3 if isinstance(pbc, bool | np.bool_) else tuple(bool(axis) for axis in pbc)
    return Case(name, area, tuple(stills), axes, float(r_cut), float(skin))  # type: ignore[arg-type]


def _among(pairs: PairSet, atoms: ndarray) -> PairSet:
    """The pairs of some of the atoms, by their new numbers."""
    most = int(max(atoms.max(initial=-1), pairs.i.max(initial=-1), pairs.j.max(initial=-1))) + 1
    new = np.full(most, -1)
    new[atoms] = np.arange(len(atoms))
    i, j, shift = new[pairs.i], new[pairs.j], pairs.shift.copy()
    turned = i > j
    shift[turned] *= -1
    i, j = np.minimum(i, j), np.maximum(i, j)
    kept = i >= 0
    moved = PairSet(i, j, shift, pairs.distance, pairs.inside, pairs.exact)
    return moved.select(kept)
