"""What does a sweep cost besides its points: at one second a point, and at ten thousand points?

Answer. TODO

    python scripts/benchmarks/sweep_overhead.py
    python scripts/benchmarks/sweep_overhead.py --points 40 --many 1000

First `--points` points that do nothing for `--seconds` each, on two workers: in place of the run of a point a
function here sleeps and says when it began and ended; all else is mdnum's, from the command to the page. Then
a sweep of `--many` points whose results are there already, made up here with four measures, over two choices
with eight seeds each (`one-at-a-time`), and over three without further seeds (`factorial`).

How to read it. *Between points* is the mean time from the end of a point to the beginning of the next of
the same worker, over the seconds of a point. *More than needed* is the time beyond that of the points on two
workers: from the first point to the last, and of the whole sweep, with the start of Python and of the
workers, which is paid once. Planning is the time until the address of each point is known; `all of it` plans
again, reads all results, tests all differences and writes the page. Times of the second table are those of
the processor.
"""

from __future__ import annotations

import json
import os
import resource
import tempfile
import time
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import parser, start, table

import mdnum

SYSTEM, WORKERS = "argon/liquid-864", 2
SEEDS, STEPS = 8, 20
MEASURES = {"energy": -1.0, "pressure": 0.5, "drift": 0.0, "lost": 0.0}
DESIGNS: dict[str, tuple[int, tuple[str, ...]]] = {
    "one-at-a-time": (SEEDS, ("cutoff.radius", "dynamics.timestep")),
    "factorial": (1, ("cutoff.radius", "dynamics.timestep", "neighbors.skin")),
}
ENDS = {"cutoff.radius": (6.0, 8.5), "dynamics.timestep": (0.0005, 0.004), "neighbors.skin": (0.4, 0.8)}


def asleep(seconds: float, notes: str, task: Any, point: Any, folder: Path) -> Any:
    """In place of a run: nothing, for a while."""
    from mdnum.sweeps.measures import Sample

    began = time.time()
    time.sleep(seconds)
    rows = np.arange(STEPS + 1.0)
    columns = {"step": rows, "time": rows, "potential": np.sin(rows), "kinetic": rows, "conserved": rows}
    summary = {"atoms": 864, "steps": STEPS, "steps_per_second": 1.0, "lost_pairs": 0, "flips_entered": 0}
    Path(notes, f"{point['address']}.json").write_text(json.dumps([os.getpid(), began, time.time()]))
    return Sample(columns, summary, 864, 1.0, folder)


def worker(task: Any, seconds: float, notes: str) -> Any:
    """Work as mdnum has it, with a point that sleeps."""
    from mdnum.verbs import sweep_worker

    sweep_worker._run = partial(asleep, seconds, notes)
    return sweep_worker.work(task)


def of_points(points: int, seconds: float, root: Path) -> dict[str, float]:
    """What lies between points, and the whole, as shares of the time of the points."""
    from mdnum.verbs import sweep as verb

    notes = root / "notes"
    notes.mkdir()
    verb.work = partial(worker, seconds=seconds, notes=str(notes))
    steps = [0.001, 0.002, 0.003, 0.004]
    began = time.time()
    mdnum.sweep(
        SYSTEM, {"dynamics.timestep": steps}, seeds=points // len(steps), measure="energy,lost", steps=STEPS,
        workers=WORKERS, points_in=root / "points", out=root / "sweep",
    )  # fmt: skip
    ended = time.time()
    told = [json.loads(file.read_text()) for file in notes.iterdir()]
    assert len(told) == points
    gaps = []
    for process in {one[0] for one in told}:
        own = sorted(one[1:] for one in told if one[0] == process)
        gaps += [after[0] - before[1] for before, after in pairwise(own)]
    ideal = points * seconds / WORKERS
    first, last = min(one[1] for one in told), max(one[2] for one in told)
    return {
        "between points, %": 100 * float(np.mean(gaps)) / seconds,
        "first to last point, % more than needed": 100 * ((last - first) / ideal - 1),
        "in all, % more than needed": 100 * ((ended - began) / ideal - 1),
        "until the first point, s": first - began,
        "after the last point, s": ended - last,
    }


def of_many(many: int, design: Any, root: Path) -> dict[str, float]:
    """Time, memory and the size of the page of a sweep whose points are there."""
    from mdnum.sweeps.plan import Question, planned

    seeds, keys = DESIGNS[design]
    settings = many // seeds
    each = round(settings ** (1 / len(keys))) if design == "factorial" else settings // len(keys)
    over = {key: np.linspace(*ENDS[key], each).tolist() for key in keys}
    question = Question(seeds, ",".join(MEASURES), STEPS, design)
    began = time.process_time()
    plan = planned(SYSTEM, over, question, None)
    planning, rng = time.process_time() - began, np.random.default_rng(0)
    for one in plan.points:
        folder = root / "points" / "workspace" / one.address
        folder.mkdir(parents=True)
        (folder / "signac_statepoint.json").write_text(json.dumps(one.state))
        measures = {
            name: {"value": value + float(rng.normal(0, 0.01)), "error": 0.01, "effective": 100.0}
            for name, value in MEASURES.items()
        }
        summary = {"steps_per_second": float(rng.uniform(1, 2)), "lost_pairs": 0}
        point = {"status": "complete", "summary": summary, "measures": measures, "seconds": 1.0}
        (folder / "point.json").write_text(json.dumps(point, indent=1))
    began = time.process_time()
    made = mdnum.sweep(
        SYSTEM, over, seeds=seeds, measure=list(MEASURES), steps=STEPS, design=design, tolerance=0.01,
        points_in=root / "points", out=root / "sweep",
    )  # fmt: skip
    seconds = time.process_time() - began
    assert made.summary["computed"] == 0 and made.summary["points"] == len(plan.points)
    return {
        "points": len(plan.points),
        "planning, s": planning,
        "all of it, s": seconds,
        "page, MB": (root / "sweep" / "report.html").stat().st_size / 1e6,
        "folder, MB": sum(file.stat().st_size for file in (root / "sweep").rglob("*")) / 1e6,
        "memory, MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }


def main() -> None:
    """Sleep, make results up, and measure what is left."""
    arguments = parser(__doc__)
    arguments.add_argument("--points", type=int, default=200, help="that sleep, a multiple of 4")
    arguments.add_argument("--seconds", type=float, default=1.0, help="that each sleeps")
    arguments.add_argument("--many", type=int, default=10_000, help="points that are there already")
    asked = arguments.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        found = of_points(asked.points, asked.seconds, Path(scratch)) if asked.points else {}
    what = f"{asked.points} points of {asked.seconds:g} s on {WORKERS} workers"
    table(what, ["", ""], [(name, f"{value:.2f}") for name, value in found.items()])
    rows = []
    for design in DESIGNS if asked.many else ():
        with tempfile.TemporaryDirectory() as scratch:
            rows.append({"design": design, **of_many(asked.many, design, Path(scratch))})
    for row in rows:
        table("", [*row], [[one if isinstance(one, str) else f"{one:.4g}" for one in row.values()]])


if __name__ == "__main__":
    start(main)
