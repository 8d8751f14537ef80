"""`mdnum fork SYSTEM --along` as a function: a run as a piecewise function of one number, into a folder."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.store import RunFolder
from mdnum.workflow.fork_question import Log, Progress, basics, finish, loaded, opened, steps_of

if TYPE_CHECKING:
    from mdnum.forks.boundaries import Boundary, BoundaryMap
    from mdnum.forks.histories import Loss
    from mdnum.systems.load import System

#: What boundaries.parquet says of a boundary that was or was not found again by a fresh process.
_CONFIRMED = {True: "yes", False: "no", None: "not asked"}


@dataclass(frozen=True)
class MapResult:
    """A finished map.

    Attributes:
        folder: the fork folder.
        map: intervals of one history each, and the boundaries between them.
        summary: what summary.json says, findings included.
    """

    folder: Path
    map: BoundaryMap
    summary: dict[str, Any]


def fork_map(
    system: System | str | Path,
    key: str,
    low: float,
    high: float,
    *,
    steps: int | None = None,
    cells: int = 64,
    most: int | None = None,
    loss: Loss | None = None,
    confirm: bool = True,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> MapResult:
    """Where the history of a run's decisions changes along a number, to adjacent floats.

    Args:
        system: a loaded system, a shipped name or the path of a system file.
        key: the number, such as "potential.sigma", "timestep" or "position.17.x".
        low, high: the interval, in the units of the system's file; both belong to it.
        steps: last step of every run; default the system's own, but no more than 500.
        cells: of the grid that tells where to look.
        most: stop after so many boundaries; default 24.
        loss: of the final state, called with the simulation, unwrapped positions and velocities; default the
            mean squared displacement from the start.
        confirm: whether to run both sides of every boundary again in a fresh process.
        out: the new fork folder; default runs/fork-<name>-<n>.
        overrides: dotted keys to values, such as {"cutoff.kind": "switched"}.
        report: write report.html.
        progress: called now and then with what is done, of how much, and a dictionary of figures.

    Raises:
        InputError: the system cannot be run, no such number, or an interval that makes no sense.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks.boundaries import MOST, boundaries
    from mdnum.forks.dials import checked, dial, unit
    from mdnum.forks.histories import squared_displacement
    from mdnum.systems import build

    began = time.perf_counter()
    system = loaded(system, overrides)
    last = steps_of(system, steps)
    # what cannot be is refused before there is a folder
    simulation = build(system)
    one = dial(simulation, key)
    checked(one, low, high)
    for end in (low, high):
        one.turn(simulation, end)
    folder = opened(system, "along", out)
    try:
        found = boundaries(
            system, one.key, low, high, last, cells=cells, most=MOST if most is None else most,
            loss=squared_displacement if loss is None else loss, confirm=confirm,
            progress=Log(folder, progress),
        )  # fmt: skip
        _write(folder, found)
        folder.log(found.words)
        folder.finalize()
        units = system.units
        summary = {
            **basics(system, "along", last),
            "key": one.key,
            "key_unit": unit(simulation, one.key),
            "value": one.value,
            "loss": "mean squared displacement" if loss is None else getattr(loss, "__name__", "loss"),
            "loss_unit": f"{units.length}²" if loss is None else "",
            **_summary(found, confirm),
            "compiles": one.compiles,
            "seconds": time.perf_counter() - began,
        }
        folder.write_summary(summary)
    except BaseException:
        folder.close()
        raise
    return MapResult(folder.path, found, finish(folder, report, progress))


def _row(edge: Boundary) -> dict[str, Any]:
    below, above = edge.below, edge.above
    return {
        "below": below.at,
        "above": above.at,
        "step": edge.step,
        "i": edge.i,
        "j": edge.j,
        "inside": above.inside,
        "also": edge.also,
        "margin_below": below.margin,
        "margin_above": above.margin,
        "bound": edge.bound,
        "loss_below": below.loss,
        "loss_above": above.loss,
        "jump": edge.jump,
        "energy_below": below.energy,
        "energy_above": above.energy,
        "apart": edge.apart,
        "confirmed": _CONFIRMED[edge.confirmed],
    }


def _write(folder: RunFolder, found: BoundaryMap) -> None:
    """Puts boundaries, intervals and runs into the folder's tables."""
    rows = [_row(edge) for edge in found.boundaries]
    if rows:
        folder.append("boundaries", {name: np.array([row[name] for row in rows]) for name in rows[0]})
    names = ("low", "high", "history", "digest", "loss_low", "loss_high", "runs", "gap")
    folder.append(
        "intervals", {name: np.array([getattr(one, name) for one in found.intervals]) for name in names}
    )
    starts = np.array([one.low for one in found.intervals])
    numbers = np.array([one.history for one in found.intervals])
    history = numbers[np.searchsorted(starts, found.at, side="right") - 1]
    folder.append("points", {"at": found.at, "history": history, "loss": found.loss, "energy": found.energy})


def _summary(found: BoundaryMap, confirm: bool) -> dict[str, Any]:
    edges = found.boundaries
    return {
        "low": found.low,
        "high": found.high,
        "histories": found.histories,
        "complete": found.complete,
        "resolution": found.resolution,
        "evaluations": found.evaluations,
        "failed_runs": found.failed,
        "confirm": confirm,
        "confirmed": sum(edge.confirmed is True for edge in edges) if confirm else None,
        "jump_largest": max((abs(edge.jump) for edge in edges), default=None),
        "apart_largest": max((edge.apart for edge in edges), default=None),
        "boundaries": [_row(edge) for edge in edges],
        "intervals": [
            {
                "low": one.low,
                "high": one.high,
                "history": one.history,
                "loss_low": one.loss_low,
                "loss_high": one.loss_high,
                "runs": one.runs,
            }
            for one in found.intervals
        ],
        "unresolved": [list(ends) for ends in found.unresolved],
        "says": found.words,
    }
