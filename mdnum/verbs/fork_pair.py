"""Run two simulations that differ in one numerical choice, and write an output folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from mdnum.errors import InputError, expect_at_least
from mdnum.plain import plain
from mdnum.verbs import frame
from mdnum.verbs.fork_verdict import TEXTS
from mdnum.verbs.frame import Answer, Keep, Outcome, Progress

if TYPE_CHECKING:
    from mdnum.forks import Fork, Twin
    from mdnum.systems import BallSystem, System
    from mdnum.systems.simulation import Simulation

#: Default number of steps of commands that make hundreds of runs or compute runs in exact arithmetic.
FEW_STEPS = 500
#: Share of the steps of the runs for which a tangent is propagated, and the smallest and largest number of
#: these steps. A step of a tangent takes as long as six steps of a run, so that the tangent takes a tenth of
#: the time of the compared runs.
_SHARE, _FEWEST, _MOST = 0.25, 400, 2_000
#: Number of steps before and after the fork for which the heights of the deciding ball are stored.
_BEFORE, _AFTER = 40, 80
#: Columns of separation.parquet by the stored series, and those that exist only for molecular dynamics.
_SERIES = {
    "free": "B", "imposed": "B|A", "back": "A|B", "cross": "cross", "overridden": "overridden",
    "furthest": "furthest", "energy_a": "energy A", "energy_b": "energy B", "energy_imposed": "energy B|A",
    "energy_back": "energy A|B", "imposed_from_b": "B|A from B", "back_from_a": "A|B from A",
    "nearest_a": "nearest A", "nearest_b": "nearest B", "ambiguous_a": "ambiguous A",
    "ambiguous_b": "ambiguous B", "strain": "strain", "strain_imposed": "strain B|A",
}  # fmt: skip
_MD_ALONE = ("energy_back", "nearest_a", "nearest_b", "ambiguous_a", "ambiguous_b")


@dataclass(frozen=True)
class PairQuestion:
    """Options for a pair of runs, as in `fork`."""

    steps: int | None = None
    split: float | None = None
    repeats: int | None = None
    counterfactual: bool = True
    back: bool | None = None
    lyapunov: bool = True
    minimal: bool = False
    pin: str | None = None


# -- what questions about forks share ------------------------------------------------------------------


def last_step(system: Any, steps: int | None, most: int | None = None) -> int:
    """Return the last step of a run. The default is the last step in the system file, at most `most`.

    Raises:
        InputError: steps is below 1.
    """
    from mdnum.systems.load import world_of

    own = system.spec.integrator.steps if world_of(system) == "ball" else system.steps
    last = steps if steps is not None else own if most is None else min(most, own)
    expect_at_least(1, steps=last)
    return last


def of_md(
    system: Any, overrides: Mapping[str, Any] | None, question: str, pairwise: bool = False
) -> Simulation:
    """Return the simulation of a molecular-dynamics system. Raise an error for unsupported systems.

    Args:
        question: name in the text keys "ball_<question>", the alternative for a ball, and
            "many_body_<question>".
        pairwise: whether only pair potentials are supported.

    Raises:
        InputError: the argument is a ball or no system, or its many-body potential is not supported.
    """
    from mdnum.systems import BallSystem, opened

    loaded = opened(system, overrides)
    if isinstance(loaded, BallSystem):
        raise InputError("the system is a ball", where=loaded.name, remedy=TEXTS(f"ball_{question}"))
    if pairwise and not loaded.pairwise:
        remedy = "Use a system with a pair potential"
        raise InputError(TEXTS(f"many_body_{question}"), where=loaded.name, remedy=remedy)
    return loaded


def basics(system: Simulation | System | BallSystem, steps: int | None) -> dict[str, Any]:
    """Return summary entries on a system: name, number of atoms or balls, last step, time step."""
    from mdnum.systems import BallSystem, System

    head: dict[str, Any] = {"system": system.name}
    if isinstance(system, BallSystem):
        spec, own = system.spec, system.spec.integrator
        counted = "impacts" if own.kind == "event-located" else "iterations"
        head |= {"about": spec.about, "balls": system.balls, "contact_kind": spec.contact.kind,
                 "integrator": own.kind, "counted": counted, "units": "ball"}  # fmt: skip
    elif isinstance(system, System):
        own = system.spec.dynamics
        head |= {"about": system.spec.about, "atoms": len(system.atoms), "units": system.spec.units}
    else:
        own = system
        head |= {"about": system.origin.about, "atoms": system.atoms, "units": system.units.name}
    last = own.steps if steps is None else steps
    return {
        **head, "steps": last, "steps_asked": last, "timestep": float(own.timestep), "status": "complete",
        "findings": [],
    }  # fmt: skip


def check(asked: PairQuestion) -> None:
    """Raise an error if options are invalid, before the output folder is made."""
    from mdnum.forks.pair import repeats_asked

    expect_at_least(1, steps=1 if asked.steps is None else asked.steps)
    if asked.split is not None and not 0 < asked.split < float("inf"):
        raise InputError(f"split = {asked.split:g}; expected a positive distance between runs A and B")
    repeats_asked(asked.repeats, asked.counterfactual)


# -- a pair of runs, into a folder ---------------------------------------------------------------------


def followed(
    system: Simulation | BallSystem,
    twin: Twin,
    labels: Mapping[str, Any],
    asked: PairQuestion,
    further: Callable[[Fork], dict[str, Any]] = lambda made: {},
    **keep: Unpack[Keep],
) -> Outcome:
    """Run a pair of simulations and write an output folder of kind "fork".

    Args:
        labels: entries of the summary on the varied choice.
        further: function that returns the entries that need the finished pair.
    """
    from mdnum.forks import fork as follow
    from mdnum.forks.pair import counterfactuals

    options: Any = {name: getattr(asked, name) for name in ("counterfactual", "back", "repeats")}
    counterfactuals(twin, **options)
    with frame.answering("fork", f"fork-{system.name}", system, **keep) as answer:
        made = follow(twin, asked.steps, split=asked.split, progress=answer.log, **options)
        answer.result = made
        answer.summary = basics(system, asked.steps) | dict(labels) | _numbers(made)
        answer.tables["separation"] = _separation(made)
        own = _of_md(made, asked, answer) if made.twin.a.streams else _of_ball(made, answer.tables)
        answer.summary |= own | _predicted(made, own) | further(made)
    return answer.outcome


def _numbers(made: Fork) -> dict[str, Any]:
    """Return summary entries on two runs: steps of divergence, verdict, and growth of distance."""
    step, verdict, growth = made.twin.a.timestep, made.verdict, made.growth["B"]
    dates = {"first_bit": made.dates.first_bit, "fork": made.dates.fork, "split": made.dates.split}
    free, imposed, overridden = (
        values[np.isfinite(values)] for values in
        (made.series.get(name, np.zeros(0)).astype(float) for name in ("B", "B|A", "overridden"))
    )  # fmt: skip
    count, other = (
        one and {**plain(one), "threshold": verdict.threshold, "displacement": size}
        for one, size in zip((verdict.count, verdict.other), (*made.displacements, None, None), strict=False)
    )
    count = count and {**count, "needed": verdict.count and verdict.count.needed}
    repeated = [[{"free": one.free, "imposed": one.imposed} for one in delays] for delays in made.repeats]
    free_runs = made.failed.keys() & {"A", "B"}
    return {
        "difference": made.twin.difference, "changes": made.twin.changes, "steps": made.steps,
        "steps_asked": made.asked, **dates,
        **{f"{name}_time": None if at is None else at * step for name, at in dates.items()},
        "tolerance": made.tolerance, "effect": verdict.word,
        "reasons": [{"code": code, **values} for code, values in verdict.reasons],
        "e_foldings": verdict.e_foldings, "displacements": made.displacements,
        "count": count, "count_other": other, "growth_rate": growth.rate,
        "growth_rate_time": growth.rate / step, "r_squared": growth.r_squared,
        "growth": {name: _fit(fit, made.series[name]) for name, fit in made.growth.items()},
        "splits": {name: made.splits[name] for name in ("B", "B|A", "A|B") if name in made.splits},
        "table": made.table,
        "shares": [
            {name: getattr(one, name) for name in ("what", "reference", "steps", "at_least", "e_foldings")}
            for one in made.shares
        ],
        "repeated": repeated[0], "repeated_other": repeated[1],
        "imposed_until": len(imposed) - 1 if len(imposed) else None,
        "imposed_largest": imposed.max() if len(imposed) else None,
        "separation_end": free[-1] if len(free) else None,
        "separation_largest": free.max() if len(free) else None,
        **_boxes(made, dates),
        "overridden": int(overridden.sum()) if len(overridden) else None,
        "cross_flips": made.flips_total, "cross_flips_kept": len(made.flips),
        "failed": {name: word for name, word in made.failed.items() if name in free_runs},
        "failed_imposed": {name: word for name, word in made.failed.items() if name not in free_runs},
        "status": "failed" if free_runs else "complete",
    }  # fmt: skip


def _boxes(made: Fork, dates: Mapping[str, int | None]) -> dict[str, Any]:
    """Return the strain between the boxes of two runs: largest, final and at divergence."""
    if "strain" not in made.series:
        return {}
    strain, free = made.series["strain"], made.series["B"]
    known = strain[np.isfinite(strain)]
    return {"boxes": {
        "end": known[-1] if len(known) else None, "largest": known.max(initial=0.0),
        **{name: None if at is None else {"strain": strain[at], "separation": free[at]}
           for name, at in dates.items()},
    }}  # fmt: skip


def _fit(fit: Any, separation: np.ndarray) -> dict[str, Any]:
    """Return the exponential fit to the distance between two runs, and the fitted steps."""
    if not np.isfinite(fit.rate):
        return dict.fromkeys(("rate", "r_squared", "first", "last", "intercept"))
    step = np.arange(fit.first, fit.last + 1)
    step = step[np.nan_to_num(separation[step]) > 0]
    return {**vars(fit), "intercept": np.mean(np.log(separation[step]) - fit.rate * step)}


def _predicted(made: Fork, summary: Mapping[str, Any]) -> dict[str, Any]:
    """Predict when two runs split, from their distance or from the Lyapunov exponent."""
    from mdnum.numerics.verdicts import expected

    exponent = summary.get("lyapunov")
    ways = {"growth": None, "exponent": exponent["rate"] if exponent and exponent["chaotic"] else None}
    for name, rate in ways.items() if made.dates.split is None else ():
        if name == "growth" or rate is not None:
            more = expected(made.series["B"], made.tolerance, rate)
            if more is not None:
                return {"predicted_split": round(made.steps + more), "predicted_by": name}
    return {"predicted_split": None, "predicted_by": None}


def _separation(made: Fork) -> dict[str, Any]:
    series, step = made.series, made.series["step"]
    columns = {
        name: series.get(key, np.full(len(step), np.nan))
        for name, key in _SERIES.items()
        if (made.twin.a.streams or name not in _MD_ALONE) and (key in made.series or "strain" not in key)
    }
    repeats = {f"repeat_{name[2:]}": series[name] for name in series if name.startswith("B ")}
    return {"step": step, "time": step * made.twin.a.timestep, **columns, **repeats}


def _decision(made: Fork) -> dict[str, Any] | None:
    """Return the first decision that differs between two runs, as plain values."""
    decision = made.decision
    if decision is None:
        return None
    length, protects = decision.margin, 1
    space = {"contact": "height", "stop": "residual"}.get(decision.channel)
    subject: dict[str, Any] = {"ball": decision.subject[0] if decision.subject else None}
    if decision.channel == "pair":
        i, j = decision.subject
        a, b = (program.simulation for program in (made.twin.a, made.twin.b))
        run = b if decision.run == "B" else a
        kind = int(a.type_of(np.array([i]), np.array([j]))[0])
        thresholds = [one.decider.thresholds[kind].value for one in (a, b, run)]
        space, protects = run.decider.space, 2
        if space == "r2":
            # the margin of r² is this factor times that of r
            length = decision.margin / (2.0 * run.decider.r_cut[kind])
        root = np.sqrt if space == "r2" else float
        distance, *cutoffs = (float(root(x)) for x in (thresholds[2] - decision.margin, *thresholds[:2]))
        subject = {**a.pair_of(i, j), "distance": distance, "margin_length": length,
                   "cutoffs": dict(zip("AB", cutoffs, strict=True))}  # fmt: skip
    before = decision.separation
    return {
        "channel": decision.channel, "step": decision.step, "run": decision.run, **subject,
        "entered": decision.entered, "decided": {"A": decision.a, "B": decision.b}, "space": space,
        "margin": decision.margin, "bound": decision.bound, "ambiguous": decision.ambiguous,
        "margins": decision.margins, "bounds": decision.bounds, "ambiguous_in": decision.ambiguous_in,
        "separation_before": before, "also": decision.also,
        "protected": abs(length) / before if np.isfinite(length) and before > 0 else None,
        "protects": protects,
    }  # fmt: skip


def _of_md(made: Fork, asked: PairQuestion, answer: Answer) -> dict[str, Any]:
    """Return summary entries, and add tables, for a pair of molecular-dynamics runs."""
    from mdnum.forks.certified import certified
    from mdnum.forks.replays import neighborhood

    frame.say(answer.log, "the atoms at the fork", made.steps)
    tables, around, decision = answer.tables, neighborhood(made), _decision(made)
    if decision is not None and around is not None:
        margins, bounds = (dict(zip("AB", pair, strict=True)) for pair in (around.margins, around.bounds))
        doubtful = [name for name, margin in margins.items() if abs(margin) <= bounds[name]]
        decision |= {"margins": margins, "bounds": bounds, "ambiguous_in": doubtful}
        tables["neighborhood"] = {"atom": around.atoms}
        for head, vectors in (("", around.positions), ("d", around.moved)):
            tables["neighborhood"] |= {f"{head}{name}": vectors[:, k] for k, name in enumerate("xyz")}
    sure, named = certified(made), made.twin.a.simulation.first_atoms
    doubts = {name: vars(made.doubts[name]) for name in sure.horizon}
    summary: dict[str, Any] = {
        "decision": decision, "r_cut": made.twin.a.simulation.r_cut,
        "certified_horizon": {name: one.step for name, one in sure.horizon.items()} or None,
        "ambiguous": {name: one.decisions for name, one in sure.horizon.items()},
        "ambiguous_steps": {name: one.steps for name, one in sure.horizon.items()},
        "ambiguous_first": {
            name: {key: values[0] for key, values in (rows | named(rows["i"])).items()}
            if len(rows["step"]) else None
            for name, rows in doubts.items()
        },
        "lists_complete": {name: one.complete for name, one in sure.horizon.items()},
        "protected_until": sure.protected, "shadow": sure.shadow, "shadow_horizon": sure.shadow_step,
    }  # fmt: skip
    names = ("step", "i", "j", "differs", "run", "entered", "margin", "bound")
    columns = {name: [getattr(flip, name) for flip in made.flips] for name in names}
    tables["cross_flips"] = {**columns, **named(columns["i"])}
    tables["ambiguous_pairs"] = {
        name: np.concatenate([getattr(rows, name) for rows in made.doubts.values()])
        for name in ("step", "i", "j", "margin", "bound")
    }
    tables["ambiguous_pairs"] |= named(tables["ambiguous_pairs"]["i"])
    runs = [np.full(len(rows.step), name) for name, rows in made.doubts.items()]
    tables["ambiguous_pairs"]["run"] = np.concatenate(runs)
    if asked.lyapunov:
        frame.say(answer.log, "the Lyapunov exponent", made.steps)
        summary |= _exponent(made)
    if asked.minimal:
        summary["minimal"] = _minimal(made, answer.log)
    if asked.pin is not None:
        frame.say(answer.log, "a decision overridden", made.steps)
        summary["pinned"] = _pinned(made, asked.pin, tables["separation"])
    return summary


def _of_ball(made: Fork, tables: dict[str, Any]) -> dict[str, Any]:
    """Return summary entries for two ball runs. Add tables of decisions and heights."""
    names = ("step", "channel", "ball", "a", "b", "margin_a", "margin_b", "bound_a", "bound_b", "run")
    flips = [{name: getattr(flip, name) for name in names} for flip in made.flips]
    tables["cross_flips"] = [
        {**flip, **{name: flip[f"{name}_{flip['run'].lower()}"] for name in ("margin", "bound")},
         "i": flip["ball"], "j": -1, "differs": True, "entered": True}
        for flip in flips
    ]  # fmt: skip
    if made.decision is not None:
        # the first ball, where they decide together
        at, ball = made.decision.step, made.decision.subject[0] if made.decision.subject else 0
        tables["around"] = [
            {"step": step, "run": name, "ball": ball, "y": float(run.y[step, ball]),
             "v": float(run.v[step, ball]), "contact": bool(step and run.contact[step - 1, ball])}
            for name, run in (("A", made.runs["A"]), ("B", made.runs["B"]))
            for step in range(max(0, at - _BEFORE), min(made.steps, at + _AFTER) + 1)
        ]  # fmt: skip
    stops = sum(flip["channel"] == "stop" for flip in flips)
    return {"decision": _decision(made), "cross_contacts": len(flips) - stops, "cross_stops": stops}


def _exponent(made: Fork) -> dict[str, Any]:
    """Return the largest Lyapunov exponent of run A, or why it is unknown."""
    from mdnum.forks.linearized import lyapunov

    def why(name: str, **values: Any) -> dict[str, Any]:
        return {"lyapunov": None, "lyapunov_reason": TEXTS(f"lyapunov_{name}", **values)}

    a = made.twin.a.simulation
    if made.dates.first_bit is None:
        return why("same")
    if not a.pairwise:
        return why("many_body")
    steps = min(made.steps, max(_FEWEST, min(_MOST, round(_SHARE * made.steps))))
    try:
        found = lyapunov(a, steps)
    except InputError as error:
        return why("error", error=error.message)
    if not np.isfinite(found.rate):
        return why("not_finite", steps=steps)
    ulp = made.twin.a.ulp
    split = found.steps_to(ulp, made.tolerance)
    row = {
        **{name: getattr(found, name) for name in ("rate", "error", "rate_time", "error_time", "steps")},
        "chaotic": found.chaotic, "ratio": plain(found.ratio(made.growth["B"])), "ulp": ulp,
        "ulp_split": None if split is None else round(split),
    }  # fmt: skip
    if found.chaotic:
        return {"lyapunov": row, "lyapunov_reason": None}
    # log(end / first) over the steps between them, as Lyapunov.chaotic has it
    linear = float(np.log(steps / found.transient)) / (steps - found.transient)
    slow = found.rate + found.error < 0.5 * linear
    return why("slow" if slow else "unclear", steps=steps, linear=linear) | {"lyapunov": row}


def _pinned(made: Fork, pin: str, separation: dict[str, Any]) -> dict[str, Any]:
    """Repeat run B with the decisions of run A. Return the result, or why this is impossible."""
    from mdnum.forks.replays import parse_pin, pinned

    try:
        found = pinned(made, **parse_pin(pin, made.twin.a.size))
    except InputError as error:
        return {"pin": pin, "pairs": None, "reason": error.message}
    separation["pinned"] = found.separation
    seen = found.separation[np.isfinite(found.separation)]
    row = {name: getattr(found, name) for name in ("pairs", "first", "last", "split", "free")}
    named = [made.twin.a.simulation.pair_of(*pair) for pair in found.pairs]
    row["pairs"] = [(pair["i"], pair["j"]) for pair in named]
    row |= {"terms": [pair["terms"] for pair in named]} if "terms" in named[0] else {}
    return {"pin": pin, **row, "until": len(seen) - 1, "largest": seen.max(), "reason": None}


def _minimal(made: Fork, log: Progress) -> dict[str, Any]:
    """Return a minimal set of imposed decisions that keeps run B close to run A."""
    from mdnum.forks.replays import disagreements, minimal_cause

    try:
        found = minimal_cause(
            made, progress=lambda done, most: frame.say(log, "minimal cause", done, most, unit="runs")
        )
    except InputError as error:
        return {"pairs": None, "proven": False, "tests": 0, "reason": error.message}
    pairs = found.pairs and [
        {**made.twin.a.simulation.pair_of(*pair), "differs": disagreements(made, *pair)}
        for pair in found.pairs
    ]
    row = {**vars(found), "proven": found.proven, "fork_alone": found.code == "alone", "pairs": pairs}
    return row | {"reason": TEXTS(f"minimal_{found.code}", **row, n=len(pairs or ()))}
