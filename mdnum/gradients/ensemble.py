"""Many rollouts instead of one: means over replicas of a gradient, and of differences across wide steps.

A replica is the same system with other velocities, and with another noise where there is a thermostat. Each
is a run with lists of its own, so replicas are made one after another, on the devices that there are.

StepEnds two crossings that change the step at which they happen, a loss with a force jump follows the
derivative of its steps; at each of them it jumps. What the event-aware gradient predicts is the slope over
many such jumps, so a difference that shall be compared with it must reach across many of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError, NumericalError
from mdnum.gradients import parameters
from mdnum.gradients.differences import nonzero
from mdnum.gradients.problem import Gradient, Method, Problem, Progress, scalars_only
from mdnum.gradients.recorded import EventAware
from mdnum.gradients.tape import RunTape, TapeStretch
from mdnum.md.integrators import Langevin
from mdnum.rollout.engine import FAILURES, Engine, unwrapped
from mdnum.systems.build import Simulation


@dataclass(frozen=True)
class Replicas:
    """Starts that differ by chance alone.

    Attributes:
        count: how many.
        seed: of the first one; the others count on from there.
        settle: steps that each runs with its new velocities before its start, so that positions differ too.
    """

    count: int = 8
    seed: int = 0
    settle: int = 0

    def __post_init__(self):
        if self.count < 2 or self.settle < 0:
            raise InputError(
                f"replicas = {self.count}, settle = {self.settle}; expected at least 2, and at least 0"
            )

    def of(self, problem: Problem) -> list[Problem]:
        """The problem with each of the starts."""
        return [
            replace(problem, simulation=replica(problem.simulation, self.seed + k, self.settle))
            for k in range(self.count)
        ]


def replica(simulation: Simulation, seed: int, settle: int = 0) -> Simulation:
    """The same system with new velocities of its temperature, and a noise of its own.

    Args:
        simulation: the system as objects.
        seed: of velocities and noise.
        settle: steps to run before the start.

    Raises:
        NumericalError: the run before the start blew up.
    """
    masses = simulation.masses
    kT = simulation.units.k_B * float(parameters.value(simulation, "dynamics.temperature"))
    random = np.random.default_rng((seed, simulation.system.spec.dynamics.seed))
    v = random.standard_normal((len(masses), 3)) * np.sqrt(kT / masses)[:, None]
    # a velocity that all atoms share is no temperature
    v -= masses @ v / masses.sum()
    made = replace(simulation, velocities=v)
    bath = simulation.integrator
    if isinstance(bath, Langevin):
        key = jax.random.fold_in(bath.key, seed)
        made = replace(made, integrator=eqx.tree_at(lambda one: one.key, bath, key))
    return settled(made, settle) if settle else made


def settled(simulation: Simulation, steps: int) -> Simulation:
    """The simulation where it is after this many steps, as a start.

    Raises:
        NumericalError: the run blew up.
    """
    *_, last = Engine(simulation, steps).segments()
    if last.closes in FAILURES:
        raise NumericalError(f"a replica ended in a {last.closes} at step {last.last}, before its start")
    x, v, images = (last.unsorted(name, last.rows - 1) for name in ("x", "v", "images"))
    x = unwrapped(np.asarray(simulation.cell.matrix), x, images)
    return replace(simulation, positions=np.asarray(x, np.float64), velocities=np.asarray(v, np.float64))


@dataclass(frozen=True)
class Estimate:
    """A mean over replicas.

    Attributes:
        mean, error: the mean and its standard error, of the shape of the parameter.
        of: each replica's, shape (replicas, ...).
    """

    mean: Float[np.ndarray, "..."]
    error: Float[np.ndarray, "..."]
    of: Float[np.ndarray, "replicas ..."]

    @classmethod
    def from_replicas(cls, values: Sequence[Any] | np.ndarray) -> Estimate:
        """From the values of all replicas."""
        of = np.stack([np.asarray(value, np.float64) for value in values])
        return cls(np.asarray(of.mean(axis=0)), np.asarray(of.std(axis=0, ddof=1) / np.sqrt(len(of))), of)


@dataclass(frozen=True)
class Ensemble(Method):
    """The mean over replicas of another method's gradient, at several horizons.

    Standard errors and the horizon of noise are in the details.

    Attributes:
        method: applied to each replica.
        replicas: their starts.
        halvings: the horizons are the steps asked for, and this many halves of halves of them.
    """

    method: Method = field(default_factory=EventAware)
    replicas: Replicas = field(default_factory=Replicas)
    halvings: int = 3

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
        found: list[Gradient] = []
        done = 0
        for steps in horizons:
            # the longest comes last, and its notes are the ones that are kept
            found = []
            for one in each(self.method, [replace(start, steps=steps) for start in starts], names):
                found.append(one)
                done += 1
                if progress is not None:
                    progress(done, len(horizons) * len(starts), "replicas")
            means = {name: Estimate.from_replicas([one.gradient[name] for one in found]) for name in names}
            for name, one in means.items():
                mean, error = (float(np.linalg.norm(part)) for part in (one.mean, one.error))
                rows.append({"steps": steps, "name": name, "mean": mean, "error": error})
        values = Estimate.from_replicas([one.value for one in found])
        details = {
            "method": self.method.name,
            "replicas": len(starts),
            "error": {name: one.error.tolist() for name, one in means.items()},
            "each": {name: one.of.tolist() for name, one in means.items()},
            "standard error of the value": float(values.error),
            "horizons": rows,
            "horizon of noise": {name: _lost(rows, name) for name in names},
        }
        gradient = {name: one.mean for name, one in means.items()}
        made = self.result(float(values.mean), gradient, found[0].notes, details)
        return replace(made, description=f"the mean over replicas of {self.method.description}")

    def _horizons(self, problem: Problem) -> list[int]:
        """Steps, shortest first; those at which the loss sees nothing are left out."""
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
    """A method's gradient of every problem, in order; one worker for each device where there are several."""
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
    """The first horizon from which on the standard error passes the mean; None where it does not."""
    mine = [row for row in rows if row["name"] == name]
    kept = [k for k, row in enumerate(mine) if row["error"] < row["mean"]]
    after = max(kept, default=-1) + 1
    return mine[after]["steps"] if after < len(mine) else None


@dataclass(frozen=True)
class SmoothedDifferences(Method):
    """Central differences with wide steps over replicas that share their random numbers.

    Of several steps, each twice the next, pairs are extrapolated to no step. The widest pair is taken that
    differs from no narrower one by more than twice the standard error of the difference: narrower steps
    have more of the noise of single events. Standard errors, steps and moved crossings are in the details.

    Attributes:
        relative: the widest step as a share of the parameter.
        steps: number of steps, each half of the one before.
        replicas: the starts; a replica's start does not change with the parameter.
        count_moved: whether to count the crossings that a step moves to another step of time.
    """

    relative: float = 0.002
    steps: int = 3
    replicas: Replicas = field(default_factory=Replicas)
    count_moved: bool = True

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
        runs, done = 2 * self.steps * len(starts) * len(names), 0

        def count() -> None:
            nonlocal done
            done += 1
            if progress is not None:
                progress(done, runs, "differences")

        for name in names:
            here = nonzero(problem, name)
            widths = self.relative * abs(here) / 2.0 ** np.arange(self.steps)
            found = np.empty((self.steps, len(starts)))
            moved = []
            for k, h in enumerate(widths):
                # all replicas at one value of the parameter: a new radius is compiled for once
                high = _values(starts, {name: here + h}, self.count_moved, count)
                low = _values(starts, {name: here - h}, self.count_moved, count)
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


def _values(starts: Sequence[Problem], values: dict[str, float], flips: bool, count: Callable[[], None]):
    """The loss of every start at shifted parameters, and the set of its crossings."""
    found = []
    for start in starts:
        made = start.at(values)
        met: set[tuple[int, ...]] = set()
        tape = RunTape(
            made.simulation, made.loss, made.steps, flips=flips, budget=0,
            each=lambda stretch, met=met: met.update(_crossings(stretch)),
        )  # fmt: skip
        found.append((tape.value, met))
        count()
    return found


def _crossings(stretch: TapeStretch) -> Iterator[tuple[int, ...]]:
    """Step and pair of every flip of a stretch; none where they were not asked for."""
    if stretch.ledger is not None:
        yield from zip(stretch.ledger.step.tolist(), *stretch.ledger.subject.T.tolist(), strict=True)


def _share(high, low) -> float | None:
    """Share of the crossings that are not in both runs at the same step; None where they were not counted."""
    total = sum(len(a[1]) + len(b[1]) for a, b in zip(high, low, strict=True))
    differing = sum(len(a[1] ^ b[1]) for a, b in zip(high, low, strict=True))
    return differing / total if total else None


def _chosen(found: Float[np.ndarray, "steps replicas"]) -> tuple[Estimate, float, int]:
    """The extrapolated derivative, its error, and which step it is from, of differences by step."""
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
