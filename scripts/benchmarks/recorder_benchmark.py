"""How long does a frame passed to `mdnum.Recorder` take, relative to the same frame of a file?

Answer. It takes no longer, also with a neighbor list; it takes longer if the list is new at every step
(docs/speed.md). It takes minutes.

A Lennard-Jones liquid (density 0.8442, r_cut 2.5, timestep 0.005, float64), every step. Frames go through
`mdnum flips` from a file (ASE's traj), through a recorder, and through a recorder that is given a neighbor
list as well, which is made again at every tenth step, or has another order at every step. Contenders take
turns in one process. The time of a frame is the slope of the least processor time over two numbers of
frames: start and page cost nothing.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _liquid import R_CUT, liquid
from _output import parser, start
from _turns import in_turn
from ase.io import iread, write
from ase.neighborlist import neighbor_list

import mdnum


def main() -> None:
    """Turns, and the slope of each."""
    options = parser(__doc__)
    for name, value in (("atoms", 4000), ("rounds", 3)):
        options.add_argument(f"--{name}", type=int, default=value)
    options.add_argument("--frames", type=int, nargs=2, default=(60, 260))
    given = options.parse_args()
    few, many = given.frames
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        mdnum.run(
            liquid(given.atoms), steps=many - 1, save_every=1, out=folder / "run", check=False, report=False,
            progress=False,
        )  # fmt: skip
        atoms = list(iread(folder / "run" / "trajectory.traj"))
        frames, cell = [one.positions for one in atoms], atoms[0].cell.array
        made = [
            (ij := np.array(neighbor_list("ij", one, R_CUT + 0.4)), ij[:, ::-1].copy()) for one in atoms[::10]
        ]
        for count in given.frames:
            write(folder / f"{count}.traj", atoms[:count])

        def file(count: int) -> None:
            out = folder / "out"
            shutil.rmtree(out, ignore_errors=True)
            mdnum.flips(folder / f"{count}.traj", cutoffs=R_CUT, out=out, progress=False)

        def recorded(count: int, every: int = 0) -> None:
            shutil.rmtree(folder / "out", ignore_errors=True)
            with mdnum.Recorder(R_CUT, cell=cell, out=folder / "out") as one:
                for step, x in enumerate(frames[:count]):
                    one.see(step, x, neighbors=made[step // 10][every == 1 and step % 2] if every else None)

        runs: dict[str, Callable[[int], None]] = {"mdnum flips": file, "Recorder": recorded}
        runs |= {f"list every {n}": partial(recorded, every=n) for n in (10, 1)}
        works = {f"{name}, {n}": partial(run, n) for name, run in runs.items() for n in given.frames}
        taken = {name: rows[1:, 1].min() for name, rows in in_turn(works, given.rounds, "frames").items()}
    slopes = {
        name: 1e3 * (taken[f"{name}, {many}"] - taken[f"{name}, {few}"]) / (many - few) for name in runs
    }
    for name, slope in slopes.items():
        print(f"{name:12} {slope:6.2f} ms a frame, {slope / slopes['mdnum flips']:.2f}")


if __name__ == "__main__":
    start(main)
