"""`mdnum ball` as a function: bounce, compare variants and gradients, judge, report."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.store.naming import default_folder

if TYPE_CHECKING:
    from mdnum.ball.problem import Problem
    from mdnum.ball.rollout import BallRun
    from mdnum.systems.ball_system import BallSystem
    from mdnum.systems.build_ball import BallSimulation

Progress = Callable[[int, int, dict[str, Any]], None]

#: Balls times steps of which every state is kept, and residuals of stop decisions kept.
_STATES, _RESIDUALS = 20_000_000, 5_000_000


@dataclass(frozen=True)
class BallResult:
    """A finished run of the ball.

    Attributes:
        folder: the run folder.
        run: every decision, and every state where there was room for them.
        summary: what summary.json says, findings and verdict included.
    """

    folder: Path
    run: BallRun
    summary: dict[str, Any]


def bounce(
    system: BallSystem | str | Path,
    *,
    out: str | Path | None = None,
    steps: int | None = None,
    overrides: Mapping[str, Any] | None = None,
    against: Sequence[str | Mapping[str, Any]] = (),
    report: bool = True,
    progress: Progress | None = None,
) -> BallResult:
    """Run a ball's system and its variants, record every contact and stop decision, and write a report.

    Args:
        system: a loaded system, a shipped name or the path of a system file.
        out: the new run folder; default runs/<name>-<n>.
        steps: instead of the system's.
        overrides: dotted keys to values, such as {"contact.k": 2e4}.
        against: further variants to compare with: "key=value", or several keys in a mapping.
        report: write report.html.
        progress: called now and then with step, steps and a dictionary of figures.

    Returns:
        the run's folder, the run and its summary.

    Raises:
        InputError: the system cannot be run. FolderError: the folder cannot be used.
    """
    from mdnum.provenance import collect
    from mdnum.systems.build_ball import build_ball

    simulation = build_ball(_loaded(system, overrides, against), steps=steps)
    name = simulation.system.name
    folder = RunFolder.create(default_folder(name) if out is None else out, world="ball")
    try:
        folder.write_system(simulation.system.to_toml())
        folder.write_provenance(collect(simulation.system))
        run, summary = _fill(folder, simulation, progress)
        folder.finalize()
        folder.write_summary(summary)
    except BaseException:
        folder.close()
        raise
    _say(progress, run.steps, "report" if report else "check")
    _judge(folder, report)
    return BallResult(folder.path, run, folder.summary)


def _loaded(
    system: BallSystem | str | Path,
    overrides: Mapping[str, Any] | None,
    against: Sequence[str | Mapping[str, Any]],
) -> BallSystem:
    from mdnum.systems import BallSystem, System, load

    if isinstance(system, System):
        raise InputError("this system is molecular dynamics", where=system.name, remedy="Use mdnum.run")
    if isinstance(system, BallSystem):
        if overrides:
            raise InputError(
                "overrides change a system while it is loaded",
                remedy="Load it with the overrides, or give its name",
                where=system.name,
            )
    else:
        system = load(system, overrides, world="ball")
    for changes in against:
        system = system.against(_changes(changes) if isinstance(changes, str) else changes)
    return system


def _changes(text: str) -> dict[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError(
            f"--against {text!r} is not of the form key=value",
            remedy="Write for example --against precision.state=float32",
        )
    return {key.strip(): value.strip()}


def _fill(
    folder: RunFolder, simulation: BallSimulation, progress: Progress | None
) -> tuple[BallRun, dict[str, Any]]:
    """Runs base and variants and puts what they say into the folder's tables and the summary."""
    from mdnum.workflow import ball_exact, ball_record, ball_tables

    problem = simulation.problem
    began = time.perf_counter()
    run, rate = _simulate(problem, progress)
    ball_tables.write(folder, run)
    _say(progress, run.steps, "gradient")
    gradient = gradients(problem, simulation.system.spec.gradient)
    variants = []
    for variant in simulation.variants:
        _say(progress, run.steps, f"variant {variant.name}")
        # without histories: the program is then the one that its gradient runs, and is compiled once
        other = variant.problem.run(keep=run.kept)
        parted = ball_record.parted(run, other)
        folder.append("separations", ball_tables.separations(variant, parted))
        theirs = gradients(variant.problem, simulation.system.spec.gradient, first=True)
        found = ball_record.compared(variant, parted, other, gradient, theirs)
        variants.append({**found, "loss": loss(variant.problem, theirs)})
    summary = ball_record.summarize(simulation, run)
    summary |= {
        "loss": loss(problem, gradient),
        "gradient": gradient,
        "exact": ball_exact.exact(simulation.system, run, gradient),
        "variants": variants,
        "steps_per_second": rate,
        "seconds": time.perf_counter() - began,
    }
    return run, summary


def _simulate(problem: Problem, progress: Progress | None) -> tuple[BallRun, float | None]:
    """The run, and steps per second after the part that holds the compilation (None for a short one)."""
    marks: list[tuple[float, int]] = []

    def note(made: int, steps: int) -> None:
        marks.append((time.perf_counter(), made))
        info: dict[str, Any] = {"phase": "run"}
        if (rate := _rate(marks)) is not None:
            info["steps_per_second"] = rate
        if progress is not None:
            progress(made, steps, info)

    _say(progress, 0, "compile")
    balls = _balls(problem)
    decisions = problem.steps * (_cap(problem) + 1)
    run = problem.run(
        history=_cap(problem) > 0 and decisions <= _RESIDUALS,
        keep=balls * problem.steps <= _STATES,
        progress=note,
    )
    return run, _rate(marks)


def _rate(marks: Sequence[tuple[float, int]]) -> float | None:
    if len(marks) < 2 or marks[-1][0] == marks[0][0]:
        return None
    return (marks[-1][1] - marks[0][1]) / (marks[-1][0] - marks[0][0])


def _balls(problem: Problem) -> int:
    import numpy as np

    return int(np.size(problem.y0))


def _cap(problem: Problem) -> int:
    """The most iterations of a solve; 0 where nothing is solved."""
    rule = getattr(problem.world.contact, "stop", None) or getattr(problem.world.integrator, "stop", None)
    return 0 if rule is None else rule.max_iter


def gradients(problem: Problem, asked: Any, first: bool = False) -> list[dict[str, Any]]:
    """Each derivative that was asked for, as a plain mapping.

    Args:
        problem: of what.
        asked: the [gradient] table.
        first: only the first method.
    """
    from mdnum.ball.gradients import compare

    if not asked.of:
        return []
    made = compare(problem, asked.of, asked.methods[: 1 if first else None])
    found: list[dict[str, Any]] = [
        {
            "method": one.method,
            "says": one.says,
            "value": float(one.value),
            "gradient": {name: float(value) for name, value in one.gradient.items()},
            "depends": {name: bool(value) for name, value in one.depends.items()},
            "why": dict(one.why),
            "details": dict(one.details),
            "refused": False,
        }
        for one in made
    ]
    # a method that does not apply says why; the others are still worth having
    for name, why in made.refused.items():
        found.append(
            {"method": name, "says": why, "value": None, "gradient": {}, "depends": {}, "refused": True}
        )
    return found


def loss(problem: Problem, gradient: Sequence[Mapping[str, Any]]) -> float:
    """The loss, taken from a derivative of the program itself where there is one: it is compiled already."""
    same = ("unrolled", "frozen", "event-aware")
    known = [made["value"] for made in gradient if made["method"] in same and not made["refused"]]
    return known[0] if known else problem.value()


def _judge(folder: RunFolder, report: bool) -> None:
    """Puts findings and verdict into the summary, and writes the report where it is wanted."""
    if report:
        from mdnum.report.ball.html import write_report

        write_report(folder)
    else:
        from mdnum.report.ball.findings import record

        record(folder)


def _say(progress: Progress | None, step: int, phase: str) -> None:
    if progress is not None:
        progress(step, 0, {"phase": phase})
