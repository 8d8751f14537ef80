"""Interface to jax-md (displacements, neighbor lists, pair search), which avoids pitfalls of jax-md."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import mdnum.numerics  # noqa: F401  (switches float64 on before the first array exists)
from mdnum.errors import CapacityError, InputError, NumericalError
from mdnum.md.cell import Cell, complete
from mdnum.registry import expect_known

if TYPE_CHECKING:
    from jax_md.partition import NeighborList
else:
    # annotations are looked at when the tests run, and must not cost the import
    NeighborList = Any

Displacement = Callable[..., Array]
Format = Literal["dense", "sparse", "ordered-sparse"]


def _dual(cell: Float[Array, "3 3"], periodic: tuple[int, ...]) -> Float[Array, "3 axes"]:
    """Return the matrix that maps a vector to fractional coordinates along periodic axes only."""
    if len(periodic) == 3:
        a, b, c = cell
        dual = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
        return dual / jnp.sum(a * dual[:, 0])
    rows = cell[jnp.asarray(periodic)]
    return rows.T @ jnp.linalg.inv(rows @ rows.T)


def displacement(
    cell: Float[Array | np.ndarray, "3 3"], pbc: tuple[bool, bool, bool] = (True, True, True)
) -> Displacement:
    """Return a minimum-image displacement function in real coordinates, for jax-md energy functions.

    Rounded fractional coordinates select the image. Integer multiples of lattice vectors are then subtracted.
    If no image is needed, the displacement is the exact difference. Positions may lie outside the box.
    Derivatives with respect to the cell (stress) are those of the chosen image.

    Args:
        cell: lattice vectors as rows, length; orthorhombic or triclinic.
        pbc: flags of the periodic axes; rows of nonperiodic axes are ignored.

    Returns:
        `fn(Ra, Rb, cell=None, perturbation=None) -> Ra - Rb`, (3,) arrays. `cell=` replaces the given cell,
            also inside jit and grad; `perturbation=` is jax-md's linear map of the result. Other keywords are
            ignored, because jax-md passes all keywords to every function.

    Error:
        the minimum image is the nearest image only for distances below half the smallest perpendicular width;
            the list builders of this module reject larger radii, which jax-md's spaces do not check.
    """
    periodic = tuple(axis for axis in range(3) if pbc[axis])
    base = jnp.asarray(cell)

    def fn(
        Ra: Array, Rb: Array, cell: Array | None = None, perturbation: Array | None = None, **_: Any
    ) -> Array:
        if Ra.shape != (3,) or Rb.shape != (3,):
            # jax-md probes with one and two dimensions and moves on at a ValueError
            raise ValueError(f"the two positions have shapes {Ra.shape} and {Rb.shape}; expected (3,) each")
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
    """Return minimum-image vectors from each atom to its neighbors. Padding gives finite vectors."""
    toward = displacement(cell, pbc)
    others = positions[jnp.where(idx < positions.shape[0], idx, 0)]
    return jax.vmap(lambda here, there: jax.vmap(lambda point: toward(point, here))(there))(positions, others)


# jax-md keeps the box of a list in float32, so its cells can come out 6e-8 too small and lose pairs that
# span one; searching a little further and filtering in float64 makes the result exact
_SEARCH_MARGIN = 1e-6
# room left in each row, as a factor
_ROOM = 1.25


def standard_promotion() -> AbstractContextManager[None]:
    """Enable automatic dtype promotion. jax-md mixes dtypes even on import."""
    return jax.numpy_dtype_promotion("standard")


@contextmanager
def _quiet_scatter() -> Iterator[None]:
    """Suppress a jax warning about jax-md, which scatters int64 indices into int32 arrays."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "scatter inputs have incompatible types", FutureWarning)
        yield


def upstream() -> ModuleType:
    """Return the package jax_md. The first call takes seconds to import the package."""
    with standard_promotion():
        import jax_md
        import jax_md.custom_partition
        import jax_md.energy
        import jax_md.minimize
        import jax_md.partition
    return jax_md


def scalar(value: float | np.ndarray) -> Float[Array, ""]:
    """Convert a number to a float64 jax array. jax-md rounds all other types to float32.

    Even with x64 enabled, jax_md.util.maybe_downcast converts Python floats, numpy floats and numpy arrays to
    float32. Apply `scalar` to every sigma, epsilon, r_onset and r_cutoff.
    """
    return jnp.asarray(value, jnp.float64)


def _refuse_update(*_: Any, **__: Any) -> NeighborList:
    raise InputError(
        "the method update does not work for a neighbor list that was built outside of jax-md",
        remedy="Build a new neighbor list with mdnum.md.jaxmd.as_neighbor_list",
    )


def as_neighbor_list(
    idx_dense: Int[Array, "atoms slots"] | np.ndarray,
    reference_position: Float[Array, "atoms 3"] | np.ndarray,
    format: Format = "dense",
    self_edges: bool = False,
    code: Any = 0,
) -> NeighborList:
    """Make a jax-md NeighborList from the neighbor list of another program.

    The conversion also works inside jit. Padding entries keep their places in the arrays.

    Args:
        idx_dense: neighbors of each atom, in both directions, padded with the number of atoms. Entries of an
            atom as its own neighbor become padding, because jax-md's EAM would add their density at r = 0.
        reference_position: positions at which the list was built, length.
        format: dense (atoms, slots); sparse (2, atoms slots), with both directions; ordered-sparse, with each
            pair once.
        self_edges: list each atom as its own neighbor, as jax-md does if its `mask_self` is false.
        code: error code of the list, for example as after an overflow.
    """
    expect_known("neighbor list format", [format], _FORMATS)
    atoms = idx_dense.shape[0]
    own = jnp.arange(atoms, dtype=jnp.int32)[:, None]
    idx = jnp.where((idx_dense == own) | (idx_dense >= atoms), atoms, idx_dense).astype(jnp.int32)
    if self_edges:
        idx = jnp.concatenate([idx, own], axis=1)
    if format != "dense":
        receiver = idx.reshape(-1)
        sender = jnp.broadcast_to(own, idx.shape).reshape(-1)
        real = receiver < atoms
        if format == "ordered-sparse":
            real = real & (receiver < sender)
        idx = jnp.stack([jnp.where(real, receiver, atoms), jnp.where(real, sender, atoms)]).astype(jnp.int32)
    return listed(idx, reference_position, format, code)


_FORMATS = {"dense": "Dense", "sparse": "Sparse", "ordered-sparse": "OrderedSparse"}


def listed(
    idx: Int[Array, "..."],
    reference_position: Float[Array, "atoms 3"] | np.ndarray,
    format: Format,
    code: Any = 0,
) -> NeighborList:
    """Make a jax-md NeighborList from entries in jax-md's format (see `as_neighbor_list`)."""
    partition = upstream().partition
    return partition.NeighborList(
        idx=idx,
        reference_position=jnp.asarray(reference_position),
        error=partition.PartitionError(jnp.asarray(code, jnp.uint8)),
        cell_list_capacity=None,
        max_occupancy=idx.shape[-1],
        format=getattr(partition, _FORMATS[format]),
        cell_size=None,
        cell_list_fn=_refuse_update,  # type: ignore[arg-type]
        update_fn=_refuse_update,  # type: ignore[arg-type]
    )


def multi_image(
    neighbor: NeighborList, x: Float[Array, "atoms 3"], cell: Float[Array, "3 3"], box: Float[Array, "3 3"]
) -> Any:
    """Return a neighbor list with integer shifts of images, as in jax_md.custom_partition.

    Args:
        x: positions, length. cell: lattice vectors as rows, length. box: the box in the form that the energy
            function accepts.
    """
    kind: Any = upstream().custom_partition.NeighborListMultiImage
    n, dense = x.shape[0], neighbor.format is upstream().partition.Dense
    idx: Any = neighbor.idx if dense else tuple(neighbor.idx)
    here, other = (jnp.arange(n)[:, None], idx) if dense else idx
    d = x[jnp.where(other < n, other, 0)] - x[jnp.where(here < n, here, 0)]
    shifts = -jnp.round(jax.lax.stop_gradient(d @ jnp.linalg.inv(cell)))
    return kind(
        idx=idx, shifts=shifts, reference_position=neighbor.reference_position, reference_box=box, box=box,
        search_shifts=jnp.zeros((1, 3)), format=neighbor.format, max_occupancy=neighbor.max_occupancy,
        update_fn=_refuse_update, did_buffer_overflow=neighbor.did_buffer_overflow,
    )  # fmt: skip


class PairSearch:
    """Neighbor search of jax-md for one cell, for repeated calls with new positions.

    Positions are passed to jax-md as fractional coordinates in [0, 1). The distances between opposite faces
    serve as the box. For positions outside the box, jax-md loses pairs without an error. The search also
    rejects some valid triclinic boxes. After every search, the overflow flag is read outside jit. After an
    overflow, the neighbor list is enlarged.

    Args:
        cell: lattice vectors as rows, length.
        r_list: search radius, length (cutoff plus skin).

    Raises:
        InputError: r_list exceeds half the smallest perpendicular width, so that one image is not sufficient.
    """

    def __init__(
        self,
        cell: Float[np.ndarray, "3 3"],
        pbc: tuple[bool, bool, bool],
        r_list: float,
    ):
        narrowest = float(np.min(Cell.create(cell, pbc).widths))
        # a hair beyond half the width is the room that callers add for rounding, not another image
        if not 0 < r_list <= narrowest / 2 * (1 + 1e-9):
            raise InputError(
                f"the radius of the neighbor list (cutoff plus skin) is {r_list:g}; expected at most "
                f"{narrowest / 2:g}, which is half the width of the cell ({narrowest:g})",
                remedy="Repeat the cell along its narrowest direction, or reduce the cutoff or the skin",
            )
        self.cell = complete(cell, np.asarray(pbc))
        self.pbc = np.asarray(pbc, bool)
        self.r_list = float(r_list)
        self._list: NeighborList | None = None
        self._low = np.zeros(3)
        self._span = np.ones(3)
        self._update = jax.jit(lambda folded, previous: previous.update(folded))

    def _frame(self, fractional: np.ndarray) -> None:
        """Choose nonperiodic axes such that all fractional coordinates are in [0, 1)."""
        low, high = fractional.min(axis=0), fractional.max(axis=0)
        self._low = np.where(self.pbc, 0.0, low - self.r_list)
        self._span = np.where(self.pbc, 1.0, high - low + 2 * self.r_list)

    def _fold(self, fractional: np.ndarray) -> np.ndarray:
        folded = (fractional - self._low) / self._span
        wrapped = folded - np.floor(folded)
        # -1e-17 folds to exactly 1.0, which is outside
        return np.where(self.pbc, np.where(wrapped >= 1.0, 0.0, wrapped), folded)

    def _allocate(self, folded: np.ndarray) -> NeighborList:
        partition = upstream().partition
        rows = jnp.asarray(self.cell * self._span[:, None])
        wraps = jnp.asarray(self.pbc)

        def metric(Ra: Array, Rb: Array, **_: Any) -> Array:
            if Ra.shape != (3,):
                raise ValueError("a position does not have three coordinates; expected x, y and z")
            delta = Ra - Rb
            delta = delta - jnp.where(wraps, jnp.round(delta), 0.0)
            return delta[0] * rows[0] + delta[1] * rows[1] + delta[2] * rows[2]

        boxes = 1.0 / np.linalg.norm(np.linalg.inv(np.asarray(rows)), axis=0)
        functions = partition.neighbor_list(
            metric,
            jnp.asarray(boxes),
            scalar(self.r_list * (1 + _SEARCH_MARGIN)),  # type: ignore[arg-type]
            dr_threshold=0.0,
            capacity_multiplier=_ROOM,
            fractional_coordinates=True,
            format=partition.Dense,
        )
        return functions.allocate(jnp.asarray(folded))

    def __call__(self, positions: Float[np.ndarray, "atoms 3"]) -> Int[np.ndarray, "atoms slots"]:
        """Return sorted neighbors within r_list, one row per atom. Padding entries equal the number of atoms.

        Raises:
            NumericalError: a position is not finite.
            CapacityError: jax-md reports an overflow even for a list that was allocated for these positions.
        """
        positions = np.asarray(positions, np.float64)
        if not np.isfinite(positions).all():
            atom = int(np.argwhere(~np.isfinite(positions).all(axis=1))[0, 0])
            raise NumericalError(f"the position of atom {atom} is not finite")
        atoms = len(positions)
        if atoms < 2:
            return np.full((atoms, 1), atoms, np.int32)
        fractional = positions @ np.linalg.inv(self.cell)
        folded = self._fold(fractional)
        found = None
        if self._list is not None and (folded >= 0).all() and (folded < 1).all():
            with standard_promotion(), _quiet_scatter():
                found = self._update(jnp.asarray(folded), self._list)
        if found is None or bool(found.did_buffer_overflow):
            self._frame(fractional)
            folded = self._fold(fractional)
            with standard_promotion(), _quiet_scatter():
                found = self._allocate(folded)
            if bool(found.did_buffer_overflow):
                raise CapacityError("jax-md allocated a neighbor list that is too small for its pairs")
            self._list = found
        idx = np.asarray(found.idx)
        vectors = positions[np.minimum(idx, atoms - 1)] - positions[:, None, :]
        images = np.where(self.pbc, np.round(vectors @ np.linalg.inv(self.cell)), 0.0)
        vectors -= images @ self.cell
        near = (idx < atoms) & (np.sum(vectors**2, axis=-1) < self.r_list**2)
        # trimmed, so that the result depends on these positions and not on earlier, fuller ones
        widest = max(1, int(near.sum(axis=1).max()))
        return np.sort(np.where(near, idx, atoms).astype(np.int32), axis=1)[:, :widest]


def dense_pairs(
    positions: Float[Array | np.ndarray, "atoms 3"],
    cell: Float[np.ndarray, "3 3"],
    pbc: tuple[bool, bool, bool],
    r_list: float,
) -> Int[np.ndarray, "atoms slots"]:
    """Return neighbors within r_list, found by jax-md. Recent `PairSearch` objects are reused."""
    rows = np.ascontiguousarray(cell, np.float64)
    return _kept_search(rows.tobytes(), pbc, float(r_list))(np.asarray(positions))


@lru_cache(maxsize=4)
def _kept_search(rows: bytes, pbc: tuple[bool, bool, bool], r_list: float) -> PairSearch:
    return PairSearch(np.frombuffer(rows, np.float64).reshape(3, 3), pbc, r_list)
