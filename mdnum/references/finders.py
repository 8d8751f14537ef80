"""Other people's neighbor searches behind one call: the pairs within r_cut, i < j, and their distances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module, metadata

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from mdnum.errors import MdnumError
from mdnum.references.oracle import widths

Found = tuple[Int[ndarray, "pairs"], Int[ndarray, "pairs"], Float[ndarray, "pairs"]]
Search = Callable[[ndarray, ndarray, ndarray, float], Found]


class FinderError(MdnumError):
    """A neighbor search raised instead of answering."""


@dataclass(frozen=True)
class Finder:
    """A neighbor search of some library.

    Attributes:
        name: library and, where it has several, the method.
        package: distribution whose version counts.
        search: (positions, cell, pbc, r_cut) -> (i, j, distance), one row per pair and image.
        unit_roundoff: 2**-53 where the library works in float64, 2**-24 in float32.
        images: whether a pair may be listed through several images (cells smaller than 2 r_cut).
        orthorhombic_only: refuses tilted cells.
        all_or_none: knows only "all directions periodic" and "none".
        ours: mdnum's own or jax-md's: what a run stands on.
        affords: how many tiny searches it is asked for beyond the needed ones; each costs jax-md 0.3 s.
    """

    name: str
    package: str
    search: Search
    unit_roundoff: float = 2.0**-53
    images: bool = True
    orthorhombic_only: bool = False
    all_or_none: bool = False
    ours: bool = False
    affords: int = 100

    @property
    def version(self) -> str | None:
        """Installed version, or None where the library is missing."""
        try:
            return metadata.version(self.package)
        except metadata.PackageNotFoundError:
            return None

    def refusal(self, cell: Float[ndarray, "3 3"], pbc: Bool[ndarray, "3"], r_cut: float) -> str | None:
        """Why this search cannot be asked about this box, or None when it can."""
        if self.version is None:
            return "not installed"
        if self.all_or_none and pbc.any() and not pbc.all():
            return "no periodicity per axis"
        if self.orthorhombic_only and pbc.any() and np.count_nonzero(cell - np.diag(np.diag(cell))):
            return "orthorhombic cells only"
        if not self.images and pbc.any() and r_cut >= 0.5 * widths(_completed(cell, pbc))[pbc].min():
            return "minimum image only, and the cell is narrower than two cutoffs"
        return None

    def pairs(
        self,
        positions: Float[ndarray, "atoms 3"],
        cell: Float[ndarray, "3 3"],
        pbc: Bool[ndarray, "3"],
        r_cut: float,
    ) -> Found:
        """The pairs this search lists within r_cut, each once, with i <= j, sorted.

        Raises:
            FinderError: the library raised; what it said is in the message.
        """
        try:
            i, j, distance = self.search(
                np.ascontiguousarray(positions, dtype=np.float64),
                np.ascontiguousarray(cell, dtype=np.float64),
                np.asarray(pbc, dtype=bool),
                float(r_cut),
            )
        except MdnumError:
            raise
        except Exception as error:
            if self.ours:  # a defect to see whole
                raise
            # another library's search may fail in any way; that is a result of the comparison
            raise FinderError(f"{type(error).__name__}: {error}", where=self.name) from error
        order = np.lexsort((distance, j, i))
        return i[order], j[order], distance[order]


def half(i: ndarray, j: ndarray, distance: ndarray, shift: ndarray) -> Found:
    """One of the two directions of every pair of a full list; for an atom and its image, one shift."""
    leading = np.sign(shift[:, 0]) * 4 + np.sign(shift[:, 1]) * 2 + np.sign(shift[:, 2])
    keep = (i < j) | ((i == j) & (leading > 0))
    return np.asarray(i)[keep].astype(int), np.asarray(j)[keep].astype(int), np.asarray(distance)[keep]


def _completed(cell: ndarray, pbc: ndarray) -> ndarray:
    from ase.geometry.cell import complete_cell

    return complete_cell(np.where(np.asarray(pbc)[:, None], cell, 0.0))


def _sorted_ends(i: ndarray, j: ndarray, distance: ndarray) -> Found:
    return np.minimum(i, j).astype(int), np.maximum(i, j).astype(int), np.asarray(distance, dtype=float)


def _numpy(compare_squares: bool) -> Search:
    def search(positions, cell, pbc, r_cut):
        i, j = np.triu_indices(len(positions), 1)
        displacement = positions[j] - positions[i]
        if pbc.any():
            fractional = np.linalg.solve(_completed(cell, pbc).T, displacement.T).T
            shift = np.where(pbc, np.rint(fractional), 0.0)
            displacement = displacement - shift @ np.where(pbc[:, None], cell, 0.0)
        squared = (displacement * displacement).sum(axis=1)
        distance = np.sqrt(squared)
        inside = squared < r_cut * r_cut if compare_squares else distance < r_cut
        return i[inside], j[inside], distance[inside]

    return search


def _ase(positions, cell, pbc, r_cut):
    from ase.neighborlist import primitive_neighbor_list

    i, j, distance, shift = primitive_neighbor_list(
        "ijdS", pbc, _completed(cell, pbc) if pbc.any() else np.eye(3), positions, r_cut
    )
    return half(i, j, distance, shift)


def _ase_tree(positions, cell, pbc, r_cut):
    """The list under ASE's own LennardJones, EAM and Tersoff."""
    from ase.neighborlist import PrimitiveNeighborList

    listed = PrimitiveNeighborList(
        [r_cut / 2] * len(positions), skin=0.0, self_interaction=False, bothways=False
    )
    cell = _completed(cell, pbc)
    listed.build(pbc, cell, positions)
    i = np.repeat(np.arange(len(positions)), [len(row) for row in listed.neighbors])
    j = np.concatenate([np.asarray(row, int) for row in listed.neighbors])
    shift = np.concatenate([np.asarray(row, float).reshape(-1, 3) for row in listed.displacements])
    distance = np.sqrt(((positions[j] + shift @ cell - positions[i]) ** 2).sum(axis=1))
    return _sorted_ends(i, j, distance)


def _vesin(positions, cell, pbc, r_cut):
    from vesin import NeighborList

    listed = NeighborList(cutoff=r_cut, full_list=False, n_threads=1)
    i, j, distance = listed.compute(positions, np.where(pbc[:, None], cell, 0.0), pbc, "ijd")
    return _sorted_ends(i, j, distance)


def _matscipy(positions, cell, pbc, r_cut):
    neighbours = import_module("matscipy.neighbours")
    if pbc.any():
        origin, box = np.zeros(3), _completed(cell, pbc)
    else:  # without a box it wants one that holds the atoms
        origin = positions.min(axis=0) - 1.0
        box = np.diag(np.ptp(positions, axis=0) + 2.0)
    i, j, distance, shift = neighbours.neighbour_list(
        "ijdS", positions=positions, cell=box, pbc=pbc, cutoff=r_cut, cell_origin=origin
    )
    return half(i, j, distance, shift)


def _mdanalysis(method: str) -> Search:
    def search(positions, cell, pbc, r_cut):
        distances = import_module("MDAnalysis.lib.distances")
        triclinic_box = import_module("MDAnalysis.lib.mdamath").triclinic_box
        box = triclinic_box(*cell) if pbc.all() else None
        if box is not None:
            # its box is six lengths and angles, so the atoms must be turned into that frame
            rotation = np.linalg.solve(
                cell, np.asarray(import_module("ase.cell").Cell(cell).standard_form()[0])
            )
            positions = positions @ rotation
        pairs, distance = distances.self_capped_distance(
            np.ascontiguousarray(positions, dtype=np.float32), r_cut, box=box, method=method
        )
        return _sorted_ends(pairs[:, 0], pairs[:, 1], distance)

    return search


def _scipy(positions, cell, pbc, r_cut):
    cKDTree = import_module("scipy.spatial").cKDTree

    lengths = np.where(pbc, np.diag(cell), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        wrapped = np.where(pbc, positions - np.floor(positions / lengths) * lengths, positions)
    wrapped = np.where(pbc & (wrapped >= lengths), 0.0, wrapped)
    pairs = cKDTree(wrapped, boxsize=lengths if pbc.any() else None).query_pairs(r_cut, output_type="ndarray")
    displacement = wrapped[pairs[:, 1]] - wrapped[pairs[:, 0]]
    with np.errstate(divide="ignore", invalid="ignore"):
        displacement -= np.where(pbc, np.rint(displacement / lengths), 0.0) * lengths
    return _sorted_ends(pairs[:, 0], pairs[:, 1], np.sqrt((displacement**2).sum(axis=1)))


_SINGLE = 2.0**-24

PEERS: tuple[Finder, ...] = (
    Finder("numpy r² <", "numpy", _numpy(True), images=False),
    Finder("numpy r <", "numpy", _numpy(False), images=False),
    Finder("ASE neighbor_list", "ase", _ase),
    Finder("ASE PrimitiveNeighborList", "ase", _ase_tree),
    Finder("vesin", "vesin", _vesin),
    Finder("matscipy", "matscipy", _matscipy),
    Finder("MDAnalysis nsgrid", "MDAnalysis", _mdanalysis("nsgrid"), _SINGLE, images=False, all_or_none=True),
    Finder(
        "MDAnalysis brute force",
        "MDAnalysis",
        _mdanalysis("bruteforce"),
        _SINGLE,
        images=False,
        all_or_none=True,
    ),
    Finder("scipy cKDTree", "scipy", _scipy, images=False, orthorhombic_only=True),
)
"""The searches that have nothing to do with mdnum."""
