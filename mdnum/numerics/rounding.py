"""Differences of floats in ulps, and rounding errors of pair distances.

A displacement is x_j - x_i minus at most one lattice vector per periodic axis. The squared components of the
displacement are added in the order x, y, z. The error of a rounding is proportional to the magnitude of its
result. The class `Reach` bounds the results' magnitudes.
"""

from __future__ import annotations

from dataclasses import dataclass

import ml_dtypes
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike, DTypeLike


def unit_roundoff(dtype: DTypeLike) -> float:
    """Return the largest relative error of a rounding (Higham 2002, 2.1)."""
    # ml_dtypes' finfo knows bfloat16 too
    return float(ml_dtypes.finfo(np.dtype(dtype)).eps) / 2


def _signed(dtype: np.dtype) -> np.dtype:
    return np.dtype(f"int{8 * dtype.itemsize}")


def ordinal(x: ArrayLike) -> Int[np.ndarray, "..."]:
    """Return the index of x among all floats of its dtype. ±0 has index 0.

    Adjacent floats have adjacent indices, so index differences count ulps. The index of NaN has no meaning.
    """
    x = np.asarray(x)
    integer = _signed(x.dtype)
    bits = x.view(integer).astype(np.int64)
    lowest = np.int64(np.iinfo(integer).min)
    return np.where(bits < 0, lowest - bits, bits)


def neighbor(x, ulps: int, dtype: DTypeLike = np.float64):
    """Return the float that is `ulps` floats above x. Negative `ulps` mean a float below x."""
    x = np.asarray(x, dtype)
    integer = _signed(x.dtype)
    place = ordinal(x) + ulps
    lowest = np.int64(np.iinfo(integer).min)
    # the branch not taken must not overflow
    bits = np.where(place < 0, lowest - np.minimum(place, 0), place)
    return bits.astype(integer).view(x.dtype)[()]


#: Factor for terms of second order, which are smaller by a factor u: u is at most 2^-24 for compared
#: distances.
_SECOND_ORDER = 1.001


def gamma(n: int, dtype: DTypeLike = np.float64) -> float:
    """Return n u / (1 - n u), which bounds the error of n roundings (Higham 2002, 3.1)."""
    nu = n * unit_roundoff(dtype)
    return nu / (1.0 - nu)


Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Reach:
    """Lattice vectors and largest coordinates of a box, to bound rounding errors."""

    # vectors of the periodic axes in the order in which they are taken off, length
    lattice: tuple[Vector, ...] = ()
    coordinate: Vector = (0.0, 0.0, 0.0)  # largest |coordinate| of a position, per axis, length

    @classmethod
    def of(cls, lattice: Float[np.ndarray, "vectors 3"], coordinate: Float[np.ndarray, "3"]) -> Reach:
        """Create a `Reach` from arrays of lattice vectors and largest coordinates."""
        return cls(tuple(_three(row) for row in lattice), _three(coordinate))

    def rounded(self) -> tuple[Float[np.ndarray, "3"], int]:
        """Return, by axis, the sum of |components| of all rounded results, and their number.

        The first subtraction gives d + n_1 a_1 + n_2 a_2 + n_3 a_3, with final value d and n in {-1, 0, 1}.
        Each further subtraction of a lattice vector removes one term n_k a_k.
        """
        sizes, most = np.zeros(3), 1
        for axis in range(3):
            # taking off a zero rounds nothing
            parts = [abs(vector[axis]) for vector in self.lattice if vector[axis] != 0]
            sizes[axis] = sum(sum(parts[k:]) for k in range(len(parts)))
            most = max(most, 1 + len(parts))
        return sizes, most

    def narrowed(self, dtype: DTypeLike) -> Float[np.ndarray, "3"]:
        """Return, by axis, the error (a length) of rounding lattice vectors to a dtype."""
        lattice = np.array(self.lattice, np.float64).reshape(-1, 3)
        return np.abs(lattice.astype(dtype).astype(np.float64) - lattice).sum(axis=0)


def _three(values) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def displacement_bound(
    r, reach: Reach, dtype: DTypeLike = np.float64, state: DTypeLike = np.float64, seen=None
):
    """Return a bound on the error (a length) of a computed displacement.

    Each rounding adds at most the unit roundoff times the rounded result. If `dtype` has fewer digits than
    the state, positions are first rounded. If `dtype` has fewer digits than float64, lattice vectors are also
    rounded. The exact displacement follows from the state and the system file. The nearest image found in
    `dtype` must be the true nearest image. Half the box width must exceed r_cut by more than the error of a
    distance.

    Args:
        r: length(s) of the displacement.
        reach: lattice vectors and largest coordinates of the box.
        dtype: dtype of the arithmetic.
        state: dtype of the positions.
        seen: largest |coordinate| along each axis, if it may exceed that in `reach`, length, shape (..., 3).

    Returns:
        The bound, length, of the shape of r, or that of `seen` without its last axis.
    """
    u = unit_roundoff(dtype)
    sizes, roundings = reach.rounded()
    if unit_roundoff(state) < u:
        coordinate = np.array(reach.coordinate)
        sizes = sizes + 2 * (coordinate if seen is None else np.fmax(coordinate, seen))
    error = u * sizes + reach.narrowed(dtype)
    length = float(np.linalg.norm(error)) if error.ndim == 1 else np.linalg.norm(error, axis=-1)
    return _SECOND_ORDER * (length + u * roundings * np.asarray(r, np.float64))


def squared_distance_bound(
    r, reach: Reach, dtype: DTypeLike = np.float64, state: DTypeLike = np.float64, seen=None
):
    """Return a bound on |computed r² - exact r²|.

    Args: as `displacement_bound`.

    Returns:
        The bound, length squared, of the same shape.
    """
    r = np.asarray(r, np.float64)
    error = displacement_bound(r, reach, dtype, state, seen)
    return 2.0 * r * error + error**2 + gamma(3, dtype) * (r + error) ** 2


def distance_bound(r, reach: Reach, dtype: DTypeLike = np.float64, state: DTypeLike = np.float64, seen=None):
    """Return a bound on |computed r - exact r| for a correctly rounded square root.

    A length changes by at most the length of the error vector. The square root halves the relative error of
    r² and adds one rounding.

    Args: as `displacement_bound`.

    Returns:
        The bound, length, of the same shape.
    """
    r = np.asarray(r, np.float64)
    error = displacement_bound(r, reach, dtype, state, seen)
    return error + (gamma(3, dtype) / 2 + _SECOND_ORDER * unit_roundoff(dtype)) * (r + error)
