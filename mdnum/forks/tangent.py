"""The linearized run: how a small perturbation of the start grows along a run, at the decisions that it made.

The tangent is carried along the states that the run itself recorded, so the run that is linearized is the
run that was made, bit for bit, list after list. Its growth is the largest Lyapunov exponent: it is rescaled
again and again (Benettin, Galgani, Giorgilli and Strelcyn 1980), so it never saturates, as the separation of
two runs does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt8

from mdnum.errors import InputError
from mdnum.md.pairforce import MdState, PairDynamics, PairForce
from mdnum.numerics.verdicts import Growth
from mdnum.rollout.engine import FAILURES, Engine, Segment, Start
from mdnum.systems.build import Simulation

#: Share of a run in which the tangent turns to the direction that grows fastest.
_TRANSIENT = 0.2
#: Blocks that the error is estimated from.
_BLOCKS = 8
#: A rate counts where it is so many times its error.
_SIGNIFICANT = 4.0
#: Decisions of a step that are kept: those which the perturbation reaches first.
KEPT = 3


@dataclass(frozen=True)
class StepTangents:
    """The tangent along some steps of one list.

    Attributes:
        segment: the steps.
        size: log of the length of the tangent (positions, and velocities times `clock`) at each step,
            relative to its length at the start, shape (rows,).
        furthest: largest displacement of an atom per amplitude, at each step, as its log, shape (rows,).
        reach: amplitude at which the nearest decisions of each step flip, by sign of the amplitude: first
            axis 0 for positive, 1 for negative amplitudes; shape (2, rows, KEPT). Infinite where there is
            none.
        pairs: i, j of those decisions (i < j; -1 where there is none), shape (2, rows, KEPT, 2).
        margins: of those decisions, in the quantity's space, same shape as `reach`.
        moved: largest displacement since the list was built, at each step, length, shape (rows,).
    """

    segment: Segment
    size: Float[np.ndarray, "rows"]
    furthest: Float[np.ndarray, "rows"]
    reach: Float[np.ndarray, "signs rows kept"]
    pairs: Int[np.ndarray, "signs rows kept ends"]
    margins: Float[np.ndarray, "signs rows kept"]
    moved: Float[np.ndarray, "rows"]


def tangents(
    simulation: Simulation,
    steps: int,
    dx: Float[np.ndarray, "atoms 3"],
    dv: Float[np.ndarray, "atoms 3"],
    *,
    clock: float,
    reach: bool = True,
    start: Start | None = None,
) -> Iterator[StepTangents]:
    """Carry a perturbation of the start along a run.

    Args:
        simulation: the system as objects, with a pair potential.
        steps: last step.
        dx: perturbation of the positions per amplitude, length. dv: of the velocities.
        clock: time by which velocities are multiplied where a length of the tangent is asked for.
        reach: whether to ask for the amplitudes at which decisions flip.
        start: where the run begins.

    Raises:
        InputError: a many-body potential.
    """
    force = simulation.smooth.force
    if not isinstance(force, PairForce):
        raise InputError(
            "decisions cannot be imposed on a many-body potential",
            remedy="Linearize a system with a pair potential",
        )
    dtype = simulation.policy.dtype("state")
    shift = 0.0
    tangent = np.asarray(dx, np.float64).T, np.asarray(dv, np.float64).T
    first = _length(tangent, clock)
    if not (np.isfinite(first) and first > 0):
        raise InputError("the perturbation is nothing", remedy="Give a direction that is not zero")
    for segment in Engine(simulation, steps, start=start).segments():
        order = segment.table.order
        tables = simulation.tables(segment.table)
        dynamics = PairDynamics(force, simulation.integrator, jnp.asarray(simulation.masses[order]), tables)
        # of full length, so that every stretch of one kind of list is one compiled program
        rows = jnp.arange(segment.record.bits.shape[0]) < segment.rows
        end, out = _carry(
            dynamics,
            jnp.asarray(segment.first),
            (jnp.asarray(segment.record.x), jnp.asarray(segment.record.v), jnp.asarray(segment.record.bits)),
            rows,
            (jnp.asarray(tangent[0][:, order], dtype), jnp.asarray(tangent[1][:, order], dtype)),
            jnp.asarray(np.float64(clock)),
            reach,
        )
        length, most, amplitude, slot, near = (np.asarray(part)[: segment.rows] for part in out)
        with np.errstate(divide="ignore"):
            size = np.log(length.astype(np.float64)) + shift - np.log(first)
            furthest = np.log(most.astype(np.float64)) + shift
        yield StepTangents(
            segment,
            size,
            furthest,
            np.swapaxes(amplitude.astype(np.float64) * np.exp(-shift), 0, 1),
            np.swapaxes(_labels(segment, slot, amplitude), 0, 1),
            np.swapaxes(near.astype(np.float64), 0, 1),
            np.array(segment.rows_of("moved")),
        )
        if segment.closes in FAILURES:
            return
        tangent = tuple(_unsorted(np.asarray(part, np.float64), order) for part in end)
        # carried at length 1, so that no length overflows, however long the run
        now = _length(tangent, clock)
        tangent = tuple(part / now for part in tangent)
        shift += float(np.log(now))


def _length(tangent, clock: float) -> float:
    x, v = tangent
    return float(np.sqrt(np.sum(x * x) + clock * clock * np.sum(v * v)))


def _unsorted(part: np.ndarray, order: np.ndarray) -> np.ndarray:
    out = np.empty_like(part)
    out[:, order] = part
    return out


def _labels(segment: Segment, slot: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    """The pairs of flat slots, -1 where there is none."""
    order = segment.table.order
    row, column = np.divmod(slot, len(order))
    ends = np.stack([order[column], np.append(order, -1)[segment.table.index[row, column]]], axis=-1)
    return np.where(np.isfinite(amplitude)[..., None], np.sort(ends, axis=-1), -1)


@partial(eqx.filter_jit)
def _carry(
    dynamics: PairDynamics,
    first: Int[Array, ""],
    recorded: tuple[
        Float[Array, "rows 3 atoms"], Float[Array, "rows 3 atoms"], UInt8[Array, "rows words atoms"]
    ],
    used: Array,
    tangent: tuple[Float[Array, "3 atoms"], Float[Array, "3 atoms"]],
    clock: Float[Array, ""],
    reach: bool,
):
    order = dynamics.tables.order
    atoms = order.shape[0]
    index = dynamics.tables.index.reshape(-1, atoms)
    # each pair from one end alone; padding points beyond the last atom and is dropped by its margin
    once = order[None, :] < jnp.append(order, jnp.zeros((), order.dtype))[index]

    def decide(state, dx):
        margins, change = jax.jvp(lambda x: dynamics.margins(state._replace(x=x)), (state.x,), (dx,))
        margins, change = margins.reshape(-1, atoms), change.reshape(-1, atoms)
        amplitude = -margins / change
        amplitude = jnp.where(once & jnp.isfinite(amplitude), amplitude, jnp.inf)

        def nearest(signed):
            value, place = lax.top_k(-jnp.where(signed >= 0, signed, jnp.inf).reshape(-1), KEPT)
            return -value, place, margins.reshape(-1)[place]

        ends = [nearest(amplitude), nearest(jnp.where(jnp.isfinite(amplitude), -amplitude, jnp.inf))]
        return tuple(jnp.stack(parts) for parts in zip(*ends, strict=True))

    def step(carry, row):
        dx, dv = carry
        number, x, v, bits, use = row
        state = MdState(number, x, v)
        length = jnp.sqrt(jnp.sum(dx * dx) + (clock * clock).astype(dx.dtype) * jnp.sum(dv * dv))
        furthest = jnp.sqrt(jnp.max(jnp.sum(dx * dx, axis=0)))
        if reach:
            near = decide(state, dx)
        else:
            none = jnp.full((2, KEPT), jnp.inf, dx.dtype)
            near = none, jnp.zeros((2, KEPT), jnp.int32), none

        def advance(x, v):
            after = dynamics.step(MdState(number, x, v), bits)
            return after.x, after.v

        _, after = jax.jvp(advance, (x, v), (dx, dv))
        carry = tuple(jnp.where(use, new, old) for new, old in zip(after, carry, strict=True))
        return carry, (length, furthest, *near)

    x, v, bits = recorded
    numbers = first + jnp.arange(x.shape[0])
    return lax.scan(step, tangent, (numbers, x, v, bits, used))


# --- Lyapunov exponents -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lyapunov:
    """Growth of a tangent along a run.

    Attributes:
        steps, timestep: of the run; the time step in the units of the system's file.
        rate: the exponent, per step. error: its standard error, from blocks of the run.
        size: log of the length of the tangent at each step, relative to its start, shape (steps + 1,).
        furthest: displacement of the furthest atom at each step per displacement of the furthest atom at the
            start, as its log, shape (steps + 1,).
        transient: steps left out at the start.
        chaotic: whether the rate is above what linear growth (a perturbation of speeds, or of a frequency)
            would give in so many steps, and above four times its error.
    """

    steps: int
    timestep: float
    rate: float
    error: float
    size: Float[np.ndarray, "rows"]
    furthest: Float[np.ndarray, "rows"]
    transient: int
    chaotic: bool

    @property
    def rate_time(self) -> float:
        """The exponent per unit of time of the system's file."""
        return self.rate / self.timestep

    @property
    def error_time(self) -> float:
        """Its standard error."""
        return self.error / self.timestep

    def ratio(self, seen: Growth) -> float:
        """Growth rate of two runs over the exponent; NaN where they were not seen to grow.

        Near 1 the runs parted as the motion parts them. Well above it, their flips did it.
        """
        return seen.rate / self.rate if self.chaotic else float("nan")

    def steps_to(self, start: float, end: float) -> float | None:
        """The step at which a displacement of the start has grown from one size to another.

        From the run itself as far as it goes, beyond it at the rate. None where it does not get there: where
        the run is not chaotic.

        Args:
            start: largest displacement of an atom at the start, length; an ulp, for example.
            end: largest displacement asked for, length.
        """
        wanted = float(np.log(end / start))
        beyond = self.furthest >= wanted
        if beyond.any():
            return float(beyond.argmax())
        if not self.chaotic:
            return None
        return self.steps + (wanted - float(self.furthest[-1])) / self.rate


def lyapunov(simulation: Simulation, steps: int | None = None, *, seed: int = 0) -> Lyapunov:
    """The largest Lyapunov exponent along a run.

    Args:
        simulation: the system as objects, with a pair potential.
        steps: last step; default the system's own.
        seed: of the perturbation that is followed: random displacements.

    Raises:
        InputError: a many-body potential, or too few steps for an error.

    Error: statistical, see Lyapunov.error; and flips of a hard cutoff do not act on a tangent, so growth that
        is made by flips alone is not in it.
    """
    last = simulation.system.spec.dynamics.steps if steps is None else steps
    if last < 10 * _BLOCKS:
        raise InputError(
            f"steps = {last} are too few for a growth rate", remedy=f"Give at least {10 * _BLOCKS}"
        )
    dx = np.random.default_rng(seed).standard_normal(simulation.positions.shape)
    dx -= dx.mean(axis=0)
    step = float(simulation.integrator.timestep)
    parts = list(tangents(simulation, last, dx, np.zeros_like(dx), clock=30 * step, reach=False))
    size = np.concatenate([part.size for part in parts])
    furthest = np.concatenate([part.furthest for part in parts])
    first = int(_TRANSIENT * last)
    edges = np.linspace(first, len(size) - 1, _BLOCKS + 1).astype(int)
    slopes = np.diff(size[edges]) / np.diff(edges)
    rate = float((size[-1] - size[first]) / (len(size) - 1 - first))
    error = float(slopes.std(ddof=1) / np.sqrt(_BLOCKS))
    # what grows in proportion to the steps gains log(end / first) over this stretch
    linear = float(np.log((len(size) - 1) / max(first, 1))) / (len(size) - 1 - first)
    return Lyapunov(
        last,
        step / simulation.units.time_factor,
        rate,
        error,
        size,
        furthest - float(np.log(np.sqrt((dx**2).sum(axis=1)).max())),
        first,
        rate > 2 * linear and rate > _SIGNIFICANT * error,
    )
