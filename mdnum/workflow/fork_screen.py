"""`mdnum fork SYSTEM --vary all`: every choice that applies, ranked by when it forks."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.workflow.fork import ForkResult, Progress, judge, new_folder, say

if TYPE_CHECKING:
    from mdnum.forks.screen import Screened
    from mdnum.store import RunFolder
    from mdnum.systems.load import System


def screen(
    system: System,
    steps: int | None,
    *,
    out: str | Path | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> ForkResult:
    """Follow the free runs of every choice, and rank the choices into a fork folder.

    Counterfactuals are left to the choices that turn out to matter.

    Args:
        system: as loaded.
        steps: horizon; default the system's own.
        out: the new fork folder.
        report: write report.html.
        progress: called with choices done, how many there are, and the name of the next as the phase.
    """
    from mdnum.forks.screen import screen as screen_choices

    began = time.perf_counter()
    folder = new_folder(system, out)
    try:
        rows = screen_choices(system, steps, progress=noted(folder, progress))
        folder.finalize()
        folder.write_summary(
            _basics(system, steps) | {**ranked(rows), "seconds": time.perf_counter() - began}
        )
    except BaseException:
        folder.close()
        raise
    say(progress, 0, "report" if report else "check")
    judge(folder, report)
    return ForkResult(folder.path, None, folder.summary)


def noted(folder: RunFolder, progress: Progress | None) -> Callable[[int, int, str], None]:
    """What a screening calls before each choice: a line in the log, and the choice as the phase."""

    def note(done: int, count: int, name: str) -> None:
        folder.log(f"{done:4d} of {count}  {name}")
        if progress is not None:
            progress(done, count, {"phase": f"{name} ({done + 1} of {count})"})

    return note


def ranked(rows: list[Screened]) -> dict[str, Any]:
    """The ranking, and the choices that do not apply, as summary.json has them."""
    ranking = [
        {
            "choice": row.choice,
            "difference": row.difference,
            "seed": row.seed,
            "fork": row.fork,
            "split": row.split,
            "must_hold": row.must_hold,
            "held": row.held,
            "steps": row.steps,
            "failed": row.failed,
        }
        for row in rows
        if row.reason_unavailable is None
    ]
    left = [
        {"choice": row.choice, "why": row.reason_unavailable}
        for row in rows
        if row.reason_unavailable is not None
    ]
    return {"ranking": ranking, "not_applicable": left}


def _basics(system: System, steps: int | None) -> dict[str, Any]:
    asked = system.spec.dynamics.steps if steps is None else steps
    return {
        "world": "fork",
        "system": system.name,
        "about": system.spec.about,
        "choice": "all",
        "atoms": len(system.atoms),
        "steps": asked,
        "steps_asked": asked,
        "timestep": float(system.spec.dynamics.timestep),
        "units": system.units.name,
        "findings": [],
        "status": "complete",
    }
