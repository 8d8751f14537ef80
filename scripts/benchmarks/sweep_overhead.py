"""How much time does a sweep take in addition to its points, if each point takes one second?

Answer. 0.040 s between two points of a worker (100 points, two workers, a quiet machine, AMD EPYC,
2026-11-27): from the first to the last point the sweep took 4.6 % longer than the points themselves. The
first point began after 3.7 s, and the report took 1.7 s. With other programs running on both cores the time
between two points was 0.11 and 0.17 s. It takes two minutes.

    python scripts/benchmarks/sweep_overhead.py
    python scripts/benchmarks/sweep_overhead.py --points 40

`--points` points that do nothing for `--seconds` each, on two workers: in place of the run of a point a
function here sleeps and says when it began and ended; all else is mdnum's, from the command to the page.

How to read it. *Between points* is the mean time from the end of a point to the beginning of the next of
the same worker, over the seconds of a point. *More than needed* is the time beyond that of the points on two
workers: from the first point to the last, and of the whole sweep, with the start of Python and of the
workers, which is paid once.
"""

from __future__ import annotations

import json
import os
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
STEPS = 20


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


def main() -> None:
    """Sleep, and measure what is left."""
    arguments = parser(__doc__)
    arguments.add_argument("--points", type=int, default=100, help="that sleep, a multiple of 4")
    arguments.add_argument("--seconds", type=float, default=1.0, help="that each sleeps")
    asked = arguments.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        found = of_points(asked.points, asked.seconds, Path(scratch))
    what = f"{asked.points} points of {asked.seconds:g} s on {WORKERS} workers"
    table(what, ["", ""], [(name, f"{value:.2f}") for name, value in found.items()])


if __name__ == "__main__":
    start(main)
