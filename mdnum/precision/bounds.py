"""How far a computed distance can be from the exact distance of the positions it was computed from."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from mdnum.precision.ulp import unit_roundoff


def gamma(n: int, dtype: DTypeLike = np.float64) -> float:
    """n*u / (1 - n*u): bounds the relative error of n roundings in a row (Higham 2002, lemma 3.1)."""
    nu = n * unit_roundoff(dtype)
    return nu / (1.0 - nu)


def squared_distance_bound(r, extent, dtype: DTypeLike = np.float64):
    """Bound on |computed r² - exact r²| for positions that are exact as given.

    The computation is d = (x_j - x_i) - n*L for each axis, then dx² + dy² + dz² with a rounding after
    every operation. Each component d carries an absolute error of at most u*|x_j - x_i| (its first
    subtraction, at most u*extent), one more per lattice vector subtracted (each intermediate is below
    2*extent), and the squares and sums add gamma_3*r². Standard forward analysis, first order terms kept
    and the second order ones covered by gamma instead of u.

    Args:
        r: distance(s) at which the bound is wanted, length.
        extent: largest absolute coordinate difference before the minimum image, per axis, length, shape (3,).
        dtype: the dtype of the arithmetic; positions are taken as already rounded to it.

    Returns:
        The bound, length squared, of the shape of r.
    """
    r = np.asarray(r, np.float64)
    # up to three lattice vectors are subtracted in a triclinic box: 1 + 3*2 roundings of size u*extent
    component = gamma(7, dtype) * float(np.linalg.norm(np.asarray(extent, np.float64)))
    return 2.0 * r * component + component**2 + gamma(3, dtype) * (r + component) ** 2


def distance_bound(r, extent, dtype: DTypeLike = np.float64):
    """Bound on |computed r - exact r|, r = sqrt(r²) with a correctly rounded square root.

    Args, error analysis: as `squared_distance_bound`; sqrt halves the relative error and adds one rounding.
    """
    r = np.asarray(r, np.float64)
    return (
        squared_distance_bound(r, extent, dtype) / np.maximum(r, np.finfo(np.float64).tiny)
        + unit_roundoff(dtype) * r
    )
