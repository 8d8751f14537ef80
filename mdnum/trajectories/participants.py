"""Which atoms of a trajectory take part in a rule, on which side, and with which radii."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.errors import InputError
from mdnum.trajectories.binned import Sides, binned
from mdnum.trajectories.frame import Box
from mdnum.trajectories.lattice import lattice_of
from mdnum.trajectories.rules import Cutoff, Rule, SpeciesCutoffs


@dataclass(frozen=True)
class Participants:
    """The atoms that take part, numbered among themselves.

    Attributes:
        labels: their numbers in the file.
        sides: who is asked for neighbors, and who can be one.
        radii: by species, length; negative for pairs that are never inside.
        both: atoms on both sides: images of themselves can be their neighbors.
        own: how many of those there are, by species.
    """

    labels: Int[np.ndarray, "participants"]
    sides: Sides
    radii: Float[np.ndarray, "species species"]
    both: Bool[np.ndarray, "participants"]
    own: Int[np.ndarray, "species"]

    @property
    def radius(self) -> float:
        """Largest radius, length."""
        return float(self.radii.max(initial=0.0))


def participants(
    rule: Rule,
    first: Int[np.ndarray, "first"] | None,
    second: Int[np.ndarray, "second"] | None,
    species: np.ndarray | None,
    atoms: int,
) -> Participants:
    """Number the atoms that take part, in the order of the file.

    Args:
        first, second: as of `Tracker`, sorted.
        species: of each atom of the file.
        atoms: of the file.
    Raises:
        InputError: an atom that is not there; as many species as atoms are expected.
    """
    everyone = np.arange(atoms)
    first = everyone if first is None else first
    second = first if second is None else second
    for name, chosen in (("first", first), ("second", second)):
        if len(chosen) and chosen.max() >= atoms:
            raise InputError(
                f"atom {int(chosen.max())} is selected, but frames have {atoms} atoms (from 0)",
                remedy="Select atoms of this trajectory",
                where=name,
            )
    if species is not None and len(species) != atoms:
        raise InputError(
            f"{len(species)} species for frames of {atoms} atoms",
            remedy="Use the topology that belongs to the trajectory",
            where="species",
        )
    centers, others = np.zeros(atoms, bool), np.zeros(atoms, bool)
    centers[first], others[second] = True, True
    labels = np.flatnonzero(centers | others)
    centers, others = centers[labels], others[labels]
    if (centers == others).all():
        # the same array: pairs within one set are searched for from one side only
        others = centers
    kinds, radii = _kinds_and_radii(rule, labels, species)
    both = centers & others
    own = np.bincount(kinds[both], minlength=len(radii))
    return Participants(labels, Sides(centers, others, kinds), radii, both, own)


def by_place(who: Participants, positions: Float[np.ndarray, "atoms 3"], box: Box) -> Participants:
    """The same atoms numbered by where they are: what is near in space is near in memory.

    Args:
        positions: of all atoms of the file, length.
        box: theirs.
    Raises:
        InputError: the box is none.
    """
    x = np.empty((len(who.labels), 3))
    if (
        not np.isfinite(taken(np.require(positions, np.float64, ["C", "W"]), who.labels, x))
        or not who.radius > 0
    ):
        return who
    everyone = np.ones(len(x), bool)
    order = binned(x, lattice_of(box), Sides(everyone, everyone, who.sides.species), who.radius, 0.0).order
    others = who.sides.others[order]
    centers = others if who.sides.centers is who.sides.others else who.sides.centers[order]
    sides = Sides(centers, others, who.sides.species[order])
    return replace(who, labels=who.labels[order], sides=sides, both=who.both[order])


@numba.njit(cache=True, nogil=True)
def taken(positions, labels, out):
    """Copy the positions of some atoms; returns the largest coordinate, not finite where one is not."""
    most0, most1, most2, finite = 0.0, 0.0, 0.0, 0
    for at in range(labels.shape[0]):
        i = labels[at]
        x0, x1, x2 = positions[i, 0], positions[i, 1], positions[i, 2]
        out[at, 0], out[at, 1], out[at, 2] = x0, x1, x2
        most0, most1, most2 = max(most0, abs(x0)), max(most1, abs(x1)), max(most2, abs(x2))
        # nan is larger than nothing
        finite += int(x0 - x0 == 0.0 and x1 - x1 == 0.0 and x2 - x2 == 0.0)
    return max(most0, most1, most2) if finite == labels.shape[0] else np.inf


def _kinds_and_radii(
    rule: Rule, labels: np.ndarray, species: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    none = np.zeros(len(labels), np.int64)
    if isinstance(rule, SpeciesCutoffs):
        assert species is not None
        # species of atoms that do not take part count too: a selection may hold none of one
        kinds, radii = rule.table(list(species))
        return kinds[labels], radii
    return none, np.array([[float(rule.radius if isinstance(rule, Cutoff) else rule.reach)]])


def indices(chosen: Sequence[int] | np.ndarray | None, where: str) -> np.ndarray | None:
    """Sorted atom numbers, each once."""
    if chosen is None:
        return None
    made = np.asarray(chosen)
    if made.size == 0:
        return np.zeros(0, np.int64)
    if made.ndim != 1 or made.dtype.kind not in "iu" or made.min() < 0:
        raise InputError(
            f"expected whole numbers from 0, got {made.dtype} of shape {made.shape}",
            remedy="Give the indices of the atoms in the trajectory, from 0",
            where=where,
        )
    return np.unique(made.astype(np.int64))
