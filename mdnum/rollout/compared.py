"""Rows of runs beside one another: atoms put in one order, and how far the same atoms are apart.

The host does this for every step that the device makes, so it is compiled; each number has the bits that the
same expression in numpy has.
"""

from __future__ import annotations

import numba
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mdnum.md.cell import Cell
from mdnum.md.verlet import PairTable


@numba.njit(cache=True, nogil=True)
def _place(values, order, out):
    for row in range(values.shape[0]):
        for axis in range(values.shape[1]):
            for k in range(order.shape[0]):
                out[row, axis, order[k]] = values[row, axis, k]


def in_user_order(
    values: Float[np.ndarray, "rows 3 atoms"], order: Int[np.ndarray, "atoms"]
) -> Float[np.ndarray, "rows 3 atoms"]:
    """Columns of a record in the user's order of atoms, float64.

    Args:
        order: atom k of the record is atom order[k].
    """
    out = np.empty(values.shape, np.float64)
    _place(values, order, out)
    return out


@numba.njit(cache=True, nogil=True)
def _largest(a, b, matrix, inverse, pbc, orthorhombic, out):
    periodic = pbc[0] or pbc[1] or pbc[2]
    for row in range(out.shape[0]):
        most = 0.0
        for k in range(a.shape[2]):
            x, y, z = b[row, 0, k] - a[row, 0, k], b[row, 1, k] - a[row, 1, k], b[row, 2, k] - a[row, 2, k]
            if periodic and orthorhombic:
                x -= np.rint(x * inverse[0, 0]) * matrix[0, 0]
                y -= np.rint(y * inverse[1, 1]) * matrix[1, 1]
                z -= np.rint(z * inverse[2, 2]) * matrix[2, 2]
            elif periodic:
                u = np.rint(x * inverse[0, 0] + y * inverse[1, 0] + z * inverse[2, 0])
                v = np.rint(x * inverse[0, 1] + y * inverse[1, 1] + z * inverse[2, 1])
                w = np.rint(x * inverse[0, 2] + y * inverse[1, 2] + z * inverse[2, 2])
                for axis, n in enumerate((u, v, w)):
                    if pbc[axis]:
                        x -= n * matrix[axis, 0]
                        y -= n * matrix[axis, 1]
                        z -= n * matrix[axis, 2]
            square = x * x + y * y + z * z
            # what is not a number stays the largest
            if not square <= most:
                most = square
            if most != most:
                break
        out[row] = np.sqrt(most)


@numba.njit(cache=True, nogil=True)
def _overridden(
    own, told, index, order, x, species, r_cut, matrix, inverse, pbc, orthorhombic, count, furthest
):
    atoms = order.shape[0]
    ends, distance = np.empty((2, 1, 3, 1)), np.empty(1)
    for row in range(count.shape[0]):
        for word in range(own.shape[1]):
            any_bit = np.uint8(0)
            for column in range(atoms):
                any_bit |= own[row, word, column] ^ told[row, word, column]
            if any_bit == 0:
                continue
            for column in range(atoms):
                bits = own[row, word, column] ^ told[row, word, column]
                for k in range(8):
                    if not (bits >> k) & 1:
                        continue
                    other = index[8 * word + k, column]
                    # a pair is listed from both ends
                    if other >= atoms or order[column] >= order[other]:
                        continue
                    for axis in range(3):
                        ends[0, 0, axis, 0] = x[row, axis, column]
                        ends[1, 0, axis, 0] = x[row, axis, other]
                    _largest(ends[0], ends[1], matrix, inverse, pbc, orthorhombic, distance)
                    off = abs(distance[0] - r_cut[species[order[column]], species[order[other]]])
                    count[row] += 1
                    if furthest[row] == furthest[row] and not off <= furthest[row]:
                        furthest[row] = off


class Apart:
    """Distances between the same atoms of two runs in one box, and of pairs on which they differ.

    Args:
        cell: the box; distances are those of nearest images.
    """

    def __init__(self, cell: Cell):
        self._lattice = (
            np.asarray(cell.matrix, np.float64),
            np.asarray(cell.inverse, np.float64),
            np.array(cell.pbc, bool),
            cell.orthorhombic,
        )

    def __call__(
        self, a: Float[np.ndarray, "rows 3 atoms"], b: Float[np.ndarray, "rows 3 atoms"]
    ) -> Float[np.ndarray, "rows"]:
        """At each row; NaN where a position is not a number."""
        out = np.empty(len(a))
        _largest(a, b, *self._lattice, out)
        return out

    def overridden(
        self,
        own: UInt8[np.ndarray, "rows words atoms"],
        told: UInt8[np.ndarray, "rows words atoms"],
        table: PairTable,
        x: Float[np.ndarray, "rows 3 atoms"],
        species: Int[np.ndarray, "atoms"],
        r_cut: Float[np.ndarray, "species species"],
    ) -> tuple[Int[np.ndarray, "rows"], Float[np.ndarray, "rows"]]:
        """How many pairs are decided otherwise in two records, and the furthest of them from its cutoff.

        Args:
            own, told: packed decisions of one list.
            table: the list.
            x: positions in its order of atoms.
            species: of each atom, in the user's order.
            r_cut: cutoff by species, length.
        """
        count, furthest = np.zeros(len(own), np.int64), np.zeros(len(own))
        _overridden(own, told, table.index, table.order, x, species, r_cut, *self._lattice, count, furthest)
        return count, furthest


@numba.njit(cache=True, nogil=True)
def _differ(a, b, out):
    for row in range(out.shape[0]):
        if out[row]:
            continue
        for axis in range(a.shape[1]):
            for k in range(a.shape[2]):
                if a[row, axis, k] != b[row, axis, k]:
                    out[row] = True
                    break
            if out[row]:
                break


def differ(
    a: Float[np.ndarray, "rows 3 atoms"],
    b: Float[np.ndarray, "rows 3 atoms"],
    also: Bool[np.ndarray, "rows"] | None = None,
) -> Bool[np.ndarray, "rows"]:
    """Whether any number of a row differs between two runs (one that is not a number does).

    Args:
        also: rows of which it is known already.
    """
    out = np.zeros(len(a), bool) if also is None else also.copy()
    _differ(a, b, out)
    return out
