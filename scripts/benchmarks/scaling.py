"""How do time, memory and the time per flip grow with the system, and do simultaneous runs slow each other
down?

Answer. They grow nearly linearly: a step takes 0.18 µs per atom at 4,000 atoms and 0.29 µs at a million
atoms, a flip takes 0.17 to 0.43 µs. Each of two simultaneous runs takes 1.0 to 1.1 times as long as a single
run (docs/speed.md). It takes many minutes.

The Lennard-Jones liquid of LAMMPS's bench/in.lj (density 0.8442, r_cut 2.5, skin 0.3, float64), recorded,
from 4,000 to 1,000,000 atoms. Every size is a process of its own on one core: the lives of two lists to warm
up, then steps whose CPU time counts, with their flips decoded to ledger rows; the same without recording;
the peak of its memory; and one neighbor search. Then every size once more in two processes at a time, a core
each, and in one process that has two cores. Then whole commands from a shell: a shipped system
with nothing compiled and again, and systems of more than 100,000 atoms from their files (`--no-commands`
leaves them out).

How to read it. What is flat is linear in the number of atoms: the slope over all sizes is the exponent of the
growth, 1 for linear. Times depend on the machine and on what else it does, slopes hardly. What a flip costs
is what recording adds, over the flips. `together` is the time of a step with both processes at work over that
of one alone: above 1 they wait for memory. `two cores` is how many times as many steps an hour one process
makes with two cores. What is compiled, and memory that is used for the first time, is part of the commands.
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
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import liquid
from _output import parser, say, start, table
from _processes import peak_mb
from _turns import Claim, claim, finish

from mdnum.safe_path import environment, python

#: Sizes, about, and CPU seconds that the steps of one should take, about.
SIZES, SECONDS = (4_000, 32_000, 108_000, 256_000, 1_000_000), 8.0
_EXPECTED = 1e-6  # CPU seconds of an atom's step, to choose how many steps that is
_COLUMNS = ("us_per_atom_step", "us_per_flip", "search_us_per_atom", "peak_mb")


def measure(atoms: int, seconds: float) -> dict[str, float]:
    """One size in this process: CPU time of an atom's step and of a flip, a search, and peak memory."""
    from mdnum.md.cell import wrap_positions
    from mdnum.systems import build

    simulation = build(liquid(atoms))
    count = simulation.atoms
    # at a million atoms a list lives seven steps
    last = max(48, round(seconds / _EXPECTED / count))
    alone, _, _ = _steps(simulation, last, record=False)
    recorded, elapsed, flips = _steps(simulation, last, record=True)
    wrapped, _ = wrap_positions(simulation.cell, simulation.positions)
    verlet = simulation.verlet_list()
    verlet.build(wrapped, simulation.cell)
    begin = time.process_time()
    verlet.build(wrapped, simulation.cell)
    search = time.process_time() - begin
    return {
        "atoms": count, "steps": last, "us_per_atom_step": 1e6 * recorded / count,
        "recording": recorded / alone - 1, "us_per_flip": 1e6 * (recorded - alone) / flips,
        "search_us_per_atom": 1e6 * search / count, "peak_mb": peak_mb(), "ms_per_step": 1e3 * elapsed,
    }  # fmt: skip


def _steps(simulation: Any, last: int, *, record: bool) -> tuple[float, float, float]:
    """CPU and clock seconds of a step, and its flips, after the lives of two lists."""
    from mdnum.rollout import Engine, PairRecorder

    recorder, flips, rows, begun = PairRecorder(simulation), 0, 0, None
    for segment in Engine(simulation, last, record=record, rows=not record).segments():
        if record:
            recorder.counts(segment)
            found = len(recorder.flips(segment))
            flips += found if begun else 0
        if begun:
            rows += segment.rows
        elif segment.epoch == 1 and segment.closes:
            begun = time.process_time(), time.perf_counter()
    if begun is None or not rows:
        raise ValueError(f"{last} steps are over before the third list is")
    now = time.process_time(), time.perf_counter()
    return (now[0] - begun[0]) / rows, (now[1] - begun[1]) / rows, flips / rows


def commands(sizes: list[int]) -> list[dict[str, Any]]:
    """`mdnum run` from a shell: seconds, those of its loop, and peak memory."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        home, out = Path(scratch), Path(scratch) / "out"
        own = environment(XDG_CACHE_HOME=str(home / "programs"), NUMBA_CACHE_DIR=str(home / "numba"))
        for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
            own.pop(name, None)

        def run(system: str, steps: int, what: str) -> None:
            shutil.rmtree(out, ignore_errors=True)
            words = python("-m", "mdnum", "run", system, "--steps", str(steps), "--out", str(out))
            say(what)
            begun = time.perf_counter()
            child = subprocess.Popen(words, env=own, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            _, status, used = os.wait4(child.pid, 0)
            seconds = time.perf_counter() - begun
            # 1 is for findings
            if os.waitstatus_to_exitcode(status) > 1:
                raise RuntimeError(f"{' '.join(words)} failed")
            summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
            loop = steps / summary["steps_per_second"]
            atoms, peak = summary["atoms"], used.ru_maxrss / 1024
            rows.append(
                {"what": what, "atoms": atoms, "steps": steps, "seconds": seconds, "loop": loop, "mb": peak}
            )

        for when in ("first", "again"):
            run("argon/liquid-864", 5_000, f"argon/liquid-864, {when}")
        for atoms in sorted(size for size in sizes if size > 100_000):
            file, steps = str(liquid(atoms).write(home / str(atoms))), 200 if atoms < 500_000 else 12
            # programs are compiled by the first
            run(file, steps, f"{atoms:,} atoms, first")
            run(file, steps, f"{atoms:,} atoms, again")
    return rows


def claims(result: dict[str, Any]) -> Iterator[Claim]:
    """What was measured beside what is required."""
    if "flat" in result:
        yield claim("cost of an atom's step, largest over smallest", result["flat"], "<=", 1.3)
    for row in result["sizes"]:
        name = f"{row['atoms']:,.0f} atoms"
        yield claim(f"time added by recording, {name}", row["recording"], "<=", 0.07)
        if "two_cores" in row:
            yield claim(f"two cores over one, {name}", row["two_cores"], ">=", 1.7)
        if row["atoms"] > 500_000:
            yield claim(
                f"one search, {name}, CPU s", 1e-6 * row["search_us_per_atom"] * row["atoms"], "<=", 0.6
            )
    for row in result.get("commands", []):
        what = f"`mdnum run` of {row['what']}"
        if row["atoms"] < 100_000:
            yield claim(what, row["seconds"], "<=", 7 if "first" in row["what"] else 5, "s")
        elif "again" in row["what"]:
            yield claim(f"{what}, over its loop", row["seconds"] / row["loop"], "<=", 1.5)
            if row["atoms"] > 500_000:
                yield claim(f"{what}, s a step", row["seconds"] / row["steps"], "<=", 2.5)
                yield claim(f"{what}, peak", row["mb"], "<=", 4096, "MB")


def children(sizes: list[int], seconds: float, cores: list[list[int]]) -> list[dict[str, float]]:
    """Sizes measured at the same time, each in a process on cores of its own."""
    runs = []
    for atoms, own in zip(sizes, cores, strict=True):
        words = [sys.executable, __file__, "--child", str(atoms), str(seconds)]
        # before the process begins: threads that a library starts stay where it was then
        pinned = partial(os.sched_setaffinity, 0, own) if hasattr(os, "sched_setaffinity") else None
        runs.append(subprocess.Popen(words, stdout=subprocess.PIPE, text=True, preexec_fn=pinned))
    answers = [run.communicate()[0] for run in runs]
    if any(run.returncode for run in runs):
        raise RuntimeError("a process failed; its error is above")
    return [json.loads(answer.splitlines()[-1]) for answer in answers]


def slope(rows: list[dict[str, float]], name: str) -> float:
    """Exponent of the growth with the number of atoms: of a whole step, a search, all flips, all memory."""
    atoms = np.log([row["atoms"] for row in rows])
    each = 0.0 if name == "peak_mb" else atoms
    return float(np.polyfit(atoms, np.log([row[name] for row in rows]) + each, 1)[0])


def show(result: dict[str, Any]) -> None:
    """All of it as tables."""
    names = ("recording", *_COLUMNS, "two_cores", "together")
    columns = (
        "N", "steps", "recording adds", "µs/atom/step", "µs/flip", "search µs/atom", "peak MB", "two cores",
        "together",
    )  # fmt: skip
    rows = [
        [f"{row['atoms']:,.0f}", row["steps"], *(float(row.get(name, np.nan)) for name in names)]
        for row in result["sizes"]
    ]
    table("growth", columns, rows)
    if powers := result.get("slopes"):
        said = ", ".join(f"{name} N^{power:.2f}" for name, power in powers.items())
        print(f"\nslopes, all atoms and flips together: {said}")
    if whole := result.get("commands"):
        cells = [[row[name] for name in ("what", "steps", "seconds", "loop", "mb")] for row in whole]
        table("\n`mdnum run` from a shell", ("what", "steps", "s", "loop s", "peak MB"), cells)


def _options() -> argparse.Namespace:
    made = parser(__doc__)
    made.add_argument("--sizes", nargs="+", type=int, metavar="N", default=list(SIZES), help="atoms, about")
    made.add_argument("--seconds", type=float, default=SECONDS, help="CPU time of a size's steps, about")
    made.add_argument("--no-commands", action="store_true", help="only the loop")
    made.add_argument("--json", action="store_true", help="print one JSON document instead of tables")
    return made.parse_args()


def main() -> None:
    """Measure each size alone, on two cores and twice at a time, and print."""
    if sys.argv[1:2] == ["--child"]:
        print(json.dumps(measure(int(sys.argv[2]), float(sys.argv[3]))))
        return
    chosen = _options()
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_setaffinity") else [0]
    rows = []
    for atoms in sorted(chosen.sizes):
        say(f"N = {atoms:,}")
        rows += children([atoms], chosen.seconds, [cores[:1]])
        if len(cores) > 1:
            (both,) = children([atoms], chosen.seconds, [cores[:2]])
            rows[-1]["two_cores"] = rows[-1]["ms_per_step"] / both["ms_per_step"]
            several = children([atoms] * 2, chosen.seconds, [[core] for core in cores[:2]])
            slower = float(np.mean([row["ms_per_step"] for row in several]))
            rows[-1]["together"] = slower / rows[-1]["ms_per_step"]
    result: dict[str, Any] = {"sizes": rows, "cores": len(cores)}
    if len(rows) > 1:
        result["slopes"] = {name: slope(rows, name) for name in _COLUMNS}
        result["flat"] = rows[-1]["us_per_atom_step"] / rows[0]["us_per_atom_step"]
    if not chosen.no_commands:
        result["commands"] = commands(chosen.sizes)
    finish(chosen, result, show, claims)


if __name__ == "__main__":
    start(main)
