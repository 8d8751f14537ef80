"""Libraries' lists that are kept and brought up to date, each complete in itself: see `peers`."""

# pyright: reportOptionalMemberAccess=false, reportOptionalCall=false
# (attributes begin as None without a type: a script that prints a class knows no Any)
from __future__ import annotations

from typing import Any

from mdnum.references.conformance.lists import Limits, PairList, source_of
from mdnum.references.conformance.peers import JAX_MD_KNOWN


class AseSkinList:
    """ase.neighborlist.NeighborList, whose skin is what each of two atoms may use up."""

    kept = pbc = None

    def allocate(self, positions, cell, pbc, r_cut, skin):
        from ase.neighborlist import NeighborList, NewPrimitiveNeighborList

        self.pbc = pbc
        self.kept = NeighborList(
            [r_cut / 2] * len(positions),
            skin=skin / 2,
            self_interaction=False,
            bothways=True,
            primitive=NewPrimitiveNeighborList,  # type: ignore
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


class JaxMdList:
    """jax-md's partition.neighbor_list: allocated once, then updated, as its documentation shows."""

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
            raise ValueError("jax-md says that its list overflowed as it was allocated")
        i, j = np.asarray(self.found.idx)
        real = (i < len(positions)) & (j < len(positions))
        return {"i": i[real], "j": j[real]}


class MdnumVerletList:
    """mdnum's own list and rule: rebuilt before the skin is spent, box strain counted."""

    listed = built = pbc = None

    def allocate(self, positions, cell, pbc, r_cut, skin):
        from mdnum.md.verlet import BUILDERS, RebuildRule, VerletList

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


def mdnum_host_list(positions, cell, pbc, r_cut):
    import numpy as np

    from mdnum.md.cell import Cell, wrap_positions
    from mdnum.md.verlet import BUILDERS, RebuildRule, VerletList

    box = Cell.create(cell, pbc)
    wrapped, _ = wrap_positions(box, positions)
    rows = VerletList(BUILDERS["host"], RebuildRule(0.0), r_cut).build(wrapped, box).unsorted()
    i, slot = np.nonzero(rows < len(positions))
    return {"i": i, "j": rows[i, slot]}


def _kept(name: str, package: str, made: type, about: str, **declared: Any) -> PairList:
    return PairList(
        name,
        made,
        kept=True,
        package=package,
        source=source_of(made),
        call=made.__name__,
        about=about,
        **declared,
    )


KEPT_PEERS: tuple[PairList, ...] = (
    _kept(
        "ase-skin",
        "ase",
        AseSkinList,
        "ase.neighborlist.NeighborList with a skin, updated",
        affords=0.1,
        limits=Limits(most_atoms=20_000, roomy=1e5, least_cutoff=0.5),
    ),
    _kept(
        "jax-md-kept",
        "jax-md",
        JaxMdList,
        "jax-md's partition.neighbor_list, allocated and updated",
        affords=0.01,
        known=JAX_MD_KNOWN,
        limits=Limits(
            minimum_image=True,
            all_axes=True,
            lower=True,
            right_handed=True,
            fixed_cell=True,
            atoms=1,
            most_atoms=5_000,
        ),
    ),
    PairList(
        "mdnum",
        lambda: mdnum_host_list,
        package="mdnum",
        source=source_of(mdnum_host_list),
        call="mdnum_host_list",
        about="mdnum's own cell list",
        limits=Limits(minimum_image=True, atoms=1),
    ),
    _kept(
        "mdnum-verlet",
        "mdnum",
        MdnumVerletList,
        "mdnum's own list with a skin, updated",
        limits=Limits(minimum_image=True, atoms=1),
    ),
)
"""Lists that are kept, and mdnum's own."""
