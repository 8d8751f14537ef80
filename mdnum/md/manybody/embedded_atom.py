"""The embedded-atom method from a table, through jax-md's energy function and float64 splines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError, NumericalError
from mdnum.md.displacement import neighbor_vectors
from mdnum.md.jaxmd import Format, NeighborList, displacement, standard_promotion, upstream
from mdnum.md.manybody.base import ManyBody, Smoothness
from mdnum.md.manybody.setfl import Setfl, read_setfl
from mdnum.md.manybody.spline import Spline


class EmbeddedAtom(ManyBody):
    """E = sum_i F(rho_i) + 1/2 sum_ij phi(r_ij), rho_i = sum_j density(r_ij), for one element.

    jax-md's sums are right once it gets a list without self entries; its own list has them and counts every
    atom's density at r = 0, and its splines round the table to float32 and return 0 beyond it.

    Attributes:
        pair, density, embedding: phi, density and F as splines.

    Error: a density off the embedding table makes the energy NaN, forces too; `check_density` says which
    atom. The spline's own error against the form it tabulates is the table's, not counted here.

    Source: Daw and Baskes, Phys. Rev. B 29, 6443 (1984); checked against ase.calculators.eam and a plain
    evaluation in extended precision (tests/oracles_manybody.py).
    """

    pair: Spline
    density: Spline
    embedding: Spline
    r_cut: float = eqx.field(static=True)
    smoothness: Smoothness = eqx.field(static=True)
    element: str = eqx.field(static=True)
    sources: tuple[str, ...] = eqx.field(static=True)
    pbc: tuple[bool, bool, bool] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    format: Format = eqx.field(static=True)

    def charge(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """Density of an atom at distance r; 0 at r = 0 (the atom itself) and from r_cut on."""
        counts = (r > 0) & (r < self.r_cut)
        return jnp.where(counts, self.density(jnp.where(counts, r, 1.0)), 0.0)

    def phi(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """Pair energy at distance r; 0 at r = 0 and from r_cut on."""
        counts = (r > 0) & (r < self.r_cut)
        return jnp.where(counts, self.pair(jnp.where(counts, r, 1.0)), 0.0)

    def embed(self, rho: Float[Array, "..."]) -> Float[Array, "..."]:
        """Energy of an atom in a density; NaN off the table."""
        # a factor and not a selection: it makes the slope NaN too, and forces with it
        on = self.embedding.inside(rho)
        return self.embedding(rho * jnp.where(on, 1.0, jnp.nan).astype(rho.dtype))

    def energy(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, ""]:
        """Potential energy, energy units of the table; see ManyBody.energy."""
        _, total = upstream().energy.eam_neighbor_list(
            displacement(cell, self.pbc),
            1.0,
            charge_fn=self.charge,
            embedding_fn=self.embed,
            pairwise_fn=self.phi,
            cutoff=self.r_cut,
            neighbor_list_fn=lambda *_, **__: None,
        )
        # jax-md mixes dtypes; the result has the dtype of the positions all the same
        with standard_promotion():
            return total(positions, neighbor)

    def densities(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, "atoms"]:
        """The density around each atom, from a dense list."""
        vectors = neighbor_vectors(positions, neighbor.idx, cell, self.pbc)
        own = jnp.arange(positions.shape[0], dtype=jnp.int32)[:, None]
        listed = (neighbor.idx < positions.shape[0]) & (neighbor.idx != own)
        squared = jnp.where(listed, jnp.sum(vectors * vectors, axis=-1), 1.0)
        return jnp.sum(jnp.where(listed, self.charge(jnp.sqrt(squared)), 0.0), axis=1)

    def check_density(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> None:
        """Raise if an atom's density is off the embedding table; on the host, outside jit.

        Raises:
            NumericalError: names the atom, its density and the table's range.
        """
        rho = np.asarray(self.densities(positions, neighbor, cell))
        off = ~np.asarray(self.embedding.inside(jnp.asarray(rho)))
        if off.any():
            atom = int(np.argmax(off))
            raise NumericalError(
                f"the density at atom {atom} is {rho[atom]:g}; the embedding table covers "
                f"{self.embedding.start:g} to {self.embedding.end:g} ({int(off.sum())} atoms are off it)",
                remedy="Atoms are too close: check the structure and the time step, or use a longer table",
            )


def embedded_atom(
    path: Path | str, symbols: Sequence[str] | None = None, pbc: tuple[bool, bool, bool] = (True, True, True)
) -> EmbeddedAtom:
    """The embedded-atom potential of a setfl table.

    Args:
        path: a single-element .eam.alloy file.
        symbols: of the atoms, to be compared with the table's element.
        pbc: which axes are periodic.

    Raises:
        InputError: the file is no such table, or it is for another element.
    """
    table = read_setfl(Path(path))
    others = sorted(set(symbols or ()) - {table.element})
    if others:
        raise InputError(
            f"a table for {table.element}, but the structure holds {', '.join(others)}",
            where=str(path),
            remedy="Correct the structure or potential.file",
        )
    r = table.dr * np.arange(len(table.r_pair))
    # the file holds r phi: phi at r = 0 is unknown, so its spline starts one step later, as ASE's does
    pair = Spline.through(table.r_pair[1:] / r[1:], table.dr, start=table.dr)
    density = Spline.through(table.density, table.dr)
    embedding = Spline.through(table.embedding, table.drho)
    return EmbeddedAtom(
        pair=pair,
        density=density,
        embedding=embedding,
        r_cut=table.r_cut,
        smoothness=_smoothness(table, pair, density, embedding),
        element=table.element,
        sources=tuple(line for line in table.comment if line.strip()),
        pbc=pbc,
        name="eam",
        format="dense",
    )


def _smoothness(table: Setfl, pair: Spline, density: Spline, embedding: Spline) -> Smoothness:
    """Jumps at r_cut, at most: a crossing changes one pair term and the densities of two atoms."""
    at = jnp.asarray(table.r_cut)
    grid = jnp.asarray(table.drho * np.arange(len(table.embedding)))
    steepest = float(jnp.max(jnp.abs(jax.vmap(jax.grad(embedding))(grid))))
    energy = abs(float(pair(at))) + 2 * steepest * abs(float(density(at)))
    force = abs(float(jax.grad(pair)(at))) + 2 * steepest * abs(float(jax.grad(density)(at)))
    # a cubic spline has a second derivative to lose, and a jump below 1e-6 is a table's rounding
    order = -1 if energy > 1e-6 else 0 if force > 1e-6 else 1
    return Smoothness(order, energy, force)
