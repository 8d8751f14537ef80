"""`mdnum fork SYSTEM --along` as a function: a run as a piecewise function of one number, into a folder."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.store import COLUMNS, RunFolder
from mdnum.workflow.fork_question import Log, Progress, basics, finish, is_ball, loaded, opened, steps_of

if TYPE_CHECKING:
    from mdnum.forks.histories import Loss
    from mdnum.forks.piecewise import Boundary, BoundaryMap
    from mdnum.systems.ball_system import BallSystem
    from mdnum.systems.load import System

#: What boundaries.parquet says of a boundary that was or was not found again by a fresh process.
_CONFIRMED = {True: "yes", False: "no", None: "not asked"}


@dataclass(frozen=True)
class MapResult:
    """A finished map.

    Attributes:
        folder: the fork folder.
        map: intervals of one history each, and the boundaries between them; None of a ball.
        summary: what summary.json says, findings included.
    """

    folder: Path
    map: BoundaryMap | None
    summary: dict[str, Any]


def fork_map(
    system: System | BallSystem | str | Path,
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
        system: a loaded system, a shipped name or the path of a system file; a ball too.
        key: the number, such as "potential.sigma", "timestep" or "position.17.x"; of a ball "k", "tol", "y0".
        low, high: the interval, in the units of the system's file; both belong to it.
        steps: last step of every run; default the system's own, but no more than 500 of molecular dynamics.
        cells: of the grid that tells where to look.
        most: stop after so many boundaries; default 24, and of a ball 64.
        loss: of the final state, called with the simulation, unwrapped positions and velocities; default the
            mean squared displacement from the start. That of a ball is the file's.
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
    if is_ball(system):
        if loss is not None:
            raise InputError("the loss of a ball is that of its system file", remedy="Leave out loss")
        options = {"cells": cells, "most": most, "confirm": confirm}
        return _ball(system, (key, low, high), steps, options, out, overrides, report, progress)
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
        edges = [_row(edge) for edge in found.boundaries]
        for name, rows in (
            ("boundaries", edges),
            ("intervals", _intervals(found)),
            ("points", _points(found)),
        ):
            _write(folder, name, rows)
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
            **_summary(found, edges, confirm),
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
        "who": f"{edge.i}–{edge.j}",
        "says": f"pair {edge.i}–{edge.j} {'enters its cutoff' if above.inside else 'is left out'}",
        "way": f"in {'above' if above.inside else 'below'}",
        "channel": "pair",
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


def _ball(
    system: Any, along: tuple[str, float, float], steps: int | None, options: dict[str, Any],
    out: str | Path | None, overrides: Mapping[str, Any] | None, report: bool, progress: Progress | None,
) -> MapResult:  # fmt: skip
    """The map of a ball, in a folder of the same kind."""
    from mdnum.systems import BallSystem, load
    from mdnum.workflow.fork_map_ball import MOST, search

    began = time.perf_counter()
    if not isinstance(system, BallSystem):
        system = load(system, overrides, world="ball")
    system = system if steps is None else system.for_steps(steps)
    options["most"] = MOST if options["most"] is None else options["most"]
    say = progress if progress is not None else (lambda *_: None)
    found, tables = search(system, *along, **options, tell=lambda phase: say(0, 0, {"phase": phase}))
    folder = opened(system, "along", out)
    try:
        for name, rows in tables.items():
            _write(folder, name, rows)
        for edge in found["boundaries"]:
            folder.log(f"from {edge['above']!r} on {edge['says']} in step {edge['step']}")
        folder.finalize()
        folder.write_summary(
            {
                "world": "fork",
                "question": "along",
                "system": system.name,
                "about": system.spec.about,
                "balls": system.balls,
                "steps": system.spec.integrator.steps,
                "timestep": system.spec.integrator.timestep,
                "units": "ball",
                **found,
                "findings": [],
                "status": "complete",
                "seconds": time.perf_counter() - began,
            }
        )
    except BaseException:
        folder.close()
        raise
    return MapResult(folder.path, None, finish(folder, report, progress))


def _write(folder: RunFolder, table: str, rows: list[dict[str, Any]]) -> None:
    """Appends rows to a table of the folder, of each what the table has a column for."""
    if rows:
        names = [name for name in rows[0] if name in COLUMNS[table] or name.startswith("gradient")]
        folder.append(table, {name: np.array([row[name] for row in rows]) for name in names})


def _intervals(found: BoundaryMap) -> list[dict[str, Any]]:
    names = ("low", "high", "history", "digest", "loss_low", "loss_high", "runs", "gap")
    return [{name: getattr(one, name) for name in names} for one in found.intervals]


def _points(found: BoundaryMap) -> list[dict[str, Any]]:
    starts = [one.low for one in found.intervals]
    pieces = np.searchsorted(starts, found.at, side="right") - 1
    return [
        {"at": at, "history": found.intervals[piece].history, "loss": loss, "energy": energy}
        for at, piece, loss, energy in zip(found.at, pieces, found.loss, found.energy, strict=True)
    ]


def _summary(found: BoundaryMap, rows: list[dict[str, Any]], confirm: bool) -> dict[str, Any]:
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
        "jump_largest": max((abs(edge.jump) for edge in edges if np.isfinite(edge.jump)), default=None),
        "apart_largest": max((edge.apart for edge in edges), default=None),
        "boundaries": rows,
        "intervals": [
            {name: row[name] for name in row if name not in ("digest", "gap")} for row in _intervals(found)
        ],
        "unresolved": [list(ends) for ends in found.unresolved],
        "says": found.words,
    }
