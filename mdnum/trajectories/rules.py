"""What makes two atoms neighbors: membership rules, each with a margin.

A rule is *symmetric* (a pair is inside or not, whoever asks) or *directed* (j is a neighbor of i, and i need
not be one of j). Distances are compared as float64 squares; a margin is a length, positive inside:

    CutoffRule      r_cut - r
    SpeciesCutoffs  r_cut of the two species - r
    Nearest         distance of the first outside - r for a neighbor, distance of the k-th - r for another
    Capped          the same, and never more than radius - r
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError

#: radius of a pair of species that is never inside
NEVER = -1.0


def _radius(value: float, where: str) -> None:
    if not (math.isfinite(value) and value > 0):
        message = f"a radius of {value!r}; expected a positive length"
        raise InputError(message, remedy="Give the radius in the length unit of the trajectory", where=where)


def _count(value: int, where: str) -> None:
    if isinstance(value, bool) or int(value) != value or value < 1:
        message = f"{value!r} neighbors; expected a whole number from 1"
        raise InputError(message, remedy="Give the number of neighbors to keep", where=where)


class _Membership:
    """What most rules have in common."""

    directed = False
    needs_species = False
    name: str  # in words
    radius: float

    @property
    def reach(self) -> float:
        """Distance beyond which nothing is a neighbor, length."""
        return self.radius

    @property
    def shortest(self) -> float:
        """The shortest length that distances are compared with; infinite where their order decides."""
        return self.reach

    def table(
        self, species: Sequence[str] | np.ndarray
    ) -> tuple[Int[np.ndarray, "atoms"], Float[np.ndarray, "species species"]]:
        """Species of each atom as a number, and the radius of each pair of numbers (`NEVER` without one)."""
        return np.zeros(len(species), np.int64), np.array([[float(self.reach)]])


@dataclass(frozen=True)
class CutoffRule(_Membership):
    """Inside where r < radius, a length.

    The decision compares r² with radius² in float64, as most codes do; a pair within rounding of the radius
    is ambiguous whichever way it fell.
    """

    radius: float

    def __post_init__(self):
        _radius(self.radius, "CutoffRule.radius")

    @property
    def name(self) -> str:
        return f"r < {self.radius:g}"


@dataclass(frozen=True)
class SpeciesCutoffs(_Membership):
    """A radius, length, for each pair of species, in either order; pairs without one are never inside."""

    radii: Mapping[tuple[str, str], float]

    needs_species = True

    def __post_init__(self):
        if not self.radii:
            message = "no pair of species"
            remedy = 'Give at least one, ("O", "H"): 2.5 say'
            raise InputError(message, remedy=remedy, where="SpeciesCutoffs.radii")
        for pair, value in self.radii.items():
            _radius(value, f"SpeciesCutoffs.radii[{pair}]")
            other = self.radii.get((pair[1], pair[0]), value)
            if other != value:
                message = f"{pair[0]}-{pair[1]} has two radii, {value:g} and {other:g}"
                remedy = "Give it once: the rule is the same in both directions"
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
        """As of every rule.

        Raises:
            InputError: a species of the rule that no atom has.
        """
        names, index = np.unique(np.asarray(species, str), return_inverse=True)
        place = {str(name): k for k, name in enumerate(names)}
        radii = np.full((len(names), len(names)), NEVER)
        for (a, b), value in self.radii.items():
            if missing := [one for one in (a, b) if one not in place]:
                message = f"no atom is of species {missing[0]!r}; there are {', '.join(list(place)[:20])}"
                remedy = "Write species as the trajectory names them"
                raise InputError(message, remedy=remedy, where=f"SpeciesCutoffs.radii[{(a, b)}]")
            radii[place[a], place[b]] = radii[place[b], place[a]] = value
        return index.reshape(-1).astype(np.int64), radii


@dataclass(frozen=True)
class Nearest(_Membership):
    """The k nearest of each atom within a length, directed from the atom to its neighbors."""

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
        """Neighbors an atom can have."""
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
    """A cutoff, length, with a largest number of neighbors: the `most` nearest of those inside, directed.

    What graph builders do that have a maximum number of neighbors and keep the nearest.
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
    """The shortest length that any of the rules compares distances with; infinite where none does."""
    return float(min((one.shortest for one in rules), default=math.inf))
