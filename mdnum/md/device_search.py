"""Neighbor search in XLA. Neighbor lists stay on the device of the positions.

Atoms are compared in the same order as in `md.host_search`. Device and host therefore build the same neighbor
table from the same bins. A search copies two numbers to the host: the largest number of atoms in a bin, and
the largest number of neighbors. Extents of the atoms along nonperiodic axes are also copied to the host.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from mdnum.md.cell import Cell
from mdnum.md.host_search import SAFETY, free_extent, grid

# candidates of the atoms that are taken at a time, which take some fifty bytes each
_AT_A_TIME = 2**21
# by which the room in a bin grows: each is compiled for
_ROOM = 4

_Whole = tuple[int, ...]


@dataclass(frozen=True)
class DeviceBuilder:
    """A cell list in XLA, on the device that holds the positions."""

    name: str = "device"

    def build(
        self, positions: Float[Array | np.ndarray, "atoms 3"], cell: Cell, r_list: float, slots: int
    ) -> tuple[Int[Array, "slots atoms"], Int[Array, "atoms"], int]:
        """Build a neighbor list like `neighbors.ListBuilder.build`. The arrays stay on the device."""
        x = jnp.asarray(positions, np.float64).T
        extent, low, high = cell.widths.copy(), np.zeros(3), np.ones(3)
        if not all(cell.pbc):
            ends = np.asarray(_ends(x))
            for k in np.flatnonzero(~np.array(cell.pbc)):
                low[k], high[k] = ends[:, k]
                extent[k] = free_extent(cell, low[k], high[k])
        bins, reach = (tuple(int(one) for one in part) for part in grid(cell, extent, r_list, len(positions)))
        span = np.where(extent > 0, extent, np.inf)
        # sent, so that nothing that is not said goes to the device
        box, low, span, r2_list = jax.device_put((cell, low, span, np.float64((r_list * SAFETY) ** 2)))
        order, start, places, x, fullest = _binned(x, box, low, span, bins)
        room = -(-int(fullest) // _ROOM) * _ROOM
        candidates = room * int(np.prod([2 * far + 1 for far in reach]))
        blocks = -(-len(positions) * candidates // _AT_A_TIME)
        table, most = _searched(x, places, box, start, r2_list, bins, reach, room, slots, blocks)
        return table, order, int(most)


@jax.jit
def _ends(x):
    return jnp.stack([x.min(axis=1, initial=jnp.inf), x.max(axis=1, initial=-jnp.inf)])


@partial(jax.jit, static_argnames="bins")
def _binned(x, cell: Cell, low, span, bins: _Whole):
    """Sort atoms by bin.

    Returns:
        order of the atoms, start of each bin, bin indices and positions of sorted atoms, largest bin size.
    """
    places, home = [], x
    for k in range(3):
        if cell.pbc[k]:
            share = x[0] * cell.inverse[0, k] + x[1] * cell.inverse[1, k] + x[2] * cell.inverse[2, k]
            # wrapping a tiny negative coordinate can round it to L itself
            outside = jnp.floor(share)
            share, home = share - outside, home - cell.matrix[k][:, None] * outside
        else:
            share = (x[k] - low[k]) / span[k]
        places.append(jnp.clip((share * bins[k]).astype(np.int32), 0, bins[k] - 1))
    bin_of = (places[0] * bins[1] + places[1]) * bins[2] + places[2]
    order = jnp.argsort(bin_of, stable=True)
    every = jnp.arange(bins[0] * bins[1] * bins[2] + 1, dtype=np.int32)
    start = jnp.searchsorted(bin_of[order], every).astype(np.int32)
    return order, start, jnp.stack(places)[:, order], home[:, order], jnp.max(jnp.diff(start))


@partial(jax.jit, static_argnames=("bins", "reach", "room", "slots", "blocks"))
def _searched(
    x, places, cell: Cell, start, r2_list, bins: _Whole, reach: _Whole, room: int, slots: int, blocks: int
):
    """Return the neighbors of each atom and their largest number. At most `slots` neighbors are kept."""
    atoms = x.shape[1]
    matrix = cell.matrix
    # layer after layer along the third axis, as the host goes
    far2, far0, far1 = np.meshgrid(*(np.arange(-reach[k], reach[k] + 1) for k in (2, 0, 1)), indexing="ij")
    far = np.stack([far0, far1, far2]).reshape(3, -1).astype(np.int32)
    by_pair = any(on and not r for on, r in zip(cell.pbc, reach, strict=True))

    def block(atom):
        i = jnp.minimum(atom, atoms - 1)
        there, times, real = [], [], jnp.ones((len(i), far.shape[1]), bool)
        for k in range(3):
            place = places[k, i][:, None] + far[k]
            around = place // bins[k]
            if not cell.pbc[k]:
                real &= around == 0
            there.append(place - around * bins[k])
            times.append(around.astype(np.float64))
        bin_of = (there[0] * bins[1] + there[1]) * bins[2] + there[2]
        begin = start[bin_of]
        count = jnp.where(real, start[bin_of + 1] - begin, 0)
        j = begin[:, :, None] + jnp.arange(room, dtype=np.int32)
        held = (jnp.arange(room, dtype=np.int32) < count[:, :, None]) & (j != i[:, None, None])
        other = jnp.minimum(j, atoms - 1)
        d = []
        for c in range(3):
            shift = (times[0] * matrix[0, c] + times[1] * matrix[1, c]) + times[2] * matrix[2, c]
            d.append((x[c, other] + shift[:, :, None]) - x[c, i][:, None, None])
        dx, dy, dz = cell.minimum_image(*d) if by_pair else d
        near = held & (dx * dx + dy * dy + dz * dz <= r2_list)
        found = jnp.sum(near, axis=2, dtype=np.int32)
        earlier = (jnp.cumsum(found, axis=1) - found)[:, :, None]
        slot = jnp.where(near, earlier + jnp.cumsum(near, axis=2, dtype=np.int32) - 1, slots)
        rows = jnp.full((len(i), slots), atoms, np.int32)
        rows = rows.at[jnp.arange(len(i))[:, None, None], slot].set(j, mode="drop")
        return rows, jnp.max(jnp.sum(found, axis=1), initial=0)

    each = -(-atoms // max(blocks, 1))
    rows, most = lax.map(block, jnp.arange(each * max(blocks, 1), dtype=np.int32).reshape(-1, each))
    return rows.reshape(-1, slots)[:atoms].T, jnp.max(most)


BUILDER = DeviceBuilder()
