"""How long do two runs and a counterfactual run take, relative to one recorded run?

Answer. 2.9 to 3.4 times the CPU time of one recorded run, with 108 to 4,000 atoms; the whole command for
argon/liquid-864 takes 80 s of CPU time, a map of 20 boundaries takes 22 s. It takes 280 s.

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
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import parser, say, start, table
from _turns import Claim, claim, finish, in_turn, ratios, seconds

if TYPE_CHECKING:
    from mdnum.systems import System

SINGLE, TRIPLE = "recorded run", "A, B and B|A"
MOST_RATIO, MOST_SECONDS, MOST_MAP_SECONDS = 3.5, 60.0, 120.0
BOUNDARIES = 20


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


def race(system: System, steps: int, turns: int) -> dict[str, Any]:
    """Let the two take turns on one system; medians."""
    loops = {SINGLE: partial(single(system), steps), TRIPLE: partial(triple(system), steps)}
    taken = in_turn(loops, turns, system.name)
    row: dict[str, Any] = {"system": system.name, "atoms": len(system.atoms), "steps": steps, "turns": turns}
    for name, loop in (("single", SINGLE), ("triple", TRIPLE)):
        wall, busy = np.median(taken[loop][1:], axis=0)
        row |= {f"{name}_ms": float(1e3 * wall / steps), f"{name}_cpu_ms": float(1e3 * busy / steps)}
        row[f"{name}_compile"] = float(taken[loop][0, 1] - busy)
    row["ratio"], row["cpu_ratio"] = np.median(ratios(taken, TRIPLE, SINGLE), axis=0).tolist()
    return row


def answered(words: list[str], turns: int) -> dict[str, Any]:
    """Seconds of `mdnum fork` in a fresh process, from the question to the report."""
    taken = []
    with tempfile.TemporaryDirectory() as scratch:
        for turn in range(turns):
            say(f"mdnum fork {' '.join(words)}: turn {turn + 1} of {turns}")
            out = Path(scratch, f"{turn}")
            command = [sys.executable, "-m", "mdnum", "fork", *words, "-o", str(out)]
            taken.append(
                seconds(
                    partial(
                        subprocess.run,
                        command,
                        check=True,
                        stdout=subprocess.DEVNULL,
                        stderr=subprocess.DEVNULL,
                    )
                )
            )
        summary = json.loads(Path(scratch, "0", "summary.json").read_text())
    wall, busy = np.median(taken, axis=0).tolist()
    return {
        "words": words, "seconds": wall, "cpu_seconds": busy, "verdict": summary["effect"],
        "steps": summary["steps"],
    }  # fmt: skip


def mapped(low: float, high: float, steps: int, most: int) -> dict[str, Any]:
    """Seconds of a map along sigma, compilation and the processes that confirm it included."""
    from mdnum.forks.boundaries import boundaries
    from mdnum.systems import load

    say(f"{most} boundaries along sigma")
    found: list[Any] = []

    def made() -> None:
        system = load("argon/crystal-108")
        found.append(boundaries(system, "potential.sigma", low, high, steps, most=most))

    wall, busy = seconds(made).tolist()
    return {
        "boundaries": len(found[0].boundaries), "runs": found[0].evaluations, "steps": steps,
        "confirmed": sum(one.confirmed is True for one in found[0].boundaries),
        "seconds": wall, "cpu_seconds": busy,
    }  # fmt: skip


def claims(result: dict[str, Any]) -> Iterator[Claim]:
    """What was measured beside what is required."""
    for row in result["ratios"]:
        for name, value in (("CPU time", row["cpu_ratio"]), ("clock", row["ratio"])):
            yield claim(f"{TRIPLE} over one recorded run, {row['system']}, {name}", value, "<=", MOST_RATIO)
    if found := result.get("answer"):
        yield claim(f"mdnum fork {' '.join(found['words'])}", found["seconds"], "<", MOST_SECONDS, "s")
    if found := result.get("map"):
        what = f"a map, {found['boundaries']} boundaries of {found['steps']} steps"
        yield claim(what, found["seconds"], "<", MOST_MAP_SECONDS, "s")


def show(result: dict[str, Any]) -> None:
    """All of it as tables."""
    table(
        f"{TRIPLE} beside one recorded run",
        ("system", "N", "steps x turns", "one ms/step", "three", "one CPU", "three", "ratio", "CPU ratio",
         "one compile s", "three"),
        (
            (
                row["system"], f"{row['atoms']:,}", f"{row['steps']} x {row['turns']}",
                *(f"{row[f'{name}_ms']:.3f}" for name in ("single", "triple", "single_cpu", "triple_cpu")),
                *(f"{row[name]:.2f}" for name in ("ratio", "cpu_ratio")),
                *(f"{row[f'{name}_compile']:.1f}" for name in ("single", "triple")),
            )
            for row in result["ratios"]
        ),
    )  # fmt: skip
    for key in ("answer", "map"):
        if found := result.get(key):
            table(f"\n{key}", list(found), [[" ".join(one) if isinstance(one, list) else one
                                              for one in found.values()]])  # fmt: skip


def _options() -> argparse.Namespace:
    made = parser(__doc__)
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
    """Parse, measure, and print."""
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
        system = system_of(name)
        result["ratios"].append(race(system, max(100, round(steps * 864 / len(system.atoms))), turns))
    if not chosen.no_answers:
        low, high = chosen.along
        result["map"] = mapped(low, high, *((60, 1) if chosen.quick else (500, BOUNDARIES)))
    finish(chosen, result, show, claims)


if __name__ == "__main__":
    start(main)
