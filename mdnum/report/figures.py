"""The report's figures, each drawn once for a page and once for a phone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from mdnum.report.axes import PAGE_WIDTH, POINTS, drawn, envelope, legend, line, log_ticks, y_label
from mdnum.report.run import Run
from mdnum.report.scales import clean
from mdnum.report.svg import BAD, FIRST, MUTED, SECOND, THIRD
from mdnum.report.words import power


def energy(run: Run, figure: Figure) -> None:
    """The change of the energy beside the ledger's jumps, and what is left between the two."""
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    time, budget, unit = run.series["time"], run.budget, run.units.energy
    if np.any(run.series["energy_jump"]):
        # one upon the other where the budget closes: a broad pale line, and a thin one that runs in it
        line(above, time, budget["change"], FIRST, "E(t) − E(0)", width=4, alpha=0.4)
        line(above, time, budget["jumps"], SECOND, "sum of the ledger’s jumps", width=0.9, band=False)
        y_label(below, f"difference ({unit})")
    else:
        line(above, time, budget["change"], FIRST, "E(t) − E(0); no flip changes the energy")
        y_label(below, f"residual ({unit})")
    y_label(above, f"energy ({unit})")
    legend(above)
    below.axhline(0, color=MUTED, lw=0.6)
    line(below, time, budget["residual"], THIRD)
    below.set_xlabel(f"time ({run.units.time})")


def flips(run: Run, figure: Figure) -> None:
    """Pairs that enter and leave at each step, and pairs inside."""
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    series = run.series
    # no decision came before the first step, so it has no flips
    time = series["time"][1:]
    for values, color, label, sign in (
        (series["entered"][1:], FIRST, "entered", 1),
        (series["left"][1:], SECOND, "left", -1),
    ):
        if not len(values):
            continue
        low, middle, high, at = envelope(time, values.astype(float), 240)
        above.fill_between(at, sign * low, sign * high, color=color, alpha=0.3, lw=0, step="mid")
        above.step(at, sign * middle, color=color, lw=1.1, where="mid", label=label)
    above.axhline(0, color=MUTED, lw=0.6)
    above.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{abs(value):g}"))
    above.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    y_label(above, "flips per step")
    legend(above)
    line(below, series["time"], series["pairs"].astype(float), THIRD)
    y_label(below, "pairs inside")
    below.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    below.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    below.set_xlabel(f"time ({run.units.time})")


def margins(run: Run, figure: Figure) -> None:
    """How far from their threshold decisions were at a flip, in units of the rounding bound."""
    axes = figure.subplots()
    ratio = run.margins
    ratio = ratio[np.isfinite(ratio)]
    top = np.ceil(np.log10(max(ratio.max(initial=10.0), 10.0)))
    edges = np.arange(-1, top + 0.25, 0.25)
    counts, _ = np.histogram(np.log10(np.maximum(ratio, 0.1001)), edges)
    axes.stairs(counts, edges, color=FIRST, fill=True, alpha=0.35)
    axes.stairs(counts, edges, color=FIRST, lw=1.1, label="flips")
    expected = run.expected_ambiguous
    if expected > 0:
        # a density that is even near zero puts counts in proportion to the width of a bin
        width = 10.0 ** edges[1:] - 10.0 ** edges[:-1]
        shown = (expected * width >= 0.5) & (expected * width <= 2 * counts.max())
        centers = (edges[1:] + edges[:-1]) / 2
        axes.plot(
            centers[shown], expected * width[shown], color=MUTED, lw=1.1, ls="--", label="spread evenly"
        )
    axes.axvspan(-1, 0, color=BAD, alpha=0.16, lw=0)
    axes.axvline(0, color=BAD, lw=1.0)
    axes.set_yscale("log")
    axes.set_ylim(0.5, 3 * max(counts.max(initial=1), 1))
    axes.set_xlim(-1, top)
    axes.annotate(
        "ambiguous", (-0.5, 0.985), xycoords=axes.get_xaxis_transform(), color=BAD, rotation=90,
        va="top", ha="center", fontsize=8,
    )  # fmt: skip
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: power(round(value))))
    log_ticks(axes)
    y_label(axes, "flips per quarter decade")
    axes.set_xlabel("|margin| / rounding bound")
    legend(axes)


def residence(run: Run, figure: Figure) -> None:
    """How long a pair keeps a decision between two flips."""
    axes = figure.subplots()
    lengths = run.stays
    steps = np.arange(len(lengths.inside))
    longest = max(10, *(np.flatnonzero(each).max(initial=0) for each in (lengths.inside, lengths.outside)))
    edges = np.unique(np.round(np.geomspace(1, longest + 1, 36)))
    for values, color, label in ((lengths.inside, FIRST, "inside"), (lengths.outside, SECOND, "outside")):
        counts, _ = np.histogram(steps, edges, weights=values)
        # per step of width: bins of a few steps would otherwise look fuller than they are
        axes.stairs(
            counts / np.diff(edges), edges, color=color, lw=1.3, label=f"stays {label}", baseline=None
        )
    axes.set_xscale("log")
    axes.set_yscale("log", nonpositive="mask")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    log_ticks(axes)
    y_label(axes, "stays per step of length")
    axes.set_xlabel("steps between two flips of a pair")
    legend(axes)


def lists(run: Run, figure: Figure) -> None:
    """What each neighbor list used up of its skin, and how long it lived."""
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    epochs, step = run.epochs, run.epochs["start"].astype(float)
    # of no skin nothing can be used up
    skin, length = clean(epochs["skin_consumed"]), epochs["length"].astype(float)
    bad = epochs["dangerous"].astype(bool) | (epochs["lost_pairs"] > 0)
    above.axhline(1, color=BAD, lw=0.9, ls=(0, (4, 3)), zorder=1.5, label="skin used up")
    for axes, values in ((above, skin), (below, length)):
        if len(values) > POINTS:
            low, middle, high, at = envelope(step, values)
            axes.fill_between(at, low, high, color=FIRST, alpha=0.3, lw=0)
            axes.plot(at, middle, color=FIRST, lw=1.1)
        else:
            axes.plot(step, values, "o", color=FIRST, ms=2.6, mew=0)
        worst = np.flatnonzero(bad)
        worst = worst[np.argsort(-values[worst])][:POINTS]
        if len(worst):
            axes.plot(
                step[worst], values[worst], "o", color=BAD, ms=3.5, mew=0, label="dangerous, or pairs lost"
            )
    above.set_ylim(0, max(1.18, 1.08 * float(np.nanmax(skin, initial=0))))
    below.set_ylim(0, 1.15 * float(np.max(length, initial=1)))
    below.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    legend(above)
    y_label(above, "skin consumed")
    y_label(below, "steps per list")
    below.set_xlabel("step at which the list was built")
    below.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))


#: Figures by file name: what draws it, and its height in inches on a page.
FIGURES: Mapping[str, tuple[Callable[[Run, Figure], None], float]] = MappingProxyType(
    {
        "energy": (energy, 3.9),
        "flips": (flips, 3.7),
        "margins": (margins, 2.9),
        "residence": (residence, 2.7),
        "lists": (lists, 3.5),
    }
)


def draw(name: str, run: Run, width: float = PAGE_WIDTH) -> Figure:
    """One of `FIGURES`.

    Args:
        width: inches; a phone's is drawn a little lower, its labels as large.
    """
    function, height = FIGURES[name]
    figure = drawn(lambda figure: function(run, figure), height, width)
    for axes in figure.axes:
        if width != PAGE_WIDTH and axes.get_xscale() == "linear":
            axes.xaxis.set_major_locator(MaxNLocator(5, integer=name == "margins"))
    return figure
