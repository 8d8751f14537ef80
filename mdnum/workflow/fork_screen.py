"""`mdnum fork SYSTEM --vary all`: every choice that applies, ranked by when it forks."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mdnum.workflow.fork import ForkResult, Progress, judge, new_folder, say

if TYPE_CHECKING:
    from mdnum.forks.choices import Screened
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
    from mdnum.forks.choices import screen as screen_choices

    began = time.perf_counter()
    folder = new_folder(system, out)
    try:

        def note(done: int, count: int, name: str) -> None:
            folder.log(f"{done:4d} of {count}  {name}")
            if progress is not None:
                progress(done, count, {"phase": f"{name} ({done + 1} of {count})"})

        rows = screen_choices(system, steps, progress=note)
        folder.finalize()
        folder.write_summary(_summarize(system, steps, rows, time.perf_counter() - began))
    except BaseException:
        folder.close()
        raise
    say(progress, 0, "report" if report else "check")
    judge(folder, report)
    return ForkResult(folder.path, None, folder.summary)


def _summarize(system: System, steps: int | None, rows: list[Screened], seconds: float) -> dict[str, Any]:
    asked = system.spec.dynamics.steps if steps is None else steps
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
        if row.why_not is None
    ]
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
        "ranking": ranking,
        "not_applicable": [
            {"choice": row.choice, "why": row.why_not} for row in rows if row.why_not is not None
        ],
        "findings": [],
        "status": "complete",
        "seconds": seconds,
    }
