"""Libraries' neighbor searches as functions of (positions, cell, pbc, r_cut), each complete in itself.

Every function here imports what it needs and names nothing outside itself, because its lines are printed in
scripts that reproduce a failure without mdnum. It calls its library as a user would and mends nothing: atoms
outside the box, odd cells and few atoms go in as they are.
"""

from __future__ import annotations

from dataclasses import replace

from mdnum.references.conformance.lists import Limits, PairList, source_of


def ase_neighbor_list(positions, cell, pbc, r_cut):
    from ase import Atoms
    from ase.neighborlist import neighbor_list

    atoms = Atoms(numbers=[1] * len(positions), positions=positions, cell=cell, pbc=pbc)
    i, j, shift, distance, vector = neighbor_list("ijSdD", atoms, r_cut)
    return {"i": i, "j": j, "shift": shift, "distance": distance, "vector": vector}


def ase_primitive_list(positions, cell, pbc, r_cut):
    import numpy as np
    from ase import Atoms
    from ase.neighborlist import NeighborList, PrimitiveNeighborList

    atoms = Atoms(numbers=[1] * len(positions), positions=positions, cell=cell, pbc=pbc)
    kept = NeighborList(
        [r_cut / 2] * len(positions),
        skin=0.0,
        self_interaction=False,
        bothways=True,
        primitive=PrimitiveNeighborList,
    )
    kept.update(atoms)
    rows = [kept.get_neighbors(atom) for atom in range(len(positions))]
    i = np.repeat(np.arange(len(rows)), [len(row[0]) for row in rows])
    j = np.concatenate([row[0] for row in rows] or [np.zeros(0, int)])
    shift = np.concatenate([row[1].reshape(-1, 3) for row in rows] or [np.zeros((0, 3), int)])
    return {"i": i, "j": j, "shift": shift}


def vesin_cells(positions, cell, pbc, r_cut):
    from vesin import NeighborList

    listed = NeighborList(cutoff=r_cut, full_list=True, algorithm="cell_list")
    i, j, shift, distance, vector = listed.compute(positions, cell, pbc, "ijSdD")
    return {"i": i, "j": j, "shift": shift, "distance": distance, "vector": vector}


def vesin_half(positions, cell, pbc, r_cut):
    from vesin import NeighborList

    listed = NeighborList(cutoff=r_cut, full_list=False)
    i, j, shift, distance, vector = listed.compute(positions, cell, pbc, "ijSdD")
    return {"i": i, "j": j, "shift": shift, "distance": distance, "vector": vector}


def matscipy_list(positions, cell, pbc, r_cut):
    from ase import Atoms
    from matscipy.neighbours import neighbour_list  # type: ignore

    atoms = Atoms(numbers=[1] * len(positions), positions=positions, cell=cell, pbc=pbc)
    i, j, shift, distance, vector = neighbour_list("ijSdD", atoms, r_cut)
    return {"i": i, "j": j, "shift": shift, "distance": distance, "vector": vector}


def pymatgen_points(positions, cell, pbc, r_cut):
    import numpy as np
    from pymatgen.core import Lattice  # type: ignore
    from pymatgen.optimization.neighbors import find_points_in_spheres  # type: ignore

    lattice = np.ascontiguousarray(Lattice(cell, pbc=(bool(pbc[0]), bool(pbc[1]), bool(pbc[2]))).matrix)
    i, j, shift, distance = find_points_in_spheres(
        np.ascontiguousarray(positions),
        np.ascontiguousarray(positions),
        r=float(r_cut),
        pbc=np.array(pbc, dtype=np.int64),
        lattice=lattice,
        tol=1e-12,
    )
    other = (i != j) | np.any(shift != 0, axis=1)
    return {"i": i[other], "j": j[other], "shift": shift[other].astype(int), "distance": distance[other]}


def mdanalysis_nsgrid(positions, cell, pbc, r_cut):
    import numpy as np
    from MDAnalysis.lib.distances import self_capped_distance
    from MDAnalysis.lib.mdamath import triclinic_box

    box = triclinic_box(*cell) if pbc.all() else None
    pairs, distance = self_capped_distance(np.asarray(positions, np.float32), r_cut, box=box, method="nsgrid")
    return {"i": pairs[:, 0], "j": pairs[:, 1], "distance": distance}


def mdanalysis_brute_force(positions, cell, pbc, r_cut):
    import numpy as np
    from MDAnalysis.lib.distances import self_capped_distance
    from MDAnalysis.lib.mdamath import triclinic_box

    box = triclinic_box(*cell) if pbc.all() else None
    pairs, distance = self_capped_distance(
        np.asarray(positions, np.float32), r_cut, box=box, method="bruteforce"
    )
    return {"i": pairs[:, 0], "j": pairs[:, 1], "distance": distance}


def scipy_tree(positions, cell, pbc, r_cut):
    import numpy as np
    from scipy.spatial import KDTree

    edges = np.where(pbc, np.diag(cell), 0.0)
    tree = KDTree(positions, boxsize=edges if pbc.any() else None)
    pairs = tree.query_pairs(r_cut, output_type="ndarray")
    return {"i": pairs[:, 0], "j": pairs[:, 1]}


def freud_query(positions, cell, pbc, r_cut):
    import freud  # type: ignore
    import numpy as np

    if pbc.any():
        (x, _, _), (xy, y, _), (xz, yz, z) = cell
        box = freud.box.Box(x, y, z, xy / y, xz / z, yz / z)
    else:
        box = freud.box.Box.cube(4 * float(np.abs(positions).max(initial=0.0) + r_cut))
    # freud's box has its middle at the origin
    middle = 0.5 * cell.sum(axis=0) if pbc.any() else np.zeros(3)
    query = freud.locality.AABBQuery(box, box.wrap(positions - middle))
    found = query.query(query.points, {"r_max": r_cut, "exclude_ii": True}).toNeighborList()
    return {"i": found.query_point_indices, "j": found.point_indices, "distance": found.distances}


def torch_sim_pairs(positions, cell, pbc, r_cut):
    import torch  # type: ignore
    from torch_sim.neighbors import torch_nl_linked_cell  # type: ignore

    # by name: releases differ in the order of these
    pairs, _, shift = torch_nl_linked_cell(
        positions=torch.as_tensor(positions),
        cell=torch.as_tensor(cell),
        pbc=torch.as_tensor(pbc)[None],
        cutoff=torch.tensor(float(r_cut), dtype=torch.float64),
        system_idx=torch.zeros(len(positions), dtype=torch.long),
        self_interaction=False,
    )
    return {"i": pairs[0].numpy(), "j": pairs[1].numpy(), "shift": shift.numpy()}


def nvalchemi_pairs(positions, cell, pbc, r_cut):
    import torch  # type: ignore
    from nvalchemiops.torch.neighbors import cell_list  # type: ignore

    pairs, _, shift = cell_list(
        torch.as_tensor(positions),
        float(r_cut),
        torch.as_tensor(cell)[None],
        torch.as_tensor(pbc)[None],
        return_neighbor_list=True,
    )
    return {"i": pairs[0].numpy(), "j": pairs[1].numpy(), "shift": shift.numpy()}


def jax_md_pairs(positions, cell, pbc, r_cut):
    from importlib import import_module

    import jax
    import jax.numpy as jnp
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    partition, space = import_module("jax_md.partition"), import_module("jax_md.space")
    positions, r_cut, skewed = jnp.asarray(positions), jnp.float64(r_cut), False
    if not pbc.any():
        displacement, _ = space.free()
        box = jnp.float64(np.ptp(np.asarray(positions), axis=0).max(initial=0.0) + 4 * r_cut)
    elif np.count_nonzero(cell - np.diag(np.diag(cell))):
        skewed, box = True, jnp.asarray(cell.T)
        displacement, _ = space.periodic_general(box, fractional_coordinates=True)
        positions = positions @ jnp.asarray(np.linalg.inv(cell))
    else:
        box = jnp.asarray(np.diag(cell))
        # the word for coordinates that may be outside of the box
        displacement, _ = space.periodic(box, wrapped=False)
    neighbor = partition.neighbor_list(
        displacement,
        box,
        r_cut,
        jnp.float64(0.0),
        fractional_coordinates=skewed,
        disable_cell_list=not pbc.any(),
        format=partition.Sparse,
    )
    found = neighbor.allocate(positions)
    if bool(found.did_buffer_overflow):
        raise ValueError("jax-md says that its list overflowed")
    i, j = np.asarray(found.idx)
    real = (i < len(positions)) & (j < len(positions))
    return {"i": i[real], "j": j[real]}


_SINGLE = 2.0**-24

#: An edge of a box of at most FLT_EPSILON is taken for none (calc_distances.h): a library for Angstrom.
_OF_MDANALYSIS = Limits(minimum_image=True, all_axes=True, lower=True, right_handed=True, least_cutoff=1e-3)

#: Measured on 512 pairs at the cutoff, release 0.2.29: in a periodic box 92 of 478 rows were one-sided, with
#: and without a cell list; in free space, where displacement(a, b) is -displacement(b, a), none.
JAX_MD_KNOWN = {
    "ONE_SIDED": "Its periodic displacement, mod(d + L/2, L) - L/2, rounds otherwise from i to j than from j "
    "to i, and each direction is decided by itself; in free space no pair is one-sided."
}


def _peer(name, package, function, about, **declared) -> PairList:
    return PairList(
        name,
        lambda: function,
        package=package,
        source=source_of(function),
        call=function.__name__,
        about=about,
        **declared,
    )


PEERS: tuple[PairList, ...] = (
    _peer(
        "ase",
        "ase",
        ase_neighbor_list,
        "ase.neighborlist.neighbor_list",
        affords=0.3,
        limits=Limits(least_cutoff=0.5),
    ),
    _peer(
        "ase-primitive",
        "ase",
        ase_primitive_list,
        "the list under ASE's LennardJones, EAM and Tersoff",
        affords=0.3,
        limits=Limits(atoms=1, most_atoms=20_000),
    ),
    _peer("vesin", "vesin", vesin_cells, "vesin's cell list, every pair from both atoms"),
    _peer("vesin-half", "vesin", vesin_half, "vesin, every pair once"),
    _peer(
        "matscipy",
        "matscipy",
        matscipy_list,
        "matscipy.neighbours.neighbour_list",
        limits=Limits(whole_cell=True),
    ),
    _peer(
        "pymatgen",
        "pymatgen",
        pymatgen_points,
        "pymatgen's find_points_in_spheres",
        limits=Limits(least_cutoff=0.01),
    ),
    _peer(
        "mdanalysis",
        "MDAnalysis",
        mdanalysis_nsgrid,
        "MDAnalysis, nsgrid",
        full=False,
        unit=_SINGLE,
        affords=0.3,
        limits=_OF_MDANALYSIS,
    ),
    _peer(
        "mdanalysis-brute",
        "MDAnalysis",
        mdanalysis_brute_force,
        "MDAnalysis, bruteforce",
        full=False,
        unit=_SINGLE,
        affords=0.3,
        limits=replace(_OF_MDANALYSIS, most_atoms=20_000),
    ),
    _peer(
        "scipy",
        "scipy",
        scipy_tree,
        "scipy.spatial.KDTree.query_pairs",
        full=False,
        limits=Limits(minimum_image=True, along_axes=True),
    ),
    _peer(
        "freud",
        "freud-analysis",
        freud_query,
        "freud.locality.AABBQuery",
        unit=_SINGLE,
        limits=Limits(minimum_image=True, all_axes=True, lower=True, right_handed=True, atoms=1),
    ),
    _peer(
        "torch-sim",
        "torch-sim-atomistic",
        torch_sim_pairs,
        "torch-sim's linked cells",
        affords=0.3,
        # its documentation asks for wrapped positions and for periodicity along all axes or none
        limits=Limits(wrapped=True, all_axes=True),
    ),
    _peer(
        "nvalchemi-ops",
        "nvalchemi-toolkit-ops",
        nvalchemi_pairs,
        "nvalchemi-ops' cell_list",
        affords=0.3,
        limits=Limits(whole_cell=True),
    ),
    _peer(
        "jax-md",
        "jax-md",
        jax_md_pairs,
        "jax-md's partition.neighbor_list, allocated each time",
        affords=0.01,
        known=JAX_MD_KNOWN,
        # its box matrix is upper triangular, with vectors as columns
        limits=Limits(minimum_image=True, all_axes=True, lower=True, right_handed=True, most_atoms=5_000),
    ),
)
"""Searches that start from nothing at every question."""
