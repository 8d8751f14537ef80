"""How many decimals must the positions of a trajectory have so that its flips can be detected?

Answer. With three decimals of an Ångström, a tenth of the flips of argon at steps of 2 fs are missed, and as
many spurious flips appear; with two decimals, more than half. It takes 27 s.

Takes a trajectory (or makes one with mdnum, every step of it) and looks at it again as if positions had been
rounded to so many decimals:

    flips              pairs that enter or leave the cutoff between frames
    missed, made up    flips that rounding hides from a frame, or puts there

How to read it. A file with three decimals of a nanometer (xtc) is the row with two decimals of an Ångström.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import parser, say, start, table

import mdnum
from mdnum.md.ledger import FlipTable
from mdnum.trajectories import CutoffRule, Tracker, open_trajectory


def flips(trajectory: str, radius: float, decimals: int | None) -> set[tuple[int, ...]]:
    """(frame, i, j, rank, entered) of every flip, from positions with so many decimals."""
    tracker, found = Tracker(CutoffRule(radius)), []
    for frame in open_trajectory(trajectory).frames():
        if decimals is not None:
            frame = replace(frame, positions=np.round(frame.positions, decimals))
        found.append(tracker.step(frame))
    rows = FlipTable.concatenate(found)
    columns = (rows.frame, rows.i, rows.j, rows.rank, rows.entered)
    return set(zip(*(column.tolist() for column in columns), strict=True))


def main() -> None:
    """Parse, look and print."""
    given = parser(__doc__)
    given.add_argument("trajectory", nargs="?", help="a file with topology (default: a run of liquid argon)")
    given.add_argument("--cutoff", type=float, default=8.5125, help="length (default 8.5125)")
    given.add_argument("--steps", type=int, default=2_000, help="of a run that is made (default 2000)")
    given.add_argument("--decimals", type=int, nargs="+", default=[3, 2, 1], metavar="N")
    chosen = given.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        trajectory = chosen.trajectory
        if trajectory is None:
            say(f"running argon/liquid-864 for {chosen.steps:,} steps")
            out = Path(folder) / "run"
            mdnum.run(
                "argon/liquid-864", steps=chosen.steps, save_every=1, out=out, check=False, report=False
            )
            trajectory = str(out / "trajectory.traj")
        exact, rows = flips(trajectory, chosen.cutoff, None), []
        for decimals in chosen.decimals:
            say(f"{decimals} decimals")
            rounded = flips(trajectory, chosen.cutoff, decimals)
            both = len(exact & rounded)
            shares = (1 - both / max(len(one), 1) for one in (exact, rounded))
            rows.append([decimals, f"{len(rounded):,}", *(f"{share:.2%}" for share in shares)])
    table(f"{len(exact):,} flips, positions rounded", ("decimals", "flips", "missed", "made up"), rows)


if __name__ == "__main__":
    start(main)
