"""How long does it take to find the flips between two frames of somebody's trajectory?

Answer. 0.81 ms for 10,976 atoms at consecutive steps, 6.3 ms at every 100th: 28 and 3.8 times as fast as
vesin and a sorted merge (docs/speed.md). It takes minutes.

A Lennard-Jones liquid (density 0.8442, T near 0.72, timestep 0.005, r_cut 2.5) in float64 in memory, run by
mdnum, then read frame by frame: at every step, where the atoms have hardly moved, and at every 100th, where
nothing that was known of the frame before helps. In one process and on one core:

    mdnum                     `mdnum.trajectories` `Tracker`: flips with their margins
    MDAnalysis, sets          `self_capped_distance`, pairs into a set, differences of sets
    vesin, sorted merge       a half list of vesin's, pairs as sorted keys, `setxor1d`

Contenders take turns, so that a busy machine is busy for all of them, each through all of its frames. The
table holds means over the frames (mdnum makes a list now and then, which belongs to the frames it serves) of
the best turn by CPU time, after compilation. MDAnalysis works in float32: its flips are not quite the same.
Then two files (xtc, the steps there and back again), a short one and one so long that start is little: what
the whole command `mdnum flips`, begun from a shell, takes over reading the file alone, and `NeighborFlips` in
one process over two; on two cores where there are two.
Then memory over many frames, and frames of a million atoms (copies of the liquid side by side, in an order
that knows nothing of space).

How to read it. Ratios travel to other machines, times do not; CPU time is what a busy machine blurs less. The
last table holds what should be; "no" on a machine that is busy with other things may mean only that.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import R_CUT, liquid
from _output import figure, parser, save, say, start, table
from _processes import children_seconds, machine

OURS, SETS, MERGE = "mdnum", "MDAnalysis, sets", "vesin, sorted merge"
EVERY, FAR = "every step", "every 100th step"
ASKED_MS = {EVERY: 1.3, FAR: 9.0}
ASKED_MILLION, ASKED_OVER_SETS, ASKED_OVER_READING, ASKED_TWO_CORES = 5.0, 10.0, 2.0, 1.8
# Å of a unit of length, so that the file resolves what flips
ANGSTROM = 3.4
# frames that are not timed: compilation, and those before mdnum has made a list
WARM = 3


@dataclass(frozen=True)
class Speed:
    """What a contender took for a frame, and what it found."""

    code: str
    frames: str
    atoms: int
    flips: float
    ms: float
    cpu_ms: float
    count: int


@dataclass(frozen=True)
class Motion:
    """Frames in memory; positions as if the box had no faces."""

    length: float
    steps: np.ndarray
    frames: list[np.ndarray]

    def every(self, stride: int) -> list[np.ndarray]:
        """Frames so many steps apart, wrapped, as files are."""
        chosen = [x for step, x in zip(self.steps, self.frames, strict=True) if step % stride == 0]
        if stride == 1:
            # those that were kept one by one
            chosen = chosen[: int(np.flatnonzero(self.steps == np.arange(len(self.steps)))[-1]) + 1]
        return [np.ascontiguousarray(np.mod(x, self.length)) for x in chosen]


def motion(atoms: int, whole: int, strides: int) -> Motion:
    """A liquid of about so many atoms: some steps kept one by one, then every 100th."""
    from mdnum.rollout import Engine, unwrapped
    from mdnum.systems import build

    simulation = build(liquid(atoms))
    matrix = np.asarray(simulation.cell.matrix, np.float64)
    steps, frames = [], []
    for segment in Engine(simulation, 100 * strides, record=True).segments():
        for row in range(segment.rows):
            step = segment.first + row
            if step < whole or step % 100 == 0:
                steps.append(step)
                images = segment.unsorted("images", row)
                frames.append(unwrapped(matrix, segment.unsorted("x", row), images))
    return Motion(float(matrix[0, 0]), np.array(steps), frames)


def mdnum_flips(length: float) -> Callable[[np.ndarray], int]:
    """Flips as mdnum finds them."""
    from mdnum.trajectories import Box, CutoffRule, Frame, Tracker

    tracker, box = Tracker(CutoffRule(R_CUT)), Box(np.eye(3) * length, np.ones(3, bool))
    return lambda x: len(tracker.step(Frame(tracker.frames, 0.0, x, box)))


def set_flips(length: float) -> Callable[[np.ndarray], int]:
    """What a script with MDAnalysis does."""
    from MDAnalysis.lib.distances import self_capped_distance

    edges = np.array([length, length, length, 90, 90, 90], np.float32)
    before: set[tuple[int, int]] = set()

    def step(x: np.ndarray) -> int:
        nonlocal before
        pairs = self_capped_distance(x.astype(np.float32), R_CUT, box=edges, return_distances=False)
        # in no particular order, which differs from frame to frame
        now = set(map(tuple, np.sort(pairs, axis=1).tolist()))
        count = len(now - before) + len(before - now)
        before = now
        return count

    return step


def merge_flips(length: float) -> Callable[[np.ndarray], int]:
    """What one does who cares: a fast list in float64, pairs as whole numbers, sorted and merged."""
    from vesin import NeighborList

    search = NeighborList(cutoff=R_CUT, full_list=False)
    before = np.zeros(0, np.int64)

    def step(x: np.ndarray) -> int:
        nonlocal before
        i, j = search.compute(points=x, box=np.eye(3) * length, periodic=True, quantities="ij")
        low, high = np.minimum(i, j).astype(np.int64), np.maximum(i, j).astype(np.int64)
        now = np.sort(low * len(x) + high)
        count = len(np.setxor1d(now, before, assume_unique=True))
        before = now
        return count

    return step


MAKERS = {OURS: mdnum_flips, SETS: set_flips, MERGE: merge_flips}


def turn(make: Callable[[float], Callable[[np.ndarray], int]], length: float, frames: list[np.ndarray]):
    """(ms, CPU ms, flips) of a frame, once a contender is warm."""
    step, begin, flips = make(length), (0.0, 0.0), 0
    for at, x in enumerate(frames):
        if at == WARM:
            begin, flips = (time.perf_counter(), time.process_time()), 0
        flips += step(x)
    count = len(frames) - WARM
    wall, busy = time.perf_counter() - begin[0], time.process_time() - begin[1]
    return 1e3 * wall / count, 1e3 * busy / count, flips / count


def race(length: float, name: str, frames: list[np.ndarray], slow: int, turns: int) -> list[Speed]:
    """Let the contenders take turns."""
    taken: dict[str, list[tuple[float, float, float]]] = {code: [] for code in MAKERS}
    short = frames[: WARM + slow]
    for code, make in MAKERS.items():
        say(f"{name}: {code}")
        turn(make, length, short[: WARM + 2])
    for _ in range(turns):
        for code, make in MAKERS.items():
            taken[code].append(turn(make, length, short if code == SETS else frames))
    made = []
    for code, rows in taken.items():
        ms, cpu_ms, flips = min(rows, key=lambda row: row[1])
        count = len(short if code == SETS else frames) - WARM
        made.append(Speed(code, name, len(frames[0]), flips, ms, cpu_ms, count))
    ours, merged = (next(one.flips for one in made if one.code == code) for code in (OURS, MERGE))
    if abs(ours - merged) > 1e-3 * merged:
        raise RuntimeError(f"mdnum finds {ours:g} flips a frame, vesin's lists differ by {merged:g}")
    return made


def resident_mb() -> float:
    """Memory of this process now, MB; nan where the system does not tell."""
    status = Path("/proc/self/status")
    if not status.is_file():
        return float("nan")
    (line,) = [line for line in status.read_text().splitlines() if line.startswith("VmRSS:")]
    return int(line.split()[1]) / 2**10


def memory(length: float, frames: list[np.ndarray], total: int) -> list[dict[str, float]]:
    """Memory of this process after each quarter of so many frames, there and back again."""
    step, seen = mdnum_flips(length), []
    there_and_back = frames + frames[-2:0:-1]
    for at in range(total):
        step(there_and_back[at % len(there_and_back)])
        if 4 * (at + 1) >= (len(seen) + 1) * total:
            seen.append({"frame": at + 1, "resident_mb": resident_mb()})
    return seen


def written(path: Path, length: float, frames: list[np.ndarray], total: int) -> None:
    """An xtc file of so many frames, there and back again."""
    import MDAnalysis

    there_and_back = frames + frames[-2:0:-1]
    universe: Any = MDAnalysis.Universe.empty(len(frames[0]), trajectory=True)
    with MDAnalysis.Writer(str(path), len(frames[0])) as file:
        for at in range(total):
            universe.atoms.positions = ANGSTROM * there_and_back[at % len(there_and_back)]
            universe.dimensions = [ANGSTROM * length] * 3 + [90.0] * 3
            file.write(universe.atoms)


def taken(work: Callable[[], object]) -> tuple[float, float]:
    """(CPU seconds, children included; seconds by the clock), the smallest of two times."""
    found = []
    for _ in range(2):
        busy, wall = time.process_time() + children_seconds(), time.perf_counter()
        work()
        found.append((time.process_time() + children_seconds() - busy, time.perf_counter() - wall))
    return min(one[0] for one in found), min(one[1] for one in found)


def file_costs(
    length: float, frames: list[np.ndarray], totals: tuple[int, int], cores: set[int]
) -> list[Any]:
    """What reading a file, the command on it, and `NeighborFlips` in one process and two take."""
    import MDAnalysis

    from mdnum.trajectories import NeighborFlips, open_trajectory

    radius, made = R_CUT * ANGSTROM, []

    def add(what: str, work: Callable[[], object]) -> None:
        cpu_seconds, seconds = taken(work)
        made.append({"frames": total, "what": what, "cpu_seconds": cpu_seconds, "seconds": seconds})

    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "liquid.xtc", Path(folder) / "out"
        command = [
            sys.executable,
            "-m",
            "mdnum",
            "flips",
            str(path),
            "--cutoff",
            str(radius),
            "--out",
            str(out),
        ]

        def whole() -> None:
            shutil.rmtree(out, ignore_errors=True)
            done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            # 1 is for findings
            if done.returncode > 1:
                raise RuntimeError(done.stderr)

        if len(cores) > 1:
            os.sched_setaffinity(0, set(sorted(cores)[:2]))
        for total in totals:
            written(path, length, frames, total)
            add("reading", lambda: deque(open_trajectory(path).frames(), 0))
            add("command", whole)
            for name, how in (("one", {}), ("two", {"backend": "multiprocessing", "n_workers": 2})):
                if len(cores) > 1:
                    universe = MDAnalysis.Universe(str(path), to_guess=())
                    add(name, lambda how=how, of=universe: NeighborFlips(of, radius).run(**how))
        if len(cores) > 1:
            os.sched_setaffinity(0, set(sorted(cores)[:1]))
    return made


def many(moved: Motion, name: str, chosen: list[np.ndarray], copies: tuple[int, int, int]) -> dict[str, Any]:
    """Seconds a frame of copies side by side, in a scattered order; none of the frames is left out."""
    from mdnum.trajectories import Box, CutoffRule, Frame, Tracker

    edges = moved.length * np.array(copies)
    places = np.stack(np.meshgrid(*[np.arange(n) for n in copies], indexing="ij"), -1).reshape(-1, 1, 3)
    order = np.random.default_rng(1).permutation(len(places) * len(chosen[0]))
    tracker, seconds, busy, flips = Tracker(CutoffRule(R_CUT)), [], [], 0
    for at, x in enumerate(chosen):
        # as if there were no faces: a copy must not jump back by its own edge in the middle of the large box
        large = np.mod((x + places * moved.length).reshape(-1, 3)[order], edges)
        wall, cpu = time.perf_counter(), time.process_time()
        flips += len(tracker.step(Frame(at, 0.0, large, Box(np.diag(edges), np.ones(3, bool)))))
        seconds.append(time.perf_counter() - wall)
        busy.append(time.process_time() - cpu)
    return {
        "frames": name, "atoms": len(order), "pairs": tracker.pairs, "flips": flips / (len(chosen) - 1),
        "seconds": seconds, "cpu_seconds": busy, "resident_mb": resident_mb(),
    }  # fmt: skip


def verdicts(result: dict[str, Any]) -> Iterator[tuple[str, str, str, bool]]:
    """(what, measured, asked, holds)."""
    speeds = [Speed(**row) for row in result["speeds"]]
    for name in (EVERY, FAR):
        by_code = {row.code: row for row in speeds if row.frames == name}
        ours = by_code[OURS].cpu_ms
        yield f"mdnum, {name}", f"{ours:.2f} ms", f"<= {ASKED_MS[name]:g} ms", ours <= ASKED_MS[name]
        ratio = by_code[SETS].cpu_ms / ours
        yield (
            f"{SETS} / mdnum, {name}", f"{ratio:.0f}", f">= {ASKED_OVER_SETS:g}", ratio >= ASKED_OVER_SETS
        )  # fmt: skip
        ratio = by_code[MERGE].cpu_ms / ours
        yield f"{MERGE} / mdnum, {name}", f"{ratio:.1f}", "> 1", ratio > 1
    files = {(row["what"], row["frames"]): row for row in result["file"]}
    short, long = sorted({row["frames"] for row in result["file"]})
    for clock, name in (("cpu_seconds", "by CPU time"), ("seconds", "by the clock")):
        command, reading = ([files[what, n][clock] for n in (short, long)] for what in ("command", "reading"))
        of = {
            f"{short:,} frames": command[0] / reading[0],
            f"{long:,} frames": command[1] / reading[1],
            "a further frame": (command[1] - command[0]) / (reading[1] - reading[0]),
        }
        for what, ratio in of.items():
            holds = ratio <= ASKED_OVER_READING
            yield f"command / reading, {what}, {name}", f"{ratio:.1f}", f"<= {ASKED_OVER_READING:g}", holds
    for frames in (short, long):
        if ("two", frames) in files:
            ratio = files["one", frames]["seconds"] / files["two", frames]["seconds"]
            what, holds = f"one process / two, {frames:,} frames, by the clock", ratio >= ASKED_TWO_CORES
            yield what, f"{ratio:.2f}", f">= {ASKED_TWO_CORES:g}", holds
    for row in result["many"]:
        worst = max(row["cpu_seconds"][1:])
        what = f"{row['atoms']:,} atoms, {row['frames']}, slowest frame"
        yield what, f"{worst:.1f} s", f"< {ASKED_MILLION:g} s", worst < ASKED_MILLION
    if len(result["memory"]) > 1:
        first, last = (result["memory"][k]["resident_mb"] for k in (0, -1))
        yield "memory, last quarter over first", f"{last / first:.2f}", "<= 1.05", last <= 1.05 * first


def show(result: dict[str, Any]) -> None:
    """Print the tables."""
    table(
        result["machine"],
        ("frames", "code", "N", "flips", "ms/frame", "CPU ms/frame", "frames timed"),
        (
            (
                row["frames"], row["code"], f"{row['atoms']:,}", f"{row['flips']:,.0f}", f"{row['ms']:.2f}",
                f"{row['cpu_ms']:.2f}", row["count"],
            )
            for row in result["speeds"]
        ),
        words=2,
    )  # fmt: skip
    if result["many"]:
        table(
            "\nmany atoms",
            ("frames", "N", "pairs", "flips", "s a frame (CPU)", "resident MB"),
            (
                (
                    row["frames"], f"{row['atoms']:,}", f"{row['pairs']:,}", f"{row['flips']:,.0f}",
                    ", ".join(f"{value:.1f}" for value in row["cpu_seconds"]), f"{row['resident_mb']:,.0f}",
                )
                for row in result["many"]
            ),
        )  # fmt: skip
    table(
        "\nmemory over frames",
        ("frame", "resident MB"),
        ((f"{row['frame']:,}", f"{row['resident_mb']:.0f}") for row in result["memory"]),
    )
    table(
        "\nfile",
        ("frames", "what", "CPU s", "s"),
        (
            (f"{row['frames']:,}", row["what"], f"{row['cpu_seconds']:.2f}", f"{row['seconds']:.2f}")
            for row in result["file"]
        ),
    )
    table("\nratios", ("what", "measured", "asked", "holds"), verdicts(result))


def draw(result: dict[str, Any], path: Path) -> None:
    """CPU time of a frame, by code, a panel for each spacing of frames."""
    drawn = figure(8.0, 2.8)
    panels = drawn.subplots(1, 2, sharex=True, sharey=True)
    for axes, name in zip(panels, (EVERY, FAR), strict=True):
        rows = [row for row in result["speeds"] if row["frames"] == name]
        axes.barh([row["code"] for row in rows], [row["cpu_ms"] for row in rows])
        axes.set_xscale("log")
        axes.set_title(f"{name}: {rows[0]['flips']:,.0f} flips a frame, N = {rows[0]['atoms']:,}")
        axes.set_xlabel("CPU ms a frame")
    panels[0].invert_yaxis()
    save(drawn, path)


def _options() -> argparse.Namespace:
    made = parser(__file__, __doc__)
    made.add_argument("--quick", action="store_true", help="500 atoms and few frames: does it work?")
    made.add_argument("--atoms", type=int, help="about so many (default 10000)")
    made.add_argument("--turns", type=int, help="turns of each contender (default 2)")
    made.add_argument("--copies", type=int, nargs=3, metavar="N", help="of the large box (default 5 5 4)")
    made.add_argument("--json", action="store_true", help="print one JSON document instead of tables")
    return made.parse_args()


def main() -> None:
    """Parse, measure, print and draw."""
    chosen = _options()
    cores: set[int] = set()
    if hasattr(os, "sched_setaffinity"):
        cores = os.sched_getaffinity(0)
        # before anything is imported that makes threads
        os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:1]))
    os.environ["OMP_NUM_THREADS"] = "1"
    atoms = chosen.atoms or (500 if chosen.quick else 10_000)
    whole, strides = (20, 8) if chosen.quick else (70, 10)
    say(f"N = {atoms:,}: melting and running")
    moved = motion(atoms, whole, strides)
    near, far = moved.every(1), moved.every(100)
    turns, slow = chosen.turns or (1 if chosen.quick else 2), 4
    result: dict[str, Any] = {"speeds": []}
    for name, frames in ((EVERY, near), (FAR, far)):
        result["speeds"] += [asdict(row) for row in race(moved.length, name, frames, slow, turns)]
    say("file")
    result["file"] = file_costs(moved.length, near, (60, 240) if chosen.quick else (800, 4_000), cores)
    say("memory")
    result["memory"] = memory(moved.length, near, 60 if chosen.quick else 800)
    a, b, c = chosen.copies or ([2, 1, 1] if chosen.quick else [5, 5, 4])
    copies = (a, b, c)
    say(f"{len(near[0]) * int(np.prod(copies)):,} atoms")
    kept = {int(step): x for step, x in zip(moved.steps, moved.frames, strict=True)}
    result["many"] = [
        many(moved, EVERY, [kept[step] for step in range(6)], copies),
        many(moved, FAR, [kept[100 * step] for step in range(1, 4)], copies),
    ]
    result["machine"] = machine()
    if chosen.json:
        print(json.dumps(result, indent=2))
    else:
        show(result)
    draw(result, chosen.output)


if __name__ == "__main__":
    start(main)
