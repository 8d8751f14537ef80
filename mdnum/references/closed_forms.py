"""Pair potentials written a second time, in plain numpy, from the formulas alone; cutoffs by `reference`.

Nothing here is shared with what a run evaluates: it is the judge where ASE has no class for a potential or a cutoff,
and the third opinion where it has one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from mdnum.md.cutoffs import CUTOFFS, AtCutoff
from mdnum.md.potentials import POTENTIALS
from mdnum.systems import pairs
from mdnum.systems.schema import SystemSpec

Form = Callable[[ndarray], tuple[ndarray, ndarray]]  # r -> u(r), u'(r)


@dataclass(frozen=True)
class PairForm:
    """The interaction of one pair of species.

    Attributes:
        species: the two symbols.
        kind: potential.
        constants: its constants by name, in the units of the system file.
        cutoff: cutoff kind.
        r_cut: cutoff radius.
        r_onset: where switching starts; r_cut for cutoffs that do not switch.
        compare: what inside means: "r2 <", "r2 <=", "r <" or "r <=".
    """

    species: tuple[str, str]
    kind: str
    constants: Mapping[str, float]
    cutoff: str
    r_cut: float
    r_onset: float
    compare: str

    def inside(self, distance: Float[ndarray, "pairs"]) -> Bool[ndarray, "pairs"]:
        """Whether distances count as inside, in the space and with the comparison of the system file."""
        space, comparison = self.compare.split()
        quantity, threshold = (distance**2, self.r_cut**2) if space == "r2" else (distance, self.r_cut)
        return quantity <= threshold if comparison == "<=" else quantity < threshold

    def bare(self, r: Float[ndarray, "pairs"]) -> tuple[Float[ndarray, "pairs"], Float[ndarray, "pairs"]]:
        """u(r) and u'(r) without any cutoff."""
        if self.kind in _BARE:
            return _BARE[self.kind](r, **self.constants)
        return POTENTIALS[self.kind].reference(r, **self.constants)

    def __call__(self, r: Float[ndarray, "pairs"]) -> tuple[Float[ndarray, "pairs"], Float[ndarray, "pairs"]]:
        """Energy and its derivative with respect to r, cut off, for pairs that are inside."""
        u, du = self.bare(r)
        at_cut, slope_at_cut = (float(x[0]) for x in self.bare(np.array([self.r_cut])))
        at = AtCutoff(self.r_cut, self.r_onset, at_cut, slope_at_cut)
        return CUTOFFS.parse(self.cutoff).reference(r, u, du, at)


def pair_forms(spec: SystemSpec, species: tuple[str, ...]) -> dict[tuple[str, str], PairForm]:
    """The interaction of every two species, both orders.

    Args:
        spec: a system with a pair potential.
        species: chemical symbols present.
    Raises:
        InputError: a pair of species has no constants or no radius.
    """
    if spec.cutoff is None:
        raise TypeError(f"{spec.potential.kind} has no [cutoff]")
    tables = pairs.pair_constants(spec, species)
    radius, onset = pairs.cutoff_radii(spec, species)
    return {
        (a, b): PairForm(
            (a, b),
            spec.potential.kind,
            {name: float(table[x, y]) for name, table in tables.items()},
            spec.cutoff.kind,
            float(radius[x, y]),
            float(radius[x, y] if onset is None else onset[x, y]),
            spec.cutoff.compare,
        )
        for x, a in enumerate(species)
        for y, b in enumerate(species)
    }


def _lennard_jones(r: ndarray, sigma: float, epsilon: float) -> tuple[ndarray, ndarray]:
    sixth = (sigma / r) ** 6
    return 4.0 * epsilon * sixth * (sixth - 1.0), -24.0 * epsilon * sixth * (2.0 * sixth - 1.0) / r


def _morse(r: ndarray, depth: float, alpha: float, r0: float) -> tuple[ndarray, ndarray]:
    decay = np.exp(-alpha * (r - r0))
    return depth * decay * (decay - 2.0), -2.0 * depth * alpha * decay * (decay - 1.0)


def _soft_sphere(r: ndarray, sigma: float, epsilon: float, alpha: float) -> tuple[ndarray, ndarray]:
    overlap = np.maximum(1.0 - r / sigma, 0.0)
    return epsilon / alpha * overlap**alpha, -epsilon / sigma * np.where(
        overlap > 0, overlap ** (alpha - 1.0), 0.0
    )


_BARE: dict[str, Callable[..., tuple[ndarray, ndarray]]] = {
    "lennard-jones": _lennard_jones,
    "morse": _morse,
    "soft-sphere": _soft_sphere,
}
