"""How long does the search for flips between two frames of a trajectory take?

Answer. For 10,976 atoms, 0.81 ms if frames are consecutive steps, and 6.3 ms if frames are 100 steps apart.
This is 28 and 3.8 times as fast as vesin and a sorted merge (docs/speed.md). It takes minutes.

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
import os
import shutil
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import R_CUT, liquid
from _output import parser, say, start, table
from _turns import Claim, claim, finish, in_turn, on_cores, seconds

OURS, SETS, MERGE = "mdnum", "MDAnalysis, sets", "vesin, sorted merge"
EVERY, FAR = "every step", "every 100th step"
#: CPU time of a frame; of one of a million atoms; ratios to other ways.
MOST_MS, MOST_SECONDS = {EVERY: 1.3, FAR: 9.0}, 5.0
LEAST_OVER_SETS, MOST_OVER_READING, LEAST_BY_TWO = 10.0, 2.0, 1.8
# Å of a unit of length, so that the file resolves what flips
ANGSTROM = 3.4
# frames that are not timed: compilation, and those before mdnum has made a list
WARM = 3


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


class Turn:
    """One contender through its frames, timed once it is warm."""

    def __init__(self, make: Callable[[float], Callable[[np.ndarray], int]], length: float, frames: list):
        self.make, self.length, self.frames = make, length, frames
        self.taken: list[tuple[float, float, float]] = []  # ms, CPU ms and flips of a frame, for each turn

    def __call__(self) -> None:
        """One turn."""
        step, flips = self.make(self.length), 0
        for x in self.frames[:WARM]:
            step(x)

        def rest() -> None:
            nonlocal flips
            flips = sum(step(x) for x in self.frames[WARM:])

        wall, busy = 1e3 * seconds(rest) / self.count
        self.taken.append((wall, busy, flips / self.count))

    @property
    def count(self) -> int:
        """Frames that are timed."""
        return len(self.frames) - WARM


def race(length: float, name: str, frames: list[np.ndarray], slow: int, turns: int) -> list[dict[str, Any]]:
    """Let the contenders take turns; the best turn of each by CPU time."""
    contenders = {
        code: Turn(make, length, frames[: WARM + slow] if code == SETS else frames)
        for code, make in MAKERS.items()
    }
    in_turn(contenders, turns, name)
    made = []
    for code, one in contenders.items():
        ms, cpu_ms, flips = min(one.taken[1:], key=lambda row: row[1])
        made.append(
            {
                "code": code, "frames": name, "atoms": len(frames[0]), "flips": flips, "ms": ms,
                "cpu_ms": cpu_ms, "count": one.count,
            }
        )  # fmt: skip
    ours, merged = (next(one["flips"] for one in made if one["code"] == code) for code in (OURS, MERGE))
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


def file_costs(
    length: float, frames: list[np.ndarray], totals: tuple[int, int], cores: list[int]
) -> list[dict[str, Any]]:
    """What reading a file, the command on it, and `NeighborFlips` in one process and two take.

    The least of two times.
    """
    import MDAnalysis

    from mdnum.trajectories import NeighborFlips, open_trajectory

    radius, made = R_CUT * ANGSTROM, []
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "liquid.xtc", Path(folder) / "out"
        command = [sys.executable, "-m", "mdnum", "flips", str(path), "--cutoff", str(radius), "-o", str(out)]

        def whole() -> None:
            shutil.rmtree(out, ignore_errors=True)
            done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            # 1 is for findings
            if done.returncode > 1:
                raise RuntimeError(done.stderr)

        works: dict[str, Callable[[], object]] = {
            "reading": lambda: deque(open_trajectory(path).frames(), 0), "command": whole
        }  # fmt: skip
        if len(cores) > 1:
            os.sched_setaffinity(0, set(cores[:2]))
            for name, how in (("one", {}), ("two", {"backend": "multiprocessing", "n_workers": 2})):
                works[name] = lambda how=how: NeighborFlips(
                    MDAnalysis.Universe(str(path), to_guess=()), radius
                ).run(**how)
        for total in totals:
            written(path, length, frames, total)
            for what, work in works.items():
                say(f"{total:,} frames of a file: {what}")
                wall, busy = np.min([seconds(work) for _ in range(2)], axis=0).tolist()
                made.append({"frames": total, "what": what, "cpu_seconds": busy, "seconds": wall})
        on_cores(1)
    return made


def many(moved: Motion, name: str, chosen: list[np.ndarray], copies: tuple[int, int, int]) -> dict[str, Any]:
    """Seconds a frame of copies side by side, in a scattered order; none of the frames is left out."""
    from mdnum.trajectories import Box, CutoffRule, Frame, Tracker

    edges = moved.length * np.array(copies)
    places = np.stack(np.meshgrid(*[np.arange(n) for n in copies], indexing="ij"), -1).reshape(-1, 1, 3)
    order = np.random.default_rng(1).permutation(len(places) * len(chosen[0]))
    tracker, taken = Tracker(CutoffRule(R_CUT)), []
    flips: list[int] = []
    for at, x in enumerate(chosen):
        # as if there were no faces: a copy must not jump back by its own edge in the middle of the large box
        large = np.mod((x + places * moved.length).reshape(-1, 3)[order], edges)
        frame = Frame(at, 0.0, large, Box(np.diag(edges), np.ones(3, bool)))
        taken.append(seconds(lambda frame=frame: flips.append(len(tracker.step(frame)))).tolist())
    walls, busy = zip(*taken, strict=True)
    return {
        "frames": name, "atoms": len(order), "pairs": tracker.pairs, "flips": sum(flips) / (len(chosen) - 1),
        "seconds": walls, "cpu_seconds": busy, "resident_mb": resident_mb(),
    }  # fmt: skip


def claims(result: dict[str, Any]) -> Iterator[Claim]:
    """What was measured beside what is required."""
    for name in (EVERY, FAR):
        ms = {row["code"]: row["cpu_ms"] for row in result["speeds"] if row["frames"] == name}
        yield claim(f"mdnum, {name}", ms[OURS], "<=", MOST_MS[name], "ms")
        yield claim(f"{SETS} / mdnum, {name}", ms[SETS] / ms[OURS], ">=", LEAST_OVER_SETS)
        yield claim(f"{MERGE} / mdnum, {name}", ms[MERGE] / ms[OURS], ">", 1)
    files = {(row["what"], row["frames"]): row for row in result["file"]}
    short, long = sorted({row["frames"] for row in result["file"]})
    for clock, name in (("cpu_seconds", "by CPU time"), ("seconds", "by the clock")):
        command, reading = ([files[what, n][clock] for n in (short, long)] for what in ("command", "reading"))
        over = {
            f"{short:,} frames": command[0] / reading[0],
            f"{long:,} frames": command[1] / reading[1],
            "a further frame": (command[1] - command[0]) / (reading[1] - reading[0]),
        }
        for what, ratio in over.items():
            yield claim(f"command / reading, {what}, {name}", ratio, "<=", MOST_OVER_READING)
    for frames in (short, long):
        if ("two", frames) in files:
            ratio = files["one", frames]["seconds"] / files["two", frames]["seconds"]
            yield claim(f"one process / two, {frames:,} frames, by the clock", ratio, ">=", LEAST_BY_TWO)
    for row in result["many"]:
        what = f"{row['atoms']:,} atoms, {row['frames']}, slowest frame"
        yield claim(what, max(row["cpu_seconds"][1:]), "<", MOST_SECONDS, "s")
    first, last = (result["memory"][k]["resident_mb"] for k in (0, -1))
    yield claim("memory, last quarter over first", last / first, "<=", 1.05)


def show(result: dict[str, Any]) -> None:
    """Print the tables."""
    table(
        "flips between frames",
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


def _options() -> argparse.Namespace:
    made = parser(__doc__)
    made.add_argument("--quick", action="store_true", help="500 atoms and few frames: does it work?")
    made.add_argument("--atoms", type=int, help="about so many (default 10000)")
    made.add_argument("--turns", type=int, help="turns of each contender (default 2)")
    made.add_argument("--copies", type=int, nargs=3, metavar="N", help="of the large box (default 5 5 4)")
    made.add_argument("--json", action="store_true", help="print one JSON document instead of tables")
    return made.parse_args()


def main() -> None:
    """Parse, measure, and print."""
    chosen = _options()
    cores = on_cores(1)
    os.environ["OMP_NUM_THREADS"] = "1"
    atoms = chosen.atoms or (500 if chosen.quick else 10_000)
    whole, strides = (20, 8) if chosen.quick else (70, 10)
    say(f"N = {atoms:,}: melting and running")
    moved = motion(atoms, whole, strides)
    near, far = moved.every(1), moved.every(100)
    turns, slow = chosen.turns or (1 if chosen.quick else 2), 4
    result: dict[str, Any] = {"speeds": []}
    for name, frames in ((EVERY, near), (FAR, far)):
        result["speeds"] += race(moved.length, name, frames, slow, turns)
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
    finish(chosen, result, show, claims)


if __name__ == "__main__":
    start(main)
