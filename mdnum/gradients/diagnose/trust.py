"""How far a gradient can be trusted, and what ends the trust.

Five things do: the rounding errors of the run have grown until another precision gives another gradient;
half the time step gives another gradient; a pair turned around so near its cutoff that another time step
would make it flip, or not, and its term weighs; a decision was so close to its threshold that rounding made
it; the gradients of other starts of the same system scatter by more than their mean. Each is looked for by
itself, and what was not looked at leaves the verdict undecided: no flip shows what did not flip, and no
rounding the time step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.base import Problem, Progress
from mdnum.gradients.diagnose.flips import MOST
from mdnum.gradients.diagnose.growth import CLOCK_STEPS, WORDS, GrowthWatch, gain
from mdnum.gradients.diagnose.horizons import (
    TIMESTEP,
    Horizons,
    first_difference,
    halved,
    horizons,
    spread,
)
from mdnum.gradients.diagnose.near import Near, Turns
from mdnum.gradients.diagnose.passes import Passed, passed
from mdnum.gradients.diagnose.results import Growth, Limit, Trust
from mdnum.gradients.ensemble import replica
from mdnum.gradients.tape import Stretch, pace_of
from mdnum.md.integrators import Langevin
from mdnum.precision import PrecisionPolicy
from mdnum.rollout.engine import Engine
from mdnum.rollout.flips import PairRecorder
from mdnum.systems.build import Simulation

#: Relative difference of two precisions above which a gradient is not trusted.
TOLERANCE = 1e-2
#: Horizons that are compared.
POINTS = 40
ROUNDING, SCATTER, AMBIGUOUS = "rounding", "standard error", "ambiguous decision"
STEP, NEAR, FLIPS = "time step", "near miss", "flips left out"
#: A gradient that grew so many times more than in proportion to the steps is one of a start among many, and
#: whether others agree must be looked at.
GROWN = 10.0
#: Share of the weight of all flips above which what the guard leaves out matters.
LEFT_OUT = 0.01
#: Bytes of tangents of one stretch that are looked through.
_MEMORY = 2**30
TRUSTED, LIMITED, UNDECIDED = "trusted", "limited", "undecided"


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
    half_step: bool = True,
    points: int = POINTS,
    budget: int = 2**29,
    made: Passed | None = None,
    near: Near | None = None,
    growth: Growth | None = None,
    progress: Progress | None = None,
) -> Trust:
    """The horizon up to which a gradient means something, and what limits it.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: parameters, full or short names; those of many entries (the start) are left out.
        tolerance: relative difference of two precisions, or of a time step and its half, that is put up with.
        saltation: whether flips count.
        replicas: starts for the standard error, this one and others with new velocities (`ensemble.replica`);
            0 leaves it out. Each is a run and a tangent pass.
        half_step: make the run and its gradient at half the time step too; else nothing is called trusted.
        points: horizons that are compared, evenly spread.
        budget: bytes of each recorded run that are kept.
        made, near, growth: the event-aware reverse pass with its turning points, and the growth of the
            gradient, where they have been made; else they are made.
        progress: called with the steps done, all steps, and a phase in words.

    Raises:
        InputError: no such parameter, no pair potential, or no parameter of few entries.
        NumericalError: the run blew up.

    Error: horizons are resolved to the spacing of the points. Where a pair turns around is the cubic through
    two steps' distances and rates. Terms of near misses are those of the whole run.
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
    if made is None or growth is None:
        near = Near(simulation, pace_of(problem.loss, problem.steps)) if saltation else None
        grows = GrowthWatch(simulation, full, problem.steps)
        made = passed(
            problem, full, saltation=saltation, budget=budget, progress=progress,
            watches=[grows, *([] if near is None else [near.reverse])],
        )  # fmt: skip
        growth = grows.result(made.gradient)
    columns = sum(int(np.size(parameters.value(simulation, name))) for name in kept)
    unseen = "" if near is not None else "they were not collected with the reverse pass"
    if near is not None and (needed := 48 * near.rows * simulation.atoms * columns) > _MEMORY:
        near, unseen = None, f"tangents by {columns} numbers would take {needed / 2**30:.3g} GiB at a time"

    def follow(one: Problem, word: str, at=at, each=None, watch=None) -> Horizons:
        def told(done: int, steps: int, phase: str) -> None:
            assert progress is not None
            progress(done, steps, f"{word}: {phase}")

        return horizons(
            one, kept, at, saltation=saltation, budget=budget, each=each, watch=watch,
            progress=None if progress is None else told,
        )  # fmt: skip

    def beside(per: int) -> Callable[[Stretch], None] | None:
        return None if near is None else partial(near.compared, per=per)

    own = follow(problem, "the run", watch=None if near is None else near.tangents)
    shadow = shadow_of(simulation)
    other = follow(replace(problem, simulation=shadow.simulation), "its shadow", each=beside(1))
    apart = relative(own, other)
    shorter, why = None, no_half_step(simulation) or "not asked for"
    if half_step and not no_half_step(simulation):
        shorter = _per_step(follow(halved(problem), "half the time step", 2 * at, beside(2)))
    steps = {} if shorter is None else relative(own, shorter)
    turns = None if near is None or shorter is None else near.turns(columns)
    unseen = unseen or ("how far they may reach takes half the time step" if shorter is None else "")
    limits = [
        _rounding(at, apart, tolerance, shadow, first_difference(own, other)),
        _time_step(at, own, shorter, steps, tolerance, why),
        _missed(problem, own, turns, unseen, made, tolerance, saltation),
        ambiguity(problem),
    ]
    scatter: dict[str, np.ndarray] = {}
    if replicas:
        starts = [replace(problem, simulation=replica(simulation, k)) for k in range(1, replicas)]
        scatter = standard_error([own, *(follow(one, f"start {k + 2}") for k, one in enumerate(starts))])
        limits.append(_scatter(at, scatter, replicas))
    else:
        limits.append(Limit(SCATTER, None, False, "Not looked at: it takes other starts of the same system."))
    skipped = [name for name in full if name not in kept]
    chaotic = growth.word != WORDS[0] or gain(growth) > GROWN * max(1.0, problem.steps / CLOCK_STEPS)
    verdict, horizon, limited, unknown = verdict_of(limits, problem.steps, chaotic, gain(growth), skipped)
    digits = {} if shorter is None else {name: _digits(*steps[name][-2:], apart[name][-1]) for name in kept}
    half = {} if shorter is None else {name: part[-1] for name, part in shorter.by_name().items()}
    says = _says(verdict, horizon, limited, unknown, limits, problem.steps, bool(replicas))
    return Trust(
        verdict, horizon, limited, tuple(limits), unknown, tolerance, shadow.words, at, apart, steps, scatter,
        half, digits, turns, tuple(map(str, own.columns)), says,
    )  # fmt: skip


def no_half_step(simulation: Simulation) -> str:
    """Why a run cannot be compared with one at half the time step; "" where it can."""
    if isinstance(simulation.integrator, Langevin):
        return "the noise of a thermostat is another at half the step, so that one run has no counterpart"
    return ""


def verdict_of(
    limits: Sequence[Limit], steps: int, chaotic: bool, grown: float, skipped: Sequence[str]
) -> tuple[str, int, str, tuple[str, ...]]:
    """The verdict, how far no limit was met, which limit was met first, and what is not known."""
    looked = [one for one in limits if one.horizon is not None]
    horizon = min((one.horizon or 0 for one in looked), default=0)
    met = [one.what for one in looked if one.reached and one.horizon == horizon]
    unknown = [
        f"{one.what} ({one.says[:1].lower()}{one.says[1:].rstrip('.')})"
        for one in limits
        if one.horizon is None and one.what != SCATTER
    ]
    if chaotic and any(one.what == SCATTER and one.horizon is None for one in limits):
        unknown.append(f"whether other starts agree, of a gradient that grew {grown:.3g}-fold")
    if skipped:
        unknown.append(f"the derivative by {', '.join(skipped)}, of too many entries")
    verdict = LIMITED if met else UNDECIDED if unknown else TRUSTED
    return verdict, horizon if met else steps, met[0] if met else "", tuple(unknown)


def _says(
    verdict: str, horizon: int, limited: str, unknown: Sequence[str], limits: Sequence[Limit], steps: int,
    replicas: bool,
) -> str:  # fmt: skip
    open_ = f" Not known: {'; '.join(unknown)}." if unknown else ""
    free = " or ".join(one.what for one in limits if one.horizon is not None and not one.reached)
    if verdict == LIMITED:
        why = next(one.says for one in limits if one.what == limited)
        until = f"beyond step {horizon} of {steps}" if horizon else f"at any of {steps} steps"
        also = [one for one in limits if one.reached and one.what != limited]
        further = "".join(f" Nor beyond step {one.horizon} for {one.what}: {one.says}" for one in also)
        return f"Not trusted {until}; the limit is {limited}. {why}{further}{open_}"
    if verdict == UNDECIDED:
        return f"Undecided: not limited by {free}, over all {steps} steps.{open_}"
    starts = "" if replicas else "; of this start, others were not looked at"
    return f"Trusted over all {steps} steps: not limited by {free}{starts}."


def _per_step(found: Horizons) -> Horizons:
    """Of a run at half the time step: horizons and derivatives in steps of the whole one."""
    factor = np.array([0.5 if column.name == TIMESTEP else 1.0 for column in found.columns])
    return replace(found, at=found.at // 2, gradient=found.gradient * factor)


def _digits(*relative: float) -> int:
    """Digits that two derivatives share, by the larger of their relative differences."""
    worst = max(relative)
    if not np.isfinite(worst):
        return 0
    return int(np.clip(np.floor(-np.log10(max(worst, 1e-16))), 0, 15))


def _time_step(at, own: Horizons, shorter: Horizons | None, steps, tolerance: float, why: str) -> Limit:
    if shorter is None:
        return Limit(STEP, None, False, f"Half the time step was not looked at: {why}.")
    horizon, reached = last_agreeing(at, list(steps.values()), tolerance)
    told = "; ".join(
        f"by {column} {own.gradient[-1, k]:.4g} and {shorter.gradient[-1, k]:.4g}"
        for k, column in list(enumerate(own.columns))[:4]
    )
    seen = (
        f"agree within {tolerance:g} up to step {horizon} and not beyond"
        if reached
        else f"agree within {max(float(np.max(one)) for one in steps.values()):.2g} all along"
    )
    return Limit(
        STEP, horizon, reached, f"Gradients at the time step and at half of it {seen} (at the end {told})."
    )


def _missed(
    problem: Problem,
    own: Horizons,
    turns: Turns | None,
    unseen: str,
    made: Passed,
    tolerance: float,
    saltation: bool,
) -> Limit:
    """Where a turning point within reach of the cutoff has a term that weighs; `unseen` says why it was not
    looked at."""
    if not np.any(np.asarray(problem.simulation.jumps())):
        return Limit(
            NEAR,
            problem.steps,
            False,
            "Nothing jumps at a cutoff: a pair that turns around near it adds nothing.",
        )
    if not saltation:
        first = min((int(one.step[0]) for one in own.ledgers if len(one)), default=None)
        if first is None:
            return Limit(
                NEAR, None, False, "Only event-aware looks at pairs that turn around near the cutoff."
            )
        return Limit(
            FLIPS, max(first - 1, 0), True,
            f"The force jumps at the cutoff, which pairs cross from step {first} on: that is left out.",
        )  # fmt: skip
    left = _left_out(made)
    if left is not None:
        return left
    if turns is None:
        return Limit(NEAR, None, False, f"Pairs that turn around near it were not looked at: {unseen}.")
    kept = turns.within
    size = np.concatenate(
        [np.full(part.shape[1], np.linalg.norm(part[-1])) for part in own.by_name().values()]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        # a term that is not known weighs
        share = np.where(turns.term == 0, 0.0, np.nan_to_num(turns.term / size, nan=np.inf))
    weighs = np.sqrt(np.cumsum(np.square(share), axis=0))
    over = np.flatnonzero(~(weighs <= tolerance).all(axis=1))
    if not kept.any():
        near = f"the nearest of {len(turns)} looked at" if len(turns) else "none turned around near it"
        return Limit(NEAR, problem.steps, False, f"No pair turned around within reach of its cutoff: {near}.")
    heavy, column = np.unravel_index(int(np.argmax(share)), share.shape)
    gap, held, count = turns.gap[heavy], size[column], int(kept.sum())
    side = "short of" if gap > 0 else f"{'unseen between two steps, ' * bool(turns.unseen[heavy])}beyond"
    part = f"{100 * share[heavy, column]:.3g} % of" if held else f"{turns.term[heavy, column]:.3g} to"
    told = (
        f"{count} pair{'' if count == 1 else 's'} turned around within reach of the cutoff; the heaviest, "
        f"({turns.i[heavy]}, {turns.j[heavy]}) before step {turns.step[heavy]}, {abs(gap):.2g} {side} it, "
        f"and half the time step or another rounding moves it by up to {turns.reach[heavy]:.2g}: its "
        f"crossings {'would add' if gap > 0 else 'add'} some {part} the derivative by {own.columns[column]}"
    )
    if not len(over):
        return Limit(NEAR, problem.steps, False, f"{told}.")
    return Limit(NEAR, max(int(turns.step[over[0]]) - 1, 0), True, f"{told}.")


def _left_out(made: Passed) -> Limit | None:
    """Flips slower than the guard, where they would have weighed."""
    slow = [one for one in made.crossings if one.grazing.any()]
    left = sum(float(np.nansum(np.abs(one.weight[one.grazing]))) for one in slow)
    applied = sum(float(np.sum(np.abs(one.weight[~one.grazing]))) for one in made.crossings)
    if not left > LEFT_OUT * (left + applied):
        return None
    first = min(int(one.ledger.step[one.grazing].min()) for one in slow)
    count = sum(int(one.grazing.sum()) for one in slow)
    return Limit(
        FLIPS, max(first - 1, 0), True,
        f"{count} flips graze and are left out, the first at step {first}, with "
        f"{100 * left / (left + applied):.3g} % of the weight of all flips.",
    )  # fmt: skip


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


def last_agreeing(
    at: Int[np.ndarray, "points"], values: Sequence[Float[np.ndarray, "points"]], limit: float
) -> tuple[int, bool]:
    """The longest horizon at which no value passes a limit, and whether it is short of the last one.

    Shorter horizons count for nothing: the error of a time step does not only grow, and what few flips add is
    coarse where there is little else. A horizon alone among others beyond the limit agrees by chance.
    """
    within = np.max(np.stack(list(values)), axis=0) <= limit
    if len(within) > 1:
        within &= np.append(False, within[:-1]) | (np.append(within[1:], False) & (at < at[-1]))
    where = np.flatnonzero(within)
    return (int(at[where[-1]]) if len(where) else 0), not within[-1]


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
