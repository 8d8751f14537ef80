"""The reverse pass of a rollout, stretch by stretch: at the states and decisions that the run recorded.

Inside jax.value_and_grad a compiler makes another forward pass, whose rounding, and after some thousand
steps whose decisions, are not those of the run that was simulated. Here the run is made first, by the program
that makes every run, and the reverse pass linearizes at what it recorded.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from mdnum.errors import InputError
from mdnum.gradients.crossings import Crossings, crossings, onto_crossings
from mdnum.gradients.forces import FORCE, MODEL, SCALE, pull_back
from mdnum.gradients.losses import LossFrame
from mdnum.gradients.parameters import Cotangents, quantities
from mdnum.gradients.tape import RunTape, TapeStretch, frame_of, over_rows, unsorted
from mdnum.md.integrators import Integrator
from mdnum.md.pairforce import ManyBodyForce, PairForce

#: Everything that a run is made of.
ALL = frozenset((MODEL, SCALE, FORCE))


class AdjointCarry(NamedTuple):
    """What the reverse pass carries from step to step.

    Attributes:
        x: cotangent of the positions at the step that comes next in time, shape (3, atoms).
        v: of the half-kicked velocities that lead there, shape (3, atoms).
        model, integrator: of parameters, so far.
        scale: of a common factor of all distances, so far.
        origin: of the frame of step 0 where the loss compares with it, user's order.
        r_cut: of the cutoffs by the times of flips, so far, shape (types,).
        frame: of potential energy and virial in the frame that the loss looks at next in time.
    """

    x: Float[Array, "3 atoms"]
    v: Float[Array, "3 atoms"]
    model: Any
    integrator: Any
    scale: Float[Array, ""]
    origin: tuple[Float[Array, "3 atoms"], Float[Array, "3 atoms"]]
    r_cut: Float[Array, "types"]
    frame: tuple[Float[Array, ""], Float[Array, ""]]


class Trace(NamedTuple):
    """What the reverse pass carried at every step of a stretch.

    Row k belongs to the state (x, half-kicked v) that step first + k begins with, before the crossings that
    lead there; rows beyond the used ones are void.

    Attributes:
        x, v: cotangents of positions and velocities, in the order of the stretch's list, shape
            (room, 3, atoms).
        model, integrator, scale, r_cut: as in `AdjointCarry`, with a leading axis of rows: what the steps
            from here to the end have added.
        frame: as in `AdjointCarry`, each of shape (room,).
    """

    x: Float[Array, "room 3 atoms"]
    v: Float[Array, "room 3 atoms"]
    model: Any
    integrator: Any
    scale: Float[Array, "room"]
    r_cut: Float[Array, "room types"]
    frame: tuple[Float[Array, "room"], Float[Array, "room"]]


def reverse(
    tape: RunTape,
    *,
    wanted: frozenset[str] = ALL,
    saltation: bool = False,
    guard: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[TapeStretch, Trace], None] | None = None,
) -> tuple[Cotangents, list[Crossings]]:
    """Derivatives of a tape's loss by everything that the run is made of.

    Args:
        tape: the run.
        wanted: what is wanted beyond the start: of MODEL, SCALE and FORCE (the integrator's numbers).
        saltation: whether to add what every flip does through the time at which it happens.
        guard: radial speed, length per internal time, below which a flip counts as grazing and adds nothing.
        progress: called with the steps done and the last step.
        watch: called with every stretch, last first, and what was carried at its steps.

    Returns:
        The derivatives, and the crossings of every stretch with their weights, last stretch first.

    Raises:
        InputError: a many-body potential with its flips.

    Error: of the order of a rounding error times the growth of the adjoint; none of truncation, for the
    program as it ran.
    """
    back = StretchReversal(tape, wanted, guard if saltation else None)
    found: list[Crossings] = []
    for stretch in tape.backward():
        weights, trace = back.through(stretch, traced=watch is not None)
        if watch is not None and trace is not None:
            watch(stretch, trace)
        if back.met is not None:
            found.append(back.met.weighed(weights))
        if progress is not None:
            progress(tape.steps - stretch.first, tape.steps)
    return back.cotangents(), found


class StretchReversal:
    """A reverse pass on its way, from the end of a tape to its start.

    Args:
        tape: the run.
        wanted: of MODEL, SCALE and FORCE.
        guard: radial speed below which a flip adds nothing; None where flips do not count.

    Attributes:
        carry: what is carried, atoms in the user's order.
        met: the crossings of the stretch that was gone through last; None where flips do not count.

    Raises:
        InputError: a many-body potential with its flips.
    """

    def __init__(self, tape: RunTape, wanted: frozenset[str], guard: float | None):
        simulation = tape.simulation
        force = simulation.force
        if guard is not None and not isinstance(force, PairForce):
            raise InputError(
                "what flips add is known for pair potentials only",
                remedy="Use the method symmetric for a many-body potential",
                where=simulation.system.name,
            )
        self.tape, self.wanted, self.guard, self.force = tape, wanted, guard, force
        self.onto_total = jax.grad(lambda total: tape.loss.value(total, tape.frames))(tape.total)
        nothing = jnp.zeros((3, simulation.atoms), simulation.policy.dtype("state"))
        numbers, _ = eqx.partition(simulation.integrator, _is_number)
        self.met: Crossings | None = None
        self.carry = AdjointCarry(
            nothing,
            nothing,
            jax.tree.map(jnp.zeros_like, quantities(force)),
            jax.tree.map(jnp.zeros_like, numbers),
            jnp.zeros((), force.policy.dtype("force")),
            (nothing, nothing),
            jnp.zeros(simulation.pair_types, jnp.float64),
            (jnp.zeros((), jnp.float64), jnp.zeros((), jnp.float64)),
        )

    def arguments(self, stretch: TapeStretch, traced: bool) -> tuple[Any, ...]:
        """What `transposed` is called with for a stretch, from where the pass stands."""
        simulation, order = self.tape.simulation, stretch.table.order
        self.met = None
        if self.guard is not None:
            assert stretch.ledger is not None, "made without flips"
            self.met = crossings(
                simulation, stretch.ledger, stretch.first, order, stretch.x, stretch.x_before, self.guard
            )
        return (
            self.force,
            simulation.integrator,
            simulation.masses[order],
            simulation.tables(stretch.table),
            stretch.columns,
            stretch.bits,
            stretch.rows,
            self.tape.seen(stretch),
            (self.tape.loss, self.tape.origin, self.tape.around, self.onto_total, self.tape.pace),
            None if self.met is None else self.met.on_device(len(stretch.x), simulation.atoms),
            self.carry,
            self.wanted,
            traced,
        )

    def through(
        self, stretch: TapeStretch, *, traced: bool = False
    ) -> tuple[Float[np.ndarray, "room most"], Trace | None]:
        """Carry everything through a stretch: the weights of its crossings, and what each step carried."""
        self.carry, (weights, trace) = transposed(*self.arguments(stretch, traced))
        return np.asarray(weights), trace

    def cotangents(self) -> Cotangents:
        """The derivatives, once the start has been reached."""
        simulation, carry = self.tape.simulation, self.carry
        x = np.asarray(carry.x + carry.origin[0], np.float64)
        v = np.asarray(carry.v + carry.origin[1], np.float64)
        # distances stretch with the box; the velocities of the start do not
        scale = float(carry.scale) - float(np.sum(v * np.asarray(simulation.velocities).T))
        return Cotangents(carry.model, carry.integrator, x, v, scale, np.asarray(carry.r_cut))


def _is_number(leaf: Any) -> bool:
    return eqx.is_inexact_array(leaf)


@partial(jax.jit, static_argnames=("wanted", "traced"))
def transposed(
    force: PairForce | ManyBodyForce,
    integrator: Integrator,
    masses: Float[Array, "atoms"],
    tables,
    rows,
    bits,
    used,
    seen,
    looking,
    crossed,
    carry: AdjointCarry,
    wanted: frozenset[str],
    traced: bool,
):
    """The transpose of a stretch of steps: the carry before it, the weights of its crossings, its trace."""
    loss, origin, around, onto_total, pace = looking
    order = tables.order
    # carried from list to list in the user's order
    carry = carry._replace(x=carry.x[:, order], v=carry.v[:, order])
    dtype = rows[1].dtype
    mass_row = masses.astype(dtype)
    # the noise of a thermostat belongs to the atom, and its size to the length that atoms are measured in
    numbers, rest = eqx.partition(integrator, _is_number)

    def drift(x, v, numbers, scale, step):
        whole = eqx.combine(numbers, rest)
        x, v, _ = whole.drift(x, v, masses * (scale * scale), step, order)
        return x, v

    def look(row):
        """Cotangents of one frame and of the origin, from those of the sums."""

        def seen_at(x, v, potential, virial, origin, length, timestep):
            at = (row[0], x, v, row[3], potential, virial)
            here = around._replace(
                matrix=around.matrix * length, volume=around.volume * length**3, timestep=timestep
            )
            frame = frame_of(at, order, around.matrix)
            scaled = frame._replace(x=frame.x * length.astype(dtype), v=frame.v * length.astype(dtype))
            start = LossFrame(
                origin_step, origin[0] * length.astype(dtype), origin[1] * length.astype(dtype), nan, nan
            )
            return loss.observe(scaled, start, here)

        nan, origin_step = origin.potential, origin.step
        one = jnp.ones((), jnp.float64)
        _, back = jax.vjp(seen_at, row[1], row[2], row[4], row[5], (origin.x, origin.v), one, around.timestep)
        return back(onto_total)

    def blind(row):
        return (
            jnp.zeros_like(row[1]),
            jnp.zeros_like(row[2]),
            jnp.zeros_like(row[4]),
            jnp.zeros_like(row[5]),
            (jnp.zeros_like(origin.x), jnp.zeros_like(origin.v)),
            jnp.zeros((), jnp.float64),
            jnp.zeros((), jnp.float64),
        )

    def step(carry: AdjointCarry, given):
        row, told, see, met = given
        number, x, v = row[0], row[1], row[2]
        half = (0.5 * integrator.timestep).astype(dtype)
        second = jnp.where(number == 0, jnp.zeros((), dtype), half)
        one = jnp.ones((), jnp.float64)
        # drift is linear in x and v, so where it is transposed does not matter to them
        _, back = jax.vjp(lambda x, v: drift(x, v, numbers, one, number), x, v)
        onto_x, onto_kicked = back((carry.x, carry.v))
        loss_x, loss_v, onto_potential, onto_virial, onto_origin, onto_length, onto_time = lax.cond(
            see, look, blind, row
        )
        onto_v = onto_kicked + loss_v
        w = (half * onto_kicked + second * onto_v) / mass_row
        made = pull_back(force, x, tables, told, w, onto_potential, onto_virial, wanted)
        model, numbers_bar, scale = carry.model, carry.integrator, carry.scale
        if MODEL in wanted:
            model = jax.tree.map(jnp.add, model, made.model)
        if FORCE in wanted:
            acceleration = made.force / mass_row
            _, back = jax.vjp(
                lambda numbers, scale: drift(x, v + half * acceleration, numbers, scale, number), numbers, one
            )
            by_numbers, by_scale = back((carry.x, carry.v))
            kick = jnp.sum(onto_kicked * acceleration) + jnp.where(
                number == 0, 0, jnp.sum(onto_v * acceleration)
            )
            by_numbers = eqx.tree_at(
                lambda one: one.timestep,
                by_numbers,
                by_numbers.timestep + (0.5 * kick + onto_time).astype(by_numbers.timestep.dtype),
            )
            numbers_bar = jax.tree.map(jnp.add, numbers_bar, by_numbers)
            scale = scale + by_scale.astype(scale.dtype)
        if SCALE in wanted:
            scale = scale + made.scale + onto_length.astype(scale.dtype)
        after = AdjointCarry(
            onto_x + loss_x + made.x,
            onto_v,
            model,
            numbers_bar,
            scale,
            jax.tree.map(jnp.add, carry.origin, onto_origin),
            carry.r_cut,
            (
                jnp.where(see, onto_potential.astype(jnp.float64), carry.frame[0]),
                jnp.where(see, onto_virial.astype(jnp.float64), carry.frame[1]),
            ),
        )
        trace = None
        if traced:
            trace = Trace(after.x, after.v, model, numbers_bar, scale, carry.r_cut, after.frame)
        weights = jnp.zeros(0)
        if met is not None:
            # the forces are there wherever the derivative by scale is wanted
            arriving = v - half * made.force / mass_row
            share = pace.share(number, integrator.timestep)
            push, weights, by_radius, by_scale = onto_crossings(
                met,
                after.x,
                after.v,
                (x, arriving, jnp.asarray(force.cell.matrix)),
                (share * after.frame[0], share * after.frame[1]),
                masses,
                integrator.timestep,
                carry.r_cut.shape[0],
            )
            after = after._replace(
                x=after.x + push,
                v=after.v - half * push,
                r_cut=after.r_cut + by_radius,
                scale=after.scale + by_scale.astype(after.scale.dtype),
            )
        return after, (weights, trace)

    carry, by_row = over_rows(step, carry, (rows, bits, seen, crossed), used, backward=True)
    return carry._replace(x=unsorted(carry.x, order), v=unsorted(carry.v, order)), by_row
