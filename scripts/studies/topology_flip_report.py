"""Which pairs flip, how often, for how long, and how narrowly?

Answer. In argon/liquid-864 33,050 pairs flip 108,638 times in 5,000 steps, 0.025 per atom and step; none
within five steps of its last flip, and half stay inside for 298 steps or more. The smallest margin is 1.6
million rounding bounds: no date depends on rounding. It takes 12 s.

Runs a system (or reads a run folder that exists) and prints what its ledger of flips says:

    flips        pairs that entered or left the cutoff; also per atom and step
    pairs        different pairs that flipped, and how unevenly: the share of the busiest hundredth
    chatter      flips that the same pair takes back within a few steps
    stays        median number of steps between two flips of a pair, inside and outside
    margins      how far from its threshold a decision was when it flipped, in units of the rounding bound;
                 at most 1 is ambiguous: another rounding could have moved the flip to another step
    budget       what is left of the energy's change when the ledger's jumps are taken off

How to read it. In a liquid many pairs flip a few times each, few chatter, and the smallest margin
is far above 1: no date of a flip depends on rounding. In a crystal with a neighbor shell at the
cutoff the same pairs flip again and again: move the cutoff between two shells. Many more ambiguous
flips than expected mean that something holds pairs at the threshold. The whole story is in
report.html, whose path is the last line.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import _shared  # noqa: F401  what scripts share is found by it
import numpy as np
from _output import COLORS, figure, parser, save, say, start, table
from matplotlib.ticker import MaxNLocator

import mdnum
from mdnum import units
from mdnum.errors import InputError
from mdnum.report import analysis
from mdnum.store import RunFolder
from mdnum.verbs import frame
from mdnum.verbs.run_page import RunView

CHATTER = 5


def units_of(run: RunView) -> units.Units:
    """The units of all its numbers."""
    return units.get(run.summary["units"])


def found_or_made(subject: str, out: Path | None, steps: int | None) -> Path:
    """The run folder named, or that of a new run of the system named; it holds a report."""
    if (Path(subject) / "summary.json").is_file():
        if steps is not None or out is not None:
            raise InputError("is a run already", where=subject, remedy="Leave out --steps and --folder")
        frame.finish(subject)
        return Path(subject)
    say(f"running {subject}")
    return mdnum.run(subject, out=out, steps=steps).folder


def facts(run: RunView) -> list[tuple[str, str]]:
    """The ledger in numbers."""
    total, steps = run.flips.total, max(run.steps, 1)
    atoms, summary = run.summary["atoms"], run.summary
    rows = [
        ("flips", f"{total:,}: {summary['flips_entered']:,} entered, {summary['flips_left']:,} left"),
        ("per atom and step", f"{total / atoms / steps:.3g}"),
        ("pairs inside, first and last step", f"{summary['pairs_first']:,}, {summary['pairs_last']:,}"),
    ]
    if total:
        counts = run.flips.busiest.flips
        top = max(1, len(counts) // 100)
        stays = run.flips.stays
        margins = run.flips.ratios
        rows += [
            ("pairs that flipped", f"{len(counts):,}; {counts[0]} times at most"),
            (f"flips of the busiest {top:,} of them", f"{counts[:top].sum() / counts.sum():.1%}"),
            (f"taken back within {CHATTER} steps", f"{stays.undone_within(CHATTER) / len(margins):.1%}"),
            ("median stay inside, outside", f"{_median(stays.inside)}, {_median(stays.outside)} steps"),
            ("smallest margin", f"{margins.min():.3g} rounding bounds"),
            (
                "ambiguous flips",
                f"{int((margins <= 1).sum()):,}; {analysis.expected_ambiguous(margins):.2g} expected",
            ),
        ]
    closes = "closes" if summary["energy_budget_closes"] else "does not close"
    rows += [
        (
            "energy budget",
            f"{closes}: {summary['energy_budget_residual']:.2e} {units_of(run).energy} left",
        ),
        ("lists", f"{summary['rebuilds']:,} rebuilds, {summary['lost_pairs']:,} pairs lost"),
    ]
    return rows


def _median(counts: np.ndarray) -> str:
    found = analysis.median(counts)
    return "no" if found is None else f"{found:.0f}"


def draw(run: RunView, path: Path) -> None:
    """Flips per step, flips per pair, stays, and margins."""
    drawn = figure(9.0, 6.0)
    per_step, per_pair, stayed, margins = drawn.subplots(2, 2).flat
    drawn.suptitle(
        f"{run.summary['system']}: {run.flips.total:,} flips in {run.steps:,} steps", x=0.01, ha="left"
    )
    series = run.series
    for name, color in (("entered", COLORS[0]), ("left", COLORS[1])):
        values = series[name][1:].astype(float)
        # a mean over a few steps, or the noise hides the trend
        width = max(1, len(values) // 60)
        values = values[: len(values) // width * width].reshape(-1, width).mean(1)
        per_step.plot(series["time"][1:][: len(values) * width : width], values, color=color, label=name)
    per_step.set_title("flips per step")
    per_step.set_xlabel(f"time ({units_of(run).time})")
    per_step.set_ylim(bottom=0)
    per_step.legend()
    if run.flips.total:
        counts = run.flips.busiest.flips
        times, pairs = np.unique(counts, return_counts=True)
        per_pair.bar(times, pairs, log=True)
        per_pair.set_ylim(bottom=0.5)
        per_pair.xaxis.set_major_locator(MaxNLocator(integer=True))
        lengths = run.flips.stays
        longest = int(np.flatnonzero(lengths.inside + lengths.outside).max(initial=10))
        edges = np.unique(np.round(np.geomspace(1, longest + 1, 30)))
        for counts, label in ((lengths.inside, "inside"), (lengths.outside, "outside")):
            density = np.histogram(np.arange(len(counts)), edges, weights=counts)[0] / np.diff(edges)
            stayed.stairs(density, edges, label=label, baseline=None)
        stayed.legend()
        stayed.set_xscale("log")
        stayed.set_yscale("log", nonpositive="mask")
        ratio = run.flips.ratios
        ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
        if len(ratio):
            low = np.floor(np.log10(min(ratio.min(), 1)))
            margins.hist(ratio, np.logspace(low, np.ceil(np.log10(ratio.max())), 60), log=True)
            margins.set_xscale("log")
            margins.axvline(1, color=COLORS[1], lw=1)
    per_pair.set_title("pairs that flip so often")
    per_pair.set_xlabel("flips of a pair")
    stayed.set_title("stays per step of length")
    stayed.set_xlabel("steps between two flips of a pair")
    margins.set_title("flips by margin (left of the line: ambiguous)")
    margins.set_xlabel("|margin| / rounding bound")
    save(drawn, path)


def main() -> None:
    """Parse, run or read, print and draw."""
    made = parser(__file__, __doc__)
    made.add_argument("subject", nargs="?", default="argon/liquid-864", help="a system, or a run folder")
    made.add_argument("--steps", type=int, help="steps of a new run (default the system's own)")
    made.add_argument("--folder", type=Path, help="where a new run goes (default runs/<name>-<n>)")
    made.add_argument("--busiest", type=int, default=8, metavar="N", help="pairs to list (default 8)")
    chosen = made.parse_args()
    folder = found_or_made(chosen.subject, chosen.folder, chosen.steps)
    opened = RunFolder.open(folder)
    run = RunView(opened, opened.summary)
    table(
        f"{run.summary['system']}, {run.summary['atoms']} atoms, {run.steps:,} steps",
        ("what", "value"),
        facts(run),
        words=2,
    )
    if run.flips.total:
        flips = RunFolder.open(folder).read("flips", ("i", "j", "distance", "radial_speed"))
        busiest = zip(run.flips.busiest.i, run.flips.busiest.j, run.flips.busiest.flips, strict=True)
        table(
            "\npairs that flip most",
            (
                "pair",
                "flips",
                f"mean distance ({units_of(run).length})",
                "fastest radial speed",
            ),
            (
                (f"{i}-{j}", count, *_where(run, flips, i, j))
                for i, j, count in islice(busiest, chosen.busiest)
            ),
        )
    draw(run, chosen.output)
    print(f"\n{run.summary['verdict']}\n\n{folder / 'report.html'}")


def _where(run: RunView, flips: dict[str, np.ndarray], i: int, j: int) -> tuple[str, str]:
    mine = (flips["i"] == i) & (flips["j"] == j)
    speed = np.abs(flips["radial_speed"][mine]).max()
    return (
        f"{flips['distance'][mine].mean():.5f}",
        f"{speed:.3g} {units_of(run).length}/{units_of(run).time}",
    )


if __name__ == "__main__":
    start(main)
