"""A pair of runs of either world, followed into a fork folder: its summary, its tables."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.plain import plain
from mdnum.verbs import frame
from mdnum.verbs.fork_verdict import TEXTS
from mdnum.verbs.frame import Outcome, Progress

if TYPE_CHECKING:
    from mdnum.forks import Fork, Twin
    from mdnum.systems import BallSystem, System

#: Steps of what makes hundreds of runs, or follows them by hand, unless more are asked for.
FEW_STEPS = 500
#: A tangent is carried for a share of the steps that were followed, but not for fewer nor for more than this:
#: its step costs as much as six of a run, so it takes a tenth as long as the runs that are compared.
_SHARE, _FEWEST, _MOST = 0.25, 400, 2_000
#: Steps before and after the fork of which the deciding ball's heights are kept.
_BEFORE, _AFTER = 40, 80
#: Columns of separation.parquet by the series that they hold; those of molecular dynamics alone come last.
_SERIES = {
    "free": "B", "imposed": "B|A", "back": "A|B", "cross": "cross", "overridden": "overridden",
    "furthest": "furthest", "energy_a": "energy A", "energy_b": "energy B", "energy_imposed": "energy B|A",
    "energy_back": "energy A|B", "imposed_from_b": "B|A from B", "back_from_a": "A|B from A",
    "nearest_a": "nearest A", "nearest_b": "nearest B", "ambiguous_a": "ambiguous A",
    "ambiguous_b": "ambiguous B",
}  # fmt: skip
_MD_ALONE = ("energy_back", "nearest_a", "nearest_b", "ambiguous_a", "ambiguous_b")


@dataclass(frozen=True)
class PairQuestion:
    """What is to be found out about a pair of runs; the arguments of `fork`."""

    steps: int | None = None
    split: float | None = None
    repeats: int | None = None
    counterfactual: bool = True
    back: bool | None = None
    lyapunov: bool = True
    minimal: bool = False
    pin: str | None = None


# -- what questions about forks share ------------------------------------------------------------------


def of_any(
    system: System | BallSystem | str | Path, overrides: Mapping[str, Any] | None
) -> System | BallSystem:
    """A system of either world.

    Raises:
        InputError: there is none, or it is loaded already and there are overrides.
    """
    from mdnum.systems import BallSystem, System, load

    if not isinstance(system, System | BallSystem):
        return load(system, overrides)
    if overrides:
        raise InputError(
            "overrides change a system while it is loaded",
            remedy="Load it with the overrides, or give its name",
            where=system.name,
        )
    return system


def is_ball(system: Any) -> bool:
    """Whether a system, or what is there under a name, is a ball."""
    from mdnum.systems import BallSystem, System
    from mdnum.systems.load import world_of

    if isinstance(system, System | BallSystem):
        return isinstance(system, BallSystem)
    return world_of(system) == "ball"


def few_steps(system: System, steps: int | None) -> int:
    """The last step: the one asked for, else the system's own, but no more than a few hundred.

    Raises:
        InputError: steps below 1.
    """
    last = min(FEW_STEPS, system.spec.dynamics.steps) if steps is None else steps
    if last < 1:
        raise InputError(f"steps = {last}; expected at least 1")
    return last


def of_md(system: Any, overrides: Mapping[str, Any] | None, question: str) -> System:
    """A system of molecular dynamics, the only ones that a question is asked of.

    Args:
        question: whose sentence "ball_<question>" says what a ball offers in its place.

    Raises:
        InputError: it is a ball, or none.
    """
    from mdnum.systems import BallSystem

    loaded = of_any(system, overrides)
    if isinstance(loaded, BallSystem):
        raise InputError("this system is a ball", where=loaded.name, remedy=TEXTS(f"ball_{question}"))
    return loaded


def basics(system: System | BallSystem, steps: int | None) -> dict[str, Any]:
    """What every summary says of the system; steps default to its own."""
    from mdnum.systems import BallSystem

    head = {"system": system.name, "about": system.spec.about}
    if isinstance(system, BallSystem):
        kind = system.spec.integrator.kind
        own = system.spec.integrator
        head |= {
            "balls": system.balls, "contact_kind": system.spec.contact.kind, "integrator": kind,
            "counted": "impacts" if kind == "event-located" else "iterations", "units": "ball",
        }  # fmt: skip
    else:
        own = system.spec.dynamics
        head |= {"atoms": len(system.atoms), "units": system.units.name}
    asked = own.steps if steps is None else steps
    return {
        **head, "steps": asked, "steps_asked": asked, "timestep": float(own.timestep), "status": "complete",
        "findings": [],
    }  # fmt: skip


def check(asked: PairQuestion) -> None:
    """Refuses what cannot be, before a folder is made."""
    from mdnum.forks.pair import repeats_asked

    if asked.steps is not None and asked.steps < 1:
        raise InputError(f"steps = {asked.steps}; expected at least 1")
    if asked.split is not None and not 0 < asked.split < float("inf"):
        raise InputError(f"split = {asked.split:g}; expected a length above 0")
    repeats_asked(asked.repeats, asked.counterfactual)


# -- a pair of runs, into a folder ---------------------------------------------------------------------


def followed(
    system: System | BallSystem,
    twin: Twin,
    labels: Mapping[str, Any],
    asked: PairQuestion,
    further: Callable[[Fork], dict[str, Any]],
    out: str | Path | None,
    report: bool,
    progress: Progress | None,
) -> Outcome:
    """Follow a twin and leave a fork folder.

    Args:
        labels: entries of the summary on what is varied; further: those that need the pair.
    """
    from mdnum.forks import fork as follow
    from mdnum.forks.pair import counterfactuals

    began = time.perf_counter()
    is_ball = hasattr(system, "balls")
    options = {name: getattr(asked, name) for name in ("counterfactual", "back", "repeats")}
    counterfactuals(twin, **options)
    with frame.new_folder("fork", f"fork-{system.name}", out, system=system) as folder:
        made = follow(
            twin,
            asked.steps,
            split=asked.split,
            progress=frame.logged(folder, progress, frame.STEPWISE),
            **options,
        )
        summary = basics(system, asked.steps) | dict(labels) | _numbers(made)
        tables = {"separation": _separation(made, is_ball)}
        if is_ball:
            summary |= {"decision": _decision(made), **_ball_flips(made, tables)}
        else:
            summary |= _of_md(made, asked, tables, progress)
        summary |= {**_predicted(made, summary), **further(made), "seconds": time.perf_counter() - began}
        frame.store(folder, summary, tables)
    return frame.finish(folder, report=report, result=made, progress=progress)


def _numbers(made: Fork) -> dict[str, Any]:
    """What the summary of any pair says: dates, verdict, growth, the table of two by two."""
    from mdnum.forks.pair import FLIPS_KEPT

    step, free, verdict = made.twin.a.timestep, made.series["B"], made.verdict
    dates = {"first_bit": made.dates.seed, "fork": made.dates.fork, "split": made.dates.split}
    count = None
    if verdict.count is not None:
        count = {**plain(verdict.count), "threshold": verdict.threshold, "needed": verdict.count.needed}

    def of(name: str, reduce: Callable[[np.ndarray], Any]) -> Any:
        values = made.series.get(name)
        return None if values is None or not np.isfinite(values).any() else reduce(values)

    return {
        "difference": made.twin.difference,
        "changes": made.twin.changes,
        "steps": made.steps,
        "steps_asked": made.asked,
        **dates,
        **{f"{name}_time": None if at is None else at * step for name, at in dates.items()},
        "tolerance": made.tolerance,
        "effect": verdict.word,
        "reasons": verdict.reasons,
        "e_foldings": verdict.nats,
        "count": count,
        "growth_rate": made.growth["B"].rate,
        "growth_rate_time": made.growth["B"].rate / step,
        "r_squared": made.growth["B"].r_squared,
        "growth": {name: _fit(fit, made.series[name]) for name, fit in made.growth.items()},
        "splits": {name: made.splits[name] for name in ("B", "B|A", "A|B") if name in made.splits},
        "table": made.table,
        "shares": [
            {"what": one.what, "reference": one.reference, "steps": one.steps, "at_least": one.at_least,
             "e_foldings": one.nats}
            for one in made.shares
        ],
        "repeated": [{"free": one.free, "imposed": one.handed} for one in made.repeats],
        "imposed_until": of("B|A", lambda values: int(np.flatnonzero(np.isfinite(values))[-1])),
        "imposed_largest": of("B|A", np.nanmax),
        "separation_end": of("B", lambda values: values[np.isfinite(values)][-1]),
        "separation_largest": float(np.nanmax(free)) if np.isfinite(free).any() else None,
        "overridden": of("overridden", lambda values: int(np.nansum(values))),
        "cross_flips": made.flips_total,
        "cross_flips_kept": min(made.flips_total, FLIPS_KEPT),
        "failed": {name: word for name, word in made.failed.items() if name in ("A", "B")},
        "failed_imposed": {name: word for name, word in made.failed.items() if name not in ("A", "B")},
        "status": "failed" if made.failed.keys() & {"A", "B"} else "complete",
    }  # fmt: skip


def _fit(fit: Any, separation: np.ndarray) -> dict[str, Any]:
    """A fit as a line: separation = exp(intercept + rate * step) between first and last."""
    if not np.isfinite(fit.rate):
        return {"rate": None, "r_squared": None, "first": None, "last": None, "intercept": None}
    step = np.arange(fit.first, fit.last + 1)
    values = separation[step]
    usable = np.isfinite(values) & (values > 0)
    intercept = float(np.mean(np.log(values[usable]) - fit.rate * step[usable]))
    return {**vars(fit), "intercept": intercept}


def _predicted(made: Fork, summary: Mapping[str, Any]) -> dict[str, Any]:
    """The step at which runs that have not split are expected to: by their own growth, or the exponent."""
    from mdnum.numerics.verdicts import expected

    exponent = summary.get("lyapunov")
    ways = {"growth": None, "exponent": exponent["rate"] if exponent and exponent["chaotic"] else None}
    for name, rate in ways.items() if made.dates.split is None else ():
        if name == "growth" or rate is not None:
            more = expected(made.series["B"], made.tolerance, rate)
            if more is not None:
                return {"predicted_split": round(made.steps + more), "predicted_by": name}
    return {"predicted_split": None, "predicted_by": None}


def _separation(made: Fork, is_ball: bool) -> dict[str, Any]:
    series, rows = made.series, len(made.series["step"])
    columns = {
        name: series.get(key, np.full(rows, np.nan))
        for name, key in _SERIES.items()
        if not (is_ball and name in _MD_ALONE)
    }
    head = {"step": series["step"], "time": series["step"] * made.twin.a.timestep}
    return head | columns | {f"repeat_{name[2:]}": series[name] for name in series if name.startswith("B ")}


def _decision(made: Fork) -> dict[str, Any] | None:
    """The decision at the fork, in plain values."""
    found = made.decision
    if found is None:
        return None
    length, space = found.margin, {"contact": "height", "stop": "residual"}.get(found.channel)
    subject = {"ball": found.subject[0] if found.subject else None}
    margins, bounds, doubtful, protects = found.margins, found.bounds, found.ambiguous_in, 1
    if found.channel == "pair":
        i, j = found.subject
        a, b = (program.simulation for program in (made.twin.a, made.twin.b))
        run = b if found.run == "B" else a
        kind = int(a.type_of(np.array([i]), np.array([j]))[0])
        thresholds = [one.decider.thresholds[kind].value for one in (a, b, run)]
        space, protects = run.decider.space, 2
        if space == "r2":
            # the margin of r² is this factor times that of r
            length = found.margin / (2.0 * run.decider.r_cut[kind])
        quantity = thresholds[2] - found.margin
        distance, *cutoffs = (
            float(np.sqrt(value)) if space == "r2" else value for value in (quantity, *thresholds[:2])
        )
        subject = {"i": i, "j": j, "distance": distance, "margin_length": length}
        subject["cutoffs"] = dict(zip("AB", cutoffs, strict=True))
    before = found.separation
    known = np.isfinite(length) and before > 0
    return {
        "channel": found.channel, "step": found.step, "run": found.run, **subject, "entered": found.entered,
        "decided": {"A": found.a, "B": found.b}, "space": space, "margin": found.margin,
        "bound": found.bound, "ambiguous": found.ambiguous, "margins": margins, "bounds": bounds,
        "ambiguous_in": doubtful, "separation_before": before, "also": found.also,
        "protected": abs(length) / before if known else None, "protects": protects,
    }  # fmt: skip


def _of_md(
    made: Fork, asked: PairQuestion, tables: dict[str, Any], progress: Progress | None
) -> dict[str, Any]:
    """Entries and tables of a pair of molecular dynamics."""
    from mdnum.forks.certified import certified
    from mdnum.forks.replays import neighborhood

    frame.say(progress, "the atoms at the fork", made.steps)
    around = neighborhood(made)
    decision = _decision(made)
    if decision is not None and around is not None:
        decision["margins"] = dict(zip("AB", around.margins, strict=True))
        decision["bounds"] = dict(zip("AB", around.bounds, strict=True))
        decision["ambiguous_in"] = [
            name for name, margin in decision["margins"].items() if abs(margin) <= decision["bounds"][name]
        ]
    summary: dict[str, Any] = {"decision": decision, "r_cut": made.twin.a.simulation.r_cut}
    found, firsts = certified(made), {}
    for name in found.horizon:
        doubts = made.doubts[name]._asdict()
        firsts[name] = {key: values[0] for key, values in doubts.items()} if len(doubts["step"]) else None
    runs = found.horizon.items()
    summary |= {
        "certified_horizon": {name: one.step for name, one in runs} or None,
        "ambiguous": {name: one.decisions for name, one in runs},
        "ambiguous_steps": {name: one.steps for name, one in runs},
        "ambiguous_first": firsts,
        "lists_complete": {name: one.complete for name, one in runs},
        "protected_until": found.protected,
        "shadow": found.shadow,
        "shadow_horizon": found.shadow_step,
    }
    names = ("step", "i", "j", "differs", "run", "entered", "margin", "bound")
    tables["cross_flips"] = {name: [getattr(flip, name) for flip in made.flips] for name in names}
    doubts = [{"run": np.full(len(one.step), name), **one._asdict()} for name, one in made.doubts.items()]
    names = ("run", "step", "i", "j", "margin", "bound")
    tables["ambiguous_pairs"] = {name: np.concatenate([one[name] for one in doubts]) for name in names}
    if around is not None:
        vectors = {name: around.positions[:, k] for k, name in enumerate("xyz")}
        vectors |= {f"d{name}": around.moved[:, k] for k, name in enumerate("xyz")}
        tables["neighborhood"] = {"atom": around.atoms, **vectors}
    if asked.lyapunov:
        frame.say(progress, "the Lyapunov exponent", made.steps)
        summary |= _exponent(made)
    if asked.minimal:
        summary["minimal"] = _minimal(made, progress)
    if asked.pin is not None:
        frame.say(progress, "a decision overridden", made.steps)
        summary["pinned"] = _pinned(made, asked.pin, tables["separation"])
    return summary


def _ball_flips(made: Fork, tables: dict[str, Any]) -> dict[str, Any]:
    """Entries and tables of a pair of a ball: decisions that differ, the deciding ball around the fork."""
    names = ("step", "channel", "ball", "a", "b", "margin_a", "margin_b", "bound_a", "bound_b", "run")
    column = {name: np.array([getattr(flip, name) for flip in made.flips]) for name in names}
    if made.flips:
        in_a, yes = column["run"] == "A", np.ones(len(made.flips), bool)
        sided = {
            name: np.where(in_a, column[f"{name}_a"], column[f"{name}_b"]) for name in ("margin", "bound")
        }
        subject = {"i": column["ball"], "j": np.full(len(yes), -1)}
        tables["cross_flips"] = column | sided | subject | {"differs": yes, "entered": yes}
    if made.decision is not None:
        # the first ball, where they decide together
        at, ball = made.decision.step, made.decision.subject[0] if made.decision.subject else 0
        step = np.arange(max(0, at - _BEFORE), min(made.steps, at + _AFTER) + 1)
        rows = []
        for name in "AB":
            run = made.runs[name]
            rows.append({
                "step": step, "run": np.full(len(step), name), "ball": np.full(len(step), ball),
                "y": run.y[step, ball].astype(np.float64), "v": run.v[step, ball].astype(np.float64),
                "contact": np.r_[False, run.contact[:, ball]][step],
            })  # fmt: skip
        tables["around"] = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    stops = int(np.sum(column["channel"] == "stop"))
    return {"cross_contacts": len(made.flips) - stops, "cross_stops": stops}


def _exponent(made: Fork) -> dict[str, Any]:
    """The largest Lyapunov exponent of run A beside the growth that was seen, or why there is none."""
    from mdnum.forks.linearized import lyapunov

    def none(name: str, **values: Any) -> dict[str, Any]:
        return {"lyapunov": None, "lyapunov_reason": TEXTS(f"lyapunov_{name}", **values)}

    a = made.twin.a.simulation
    if made.dates.seed is None:
        return none("same")
    if not a.pairwise:
        return none("many_body")
    steps = min(made.steps, max(_FEWEST, min(_MOST, round(_SHARE * made.steps))))
    try:
        found = lyapunov(a, steps)
    except InputError as error:
        return none("error", error=error.message)
    if not np.isfinite(found.rate):
        return none("not_finite", steps=steps)
    # where A's largest coordinate lies: no smaller displacement of it can be written down
    ulp = float(np.spacing(np.abs(a.positions).max().astype(a.policy.dtype("state"))))
    split = found.steps_to(ulp, made.tolerance)
    table = {
        name: getattr(found, name)
        for name in ("rate", "error", "rate_time", "error_time", "steps", "chaotic")
    }
    table |= {"ratio": plain(found.ratio(made.growth["B"])), "ulp": ulp}
    table["ulp_split"] = None if split is None else round(split)
    # log(end / first) over the steps between them, as Lyapunov.chaotic has it
    linear = float(np.log(steps / found.transient)) / (steps - found.transient)
    slow = found.rate + found.error < 0.5 * linear
    reason = None if found.chaotic else none("slow" if slow else "unclear", steps=steps, linear=linear)
    return {"lyapunov": table, "lyapunov_reason": reason and reason["lyapunov_reason"]}


def _pinned(made: Fork, pin: str, separation: dict[str, Any]) -> dict[str, Any]:
    """B run again with some decisions overridden with A's; a reason where it cannot be."""
    from mdnum.forks.replays import check_pins, parse_pin, pinned

    wanted = parse_pin(pin, made.twin.a.size)
    try:
        check_pins(made)
    except InputError as error:
        return {"pin": pin, "pairs": None, "reason": error.message}
    if not wanted and made.decision is None:
        return {"pin": pin, "pairs": None, "reason": "the runs do not fork"}
    found = pinned(made, **wanted)
    separation["pinned"] = found.separation
    seen = found.separation[np.isfinite(found.separation)]
    row = {name: getattr(found, name) for name in ("pairs", "first", "last", "split", "free")}
    return {"pin": pin, **row, "until": len(seen) - 1, "largest": seen.max(), "reason": None}


def _minimal(made: Fork, progress: Progress | None) -> dict[str, Any]:
    """The fewest decisions that have to be overridden; a reason where none can be."""
    from mdnum.forks.replays import disagreements, minimal_cause

    try:
        found = minimal_cause(
            made,
            progress=lambda done, most: frame.say(progress, "minimal cause", done, most, unit="runs"),  # type: ignore[arg-type]
        )
    except InputError as error:
        return {"pairs": None, "proven": False, "tests": 0, "reason": error.message}
    pairs = [{"i": i, "j": j, "differs": disagreements(made, i, j)} for i, j in found.pairs or ()]
    values = {**vars(found), "n": len(pairs), "decisions": found.horizon + 1}
    reason = TEXTS(f"minimal_{found.code}", **values)
    return {
        **vars(found), "proven": found.proven, "fork_alone": found.code == "alone", "reason": reason,
        "pairs": pairs or None,
    }  # fmt: skip
