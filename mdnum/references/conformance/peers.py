"""Neighbor searches of libraries, found by name or `module:function`.

Every function and class in this module is self-contained, including all imports. The source of each function
and class is copied into scripts that reproduce a failure without mdnum. Each function calls its library as a
user would. Unusual input is passed on unchanged.
"""

# pyright: reportOptionalMemberAccess=false, reportOptionalCall=false
# (attributes begin as None without a type: a script that prints a class knows no Any)
from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mdnum.errors import InputError
from mdnum.plain import beside
from mdnum.references.conformance.lists import LISTS, ListLimits, PairList, from_object, source_of
from mdnum.references.load import place
from mdnum.registry import meant

_DECLARED: dict[str, Any] = beside(__file__)


def _declared(name: str) -> dict[str, Any]:
    row = dict(_DECLARED[name])
    if (other := row.pop("like", None)) is None:
        return row
    base = _declared(other)
    return {**base, **row, "limits": {**base.get("limits", {}), **row.get("limits", {})}}


def peer(*names: str, helpers: Sequence[Any] = ()) -> Callable[[Any], Any]:
    """Return a decorator that registers a neighbor list in `LISTS` by given names.

    Args:
        names: names listed in peers.toml.
        helpers: other objects used in the source of the decorated object, for scripts without mdnum.
    """

    def register(made: Any) -> Any:
        kept, source = inspect.isclass(made), "\n\n".join(source_of(one) for one in (*helpers, made))
        for name in names:
            declared = _declared(name)
            given, call = declared.pop("given", {}), made.__name__
            about = declared.pop("about")
            called = functools.partial(made, **given) if given else made
            if given:
                arguments = ", ".join(f"{word}={value!r}" for word, value in given.items())
                call = f"(lambda *given: {call}(*given, {arguments}))"
            declared["limits"] = ListLimits(**declared.get("limits", {}))
            declared["needs"] = tuple(declared.get("needs", ()))
            listed = PairList(
                name, called if kept else lambda called=called: called, kept, source=source, call=call,
                description=about, word=name, **declared,
            )  # fmt: skip
            LISTS.add(name, listed, description=about)
        return made

    return register


@peer("numpy-r2", "numpy")
def numpy_pairs(positions, cell, pbc, r_cut, squared=False):
    """Brute-force search in plain numpy that tests one image of every pair."""

    import numpy as np

    i, j = np.triu_indices(len(positions), 1)
    d = positions[j] - positions[i]
    if pbc.any():
        box = np.where(pbc[:, None], cell, 0.0)
        fraction = d @ np.linalg.pinv(box)
        d = d - np.where(pbc, np.rint(fraction), 0.0) @ box
    r2 = (d * d).sum(axis=1)
    inside = r2 < r_cut * r_cut if squared else np.sqrt(r2) < r_cut
    return {"i": i[inside], "j": j[inside]}


@peer("ase")
def ase_neighbor_list(positions, cell, pbc, r_cut):
    """ASE's function ase.neighborlist.neighbor_list."""

    from ase import Atoms
    from ase.neighborlist import neighbor_list

    atoms = Atoms(numbers=[1] * len(positions), positions=positions, cell=cell, pbc=pbc)
    i, j, shift, distance, vector = neighbor_list("ijSdD", atoms, r_cut)
    return {"i": i, "j": j, "shift": shift, "distance": distance, "vector": vector}


@peer("ase-skin")
class AseSkinList:
    """The class ase.neighborlist.NeighborList of ASE. A skin is added to the radius of each atom."""

    kept = pbc = None

    def __init__(self, primitive="NewPrimitiveNeighborList"):
        self.primitive = primitive

    def allocate(self, positions, cell, pbc, r_cut, skin):
        from ase import neighborlist

        self.pbc = pbc
        self.kept = neighborlist.NeighborList(
            [r_cut / 2] * len(positions),
            skin=skin / 2,
            self_interaction=False,
            bothways=True,
            primitive=getattr(neighborlist, self.primitive),
        )
        return self.update(positions, cell)

    def update(self, positions, cell):
        import numpy as np
        from ase import Atoms

        atoms = Atoms(numbers=[1] * len(positions), positions=positions, cell=cell, pbc=self.pbc)
        self.kept.update(atoms)
        rows = [self.kept.get_neighbors(atom) for atom in range(len(positions))]
        i = np.repeat(np.arange(len(rows)), [len(row[0]) for row in rows])
        j = np.concatenate([row[0] for row in rows] or [np.zeros(0, int)])
        shift = np.concatenate([row[1].reshape(-1, 3) for row in rows] or [np.zeros((0, 3), int)])
        return {"i": i, "j": j, "shift": shift}


@peer("ase-primitive", helpers=[AseSkinList])
def ase_primitive_list(positions, cell, pbc, r_cut):
    """The class PrimitiveNeighborList of ASE, used by its calculators LennardJones, EAM and Tersoff."""
    return AseSkinList("PrimitiveNeighborList").allocate(positions, cell, pbc, r_cut, 0.0)


@peer("vesin", "vesin-half")
def vesin_cells(positions, cell, pbc, r_cut, half=False):
    """The cell list of vesin, with every pair once for each of its two atoms."""

    from vesin import NeighborList

    # half a list is found by the algorithm that vesin chooses
    listed = NeighborList(cutoff=r_cut, full_list=not half, algorithm="auto" if half else "cell_list")
    i, j, shift, distance, vector = listed.compute(positions, cell, pbc, "ijSdD")
    return {"i": i, "j": j, "shift": shift, "distance": distance, "vector": vector}


@peer("matscipy")
def matscipy_list(positions, cell, pbc, r_cut):
    """The function matscipy.neighbours.neighbour_list of matscipy."""

    from ase import Atoms
    from matscipy.neighbours import neighbour_list  # type: ignore

    atoms = Atoms(numbers=[1] * len(positions), positions=positions, cell=cell, pbc=pbc)
    i, j, shift, distance, vector = neighbour_list("ijSdD", atoms, r_cut)
    return {"i": i, "j": j, "shift": shift, "distance": distance, "vector": vector}


@peer("pymatgen")
def pymatgen_points(positions, cell, pbc, r_cut):
    """The function find_points_in_spheres of pymatgen."""

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


@peer("mdanalysis", "mdanalysis-brute")
def mdanalysis_pairs(positions, cell, pbc, r_cut, method="nsgrid"):
    """The nsgrid search of MDAnalysis."""

    import numpy as np
    from MDAnalysis.lib.distances import self_capped_distance
    from MDAnalysis.lib.mdamath import triclinic_box

    box = triclinic_box(*cell) if pbc.all() else None
    pairs, distance = self_capped_distance(np.asarray(positions, np.float32), r_cut, box=box, method=method)
    return {"i": pairs[:, 0], "j": pairs[:, 1], "distance": distance}


@peer("scipy")
def scipy_tree(positions, cell, pbc, r_cut):
    """The k-d tree search of SciPy, scipy.spatial.KDTree.query_pairs."""

    import numpy as np
    from scipy.spatial import KDTree

    edges = np.where(pbc, np.diag(cell), 0.0)
    tree = KDTree(positions, boxsize=edges if pbc.any() else None)
    pairs = tree.query_pairs(r_cut, output_type="ndarray")
    return {"i": pairs[:, 0], "j": pairs[:, 1]}


@peer("freud")
def freud_query(positions, cell, pbc, r_cut):
    """The class freud.locality.AABBQuery of freud."""

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


@peer("torch-sim")
def torch_sim_pairs(positions, cell, pbc, r_cut):
    """The linked-cell search of torch-sim."""

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


@peer("nvalchemi-ops")
def nvalchemi_pairs(positions, cell, pbc, r_cut, room=64):
    """The function cell_list of nvalchemi-ops."""

    import torch  # type: ignore
    from nvalchemiops.torch.neighbors import NeighborOverflowError, cell_list  # type: ignore

    asked = torch.as_tensor(positions), float(r_cut), torch.as_tensor(cell)[None], torch.as_tensor(pbc)[None]
    try:
        # its own estimate is for a unit of length (0.2 atoms in a cubic Angstrom)
        pairs, _, shift = cell_list(*asked, max_neighbors=room, return_neighbor_list=True)
    except NeighborOverflowError as error:
        return nvalchemi_pairs(positions, cell, pbc, r_cut, max(2 * room, error.num_neighbors))
    return {"i": pairs[0].numpy(), "j": pairs[1].numpy(), "shift": shift.numpy()}


@peer("jax-md-kept")
class JaxMdList:
    """The function partition.neighbor_list of jax-md, with updates as shown in its documentation."""

    found = neighbor = step = None
    skewed = free = False

    def allocate(self, positions, cell, pbc, r_cut, skin):
        from importlib import import_module

        import jax
        import jax.numpy as jnp
        import numpy as np

        jax.config.update("jax_enable_x64", True)
        partition, space = import_module("jax_md.partition"), import_module("jax_md.space")
        self.free = not pbc.any()
        self.skewed = not self.free and bool(np.count_nonzero(cell - np.diag(np.diag(cell))))
        if self.free:
            displacement, _ = space.free()
            box = jnp.float64(np.ptp(positions, axis=0).max(initial=0.0) + 8 * r_cut)
        elif self.skewed:
            box = jnp.asarray(cell.T)
            displacement, _ = space.periodic_general(box, fractional_coordinates=True)
        else:
            box = jnp.asarray(np.diag(cell))
            displacement, _ = space.periodic(box, wrapped=False)
        self.neighbor = partition.neighbor_list(
            displacement,
            box,
            jnp.float64(r_cut),
            jnp.float64(skin),
            fractional_coordinates=self.skewed,
            disable_cell_list=self.free,
            format=partition.Sparse,
        )
        self.found = self.neighbor.allocate(self.placed(positions, cell))
        # compiled once, as in a run; by itself each update is traced anew and takes a second
        self.step = jax.jit(lambda found, placed: found.update(placed))
        return self.pairs(positions)

    def update(self, positions, cell):
        placed = self.placed(positions, cell)
        self.found = self.step(self.found, placed)
        if bool(self.found.did_buffer_overflow):
            self.found = self.neighbor.allocate(placed)
        return self.pairs(positions)

    def placed(self, positions, cell):
        import jax.numpy as jnp
        import numpy as np

        # a copy: jax may take numpy's memory for its own, and the next positions are written there
        return jnp.array(positions @ np.linalg.inv(cell) if self.skewed else positions)

    def pairs(self, positions):
        import numpy as np

        if bool(self.found.did_buffer_overflow):
            raise ValueError("jax-md allocated a neighbor list that is too small for its pairs")
        i, j = np.asarray(self.found.idx)
        real = (i < len(positions)) & (j < len(positions))
        return {"i": i[real], "j": j[real]}


@peer("jax-md", helpers=[JaxMdList])
def jax_md_pairs(positions, cell, pbc, r_cut):
    """The function partition.neighbor_list of jax-md, with a new allocation at each call."""
    return JaxMdList().allocate(positions, cell, pbc, r_cut, 0.0)


@peer("mdnum-verlet")
class MdnumVerletList:
    """The Verlet list of mdnum, rebuilt before motion and box strain exceed the skin."""

    listed = built = pbc = None

    def allocate(self, positions, cell, pbc, r_cut, skin):
        from mdnum.md.neighbors import BUILDERS, RebuildRule, VerletList

        self.pbc = pbc
        self.listed = VerletList(BUILDERS["host"], RebuildRule(skin), r_cut)
        self.built = None
        return self.update(positions, cell)

    def update(self, positions, cell):
        import numpy as np

        from mdnum.md.cell import Cell, wrap_positions

        box = Cell.create(cell, self.pbc)
        wrapped, _ = wrap_positions(box, positions)
        if self.built is None or self.listed.consumed(wrapped, box, *self.built[1:]) >= 1.0:
            self.built = (self.listed.build(wrapped, box), wrapped, box)
        rows = self.built[0].unsorted()
        i, slot = np.nonzero(rows < len(positions))
        return {"i": i, "j": rows[i, slot]}


@peer("mdnum", helpers=[MdnumVerletList])
def mdnum_host_list(positions, cell, pbc, r_cut):
    """The cell list of mdnum."""
    return MdnumVerletList().allocate(positions, cell, pbc, r_cut, 0.0)


# --- from a word to a list ---------------------------------------------------------------------------


def known() -> tuple[PairList, ...]:
    """Return all registered neighbor lists, even if their packages are not installed."""

    def named(name: str) -> PairList:
        listed = LISTS[name]
        if not isinstance(listed, PairList):
            package = LISTS.package(name)
            listed = replace(from_object(listed, name), package=package, description=LISTS.description(name))
        return replace(listed, word=name)

    return tuple(map(named, LISTS))


def installed() -> tuple[PairList, ...]:
    """Return the registered neighbor lists whose packages are installed."""
    return tuple(listed for listed in known() if not listed.lacks)


def load(word: str) -> PairList:
    """Return the neighbor list with a given name.

    Args:
        word: a name from `known()`, `package.module:function`, or `path/to/file.py:function`; see
            `mdnum.references.load`. The function takes (positions, cell, pbc, r_cut) and returns pairs in a
            form that `answer.read` accepts; a class or an object with `allocate` and `update` is an updatable
            list (`KeptList`).

    Raises:
        InputError: the neighbor list does not exist, or cannot be imported.
    """
    by_name = {listed.name: listed for listed in known()}
    if word in by_name:
        listed = by_name[word]
        if lacks := listed.lacks:
            message = (
                f"{word} needs {' and '.join(lacks)}, which {'are' if lacks[1:] else 'is'} not installed"
            )
            raise InputError(message, remedy=f"Run python3 -m pip install {' '.join(lacks)}")
        return listed
    where = place(word)
    if where is None:
        further = f"Give {', '.join(sorted(by_name))}, package.module:function or file.py:function"
        message = f"{word!r} is not a known neighbor list"
        raise InputError(message, remedy=meant(word, by_name) + further)
    made = where.find()
    lines, call = where.source()
    listed = from_object(made, f"{Path(where.home).stem}:{where.call}" if where.is_file else word, lines)
    if "(" not in call:
        return replace(listed, word=word, call=call)
    # an object, or a function that another made: made anew for each life
    call = f"(lambda: {call})" if listed.kept else call
    return replace(listed, word=word, call=call, make=where.find)
