"""Exact time reversal of a run with an integer state.

A step is reversed by subtracting the integers that the step added. All states of the forward run are
recovered bit for bit. The neighbor lists may differ, because integer sums do not depend on order.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from mdnum.errors import InputError, NumericalError
from mdnum.md.decide import Tables
from mdnum.md.fixed_point import FixedPointStep
from mdnum.md.integrators import ByAtom, unsorted
from mdnum.md.neighbors import PairTable, VerletList
from mdnum.rollout.engine import Engine
from mdnum.rollout.epoch import EpochProgram, EpochRecord, EpochState, write_row
from mdnum.systems.simulation import Simulation


class Back(NamedTuple):
    """State of a run during time reversal, in the user's order of atoms."""

    step: Int[Array, ""]  # the step whose forces come next; -1 when all are done
    x: Float[Array, "3 atoms"]  # wrapped positions at that step, shape (3, atoms)
    v: Float[Array, "3 atoms"]  # velocities after its first half kick; in the end, those of the start
    images: Int[Array, "3 atoms"]  # lattice vectors taken off by wrapping so far, shape (3, atoms)
    extra: Any  # of the integrator: what friction had forgotten by then


class Stretched(NamedTuple):
    """Steps of a reversed run, earliest first. Atoms are in the order of the neighbor list."""

    first: int  # step of the first row
    rows: int  # how many there are; the record's other rows are void
    record: EpochRecord  # as an epoch's, without kinetic energy, heat and displacement
    table: PairTable  # the list
    # positions of the step before the first row, shape (3, atoms); at the start, its own
    x_before: np.ndarray
    back: Back  # where the way back goes on


@partial(jax.jit, static_argnames=("structure",))
def _undrifted(leaves, structure, state: EpochState) -> Back:
    """Return the state of a run before the last update of positions."""
    program: EpochProgram = jax.tree.unflatten(structure, leaves)
    order = jnp.arange(state.x.shape[1])
    return _before(program, program.masses, order, Back(state.step, *state[1:4], state.extra))


def _before(program: EpochProgram, masses, order, back: Back) -> Back:
    """Reverse an update of positions (a drift). Return the previous state."""
    step = back.step - 1
    x, v, extra = program.integrator.undrift(  # type: ignore[attr-defined]
        back.x, back.v, back.extra, masses, step, order
    )
    wrapped, n = program.force.cell.wrap(*x)  # type: ignore[attr-defined]
    images = back.images + jnp.stack(n).astype(jnp.int32)
    return Back(step, jnp.stack(wrapped), v, images, extra)


@partial(jax.jit, static_argnames=("structure",), donate_argnames=("record",))
def _run_back(leaves, structure, tables: Tables, back: Back, record: EpochRecord):
    """Reverse steps until a new neighbor list or stored bits are needed."""
    program: EpochProgram = jax.tree.unflatten(structure, leaves)
    order = tables.order

    masses = program.masses[order]
    scheme: FixedPointStep = program.integrator  # type: ignore[assignment]
    half = 0.5 * scheme.timestep
    room = record.potential.shape[0]
    here = Back(back.step, *jax.tree.map(lambda a: a[:, order], back[1:]))
    home = here.x

    def body(carry):
        here, row, _, record = carry
        made = program.force(here.x, tables, decisions=True)  # type: ignore[operator]
        acceleration = made.force / masses
        v = scheme.kick(here.v, -half, acceleration, masses)
        record = write_row(
            record,
            room - 1 - row,
            x=here.x,
            v=v,
            images=here.images,
            bits=made.decisions.bits,
            potential=jnp.sum(made.energy),
            virial=made.virial,
        )
        # the first step of all began from full-step velocities, and no drift led there
        second = jnp.where(here.step == 0, 0.0, half)
        v = scheme.kick(v, -second, acceleration, masses)
        earlier = _before(program, masses, order, here._replace(v=v))
        start = here._replace(step=here.step - 1, v=v)
        earlier = jax.tree.map(lambda a, b: jnp.where(here.step == 0, a, b), start, earlier)
        largest = program.force.cell.farthest(earlier.x - home)  # type: ignore[attr-defined]
        return earlier, row + 1, largest > program.half_skin, record

    def go_on(carry):
        here, row, due, _ = carry
        more = (here.step >= 0) & (row < room) & ~due
        if scheme.pause is None:
            return more
        return more & ((row == 0) | (here.step % scheme.pause != 0))

    start = (here, jnp.zeros((), jnp.int64), jnp.zeros((), bool), record)
    here, rows, _, record = lax.while_loop(go_on, body, start)

    parts = jax.tree.map(lambda a: unsorted(a, order), here[1:])
    return Back(here.step, *parts), rows, here.x, record


class BackwardRun:
    """Exact time reversal of a run with a fixed-point state.

    Args:
        simulation: the system as objects, with a fixed-point state.
        end: the state after the last step of the run.
        baths: bits of the thermostat's bath before each step at which the forward run emptied the bath.

    Raises:
        InputError: the state is not a fixed-point state.
    """

    def __init__(
        self, simulation: Simulation, end: EpochState, baths: Mapping[int, np.ndarray] | None = None
    ):
        if simulation.fixed_point is None:
            raise InputError(
                "the run uses floating-point arithmetic, so its steps cannot be reversed exactly",
                where="precision.state",
                remedy='Set state = "lattice": steps in fixed-point arithmetic can be reversed exactly',
            )
        self.simulation = simulation
        self.baths = dict(baths or {})
        # whatever the run did with its lists: these are never used once a pair may be missing
        rule = replace(simulation.rule, every=1, delay=0, check=True)
        self._verlet: VerletList = simulation.verlet_list()
        engine = Engine(replace(simulation, rule=rule), int(end.step) - 1)
        self._engine = engine
        self._leaves, self._structure = engine.leaves, engine.structure
        self.back: Back = _undrifted(self._leaves, self._structure, end)

    def stretches(self) -> Iterator[Stretched]:
        """Yield groups of consecutive time steps, the last group first.

        Raises:
            NumericalError: the thermostat's bath differs from the bath of the forward run.
        """
        simulation = self.simulation
        while int(self.back.step) >= 0:
            self._change_bath()
            positions = np.asarray(self.back.x, np.float64).T.copy()
            table = self._verlet.build(positions, simulation.cell)
            tables = simulation.tables(table)
            record = self._engine.take(0, table.slots // 8)
            last = int(self.back.step)
            self.back, rows, x_before, record = _run_back(
                self._leaves, self._structure, tables, self.back, record
            )
            count = int(rows)
            # rows were filled from the end
            columns: list[Any] = [np.roll(np.asarray(column), count, axis=0) for column in record[:-2]]
            first, made = last - count + 1, EpochRecord(*columns)
            yield Stretched(first, count, made, table, np.asarray(x_before), self.back)
            self._engine.give(0, record)
        self._check_bath()

    def _change_bath(self) -> None:
        """Restore the thermostat's bath (bits removed by friction) at steps that emptied the bath."""
        step, period = int(self.back.step), self.simulation.propagator.pause
        if period is None or step % int(period):
            return
        self._check_bath()
        if step not in self.baths:
            raise NumericalError(f"velocity bits that friction removed before step {step} were not stored")
        self.back = self.back._replace(extra=ByAtom(jnp.asarray(self.baths[step])))

    def _check_bath(self) -> None:
        """Raise `NumericalError` if the bath is not zero at the step that emptied the bath."""
        if any(np.any(np.asarray(part)) for part in jax.tree.leaves(self.back.extra)):
            step = max(int(self.back.step), 0)
            raise NumericalError(
                f"the reversed run differs from the forward run: at step {step}, the store of velocity "
                "bits that friction removes is not empty"
            )
