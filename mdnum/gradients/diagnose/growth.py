"""Growth of gradients and perturbations with the number of steps.

The cotangent of a state is the gradient of a run that starts from this state. One reverse pass over T steps
therefore gives gradients for all run lengths (horizons) up to T. Each of these runs has a different start.
Cotangents of a chaotic run span many powers of two. Scaling the loss helps only if the narrow format covers
this range.

The largest singular value of a run's Jacobian bounds the gradient of a loss that depends only on the last
state. Singular values are computed by subspace iteration with a random block (Halko, Martinsson and Tropp
2011). The block is orthonormalized after every stretch of steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mdnum.errors import InputError, NumericalError
from mdnum.gradients import parameters
from mdnum.gradients.adjoint import AdjointCarry, pull_back
from mdnum.gradients.parameters import Cotangents
from mdnum.gradients.problem import Problem, Progress
from mdnum.gradients.recorded import passed, tape_of
from mdnum.gradients.tape import RunTape, TapeStretch
from mdnum.md.decide import Tables
from mdnum.md.integrators import KickDrift, check_kick, unsorted
from mdnum.md.pairforce import MdState, PairDynamics, PairForce
from mdnum.numerics import formats
from mdnum.numerics.verdicts import growth_rate
from mdnum.rollout.epoch import over_rows
from mdnum.systems.simulation import Simulation

#: Number of time steps that converts a velocity to a length: about the time in which an atom encounters its
#: neighbors.
CLOCK_STEPS = 30
#: A run counts as bounded if no speed exceeds this multiple of the usual speed.
_WILD = 10.0
WORDS = ("both bounded", "forward bounded, gradient not", "forward not bounded")
#: Range of distinguished binary exponents; values beyond are counted at the ends.
_LOWEST, _HIGHEST = -200, 200
#: Share of the numbers of a step that may be lost if a single scale factor is considered sufficient.
LOST = 0.01
#: Number of e-foldings between vectors above which only the diagonal of the product of triangular matrices is
#: used.
_RANGE = 30.0


@dataclass(frozen=True)
class GradientGrowth:
    """Norm of the gradient for every number of steps, and its growth rate."""

    # a row for each horizon 0, 1, ..., T, of the state that many steps before the end: `horizon`, `step`,
    # `onto_positions` and `onto_velocities` (norms of the derivatives by all of them), `size` (norm of both,
    # with velocities measured by `clock`), `speed` (rms of the atoms), and `gradient.<name>`: the derivative
    # by each parameter, were it changed over the last `horizon` steps alone (its norm by the start); the last
    # row is the gradient of the whole run
    table: dict[str, np.ndarray]
    clock: float  # internal time that turns velocities into lengths
    # timestep, time: in units of the file
    timestep: float
    # rate, error: growth of log(size) per step and its standard error
    rate: float
    error: float
    time: float  # for a factor of e
    gain: float  # largest size over the first that is not 0; 1 where all are
    word: str  # one of WORDS


class GrowthWatch:
    """Collector of gradient norms at every step of a reverse pass, for `GradientGrowth`."""

    def __init__(self, simulation: Simulation, names: Sequence[str], steps: int):
        self.simulation, self.names, self.steps = simulation, tuple(names), steps
        self.norms = np.full((steps + 1, 3), np.nan)
        self.gradient: dict[str, np.ndarray] = {}
        # by the start itself a derivative has the entries of the start: its norm is shown for it
        self._scalars = [name for name in self.names if not name.startswith("initial.")]

    def __call__(self, stretch: TapeStretch, trace: AdjointCarry) -> None:
        """Collect data from the cotangents of successive steps of a reverse pass."""
        rows, first = stretch.rows, stretch.first
        onto_x, onto_v = (np.asarray(part, np.float64)[:rows] for part in (trace.x, trace.v))
        v = stretch.v[:rows].astype(np.float64)
        # numbers that are not finite are the detective's business
        with np.errstate(over="ignore", invalid="ignore"):
            for k, part in enumerate((onto_x, onto_v)):
                self.norms[first : first + rows, k] = np.sqrt(np.sum(part * part, axis=(1, 2)))
            self.norms[first : first + rows, 2] = np.sqrt(np.mean(np.sum(v * v, axis=1), axis=1))
        leaves, structure = jax.tree.flatten((trace.model, trace.integrator))
        leaves = [np.asarray(leaf) for leaf in leaves]
        matrix, r_cut = np.asarray(trace.matrix), np.asarray(trace.r_cut)
        for row in range(rows if self._scalars else 0):
            model, integrator = jax.tree.unflatten(structure, [leaf[row] for leaf in leaves])
            box = stretch.cell_of(row, self.simulation.cell).matrix
            scale = float(np.sum(onto_x[row] * stretch.x[row]) + np.sum(matrix[row] * np.asarray(box)))
            parts = Cotangents(model, integrator, onto_x[row], onto_v[row], scale, r_cut[row])
            # a temperature scales the velocities that the run has here
            here = replace(self.simulation, velocities=v[row].T)
            for name in self._scalars:
                value = parameters.gradient(here, parts, name)
                if name not in self.gradient:
                    self.gradient[name] = np.full((self.steps + 1, *value.shape), np.nan)
                self.gradient[name][first + row] = value

    def result(self, whole: dict[str, Float[np.ndarray, "..."]]) -> GradientGrowth:
        """Return the norms of the gradient by horizon, and their growth rate. The last row refers to the
        gradient of the whole run. The other rows omit how the loss depends on the first frame.
        """
        units = self.simulation.units
        timestep = float(self.simulation.integrator.timestep)
        clock, backward = CLOCK_STEPS * timestep, self.norms[::-1]
        size = np.sqrt(backward[:, 0] ** 2 + (backward[:, 1] / clock) ** 2)
        table = {
            "horizon": np.arange(self.steps + 1), "step": np.arange(self.steps, -1, -1),
            "onto_positions": backward[:, 0].copy(), "onto_velocities": backward[:, 1].copy(), "size": size,
            "speed": backward[:, 2].copy(),
        }  # fmt: skip
        for name in self.names:
            if name in self.gradient:
                values = self.gradient[name][::-1].copy()
                values[-1] = whole[name]
            else:
                values = backward[:, 0 if name == "initial.positions" else 1].copy()
                values[-1] = np.linalg.norm(whole[name])
            columns = values.reshape(len(values), -1).T
            several = len(columns) > 1
            table |= {f"gradient.{name}{f'.{k}' * several}": column for k, column in enumerate(columns)}
        with np.errstate(divide="ignore", invalid="ignore"):
            rate, error, grows = growth_rate(np.log(size))
        word = _word(self.norms[:, 2], grows)
        there = size[np.isfinite(size) & (size > 0)]
        gain = float(there.max() / there[0]) if len(there) else 1.0
        step = timestep / units.time_factor
        return GradientGrowth(table, clock, step, rate, error, step / rate if rate else np.inf, gain, word)


def _word(speed: Float[np.ndarray, "rows"], grows: bool) -> str:
    """Return whether the gradient and the rms speed stay bounded, as a word from WORDS."""
    usual = float(np.median(speed))
    if usual > 0 and not (np.isfinite(speed).all() and speed.max() <= _WILD * usual):
        return WORDS[2]
    return WORDS[1] if grows else WORDS[0]


def growth(
    problem: Problem, names: Sequence[str], *, saltation: bool = True, progress: Progress | None = None
) -> GradientGrowth:
    """Compute the gradient for every number of steps, from one reverse pass.

    Raises:
        InputError: a parameter does not exist, or flips were requested without a pair potential.
        NumericalError: the run blew up.

    Error: the error of the reverse pass; horizons below T belong to later starts on the same trajectory.
    """
    names = parameters.resolve(problem.simulation, names)
    watch = GrowthWatch(problem.simulation, names, problem.steps)
    made = passed(problem, names, saltation=saltation, watches=[watch], progress=progress)
    return watch.result(made.gradient)


@dataclass(frozen=True)
class Scaling:
    """Overflow and underflow of the cotangents in a narrow float format."""

    format: str  # the type, one of numerics.formats
    numbers: int  # in each step
    # by `horizon`, numbers of the step that are beyond the largest of the format (`overflow`), lost below
    # half the smallest (`underflow`), have lost digits (`subnormal`), the `largest` and `smallest` magnitude
    # (zeros left out), and the counts with the scale (`scaled_...`)
    table: dict[str, np.ndarray]
    # scale, power: a power of two by which the loss is multiplied so that the fewest numbers are lost and
    # none overflows, NaN where more than half are lost with any; and its exponent
    scale: float
    power: int
    usable: bool  # whether there is anything finite to scale
    fits: bool  # whether no step loses more than 1 % of its numbers with it
    worst: float  # largest share that a step loses


class ScalingWatch:
    """Collector of overflow counts at every step of a reverse pass, for `Scaling`."""

    def __init__(self, steps: int, format: str = "float16"):
        self.format = formats.format_of(format)
        self.steps, self.numbers = steps, 0
        self.table = {name: np.zeros(steps + 1, np.int64) for name in ("overflow", "underflow", "subnormal")}
        self.table |= {"largest": np.zeros(steps + 1), "smallest": np.full(steps + 1, np.inf)}
        # how many numbers of each step have each binary exponent
        self.exponents = np.zeros((steps + 1, _HIGHEST - _LOWEST + 1), np.int32)

    def __call__(self, stretch: TapeStretch, trace: AdjointCarry) -> None:
        """Collect data from the cotangents of successive steps of a reverse pass."""
        for row in range(stretch.rows):
            both = (np.asarray(part[row], np.float64).ravel() for part in (trace.x, trace.v))
            self.put(stretch.first + row, np.concatenate(list(both)))

    def put(self, step: int, values: Float[np.ndarray, "numbers"]) -> None:
        """Count the cotangents of one step that overflow or underflow."""
        form, size, table = self.format, np.abs(values), self.table
        self.numbers = len(values)
        there = size[np.isfinite(size) & (size > 0)]
        # half a unit in the last place beyond the largest rounds to infinity
        too_large = form.largest * (1 + 2.0 ** -(form.significand + 1))
        table["overflow"][step] = np.count_nonzero(~(size <= too_large))
        table["underflow"][step] = lost = np.count_nonzero(there <= form.smallest_subnormal / 2)
        table["subnormal"][step] = np.count_nonzero(there < form.smallest_normal) - lost
        if len(there):
            table["largest"][step], table["smallest"][step] = there.max(), there.min()
            place = np.clip(np.frexp(there)[1], _LOWEST, _HIGHEST) - _LOWEST
            self.exponents[step] = np.bincount(place, minlength=_HIGHEST - _LOWEST + 1)
        if not np.isfinite(size).all():
            table["largest"][step] = np.inf

    def result(self) -> Scaling:
        """Count cotangents that overflow or underflow, without and with scaling of the loss."""
        form = self.format
        largest = float(self.table["largest"].max())
        there = self.exponents.sum(axis=1, dtype=np.int64)
        usable = 0 < largest < np.inf
        # the more is multiplied the less is lost, so the best scale is the largest that overflows nowhere
        power = int(np.floor(np.log2(form.largest / largest))) if usable else 0
        # |x| < 2^e of frexp; half the smallest number is a power of two, so the counts are exact
        below = int(np.log2(form.smallest_subnormal)) - 1
        end = int(np.clip(below - power - _LOWEST + 1, 0, self.exponents.shape[1]))
        lost = self.exponents[:, :end].sum(axis=1, dtype=np.int64)
        kept = 1 - lost.sum() / max(there.sum(), 1)
        worst = float(np.max(lost / np.maximum(there, 1)))
        overflow = self.table["overflow"]
        scaled = {
            "scaled_overflow": np.zeros_like(overflow) if usable else overflow,
            "scaled_underflow": lost,
        }
        table = {name: column[::-1].copy() for name, column in (self.table | scaled).items()}
        scale = 2.0**power if usable and kept > 0.5 else float("nan")
        return Scaling(
            form.name, self.numbers, {"horizon": np.arange(self.steps + 1)} | table, scale, power, usable,
            bool(usable and worst <= LOST), worst,
        )  # fmt: skip


# --- singular values of the run's Jacobian -------------------------------------------------------------


@dataclass(frozen=True)
class Spectrum:
    """Singular values of the Jacobian of a whole run.

    The norm includes the velocities, multiplied by the internal time `clock`.
    """

    steps: int  # of the run
    clock: float  # internal time
    # natural logarithm of the largest singular values, largest first
    log_singular: Float[np.ndarray, "values"]
    # |Phi^T u - s v| / s of each with its vectors u and v: how exact it is
    residual: Float[np.ndarray, "values"]
    # exponents, exponents_time: finite-time Lyapunov exponents per step, and per unit of time of the file
    exponents: Float[np.ndarray, "values"]
    exponents_time: Float[np.ndarray, "values"]
    # horizon, curve: steps, and log stretch of the k-th direction of an orthonormal frame carried forward
    horizon: Int[np.ndarray, "points"]
    curve: Float[np.ndarray, "points values"]
    transposed: float  # relative defect of <w, Phi v> = <Phi^T w, v>: a rounding error
    word: str  # one of WORDS


@dataclass(frozen=True)
class TangentImage:
    """Product of a Jacobian and orthonormal vectors, stored as basis @ mixing * exp(log_scale)."""

    basis: Float[np.ndarray, "coordinates vectors"]  # orthonormal, shape (coordinates, vectors)
    mixing: Float[np.ndarray, "vectors vectors"]  # upper triangular, of size one, shape (vectors, vectors)
    log_scale: float  # log of what was taken out
    steps: np.ndarray  # number of steps after which `stretches` was noted, shape (points,)
    # log of the diagonal of the mixing so far, shape (points, vectors)
    stretches: Float[np.ndarray, "points vectors"]


class Jacobian:
    """Derivative of the last state with respect to the first state, at fixed decisions.

    A state contains all positions, and all velocities times the internal time `clock`.

    Raises:
        InputError: a many-body potential, or an integrator that is not a linear `KickDrift`.
    """

    def __init__(self, tape: RunTape, clock: float):
        check_kick(tape.simulation.integrator)
        if not isinstance(tape.simulation.force, PairForce):
            raise InputError("Jacobians are supported only for pair potentials", where=tape.simulation.name)
        self.tape, self.clock = tape, clock
        self.force: PairForce = tape.simulation.force
        self.coordinates = 6 * tape.simulation.atoms

    def image(self, block: Float[np.ndarray, "coordinates vectors"], backward: bool = False) -> TangentImage:
        """Return the Jacobian times vectors. If `backward`, return the transpose times vectors."""
        stretches = self.tape.backward() if backward else self.tape.forward()
        vectors, steps = block.shape[1], self.tape.steps
        mixing, log_scale = np.eye(vectors), 0.0
        noted, curve, done = [0], [np.zeros(vectors)], 0
        for stretch in stretches:
            # the last row is a state that no step leaves
            used = min(stretch.rows, steps - stretch.first)
            if used <= 0:
                continue
            block, r = _orthonormal(self._through(stretch, used, block, backward))
            mixing = r @ mixing
            size = float(np.abs(mixing).max())
            if not np.isfinite(size) or size == 0:
                raise FloatingPointError("a tangent is not finite")
            mixing, log_scale, done = mixing / size, log_scale + float(np.log(size)), done + used
            noted.append(done)
            with np.errstate(divide="ignore"):
                curve.append(curve[-1] + np.log(np.abs(np.diag(r))))
        return TangentImage(block, mixing, log_scale, np.array(noted), np.array(curve))

    def _through(self, stretch: TapeStretch, used: int, block, backward: bool):
        simulation, order = self.tape.simulation, stretch.table.order
        dtype, clocks = simulation.policy.dtype("state"), (1 / self.clock, self.clock)
        into, back = reversed(clocks) if backward else clocks
        x, v = (part.T.reshape(-1, 3, simulation.atoms)[..., order] for part in np.split(block, 2))
        x, v = _carried(
            self.force, simulation.integrator, jnp.asarray(simulation.masses[order]),
            simulation.tables(stretch.table), (stretch.steps, stretch.x, stretch.v, stretch.bits), used,
            (jnp.asarray(x.astype(dtype)), jnp.asarray((into * v).astype(dtype))), backward,
        )  # fmt: skip
        v = back * np.asarray(v, np.float64)
        moved = (unsorted(jnp.asarray(part, jnp.float64), order) for part in (x, v))
        return np.concatenate([np.asarray(part).reshape(block.shape[1], -1).T for part in moved])


def _orthonormal(block):
    """Return the QR factors of a block of vectors. The diagonal of R is ≥ 0."""
    q, r = np.linalg.qr(block)
    signs = np.where(np.diag(r) < 0, -1.0, 1.0)
    return q * signs, signs[:, None] * r


@partial(jax.jit, static_argnames=("backward",))
def _carried(
    force: PairForce,
    integrator: KickDrift,
    masses: Float[Array, "atoms"],
    tables: Tables,
    rows,
    used,
    block: tuple[Float[Array, "vectors 3 atoms"], Float[Array, "vectors 3 atoms"]],
    backward: bool,
):
    dynamics = PairDynamics(force, integrator, masses, tables)
    dtype = block[0].dtype
    half = (0.5 * integrator.timestep).astype(dtype)
    nothing = jnp.zeros((), jnp.float64)

    def push(row, dx, dv):
        number, x, v, told = row

        def step(x, v):
            after = dynamics.step(MdState(number, x, v), told)
            return after.x, after.v

        return jax.jvp(step, (x, v), (dx, dv))[1]

    def pull(row, onto_x, onto_v):
        number, x, v, told = row
        _, back = jax.vjp(lambda x, v: integrator.drift(x, v, masses, number, tables.order)[:2], x, v)
        onto_x, onto_v = back((onto_x, onto_v))
        kicks = half + jnp.where(number == 0, jnp.zeros((), dtype), half)
        w = kicks * onto_v / masses.astype(dtype)
        made = pull_back(force, x, tables, told, w, nothing, nothing)
        return onto_x + made.x, onto_v

    def body(carry, row):
        each = jax.vmap(partial(pull if backward else push, row))
        return each(*carry), jnp.zeros(())

    return over_rows(body, block, rows, used, backward=backward)[0]


def spectrum(
    problem: Problem,
    *,
    values: int = 3,
    extra: int = 4,
    rounds: int = 4,
    seed: int = 0,
    tape: RunTape | None = None,
    progress: Progress | None = None,
) -> Spectrum:
    """Compute singular values of the Jacobian of a run, and finite-time Lyapunov exponents.

    The effect of flips on perturbations is not included.

    Args:
        values: number of singular values. extra: additional vectors, for faster convergence.
        rounds: forward and backward passes of the block. seed: seed of the random block.
        tape: the run, if already made.

    Raises:
        InputError: no pair potential, or fewer coordinates than values. NumericalError: the run blew up.

    Error: a true singular value lies within the relative distance `residual` of each.
    """
    simulation = problem.simulation
    if tape is None:
        tape = tape_of(problem, False, progress=progress)
    timestep = float(simulation.integrator.timestep)
    jacobian = Jacobian(tape, CLOCK_STEPS * timestep)
    if not 1 <= values <= jacobian.coordinates or rounds < 1:
        raise InputError(
            f"{values = }, {rounds = }; expected 1 to {jacobian.coordinates} values and 1 or more rounds"
        )
    vectors = min(values + extra, jacobian.coordinates)
    rng = np.random.default_rng(seed)
    start, _ = np.linalg.qr(rng.standard_normal((jacobian.coordinates, vectors)))
    defect = float("nan")
    try:
        there = jacobian.image(start)
        for k in range(rounds):
            back = jacobian.image(there.basis, backward=True)
            if k == 0:
                defect = _defect(start, there, back)
            if progress is not None:
                progress(k + 1, rounds, "singular values")
            start = back.basis
            there = jacobian.image(start)
        log_s, left, right = _svd(there)
        residual = _residual(jacobian, there.basis @ left, start @ right, log_s)
    except FloatingPointError as error:
        raise NumericalError(
            f"singular values of the Jacobian cannot be computed: {error}", remedy="Use diagnose() instead"
        ) from error
    exponents = log_s[:values] / tape.steps
    steps, curve = np.arange(tape.steps + 1), there.stretches[:, :values]
    *_, grows = growth_rate(np.interp(steps, there.steps, curve[:, 0]))
    speeds = [
        np.sum(one.v[: one.rows].astype(np.float64) ** 2, axis=1).mean(axis=1) for one in tape.forward()
    ]
    return Spectrum(
        tape.steps, jacobian.clock, log_s[:values], residual[:values], exponents,
        exponents / (timestep / simulation.units.time_factor), there.steps, curve, defect,
        _word(np.sqrt(np.concatenate(speeds)), grows),
    )  # fmt: skip


def _defect(start, there: TangentImage, back: TangentImage) -> float:
    """Return the relative error of Q' (Phi q) = (Phi' Q)' q, a test of the transpose."""
    forward = there.mixing
    factor = np.exp(np.clip(back.log_scale - there.log_scale, -600, 600))
    backward = factor * (back.basis @ back.mixing).T @ start
    return float(np.abs(forward - backward).max() / np.abs(forward).max())


def _svd(image: TangentImage) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return singular values (logarithms) and left and right singular vectors of a Jacobian."""
    diagonal = image.stretches[-1]
    if diagonal.max() - diagonal.min() > _RANGE:
        # rounding has eaten the small ones in the product; the block is aligned, so its diagonal has them
        order = np.argsort(-diagonal)
        identity = np.eye(len(diagonal))[:, order]
        return diagonal[order], identity, identity
    left, sizes, right = np.linalg.svd(image.mixing)
    return np.log(sizes) + image.log_scale, left, right.T


def _residual(jacobian: Jacobian, left, right, log_s) -> np.ndarray:
    """Return the residual |Phi' u - s v| / s of each pair of singular vectors."""
    back = jacobian.image(left, backward=True)
    with np.errstate(over="ignore"):
        image = (back.basis @ back.mixing) * np.exp(back.log_scale - log_s)
    return np.linalg.norm(image - right, axis=0)
