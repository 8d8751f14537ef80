"""The pairs of a still, and which of them a list has to have, may have and must not have."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy import ndarray

from mdnum.references.conformance.case import Case
from mdnum.references.oracle import PairSet, all_pairs, exactly_inside, rounding_bound

SINGLE, DOUBLE = 2.0**-24, 2.0**-53


@dataclass(frozen=True)
class Truth:
    """Pairs in and around the cutoff at one still.

    Attributes:
        positions, cell: as the list was given them; rows of axes that do not repeat are zero.
        i, j, shift, distance: as in `PairSet`, out to the reach that was asked for.
        tie: the pairs at exactly r_cut.
        r_cut: length.
        scale: `rounding_bound` for a unit roundoff of 1, times what fractional coordinates of a skewed cell
            lose: how far a distance can be off, by the roundoff of the arithmetic.
        reach: pairs as far as this may be listed, length; the cutoff unless a list holds a skin.
        inside: by real arithmetic, r < r_cut.
    """

    positions: ndarray
    cell: ndarray
    i: ndarray
    j: ndarray
    shift: ndarray
    distance: ndarray
    tie: ndarray
    r_cut: float
    scale: float
    reach: float
    inside: ndarray

    def needed(self, unit: float) -> ndarray:
        """The pairs that a list of this roundoff cannot be excused for lacking."""
        return self.distance < self.r_cut - unit * self.scale

    def allowed(self, unit: float) -> ndarray:
        """The pairs that it may have."""
        return self.distance <= self.reach + unit * self.scale


def truth(case: Case, step: int, *, reach: float | None = None, unit: float = DOUBLE) -> Truth:
    """The pairs of one still of a case.

    Args:
        reach: how far pairs may be listed, length; the cutoff by default.
        unit: the coarsest roundoff that will be asked about.
    Error: decisions within rounding of the cutoff are those of rational arithmetic; see `all_pairs`.
    """
    still, pbc = case.stills[step], np.array(case.pbc)
    positions, r_cut = still.positions, case.r_cut
    cell = np.where(pbc[:, None], still.cell, 0.0)
    scale = rounding_bound(positions, cell, r_cut, unit_roundoff=1.0) * conditioning(cell, pbc)
    reach = r_cut if reach is None else reach
    if case.known is not None and case.steps == 1:
        pairs = case.known
    else:
        pairs = all_pairs(positions, still.cell, pbc, r_cut, reach=reach + unit * scale)
    tie = np.zeros(len(pairs), bool)
    for row in np.flatnonzero(pairs.exact & ~pairs.inside):
        i, j, shift = int(pairs.i[row]), int(pairs.j[row]), pairs.shift[row]
        tie[row] = exactly_inside(positions, cell, i, j, shift, r_cut, closed=True)
    return Truth(
        positions, cell, pairs.i, pairs.j, pairs.shift, pairs.distance, tie, r_cut, scale, reach, pairs.inside
    )


def conditioning(cell: ndarray, pbc: ndarray) -> float:
    """What going through fractional coordinates and back can multiply a rounding error by; at least 1.

    Source: Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., section 7.1: the condition number
    of the periodic lattice vectors, each scaled to length 1 because lengths alone cost nothing.
    """
    if not pbc.any():
        return 1.0
    rows = cell[pbc] / np.linalg.norm(cell[pbc], axis=1)[:, None]
    return max(1.0, float(np.linalg.cond(rows)))


def keys(count: int, i: ndarray, j: ndarray, shift: ndarray | None, *others: tuple) -> list[ndarray]:
    """One whole number for each row, equal where rows are: of these rows and of others, (i, j, shift) each.

    Args:
        count: atoms.
        shift: None to tell rows by their atoms alone.
    """
    sets = [(i, j, shift), *others]
    lengths = np.cumsum([0, *(len(one[0]) for one in sets)])
    key = np.concatenate([np.asarray(one[0], np.int64) * count + one[1] for one in sets])
    if shift is not None:
        for axis in range(3):
            column = np.concatenate([np.asarray(one[2])[:, axis] for one in sets])
            # by rank: shifts of atoms far outside the box are large, but few of them differ
            _, rank = np.unique(column, return_inverse=True)
            _, key = np.unique(key, return_inverse=True)
            key = key * (int(rank.max(initial=0)) + 1) + rank
    return [key[first:last] for first, last in pairwise(lengths)]


def of(pairs: Truth, mask: ndarray) -> PairSet:
    """Some rows of a truth as pairs."""
    kept = PairSet(pairs.i, pairs.j, pairs.shift, pairs.distance, pairs.inside, pairs.tie)
    return kept.select(mask)
