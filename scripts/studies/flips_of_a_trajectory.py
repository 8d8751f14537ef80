"""How often, and with how many digits, must a trajectory be written for its flips to be seen?

Answer. Of argon at 2 fs a step, a frame every 32 fs shows 99.8 % of the flips and one every 128 fs 96 %,
and the loss estimated from those frames alone is right. Three decimals of an Ångström hide a tenth of the
flips and make up as many; two decimals, more than half. It takes 27 s.

Takes a trajectory (or makes one with mdnum, every step of it) and looks at it again as if fewer frames had
been written, and as if positions had been rounded to so many decimals:

    flips        pairs that entered or left the cutoff between the frames that are left
    of all       their share of the flips in all frames
    said lost    share of all flips that mdnum says happened and reverted between the frames, from those
                 frames alone, and its range (docs/lost-flips.md has how often that holds the truth)
    lost         the same for true, as far as all frames know
    median       median contact that begins in the file (product-limit estimate)
    by rate      mean contact by the rate at which they end, which needs no beginning
    missed, made up   flips that rounding hides from a frame, or puts there

How to read it. Where "of all" falls, contacts seem to last longer than they do, by as much; "by rate" shows
it. Where "said lost" is a dash, too wide a range fits, or what is lost cannot be
told apart from the rounding of the file, and no number is given. A file with
three decimals of a nanometer (xtc) is the row with two decimals of an Ångström.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import COLORS, figure, parser, save, say, start, table

import mdnum
from mdnum.md.ledger import FlipTable
from mdnum.trajectories import CutoffRule, Tracker, open_trajectory


def made(folder: Path, steps: int) -> Path:
    """A run of liquid argon with every step written."""
    say(f"running argon/liquid-864 for {steps:,} steps")
    run = mdnum.run(
        "argon/liquid-864", steps=steps, save_every=1, out=folder / "run", check=False, report=False
    )
    return run.folder / "trajectory.traj"


def at_strides(chosen: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """What the file says at each stride."""
    rows, stop = [], ""
    count = open_trajectory(chosen.trajectory, chosen.topology).count
    if count is not None:
        # all strides end at the same frame
        longest = max(chosen.strides)
        stop = str((count - 1) // longest * longest + 1)
    for stride in chosen.strides:
        say(f"every {stride} frames" if stride > 1 else "every frame")
        cutoffs = [] if chosen.cutoff is None else [chosen.cutoff]
        found = mdnum.flips(
            f"{chosen.trajectory}@:{stop}:{stride}", topology=chosen.topology, cutoffs=cutoffs,
            out=folder / f"stride-{stride}", report=False,
        ).summary  # fmt: skip
        rows.append(
            {
                "every": stride,
                "interval": found["interval"],
                "unit": found["time"],
                **found["rules"][0],
                "stride": found["rules"][0]["stride"]["between"] or {"lost": None},
            }
        )
    return rows


def told(row: dict[str, Any], whole: int) -> list[Any]:
    """A line of the first table."""
    between, life = row["stride"], row["lifetime"]
    said = None
    if between["lost"] is not None:
        lost, low, high = (f"{100 * between[name]:.2g}" for name in ("lost", "low", "high"))
        said = f"{lost}% ({low} to {high})"
    share = row["flips"] / whole if whole else float("nan")
    median = life["median"] and life["median"] * row["interval"]
    return [
        row["every"], f"{row['interval']:.4g}", f"{row['flips']:,}", f"{share:.1%}", said, f"{1 - share:.1%}",
        median, life["mean_by_rate"] * row["interval"],
    ]  # fmt: skip


def ledger(chosen: argparse.Namespace, radius: float, decimals: int | None) -> set[tuple[int, ...]]:
    """(frame, i, j, rank, entered) of every flip, from positions with so many decimals."""
    tracker, found = Tracker(CutoffRule(radius)), []
    for frame in open_trajectory(chosen.trajectory, chosen.topology).frames():
        if decimals is not None:
            frame = replace(frame, positions=np.round(frame.positions, decimals))
        found.append(tracker.step(frame))
    rows = FlipTable.concatenate(found)
    columns = (rows.frame, rows.i, rows.j, rows.rank, rows.entered)
    return set(zip(*(column.tolist() for column in columns), strict=True))


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Flips that are left and that are said to be lost, and contacts, against the time between frames."""
    drawn = figure(9.0, 3.6)
    flips, contacts = drawn.subplots(1, 2)
    interval = np.array([row["interval"] for row in rows])
    whole = max(rows[0]["flips"], 1)
    flips.plot(interval, [1 - row["flips"] / whole for row in rows], "o-", label="lost")
    said = [(row["interval"], row["stride"]) for row in rows if row["stride"]["lost"] is not None]
    if said:
        x, found = zip(*said, strict=True)
        middle = np.array([one["lost"] for one in found])
        ends = np.array([[one["lost"] - one["low"], one["high"] - one["lost"]] for one in found]).T
        flips.errorbar(x, middle, np.abs(ends), fmt="s", color=COLORS[1], capsize=3, label="said to be lost")
    for name, label in (("mean_by_rate", "mean by rate"), ("median", "median")):
        values = [row["lifetime"][name] for row in rows]
        known = [(x, value * x) for x, value in zip(interval, values, strict=True) if value is not None]
        contacts.plot(*zip(*known, strict=True), "o-", label=label) if known else None
    unit = rows[0]["unit"]
    for axes, title in ((flips, "flips between the frames, share of all"), (contacts, f"contacts ({unit})")):
        axes.set_title(title)
        axes.set_xlabel(f"time between frames ({unit})")
        axes.set_xscale("log")
        axes.set_ylim(bottom=0)
        axes.legend()
    save(drawn, path)


def whole_numbers(text: str) -> list[int]:
    """Numbers between commas."""
    return [int(word) for word in text.split(",") if word]


def main() -> None:
    """Parse, look, print and draw."""
    given = parser(__doc__, __file__)
    given.add_argument("trajectory", nargs="?", help="a file, or a run of mdnum (default: one is made)")
    given.add_argument("-s", "--topology", help="what its atoms are, where it does not say")
    given.add_argument("--cutoff", type=float, help="length (default that of the mdnum run)")
    given.add_argument("--steps", type=int, default=2_000, help="of a run that is made (default 2000)")
    given.add_argument(
        "--strides", type=whole_numbers, default=[1, 4, 16, 64], metavar="N,N", help="1,4,16,64"
    )
    given.add_argument("--decimals", type=whole_numbers, default=[3, 2, 1], metavar="N,N", help="3,2,1")
    chosen = given.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if chosen.trajectory is None:
            chosen.trajectory = made(Path(folder), chosen.steps)
        rows = at_strides(chosen, Path(folder))
        time = rows[0]["unit"]
        columns = ("stride", f"interval ({time})", "flips", "of all", "said lost", "lost", f"median ({time})",
                   f"by rate ({time})")  # fmt: skip
        title = f"{Path(chosen.trajectory).name}, {rows[0]['rule']}"
        table(title, columns, (told(row, rows[0]["flips"]) for row in rows))
        if chosen.decimals:
            radius = float(rows[0]["rule"].rpartition("<")[2])
            exact = ledger(chosen, radius, None)
            lines = []
            for decimals in chosen.decimals:
                say(f"{decimals} decimals")
                rounded = ledger(chosen, radius, decimals)
                both = len(exact & rounded)
                shares = (1 - both / max(len(one), 1) for one in (exact, rounded))
                lines.append([decimals, f"{len(rounded):,}", *(f"{share:.2%}" for share in shares)])
            table("\nevery frame, positions rounded", ("decimals", "flips", "missed", "made up"), lines)
        draw(rows, chosen.output)


if __name__ == "__main__":
    start(main)
