"""`mdnum fork` of a ball: vary one numerical choice, follow both rollouts, judge the decisions, report."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.workflow import fork_numbers as numbers
from mdnum.workflow.fork import ALL, ForkResult, Progress, refuse, say
from mdnum.workflow.fork_question import Log, finish, opened

if TYPE_CHECKING:
    from mdnum.forks import Decision, Fork
    from mdnum.store import RunFolder
    from mdnum.systems.ball_system import BallSystem

#: What a folder of this kind is called in summary.json and among the tables.
KIND = "ball-fork"
#: Decisions that differ of which the folder keeps a row each; the counts cover all of them.
ROWS_KEPT = 100_000
#: Steps before and after the fork of which the deciding ball's heights are kept.
_BEFORE, _AFTER = 40, 80
#: Columns of separation.parquet by the series that they hold.
_SERIES = {
    "free": "B", "handed": "B|A", "back": "A|B", "cross": "cross", "overridden": "overridden",
    "furthest": "furthest", "energy_a": "energy A", "energy_b": "energy B", "energy_handed": "energy B|A",
    "handed_from_b": "B|A from B", "back_from_a": "A|B from A",
}  # fmt: skip


def fork_ball(
    system: BallSystem,
    vary: str | None = None,
    *,
    steps: int | None = None,
    split: float | None = None,
    repeats: int | None = None,
    counterfactual: bool = True,
    out: str | Path | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> ForkResult:
    """Run a ball and its twin that differs in one choice, and say where, why and whether they part.

    Args:
        system: as loaded.
        vary: the choice, such as "precision" or "contact=earlier"; "all" screens every choice. Default what
            the [fork] table of the system file says, as for steps and split.
        steps: to make; default the system's own.
        split: separation of heights that counts as split, m; default 1 % of the largest start height.
        repeats: further pairs of runs with perturbed starts at most, to tell a delay from chance; default 15.
        counterfactual: whether to run either program under the other's decisions too.
        out: the new fork folder; default runs/fork-<name>-<n>.
        report: write report.html.
        progress: called now and then with step, steps and a dictionary of figures.

    Raises:
        InputError: the choice is unknown, or does not apply to the system.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks import fork as follow
    from mdnum.forks.choices import parse, shipped, twin_of
    from mdnum.forks.pair import repeats_asked

    asked_split, table = split is not None, system.spec.fork
    if table is not None:
        vary, steps, split = vary or table.vary, steps or table.steps, split or table.split
    if vary is None:
        raise InputError(
            "nothing to vary",
            where=system.name,
            remedy=f"Add --vary CHOICE, or --vary all. There are {', '.join(shipped('ball'))}",
        )
    system = system if steps is None else system.for_steps(steps)
    if vary == ALL:
        given = {"split": asked_split, "repeats": repeats is not None, "counterfactual": not counterfactual}
        refuse(given, "of one comparison, and all choices were asked for", "Give one choice to vary")
        return _screen(system, out, report, progress)
    choice = parse(vary)
    repeats_asked(repeats, counterfactual)
    began = time.perf_counter()
    say(progress, 0, "compile")
    twin = twin_of(choice, system)
    folder = _opened(system, out)
    try:
        options: dict[str, Any] = {"split": split, "repeats": repeats, "counterfactual": counterfactual}
        made = follow(twin, progress=Log(folder, progress), **options)
        write(folder, made)
        folder.finalize()
        told = {
            "choice": vary,
            "choice_about": choice.describe("ball"),
            "must_hold": choice.must_hold,
            "seconds": time.perf_counter() - began,
        }
        folder.write_summary(summarize(system, made) | told)
    except BaseException:
        folder.close()
        raise
    return ForkResult(folder.path, made, finish(folder, report, progress))


def _screen(
    system: BallSystem, out: str | Path | None, report: bool, progress: Progress | None
) -> ForkResult:
    """Every choice that applies, ranked by when it forks."""
    from mdnum.forks.screen import screen
    from mdnum.workflow.fork_screen import noted, ranked

    began = time.perf_counter()
    folder = _opened(system, out)
    try:
        rows = screen(system, progress=noted(folder, progress))
        folder.finalize()
        folder.write_summary(
            _basics(system) | {"choice": "all", **ranked(rows), "seconds": time.perf_counter() - began}
        )
    except BaseException:
        folder.close()
        raise
    return ForkResult(folder.path, None, finish(folder, report, progress))


def _opened(system: Any, out: str | Path | None) -> RunFolder:
    return opened(system, KIND, out)


def _basics(system: BallSystem) -> dict[str, Any]:
    """What every summary of a ball's fork folder says."""
    steps = system.spec.integrator.steps
    return {
        "world": "fork",
        "question": KIND,
        "system": system.name,
        "about": system.spec.about,
        "balls": system.balls,
        "contact_kind": system.spec.contact.kind,
        "integrator": system.spec.integrator.kind,
        "counted": "impacts" if system.spec.integrator.kind == "event-located" else "iterations",
        "steps": steps,
        "steps_asked": steps,
        "timestep": system.spec.integrator.timestep,
        "units": "ball",
        "findings": [],
        "status": "complete",
    }


def write(folder: RunFolder, fork: Fork) -> None:
    """Puts the series and the decisions that differ into a folder's tables."""
    series = fork.series
    rows = len(series["step"])
    columns = {name: series.get(key, np.full(rows, np.nan)) for name, key in _SERIES.items()}
    columns |= {"step": series["step"], "time": series["step"] * fork.twin.a.timestep}
    columns |= {f"repeat_{name[2:]}": series[name] for name in series if name.startswith("B ")}
    folder.append("separation", columns)
    if fork.decision is not None:
        folder.append("around", _around(fork, fork.decision))
    if not fork.flips:
        return
    flips = fork.flips[:ROWS_KEPT]
    names = ("step", "channel", "ball", "a", "b", "margin_a", "margin_b", "bound_a", "bound_b", "run")
    column = {name: np.array([getattr(flip, name) for flip in flips]) for name in names}
    in_a = column["run"] == "A"
    more = {
        "i": column["ball"],
        "j": np.full(len(flips), -1),
        "differs": np.ones(len(flips), bool),
        "entered": np.ones(len(flips), bool),
        "margin": np.where(in_a, column["margin_a"], column["margin_b"]),
        "bound": np.where(in_a, column["bound_a"], column["bound_b"]),
    }
    folder.append("cross_flips", column | more)


def _around(fork: Fork, made: Decision) -> dict[str, Any]:
    """The deciding ball (the first, where they decide together) in both runs around the fork."""
    ball = made.subject[0] if made.subject else 0
    step = np.arange(max(0, made.step - _BEFORE), min(fork.steps, made.step + _AFTER) + 1)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("step", "run", "ball", "y", "v", "contact")}
    for name in "AB":
        run = fork.runs[name]
        touching = np.r_[False, run.contact[:, ball]]
        for column, values in (
            ("step", step),
            ("run", np.full(len(step), name)),
            ("ball", np.full(len(step), ball)),
            ("y", run.y[step, ball].astype(np.float64)),
            ("v", run.v[step, ball].astype(np.float64)),
            ("contact", touching[step]),
        ):
            rows[column].append(values)
    return {name: np.concatenate(parts) for name, parts in rows.items()}


def summarize(system: BallSystem, fork: Fork) -> dict[str, Any]:
    """The content of summary.json, without choice, headline and findings."""
    step = fork.twin.a.timestep
    free, rate = fork.series["B"], fork.growth["B"]
    total = fork.flips_total
    return _basics(system) | {
        "difference": fork.twin.difference,
        "changes": {key: list(values) for key, values in fork.twin.changes.items()},
        "steps": fork.steps,
        "steps_asked": fork.asked,
        **numbers.dates(fork.dates, step),
        "tolerance": fork.tolerance,
        "decision": None if fork.decision is None else _decision(fork.decision),
        **numbers.verdict(fork.verdict),
        **numbers.rate(rate, step),
        "growth": {name: numbers.fitted(fit, fork.series[name]) for name, fit in fork.growth.items()},
        **numbers.predicted(fork.dates, free, fork.tolerance, fork.steps),
        "splits": {name: fork.splits[name] for name in ("B", "B|A", "A|B") if name in fork.splits},
        "table": [numbers.cell(cell) for cell in fork.table],
        "shares": [numbers.share(share) for share in fork.shares],
        **numbers.repeats(fork.repeats),
        "handed_until": numbers.until(fork.series, "B|A"),
        "handed_largest": numbers.largest(fork.series, "B|A"),
        "separation_end": numbers.plain(free[-1]),
        "separation_largest": numbers.largest(fork.series, "B"),
        "overridden": numbers.total(fork.series, "overridden"),
        "cross_flips": total,
        "cross_flips_kept": min(total, ROWS_KEPT),
        "cross_contacts": int(sum(flip.channel == "contact" for flip in fork.flips)),
        "cross_stops": int(sum(flip.channel == "stop" for flip in fork.flips)),
        "failed": {name: word for name, word in fork.failed.items() if word},
        "status": "failed" if fork.failed else "complete",
    }


def _decision(made: Decision) -> dict[str, Any]:
    """The decision at the fork, in plain values."""
    finite = {name: numbers.plain(margin) for name, margin in made.margins.items()}
    margin, bound = finite[made.run], made.bounds[made.run]
    before = made.separation
    return {
        "channel": made.channel,
        "step": made.step,
        "ball": made.subject[0] if made.subject else None,
        "run": made.run,
        "entered": True,
        "decided": {"A": made.a, "B": made.b},
        "space": "height" if made.channel == "contact" else "residual",
        "margin": margin,
        "bound": bound,
        "ambiguous": made.run in made.ambiguous_in,
        "margins": finite,
        "bounds": made.bounds,
        "ambiguous_in": made.ambiguous_in,
        "separation_before": before,
        "protected": abs(margin) / before if margin is not None and before > 0 else None,
        "also": made.also,
    }
