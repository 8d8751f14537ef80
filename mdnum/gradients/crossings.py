"""Effect on gradients of the times at which pairs cross their cutoff (saltation).

A perturbed pair crosses the cutoff earlier or later. If the force jumps at the cutoff, another crossing time
also changes the pair's momentum. The derivative at fixed decisions omits this change, however short the time
step. A saltation matrix (mdnum.numerics) adds the effect of the crossing time. The potential energy and the
virial also jump at a crossing. If a loss sums energies or virials over frames, a later crossing shifts the
jump by a fraction of a frame.

Let a pair have the radial force jump f (positive: repulsive) and the radial speed s. A change dr of its
distance changes the crossing time by -dr/s, and the momentum along the pair by f dr/s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt8

from mdnum.errors import InputError
from mdnum.md.cell import HostCell
from mdnum.md.decide import Tables
from mdnum.md.ledger import FlipTable
from mdnum.md.pairforce import ManyBodyForce
from mdnum.systems.simulation import Simulation

if TYPE_CHECKING:
    from mdnum.gradients.tape import TapeStretch

#: Smallest capacity for the crossings of one step, as a power of two.
_ROOM_BITS = 6


class Met(NamedTuple):
    """Cutoff crossings of one or several steps, padded to a fixed size."""

    # i, j: sorted atoms; beyond the last one where there is no crossing
    i: Int[Array, "most"]
    j: Int[Array, "most"]
    # normal, images: as in `Crossings`
    normal: Float[Array, "3 most"]
    push: Float[Array, "most"]  # signed force jump over radial speed, energy/length per (length/time)
    kind: Int[Array, "most"]  # pair type; -1 - kind where it is left out
    images: Int[Array, "3 most"]
    # potential, virial: their jumps over the radial speed, energy per (length/time)
    potential: Float[Array, "most"]
    virial: Float[Array, "most"]


class MetRows(NamedTuple):
    """Cutoff crossings of a stretch of steps, padded to a fixed size."""

    met: Met  # of all rows
    spans: Int[np.ndarray, "room 2"]  # where each row begins, and how many crossings it has
    slots: Int[np.ndarray, "most"]  # numbers from 0, as many as the row with the most has, or a few more

    def row(self, span: Int[Array, "2"], atoms: int) -> Met:
        """Return the crossings of one step."""
        most = len(self.slots)
        own = Met(*(lax.dynamic_slice_in_dim(column, span[0], most, -1) for column in self.met))
        # behind them are those of the next row
        here = self.slots < span[1]
        i, j = (jnp.where(here, end, atoms) for end in (own.i, own.j))
        return own._replace(i=i, j=j, kind=jnp.where(here, own.kind, -1))


@dataclass(frozen=True)
class Crossings:
    """Cutoff crossings in a stretch of steps, with normals, radial speeds and force jumps."""

    ledger: FlipTable  # the flips
    row: Int[np.ndarray, "crossings"]  # row of each in its stretch, ascending
    # i, j: its atoms in the order of the stretch's list
    i: Int[np.ndarray, "crossings"]
    j: Int[np.ndarray, "crossings"]
    normal: Float[np.ndarray, "crossings 3"]  # unit vector from i to j at the crossing
    # radial speed there, length per internal time: negative where the pair enters
    speed: Float[np.ndarray, "crossings"]
    force: Float[np.ndarray, "crossings"]  # radial force that the flip adds, energy/length
    # energy, virial: what the flip adds to the potential energy and to the virial, energy
    energy: Float[np.ndarray, "crossings"]
    virial: Float[np.ndarray, "crossings"]
    kind: Int[np.ndarray, "crossings"]  # pair type
    # lattice vectors from the nearest image of atom j to its wrapped position
    images: Int[np.ndarray, "crossings 3"]
    grazing: Bool[np.ndarray, "crossings"]  # slower than the guard: left out
    # derivative of the loss by the cutoff of this one crossing; NaN until the reverse pass has been there.
    # For one left out, what it would have been
    weight: Float[np.ndarray, "crossings"]

    def __len__(self) -> int:
        return len(self.row)

    @property
    def kick(self) -> Float[np.ndarray, "crossings"]:
        """Force jump (energy/length) divided by the radial speed (length/time), for each crossing. The
        quotient is the change of the pair's radial momentum per change of its distance.
        """
        return self.force / self.speed

    def spans(self, room: int) -> Int[np.ndarray, "room 2"]:
        """Return the index of the first crossing and the number of crossings for each of `room` steps."""
        starts = np.searchsorted(self.row, np.arange(room + 1))
        return np.stack([starts[:-1], np.diff(starts)], axis=1)

    def rows(self, room: int) -> MetRows:
        """Return the cutoff crossings of `room` steps, padded to a fixed size."""
        spans = self.spans(room)
        most = _padded(int(spans[:, 1].max(initial=0)))
        # a slice of so many fits everywhere
        long = _padded(len(self) + most)

        def padded(values: np.ndarray) -> Any:
            out = np.zeros((*values.shape[1:], long), values.dtype)
            out[..., : len(self)] = values.T
            return out

        # what is left out still has its weight worked out: the sign tells the reverse pass not to apply it
        kind = np.where(self.grazing, -1 - self.kind, self.kind)
        columns = (
            self.i, self.j, self.normal, self.kick, kind, self.images,
            self.energy / self.speed, self.virial / self.speed,
        )  # fmt: skip
        return MetRows(Met(*map(padded, columns)), spans, np.arange(most))

    def gathered(self, values: Float[np.ndarray, "room most *rest"]) -> Float[np.ndarray, "crossings *rest"]:
        """Return an array with one entry per crossing, without padding."""
        return values[np.arange(values.shape[1]) < self.spans(len(values))[:, 1:]]

    def weighed(self, weights: Float[np.ndarray, "room most"]) -> Crossings:
        """Return a copy of the crossings with the weights of a reverse pass."""
        return replace(self, weight=self.gathered(weights))


def _padded(count: int) -> int:
    """Round a count up to a power of four. Programs are then compiled for few array sizes."""
    bits = max(_ROOM_BITS, count.bit_length())
    return 1 << (bits + bits % 2)


def onto_crossings(
    met: Met,
    onto_x: Float[Array, "3 atoms"],
    onto_v: Float[Array, "3 atoms"],
    onto_sums: tuple[Float[Array, ""], Float[Array, ""]],
    masses: Float[Array, "atoms"],
    timestep: Float[Array, ""],
    types: int,
    pull: Float[Array, "most"] | None = None,
    squeeze: Float[Array, "*axes"] | None = None,
) -> tuple[Float[Array, "3 atoms"], Float[Array, "most"], Float[Array, "types"], Float[Array, "3 3"]]:
    """Propagate cotangents backward through the crossings (saltation) of one step.

    On average, a crossing lies halfway through the drift between two steps. Let n be the unit vector from i
    to j, f the force jump, h the lattice vectors, and s = n · (v_j - v_i) + n · (dh/dt h^-1) r the radial
    speed. A perturbation changes the distance by dr = n · (dx_j - dx_i - dL). Here L is the lattice
    translation between the images. The duration of the force jump then changes by dr/s:

        d(m v_j) = f n dr/s = -d(m v_i)    on the atoms, through the force
        d(W) = (f r_cut n ⊗ n) dr/s        on the integrator's use of the virial tensor W

    The cotangent of dr is therefore f/s n · (v̄_j/m_j - v̄_i/m_i) + f r_cut/s n · S n. Here v̄ is the
    cotangent of v. S is the cotangent of the virial in a step, divided by the time step.

    Args:
        met: the crossings between the previous step and this one.
        onto_x, onto_v: cotangents of this step's positions and of the velocities that lead there.
        onto_sums: cotangents of potential energy and virial per time, for frames at equal times.
        timestep: internal time. types: number of pair types.
        pull: cotangent of each distance, for a crossing that does not act along its pair alone.
        squeeze: cotangent of the virial that the integrator uses, or of its tensor, over the time step.

    Returns:
        the contribution to the cotangent of the positions, and the derivatives of the loss by the cutoff of
        each crossing, by the cutoff of each pair type, and by the lattice vectors.
    """
    dtype = onto_x.dtype
    half = (0.5 * timestep).astype(dtype)
    if pull is None:
        pull = met.push.astype(dtype) * _along(met, (onto_v + half * onto_x) / masses.astype(dtype))
        onto_potential, onto_virial = onto_sums
        if squeeze is not None:
            # n · S n for each normal n, where S is a tensor or a number times the unit tensor
            along = jnp.sum(met.normal * (squeeze @ met.normal), axis=0) if squeeze.ndim else squeeze
            onto_virial = onto_virial + along
        pull = pull + (onto_potential * met.potential + onto_virial * met.virial).astype(dtype)
    applied = jnp.where(met.kind >= 0, pull, 0)
    along = applied * met.normal.astype(dtype)
    push = jnp.zeros_like(onto_x).at[:, met.j].add(along, mode="drop").at[:, met.i].add(-along, mode="drop")
    kind = jnp.where(met.kind >= 0, met.kind, 0)
    by_radius = jnp.zeros(types, jnp.float64).at[kind].add(-applied.astype(jnp.float64))
    by_matrix = -(met.images.astype(jnp.float64) @ along.T.astype(jnp.float64))
    return push, -pull.astype(jnp.float64), by_radius, by_matrix


def of_energy(
    force: ManyBodyForce,
    tables: Tables,
    bits: UInt8[Array, "words atoms"],
    met: Met,
    count: Int[Array, ""],
    x: Float[Array, "3 atoms"],
    onto: tuple[Float[Array, "3 atoms"], Float[Array, ""], Float[Array, ""]],
    squeeze: Float[Array, "*axes"] | None = None,
) -> Float[Array, "most"]:
    """Compute cotangents of crossing distances. The energy is evaluated with and without each pair.

    The jump affects all atoms whose energy depends on the pair. The jump is evaluated at the cutoff distance.
    For other pairs, the decisions at the end of the step are used.

    Args:
        met: crossings whose `push` is one over the radial speed, negative where the pair leaves.
        count: number of crossings.
        x: this step's wrapped positions.
        onto: cotangents of the velocities, over the masses, and of potential energy and virial.
        squeeze: as for `onto_crossings`.
    """
    w, potential, virial = onto
    index, atom = tables.index, jnp.arange(x.shape[1])
    slots = jnp.arange(8, dtype=jnp.uint8)[None, :, None]
    matrix, unit = force.cell.matrix.astype(force.dtype), jnp.eye(3, dtype=force.dtype)
    strain = virial * unit
    if squeeze is not None:
        strain = strain + (squeeze if squeeze.ndim else squeeze * unit)
    short = 0.5 * (force.potential.r_cut - _along(met, x, jnp.asarray(force.cell.matrix)))

    def one(k, found):
        i, j, normal = met.i[k], met.j[k], met.normal[:, k] * short[k]
        pair = ((index == j) & (atom == i)) | ((index == i) & (atom == j))
        pair = jnp.sum(pair.astype(jnp.uint8) << slots, axis=1, dtype=jnp.uint8)
        at = x.at[:, j].add(normal.astype(x.dtype)).at[:, i].add(-normal.astype(x.dtype))
        ends = [
            force.energy_of(tables, force.neighbors(at, tables, held)) for held in (bits | pair, bits & ~pair)
        ]

        def change(x, by):
            return ends[0](x, matrix, by) - ends[1](x, matrix, by)

        here = at.T.astype(force.dtype), unit
        jump, slope = jax.jvp(change, here, (w.T.astype(force.dtype), strain.astype(force.dtype)))
        return found.at[k].set(met.push[k] * (potential * jump - slope))

    return lax.fori_loop(0, count, one, jnp.zeros_like(met.push)).astype(x.dtype)


def _along(
    met: Met, vectors: Float[Array, "3 atoms"], matrix: Float[Array, "3 3"] | None = None
) -> Float[Array, "most"]:
    """Return the difference between the vectors of the two atoms, projected on each pair's direction.
    If `matrix` contains lattice vectors, the nearest image of the second atom is used.
    """
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
    """Propagate one tangent forward through the crossings (saltation) of one step.

    Args:
        met: the crossings between the previous step and this one.
        x, v: tangents of this step's wrapped positions and of the velocities that lead there.
        timestep: internal time. r_cut, matrix: tangents of the cutoffs and of the lattice vectors.

    Returns:
        tangents of the distances at the crossings, increments of x and v, and the sums over crossings of the
        jumps of potential energy and virial, each times the time by which the jump comes earlier.
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


def crossings(simulation: Simulation, stretch: TapeStretch, guard: float) -> Crossings:
    """Return the flips of a stretch of steps as crossings.

    Args:
        stretch: recorded with its flips.
        guard: radial speed, length per internal time, below which a crossing is left out.

    Raises:
        InputError: the stretch was recorded without flips.
    """
    ledger = stretch.ledger
    if ledger is None:
        raise InputError("the flips of the run were not recorded", remedy="Repeat the run, recording flips")
    row = (ledger.step - stretch.first).astype(np.int64)
    low, high = ledger.i, ledger.j
    i, j = stretch.table.place[low % simulation.atoms], stretch.table.place[high]
    if simulation.channels > 1:
        ledger = replace(ledger, i=low % simulation.atoms)
    cell, x, ahead = HostCell(simulation.cell), stretch.x.reshape(-1), stretch.x_before.reshape(-1)
    boxes = [stretch.cell_of(row - 1, simulation.cell) for row in range(stretch.rows + 1)]
    matrices, inverses = (np.array([getattr(one, name) for one in boxes]) for name in ("matrix", "inverse"))
    atoms = stretch.x.shape[2]

    def positions(rows: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Return atom positions at the steps in `rows`. Row -1 is the step before the first row."""
        axes = [of + k * atoms for k in range(3)]
        seen = [x.take(3 * atoms * rows + at, mode="clip") for at in axes]
        return np.stack([np.where(rows < 0, ahead[at], one) for at, one in zip(axes, seen, strict=True)], 1)

    def apart(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return minimum-image displacements of pairs, and the numbers of lattice vectors subtracted."""
        start, end = positions(rows, i).astype(np.float64), positions(rows, j).astype(np.float64)
        inverse = inverses[rows + 1]
        if stretch.cell.size:
            n = np.rint(np.einsum("ka,kab->kb", end - start, inverse))
            near = end - start - np.einsum("ka,kab->kb", n, matrices[rows + 1])
        else:
            near = np.stack(cell.displacement(start, end), axis=1)
        return near, np.rint(np.einsum("ka,kab->kb", end - start - near, inverse)).astype(np.int64)

    (earlier, _), (now, images) = apart(row - 1), apart(row)
    change = np.linalg.norm(now, axis=1) - np.linalg.norm(earlier, axis=1)
    speed = change / float(simulation.integrator.timestep)
    middle = earlier + now
    normal = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    # a distance that did not change has no time of crossing at all
    grazing = ~(np.abs(speed) > guard) | (speed == 0)
    safe = np.where(speed == 0, np.inf, speed)
    force, kind = ledger.force_jump, np.asarray(simulation.type_of(low, high), np.int64)
    energy, virial = ledger.energy_jump, force * np.asarray(simulation.decider.r_cut)[kind]
    if not simulation.pairwise:
        # what it does is found where it is transposed (`of_energy`)
        force, energy, virial = np.where(ledger.entered, 1.0, -1.0), 0 * safe, 0 * safe
    unknown = np.full(len(row), np.nan)
    return Crossings(ledger, row, i, j, normal, safe, force, energy, virial, kind, images, grazing, unknown)
