"""What a flip does to a gradient: the time at which a pair crosses its cutoff moves with everything else.

Where the force jumps, a perturbed pair feels it earlier or later, and its momentum is another one ever
after. Differentiating the steps of a program never sees that; the error does not shrink with the time step.
The term is the saltation term of mdnum.numerics, with the cutoff's sphere as the threshold, written for the
reverse pass. A loss that sees the potential energy or the virial jumps with them too: where its frames follow
one another at equal times, a later crossing moves the jump across a share of them.

Source: for a pair with the radial force jump f (positive: repulsive) and the radial speed s, a perturbation
dr of the distance moves the crossing by -dr/s and the momentum along the pair by f dr/s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mdnum.md.cell import HostCell
from mdnum.numerics import Ledger
from mdnum.numerics.saltation import saltation_flagged
from mdnum.systems.build import Simulation

#: Crossings of one step that there is room for at least, as a power of two.
_ROOM_BITS = 6


class Met(NamedTuple):
    """The crossings of some rows on the device, padded to one length.

    Attributes:
        i, j: sorted atoms; beyond the last one where there is no crossing. normal, images: as in `Crossings`.
        push: signed force jump over radial speed, energy/length per (length/time).
        kind: pair type; -1 - kind where it is left out.
        potential, virial: their jumps over the radial speed, energy per (length/time).
    """

    i: Int[Array, "*rows most"]
    j: Int[Array, "*rows most"]
    normal: Float[Array, "*rows 3 most"]
    push: Float[Array, "*rows most"]
    kind: Int[Array, "*rows most"]
    images: Int[Array, "*rows 3 most"]
    potential: Float[Array, "*rows most"]
    virial: Float[Array, "*rows most"]


@dataclass(frozen=True)
class Crossings:
    """The flips of one stretch, as events with a time.

    Attributes:
        ledger: the flips. kind: pair type.
        row: row of each in its stretch. i, j: its atoms in the order of the stretch's list.
        normal: unit vector from i to j at the crossing.
        speed: radial speed there, length per internal time: negative where the pair enters.
        force: radial force that the flip adds, energy/length.
        energy, virial: what the flip adds to the potential energy and to the virial, energy.
        images: lattice vectors from the nearest image of atom j to its wrapped position.
        grazing: slower than the guard: left out.
        weight: derivative of the loss by the cutoff of this one crossing; NaN until the reverse pass has
            been there. For one left out, what it would have been.
    """

    ledger: Ledger
    row: Int[np.ndarray, "crossings"]
    i: Int[np.ndarray, "crossings"]
    j: Int[np.ndarray, "crossings"]
    normal: Float[np.ndarray, "crossings 3"]
    speed: Float[np.ndarray, "crossings"]
    force: Float[np.ndarray, "crossings"]
    energy: Float[np.ndarray, "crossings"]
    virial: Float[np.ndarray, "crossings"]
    kind: Int[np.ndarray, "crossings"]
    images: Int[np.ndarray, "crossings 3"]
    grazing: Bool[np.ndarray, "crossings"]
    weight: Float[np.ndarray, "crossings"]

    def __len__(self) -> int:
        return len(self.row)

    @property
    def kick(self) -> Float[np.ndarray, "crossings"]:
        """How the momentum along the pair follows its distance through the crossing, energy/length per
        (length/time): the saltation matrix of (distance, momentum), whose threshold is the cutoff."""
        still = np.zeros_like(self.speed)
        before, after = np.stack([self.speed, still], axis=1), np.stack([self.speed, self.force], axis=1)
        normal = np.broadcast_to([1.0, 0.0], before.shape)
        return saltation_flagged(np.broadcast_to(np.eye(2), (len(self), 2, 2)), before, after, normal)[0][
            :, 1, 0
        ]

    def _places(self, room: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The crossings sorted by row, their rows, and where each stands among those of its row."""
        counts = np.bincount(self.row, minlength=room)
        order = np.argsort(self.row, kind="stable")
        row = self.row[order]
        return order, row, np.arange(len(row)) - np.concatenate([[0], np.cumsum(counts)[:-1]])[row]

    def on_device(self, room: int, atoms: int) -> Met:
        """Padded to the rows of the stretch."""
        order, row, place = self._places(room)
        # a power of four, so that few are compiled for
        bits = max(_ROOM_BITS, int(place.max(initial=0)).bit_length())
        most = 1 << (bits + bits % 2)

        def padded(values: np.ndarray, nothing: int = 0) -> Array:
            out = np.full((room, *values.shape[1:], most), nothing, values.dtype)
            out[(row, slice(None), place) if values.ndim == 2 else (row, place)] = values[order]
            return jnp.asarray(out)

        # what is left out still has its weight worked out: the sign tells the reverse pass not to apply it
        kind = np.where(self.grazing, -1 - self.kind, self.kind)
        return Met(
            padded(self.i, atoms), padded(self.j, atoms), padded(self.normal), padded(self.kick),
            padded(kind), padded(self.images), padded(self.energy / self.speed),
            padded(self.virial / self.speed),
        )  # fmt: skip

    def gathered(self, values: Float[np.ndarray, "room most *rest"]) -> Float[np.ndarray, "crossings *rest"]:
        """Values of padded rows, in the order of the crossings."""
        order, row, place = self._places(len(values))
        out = np.empty((len(row), *values.shape[2:]))
        out[order] = values[row, place]
        return out

    def weighed(self, weights: Float[np.ndarray, "room most"]) -> Crossings:
        """With the weights that the reverse pass found."""
        return replace(self, weight=self.gathered(weights))


def onto_crossings(
    met: Met,
    onto_x: Float[Array, "3 atoms"],
    onto_v: Float[Array, "3 atoms"],
    here: tuple[Float[Array, "3 atoms"], Float[Array, "3 atoms"], Float[Array, "3 3"]],
    onto_sums: tuple[Float[Array, ""], Float[Array, ""]],
    masses: Float[Array, "atoms"],
    timestep: Float[Array, ""],
    types: int,
) -> tuple[Float[Array, "3 atoms"], Float[Array, "most"], Float[Array, "types"], Float[Array, ""]]:
    """The transpose of the saltation of one step's crossings.

    A crossing lies between two steps, on average in their middle, where positions are half a drift short of
    the later step's.

    Args:
        met: the crossings between the step before and this one.
        onto_x, onto_v: cotangents of this step's positions and of the velocities that lead there.
        here: these wrapped positions and velocities themselves, and the lattice vectors.
        onto_sums: cotangents of potential energy and virial per time, as frames at equal times see them.
        timestep: internal time. types: number of pair types.

    Returns:
        what is added to the cotangent of the positions, derivatives of the loss by the cutoff of each
        crossing, by the cutoff of each pair type, and by a common factor of all distances.
    """
    dtype = onto_x.dtype
    half = (0.5 * timestep).astype(dtype)
    x, v, matrix = here
    pull = met.push.astype(dtype) * _along(met, (onto_v + half * onto_x) / masses.astype(dtype))
    onto_potential, onto_virial = onto_sums
    pull = pull + (onto_potential * met.potential + onto_virial * met.virial).astype(dtype)
    applied = jnp.where(met.kind >= 0, pull, 0)
    along = applied * met.normal.astype(dtype)
    push = jnp.zeros_like(onto_x).at[:, met.j].add(along, mode="drop").at[:, met.i].add(-along, mode="drop")
    kind = jnp.where(met.kind >= 0, met.kind, 0)
    by_radius = jnp.zeros(types, jnp.float64).at[kind].add(-applied.astype(jnp.float64))
    by_scale = jnp.sum(applied * _along(met, x - half * v, matrix)).astype(jnp.float64)
    return push, -pull.astype(jnp.float64), by_radius, by_scale


def _along(
    met: Met, vectors: Float[Array, "3 atoms"], matrix: Float[Array, "3 3"] | None = None
) -> Float[Array, "most"]:
    """Component along each pair of the difference of a vector between its atoms; of nearest images where
    lattice vectors are given."""
    dtype = vectors.dtype
    there = vectors.at[:, met.j].get(mode="fill", fill_value=0)
    here = vectors.at[:, met.i].get(mode="fill", fill_value=0)
    apart = there - here
    if matrix is not None:
        apart = apart - (matrix.T @ met.images.astype(matrix.dtype)).astype(dtype)
    return jnp.sum(met.normal.astype(dtype) * apart, axis=0)


def push_through(
    met: Met,
    x: Float[Array, "3 atoms"],
    v: Float[Array, "3 atoms"],
    masses: Float[Array, "atoms"],
    timestep: Float[Array, ""],
    r_cut: Float[Array, "types"],
    matrix: Float[Array, "3 3"],
) -> tuple[Float[Array, "most"], tuple[Float[Array, "3 atoms"], Float[Array, "3 atoms"]], Float[Array, "2"]]:
    """The saltation of one step's crossings, on one tangent.

    Args:
        met: the crossings between the step before and this one.
        x, v: tangents of this step's wrapped positions and of the velocities that lead there.
        timestep: internal time. r_cut, matrix: tangents of the cutoffs and of the lattice vectors.

    Returns:
        tangents of the distances at the crossings, what is added to x and v, and the times by which the
        jumps of potential energy and virial come earlier, times these jumps, summed.
    """
    dtype = x.dtype
    half = (0.5 * timestep).astype(dtype)
    dr = _along(met, x - half * v, matrix)
    kind = jnp.where(met.kind >= 0, met.kind, 0)
    ahead = jnp.where(met.kind >= 0, dr - r_cut[kind].astype(dtype), 0)
    along = met.push.astype(dtype) * ahead * met.normal.astype(dtype)
    kick = jnp.zeros_like(x).at[:, met.j].add(along, mode="drop").at[:, met.i].add(-along, mode="drop")
    kick = kick / masses.astype(dtype)
    sums = jnp.stack([jnp.sum(jump * ahead.astype(jnp.float64)) for jump in (met.potential, met.virial)])
    return dr.astype(jnp.float64), (half * kick, kick), sums


def crossings(
    simulation: Simulation,
    ledger: Ledger,
    first: int,
    order: Int[np.ndarray, "atoms"],
    x: Float[np.ndarray, "rows 3 atoms"],
    x_before: Float[np.ndarray, "3 atoms"],
    guard: float,
) -> Crossings:
    """The flips of a stretch as events: their normals and radial speeds between two steps.

    Args:
        ledger: its flips. first: step of the first row. order: sorted atom k is atom order[k].
        x: wrapped positions of the stretch. x_before: of the step before it.
        guard: radial speed, length per internal time, below which a crossing is left out.
    """
    row = (ledger.step - first).astype(np.int64)
    place = np.argsort(order)
    low, high = ledger.subject[:, 0], ledger.subject[:, 1]
    i, j = place[low], place[high]
    cell = HostCell(simulation.cell)
    before = np.where((row > 0)[:, None], x[np.maximum(row - 1, 0), :, i], x_before[:, i].T)
    before_j = np.where((row > 0)[:, None], x[np.maximum(row - 1, 0), :, j], x_before[:, j].T)
    earlier = np.stack(cell.displacement(before.astype(np.float64), before_j.astype(np.float64)), axis=1)
    now_i, now_j = x[row, :, i].astype(np.float64), x[row, :, j].astype(np.float64)
    now = np.stack(cell.displacement(now_i, now_j), axis=1)
    inverse = np.asarray(simulation.cell.inverse, np.float64)
    images = np.rint((now_j - now_i - now) @ inverse).astype(np.int64)
    change = np.linalg.norm(now, axis=1) - np.linalg.norm(earlier, axis=1)
    speed = change / float(simulation.integrator.timestep)
    middle = earlier + now
    normal = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    # a distance that did not change has no time of crossing at all
    grazing = ~(np.abs(speed) > guard) | (speed == 0)
    safe = np.where(speed == 0, np.inf, speed)
    force = np.asarray(ledger.extra["force_jump"], np.float64)
    kind = np.asarray(simulation.type_of(low, high), np.int64)
    energy, virial = np.asarray(ledger.jump, np.float64), force * np.asarray(simulation.decider.r_cut)[kind]
    unknown = np.full(len(row), np.nan)
    return Crossings(ledger, row, i, j, normal, safe, force, energy, virial, kind, images, grazing, unknown)
