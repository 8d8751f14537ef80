"""How a gradient grows with the horizon, read off one reverse pass.

The cotangent of the state h steps before the end is the gradient of a run of h steps that starts there. So
one reverse pass over T steps holds a gradient for every horizon up to T, each of another start of the same
motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float, Int

from mdnum.gradients import parameters
from mdnum.gradients.adjoint import Trace
from mdnum.gradients.base import Problem, Progress
from mdnum.gradients.diagnose.passes import Passed, passed
from mdnum.gradients.diagnose.results import Growth
from mdnum.gradients.parameters import Cotangents
from mdnum.gradients.tape import Stretch
from mdnum.systems.build import Simulation

#: Time steps that turn a velocity into a length: of the order of the time in which an atom feels its cage.
CLOCK_STEPS = 30
#: Share of the horizons before a growth rate is read off, and blocks that its error comes from.
TRANSIENT, BLOCKS = 0.2, 8
#: A rate counts where it is so many times its error, and a run is bounded where no speed is so many times
#: the usual one.
_SIGNIFICANT, _WILD = 4.0, 10.0
WORDS = ("both bounded", "forward bounded, gradient not", "forward not bounded")


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
        # by the start itself a derivative has as many entries as the start: its norm stands for it
        self._scalars = [name for name in self.names if not name.startswith("initial.")]

    def __call__(self, stretch: Stretch, trace: Trace) -> None:
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
                self._put(name, first + row, parameters.gradient(here, parts, name))

    def _put(self, name: str, step: int, value: np.ndarray) -> None:
        if name not in self.gradient:
            self.gradient[name] = np.full((self.steps + 1, *value.shape), np.nan)
        self.gradient[name][step] = value

    def result(self, whole: dict[str, Float[np.ndarray, "..."]]) -> Growth:
        """The growth.

        Args:
            whole: the gradient of the whole run, which is the last row: a loss may compare with the start,
                and that is no part of what is carried from step to step.
        """
        simulation = self.simulation
        timestep = float(simulation.integrator.timestep)
        clock = CLOCK_STEPS * timestep
        backward = self.norms[::-1]
        size = np.sqrt(backward[:, 0] ** 2 + (backward[:, 1] / clock) ** 2)
        gradient = {}
        for name in self.names:
            if name in self.gradient:
                gradient[name] = self.gradient[name][::-1].copy()
                gradient[name][-1] = whole[name]
            else:
                column = 0 if name == "initial.positions" else 1
                gradient[name] = backward[:, column].copy()
                gradient[name][-1] = np.linalg.norm(whole[name])
        rate, error, grows = growth_rate(size)
        bounded = forward_bounded(self.norms[:, 2])
        word = WORDS[2] if not bounded else WORDS[1] if grows else WORDS[0]
        per_time = rate / (timestep / simulation.units.time_factor)
        return Growth(
            np.arange(self.steps + 1),
            np.arange(self.steps, -1, -1),
            backward[:, 0].copy(),
            backward[:, 1].copy(),
            size,
            gradient,
            backward[:, 2].copy(),
            clock,
            timestep / simulation.units.time_factor,
            rate,
            error,
            word,
            _sentence(word, size, rate, error, per_time, simulation.units.time),
        )


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


def gain(growing: Growth) -> float:
    """How much the gradient by the state grew, from the first horizon that has one; 1 where none has."""
    there = growing.size[np.isfinite(growing.size) & (growing.size > 0)]
    return float(there.max() / there[0]) if len(there) else 1.0


def forward_bounded(speed: Float[np.ndarray, "rows"]) -> bool:
    """Whether the rms speeds of a run stay within a factor of the usual one."""
    usual = float(np.median(speed))
    return bool(np.isfinite(speed).all() and speed.max() <= _WILD * usual) if usual > 0 else True


def _sentence(word: str, size, rate: float, error: float, per_time: float, time: str) -> str:
    steps = len(size) - 1
    seen = np.flatnonzero(np.isfinite(size) & (size > 0))
    if not len(seen):
        return "No state has an effect on the loss that is finite and not zero."
    gain = size[seen[-1]] / size[seen[0]]
    told = f"Over {steps} steps the gradient by the state grew {gain:.3g}-fold"
    if word == WORDS[1]:
        unit = f" (a factor e in {1 / per_time:.3g} {time})"
        return f"{told}, by {rate:.3g} ± {error:.1g} a step{unit}, while the run itself stayed bounded."
    if word == WORDS[2]:
        return f"{told}, and the run itself did not stay bounded."
    if not np.isfinite(rate):
        return f"{told}; too few steps to tell whether that goes on."
    return f"{told}, no faster than in proportion to the steps."


def growth(
    problem: Problem,
    names: Sequence[str],
    *,
    saltation: bool = True,
    budget: int = 2**29,
    progress: Progress | None = None,
) -> Growth:
    """The gradient against the horizon, from one reverse pass.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: parameters, full or short names.
        saltation: whether flips count.
        budget: bytes of the recorded run that are kept.
        progress: called with the steps done, all steps, and a phase in words.

    Raises:
        InputError: no such parameter, or no pair potential. NumericalError: the run blew up.

    Error: that of the reverse pass; horizons below T belong to later starts of the same run.
    """
    names = parameters.resolve(problem.simulation, names)
    watch = GrowthWatch(problem.simulation, names, problem.steps)
    made: Passed = passed(
        problem, names, saltation=saltation, budget=budget, watches=[watch], progress=progress
    )
    return watch.result(made.gradient)
