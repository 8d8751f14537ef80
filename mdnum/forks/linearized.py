"""The linearized run: how a small perturbation grows and changes decisions.

The tangent (the derivative of the state) is propagated along the recorded states. The reference trajectory is
therefore the recorded run, bit for bit. The exponential growth rate of the tangent is the largest Lyapunov
exponent. The tangent is rescaled repeatedly (Benettin, Galgani, Giorgilli and Strelcyn 1980). Unlike the
distance between two runs, the tangent does not saturate.

Each decision has a margin m and a tangent dm/da for the amplitude a of the perturbation. To first order, the
decision flips at a = -m / (dm/da). At each step, a perturbation below the smallest flip amplitude flips no
decision. The prediction holds while the perturbed run stays close and makes the same decisions. If the force
jumps at the cutoff, the first flip changes the momenta of both atoms. The forecast then ends at the first
flip. If the force is continuous, a flip does not change the motion to first order.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt8

from mdnum.errors import InputError, expect_at_least
from mdnum.md.integrators import check_kick
from mdnum.md.pairforce import MdState, PairDynamics, PairForce
from mdnum.numerics.verdicts import BLOCKS, TRANSIENT, Growth, growth_rate
from mdnum.plain import result
from mdnum.rollout.engine import FAILURES, Engine, Segment
from mdnum.rollout.epoch import over_rows
from mdnum.systems.simulation import Simulation

#: Number of decisions per step that are stored: those which the perturbation reaches first.
KEPT = 3
#: Number of time steps by which velocities are multiplied in the norm of a tangent.
_CLOCK = 30
#: Displacement, as a share of the cutoff, above which a forecast is unreliable. For a crystal of argon every
#: first flip was predicted up to 0.006, one of two at 0.02, and none of six late ones at 0.04.
LINEAR = 5e-3
#: Relative error of the amplitude of a flip, for each cutoff of displacement. Measured for a crystal (cold,
#: warm, and with a continuous force) and a liquid: at most 196 in 304 decisions, 15 in seven of eight; it is
#: large if a pair moves perpendicular to its axis.
_SECOND_ORDER = 200.0
#: Largest perturbation of a run by rounding, in ulps of its starting state.
_ULPS = 8.0


@dataclass(frozen=True)
class StepTangents:
    """The tangent of a run during the steps with one neighbor list."""

    segment: Segment  # the steps
    # log of the length of the tangent (positions, and velocities times 30 time steps) at each step, relative
    # to its length at the start, shape (rows,)
    size: Float[np.ndarray, "rows"]
    # largest displacement of an atom per amplitude, at each step, as its log, shape (rows,)
    furthest: Float[np.ndarray, "rows"]
    # amplitude at which the nearest decisions of each step flip, by sign of the amplitude: first axis 0 for
    # positive, 1 for negative amplitudes; shape (2, rows, KEPT). Infinite where there is none
    reach: Float[np.ndarray, "signs rows kept"]
    # i, j of those decisions (i < j; -1 where there is none), shape (2, rows, KEPT, 2)
    pairs: Int[np.ndarray, "signs rows kept ends"]
    # of those decisions, in the quantity's space, same shape as `reach`
    margins: Float[np.ndarray, "signs rows kept"]
    # largest displacement since the list was built, at each step, length, shape (rows,)
    moved: Float[np.ndarray, "rows"]


def tangents(
    simulation: Simulation,
    steps: int,
    dx: Float[np.ndarray, "atoms 3"],
    dv: Float[np.ndarray, "atoms 3"],
    reach: bool = True,
) -> Iterator[StepTangents]:
    """Propagate an infinitesimal perturbation of the start along a run.

    Args:
        simulation: a simulation with a pair potential.
        dx: perturbation of the positions per amplitude, length. dv: that of the velocities.
        reach: whether to compute the amplitudes at which decisions flip.

    Raises:
        InputError: the potential is a many-body potential, or the integrator is not a linear `KickDrift`.
    """
    force = simulation.smooth.force
    check_kick(simulation.integrator)
    if not isinstance(force, PairForce):
        raise InputError(
            "pair decisions cannot be imposed on a many-body potential",
            remedy="Use a system with a pair potential",
        )
    dtype, clock = simulation.policy.dtype("state"), _CLOCK * float(simulation.integrator.timestep)
    shift = 0.0
    tangent = np.asarray(dx, np.float64).T, np.asarray(dv, np.float64).T
    first = _length(tangent, clock)
    if not (np.isfinite(first) and first > 0):
        raise InputError("the perturbation (dx, dv) is zero or not finite", remedy="Give nonzero dx or dv")
    for segment in Engine(simulation, steps).segments():
        order = segment.table.order
        tables = simulation.tables(segment.table)
        dynamics = PairDynamics(force, simulation.integrator, jnp.asarray(simulation.masses[order]), tables)
        end, out = _carry(
            dynamics,
            jnp.asarray(segment.first),
            jnp.asarray(segment.rows),
            (jnp.asarray(segment.record.x), jnp.asarray(segment.record.v), jnp.asarray(segment.record.bits)),
            (jnp.asarray(tangent[0][:, order], dtype), jnp.asarray(tangent[1][:, order], dtype)),
            jnp.asarray(np.float64(clock)),
            reach,
        )
        length, most, amplitude, slot, near = (np.asarray(part)[: segment.rows] for part in out)
        with np.errstate(divide="ignore"):
            size = np.log(length.astype(np.float64)) + shift - np.log(first)
            furthest = np.log(most.astype(np.float64)) + shift
        yield StepTangents(
            segment, size, furthest, np.swapaxes(amplitude.astype(np.float64) * np.exp(-shift), 0, 1),
            np.swapaxes(_labels(segment, slot, amplitude), 0, 1), np.swapaxes(near.astype(np.float64), 0, 1),
            np.array(segment.rows_of("moved")),
        )  # fmt: skip
        if segment.closes in FAILURES:
            return
        tangent = tuple(np.asarray(part, np.float64)[:, np.argsort(order)] for part in end)
        # carried at length 1, so that no length overflows, however long the run
        now = _length(tangent, clock)
        tangent = tuple(part / now for part in tangent)
        shift += float(np.log(now))


def _joined(parts: list[StepTangents], name: str, axis: int = 0) -> np.ndarray:
    return np.concatenate([getattr(part, name) for part in parts], axis)


def _length(tangent, clock: float) -> float:
    x, v = tangent
    return float(np.sqrt(np.sum(x * x) + clock * clock * np.sum(v * v)))


def _labels(segment: Segment, slot: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    """Return the atom pairs in given slots of the flattened neighbor list. Empty slots give -1."""
    order = segment.table.order
    row, column = np.divmod(slot, len(order))
    ends = np.stack([order[column], np.append(order, -1)[segment.table.index[row, column]]], axis=-1)
    return np.where(np.isfinite(amplitude)[..., None], np.sort(ends, axis=-1), -1)


@eqx.filter_jit
def _carry(
    dynamics: PairDynamics,
    first: Int[Array, ""],
    count: Int[Array, ""],
    recorded: tuple[
        Float[Array, "rows 3 atoms"], Float[Array, "rows 3 atoms"], UInt8[Array, "rows words atoms"]
    ],
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
        number, x, v, bits = row
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
        return after, (length, furthest, *near)

    return over_rows(step, tangent, (first + jnp.arange(len(recorded[0])), *recorded), count)


# --- Lyapunov exponents -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lyapunov:
    """Growth of the tangent along a run, with the largest Lyapunov exponent."""

    # steps, timestep: of the run; the time step in the units of the system's file
    steps: int
    timestep: float
    rate: float  # the exponent, per step
    error: float  # its standard error, from blocks of the run
    # log of the length of the tangent at each step, relative to its start, shape (steps + 1,)
    size: Float[np.ndarray, "rows"]
    # displacement of the furthest atom at each step per displacement of the furthest atom at the start, as
    # its log, shape (steps + 1,)
    furthest: Float[np.ndarray, "rows"]
    transient: int  # steps left out at the start
    # whether the rate is above what linear growth (a perturbation of speeds, or of a frequency) would give in
    # so many steps, and above four times its error
    chaotic: bool

    @property
    def rate_time(self) -> float:
        """Lyapunov exponent per unit of time."""
        return self.rate / self.timestep

    @property
    def error_time(self) -> float:
        """Standard error of the Lyapunov exponent per unit of time."""
        return self.error / self.timestep

    def ratio(self, seen: Growth) -> float:
        """Divide the rate at which two runs diverge by the Lyapunov exponent. NaN if the run is not chaotic.

        Without flips, two runs diverge at the Lyapunov rate. Faster divergence is due to flips.
        """
        return seen.rate / self.rate if self.chaotic else float("nan")

    def steps_to(self, start: float, end: float) -> float | None:
        """Return the step at which a displacement has grown from one length to another.

        The displacement grows in proportion to the tangent during the run, and exponentially after the run.
        The result is None if a displacement without chaos does not reach `end` during the run.

        Args:
            start: largest displacement of an atom at the start, length; for example one rounding unit.
            end: final size of the largest displacement, length.
        """
        wanted = float(np.log(end / start))
        beyond = self.furthest >= wanted
        if beyond.any():
            return float(beyond.argmax())
        if not self.chaotic:
            return None
        return self.steps + (wanted - float(self.furthest[-1])) / self.rate


def lyapunov(simulation: Simulation, steps: int | None = None, *, seed: int = 0) -> Lyapunov:
    """Compute the largest Lyapunov exponent along a run.

    Args:
        simulation: a simulation with a pair potential.
        seed: random seed of the initial perturbation, which displaces all atoms randomly.

    Raises:
        InputError: the potential is a many-body potential, or the run is too short for an error estimate.

    Error: statistical, see Lyapunov.error. Flips at a hard cutoff do not change the tangent, so growth caused
        by flips alone is not included.
    """
    last = simulation.steps if steps is None else steps
    if last < 10 * BLOCKS:
        raise InputError(
            f"{last} steps are too few for a Lyapunov exponent", remedy=f"Give at least {10 * BLOCKS} steps"
        )
    dx = np.random.default_rng(seed).standard_normal(simulation.positions.shape)
    dx -= dx.mean(axis=0)
    step = float(simulation.integrator.timestep)
    parts = list(tangents(simulation, last, dx, np.zeros_like(dx), reach=False))
    size, furthest = _joined(parts, "size"), _joined(parts, "furthest")
    rate, error, grows = growth_rate(size)
    furthest = furthest - float(np.log(np.sqrt((dx**2).sum(axis=1)).max()))
    timestep = step / simulation.units.time_factor
    return Lyapunov(last, timestep, rate, error, size, furthest, int(TRANSIENT * last), grows)


# --- forecasts ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PredictedFlip:
    """A decision that is predicted to flip if the start is perturbed."""

    # step, i, j: of the decision, i < j
    step: int
    i: int
    j: int
    # amplitude, ulps: at which it flips, with its sign, and in ulps of the largest start coordinate
    amplitude: float
    margin: float  # of the unperturbed run, in the quantity's space
    ulps: float


class ForecastRange(NamedTuple):
    """The last step of a valid forecast for one amplitude, and why the forecast ends there."""

    step: int  # the last one; -1 for none
    # why there: "end" of the run; "flip", the first one kicks its atoms; "close", whether a decision of the
    # next step flips is within the error; "size", the displacement is too large from then on; "list", a pair
    # that was not examined could come inside
    ends: str


@result
class Forecast:
    """First-order prediction of the decisions that a perturbation of the start flips.

    Error: second-order terms are neglected; rounding adds a few ulps. Flips that are uncertain within this
        error are not predicted. `good_until` returns the last step for which the forecast is valid.
    """

    # simulation, steps: the run
    simulation: Simulation
    steps: int
    # dx, dv: the direction: change of positions (length) and velocities per amplitude, shape (atoms, 3)
    dx: Float[np.ndarray, "atoms 3"]
    dv: Float[np.ndarray, "atoms 3"]
    # amplitude at which the nearest decisions of each step flip, for positive and negative amplitudes, shape
    # (2, steps + 1, KEPT)
    reach: Float[np.ndarray, "signs rows kept"]
    # pairs: of those decisions, shape (2, steps + 1, KEPT, 2); margins: theirs, as `reach`
    pairs: Int[np.ndarray, "signs rows kept ends"]
    margins: Float[np.ndarray, "signs rows kept"]
    # displacement of the furthest atom per amplitude at each step, shape (steps + 1,)
    furthest: Float[np.ndarray, "rows"]
    ulp: float  # spacing of the floats at the largest start coordinate, length
    # pairs that were examined, those of the list, at each step, shape (steps + 1,)
    listed: Int[np.ndarray, "rows"]
    # how much nearer to the cutoff than in the run a pair would have to be that was not examined, length,
    # shape (steps + 1,)
    room: Float[np.ndarray, "rows"]

    @property
    def kicks(self) -> bool:
        """True if the force jumps at a flip. The flip then changes all later motion."""
        return self.simulation.cutoff.smoothness < 1

    def good_until(self, amplitude: float) -> ForecastRange:
        """Return the last step of a valid forecast for an amplitude, and why the forecast ends."""
        listed = self._until(2 * abs(amplitude) * self.furthest > self.room)
        ends = ((self.steps, "end"), (self.linear_until(amplitude), "size"), (listed, "list"))
        last = min((ForecastRange(*end) for end in ends), key=lambda one: one.step)
        if self.kicks:
            nearest = self.reach[0 if amplitude >= 0 else 1].min(axis=1)
            error = self._error(amplitude)
            near = np.flatnonzero(nearest[: last.step + 1] <= abs(amplitude) * (1 + error[: last.step + 1]))
            if len(near):
                step = int(near[0])
                sure = nearest[step] <= abs(amplitude) * (1 - error[step])
                return ForecastRange(step, "flip") if sure else ForecastRange(step - 1, "close")
        return last

    def first(self, amplitude: float, count: int = 3) -> tuple[PredictedFlip, ...]:
        """Predict which decisions a perturbation flips first, while the forecast is valid.

        At most `KEPT` flips per step are listed. A step with `KEPT` flips may have more.

        Args:
            amplitude: amplitude of the perturbation; its sign matters.
            count: largest number of flips to return.
        """
        sign = 0 if amplitude >= 0 else 1
        sure = self.reach[sign] <= abs(amplitude) * (1 - self._error(amplitude))[:, None]
        rows, places = np.nonzero(sure[: self.good_until(amplitude).step + 1])
        flips = (
            self._flip(sign, row, place) for row, place in zip(rows.tolist(), places.tolist(), strict=True)
        )
        return _each_pair_once(flips, count)

    def nearest(self, count: int = 10) -> tuple[PredictedFlip, ...]:
        """Return the predicted flips with the smallest |amplitude|, one for each pair of atoms.

        A flip is included only if the forecast is valid up to its step. If the force jumps at the cutoff,
        only the first flip can be predicted.
        """
        # where flips kick, only what flips sooner or at less than all before it can be the first
        least = np.minimum.accumulate(self.reach.min(axis=2), axis=1)
        first = self.reach <= least[:, :, None] if self.kicks else np.isfinite(self.reach)
        flats = np.flatnonzero(first & np.isfinite(self.reach))
        flats = flats[np.argsort(self.reach.reshape(-1)[flats], kind="stable")]
        places = (map(int, np.unravel_index(flat, self.reach.shape)) for flat in flats)
        flips = (self._flip(*place) for place in places)
        # its own flip is within the error of its own amplitude, and ends the range a step before
        good = (flip for flip in flips if self.good_until(flip.amplitude).step >= flip.step - 1)
        return _each_pair_once(good, count)

    def linear_until(self, amplitude: float) -> int:
        """Return the last step at which a perturbation is small enough for a forecast."""
        return self._until(abs(amplitude) * self.furthest > LINEAR * self.simulation.r_cut)

    def _until(self, beyond: Bool[np.ndarray, "rows"]) -> int:
        return int(beyond.argmax()) - 1 if beyond.any() else self.steps

    def _error(self, amplitude: float) -> Float[np.ndarray, "rows"]:
        """Estimate the relative error of a flip's predicted amplitude at each step."""
        size = abs(amplitude)
        with np.errstate(divide="ignore", over="ignore"):
            return _SECOND_ORDER * size * self.furthest / self.simulation.r_cut + _ULPS * self.ulp / size

    def _flip(self, sign: int, row: int, place: int) -> PredictedFlip:
        i, j = (int(end) for end in self.pairs[sign, row, place])
        amplitude = float(self.reach[sign, row, place]) * (1 if sign == 0 else -1)
        largest = float(np.sqrt((self.dx**2).sum(axis=1)).max()) or 1.0
        margins = float(self.margins[sign, row, place])
        return PredictedFlip(row, i, j, amplitude, margins, abs(amplitude) * largest / self.ulp)


def _each_pair_once(flips: Iterable[PredictedFlip], count: int) -> tuple[PredictedFlip, ...]:
    """Return the first `count` predicted flips, at most one for each pair of atoms."""
    found: dict[tuple[int, int], PredictedFlip] = {}
    for flip in flips:
        found.setdefault((flip.i, flip.j), flip)
        if len(found) == count:
            break
    return tuple(found.values())


def forecast(
    simulation: Simulation,
    steps: int | None = None,
    dx: Float[np.ndarray, "atoms 3"] | None = None,
    dv: Float[np.ndarray, "atoms 3"] | None = None,
    *,
    seed: int = 0,
) -> Forecast:
    """Predict the flips caused by a perturbation of the start.

    Args:
        simulation: a simulation with a pair potential.
        dx, dv: the direction; default random displacements whose maximum is 1, so that the amplitude is the
            largest displacement.
        seed: random seed of a random direction.

    Raises:
        InputError: the potential is a many-body potential, or the direction is zero or has the wrong shape.
    """
    last = simulation.steps if steps is None else steps
    expect_at_least(1, steps=last)
    shape = simulation.positions.shape
    if dx is None and dv is None:
        dx = direction(simulation, seed)
    change = [np.zeros(shape) if part is None else np.asarray(part, np.float64) for part in (dx, dv)]
    if any(part.shape != shape for part in change):
        raise InputError(f"the perturbations dx and dv must have the same shape as the positions, {shape}")
    dx, dv = change
    parts = list(tangents(simulation, last, dx, dv))
    tables = [part.segment.table for part in parts]
    listed = [np.full(len(part.size), table.pairs) for part, table in zip(parts, tables, strict=True)]
    largest = np.abs(np.asarray(simulation.positions)).max()
    return Forecast(
        simulation, last, dx, dv, _joined(parts, "reach", 1), _joined(parts, "pairs", 1),
        _joined(parts, "margins", 1), np.exp(_joined(parts, "furthest")),
        float(np.spacing(np.asarray(largest, simulation.policy.dtype("state")))), np.concatenate(listed),
        simulation.rule.skin - 2 * _joined(parts, "moved"),
    )  # fmt: skip


def direction(simulation: Simulation, seed: int) -> Float[np.ndarray, "atoms 3"]:
    """Return random displacements of all atoms. The longest has length 1."""
    noise = np.random.default_rng(seed).standard_normal(simulation.positions.shape)
    return noise / np.sqrt((noise**2).sum(axis=1)).max()
