"""`mdnum fork SYSTEM --forecast` as a function: flips foretold by one tangent run, into a folder."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError
from mdnum.store import RunFolder
from mdnum.workflow.fork_question import OF_A_BALL, Log, Progress, basics, finish, loaded, opened

if TYPE_CHECKING:
    from mdnum.forks.forecast import Forecast, ForecastRange, PredictedFlip
    from mdnum.systems.load import System

#: Flips that are listed of each kind.
_FIRST, _NEAREST = 10, 10


@dataclass(frozen=True)
class ForecastResult:
    """A finished forecast.

    Attributes:
        folder: the fork folder.
        forecast: what perturbations along its direction will flip.
        summary: what summary.json says, findings included.
    """

    folder: Path
    forecast: Forecast
    summary: dict[str, Any]


def fork_forecast(
    system: System | str | Path,
    size: float,
    *,
    steps: int | None = None,
    out: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> ForecastResult:
    """Which decisions a random displacement of the start would flip first, from one tangent run.

    Args:
        system: a loaded system, a shipped name or the path of a system file; pair potentials only.
        size: of the displacement: how far the furthest atom is moved, length.
        steps: last step; default the system's own.
        out: the new fork folder; default runs/fork-<name>-<n>.
        overrides: dotted keys to values.
        report: write report.html.
        progress: called at each phase with a dictionary that names it.

    Raises:
        InputError: the system cannot be run, its potential is a many-body one, or size is no length.
        FolderError: the folder cannot be used.
    """
    from mdnum.forks.forecast import LINEAR, forecast
    from mdnum.systems import build

    if not 0 < size < float("inf"):
        raise InputError(f"a displacement of {size:g}; expected a length above 0")
    began = time.perf_counter()
    system = loaded(system, overrides, OF_A_BALL["--forecast"])
    simulation = build(system)
    if not simulation.pairwise:
        raise InputError(
            "decisions of a many-body potential are not foretold",
            where=system.name,
            remedy="Use a system with a pair potential",
        )
    last = system.spec.dynamics.steps if steps is None else steps
    if last < 1:
        raise InputError(f"steps = {last}; expected at least 1")
    folder = opened(system, "forecast", out)
    try:
        Log(folder, progress)(0, 0, {"phase": "carrying a tangent along"})
        found = forecast(simulation, last)
        first, nearest, good = found.first(size, _FIRST), found.nearest(_NEAREST), found.good_until(size)
        _write(folder, found, {"first": first, "nearest": nearest})
        folder.finalize()
        summary = {
            **basics(system, "forecast", last),
            "size": size,
            "first": [_row(flip) for flip in first],
            "nearest": [_row(flip) for flip in nearest],
            "until": good.step,
            "ends": good.ends,
            "kicks": found.kicks,
            "examined": int(found.listed[: good.step + 1].sum()),
            "says": _says(good, last, int(found.listed[: good.step + 1].sum())),
            "linear": LINEAR * simulation.r_cut,
            "ulp": found.ulp,
            "seconds": time.perf_counter() - began,
        }
        folder.write_summary(summary)
    except BaseException:
        folder.close()
        raise
    return ForecastResult(folder.path, found, finish(folder, report, progress))


def _says(good: ForecastRange, last: int, examined: int) -> str:
    """How far a forecast goes, why no further, and what it looked at."""
    why = {
        "end": "",
        "flip": ": the flip there kicks its atoms, and what follows is not foretold",
        "close": f": whether a decision of step {good.step + 1:,} flips is within the error",
        "size": ": the displacement is too large for a forecast after it",
        "list": ": a pair beyond the neighbor list could come inside after it, and those are not looked at",
    }[good.ends]
    until = f"up to step {good.step:,} of {last:,}" if good.step >= 0 else f"for no step of {last:,}"
    return f"Good {until}{why}; {examined:,} decisions of listed pairs were examined."


def _row(flip: PredictedFlip) -> dict[str, Any]:
    return {name: getattr(flip, name) for name in ("step", "i", "j", "amplitude", "margin", "ulps")}


def _write(folder: RunFolder, found: Forecast, lists: Mapping[str, tuple[PredictedFlip, ...]]) -> None:
    """Puts the flips that are listed, and the nearest one of every step, into the folder's tables."""
    for asked, flips in lists.items():
        rows = [_row(flip) for flip in flips]
        if rows:
            columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
            folder.append("foretold", {"asked": np.full(len(rows), asked), **columns})
    least = np.argmin(found.reach, axis=2, keepdims=True)
    reach = np.take_along_axis(found.reach, least, axis=2)[:, :, 0]
    sign = np.argmin(reach, axis=0)
    row = np.arange(reach.shape[1])
    pair = found.pairs[sign, row, least[sign, row, 0]]
    folder.append(
        "reach",
        {
            "step": row,
            "positive": reach[0],
            "negative": reach[1],
            "i": pair[:, 0],
            "j": pair[:, 1],
            "furthest": found.furthest,
        },
    )
