"""Many rollouts instead of one: the mean of a gradient over replicas, and how far it can be told from noise.

A replica is the same system with other velocities, and with another noise where there is a thermostat. Each
is a run with lists of its own, so replicas are made one after another, on as many devices as there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from mdnum.errors import InputError, NumericalError
from mdnum.gradients import parameters
from mdnum.gradients.base import Gradient, Method, Problem, Progress, check
from mdnum.gradients.symmetric import EventAware
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
    noise = np.random.default_rng((seed, simulation.system.spec.dynamics.seed)).standard_normal(
        (len(masses), 3)
    )
    v = noise * np.sqrt(kT / masses)[:, None]
    # a velocity that all atoms share is no temperature
    v -= masses @ v / masses.sum()
    made = replace(simulation, velocities=v)
    bath = simulation.integrator
    if isinstance(bath, Langevin):
        key = jax.random.fold_in(bath.key, seed)
        made = replace(made, integrator=eqx.tree_at(lambda one: one.key, bath, key))
    return settled(made, settle) if settle else made


def settled(simulation: Simulation, steps: int) -> Simulation:
    """The simulation where it is after so many steps, as a start.

    Raises:
        NumericalError: the run blew up.
    """
    *_, last = Engine(simulation, steps).segments()
    if last.closes in FAILURES:
        raise NumericalError(f"a replica ended in a {last.closes} at step {last.last}, before its start")
    x = unwrapped(
        np.asarray(simulation.cell.matrix),
        last.unsorted("x", last.rows - 1),
        last.unsorted("images", last.rows - 1),
    )
    v = last.unsorted("v", last.rows - 1)
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

    @property
    def told_from_zero(self) -> bool:
        """Whether the mean is longer than its standard error."""
        return bool(np.linalg.norm(self.mean) > np.linalg.norm(self.error))


@dataclass(frozen=True)
class Ensemble:
    """The mean over replicas of another method's gradient, at several horizons.

    Attributes:
        method: applied to each replica.
        replicas: their starts.
        halvings: the horizons are the steps asked for, and that many halves of halves of them.
    """

    method: Method = field(default_factory=EventAware)
    replicas: Replicas = field(default_factory=Replicas)
    halvings: int = 3

    @property
    def name(self) -> str:
        """Its word."""
        return "ensemble"

    @property
    def says(self) -> str:
        """Which derivative it gives."""
        return f"the mean over replicas of {self.method.says}"

    def why_not(self, problem: Problem, names: Sequence[str]) -> str | None:
        """Where the method itself does not apply, or replicas have no parameter in common."""
        own = [name for name in names if name.startswith("initial.")]
        if own:
            return f"every replica has {' and '.join(own)} of its own"
        return self.method.why_not(problem, names)

    def __call__(self, problem: Problem, names: Sequence[str], progress: Progress | None = None) -> Gradient:
        """The mean by the named parameters; standard errors and the horizon of noise are in the details."""
        names = check(self, problem, names)
        starts = self.replicas.of(problem)
        horizons = self._horizons(problem)
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
            for name in names:
                rows.append(_row(steps, name, Estimate.from_replicas([one.gradient[name] for one in found])))
        means = {name: Estimate.from_replicas([one.gradient[name] for one in found]) for name in names}
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
        return Gradient(self.name, self.says, float(values.mean), gradient, found[0].notes, details)

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


def _row(steps: int, name: str, one: Estimate) -> dict[str, Any]:
    return {
        "steps": steps,
        "name": name,
        "mean": float(np.linalg.norm(one.mean)),
        "error": float(np.linalg.norm(one.error)),
    }


def _lost(rows: Sequence[dict[str, Any]], name: str) -> int | None:
    """The first horizon from which on the standard error passes the mean; None where it does not."""
    mine = [row for row in rows if row["name"] == name]
    kept = [k for k, row in enumerate(mine) if row["error"] < row["mean"]]
    after = max(kept, default=-1) + 1
    return mine[after]["steps"] if after < len(mine) else None
