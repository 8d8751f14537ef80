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
from mdnum.workflow.fork_question import Log, Progress, basics, finish, opened, steps_of

if TYPE_CHECKING:
    from mdnum.forks.boundaries import Boundary, BoundaryMap
    from mdnum.rollout.program import Loss
    from mdnum.systems.ball_system import BallSystem
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
    from mdnum.forks.boundaries import boundaries, checked
    from mdnum.forks.worlds import program_of
    from mdnum.systems import BallSystem
    from mdnum.workflow.fork import loaded_of_any
    from mdnum.workflow.fork_words import map_words

    began = time.perf_counter()
    given: Any = loaded_of_any(system, overrides)
    is_ball = isinstance(given, BallSystem)
    if is_ball and loss is not None:
        raise InputError("the loss of a ball is that of its system file", remedy="Leave out loss")
    if is_ball:
        given = given if steps is None else given.for_steps(steps)
        last = given.spec.integrator.steps
    else:
        last = steps_of(given, steps)
    # what cannot be is refused before there is a folder
    number = checked(program_of(given), key, low, high)
    folder = opened(given, "along", out)
    try:
        found = boundaries(
            given, number.key, low, high, last, cells=cells, most=most, loss=loss, confirm=confirm,
            progress=Log(folder, progress),
        )  # fmt: skip
        edges = [_row(edge) for edge in found.boundaries]
        for name, rows in (
            ("boundaries", edges),
            ("intervals", _intervals(found)),
            ("points", _points(found)),
        ):
            _write(folder, name, rows)
        folder.log(map_words(found))
        folder.finalize()
        folder.write_summary(
            {
                **(_ball_basics(given) if is_ball else basics(given, "along", last)),
                "key": number.key,
                "key_unit": number.unit,
                "value": number.value,
                **_loss(given, loss),
                **_summary(found, edges, confirm),
                "says": map_words(found),
                "compiles": number.compiles,
                "seconds": time.perf_counter() - began,
            }
        )
    except BaseException:
        folder.close()
        raise
    return MapResult(folder.path, found, finish(folder, report, progress))


def _ball_basics(system: BallSystem) -> dict[str, Any]:
    return {
        "world": "fork",
        "question": "along",
        "system": system.name,
        "about": system.spec.about,
        "balls": system.balls,
        "steps": system.spec.integrator.steps,
        "timestep": system.spec.integrator.timestep,
        "units": "ball",
        "findings": [],
        "status": "complete",
    }


def _loss(system: Any, loss: Any) -> dict[str, str]:
    if hasattr(system, "balls"):
        kind = str(system.spec.loss.kind)
        return {"loss": kind.replace("-", " "), "loss_unit": "m²" if kind == "residual-penetration" else "m"}
    if loss is None:
        return {"loss": "mean squared displacement", "loss_unit": f"{system.units.length}²"}
    return {"loss": getattr(loss, "__name__", "loss"), "loss_unit": ""}


def _row(edge: Boundary) -> dict[str, Any]:
    below, above = edge.below, edge.above
    subject = [*edge.subject, -1, -1][:2]
    if edge.channel == "pair":
        who = "–".join(map(str, edge.subject))
        says = f"pair {who} {'enters its cutoff' if above.decided else 'is left out'}"
        way = f"in {'above' if above.decided else 'below'}"
    elif edge.channel == "contact":
        who = f"ball {subject[0]}"
        says = f"{who} {'touches' if above.decided else 'misses'} the floor"
        way = f"touches {'above' if above.decided else 'below'}"
    else:
        who = f"ball {subject[0]}" if edge.subject else "solver"
        solver = f"the solver of {who}" if edge.subject else "the solver"
        says = f"{solver} makes {above.decided} iterations instead of {below.decided}"
        way = f"{below.decided} → {above.decided}"
    gradients = {"gradient_below": below.gradient, "gradient_above": above.gradient}
    if edge.channel == "pair":
        gradients = {}
    return {
        "below": below.at,
        "above": above.at,
        "step": edge.step,
        "i": subject[0],
        "j": subject[1],
        "who": who,
        "says": says,
        "way": way,
        "channel": edge.channel,
        "inside": above.decided < below.decided if edge.channel == "stop" else bool(above.decided),
        "also": edge.also,
        "margin_below": below.margin,
        "margin_above": above.margin,
        "bound": edge.bound,
        "loss_below": below.loss,
        "loss_above": above.loss,
        "jump": edge.jump,
        **gradients,
        "energy_below": below.energy,
        "energy_above": above.energy,
        "apart": edge.apart,
        "confirmed": _CONFIRMED[edge.confirmed],
    }


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
    }
