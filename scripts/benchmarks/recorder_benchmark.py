"""What does a frame cost that a loop gives to `mdnum.Recorder`, over the same frame of a file?

Answer. As much, also with a neighbor list; more with one that is new at every step (docs/speed.md).
It takes minutes.

A Lennard-Jones liquid (density 0.8442, r_cut 2.5, timestep 0.005, float64), every step. Frames go through
`mdnum flips` from a file (ASE's traj), through a recorder, and through a recorder that is given a neighbor
list as well, which is made again at every tenth step, or has another order at every step. Contenders take
turns in one process. The time of a frame is the slope of the least processor time over two numbers of
frames: start and page cost nothing.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import R_CUT, liquid
from ase.io import iread, write
from ase.neighborlist import neighbor_list

import mdnum


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("atoms", 4000), ("rounds", 3)):
        asked.add_argument(f"--{name}", type=int, default=value)
    asked.add_argument("--frames", type=int, nargs=2, default=(60, 260))
    given = asked.parse_args()
    folder = Path(tempfile.mkdtemp())
    long = max(given.frames)
    mdnum.run(
        liquid(given.atoms), steps=long - 1, save_every=1, out=folder / "run", check=False, report=False,
        progress=False,
    )  # fmt: skip
    atoms = list(iread(folder / "run" / "trajectory.traj"))
    frames, cell = [one.positions for one in atoms], atoms[0].cell.array

    def file(count: int) -> None:
        mdnum.flips(folder / f"{count}.traj", cutoffs=R_CUT, out=folder / "out", progress=False)

    def recorded(count: int, every: int = 0) -> None:
        with mdnum.Recorder(R_CUT, cell=cell, out=folder / "out") as one:
            for step, x in enumerate(frames[:count]):
                one.see(step, x, neighbors=made[step // 10][every == 1 and step % 2] if every else None)

    def timed(run: Callable[[int], None], count: int) -> float:
        began = time.process_time()
        run(count)
        spent = time.process_time() - began
        shutil.rmtree(folder / "out")
        return spent

    made = [
        (ij := np.array(neighbor_list("ij", one, R_CUT + 0.4)), ij[:, ::-1].copy()) for one in atoms[::10]
    ]
    for count in given.frames:
        write(folder / f"{count}.traj", atoms[:count])
    runs: dict[str, Callable[[int], None]] = {"mdnum flips": file, "Recorder": recorded}
    runs |= {f"list every {n}": partial(recorded, every=n) for n in (10, 1)}
    best: dict[tuple[str, int], float] = {}
    for _ in range(given.rounds + 1):
        for name, run in runs.items():
            for count in given.frames:
                best[name, count] = min(timed(run, count), best.get((name, count), 1e9))
    few, many = given.frames
    slopes = {name: 1e3 * (best[name, many] - best[name, few]) / (many - few) for name in runs}
    for name, slope in slopes.items():
        print(f"{name:12} {slope:6.2f} ms a frame, {slope / slopes['mdnum flips']:.2f}")
    shutil.rmtree(folder)


main()
