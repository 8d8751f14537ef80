"""Test cases for neighbor lists: atoms in a box, for one or several calls."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge
from numpy import ndarray
from pydantic import FiniteFloat, PlainValidator, StrictBool

from mdnum.plain import beside
from mdnum.references.oracle import PairSet

#: Descriptions of the areas of test cases, by name, in the order in which they are tested and reported.
AREAS: Mapping[str, str] = MappingProxyType(beside(__file__)["areas"])

Pbc = tuple[StrictBool, StrictBool, StrictBool]


def _rows(value: Any) -> ndarray:
    rows = np.array(value, np.float64).reshape(-1, 3)
    rows.setflags(write=False)
    return rows


def _finite(value: Any) -> ndarray:
    if not np.isfinite(rows := _rows(value)).all():
        raise ValueError("a coordinate of an atom is not a finite number")
    return rows


def _vectors(value: Any) -> ndarray:
    if (rows := _finite(value)).shape != (3, 3):
        raise ValueError("the box is not a 3 x 3 array; expected three lattice vectors")
    return rows


#: Arrays that JSON restores exactly: the shortest decimal form of a double determines the double.
Rows = Annotated[ndarray, PlainValidator(_finite)]
Vectors = Annotated[ndarray, PlainValidator(_vectors)]
Length = Annotated[FiniteFloat, Ge(0)]


@dataclass(frozen=True)
class Still:
    """Positions and cell vectors at one call of a neighbor list."""

    positions: Rows  # length, shape (atoms, 3)
    cell: Vectors  # lattice vectors as rows, length; rows of axes that do not repeat may hold anything finite
    fresh: StrictBool = False  # a list that is kept is allocated here, rather than updated
    skin: Length | None = None  # that it is allocated with, length; None for that of the case

    def __post_init__(self) -> None:
        object.__setattr__(self, "positions", _rows(self.positions))
        object.__setattr__(self, "cell", _rows(self.cell))


@dataclass(frozen=True)
class Case:
    """A test case: atoms in a box at one or several calls, and a cutoff."""

    name: str  # what is special, in words
    area: str  # a key of `AREAS`
    # one for a list that is asked once; the steps of a sequence for one that is kept
    stills: tuple[Still, ...]
    pbc: Pbc  # which axes repeat
    r_cut: Length  # cutoff, length
    skin: Length = 0.0  # of a list that is kept, length; the largest where it changes
    known: Annotated[PairSet | None, PlainValidator(lambda pairs: pairs)] = field(
        default=None, repr=False, compare=False
    )  # the pairs of a single still where they are known without a search
    motions: int = 0  # how many of its steps bring a pair from beyond the list to inside the cutoff (`rule`)

    @property
    def atoms(self) -> int:
        """Number of atoms in the test case. The largest if calls differ."""
        return max(len(still.positions) for still in self.stills)

    @property
    def steps(self) -> int:
        """Number of calls of the neighbor list in the test case."""
        return len(self.stills)

    def until(self, steps: int) -> Case:
        """Return the test case with only its first `steps` calls."""
        return replace(self, stills=self.stills[:steps])

    def only(self, atoms: ndarray) -> Case:
        """Return the test case with some of the atoms, in the given order."""
        stills = tuple(
            replace(still, positions=still.positions[atoms[atoms < len(still.positions)]])
            for still in self.stills
        )
        return replace(self, stills=stills, known=None if self.known is None else _among(self.known, atoms))

    def changed(self, positions: Any = None, cell: Any = None, **other: Any) -> Case:
        """Return the test case with positions and cells changed by the given functions."""
        same = lambda rows: rows  # noqa: E731
        x, box = positions or same, cell or same
        stills = tuple(replace(one, positions=x(one.positions), cell=box(one.cell)) for one in self.stills)
        return replace(self, **{"stills": stills, "known": None, **other})

    def equals(self, other: Case) -> bool:
        """Return whether another test case has the same positions, cells, cutoff and skin."""
        return (self.pbc, self.r_cut, self.skin) == (other.pbc, other.r_cut, other.skin) and all(
            np.array_equal(a.positions, b.positions) and np.array_equal(a.cell, b.cell)
            for a, b in zip(self.stills, other.stills, strict=True)
        )


def matrix(cell: Any) -> ndarray:
    """Convert a matrix, edge lengths or a cube's edge to lattice vectors (rows)."""
    cell = np.asarray(cell, np.float64)
    return np.diag(cell * np.ones(3)) if cell.ndim < 2 else cell


def _axes(pbc: bool | Sequence[bool]) -> Pbc:
    x, y, z = (pbc,) * 3 if isinstance(pbc, bool | np.bool_) else pbc
    return bool(x), bool(y), bool(z)


def once(
    name: str,
    area: str,
    positions: Any,
    cell: Any = None,
    pbc: bool | Sequence[bool] = True,
    r_cut: float = 1.0,
    known: PairSet | None = None,
) -> Case:
    """Return a test case with one call. Without a cell, the test case has no box."""
    if cell is None:
        cell, pbc = np.zeros((3, 3)), False
    return Case(name, area, (Still(positions, matrix(cell)),), _axes(pbc), float(r_cut), known=known)


def sequence(
    name: str,
    area: str,
    path: Iterable[Any],
    cell: Any,
    r_cut: float = 1.0,
    skin: float = 0.3,
    pbc: bool | Sequence[bool] = True,
) -> Case:
    """Return a test case with several calls: positions or tuples (positions, cell)."""
    places = (place if isinstance(place, tuple) else (place, cell) for place in path)
    stills = tuple(Still(positions, matrix(box)) for positions, box in places)
    return Case(name, area, stills, _axes(pbc), float(r_cut), float(skin))


def _among(pairs: PairSet, atoms: ndarray) -> PairSet:
    """Return the pairs within `atoms`, as indices into `atoms`."""
    most = int(max(atoms.max(initial=-1), pairs.i.max(initial=-1), pairs.j.max(initial=-1))) + 1
    new = np.full(most, -1)
    new[atoms] = np.arange(len(atoms))
    i, j, shift = new[pairs.i], new[pairs.j], pairs.shift.copy()
    shift[i > j] *= -1
    i, j = np.minimum(i, j), np.maximum(i, j)
    return PairSet(i, j, shift, pairs.distance, pairs.inside, pairs.exact).select(i >= 0)


def gas(count: int, cell, seed: int, low: float = 0.0, high: float = 1.0) -> ndarray:
    """Return random positions whose fractional coordinates are uniform between `low` and `high`."""
    return np.random.default_rng(seed).uniform(low, high, (count, 3)) @ matrix(cell)


def grid(count: int) -> ndarray:
    """Return all integer coordinates in a cube with `count` points along each edge."""
    return np.stack(np.meshgrid(*[np.arange(count)] * 3, indexing="ij"), -1).reshape(-1, 3)
