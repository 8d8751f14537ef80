"""Forward-mode derivatives: tangents with respect to a few parameters, along a recorded run.

A tangent is propagated through each step at the recorded state and decisions. Each parameter entry needs one
more force evaluation per step, but no memory for earlier steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from mdnum.gradients.crossings import Crossings, MetRows, crossings, push_through
from mdnum.gradients.losses import LossFrame
from mdnum.gradients.parameters import (
    Direction,
    ParameterEntry,
    columns_of,
    directions,
    quantities,
    with_quantities,
)
from mdnum.gradients.tape import RunTape, TapeStretch, frame_of
from mdnum.md.decide import Tables
from mdnum.md.integrators import KickDrift, check_kick, unsorted
from mdnum.md.pairforce import Forces, ManyBodyForce, PairForce
from mdnum.rollout.epoch import over_rows


class TangentCarry(NamedTuple):
    """Tangents of the state between two steps, one per parameter entry. Atoms are in the user's order."""

    # of the positions as if the box had no faces, at the step that comes next
    x: Float[Array, "columns 3 atoms"]
    v: Float[Array, "columns 3 atoms"]  # of the half-kicked velocities that lead there
    total: Any  # of the sums of the loss
    # of potential energy and virial, by flips since the last frame that the loss looked at
    waiting: Float[Array, "columns 2"]


@dataclass(frozen=True)
class StretchTangents:
    """Tangents along consecutive steps with the same neighbor list."""

    stretch: TapeStretch  # the steps
    columns: tuple[ParameterEntry, ...]  # the numbers by which it is differentiated
    # x, v: tangents of the positions (as if the box had no faces) and of the full-step velocities in the
    # order of the stretch's list; None where they were not asked for
    x: Float[np.ndarray, "rows columns 3 atoms"] | None
    v: Float[np.ndarray, "rows columns 3 atoms"] | None
    crossings: Crossings | None  # its flips as events; None for a tape without flips
    # tangent of the distance of each crossing's pair at the crossing
    dr: Float[np.ndarray, "crossings columns"] | None
    dr_cut: Float[np.ndarray, "crossings columns"] | None  # of its cutoff
    total: Any  # of the sums of the loss up to here


def tangents(
    tape: RunTape,
    names: Sequence[str],
    *,
    saltation: bool = False,
    guard: float = 0.0,
    states: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[StretchTangents]:
    """Yield tangents with respect to parameters for each stretch of steps.

    If saltation is False, the tangents do not include the effect of flips. The contribution of flips is the
    sum of weight * (dr_cut - dr) over crossings. Event-aware reverse mode provides the weights.

    Args:
        tape: the run; recorded with flips if crossings are needed. names: full names of parameters.
        saltation: whether the tangents jump at every crossing that does not graze.
        guard: radial speed, length per internal time, below which a crossing grazes.
        states: whether to return the tangents of every step.

    Raises:
        InputError: saltation with a tape without flips, or an integrator that is not a linear `KickDrift`.

    Error: a rounding error times the growth of the tangent; no truncation error, for the program as it ran.
    """
    simulation = tape.simulation
    force = simulation.force
    check_kick(simulation.integrator)
    columns = columns_of(simulation, names)
    along = directions(simulation, columns)
    total = jax.tree.map(lambda one: jnp.zeros((len(columns), *one.shape), one.dtype), tape.total)
    carry = TangentCarry(along.x, along.v, total, jnp.zeros((len(columns), 2)))
    for stretch in tape.forward():
        order = stretch.table.order
        wanted = saltation or stretch.ledger is not None
        met = crossings(simulation, stretch, guard) if wanted else None
        crossed = None if met is None else met.rows(len(stretch.x))
        carry, (by_row, dr) = _stretch(
            force, simulation.integrator, jnp.asarray(simulation.masses[order]),
            simulation.tables(stretch.table), stretch.columns, stretch.bits, stretch.rows,
            tape.seen(stretch), (tape.loss, tape.origin, tape.around, tape.pace), crossed,
            carry._replace(x=carry.x[..., order], v=carry.v[..., order]), along,
            jnp.asarray(float(saltation)), states,
        )  # fmt: skip
        carry = carry._replace(x=unsorted(carry.x, order), v=unsorted(carry.v, order))
        x, v = (np.asarray(part)[: stretch.rows] for part in by_row) if states else (None, None)
        moved = None if met is None else met.gathered(np.moveaxis(np.asarray(dr), 1, 2))
        cuts = None if met is None else np.asarray(along.r_cut).T[met.kind]
        yield StretchTangents(stretch, columns, x, v, met, moved, cuts, carry.total)
        if progress is not None:
            progress(stretch.first + stretch.rows - 1, tape.steps)


def by_column(tape: RunTape, total: Any) -> Float[np.ndarray, "columns"]:
    """Compute derivatives of the loss from the tangents of its sums over frames."""

    def one(tangent):
        return jax.jvp(lambda total: tape.loss.value(total, tape.frames), (tape.total,), (tangent,))[1]

    return np.asarray(jax.vmap(one)(total), np.float64)


def _evaluate(force: PairForce | ManyBodyForce, x, tables: Tables, told, values, matrix) -> Forces:
    """Evaluate forces with other parameters and lattice vectors. Nearest images are kept."""
    other: Any = with_quantities(force, values)
    other = replace(other, cell=replace(force.cell, matrix=matrix))
    if isinstance(force, PairForce):
        return other(x, tables, decisions=False, given=told)
    # it decides again, at the recorded positions, hence as it did
    return other(x, tables, decisions=False)


@partial(jax.jit, static_argnames=("states",))
def _stretch(
    force: PairForce | ManyBodyForce,
    integrator: KickDrift,
    masses: Float[Array, "atoms"],
    tables: Tables,
    rows,
    bits,
    used,
    seen,
    looking,
    crossed: MetRows | None,
    carry: TangentCarry,
    along: Direction,
    jumps: Float[Array, ""],
    states: bool,
):
    loss, origin, around, pace = looking
    order = tables.order
    dtype = rows[1].dtype
    mass_row = masses.astype(dtype)
    numbers = eqx.filter(integrator, eqx.is_inexact_array)
    rest = eqx.filter(integrator, eqx.is_inexact_array, inverse=True)
    matrix = jnp.asarray(force.cell.matrix)
    volume = around.volume

    def evaluate(told):
        def forces(x, values, matrix):
            made = _evaluate(force, x, tables, told, values, matrix)
            energy = jnp.sum(made.energy, dtype=jnp.float64)
            return made.force.astype(dtype) / mass_row, energy, made.virial

        return forces

    def drift(x, v, numbers, number):
        x, v, _ = eqx.combine(numbers, rest).drift(x, v, masses, number, order)
        return x, v

    def look(row, total, x, v, potential, virial, along):
        frame = frame_of(row, order, around.matrix)
        whole = frame._replace(x=unsorted(x, order), v=unsorted(v, order))
        moving = whole._replace(step=_still(frame.step), potential=potential, virial=virial)
        start = LossFrame(_still(origin.step), along.x, along.v, jnp.zeros(()), jnp.zeros(()))
        # of a cube with the box: the volume goes with the trace of what moves the lattice vectors
        stretch = jnp.trace(jnp.linalg.solve(_whole(matrix), along.matrix))
        here = jax.tree.map(jnp.zeros_like, around)._replace(
            matrix=along.matrix, volume=volume * stretch, timestep=along.integrator.timestep
        )
        _, seen = jax.jvp(loss.observe, (frame, origin, around), (moving, start, here))
        return jax.tree.map(jnp.add, total, seen)

    def push(row, told, see, span, carry: TangentCarry, along: Direction):
        """Propagate the tangent with respect to one parameter entry through one step."""
        number, x, v = row[0], row[1], row[2]
        dx, dv = carry.x, carry.v
        half, first = (0.5 * integrator.timestep).astype(dtype), number == 0
        dr, waiting = jnp.zeros(0), carry.waiting
        shift = (along.matrix.T @ row[3].astype(matrix.dtype)).astype(dtype)
        if crossed is not None:
            met = crossed.row(span, x.shape[1])
            dr, (by_x, by_v), ahead = push_through(
                met, dx - shift, dv, masses, integrator.timestep, along.r_cut, along.matrix
            )
            dx, dv = dx + jumps.astype(dtype) * by_x, dv + jumps.astype(dtype) * by_v
            waiting = waiting + jumps * pace.share(number, integrator.timestep) * ahead
        (acceleration, *_), (onto, potential, virial) = jax.jvp(
            evaluate(told), (x, quantities(force), matrix), (dx - shift, along.model, along.matrix)
        )
        kick = half * onto + 0.5 * along.integrator.timestep.astype(dtype) * acceleration
        dv = dv + jnp.where(first, 0, kick)
        potential, virial = potential + waiting[0], virial + waiting[1]
        total = lax.cond(
            see, look, lambda row, total, *_: total, row, carry.total, dx, dv, potential, virial, along
        )
        waiting = jnp.where(see, 0, waiting)
        _, (after_x, after_v) = jax.jvp(
            lambda x, v, numbers: drift(x, v, numbers, number),
            (x, integrator.kick(v, half, acceleration), numbers),
            (dx, dv + kick, along.integrator),
        )
        return TangentCarry(after_x, after_v, total, waiting), (dx, dv), dr

    def step(carry, given):
        row, told, see, span = given
        after, here, dr = jax.vmap(partial(push, row, told, see, span))(carry, along)
        return after, (here if states else (), dr)

    spans = None if crossed is None else crossed.spans
    return over_rows(step, carry, (rows, bits, seen, spans), used)


def _whole(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return the lattice vectors, with unit vectors in place of zero vectors."""
    missing = jnp.all(matrix == 0, axis=1)
    return jnp.where(missing[:, None], jnp.eye(3, dtype=matrix.dtype), matrix)


def _still(integer: Array) -> Any:
    """Return the zero tangent that JAX requires for an integer."""
    return np.zeros(jnp.shape(integer), jax.dtypes.float0)
