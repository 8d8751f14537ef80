"""The lattice of one frame's box: reduced vectors, widths, and the distance to any image of an atom.

Vectors are reduced first, so that a box that is skewed beyond need costs no more than the compact one that
tiles space in the same way. A decision is always taken on the same number: the length of

    (x_j - x_i) + s_0 a_0 + s_1 a_1 + s_2 a_2

with the coordinates as they are stored, i < j, integers s and the reduced vectors a, in this order of
operations. So it does not depend on which search found the pair.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.errors import InputError
from mdnum.trajectories.frame import Box

_UNIT_ROUNDOFF = 2.0**-53
# sqrt(volume² / product of lengths²) under which vectors are called dependent
_FLAT = 1e-10


class ReducedLattice(NamedTuple):
    """What a search needs to know of a box; the compiled loops take it as it is.

    Attributes:
        vectors: reduced lattice vectors as rows, length; zero along directions that do not repeat.
        inverse: of the vectors completed by unit vectors normal to them: x @ inverse are the coordinates.
        widths: distance between opposite faces, length; inf along directions that do not repeat.
    """

    vectors: Float[np.ndarray, "3 3"]
    periodic: Bool[np.ndarray, "3"]  # which rows repeat
    inverse: Float[np.ndarray, "3 3"]
    widths: Float[np.ndarray, "3"]
    combination: Int[np.ndarray, "3 3"]  # vectors = combination @ matrix of the box

    @property
    def narrowest(self) -> float:
        """Smallest width, length: no lattice vector is shorter."""
        return float(self.widths.min())

    @property
    def volume(self) -> float:
        """Volume of the box; of a slice one length thick along directions that do not repeat."""
        return float(1.0 / abs(np.linalg.det(self.inverse)))

    def rounding(self, largest: float, radius: float) -> float:
        """How far a computed distance near radius can be off, length.

        Args:
            largest: largest coordinate, absolute.
            radius: the distance.
        Source: Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., section 3.1.
        """
        combined = np.abs(self.combination).sum(axis=1).max()
        size = largest + float(np.abs(self.vectors).sum()) * max(1.0, float(combined) - 1.0) + radius
        return 16.0 * _UNIT_ROUNDOFF * size


def lattice_of(box: Box) -> ReducedLattice:
    """The lattice of a box.

    Raises:
        InputError: a direction repeats, but its vector is zero, not finite, or in the plane of the others.
    """
    from ase.geometry import complete_cell
    from ase.geometry.minkowski_reduction import minkowski_reduce

    pbc = np.asarray(box.pbc, bool)
    matrix = np.where(pbc[:, None], np.asarray(box.matrix, np.float64), 0.0)
    for axis in np.flatnonzero(pbc):
        if not np.isfinite(matrix[axis]).all() or not matrix[axis].any():
            raise InputError(
                f"the box repeats along direction {axis}, but its vector there is {matrix[axis].tolist()}",
                remedy="Give the frame a box, or say that this direction does not repeat",
                where="box",
            )
    combination, vectors = np.eye(3, dtype=np.int64), matrix
    if pbc.any():
        scaled = matrix[pbc] / np.linalg.norm(matrix[pbc], axis=1)[:, None]
        if not np.sqrt(max(np.linalg.det(scaled @ scaled.T), 0.0)) > _FLAT:
            raise InputError(
                f"the vectors of the box lie in one plane: {matrix[pbc].tolist()}",
                remedy="Give the frame the box it was run in",
                where="box",
            )
        if np.count_nonzero(matrix) > pbc.sum():
            # a box with right angles is reduced, and stays in its order
            combination = np.asarray(minkowski_reduce(matrix, pbc.tolist())[1], np.int64)
        vectors = np.where(pbc[:, None], combination @ matrix, 0.0)
    inverse = np.linalg.inv(complete_cell(vectors))
    widths = np.where(pbc, 1.0 / np.linalg.norm(inverse, axis=0), np.inf)
    return ReducedLattice(vectors, pbc, inverse, widths, combination)


def own_images(lattice: ReducedLattice, radius: float) -> Float[np.ndarray, "images"]:
    """Squared lengths of the lattice vectors no longer than radius, one of each ± pair, ascending."""
    span = [range(-int(radius / w) - 1, int(radius / w) + 2) if p else range(1)
            for w, p in zip(lattice.widths, lattice.periodic, strict=True)]  # fmt: skip
    if not lattice.periodic.any() or radius < lattice.narrowest * (1 - 1e-9):
        return np.zeros(0)
    found = []
    for s in itertools.product(*span):
        if s > (0, 0, 0):
            d = s[0] * lattice.vectors[0] + s[1] * lattice.vectors[1] + s[2] * lattice.vectors[2]
            square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
            if square <= radius * radius:
                found.append(float(square))
    return np.sort(np.array(found, np.float64))


# inlined: a call that takes arrays costs more than what is done here
@numba.njit(cache=True, nogil=True, inline="always")
def square_of(x, i, j, s0, s1, s2, vectors):
    """Squared distance from atom i to an image of atom j, i < j: the number that decides."""
    if s0 == 0 and s1 == 0 and s2 == 0:
        d0, d1, d2 = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
    else:
        d0 = (x[j, 0] - x[i, 0]) + (s0 * vectors[0, 0] + s1 * vectors[1, 0] + s2 * vectors[2, 0])
        d1 = (x[j, 1] - x[i, 1]) + (s0 * vectors[0, 1] + s1 * vectors[1, 1] + s2 * vectors[2, 1])
        d2 = (x[j, 2] - x[i, 2]) + (s0 * vectors[0, 2] + s1 * vectors[1, 2] + s2 * vectors[2, 2])
    return d0 * d0 + d1 * d1 + d2 * d2


@numba.njit(cache=True, nogil=True, inline="never")
def near_squares(x, i, j, lattice, y, squares):
    """`square_of` the image that rounding to the lattice names, of pairs; y is room for (3, block).

    Without a branch: to add a sum of zeros changes no square, and vectors are zero where a direction does not
    repeat. Gathered first, so that the rest are vector instructions; what the lattice is, is read once.
    """
    vectors, inverse = lattice.vectors, lattice.inverse
    y0, y1, y2 = y[0], y[1], y[2]
    for k in range(i.shape[0]):
        # unsigned: no test for indices from the end
        a, b = np.uint32(i[k]), np.uint32(j[k])
        y0[k], y1[k], y2[k] = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
    v00, v01, v02 = vectors[0, 0], vectors[0, 1], vectors[0, 2]
    v10, v11, v12 = vectors[1, 0], vectors[1, 1], vectors[1, 2]
    v20, v21, v22 = vectors[2, 0], vectors[2, 1], vectors[2, 2]
    r00, r01, r02 = inverse[0, 0], inverse[0, 1], inverse[0, 2]
    r10, r11, r12 = inverse[1, 0], inverse[1, 1], inverse[1, 2]
    r20, r21, r22 = inverse[2, 0], inverse[2, 1], inverse[2, 2]
    for k in range(i.shape[0]):
        s0 = -np.rint(y0[k] * r00 + y1[k] * r10 + y2[k] * r20)
        s1 = -np.rint(y0[k] * r01 + y1[k] * r11 + y2[k] * r21)
        s2 = -np.rint(y0[k] * r02 + y1[k] * r12 + y2[k] * r22)
        d0 = y0[k] + (s0 * v00 + s1 * v10 + s2 * v20)
        d1 = y1[k] + (s0 * v01 + s1 * v11 + s2 * v21)
        d2 = y2[k] + (s0 * v02 + s1 * v12 + s2 * v22)
        squares[k] = d0 * d0 + d1 * d1 + d2 * d2


@numba.njit(cache=True, nogil=True)
def image_square(x, i, j, rank, lattice):
    """Squared distance to the image of j that has `rank` nearer ones; inf where there are not so many.

    i < j, or i == j for images of an atom itself, of which one of each ± pair counts.
    """
    vectors, periodic, widths = lattice.vectors, lattice.periodic, lattice.widths
    # the image that rounding names; nearest where that is near enough
    base = np.zeros(3, np.int64)
    for k in range(3):
        if periodic[k]:
            f = 0.0
            for c in range(3):
                f += (x[j, c] - x[i, c]) * lattice.inverse[c, k]
            base[k] = -np.int64(np.rint(f))
    narrowest = min(widths[0], widths[1], widths[2])
    if narrowest == np.inf:
        return np.inf if rank > 0 or i == j else square_of(x, i, j, 0, 0, 0, vectors)
    best = np.empty(rank + 1)
    span = np.zeros(3, np.int64)
    for k in range(3):
        span[k] = 1 if periodic[k] else 0
    while True:
        best[:] = np.inf
        for s0 in range(base[0] - span[0], base[0] + span[0] + 1):
            for s1 in range(base[1] - span[1], base[1] + span[1] + 1):
                for s2 in range(base[2] - span[2], base[2] + span[2] + 1):
                    if i == j and (s0 < 0 or (s0 == 0 and s1 < 0) or (s0 == 0 and s1 == 0 and s2 <= 0)):
                        continue
                    square = square_of(x, i, j, s0, s1, s2, vectors)
                    place = rank
                    if square < best[place]:
                        while place > 0 and best[place - 1] > square:
                            best[place] = best[place - 1]
                            place -= 1
                        best[place] = square
        # an image not tried is at least (span + 1/2) widths away
        grown = False
        reach = np.sqrt(best[rank])
        for k in range(3):
            if periodic[k] and not reach <= (span[k] + 0.499999) * widths[k]:
                # the vectors are reduced: the nearest of all is among the 27 around the rounded one
                if rank == 0 and i != j and span[k] >= 1:
                    continue
                grown = True
                span[k] = span[k] + 1 if reach == np.inf else np.int64(reach / widths[k] + 0.6)
        if not grown:
            return best[rank]
