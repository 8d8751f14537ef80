"""Computation of the points of a sweep by a worker process."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from mdnum.errors import FolderError, InputError, MdnumError
from mdnum.sweeps.measures import Sample, chosen, measured
from mdnum.sweeps.plan import resolved
from mdnum.sweeps.points import Workspace, write_result
from mdnum.verbs import sweep_measures  # noqa: F401  adds measures

_SERIES = "series.parquet"


@dataclass(frozen=True)
class Task:
    """Points of a sweep that one process computes in sequence."""

    workspace: str
    points: tuple[Mapping[str, Any], ...]  # each with address, state and settings
    system: Any  # path or name of a system, or a simulation that was pickled by value
    overrides: Mapping[str, Any]
    measures: Mapping[str, str]  # names, with the digests of their sources
    keep: bool  # run folders


def enough(result: Mapping[str, Any] | None, measures: Mapping[str, str]) -> bool:
    """True if a result is complete, or if another attempt would fail again."""
    if result is None:
        return False
    if result["status"] == "failed":
        # what failed for no reason of its own, such as a process that was killed, is tried by the next sweep
        return not result.get("again", False)
    return not _missing(result, measures)


def _missing(result: Mapping[str, Any] | None, measures: Mapping[str, str]) -> list[str]:
    """Return the measures that are not stored, or were computed by other source code."""
    stored = {} if result is None else result["measures"]
    return [name for name, at in measures.items() if stored.get(name, {}).get("digest") != at]


def work(task: Task) -> list[dict[str, Any]]:
    """Compute the missing points of a task. Return the address and the status of each point.

    The status is "computed" (now), "there" (stored before), "busy" (in another process), or "full" (not
    writable), with the reason.
    """
    place, told = Workspace(Path(task.workspace)), []
    for point in task.points:
        address, status, why = point["address"], "there", ""
        if not enough(place.result(address), task.measures):
            with place.claimed(address) as mine:
                status = "busy"
                if mine and enough(place.result(address), task.measures):
                    status = "there"
                elif mine:
                    try:
                        _compute(place, task, point)
                        status = "computed"
                    except FolderError as error:
                        status, why = "full", str(error)
        told.append({"address": address, "status": status, "why": why})
    return told


def _compute(place: Workspace, task: Task, point: Mapping[str, Any]) -> None:
    began = perf_counter()
    stored = place.result(point["address"])
    world = "ball" if "integrator" in point["state"]["system"] else "md"
    measures = chosen(_missing(stored, task.measures), world)
    if other := [one.name for one in measures if one.digest != task.measures[one.name]]:
        message = "the file has changed since the sweep began"
        raise InputError(message, where=other[0], remedy="Start the sweep again")
    series = place.folder(point["address"]) / _SERIES
    with place.filling(point["address"], point["state"]) as folder:
        result: dict[str, Any]
        try:
            known = stored["summary"] if stored else {}
            if known and series.exists() and all(one.needs != "frames" for one in measures):
                sample = _sample(task, point, folder, series, known)
            else:
                sample = _run(task, point, folder)
            result = {"status": "complete", "summary": sample.summary, "measures": measured(measures, sample)}
            if stored is not None:
                result["measures"] = {**stored["measures"], **result["measures"]}
        except (FolderError, OSError):
            raise
        except MdnumError as error:
            result = {"status": "failed", "why": str(error), "measures": {}, "summary": {}}
        except Exception as error:
            why = f"{type(error).__name__}: {error}"
            result = {"status": "failed", "why": why, "measures": {}, "summary": {}, "again": True}
        result["seconds"] = perf_counter() - began + (stored or {}).get("seconds", 0.0)
        write_result(folder, result)
        if not task.keep:
            shutil.rmtree(folder / "run", ignore_errors=True)


def _simulation(task: Task, point: Mapping[str, Any]) -> Any:
    """Build the simulation, or the ball system, of a point."""
    from mdnum.systems import opened

    if isinstance(task.system, str):
        return opened(task.system, {**task.overrides, **point["settings"]})
    import cloudpickle

    return resolved(cloudpickle.loads(task.system), point["settings"])


def _run(task: Task, point: Mapping[str, Any], folder: Path) -> Sample:
    from mdnum.systems import BallSystem
    from mdnum.verbs.run import run

    system = _simulation(task, point)
    if isinstance(system, BallSystem):
        return _bounced(system, point["state"]["asked"]["steps"], task, point, folder)
    made = run(
        system, **point["state"]["asked"], out=folder / "run", check=False, report=False,
        progress=False,
    )  # fmt: skip
    shutil.copy(folder / "run" / _SERIES, folder / _SERIES)
    kept = ("atoms", "steps", "dynamics", "lost_pairs", "flips_entered", "steps_per_second", "wall_seconds")
    summary = {name: made.summary[name] for name in kept}
    structure = made.result.simulation
    summary |= {"k_B": structure.units.k_B, "volume": structure.cell.volume, "units": structure.units.name}
    return _sample(task, point, folder, folder / _SERIES, summary, made)


def _bounced(system: Any, steps: int, task: Task, point: Mapping[str, Any], folder: Path) -> Sample:
    """Simulate a ball, and return the data from which measures are computed."""
    import pyarrow
    import pyarrow.parquet as parquet

    from mdnum.systems.build_ball import problem
    from mdnum.verbs.ball_record import steps as rows

    run = problem(system.for_steps(steps).spec).run()
    parquet.write_table(pyarrow.table(rows(run)), folder / _SERIES)
    summary = {"atoms": run.balls, "steps": run.steps, "k_B": 1.0, "volume": float("nan"), "units": "ball"}
    return _sample(task, point, folder, folder / _SERIES, summary)


def _sample(
    task: Task, point: Mapping[str, Any], folder: Path, series: Path, summary: Any, outcome: Any = None
) -> Sample:
    import pyarrow.parquet as parquet

    table = parquet.read_table(series)
    columns = {name: np.asarray(table[name]) for name in table.column_names}
    return Sample(
        columns, summary, summary["atoms"], summary["k_B"], folder / "run", summary["volume"], outcome,
        lambda: _simulation(task, point),
    )  # fmt: skip
