"""How far a gradient can be trusted, and what ends the trust.

Three things do: the rounding errors of the run have grown until another precision gives another gradient;
the gradients of other starts of the same system scatter by more than their mean; a decision was so close to
its threshold that rounding made it. Each is looked for by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.base import Problem, Progress
from mdnum.gradients.diagnose.flips import MOST
from mdnum.gradients.diagnose.horizons import Horizons, first_difference, horizons, spread
from mdnum.gradients.diagnose.results import Limit, Trust
from mdnum.gradients.ensemble import replica
from mdnum.precision import PrecisionPolicy
from mdnum.rollout.engine import Engine
from mdnum.rollout.flips import PairRecorder
from mdnum.systems.build import Simulation

#: Relative difference of two precisions above which a gradient is not trusted.
TOLERANCE = 1e-2
#: Horizons that are compared.
POINTS = 40
ROUNDING, SCATTER, AMBIGUOUS = "rounding", "standard error", "ambiguous decision"


@dataclass(frozen=True)
class Shadow:
    """A run beside the run, whose rounding errors are others.

    Attributes:
        simulation: the same system.
        words: what is different about it.
        wider: whether its errors are smaller, and not only others of the same size.
    """

    simulation: Simulation
    words: str
    wider: bool


def shadow_of(simulation: Simulation, seed: int = 0) -> Shadow:
    """The run that a run is compared with.

    Where any role of a number is narrower than float64, all roles are float64. There is no wider hardware
    format than float64: such a run is compared with one whose start is moved by a rounding, which tells how
    much of its gradient is made of roundings, up to a factor of order one.
    """
    if simulation.policy != PrecisionPolicy():
        narrow = sorted(set(vars(simulation.policy).values()) - {"float64"})
        wide = replace(
            simulation,
            policy=PrecisionPolicy(),
            lattice=None,
            decider=replace(simulation.decider, dtype="float64", state="float64"),
        )
        return Shadow(wide, f"{' and '.join(narrow)} against float64", True)
    x = simulation.positions
    # of the largest coordinate: one of a coordinate near zero would be absorbed by the first step
    moved = x + np.spacing(np.abs(x).max()) * np.random.default_rng(seed).choice([-1.0, 1.0], x.shape)
    return Shadow(
        replace(simulation, positions=moved), "float64 against float64 from a start a rounding away", False
    )


def trust(
    problem: Problem,
    names: Sequence[str],
    *,
    tolerance: float = TOLERANCE,
    saltation: bool = True,
    replicas: int = 0,
    points: int = POINTS,
    budget: int = 2**29,
    progress: Progress | None = None,
) -> Trust:
    """The horizon up to which a gradient means something, and what limits it.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: parameters, full or short names; those of many entries (the start) are left out.
        tolerance: relative difference of two precisions that is put up with.
        saltation: whether flips count.
        replicas: starts for the standard error, this one and others with new velocities (`ensemble.replica`);
            0 leaves it out. Each is a run and a tangent pass.
        points: horizons that are compared, evenly spread.
        budget: bytes of each recorded run that are kept.
        progress: called with the steps done, all steps, and a phase in words.

    Raises:
        InputError: no such parameter, no pair potential, or no parameter of few entries.
        NumericalError: the run blew up.

    Error: horizons are resolved to the spacing of the points.
    """
    simulation = problem.simulation
    full = parameters.resolve(simulation, names)
    kept = [name for name in full if np.size(parameters.value(simulation, name)) <= MOST]
    if not kept:
        raise InputError(
            f"a trust horizon by {', '.join(full)} would need a tangent for each entry",
            remedy="Name a parameter of one entry too, such as dynamics.temperature",
        )
    if replicas == 1 or replicas < 0:
        raise InputError(f"replicas = {replicas}; one start has no standard error", remedy="Give 2 or more")
    if not 0 < tolerance < 1:
        raise InputError(f"tolerance = {tolerance:g}; expected between 0 and 1")
    at = spread(problem, points)

    def follow(one: Simulation, word: str) -> Horizons:
        def told(done: int, steps: int, phase: str) -> None:
            assert progress is not None
            progress(done, steps, f"{word}: {phase}")

        return horizons(
            replace(problem, simulation=one),
            kept,
            at,
            saltation=saltation,
            budget=budget,
            progress=None if progress is None else told,
        )

    own = follow(simulation, "the run")
    shadow = shadow_of(simulation)
    other = follow(shadow.simulation, "its shadow")
    apart = relative(own, other)
    limits = [
        _rounding(at, apart, tolerance, shadow, first_difference(own, other)),
        ambiguity(problem),
    ]
    scatter: dict[str, np.ndarray] = {}
    if replicas:
        made = [own, *(follow(replica(simulation, k), f"start {k + 1}") for k in range(1, replicas))]
        scatter = standard_error(made)
        limits.append(_scatter(at, scatter, replicas))
    else:
        limits.append(Limit(SCATTER, None, False, "Not looked at: it takes other starts of the same system."))
    looked = [one for one in limits if one.horizon is not None]
    shortest = min(looked, key=lambda one: one.horizon or 0)
    horizon = shortest.horizon or 0
    met = [one for one in looked if one.reached and one.horizon == horizon]
    limited = met[0].what if met else ""
    if limited:
        says = f"Trusted up to {horizon} of {problem.steps} steps; the limit is {limited}. {met[0].says}"
    else:
        free = " or ".join(one.what for one in looked)
        beside = "" if replicas else "; whether other starts agree was not looked at"
        says = f"Trusted over all {problem.steps} steps: not limited by {free}{beside}."
    return Trust(horizon, limited, tuple(limits), tolerance, shadow.words, at, apart, scatter, says)


def relative(a: Horizons, b: Horizons) -> dict[str, Float[np.ndarray, "points"]]:
    """Norm of the difference over the larger norm, by parameter and horizon; 0 where both are 0."""
    out = {}
    second = b.by_name()
    for name, first in a.by_name().items():
        one, two = (np.linalg.norm(part, axis=1) for part in (first, second[name]))
        size = np.maximum(one, two)
        apart = np.linalg.norm(first - second[name], axis=1)
        out[name] = np.where(size > 0, apart / np.where(size > 0, size, 1), 0.0)
    return out


def standard_error(made: Sequence[Horizons]) -> dict[str, Float[np.ndarray, "points"]]:
    """Standard error over the size of the mean, by parameter and horizon."""
    out = {}
    for name in made[0].by_name():
        each = np.stack([one.by_name()[name] for one in made])
        error = np.linalg.norm(each.std(axis=0, ddof=1), axis=1) / np.sqrt(len(made))
        mean = np.linalg.norm(each.mean(axis=0), axis=1)
        out[name] = np.where(mean > 0, error / np.where(mean > 0, mean, 1), np.where(error > 0, np.inf, 0.0))
    return out


def last_below(
    at: Int[np.ndarray, "points"], values: Sequence[Float[np.ndarray, "points"]], limit: float
) -> tuple[int, bool]:
    """The longest horizon up to which no value passes a limit for good, and whether one does.

    A single point beyond the limit does not end it: a gradient that changes its sign is small there, and any
    error large beside it.
    """
    beyond = ~(np.max(np.stack(list(values)), axis=0) <= limit)
    lasting = beyond & np.append(beyond[1:], True)
    if not lasting.any():
        return int(at[-1]), False
    first = int(np.argmax(lasting))
    return (int(at[first - 1]) if first else 0), True


def _rounding(at, apart, tolerance: float, shadow: Shadow, differ: int | None) -> Limit:
    horizon, reached = last_below(at, list(apart.values()), tolerance)
    flips = (
        "both runs flip alike all along" if differ is None else f"their flips first differ at step {differ}"
    )
    largest = max(float(np.max(values)) for values in apart.values())
    seen = (
        f"agree within {tolerance:g} up to step {horizon} and not beyond"
        if reached
        else f"agree within {max(largest, 0.0):.2g} all along"
    )
    return Limit(ROUNDING, horizon, reached, f"Gradients of {shadow.words} {seen}; {flips}.")


def _scatter(at, scatter, replicas: int) -> Limit:
    horizon, reached = last_below(at, list(scatter.values()), 1.0)
    seen = f"passes the mean beyond step {horizon}" if reached else "stays below the mean over all steps"
    return Limit(SCATTER, horizon, reached, f"The standard error of {replicas} starts {seen}.")


def ambiguity(problem: Problem) -> Limit:
    """The first decision of the run that another legitimate rounding could have made otherwise."""
    recorder = PairRecorder(problem.simulation)
    for segment in Engine(problem.simulation, problem.steps).segments():
        close = recorder.doubtful(segment)
        if len(close.step):
            step, i, j = int(close.step[0]), int(close.i[0]), int(close.j[0])
            return Limit(
                AMBIGUOUS,
                max(step - 1, 0),
                True,
                f"At step {step} the pair ({i}, {j}) is {abs(close.margin[0]):.2g} from its threshold, and "
                f"rounding is bounded by {close.bound[0]:.2g}.",
            )
    return Limit(
        AMBIGUOUS, problem.steps, False, "No decision of the run was within rounding of its threshold."
    )
