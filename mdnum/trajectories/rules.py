"""Membership rules: definitions of the neighbors of an atom.

A rule is *symmetric* if i and j are neighbors of each other. In a *directed* rule, j may be a neighbor of i
although i is not a neighbor of j. Squared distances are compared in float64. Every decision has a margin, a
length that is positive for neighbors. Margins of two atoms at distance r:

    CutoffRule      r_cut - r
    SpeciesCutoffs  r_cut of the two species - r
    Nearest         distance of the first outside - r for a neighbor, distance of the k-th - r for another
    Capped          as for Nearest, and never more than radius - r
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError

#: Radius of a pair of species that is never inside.
NEVER = -1.0


def _radius(value: float, where: str) -> None:
    if not (math.isfinite(value) and value > 0):
        message = f"a radius of {value!r}; expected a positive length"
        raise InputError(message, remedy="Give the cutoff in the length unit of the trajectory", where=where)


def _count(value: int, where: str) -> None:
    if isinstance(value, bool) or int(value) != value or value < 1:
        message = f"{value!r} neighbors; expected an integer of at least 1"
        raise InputError(message, remedy="Give the number of nearest neighbors to count", where=where)


class _Membership:
    """Base class of membership rules, with properties that most rules share."""

    directed = False
    needs_species = False
    name: str  # in words
    radius: float

    @property
    def reach(self) -> float:
        """Largest distance at which an atom can be a neighbor, in length units."""
        return self.radius

    @property
    def shortest(self) -> float:
        """Smallest cutoff radius (length). Infinite if the neighbors are the k nearest atoms."""
        return self.reach

    def table(
        self, species: Sequence[str] | np.ndarray
    ) -> tuple[Int[np.ndarray, "atoms"], Float[np.ndarray, "species species"]]:
        """Return species numbers of atoms, and radii of species pairs (`NEVER` if never neighbors)."""
        return np.zeros(len(species), np.int64), np.array([[float(self.reach)]])


@dataclass(frozen=True)
class CutoffRule(_Membership):
    """Rule by which a pair is inside if its distance is less than `radius` (length).

    Membership is decided by comparing r² with radius² in float64. A pair is ambiguous if its distance equals
    the radius within rounding error.
    """

    radius: float

    def __post_init__(self):
        _radius(self.radius, "CutoffRule.radius")

    @property
    def name(self) -> str:
        return f"r < {self.radius:g}"


@dataclass(frozen=True)
class SpeciesCutoffs(_Membership):
    """Rule with a cutoff radius for each listed pair of species; all other pairs are never neighbors."""

    radii: Mapping[tuple[str, str], float]

    needs_species = True

    def __post_init__(self):
        if not self.radii:
            message = "no pair of species was given"
            remedy = 'Give at least one pair, such as ("O", "H"): 2.5'
            raise InputError(message, remedy=remedy, where="SpeciesCutoffs.radii")
        for pair, value in self.radii.items():
            _radius(value, f"SpeciesCutoffs.radii[{pair}]")
            other = self.radii.get((pair[1], pair[0]), value)
            if other != value:
                message = f"{pair[0]}-{pair[1]} has two radii, {value:g} and {other:g}"
                remedy = "Give one radius: the order of the two species does not matter"
                raise InputError(message, remedy=remedy, where="SpeciesCutoffs.radii")

    @property
    def name(self) -> str:
        return ", ".join(f"{a}-{b} < {value:g}" for (a, b), value in self.radii.items())

    @property
    def reach(self) -> float:
        return max(self.radii.values())

    @property
    def shortest(self) -> float:
        return min(self.radii.values())

    def table(
        self, species: Sequence[str] | np.ndarray
    ) -> tuple[Int[np.ndarray, "atoms"], Float[np.ndarray, "species species"]]:
        """Return species numbers of atoms, and radii of species pairs (`NEVER` if never neighbors).

        Raises:
            InputError: a species of the rule does not occur among the atoms.
        """
        names, index = np.unique(np.asarray(species, str), return_inverse=True)
        place = {str(name): k for k, name in enumerate(names)}
        radii = np.full((len(names), len(names)), NEVER)
        for (a, b), value in self.radii.items():
            if missing := [one for one in (a, b) if one not in place]:
                message = f"no atom is of species {missing[0]!r}; there are {', '.join(list(place)[:20])}"
                remedy = "Use the names of species in the trajectory"
                raise InputError(message, remedy=remedy, where=f"SpeciesCutoffs.radii[{(a, b)}]")
            radii[place[a], place[b]] = radii[place[b], place[a]] = value
        return index.reshape(-1).astype(np.int64), radii


@dataclass(frozen=True)
class Nearest(_Membership):
    """Directed rule: the neighbors of an atom are the k nearest atoms, within an optional distance."""

    k: int
    within: float | None = None

    directed = True

    def __post_init__(self):
        _count(self.k, "Nearest.k")
        if self.within is not None:
            _radius(self.within, "Nearest.within")

    @property
    def name(self) -> str:
        return f"{self.k} nearest" + (f" within {self.within:g}" if self.within is not None else "")

    @property
    def most(self) -> int:
        """Largest possible number of neighbors of an atom."""
        return self.k

    @property
    def reach(self) -> float:
        return math.inf if self.within is None else self.within

    @property
    def shortest(self) -> float:
        # it is the order of distances that decides, hardly ever the radius
        return math.inf


@dataclass(frozen=True)
class Capped(_Membership):
    """Directed rule: the neighbors of an atom are the `most` nearest atoms inside a cutoff radius.

    Graph builders that keep only the nearest atoms follow this rule.
    """

    radius: float
    most: int

    directed = True

    def __post_init__(self):
        _radius(self.radius, "Capped.radius")
        _count(self.most, "Capped.most")

    @property
    def name(self) -> str:
        return f"r < {self.radius:g}, at most {self.most} neighbors"


Rule = CutoffRule | SpeciesCutoffs | Nearest | Capped


def smallest_radius(rules: Sequence[Rule]) -> float:
    """Return the smallest cutoff radius of several rules (length), or infinity."""
    return float(min((one.shortest for one in rules), default=math.inf))
