"""The largest number of steps (horizon) for which a gradient can be trusted.

Each of five limits can end the trust in a gradient. (1) Another precision gives a different gradient. (2)
Half the time step gives a different gradient. (3) A pair turned around close to its cutoff, so another time
step could add or remove a flip. (4) Rounding determined a decision close to its threshold. (5) Gradients from
other initial states scatter by more than their mean. If one of the five limits was not examined, the verdict
is undecided.

One run with its tangents (derivatives in forward mode) gives the gradients for all horizons.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mdnum.errors import InputError
from mdnum.gradients import parameters
from mdnum.gradients.diagnose.growth import CLOCK_STEPS, WORDS, GradientGrowth, GrowthWatch
from mdnum.gradients.diagnose.near import FINER, Near, Turns
from mdnum.gradients.differences import replica
from mdnum.gradients.losses import Loss
from mdnum.gradients.parameters import ParameterEntry, columns_of
from mdnum.gradients.problem import Problem, Progress, in_phase
from mdnum.gradients.recorded import GUARD, MOST, ReversePass, joined, passed, radial_speed
from mdnum.gradients.tangents import StretchTangents, tangents
from mdnum.gradients.tape import RunTape, TapeStretch, pace_of
from mdnum.numerics import PrecisionPolicy
from mdnum.rollout.engine import Engine
from mdnum.rollout.flips import PairRecorder
from mdnum.systems.simulation import Simulation

#: Parameter whose derivatives are twice as large at half the time step.
TIMESTEP = "dynamics.timestep"
#: Relative difference between two precisions, or two time steps, above which a derivative is not trusted, and
#: the limit for near misses relative to it. Trusted derivatives were within 5 % of those of the exact motion.
TOLERANCE = 2e-2
#: Number of horizons that are compared.
POINTS = 40
ROUNDING, SCATTER, AMBIGUOUS = "rounding", "standard error", "ambiguous decision"
STEP, NEAR, FLIPS = "time step", "near miss", "flips left out"
#: Open questions in addition to limits that were not examined: whether other starting states agree, for a
#: gradient that grew chaotically; and derivatives with respect to parameters with too many entries.
STARTS, SKIPPED, NOT_FINITE = "other starts", "parameters of many entries", "finite derivatives"
#: Growth of a gradient, relative to growth in proportion to the number of steps, above which the scatter over
#: starting states must be examined.
GROWN = 10.0
#: Largest number of bytes of tangents of one stretch that are examined.
_MEMORY = 2**30
TRUSTED, LIMITED, UNDECIDED = "trusted", "limited", "undecided"


class Shorter(Loss):
    """Losses of several runs that have the same start and different last steps (horizons)."""

    name = "shorter"
    inner: Loss = eqx.field(kw_only=True)  # the loss
    # whether the loss of a run of each horizon looks at each step
    table: Bool[Array, "rows horizons"] = eqx.field(kw_only=True)
    # steps that are made for each of these; it looks at the last of them
    per: Int[Array, ""] = eqx.field(kw_only=True)

    def looks_at(self, steps, last):
        per = int(self.per)
        seen = np.asarray(self.table).max(axis=1)[np.minimum(steps // per, len(self.table) - 1)]
        return seen & (steps % per == 0)

    def observe(self, frame, origin, around):
        step = frame.step // self.per
        whole = around._replace(timestep=self.per.astype(jnp.float64) * around.timestep)
        seen = self.inner.observe(frame._replace(step=step), origin, whole)
        wanted = jnp.asarray(self.table)[step]

        def spread(leaf):
            leaf = jnp.asarray(leaf)
            where = wanted.reshape(-1, *(1,) * leaf.ndim)
            return jnp.where(where, leaf[None], jnp.zeros((), leaf.dtype))

        return jax.tree.map(spread, seen)

    def value(self, total, frames):
        """Return the loss of the longest run."""
        return self.of(total, self.table.shape[1] - 1)

    def of(self, total: Any, k: int) -> Float[Array, ""]:
        """Return the loss at the horizon with index k."""
        frames = int(np.asarray(self.table)[:, k].sum())
        return self.inner.value(jax.tree.map(lambda leaf: leaf[k], total), frames)


def shorter(problem: Problem, at: Int[np.ndarray, "points"], per: int = 1) -> Problem:
    """Return a problem with losses at several horizons. `per` short steps replace each time step.

    Args:
        at: horizons, rising; the last horizon is the length of the run.
    """
    rows = np.arange(int(at[-1]) + 1)
    table = np.stack([problem.loss.looks_at(rows, int(h)) & (rows <= h) for h in at], axis=1)
    simulation = problem.simulation
    if per > 1:
        timestep = parameters.value(simulation, TIMESTEP) / per
        simulation = parameters.with_values(simulation, {TIMESTEP: timestep})
    loss = Shorter(inner=problem.loss, table=jnp.asarray(table), per=jnp.asarray(per))
    return Problem(simulation, loss, per * int(at[-1]))


@dataclass(frozen=True)
class Horizons:
    """Losses and gradients of runs with the same start and different lengths."""

    at: Int[np.ndarray, "points"]  # horizons, steps
    columns: tuple[ParameterEntry, ...]  # the numbers that are differentiated by
    value: Float[np.ndarray, "points"]  # the loss, by horizon
    gradient: Float[np.ndarray, "points columns"]  # by horizon and column
    flips: Int[np.ndarray, "flips 4"]  # step, pair and whether it entered, of each flip of the run, in order

    def by_name(self) -> dict[str, Float[np.ndarray, "points entries"]]:
        """Return the gradient at every horizon, as one array per parameter."""
        names = [column.name for column in self.columns]
        return {
            name: self.gradient[:, [k for k, one in enumerate(names) if one == name]]
            for name in dict.fromkeys(names)
        }


def spread(problem: Problem, points: int) -> Int[np.ndarray, "points"]:
    """Return evenly spaced horizons (steps) for which the loss uses at least one frame."""
    steps = np.unique(np.round(np.linspace(0, problem.steps, points + 1)).astype(np.int64))[1:]

    def looks(h: int) -> bool:
        try:
            return bool(problem.loss.looks_at(np.arange(h + 1), h).any())
        except InputError:
            # a slope or an integral that needs a longer run
            return False

    return np.array([h for h in steps if looks(int(h))], np.int64)


def horizons(
    problem: Problem,
    names: Sequence[str],
    at: Int[np.ndarray, "points"],
    *,
    per: int = 1,
    saltation: bool = True,
    each: Callable[[TapeStretch], None] | None = None,
    watch: Callable[[StretchTangents], None] | None = None,
    progress: Progress | None = None,
) -> Horizons:
    """Compute loss and gradient at several horizons of a run.

    Args:
        problem: of a pair potential. names: full names of the parameters; each entry takes one tangent.
        at: horizons, rising; the last horizon is the length of the run. saltation: whether flips count.
        per: number of steps that replace one step of the run. The derivative by the time step is that by the
            length of all of them together.
        each: called with every stretch when it is complete.
        watch: called with the tangents of every stretch, including those of each step.

    Raises:
        InputError: no pair potential. NumericalError: the run blew up.

    Error: that of tangents: a rounding error times their growth.
    """
    made = shorter(problem, at, per)
    simulation, loss = made.simulation, made.loss
    assert isinstance(loss, Shorter)
    tape = RunTape(simulation, loss, made.steps, flips=True, each=each, progress=in_phase(progress, "run"))
    total: Any = None
    flips = []
    for part in tangents(
        tape, names, saltation=saltation, guard=GUARD * radial_speed(simulation), states=watch is not None,
        progress=in_phase(progress, "tangents"),
    ):  # fmt: skip
        total = part.total
        if watch is not None:
            watch(part)
        ledger = part.stretch.ledger
        assert ledger is not None
        flips.append(np.stack([ledger.step, ledger.i, ledger.j, ledger.entered], axis=1).astype(np.int64))
    values, slopes = [], []
    for k in range(len(at)):
        value, push = jax.linearize(lambda total, k=k: loss.of(total, k), tape.total)
        values.append(float(value))
        slopes.append(np.asarray(jax.vmap(push)(total), np.float64))
    columns = columns_of(simulation, names)
    factor = np.array([1 / per if column.name == TIMESTEP else 1.0 for column in columns])
    return Horizons(at, columns, np.array(values), np.stack(slopes) * factor, np.concatenate(flips))


def first_difference(a: Horizons, b: Horizons) -> int | None:
    """Return the first step at which the flips of two runs differ. None if all are equal."""
    common = min(len(a.flips), len(b.flips))
    differ = np.flatnonzero((a.flips[:common] != b.flips[:common]).any(axis=1))
    k = int(differ[0]) if len(differ) else common
    return min((int(one.flips[k, 0]) for one in (a, b) if k < len(one.flips)), default=None)


@dataclass(frozen=True)
class Limit:
    """One limit on the number of steps for which a gradient can be trusted."""

    what: str  # ROUNDING, STEP, NEAR, FLIPS, AMBIGUOUS or SCATTER
    # the longest horizon, in steps, at which it did no harm; None where it was not examined
    horizon: int | None
    reached: bool  # whether it was met within the horizon asked for; else trust holds at least that far
    code: str  # what was seen, or why it was not examined
    values: dict[str, Any] = field(default_factory=dict)  # the numbers of it


@dataclass(frozen=True)
class Judgment:
    """The trust horizon of derivatives with respect to one or all parameters, and its limits."""

    # "trusted" where every limit was examined and none was met, "limited" where one was met, else "undecided"
    verdict: str
    horizon: int  # the shortest of the limits that were examined, steps
    limited_by: str  # which it is; else empty
    unknown: tuple[str, ...]  # what was not examined and is needed
    limits: tuple[Limit, ...]  # all of them


@dataclass(frozen=True)
class Trust(Judgment):
    """Number of steps for which a gradient can be trusted, with a verdict for each parameter."""

    by: dict[str, Judgment]  # of each parameter, by full name
    tolerance: float  # relative difference above which two precisions, or two time steps, disagree
    # by `horizon`, for each parameter the relative difference of two precisions (`relative.`), of the time
    # step and its half (`step.`), and standard error over the mean (`error.`), where examined
    table: dict[str, np.ndarray]
    half: dict[str, Float[np.ndarray, "entries"]]  # the gradient at half the time step, by parameter
    digits: dict[str, int]  # digits that half the time step and another rounding leave, by parameter
    turns: Turns | None  # pairs that turned around near their cutoff, where that was examined
    columns: tuple[str, ...]  # the numbers whose terms these have


def shadow_of(simulation: Simulation, seed: int = 0) -> tuple[Simulation, tuple[str, ...]]:
    """Return a simulation that rounds differently, and the formats narrower than float64.

    A run in formats narrower than float64 is compared with a float64 run. No hardware format is wider than
    float64. A float64 run is compared with one whose initial state is shifted by one rounding error. The
    shift shows the effect of rounding on the gradient, up to a factor of order one.
    """
    if simulation.policy != PrecisionPolicy():
        return simulation.with_policy(), tuple(sorted(set(vars(simulation.policy).values()) - {"float64"}))
    x = simulation.positions
    # of the largest coordinate: one of a coordinate near zero would be absorbed by the first step
    moved = x + np.spacing(np.abs(x).max()) * np.random.default_rng(seed).choice([-1.0, 1.0], x.shape)
    return replace(simulation, positions=moved), ()


def trust(
    problem: Problem,
    names: Sequence[str],
    *,
    tolerance: float = TOLERANCE,
    saltation: bool = True,
    replicas: int = 0,
    half_step: bool = True,
    points: int = POINTS,
    made: ReversePass | None = None,
    near: Near | None = None,
    growth: GradientGrowth | None = None,
    progress: Progress | None = None,
) -> Trust:
    """Find the number of steps (horizon) up to which a gradient can be trusted.

    Args:
        problem: the loss of a rollout of a pair potential.
        names: parameters; those with many entries (the start) are left out.
        tolerance: acceptable relative difference between two precisions, or between a time step and its half.
        saltation: whether flips count. points: number of horizons that are compared, evenly spread.
        replicas: starts for the standard error, each a run and a pass of tangents; 0 leaves it out.
        half_step: whether to repeat run and gradient at half the time step; otherwise nothing is called
            trusted.
        made, near, growth: the event-aware reverse pass with its turning points, and the growth of the
            gradient, if already computed.

    Raises:
        InputError: a parameter does not exist, all parameters have many entries, or no pair potential.
        NumericalError: the run blew up.

    Error: horizons are resolved to the spacing of the points. Turning points are located on the cubic through
    two steps' distances and rates. Terms of near misses are computed for the whole run.
    """
    simulation = problem.simulation
    full = parameters.resolve(simulation, names)
    kept = [name for name in full if np.size(parameters.value(simulation, name)) <= MOST]
    if not kept:
        raise InputError(
            f"the parameter {', '.join(full)} has too many entries to compute a trust horizon for each",
            remedy="Give a scalar parameter, such as dynamics.temperature",
        )
    if replicas == 1 or replicas < 0:
        raise InputError(
            f"replicas = {replicas}; standard errors need at least 2 replicas", remedy="Give 0, 2 or more"
        )
    if not 0 < tolerance < 1:
        raise InputError(f"tolerance = {tolerance:g}; expected a relative difference between 0 and 1")
    at = spread(problem, points)
    if made is None or growth is None:
        near = Near(simulation, pace_of(problem.loss, problem.steps)) if saltation else None
        grows = GrowthWatch(simulation, full, problem.steps)
        watches = [grows, *([] if near is None else [near.reverse])]
        made = passed(problem, full, saltation=saltation, watches=watches, progress=progress)
        growth = grows.result(made.gradient)
    columns = sum(int(np.size(parameters.value(simulation, name))) for name in kept)
    needed = 0 if near is None else 48 * near.rows * simulation.atoms * columns
    if needed > _MEMORY:
        near = None

    def follow(one: Problem, word: str, per: int = 1, each=None, watch=None) -> Horizons:
        def report(done: int, steps: int, phase: str) -> None:
            if progress is not None:
                progress(done, steps, f"{word}: {phase}")

        if near is not None and watch is None:
            # one program for all of them
            watch = _unseen
        return horizons(one, kept, at, per=per, saltation=saltation, each=each, watch=watch, progress=report)

    def beside(per: int):
        return None if near is None else partial(near.compared, per=per)

    own = follow(problem, "the run", watch=None if near is None else near.tangents)
    shadow, narrow = shadow_of(simulation)
    other = follow(replace(problem, simulation=shadow), "its shadow", each=beside(1))
    differing = relative(own, other)
    noisy = no_half_step(simulation)
    finer = None
    if half_step and not noisy:
        finer = follow(problem, "half the time step", 2, beside(2))
        if near is not None and len(near.turns(columns)):
            fine, phase = shorter(problem, at[-1:], FINER), in_phase(progress, "shorter steps")
            RunTape(fine.simulation, fine.loss, fine.steps, budget=0, each=beside(FINER), progress=phase)
    steps = {} if finer is None else relative(own, finer)
    turns = None if near is None or finer is None else near.turns(columns)
    unseen = ("half-step", {}) if finer is None else ("memory", {"bytes": needed})
    roundings = {"narrow": " and ".join(narrow) or "float64", "first": first_difference(own, other)}
    scatter: dict[str, np.ndarray] = {}
    if replicas:
        starts = [replace(problem, simulation=replica(simulation, k)) for k in range(1, replicas)]
        scatter = standard_error([own, *(follow(one, f"start {k + 2}") for k, one in enumerate(starts))])
    moved, ambiguous, chaotic = near and near.moved, ambiguity(problem), grew(growth)

    def judged(*chosen: str) -> Judgment:
        """Return the verdict on the derivatives with respect to the chosen parameters."""
        apart, halved, scattered = (
            {name: one[name] for name in chosen if name in one} for one in (differing, steps, scatter)
        )
        limits = (
            _compared(ROUNDING, last_below(at, apart, tolerance), apart, tolerance, roundings),
            _compared(STEP, last_agreeing(at, halved, tolerance), halved, tolerance, {
                "largest": max(float(np.max(one[-2:])) for one in halved.values())
            }) if halved
            else Limit(STEP, None, False, "noise" if noisy else "not requested"),
            _missed(problem, own, turns, unseen, made, moved, tolerance, saltation, chosen), ambiguous,
            Limit(SCATTER, *last_below(at, scattered, 1.0), "scatter", {"replicas": replicas}) if scattered
            else Limit(SCATTER, None, False, "not requested"),
        )  # fmt: skip
        open_ = chosen == tuple(kept) and len(kept) < len(full)
        return Judgment(*verdict_of(limits, problem.steps, chaotic, open_), limits)

    whole, skipped = judged(*kept), Judgment(UNDECIDED, problem.steps, "", (SKIPPED,), ())
    by = {name: judged(name) if name in kept else skipped for name in full}
    # the last two horizons, so that none agrees by chance
    digits = {name: _digits(*one[-2:], differing[name][-1]) for name, one in steps.items()}
    half = {} if finer is None else {name: part[-1] for name, part in finer.by_name().items()}
    table = {"horizon": at}
    for key, values in (("relative", differing), ("step", steps), ("error", scatter)):
        table |= {f"{key}.{name}": column for name, column in values.items()}
    return Trust(
        **vars(whole), by=by, tolerance=tolerance, table=table, half=half, digits=digits, turns=turns,
        columns=tuple(map(str, own.columns)),
    )  # fmt: skip


def grew(growth: GradientGrowth) -> bool:
    """Return whether a gradient grew so much that other initial states may give another one."""
    # over the first horizons all of them grow: velocities turn into lengths, and averages gain frames
    size = growth.table["size"][min(CLOCK_STEPS, len(growth.table["size"]) - 1) :]
    there = size[np.isfinite(size) & (size > 0)]
    gain = there.max() / there[0] if len(there) else 1.0
    return growth.word != WORDS[0] or bool(gain > GROWN * max(1.0, len(size) / CLOCK_STEPS))


def no_half_step(simulation: Simulation) -> bool:
    """Return whether half the time step would give a thermostat different noise."""
    return simulation.integrator.random is not None


def verdict_of(
    limits: Sequence[Limit], steps: int, chaotic: bool, skipped: bool
) -> tuple[str, int, str, tuple[str, ...]]:
    """Return the verdict, the horizon, the first limit reached, and the unexamined limits."""
    examined = [one for one in limits if one.horizon is not None]
    horizon = min((one.horizon or 0 for one in examined), default=0)
    met = [one.what for one in examined if one.reached and one.horizon == horizon]
    missing = [one.what for one in limits if one.horizon is None]
    unknown = [what for what in missing if what != SCATTER]
    if chaotic and SCATTER in missing:
        unknown.append(STARTS)
    if skipped:
        unknown.append(SKIPPED)
    verdict = LIMITED if met else UNDECIDED if unknown else TRUSTED
    return verdict, horizon if met else steps, met[0] if met else "", tuple(unknown)


def _unseen(part: StretchTangents) -> None:
    """Ignore the tangents of a stretch of steps; this callback does nothing."""


def _digits(*relative: float) -> int:
    """From the largest relative difference, compute the number of decimal digits that agree."""
    worst = max(relative)
    if not np.isfinite(worst):
        return 0
    return int(np.clip(np.floor(-np.log10(max(worst, 1e-16))), 0, 15))


def _compared(what: str, agreed: tuple[int, bool], differing, tolerance: float, values) -> Limit:
    horizon, reached = agreed
    largest = max(float(np.max(one)) for one in differing.values())
    code = "disagree" if reached else "agree"
    return Limit(what, horizon, reached, code, {"tolerance": tolerance, "largest": largest, **values})


def _missed(
    problem: Problem, own: Horizons, turns: Turns | None, unseen, made: ReversePass, moved, tolerance: float,
    saltation: bool, names: Sequence[str],
) -> Limit:  # fmt: skip
    """Find the last step up to which omitted flips and near misses hardly affect a gradient."""
    if not np.any(np.asarray(problem.simulation.jumps())):
        return Limit(NEAR, problem.steps, False, "no jump")
    if not saltation:
        if not len(own.flips):
            return Limit(NEAR, None, False, "steps alone")
        first = int(own.flips[0, 0])
        return Limit(FLIPS, max(first - 1, 0), True, "steps alone", {"first": first})
    chosen = np.array([column.name in names for column in own.columns])
    whole = own.by_name()
    size = np.array([np.linalg.norm(whole[column.name][-1]) for column in own.columns])[chosen]
    left = _left_out(made, np.concatenate(moved)[:, chosen], size, tolerance) if moved else None
    if left is not None:
        return left
    if turns is None:
        return Limit(NEAR, None, False, *unseen)
    if not np.any(turns.term):
        return Limit(NEAR, problem.steps, False, "none within reach", {"turns": len(turns)})
    table, term = turns.table, turns.term[:, chosen]
    share, weighs = _shares(term, size)
    over = np.flatnonzero(~(weighs <= tolerance).all(axis=1))
    k, column = np.unravel_index(int(np.argmax(share)), share.shape)
    values = {
        "count": int(turns.within.sum()), **{name: int(table[name][k]) for name in ("i", "j", "step")},
        "gap": float(abs(turns.gap[k])), "reach": float(turns.reach[k]), "term": float(term[k, column]),
        "share": float(share[k, column]), "column": str(own.columns[np.flatnonzero(chosen)[column]]),
    }  # fmt: skip
    code = "short of" if turns.gap[k] > 0 else "beyond"
    if table["unseen"][k] or abs(turns.gap[k]) > turns.reach[k]:
        code = "between two steps" if table["unseen"][k] else "elsewhere"
    horizon = max(int(table["step"][over[0]]) - 1, 0) if len(over) else problem.steps
    return Limit(NEAR, horizon, bool(len(over)), code, values)


def _shares(term: Float[np.ndarray, "terms columns"], size: Float[np.ndarray, "columns"]):
    """Divide contributions by `size`. Return them, and the root of their cumulative sum of squares."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # a term that is not known weighs
        share = np.where(term == 0, 0.0, np.nan_to_num(np.abs(term) / size, nan=np.inf))
        return share, np.sqrt(np.cumsum(np.square(share), axis=0))


def _left_out(
    made: ReversePass, moved: Float[np.ndarray, "flips columns"], size: Float[np.ndarray, "columns"],
    tolerance: float,
) -> Limit | None:  # fmt: skip
    """Return a limit if grazing flips or jumps of the loss contribute too much."""
    tape, met = made.tape, made.crossings[::-1]
    energy, virial, speed, weight, slow = (
        joined(met, name) for name in ("energy", "virial", "speed", "weight", "grazing")
    )
    jump = np.dot(tape.jumps_unseen, [energy, virial]) / speed @ moved
    share = _shares(jump[None] / (tape.steps * float(tape.simulation.integrator.timestep)), size)[0].max()
    if share > tolerance:
        return Limit(FLIPS, 0, True, "single frames", {"flips": len(speed), "share": float(share)})
    weighs = _shares(moved[slow] * weight[slow, None], size)[1].max(axis=1)
    if not weighs.max(initial=0.0) > tolerance:
        return None
    step = joined(met, "step", ledger=True)[slow]
    values = {"count": int(slow.sum()), "first": int(step[0]), "share": float(weighs[-1])}
    return Limit(FLIPS, max(int(step[np.argmax(weighs > tolerance)]) - 1, 0), True, "grazing", values)


def relative(a: Horizons, b: Horizons) -> dict[str, Float[np.ndarray, "points"]]:
    """Return the difference of two gradients, divided by the larger norm, by parameter and horizon."""
    out = {}
    second = b.by_name()
    for name, first in a.by_name().items():
        size = np.maximum(*(np.linalg.norm(part, axis=1) for part in (first, second[name])))
        difference = np.linalg.norm(first - second[name], axis=1)
        out[name] = np.where(size > 0, difference / np.where(size > 0, size, 1), 0.0)
    return out


def standard_error(made: Sequence[Horizons]) -> dict[str, Float[np.ndarray, "points"]]:
    """Return the relative standard error of the mean gradient, by parameter and horizon."""
    out = {}
    for name in made[0].by_name():
        each = np.stack([one.by_name()[name] for one in made])
        error = np.linalg.norm(each.std(axis=0, ddof=1), axis=1) / np.sqrt(len(made))
        mean = np.linalg.norm(each.mean(axis=0), axis=1)
        out[name] = np.where(mean > 0, error / np.where(mean > 0, mean, 1), np.where(error > 0, np.inf, 0.0))
    return out


def last_below(
    at: Int[np.ndarray, "points"], values: dict[str, Float[np.ndarray, "points"]], limit: float
) -> tuple[int, bool]:
    """Return the last horizon before two successive errors above a limit, and whether such errors exist.

    Relative errors are large where a gradient changes sign. A single error is therefore ignored, except at
    the last horizon.
    """
    beyond = ~(np.max(np.stack(list(values.values())), axis=0) <= limit)
    lasting = beyond & np.append(beyond[1:], True)
    if not lasting.any():
        return int(at[-1]), False
    first = int(np.argmax(lasting))
    return (int(at[first - 1]) if first else 0), True


def last_agreeing(
    at: Int[np.ndarray, "points"], values: dict[str, Float[np.ndarray, "points"]], limit: float
) -> tuple[int, bool]:
    """Return the longest horizon with all errors below a limit, and whether a longer one exists.

    Disagreement of two gradients at shorter horizons is ignored. At longer horizons, the relative error of
    the time step and of a flip may decrease. Agreement at only one horizon is regarded as chance.
    """
    within = np.max(np.stack(list(values.values())), axis=0) <= limit
    if len(within) > 1:
        within &= np.append(False, within[:-1]) | (np.append(within[1:], False) & (at < at[-1]))
    where = np.flatnonzero(within)
    return (int(at[where[-1]]) if len(where) else 0), not within[-1]


def ambiguity(problem: Problem) -> Limit:
    """Find the first decision whose distance from its threshold is below its rounding error bound."""
    recorder = PairRecorder(problem.simulation)
    for segment in Engine(problem.simulation, problem.steps).segments():
        close = recorder.doubtful(segment)
        if len(close.step):
            values = {
                "step": int(close.step[0]), **problem.simulation.pair_of(close.i[0], close.j[0]),
                "margin": float(abs(close.margin[0])), "bound": float(close.bound[0]),
            }  # fmt: skip
            return Limit(AMBIGUOUS, max(values["step"] - 1, 0), True, "within rounding", values)
    return Limit(AMBIGUOUS, problem.steps, False, "none")
