"""What does it cost to follow two runs and a counterfactual, beside one recorded run?

Answer. 2.9 to 3.4 times the CPU time of one recorded run, with 108 to 4,000 atoms; a whole answer about
argon/liquid-864 takes 80 s of CPU time, a map of 20 boundaries 22 s. It takes 280 s.

Run A, run B (the same program, one coordinate one ulp aside) and B's arithmetic under A's decisions advance
together; beside them A alone, recorded: its flips decoded to ledger rows, all a run does but write them. The
two take turns from the same start, so that a busy machine is busy for both, after compilation. The first
table holds medians over the turns:

    ms/step  clock and CPU time (of all cores together) of a step
    ratio    of the three runs to one, median over the turns, by clock and by CPU time
    compile  CPU seconds that the first turn took beyond the later ones

Then two answers, from the question to the end: `mdnum fork argon/liquid-864 --vary precision` in a fresh
process, and the first 20 boundaries along sigma of 500 steps of argon/crystal-108.

How to read it. Ratios travel to other machines, times do not; the ratio by CPU time is the one that a busy
machine does not blur. Below 3, the runs side by side share what one run alone waits for; what is above 3 is
the comparison itself: positions brought into one order, distances, and flips matched. "no" in the last
table, on a machine that is busy with other things, may mean only that.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import figure, parser, save, say, start, table
from _processes import children_seconds, machine

if TYPE_CHECKING:
    from mdnum.systems import System

SINGLE, TRIPLE = "recorded run", "A, B and B|A"
MOST_RATIO, MOST_SECONDS, MOST_MAP_SECONDS = 3.5, 60.0, 120.0
BOUNDARIES = 20


@dataclass(frozen=True)
class Row:
    """One system's medians."""

    system: str
    atoms: int
    steps: int
    turns: int
    single_ms: float
    triple_ms: float
    single_cpu_ms: float
    triple_cpu_ms: float
    ratio: float
    cpu_ratio: float
    single_compile: float
    triple_compile: float


def system_of(word: str) -> System:
    """A shipped system by name, or a Lennard-Jones liquid of so many atoms."""
    from _liquid import liquid

    from mdnum.systems import load

    return liquid(int(word)) if word.isdigit() else load(word, world="md")


def single(system: System) -> Callable[[int], None]:
    """A run alone, recorded."""
    from mdnum.rollout import Engine, PairRecorder
    from mdnum.systems import build

    simulation = build(system)

    def run(steps: int) -> None:
        recorder = PairRecorder(simulation)
        for segment in Engine(simulation, steps).segments():
            recorder.counts(segment)
            recorder.flips(segment)

    return run


def triple(system: System) -> Callable[[int], None]:
    """Two runs and the counterfactual, compared step by step."""
    from mdnum.forks.choices import parse, twin_of

    twin = twin_of(parse("start"), system)

    def run(steps: int) -> None:
        for _ in twin.a.lockstep(twin.b, steps, forward=True, back=False, guard=None):
            pass

    return run


def timed(loop: Callable[[int], None], steps: int) -> tuple[float, float]:
    """Clock and CPU seconds."""
    wall, busy = time.perf_counter(), time.process_time()
    loop(steps)
    return time.perf_counter() - wall, time.process_time() - busy


def race(word: str, steps: int, turns: int) -> Row:
    """Let the two take turns on one system."""
    system = system_of(word)
    loops = {SINGLE: single(system), TRIPLE: triple(system)}
    first, taken = {}, {name: [] for name in loops}
    for name, loop in loops.items():
        say(f"{system.name}: compiling {name}")
        first[name] = timed(loop, steps)[1]
    for turn in range(turns):
        say(f"{system.name}: turn {turn + 1} of {turns}")
        for name, loop in loops.items():
            taken[name].append(timed(loop, steps))
    one, three = np.array(taken[SINGLE]), np.array(taken[TRIPLE])
    walls, cpus = (1e3 * np.median(np.stack([one[:, k], three[:, k]]), axis=1) / steps for k in (0, 1))
    ratios = np.median(three / one, axis=0)
    return Row(
        system.name, len(system.atoms), steps, turns, float(walls[0]), float(walls[1]), float(cpus[0]),
        float(cpus[1]), float(ratios[0]), float(ratios[1]),
        first[SINGLE] - float(np.median(one[:, 1])), first[TRIPLE] - float(np.median(three[:, 1])),
    )  # fmt: skip


def answered(words: list[str], turns: int) -> dict[str, Any]:
    """Seconds of `mdnum fork` in a fresh process, from the question to the report."""
    taken = []
    for turn in range(turns):
        say(f"mdnum fork {' '.join(words)}: turn {turn + 1} of {turns}")
        with tempfile.TemporaryDirectory() as scratch:
            busy, wall = children_seconds(), time.perf_counter()
            subprocess.run(
                [sys.executable, "-m", "mdnum", "fork", *words, "-o", f"{scratch}/fork"],
                check=True,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            taken.append((time.perf_counter() - wall, children_seconds() - busy))
            summary = json.loads(Path(scratch, "fork", "summary.json").read_text())
    return {
        "words": words,
        "seconds": median(wall for wall, _ in taken),
        "cpu_seconds": median(busy for _, busy in taken),
        "verdict": summary["effect"],
        "steps": summary["steps"],
    }


def mapped(low: float, high: float, steps: int, most: int) -> dict[str, Any]:
    """Seconds of a map along sigma, compilation and the processes that confirm it included."""
    from mdnum.forks.boundaries import boundaries
    from mdnum.systems import load

    say(f"{most} boundaries along sigma")
    busy, wall, beside = time.process_time(), time.perf_counter(), children_seconds()
    found = boundaries(load("argon/crystal-108"), "potential.sigma", low, high, steps, most=most)
    return {
        "boundaries": len(found.boundaries),
        "runs": found.evaluations,
        "steps": steps,
        "confirmed": sum(one.confirmed is True for one in found.boundaries),
        "seconds": time.perf_counter() - wall,
        "cpu_seconds": time.process_time() - busy + children_seconds() - beside,
    }


def verdicts(result: dict[str, Any]) -> list[tuple[str, float, str, bool]]:
    """What was measured against what it should be: (claim, measured, wanted, holds)."""
    rows = []
    for row in result["ratios"]:
        for name, value in (("CPU time", row["cpu_ratio"]), ("clock", row["ratio"])):
            claim = f"{TRIPLE} over one recorded run, {row['system']}, {name}"
            rows.append((claim, value, f"<= {MOST_RATIO}", value <= MOST_RATIO))
    for key, most in (("answer", MOST_SECONDS), ("map", MOST_MAP_SECONDS)):
        if found := result.get(key):
            name = "mdnum fork " + " ".join(found["words"]) if key == "answer" else "a map, "
            name += "" if key == "answer" else f"{found['boundaries']} boundaries of {found['steps']} steps"
            rows.append((f"seconds: {name}", found["seconds"], f"< {most:g}", found["seconds"] < most))
    return rows


def show(result: dict[str, Any]) -> None:
    """All of it as tables."""
    print("on " + result["machine"])
    table(
        f"{TRIPLE} beside one recorded run",
        ("system", "N", "steps x turns", "one ms/step", "three", "one CPU", "three", "ratio", "CPU ratio",
         "one compile s", "three"),
        (
            (
                row.system, f"{row.atoms:,}", f"{row.steps} x {row.turns}", f"{row.single_ms:.3f}",
                f"{row.triple_ms:.3f}", f"{row.single_cpu_ms:.3f}", f"{row.triple_cpu_ms:.3f}",
                f"{row.ratio:.2f}", f"{row.cpu_ratio:.2f}", f"{row.single_compile:.1f}",
                f"{row.triple_compile:.1f}",
            )
            for row in (Row(**one) for one in result["ratios"])
        ),
    )  # fmt: skip
    for key in ("answer", "map"):
        if found := result.get(key):
            print(f"\n{key}: " + ", ".join(f"{name} {_plain(value)}" for name, value in found.items()))
    table("\nwanted", ("what", "measured", "wanted", "holds"), verdicts(result))


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(value)
    return f"{value:.1f}" if isinstance(value, float) else str(value)


def draw(result: dict[str, Any], path: Path) -> None:
    """Ratios by system, beside what they should not pass."""
    rows = [Row(**one) for one in result["ratios"]]
    drawn = figure(6.0, 1.4 + 0.6 * len(rows))
    axes = drawn.subplots()
    at = np.arange(len(rows))
    axes.barh(at - 0.2, [row.cpu_ratio for row in rows], 0.38, label="CPU time")
    axes.barh(at + 0.2, [row.ratio for row in rows], 0.38, label="clock")
    axes.axvline(MOST_RATIO, color="black", lw=0.8, label=f"{MOST_RATIO}")
    axes.set_yticks(at, [f"{row.system} ({row.atoms:,})" for row in rows])
    axes.invert_yaxis()
    axes.set_title(f"{TRIPLE} over one recorded run")
    drawn.legend(loc="outside lower center", ncols=3)
    save(drawn, path)


def _options() -> argparse.Namespace:
    made = parser(__file__, __doc__)
    made.add_argument("--quick", action="store_true", help="the crystal alone, a short turn: does it work?")
    made.add_argument(
        "--systems", nargs="+", metavar="NAME",
        help="shipped systems, or sizes of a liquid (default argon/crystal-108 argon/liquid-864 4000)",
    )  # fmt: skip
    made.add_argument(
        "--steps", type=int, metavar="N", help="of a turn at 864 atoms (default 600); others in proportion"
    )
    made.add_argument("--turns", type=int, help="turns of each (default 5)")
    made.add_argument("--no-answers", action="store_true", help="only the ratios")
    made.add_argument(
        "--along", nargs=2, type=float, default=[1.0, 1.0001], metavar=("LOW", "HIGH"),
        help="interval of sigma that is mapped (default 1.0 1.0001)",
    )  # fmt: skip
    made.add_argument("--json", action="store_true", help="print one JSON document instead of tables")
    return made.parse_args()


def main() -> None:
    """Parse, measure, print and draw."""
    chosen = _options()
    names = chosen.systems or (
        ["argon/crystal-108"] if chosen.quick else ["argon/crystal-108", "argon/liquid-864", "4000"]
    )
    turns = chosen.turns or (1 if chosen.quick else 5)
    steps = chosen.steps or (40 if chosen.quick else 600)
    result: dict[str, Any] = {"ratios": []}
    if not (chosen.no_answers or chosen.quick):
        # before this process holds memory of its own
        result["answer"] = answered(["argon/liquid-864", "--vary", "precision"], min(turns, 3))
    for name in names:
        atoms = len(system_of(name).atoms)
        result["ratios"].append(asdict(race(name, max(100, round(steps * 864 / atoms)), turns)))
    if not chosen.no_answers:
        low, high = chosen.along
        result["map"] = mapped(low, high, *((60, 1) if chosen.quick else (500, BOUNDARIES)))
    result["machine"] = machine()
    if chosen.json:
        print(json.dumps(result, indent=2))
    else:
        show(result)
    draw(result, chosen.output)


if __name__ == "__main__":
    start(main)
