"""Find the pairs inside a cutoff by brute force and exact arithmetic."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from mdnum.errors import InputError

Positions = Float[ndarray, "atoms 3"]
Vectors = Float[ndarray, "3 3"]  # lattice vectors as rows
Axes = Bool[ndarray, "3"]
Shift = Int[ndarray, "3"] | tuple[int, int, int]

_BLOCK = 2_000_000  # pairs and images looked at in one go: 48 MB of displacements


@dataclass(frozen=True)
class PairSet:
    """Pairs of atoms, including periodic images; each pair is listed once."""

    i: Int[ndarray, "pairs"]  # first atom; i <= j
    j: Int[ndarray, "pairs"]  # second atom; i == j for an atom and an image of itself
    shift: Int[ndarray, "pairs 3"]  # lattice vectors added to atom j: displacement = x_j - x_i + shift @ cell
    distance: Float[ndarray, "pairs"]  # length of that displacement as float64 computes it
    inside: Bool[ndarray, "pairs"]  # whether the pair is within the cutoff, by real arithmetic
    # the pairs so close to the cutoff that `inside` was decided in rational arithmetic
    exact: Bool[ndarray, "pairs"]

    def __len__(self) -> int:
        return len(self.i)

    def select(self, mask: Bool[ndarray, "pairs"]) -> PairSet:
        """Return only the pairs for which `mask` is true."""
        columns = self.i, self.j, self.shift, self.distance, self.inside, self.exact
        return PairSet(*(column[mask] for column in columns))


def widths(cell: Vectors) -> Float[ndarray, "3"]:
    """Return the distances between opposite faces of the cell (the perpendicular widths)."""
    return 1.0 / np.linalg.norm(np.linalg.inv(cell), axis=0)


def rounding_bound(
    positions: Positions, cell: Vectors, r_cut: float, *, unit_roundoff: float = 2.0**-53
) -> float:
    """Upper bound on the rounding error (a length) of a distance close to r_cut.

    The bound applies to codes that wrap coordinates, add a lattice vector, and compute the distance. No
    intermediate number exceeds the sum of coordinates and cell vectors. Each operation rounds once or twice.
    Typical rounding errors are a tenth of this bound.

    Args:
        positions: coordinates as passed to the code.
        cell: cell vectors as rows; zero rows for directions without a cell vector.
        r_cut: cutoff radius.
        unit_roundoff: 2**-53 for float64, 2**-24 for float32.
    Source: Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., section 3.1.
    """
    largest = float(np.abs(positions).max(initial=0.0)) + float(np.abs(cell).sum(axis=0).max()) + r_cut
    return 8.0 * unit_roundoff * largest


def exactly_inside(
    positions: Positions, cell: Vectors, i: int, j: int, shift: Shift, r_cut: float, *, closed: bool = False
) -> bool:
    """Decide exactly whether a pair is inside r_cut. If `closed` is True, r == r_cut counts as inside.

    With rounding, r < r_cut and r² < r_cut² may give different decisions.
    """
    squared, threshold = Fraction(0), Fraction(float(r_cut)) ** 2
    for axis in range(3):
        component = Fraction(float(positions[j, axis])) - Fraction(float(positions[i, axis]))
        for row in range(3):
            component += int(shift[row]) * Fraction(float(cell[row, axis]))
        squared += component * component
    return squared <= threshold if closed else squared < threshold


def all_pairs(
    positions: Positions,
    cell: Vectors,
    pbc: Axes,
    r_cut: float,
    *,
    closed: bool = False,
    reach: float | None = None,
) -> PairSet:
    """Find every pair within `reach`. Decide exactly whether each pair is inside r_cut.

    All pairs and all relevant lattice vectors are tested, without cell list or skin. Triclinic cells, partial
    periodicity, atoms outside the cell, and small cells are allowed. A small cell has several images of a
    pair. The time is proportional to the square of the number of atoms.

    Args:
        positions: coordinates, wrapped or not.
        cell: cell vectors as rows; rows of directions that are not periodic are ignored.
        pbc: whether each of the three directions is periodic.
        r_cut: cutoff radius.
        closed: whether r == r_cut counts as inside.
        reach: list pairs out to this distance (default: r_cut plus the rounding bound).
    Raises:
        InputError: a periodic direction without a cell vector, or positions that are not finite.
    Error: `inside` is exact: within the rounding bound of r_cut it is decided with `fractions.Fraction`;
        beyond this bound float64 cannot be wrong.
    """
    positions = np.ascontiguousarray(positions, dtype=np.float64)
    pbc = np.asarray(pbc, dtype=bool)
    cell = _usable_cell(np.asarray(cell, dtype=np.float64), pbc)
    if not np.isfinite(positions).all():
        raise InputError("the positions contain numbers that are not finite", where="pair oracle")
    stored = np.where(pbc[:, None], cell, 0.0)
    bound = rounding_bound(positions, stored, r_cut)
    reach = r_cut + bound if reach is None else max(reach, r_cut + bound)

    parts = list(_within(positions, cell, pbc, reach))
    i, j, shift, distance = (np.concatenate([part[k] for part in parts]) for k in range(4))
    order = np.lexsort((shift[:, 2], shift[:, 1], shift[:, 0], j, i))
    i, j, shift, distance = i[order], j[order], shift[order], distance[order]
    exact = np.abs(distance - r_cut) <= bound
    inside = distance < r_cut
    for row in np.flatnonzero(exact):
        inside[row] = exactly_inside(positions, stored, i[row], j[row], shift[row], r_cut, closed=closed)
    return PairSet(i, j, shift, distance, inside, exact)


def _usable_cell(cell: ndarray, pbc: ndarray) -> ndarray:
    """Check the vectors of periodic directions, and return the completed cell."""
    lengths = np.linalg.norm(cell, axis=1)
    for axis in np.flatnonzero(pbc):
        if not lengths[axis] > 0.0:
            raise InputError(
                f"direction {axis} of the structure is periodic, but has no cell vector",
                remedy="Give a cell vector for this direction, or set pbc to false for it",
                where="pair oracle",
            )
    return completed(cell, pbc)


def completed(cell: Vectors, pbc: Axes) -> Vectors:
    """Return the cell. Nonperiodic vectors are replaced by unit vectors normal to the others."""
    if pbc.all():
        return cell
    free = np.flatnonzero(~pbc)
    basis = np.linalg.svd(np.vstack([cell[pbc], np.zeros((1, 3))]), full_matrices=True)[2]
    full = np.array(cell, np.float64)
    full[free] = basis[3 - len(free) :]
    return full


def _within(positions: ndarray, cell: ndarray, pbc: ndarray, reach: float):
    """Yield (i, j, shift, distance) of the pairs within `reach`, block by block."""
    n, stored, width = len(positions), np.where(pbc[:, None], cell, 0.0), widths(cell)
    fractional = np.linalg.solve(cell.T, positions.T).T
    # |normal component| <= reach, so when reach is under half a width the image in reach can only be
    # the one whose fractional difference rounds to zero, in a triclinic cell as well
    nearest = not pbc.any() or bool(reach < 0.499 * width[pbc].min())
    # else atoms brought home differ by less than one cell, so one vector beyond reach / width is enough
    home = np.where(pbc, fractional if nearest else -np.floor(fractional), 0.0)
    most = np.where(nearest | ~pbc, 0, (reach / width).astype(int) + 1)
    vectors = np.array(list(product(*(range(-count, count + 1) for count in most))), dtype=float)
    # an atom and its own image: one of the two opposite shifts, never the null shift
    leading = np.array([tuple(vector) > (0.0, 0.0, 0.0) for vector in vectors.tolist()], dtype=bool)
    some = max(1, _BLOCK // max(n, 1))
    rows = max(1, some // len(vectors))
    yield np.empty(0, int), np.empty(0, int), np.empty((0, 3), int), np.empty(0)
    for start in range(0, n, rows):
        first, second = np.meshgrid(np.arange(start, min(start + rows, n)), np.arange(n), indexing="ij")
        first, second = first[second >= first], second[second >= first]
        between = home[second] - home[first]
        between = -np.rint(between) if nearest else between
        for begin in range(0, len(vectors), some):
            shift = vectors[begin : begin + some, None] + between
            displacement = positions[second] - positions[first] + shift @ stored
            dx, dy, dz = np.moveaxis(displacement, -1, 0)
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            near = (distance <= reach) & ((first != second) | leading[begin : begin + some, None])
            which, pair = np.nonzero(near)
            yield first[pair], second[pair], shift[which, pair].astype(int), distance[which, pair]
