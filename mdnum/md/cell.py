"""Simulation boxes: lattice vectors, wrapping and minimum image, on the host and in jit.

Code on the host and in jit executes the same operations in the same order. Lattice vectors are subtracted as
n * L. For wrapped positions, n is -1, 0 or 1. The products n * L are exact. Numpy and jit therefore agree bit
for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import DTypeLike

from mdnum.compiled import njit
from mdnum.errors import InputError
from mdnum.numerics.rounding import Reach


class Cell(eqx.Module):
    """A parallelepiped simulation box, with numpy arrays on the host and jax arrays in jit."""

    # lattice vectors as rows, length, shape (3, 3); a free axis may hold a zero vector
    matrix: Float[np.ndarray | jax.Array, "3 3"]
    # columns give fractional coordinates of the periodic axes; 0 for a free axis, shape (3, 3)
    inverse: Float[np.ndarray | jax.Array, "3 3"]
    pbc: tuple[bool, bool, bool] = eqx.field(static=True)  # periodicity per axis
    orthorhombic: bool = eqx.field(static=True)  # lattice vectors lie along x, y and z

    @classmethod
    def create(cls, matrix, pbc: Any = True) -> Cell:
        """Make a box from lattice vectors.

        Args:
            matrix: lattice vectors as rows, shape (3, 3), or three edge lengths.
            pbc: one flag for all axes, or one flag per axis.

        Raises:
            InputError: a periodic axis without a lattice vector, or vectors that span no volume.
        """
        matrix = np.asarray(matrix, np.float64)
        if matrix.shape == (3,):
            matrix = np.diag(matrix)
        flags = np.broadcast_to(np.asarray(pbc, bool), (3,))
        norms = np.linalg.norm(matrix, axis=1)
        if not np.all(np.isfinite(matrix)):
            raise InputError("the lattice vectors of the cell contain numbers that are not finite")
        if np.any(flags & (norms == 0)):
            axis = "abc"[int(np.argmax(flags & (norms == 0)))]
            raise InputError(
                f"axis {axis} of the structure is periodic, but its lattice vector is zero",
                remedy="Give the axis a lattice vector, or set structure.pbc = false for this axis",
            )
        try:
            full = complete(matrix, flags)
        except np.linalg.LinAlgError:
            full = np.zeros((3, 3))
        # parallel vectors beside a free axis have no perpendicular: not a number, which is not small
        if not abs(np.linalg.det(full)) > 1e-9 * np.prod(np.linalg.norm(full, axis=1)):
            raise InputError("the lattice vectors span no volume")
        inverse = np.linalg.inv(full)
        inverse[:, ~flags] = 0.0
        diagonal = bool(np.all(full == np.diag(np.diag(full))))
        a, b, c = (bool(flag) for flag in flags)
        return cls(matrix.copy(), inverse, (a, b, c), diagonal)

    @property
    def widths(self) -> Float[np.ndarray, "3"]:
        """Perpendicular widths of the box (length) along periodic axes; infinity along nonperiodic axes."""
        with np.errstate(divide="ignore"):
            widths = 1.0 / np.linalg.norm(np.asarray(self.inverse), axis=0)
        return widths

    def is_narrow(self, radius):
        """Return True if a radius exceeds half a width of the box. The minimum image then misses pairs."""
        return ((2 * radius) ** 2 * (self.inverse**2).sum(0) > 1).any()

    @property
    def nearby2(self):
        """Square of half the smallest perpendicular width, slightly reduced for rounding (in jit).

        `minimum_image` returns displacements shorter than half a width unchanged, bit for bit.
        """
        return (1 - 1e-9) * 0.25 / jnp.max(jnp.sum(self.inverse * self.inverse, axis=0))

    @property
    def volume(self) -> float:
        """Volume of the three lattice vectors, length³. NaN if a lattice vector is missing (zero)."""
        volume = float(abs(np.linalg.det(np.asarray(self.matrix))))
        return volume if volume > 0 else float("nan")

    def reach(self, positions: Float[np.ndarray, "atoms 3"]) -> Reach:
        """Return the largest coordinates and lattice vectors, from which rounding bounds are computed.

        The largest coordinates along periodic axes follow from the box. Along nonperiodic axes, the
        coordinates include a margin for motion, equal to the extent of the atoms.

        Args:
            positions: initial positions of the atoms, length.
        """
        flags = np.array(self.pbc)
        matrix = np.asarray(self.matrix, np.float64)
        lattice = matrix[flags]
        box = np.abs(lattice).sum(axis=0)
        if not len(positions) or flags.all():
            return Reach.of(lattice, box)
        # the axes that a free direction has a share in
        free = (complete(matrix, flags)[~flags] != 0).any(axis=0)
        wrapped, _ = wrap_positions(self, positions)
        room = np.abs(wrapped).max(axis=0) + np.ptp(wrapped, axis=0) + 1.0
        return Reach.of(lattice, np.where(free, box + room, box))

    def astype(self, dtype) -> Cell:
        """Return the box with jax arrays of the given dtype."""
        return Cell(
            jnp.asarray(self.matrix, dtype), jnp.asarray(self.inverse, dtype), self.pbc, self.orthorhombic
        )

    def minimum_image(self, x, y, z):
        """Return the components of the minimum image of a displacement.

        The minimum image is correct if the nearest image is closer than half the smallest perpendicular
        width. Calling functions reject cutoffs longer than this half width.
        """
        if not any(self.pbc):
            return x, y, z
        rounding = np.rint if isinstance(x, np.ndarray) else jnp.round
        lattice = (self.matrix, self.inverse, self.pbc, self.orthorhombic)
        return _subtract(lattice, x, y, z, _images(lattice, x, y, z, rounding))

    def deformation(self, now: Cell):
        """Return the deformation F to another box, shape (3, 3): new lattice rows = old rows @ F.

        Directions along nonperiodic axes do not change. For equal boxes, the deformation is the identity.
        """
        return np.eye(3) + self.inverse @ (now.matrix - self.matrix)

    def deformed(self, by) -> Cell:
        """Return the box with its lattice vectors (rows) multiplied by a deformation (inside jit).

        Args:
            by: deformation, shape (3, 3), float64. If orthorhombic is True, the deformed box must be
                orthorhombic, too.
        """
        return self.spanned(self.matrix @ by)

    def spanned(self, matrix) -> Cell:
        """Return a box with new lattice vectors (rows) and the same periodic axes (inside jit)."""
        flags = np.array(self.pbc)
        rows = jnp.where(flags[:, None], matrix, 0.0)
        # of the products of rows: a free axis, which has none, keeps an inverse of 0
        square = rows @ rows.T + np.diag(np.where(flags, 0.0, 1.0))
        crossed = jnp.cross(square[np.array([1, 2, 0])], square[np.array([2, 0, 1])])
        return Cell(matrix, rows.T @ crossed.T / (square[0] @ crossed[0]), self.pbc, self.orthorhombic)

    def spent(self, x, reference: Cell, home, r_list):
        """Return strain_loss / 2 + the largest displacement relative to the box (inside jit).

        A neighbor list is complete while `spent` is at most half the skin.

        Args:
            x, home: present positions, in this box, and positions when the list was built, in the box
                `reference`; length, shape (3, atoms). Both boxes are in float64.
            r_list: radius of the neighbor list, length.

        Returns:
            length, float64.
        """
        moved = x - transformed(home, reference.deformation(self))
        return self.astype(x.dtype).farthest(moved) + 0.5 * strain_loss(reference, self, r_list)

    def farthest(self, moved):
        """Return the length of the longest minimum-image displacement in float64 (inside jit)."""
        d = self.minimum_image(*moved)
        return jnp.sqrt(jnp.max(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])).astype(jnp.float64)

    def wrap(self, x, y, z):
        """Return the components of wrapped positions, and the numbers of lattice vectors subtracted."""
        if not any(self.pbc):
            zero = np.zeros_like(x) if isinstance(x, np.ndarray) else jnp.zeros_like(x)
            return (x, y, z), (zero, zero, zero)
        floor = np.floor if isinstance(x, np.ndarray) else jnp.floor
        lattice = (self.matrix, self.inverse, self.pbc, self.orthorhombic)
        n = _images(lattice, x, y, z, floor)
        return _subtract(lattice, x, y, z, n), n


def _images(lattice, x, y, z, rounding):
    """Return the number of lattice vectors to subtract from a vector, per axis."""
    _, m, _, orthorhombic = lattice
    if orthorhombic:
        return rounding(x * m[0, 0]), rounding(y * m[1, 1]), rounding(z * m[2, 2])
    return tuple(rounding(x * m[0, k] + y * m[1, k] + z * m[2, k]) for k in range(3))


def _subtract(lattice, x, y, z, n):
    a, _, pbc, orthorhombic = lattice
    if orthorhombic:
        return x - n[0] * a[0, 0], y - n[1] * a[1, 1], z - n[2] * a[2, 2]
    for k in range(3):
        if pbc[k]:
            x, y, z = x - n[k] * a[k, 0], y - n[k] * a[k, 1], z - n[k] * a[k, 2]
    return x, y, z


@njit(inline="always")
def nearest_image(lattice, x, y, z):
    """Return the minimum image in compiled code. The bits are those of `Cell.minimum_image`.

    Args:
        lattice: the box as returned by `box_of`, in the dtype of the displacement.
    """
    a, m, pbc, orthorhombic = lattice
    if not (pbc[0] or pbc[1] or pbc[2]):
        return x, y, z
    if orthorhombic:
        f, g, h = np.rint(x * m[0][0]), np.rint(y * m[1][1]), np.rint(z * m[2][2])
        return x - f * a[0][0], y - g * a[1][1], z - h * a[2][2]
    f = np.rint(x * m[0][0] + y * m[1][0] + z * m[2][0])
    g = np.rint(x * m[0][1] + y * m[1][1] + z * m[2][1])
    h = np.rint(x * m[0][2] + y * m[1][2] + z * m[2][2])
    if pbc[0]:
        x, y, z = x - f * a[0][0], y - f * a[0][1], z - f * a[0][2]
    if pbc[1]:
        x, y, z = x - g * a[1][0], y - g * a[1][1], z - g * a[1][2]
    if pbc[2]:
        x, y, z = x - h * a[2][0], y - h * a[2][1], z - h * a[2][2]
    return x, y, z


def stacked(cells: Sequence[Cell], dtype: DTypeLike = np.float64):
    """Convert one box, or one per row, to arrays for compiled loops (see `box_of`)."""
    numbers = np.array([(cell.matrix, cell.inverse) for cell in cells], dtype)
    return numbers, cells[0].pbc, all(cell.orthorhombic for cell in cells)


@njit(inline="always")
def box_of(boxes, row):
    """Return one of several stacked boxes: lattice vectors, inverse, periodicity and orthorhombic flag.

    Tuples are returned, because reference counts of arrays slow down a compiled loop.
    """
    numbers, pbc, orthorhombic = boxes
    a, m = numbers[row % len(numbers), 0], numbers[row % len(numbers), 1]
    matrix = (a[0, 0], a[0, 1], a[0, 2]), (a[1, 0], a[1, 1], a[1, 2]), (a[2, 0], a[2, 1], a[2, 2])
    inverse = (m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2])
    return matrix, inverse, pbc, orthorhombic


class HostCell:
    """Fast version of the methods of `Cell` on the host, for calls with few positions."""

    def __init__(self, cell: Cell, dtype: DTypeLike = np.float64):
        self.dtype = np.dtype(dtype)
        matrix, inverse = np.asarray(cell.matrix, dtype), np.asarray(cell.inverse, dtype)
        self._lattice = (matrix, inverse, cell.pbc, cell.orthorhombic)

    def displacement(
        self, start: Float[np.ndarray, "... 3"], end: Float[np.ndarray, "... 3"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the minimum image of end - start by components. The force loop gives the same bits."""
        start, end = np.asarray(start, self.dtype), np.asarray(end, self.dtype)
        x, y, z = (end[..., k] - start[..., k] for k in range(3))
        if not any(self._lattice[2]):
            return x, y, z
        return _subtract(self._lattice, x, y, z, _images(self._lattice, x, y, z, np.rint))


def wrap_positions(
    cell: Cell, positions: Float[np.ndarray, "atoms 3"]
) -> tuple[Float[np.ndarray, "atoms 3"], Int[np.ndarray, "atoms 3"]]:
    """Wrap positions. Also return the numbers of lattice vectors subtracted.

    Error: the first pass subtracts the product n * L, which is rounded. A second pass wraps positions that
    rounding left outside the box. A wrapped coordinate may equal the edge length L: a tiny negative number
    plus L rounds to L.
    """
    wrapped = np.array(positions, np.float64, copy=True)
    images = np.zeros(wrapped.shape, np.int64)
    for _ in range(2):
        components, n = cell.wrap(*(np.ascontiguousarray(c) for c in wrapped.T))
        wrapped = np.stack(components, axis=1)
        images += np.stack(n, axis=1).astype(np.int64)
    return wrapped, images


def displacement(
    cell: Cell,
    start: Float[np.ndarray, "... 3"],
    end: Float[np.ndarray, "... 3"],
    dtype: DTypeLike = np.float64,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the minimum image of end - start by components. The force loop gives the same bits."""
    return HostCell(cell, dtype).displacement(start, end)


def transformed(x, by):
    """Multiply positions (rows) by a deformation matrix. Return their components (inside jit)."""
    # one product: XLA fuses sums that are written out with what makes their operands, again for each row
    return jnp.matmul(by.astype(x.dtype).T, x, precision="highest")


def strain_loss(reference: Cell, now: Cell, r_list):
    """Return an upper bound on how much a deformation of the box shortens a distance of length r_list.

    A vector of length r_list has at least the length sigma_min(F) * r_list after the deformation F. A
    neighbor list is complete while `strain_loss` plus twice the largest displacement (relative to the box) is
    at most the skin. `strain_loss` works on the host and inside jit.

    The bound uses sigma_min(F) >= lambda_min(S) >= t - sqrt(2/3) |S - t|. S is the symmetric part of F, t a
    third of the trace of F, and |.| the Frobenius norm. The upper bound requires no matrix decomposition. If
    the box keeps its shape, the upper bound is exact. If the shape changes, the error is at most 0.41 |S - t|
    plus the square of the rotation angle.

    Source: kUPS issue 263, `2 max|u| + r_list max(0, 1 - sigma_min(F)) <= r_list - r_cut`.
    """
    strain = reference.deformation(now) - np.eye(3)
    module = strain.__array_namespace__()
    mean = (strain[0, 0] + strain[1, 1] + strain[2, 2]) / 3
    shape = 0.5 * (strain + strain.T) - mean * np.eye(3)
    return r_list * module.maximum(0.0, math.sqrt(2 / 3) * module.sqrt(module.sum(shape * shape)) - mean)


def complete(cell: Float[np.ndarray, "3 3"], pbc: Bool[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Replace lattice vectors of nonperiodic axes by unit vectors perpendicular to the others.

    A tilted vector of a nonperiodic axis would change the images along periodic axes.

    Args:
        cell: lattice vectors as rows, length; rows of nonperiodic axes are ignored.
        pbc: which axes are periodic.
    """
    from ase.geometry import complete_cell

    rows = np.where(np.asarray(pbc, bool)[:, None], np.asarray(cell, np.float64), 0.0)
    return np.asarray(complete_cell(rows), np.float64)
