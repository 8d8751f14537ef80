"""How a gradient grows with the horizon, and whether it would fit a narrow type, read off one reverse pass.

The cotangent of the state h steps before the end is the gradient of a run of h steps that starts there. So
one reverse pass over T steps holds a gradient for every horizon up to T, each of another start of the same
motion.

Cotangents of a chaotic run span many powers of two between the last step and the first. A loss scale moves
all of them together: it helps where they are small everywhere, and cannot help where they span more than the
format does. The pass is watched in the type that it runs in and compared with the narrow one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, Int

from mdnum.gradients import parameters
from mdnum.gradients.adjoint import Trace
from mdnum.gradients.parameters import Cotangents
from mdnum.gradients.problem import Problem, Progress
from mdnum.gradients.recorded import passed
from mdnum.gradients.tape import TapeStretch
from mdnum.numerics import formats
from mdnum.systems.build import Simulation

#: Time steps that turn a velocity into a length: of the order of the time in which an atom feels its cage.
CLOCK_STEPS = 30
#: Share of the horizons before a growth rate is read off, and blocks that its error comes from.
TRANSIENT, BLOCKS = 0.2, 8
#: A rate counts where it is this multiple of its error, and a run is bounded where no speed is this multiple
#: of the usual one.
_SIGNIFICANT, _WILD = 4.0, 10.0
WORDS = ("both bounded", "forward bounded, gradient not", "forward not bounded")
#: Binary exponents that are told apart; what lies beyond is counted at the ends.
_LOWEST, _HIGHEST = -200, 200
#: Share of the numbers of a step that may be lost where one scale is said to fit.
LOST = 0.01


@dataclass(frozen=True)
class GradientGrowth:
    """How the gradient grows with the horizon, from one reverse pass.

    Attributes:
        table: a row for each horizon 0, 1, ..., T, of the state that many steps before the end: `horizon`,
            `step`, `onto_positions` and `onto_velocities` (norms of the derivatives by all of them), `size`
            (norm of both, with velocities measured by `clock`), `speed` (rms of the atoms: the forward run),
            and `gradient.<name>`: the derivative by each parameter, were it changed over the last `horizon`
            steps alone (its norm by the start); the last row is the gradient of the whole run.
        clock: internal time that turns velocities into lengths. timestep: in the units of the system's file.
        rate: growth of log(size) per step, from a straight line through the later part.
        error: its standard error, from blocks. time: for a factor of e, in the units of the system's file.
        gain: largest size over the first that is not 0; 1 where all are.
        word: one of WORDS.
    """

    table: dict[str, np.ndarray]
    clock: float
    timestep: float
    rate: float
    error: float
    time: float
    gain: float
    word: str

    @property
    def size(self) -> Float[np.ndarray, "rows"]:
        """Norm of the derivative by the state."""
        return self.table["size"]


class GrowthWatch:
    """Collects what `Growth` shows while a reverse pass goes on.

    Args:
        simulation: the system as objects.
        names: full names of the parameters.
        steps: last step.
    """

    def __init__(self, simulation: Simulation, names: Sequence[str], steps: int):
        self.simulation, self.names, self.steps = simulation, tuple(names), steps
        self.norms = np.full((steps + 1, 3), np.nan)
        self.gradient: dict[str, np.ndarray] = {}
        # by the start itself a derivative has the entries of the start: its norm is shown for it
        self._scalars = [name for name in self.names if not name.startswith("initial.")]

    def __call__(self, stretch: TapeStretch, trace: Trace) -> None:
        """One stretch of the reverse pass."""
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
        scale, r_cut = np.asarray(trace.scale, np.float64), np.asarray(trace.r_cut)
        for row in range(rows if self._scalars else 0):
            model, integrator = jax.tree.unflatten(structure, [leaf[row] for leaf in leaves])
            turned = float(np.sum(onto_v[row] * v[row]))
            parts = Cotangents(
                model, integrator, onto_x[row], onto_v[row], float(scale[row]) - turned, r_cut[row]
            )
            # a temperature scales the velocities that the run has here
            here = replace(self.simulation, velocities=v[row].T)
            for name in self._scalars:
                value = parameters.gradient(here, parts, name)
                if name not in self.gradient:
                    self.gradient[name] = np.full((self.steps + 1, *value.shape), np.nan)
                self.gradient[name][first + row] = value

    def result(self, whole: dict[str, Float[np.ndarray, "..."]]) -> GradientGrowth:
        """The growth.

        Args:
            whole: the gradient of the whole run, which is the last row: a loss may compare with the start,
                and that is no part of what is carried from step to step.
        """
        units = self.simulation.units
        timestep = float(self.simulation.integrator.timestep)
        clock, backward = CLOCK_STEPS * timestep, self.norms[::-1]
        size = np.sqrt(backward[:, 0] ** 2 + (backward[:, 1] / clock) ** 2)
        table = {
            "horizon": np.arange(self.steps + 1),
            "step": np.arange(self.steps, -1, -1),
            "onto_positions": backward[:, 0].copy(),
            "onto_velocities": backward[:, 1].copy(),
            "size": size,
            "speed": backward[:, 2].copy(),
        }
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
        rate, error, grows = growth_rate(size)
        bounded = forward_bounded(self.norms[:, 2])
        word = WORDS[2] if not bounded else WORDS[1] if grows else WORDS[0]
        there = size[np.isfinite(size) & (size > 0)]
        gain = float(there.max() / there[0]) if len(there) else 1.0
        step = timestep / units.time_factor
        return GradientGrowth(table, clock, step, rate, error, step / rate if rate else np.inf, gain, word)


def growth_rate(size: Float[np.ndarray, "rows"]) -> tuple[float, float, bool]:
    """Growth of log(size) per row, its standard error, and whether it is more than linear growth gives.

    From the later part of the rows, in blocks. NaN and no where there are too few rows, or they are not
    finite.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return log_rate(np.log(size))


def log_rate(log: Float[np.ndarray, "rows"]) -> tuple[float, float, bool]:
    """As `growth_rate`, of a size that is given by its logarithm."""
    rows = np.flatnonzero(np.isfinite(log))
    if not len(rows) or len(log) < 10 * BLOCKS:
        return float("nan"), float("nan"), False
    first = max(int(TRANSIENT * (len(log) - 1)), int(rows[0]))
    if len(log) - first < 4 * BLOCKS or not np.isfinite(log[first:]).all():
        return float("nan"), float("nan"), False
    edges: Int[np.ndarray, "edges"] = np.linspace(first, len(log) - 1, BLOCKS + 1).astype(int)
    slopes = np.diff(log[edges]) / np.diff(edges)
    rate = float((log[-1] - log[first]) / (len(log) - 1 - first))
    error = float(slopes.std(ddof=1) / np.sqrt(BLOCKS))
    # what grows in proportion to the steps gains log(end / first) over this stretch
    linear = float(np.log((len(log) - 1) / max(first, 1))) / (len(log) - 1 - first)
    return rate, error, bool(rate > 2 * linear and rate > _SIGNIFICANT * error)


def forward_bounded(speed: Float[np.ndarray, "rows"]) -> bool:
    """Whether the rms speeds of a run stay within a factor of the usual one."""
    usual = float(np.median(speed))
    return bool(np.isfinite(speed).all() and speed.max() <= _WILD * usual) if usual > 0 else True


def growth(
    problem: Problem, names: Sequence[str], *, saltation: bool = True, progress: Progress | None = None
) -> GradientGrowth:
    """The gradient against the horizon, from one reverse pass.

    Args:
        problem: the loss of a rollout.
        names: parameters, full or short names.
        saltation: whether flips count.
        progress: called with the steps done, all steps, and the name of the phase.

    Raises:
        InputError: no such parameter, or flips of no pair potential. NumericalError: the run blew up.

    Error: that of the reverse pass; horizons below T belong to later starts of the same run.
    """
    names = parameters.resolve(problem.simulation, names)
    watch = GrowthWatch(problem.simulation, names, problem.steps)
    made = passed(problem, names, saltation=saltation, watches=[watch], progress=progress)
    return watch.result(made.gradient)


@dataclass(frozen=True)
class Scaling:
    """Whether the cotangents of a reverse pass fit a narrow type, step by step.

    Attributes:
        format: the type, one of precision.formats.
        numbers: in each step.
        table: by `horizon`, numbers of the step that are beyond the largest of the format (`overflow`), lost
            below half the smallest (`underflow`), have lost digits (`subnormal`), the `largest` and
            `smallest` magnitude (zeros left out), and the counts with the scale (`scaled_...`).
        scale: a power of two by which the loss is multiplied so that the fewest numbers are lost and none
            overflows; NaN where no scale keeps the largest in range and more than half of the others.
        power: its exponent, of the largest scale that overflows nowhere.
        usable: whether there is anything finite to scale.
        fits: whether one scale serves all steps: nothing overflows, and no step loses more than 1 % of its
            numbers. worst: largest share of its numbers that a step loses.
    """

    format: str
    numbers: int
    table: dict[str, np.ndarray]
    scale: float
    power: int
    usable: bool
    fits: bool
    worst: float


class ScalingWatch:
    """Counts what would overflow and underflow while a reverse pass goes on.

    Args:
        steps: last step.
        format: one of precision.formats.
    """

    def __init__(self, steps: int, format: str = "float16"):
        self.format = formats.format_of(format)
        self.steps, self.numbers = steps, 0
        self.largest, self.smallest = np.zeros(steps + 1), np.full(steps + 1, np.inf)
        self.overflow, self.underflow, self.subnormal = (np.zeros(steps + 1, np.int64) for _ in range(3))
        # how many numbers of each step have each binary exponent
        self.exponents = np.zeros((steps + 1, _HIGHEST - _LOWEST + 1), np.int32)

    def __call__(self, stretch: TapeStretch, trace: Trace) -> None:
        """One stretch of the reverse pass."""
        for row in range(stretch.rows):
            both = (np.asarray(part[row], np.float64).ravel() for part in (trace.x, trace.v))
            self.put(stretch.first + row, np.concatenate(list(both)))

    def put(self, step: int, values: Float[np.ndarray, "numbers"]) -> None:
        """The cotangents of one step."""
        form, size = self.format, np.abs(values)
        self.numbers = len(values)
        there = size[np.isfinite(size) & (size > 0)]
        # half a unit in the last place beyond the largest rounds to infinity
        too_large = form.largest * (1 + 2.0 ** -(form.significand + 1))
        self.overflow[step] = np.count_nonzero(~(size <= too_large))
        self.underflow[step] = np.count_nonzero(there <= form.smallest_subnormal / 2)
        self.subnormal[step] = np.count_nonzero(there < form.smallest_normal) - self.underflow[step]
        if len(there):
            self.largest[step], self.smallest[step] = there.max(), there.min()
            place = np.clip(np.frexp(there)[1], _LOWEST, _HIGHEST) - _LOWEST
            self.exponents[step] = np.bincount(place, minlength=_HIGHEST - _LOWEST + 1)
        if not np.isfinite(size).all():
            self.largest[step] = np.inf

    def result(self) -> Scaling:
        """The counts, with and without the best scale; exact but for numbers on an edge of a power of two."""
        form = self.format
        largest = float(self.largest.max())
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
        columns = {
            "overflow": self.overflow, "underflow": self.underflow, "subnormal": self.subnormal,
            "largest": self.largest, "smallest": self.smallest,
            "scaled_overflow": np.zeros_like(self.overflow) if usable else self.overflow,
            "scaled_underflow": lost,
        }  # fmt: skip
        table = {name: column[::-1].copy() for name, column in columns.items()}
        scale = 2.0**power if usable and kept > 0.5 else float("nan")
        return Scaling(
            form.name, self.numbers, {"horizon": np.arange(self.steps + 1)} | table, scale, power, usable,
            bool(usable and worst <= LOST), worst,
        )  # fmt: skip
