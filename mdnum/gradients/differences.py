"""Gradient methods with many runs: finite differences, and means over replicas.

A replica is the same system with other initial velocities and thermostat noise. Replicas run one after
another on each device, because their neighbor lists differ.

If a parameter changes, pairs cross the cutoff at other steps. If the force jumps at the cutoff, the loss
jumps too. Between two jumps, the slope of the loss is the derivative at fixed decisions. The event-aware
gradient is the slope of the loss across many jumps. Finite differences that are compared with this gradient
must span many jumps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from math import factorial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError, NumericalError
from mdnum.gradients import parameters
from mdnum.gradients.problem import Gradient, Method, Problem, Progress, scalars_only
from mdnum.gradients.recorded import EventAware
from mdnum.gradients.tape import RunTape, TapeStretch
from mdnum.numerics import PrecisionPolicy
from mdnum.numerics.roles import FIXED_POINT
from mdnum.rollout.engine import FAILURES, Engine, unwrapped
from mdnum.systems.simulation import Simulation

#: Largest step, and spacing of the values from which the noise is estimated (in rounding errors of the
#: parameter), relative to the parameter.
_WIDEST, _SPACING = 1e-4, 64.0
#: Relative rounding error of a fixed-point state: an impulse is rounded to a fraction of its unit.
_FIXED_POINT = 2.0**-30
#: Approximate number of runs needed to choose a step: for the noise, and for one or two steps.
_CHOOSING = 15
#: Estimates of the noise from neighboring orders are accepted if they agree within this factor.
_AGREE = 4.0
#: Smallest factor by which a step is reduced at a time, because the first truncation error may be arbitrary.
_MOST_SHRINK = 1e-3
#: Number of times that the spacing is increased if all values are equal; number of values for a noise
#: estimate.
_WIDENINGS, _POINTS = 4, 7
#: Largest number of changes of a step.
_TRIES = 4


class Differentiated(NamedTuple):
    """A derivative computed from function values, with an estimate of its error."""

    value: float  # the derivative
    error: float  # what truncation and noise leave uncertain: the disagreement of the last two extrapolations
    step: float  # the largest step of the extrapolation that was chosen
    table: tuple[tuple[float, float], ...]  # central differences by step, largest step first


def richardson(f: Callable[[float], float], x: float, step: float, levels: int = 6) -> Differentiated:
    """Differentiate f at x by Richardson's extrapolation of central differences (Ridders 1982).

    The finite-difference step decreases by factors of 1.4. The extrapolation with the smallest estimated
    error is returned.

    Args:
        f: function of one number. x: point. step: the largest step. levels: number of steps.
    """
    shrink = 1.4
    table = np.full((levels, levels), np.nan)
    rows: list[tuple[float, float]] = []
    best, error, chosen = np.nan, np.inf, step
    h = step
    for k in range(levels):
        table[k, 0] = (f(x + h) - f(x - h)) / (2 * h)
        rows.append((h, float(table[k, 0])))
        factor = shrink**2
        for m in range(1, k + 1):
            table[k, m] = (table[k, m - 1] * factor - table[k - 1, m - 1]) / (factor - 1)
            factor *= shrink**2
            here = max(abs(table[k, m] - table[k, m - 1]), abs(table[k, m] - table[k - 1, m - 1]))
            if here < error:
                best, error, chosen = float(table[k, m]), float(here), h * shrink**m
        if k and abs(table[k, k] - table[k - 1, k - 1]) >= 2 * error:
            break
        h /= shrink
    return Differentiated(best, error, chosen, tuple(rows))


def noise_of(values: Float[np.ndarray, "points"]) -> float:
    """Estimate the standard deviation of a function's noise from equally spaced values.

    Differences of order k cancel a smooth function and amplify noise by a known factor.

    Args:
        values: at least 4, so closely spaced that the function is nearly linear over all of them.

    Error: a factor of a few, because the values are few.
    Source: J. J. Moré, S. M. Wild, Estimating Computational Noise, SIAM J. Sci. Comput. 33 (2011) 1292.
    """
    levels, signs = [], []
    differences = np.asarray(values, np.float64)
    for k in range(1, len(values) - 1):
        differences = np.diff(differences)
        gamma = factorial(k) ** 2 / factorial(2 * k)
        levels.append(float(np.sqrt(gamma * np.mean(differences**2))))
        signs.append(bool(differences.min() < 0 < differences.max()))
    for k in range(len(levels) - 2):
        near = levels[k : k + 3]
        if signs[k] and max(near) <= _AGREE * min(near):
            return levels[k]
    # no plateau: what is smooth is still in the lower orders
    return levels[-1]


class DifferenceStep(NamedTuple):
    """Step size for central differences of a function, and its noise (standard deviation)."""

    size: float
    noise: float


def choose_step(f: Callable[[float], float], x: float, first: float, spacing: float) -> DifferenceStep:
    """Choose the step size with about equal truncation error and noise of a central difference.

    Args:
        first: the initial step, which is also the largest, because the function may differ in kind beyond it.
        spacing: between the values from which the noise is estimated: some rounding errors of x.

    Error: the truncation is estimated from differences over one and two steps; for a function that jumps in
    between, the estimate may be too small by chance; extrapolate and compare.
    """
    values = np.full(_POINTS, f(x))
    for _ in range(_WIDENINGS):
        values = np.array([f(x + k * spacing) for k in range(_POINTS)])
        if np.ptp(values) > 0:
            break
        # what a rounding hides has a noise that was not seen, not none
        spacing *= 64
    # a value has at least the rounding error of its last operation
    noise = max(noise_of(values), float(np.finfo(np.float64).eps) * abs(f(x)))
    size = first
    for attempt in range(_TRIES):
        one = (f(x + size) - f(x - size)) / (2 * size)
        two = (f(x + 2 * size) - f(x - 2 * size)) / (4 * size)
        truncation, rounding = abs(two - one) / 3, noise / size
        if truncation <= 10 * rounding or rounding == 0 or attempt == _TRIES - 1:
            break
        # truncation goes with the square of the step, noise with one over it
        wanted = (rounding / truncation) ** (1 / 3) if np.isfinite(truncation) else 0.0
        size *= max(wanted, _MOST_SHRINK)
    return DifferenceStep(size, noise)


def nonzero(problem: Problem, name: str) -> float:
    """Return the value of a scalar parameter. Raise an error if it is 0.

    Raises:
        InputError: the value is 0.
    """
    here = float(parameters.value(problem.simulation, name))
    if here == 0:
        raise InputError(
            f"the parameter {name} is 0, but the finite-difference step is a fraction of the parameter",
            remedy="Differentiate with respect to another parameter",
        )
    return here


@dataclass(frozen=True)
class FiniteDifferences(Method):
    """Gradient method: central differences of the loss, extrapolated to zero shift of the parameter.

    The details contain errors, finite-difference steps and the noise of the loss.
    """

    # the largest step as a share of the parameter; None for one that the noise of the loss and its third
    # derivative ask for. In a long run the loss is straight over tiny steps only
    relative: float | None = None
    levels: int = 3  # steps of the extrapolation

    name = "finite-differences"
    kind = "values"
    description = "differences of the loss between runs with shifted parameters, extrapolated to no shift"

    @property
    def runs(self) -> int:
        """Approximate number of runs that the method makes for each parameter."""
        return 2 * self.levels + (0 if self.relative is not None else _CHOOSING)

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        return scalars_only(problem, names)

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        gradient: dict[str, np.ndarray] = {}
        details: dict[str, dict[str, Any]] = {"error": {}, "step": {}, "noise": {}, "table": {}}
        count = _counter(progress, self.runs * len(names), "differences")
        for name in names:
            here = nonzero(problem, name)

            @cache
            def at(q: float, name: str = name) -> float:
                count()
                return problem.value({name: q})

            widest, noise = self.relative and self.relative * abs(here), 0.0
            if widest is None:
                # a shift below the relative spacing of the numbers that a parameter is kept in is none
                policy = problem.simulation.policy
                narrow = policy.state == FIXED_POINT
                rounding = _FIXED_POINT if narrow else float(jnp.finfo(policy.dtype("force")).eps)
                size, noise = choose_step(at, here, _WIDEST * abs(here), _SPACING * rounding * abs(here))
                widest, details["noise"][name] = 2 * size, noise
            found = richardson(at, here, widest, self.levels)
            gradient[name] = np.asarray(found.value)
            details["error"][name] = max(found.error, noise / found.step)
            details["step"][name], details["table"][name] = found.step, found.table
        same = "the loss was the same at all shifts"
        notes = {name: same for name, value in gradient.items() if not np.any(value)}
        return self.result(problem.value(), gradient, notes, details)


def _counter(progress: Progress | None, runs: int, phase: str) -> Callable[[], None]:
    """Return a function that reports progress. Call this function once per run."""
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(min(done, runs), runs, phase)

    return count


@dataclass(frozen=True)
class ShadowDifferences(Method):
    """Gradient method: finite differences in float64 for a run in a narrower format.

    For runs in float64, no wider format is practical. Use `FiniteDifferences`, which estimates its own noise.
    """

    relative: float = 1e-4  # the largest step as a share of the parameter
    levels: int = 6  # steps of the extrapolation

    name = "shadow-differences"
    kind = "values"
    description = "differences of the loss in float64, of a run that is made in a narrower format"

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        if problem.simulation.policy.state == FIXED_POINT:
            return "a fixed-point integer state is another program, not a rounded one"
        if problem.simulation.policy == PrecisionPolicy():
            return "the run is in float64 throughout, and there is no wider format to shadow it in"
        return scalars_only(problem, names)

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        wide = replace(problem, simulation=problem.simulation.with_policy())
        found = FiniteDifferences(self.relative, self.levels)(wide, names, progress)
        details = {**found.details, "value of the run itself": problem.value()}
        return self.result(found.value, found.gradient, {}, details)


# --- means over replicas ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Replicas:
    """Initial states of a system that differ only in random numbers."""

    count: int = 8  # how many
    seed: int = 0  # of the first one; the others count on from there
    # steps that each runs with its new velocities before its start, so that positions differ too
    settle: int = 0

    def __post_init__(self):
        if self.count < 2 or self.settle < 0:
            seen = f"replicas = {self.count}, settle = {self.settle}"
            raise InputError(f"{seen}; expected at least 2 replicas with 0 or more equilibration steps each")

    def of(self, problem: Problem) -> list[Problem]:
        """Return a list of problems, one for each replica (initial state)."""
        return [
            replace(problem, simulation=replica(problem.simulation, self.seed + k, self.settle))
            for k in range(self.count)
        ]


def replica(simulation: Simulation, seed: int, settle: int = 0) -> Simulation:
    """Return the system with new random velocities at its temperature. A thermostat gets new noise.

    Args:
        seed: of velocities and noise. settle: steps to run before the start.

    Raises:
        NumericalError: the run before the start blew up.
    """
    masses = simulation.masses
    kT = simulation.units.k_B * simulation.draw.temperature
    random = np.random.default_rng((seed, simulation.draw.seed))
    v = random.standard_normal((len(masses), 3)) * np.sqrt(kT / masses)[:, None]
    # a velocity that all atoms share is no temperature
    v -= masses @ v / masses.sum()
    made = replace(simulation, velocities=v)
    if (key := made.integrator.random) is not None:
        key = jax.random.fold_in(key, seed)
        made = replace(made, integrator=eqx.tree_at(lambda one: one.random, made.integrator, key))
    return settled(made, settle) if settle else made


def settled(simulation: Simulation, steps: int) -> Simulation:
    """Return a simulation that starts from the state after `steps` steps.

    Raises:
        NumericalError: the run blew up.
    """
    *_, last = Engine(simulation, steps).segments()
    if last.closes in FAILURES:
        raise NumericalError(f"a replica failed while equilibrating ({last.closes} at step {last.last})")
    x, v, images = (last.unsorted(name, last.rows - 1) for name in ("x", "v", "images"))
    cell = last.cell_of(last.rows - 1)
    x = unwrapped(np.asarray(cell.matrix), x, images)
    return replace(
        simulation.in_row(cell), positions=np.asarray(x, np.float64), velocities=np.asarray(v, np.float64)
    )


@dataclass(frozen=True)
class Estimate:
    """Mean over replicas, with its standard error and all values."""

    # mean, error: the mean and its standard error, of the shape of the parameter
    mean: Float[np.ndarray, "..."]
    error: Float[np.ndarray, "..."]
    of: Float[np.ndarray, "replicas ..."]  # each replica's, shape (replicas, ...)

    @classmethod
    def from_replicas(cls, values: Sequence[Any] | np.ndarray) -> Estimate:
        """Compute mean and standard error from the values of all replicas."""
        of = np.stack([np.asarray(value, np.float64) for value in values])
        return cls(np.asarray(of.mean(axis=0)), np.asarray(of.std(axis=0, ddof=1) / np.sqrt(len(of))), of)


@dataclass(frozen=True)
class Ensemble(Method):
    """Gradient method: average of another method's gradient over replicas, at several horizons.

    The details contain standard errors, and the number of steps at which noise dominates.
    """

    method: Method = field(default_factory=EventAware)  # applied to each replica
    replicas: Replicas = field(default_factory=Replicas)  # their starts
    halvings: int = 3  # the horizons are the steps asked for, and this many halves of halves of them

    name = "ensemble"
    kind = "average"
    description = "the mean over replicas of the derivative of the flow"

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        own = [name for name in names if name.startswith("initial.")]
        if own:
            return f"every replica has {' and '.join(own)} of its own"
        return self.method.reason_unavailable(problem, names)

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        starts, horizons = self.replicas.of(problem), self._horizons(problem)
        rows: list[dict[str, Any]] = []
        count = _counter(progress, len(horizons) * len(starts), "replicas")
        for steps in horizons:
            # the longest comes last, and its notes are the ones that are kept
            found: list[Gradient] = []
            for one in each(self.method, [replace(start, steps=steps) for start in starts], names):
                found.append(one)
                count()
            means = {name: Estimate.from_replicas([one.gradient[name] for one in found]) for name in names}
            for name, one in means.items():
                mean, error = (float(np.linalg.norm(part)) for part in (one.mean, one.error))
                rows.append({"steps": steps, "name": name, "mean": mean, "error": error})
        values = Estimate.from_replicas([one.value for one in found])
        details = {
            "method": self.method.name, "replicas": len(starts),
            "error": {name: one.error.tolist() for name, one in means.items()},
            "each": {name: one.of.tolist() for name, one in means.items()},
            "standard error of the value": float(values.error), "horizons": rows,
            "horizon of noise": {name: _lost(rows, name) for name in names},
        }  # fmt: skip
        gradient = {name: one.mean for name, one in means.items()}
        made = self.result(float(values.mean), gradient, found[0].notes, details)
        return replace(made, description=f"the mean over replicas of {self.method.description}")

    def _horizons(self, problem: Problem) -> list[int]:
        """Return the horizons (numbers of steps) at which the loss uses a frame, shortest first."""
        found = []
        for k in reversed(range(self.halvings + 1)):
            steps = problem.steps >> k
            try:
                replace(problem, steps=max(steps, 1))
            except InputError:
                continue
            if steps >= 1 and steps not in found:
                found.append(steps)
        return found


def each(method: Method, problems: Sequence[Problem], names: Sequence[str]):
    """Distribute the problems over all devices. Yield their gradients in the same order."""
    devices = jax.local_devices()
    if len(devices) < 2:
        yield from (method(one, names) for one in problems)
        return

    def on(k: int) -> Gradient:
        with jax.default_device(devices[k % len(devices)]):
            return method(problems[k], names)

    with ThreadPoolExecutor(len(devices)) as workers:
        yield from workers.map(on, range(len(problems)))


def _lost(rows: Sequence[dict[str, Any]], name: str) -> int | None:
    """Return the number of steps from which the standard error exceeds the mean, or None."""
    mine = [row for row in rows if row["name"] == name]
    kept = [k for k, row in enumerate(mine) if row["error"] < row["mean"]]
    after = max(kept, default=-1) + 1
    return mine[after]["steps"] if after < len(mine) else None


@dataclass(frozen=True)
class SmoothedDifferences(Method):
    """Gradient method: mean over replicas of central differences that span many flips.

    The two runs of a difference use the same random numbers. Differences with steps h and h/2 are
    extrapolated to h = 0. The result is the extrapolation from the largest step that agrees with all smaller
    steps, within twice the standard error. Smaller steps increase the noise due to single flips.
    """

    relative: float = 0.002  # the widest step as a share of the parameter
    steps: int = 3  # number of steps, each half of the one before
    # the starts; a replica's start does not change with the parameter
    replicas: Replicas = field(default_factory=Replicas)

    name = "smoothed-differences"
    kind = "average"
    description = "the mean over replicas of differences across steps wider than the spacing of events"

    def reason_unavailable(self, problem: Problem, names: Sequence[str]) -> str | None:
        return scalars_only(problem, names)

    def differentiate(self, problem: Problem, names: tuple[str, ...], progress: Progress | None) -> Gradient:
        starts = self.replicas.of(problem)
        gradient: dict[str, np.ndarray] = {}
        details: dict[str, Any] = {
            "replicas": len(starts), **{key: {} for key in ("error", "each", "step", "table", "moved")}
        }  # fmt: skip
        count = _counter(progress, 2 * self.steps * len(starts) * len(names), "differences")
        for name in names:
            here = nonzero(problem, name)
            widths = self.relative * abs(here) / 2.0 ** np.arange(self.steps)
            found = np.empty((self.steps, len(starts)))
            moved = []
            for k, h in enumerate(widths):
                # all replicas at one value of the parameter: a new radius is compiled for once
                high = _values(starts, {name: here + h}, count)
                low = _values(starts, {name: here - h}, count)
                found[k] = [(a[0] - b[0]) / (2 * h) for a, b in zip(high, low, strict=True)]
                moved.append(_share(high, low))
            chosen, error, best = _chosen(found)
            gradient[name] = chosen.mean
            details["each"][name] = chosen.of.tolist()
            details["error"][name] = error
            details["step"][name] = float(widths[best])
            details["moved"][name] = moved[best]
            details["table"][name] = [
                [float(h), float(one.mean()), float(one.std(ddof=1) / np.sqrt(len(one))), share]
                for h, one, share in zip(widths, found, moved, strict=True)
            ]
        return self.result(float(np.mean([one.value() for one in starts])), gradient, {}, details)


def _values(starts: Sequence[Problem], values: dict[str, float], count: Callable[[], None]):
    """Return the loss of each initial state at given parameter values, with all crossings (step, i, j)."""
    found = []
    for start in starts:
        made, met = start.at(values), set()

        def add(stretch: TapeStretch, met: set = met) -> None:
            assert stretch.ledger is not None
            columns = (stretch.ledger.step, stretch.ledger.i, stretch.ledger.j)
            met.update(zip(*(column.tolist() for column in columns), strict=True))

        tape = RunTape(made.simulation, made.loss, made.steps, flips=True, budget=0, each=add)
        found.append((tape.value, met))
        count()
    return found


def _share(high, low) -> float | None:
    """Return the fraction of cutoff crossings that do not occur in both runs at the same step."""
    total = sum(len(a[1]) + len(b[1]) for a, b in zip(high, low, strict=True))
    differing = sum(len(a[1] ^ b[1]) for a, b in zip(high, low, strict=True))
    return differing / total if total else None


def _chosen(found: Float[np.ndarray, "steps replicas"]) -> tuple[Estimate, float, int]:
    """Choose one extrapolated difference. Return the derivative, its error and the index of its step."""
    if len(found) == 1:
        only = Estimate.from_replicas(found[0])
        return only, float(only.error), 0
    flat = [Estimate.from_replicas((4 * fine - wide) / 3) for wide, fine in pairwise(found)]
    best, left = len(flat) - 1, 0.0
    for k, one in enumerate(flat):
        differences = [Estimate.from_replicas(other.of - one.of) for other in flat[k + 1 :]]
        if all(abs(float(other.mean)) <= 2 * float(other.error) for other in differences):
            # what the pairs differ by, beyond their noise, may be left of truncation
            beyond = [abs(float(other.mean)) - float(other.error) for other in differences]
            best, left = k, max([*beyond, 0.0])
            break
    return flat[best], float(np.hypot(flat[best].error, left)), best
