"""Any jax-md energy function over a neighbor list, as a many-body potential."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.md.jaxmd import Format, NeighborList
from mdnum.md.manybody.base import ManyBody, Smoothness


class Wrapped(ManyBody):
    """A jax-md energy function with the attributes that mdnum needs beside it."""

    energy_fn: Callable[..., Array] = eqx.field(static=True)
    r_cut: float = eqx.field(static=True)
    format: Format = eqx.field(static=True)
    pbc: tuple[bool, bool, bool] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    smoothness: Smoothness = eqx.field(static=True)
    sources: tuple[str, ...] = eqx.field(static=True)

    def energy(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> Float[Array, ""]:
        """Potential energy, in the units of the function wrapped; see ManyBody.energy."""
        return self.energy_fn(positions, neighbor, cell=cell)

    def check_cell(
        self, positions: Float[Array, "atoms 3"], neighbor: NeighborList, cell: Float[Array, "3 3"]
    ) -> None:
        """Raise if the function does not follow the cell it is given.

        jax_md.space's own displacements swallow the keyword and keep the box they were made with: energies
        look right and stresses are silently wrong. Shifting one atom by a lattice vector of a slightly
        larger cell must not change the energy in that cell.

        Raises:
            InputError: it does not.
        """
        larger = cell * 1.03125
        axis = next((axis for axis in range(3) if self.pbc[axis]), None)
        if axis is None:
            return
        points = np.asarray(positions)
        moved = points.copy()
        moved[0] += np.asarray(larger)[axis]
        here = float(self.energy(jnp.asarray(points), neighbor, larger))
        there = float(self.energy(jnp.asarray(moved), neighbor, larger))
        if not abs(here - there) <= 1e-6 * max(abs(here), 1.0):
            raise InputError(
                f"{self.name}: the energy function ignores the cell it is given (a move by a lattice vector "
                f"changes the energy from {here:g} to {there:g})",
                remedy="build it on mdnum.md.jaxmd.displacement instead of a space of jax_md.space",
            )


def from_jax_md(
    energy_fn: Callable[..., Array],
    r_cut: float,
    format: Format = "dense",
    *,
    pbc: tuple[bool, bool, bool] = (True, True, True),
    name: str = "jax-md",
    smoothness: Smoothness | None = None,
    sources: tuple[str, ...] = (),
) -> Wrapped:
    """Wrap a jax-md energy function `energy_fn(positions, neighbor, cell=...)`.

    Build it on `mdnum.md.jaxmd.displacement(cell, pbc)` and hand its constants in as
    `mdnum.md.jaxmd.scalar(...)`: anything else becomes float32 in silence. The function must test r < r_cut
    itself, or its energy depends on when the list was built.

    Args:
        energy_fn: the second of the pair that jax-md's `*_neighbor_list` functions return.
        r_cut: longest interaction radius, length.
        format: neighbor list format that it takes.
        smoothness: at r_cut; if not given, nothing is promised (order -1, jumps unknown: NaN).
    """
    if not (np.isfinite(r_cut) and r_cut > 0):
        raise InputError(f"an interaction radius above 0 is needed; got {r_cut}")
    unknown = Smoothness(-1, float("nan"), float("nan"))
    return Wrapped(
        energy_fn=jax.named_call(energy_fn, name=name),
        r_cut=float(r_cut),
        format=format,
        pbc=pbc,
        name=name,
        smoothness=unknown if smoothness is None else smoothness,
        sources=sources,
    )
