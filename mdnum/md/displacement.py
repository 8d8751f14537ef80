"""Minimum-image displacement in real coordinates, orthorhombic or triclinic, periodic per axis."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

import mdnum.numerics  # noqa: F401  (switches float64 on before the first array exists)
from mdnum.errors import InputError
from mdnum.md.cell import complete

Displacement = Callable[..., Array]


def widths(cell: Float[np.ndarray, "3 3"], pbc: Bool[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Perpendicular widths of the cell along each axis, infinite where it is not periodic.

    Raises:
        InputError: the periodic vectors do not span a volume.
    """
    full = complete(cell, pbc)
    volume = abs(np.linalg.det(full))
    if not np.isfinite(volume) or volume < 1e-12 * np.prod(np.linalg.norm(full, axis=1)):
        raise InputError(
            "the periodic cell vectors are linearly dependent", remedy="give three independent vectors"
        )
    return np.where(np.asarray(pbc, bool), 1.0 / np.linalg.norm(np.linalg.inv(full), axis=0), np.inf)


def _dual(cell: Float[Array, "3 3"], periodic: tuple[int, ...]) -> Float[Array, "3 axes"]:
    """Columns that turn a vector into its fractional coordinates along the periodic axes alone.

    The pseudo-inverse of the periodic rows: a tilted non-periodic row must not leak into the image choice.
    """
    if len(periodic) == 3:
        a, b, c = cell
        dual = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
        return dual / jnp.sum(a * dual[:, 0])
    rows = cell[jnp.asarray(periodic)]
    return rows.T @ jnp.linalg.inv(rows @ rows.T)


def displacement(
    cell: Float[Array | np.ndarray, "3 3"], pbc: tuple[bool, bool, bool] = (True, True, True)
) -> Displacement:
    """Minimum-image displacement in real coordinates, in the form every jax-md energy function takes.

    The image is chosen by rounding fractional coordinates and subtracted as whole lattice vectors, so a
    pair that needs no image keeps the exact difference of its coordinates, positions may leave the box, and
    derivatives with respect to the cell (stress by strain) are those of the chosen image.

    Args:
        cell: lattice vectors as rows, length; orthorhombic or triclinic.
        pbc: which axes are periodic; the others are free and their rows are ignored.

    Returns:
        `fn(Ra, Rb, cell=None, perturbation=None) -> Ra - Rb`, (3,) arrays. `cell=` replaces the cell of the
        call, also under jit and grad; `perturbation=` is jax-md's linear map of the result. Other keywords
        are ignored, because jax-md hands every function all of them.

    Error:
        the minimum image is the nearest one only below half the smallest perpendicular width; builders here
        refuse a longer list. jax-md's own spaces ignore the question (no flag).
    """
    periodic = tuple(axis for axis in range(3) if pbc[axis])
    base = jnp.asarray(cell)

    def fn(
        Ra: Array, Rb: Array, cell: Array | None = None, perturbation: Array | None = None, **_: Any
    ) -> Array:
        if Ra.shape != (3,) or Rb.shape != (3,):
            # jax-md probes with one and two dimensions and moves on at a ValueError
            raise ValueError(f"displacement of two points in 3 dimensions; got {Ra.shape} and {Rb.shape}")
        vector = Ra - Rb
        if periodic:
            lattice = jnp.asarray(base if cell is None else cell, vector.dtype)
            dual = jax.lax.stop_gradient(_dual(lattice, periodic))
            held = jax.lax.stop_gradient(vector)
            for column, axis in enumerate(periodic):
                # sums are written out: a dot of three numbers may run in reduced precision on an accelerator
                along = held[0] * dual[0, column] + held[1] * dual[1, column] + held[2] * dual[2, column]
                vector = vector - jnp.round(along) * lattice[axis]
        if perturbation is not None:
            vector = jnp.sum(perturbation * vector[None, :], axis=1)
        return vector

    return fn


def neighbor_vectors(
    positions: Float[Array, "atoms 3"],
    idx: Int[Array, "atoms slots"],
    cell: Float[Array, "3 3"],
    pbc: tuple[bool, bool, bool],
) -> Float[Array, "atoms slots 3"]:
    """Minimum-image vectors from each atom to its listed neighbors; padded slots hold some finite vector."""
    toward = displacement(cell, pbc)
    others = positions[jnp.where(idx < positions.shape[0], idx, 0)]
    return jax.vmap(lambda here, there: jax.vmap(lambda point: toward(point, here))(there))(positions, others)
