"""Plots drawn with plain matplotlib, in one style and one width that the page scales."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator, NullFormatter, ScalarFormatter

from mdnum.report import thin
from mdnum.report.section import Figure, Plot, Region, Series
from mdnum.report.svg import BAD, FIRST, GRID, INK, MUTED, SECOND, THIRD, style
from mdnum.report.words import many, typeset

#: Inches; the page scales it.
WIDTH = 7.2
#: Points a line is thinned to; longer ones become an envelope of smallest and largest values.
POINTS = 600
COLORS = {"first": FIRST, "second": SECOND, "third": THIRD, "bad": BAD, "muted": MUTED, "ink": INK}
_MARKERS = {"first": "o", "second": "s", "third": "^", "bad": "X", "muted": "D", "ink": "o"}
#: Colors of a region's classes, in order: as a rule all is well, look here, do not.
_CLASSES = (THIRD, SECOND, BAD, FIRST, MUTED, INK)


def draw(figure: Figure | Plot) -> Canvas:
    """A figure of a page as matplotlib has it."""
    if isinstance(figure, Plot):
        return canvas(lambda empty: _plot(figure, empty), 3.3 if figure.region else 2.9)
    return canvas(figure.draw, figure.height)


def canvas(fill: Callable[[Canvas], None], height: float) -> Canvas:
    """A figure in the report's style.

    Args:
        fill: draws into it.
        height: inches.
    """
    with style():
        figure = Canvas(figsize=(WIDTH, height), layout="constrained")
        fill(figure)
        figure.align_ylabels()
        for axes in figure.axes:
            axes.grid(True, color=GRID, lw=0.6)
            axes.set_axisbelow(True)
            axes.spines[["top", "right", "left"]].set_visible(False)
            axes.tick_params(which="both", length=0)
            for axis, scale in ((axes.xaxis, axes.get_xscale()), (axes.yaxis, axes.get_yscale())):
                if scale != "linear":
                    axis.set_minor_formatter(NullFormatter())
                elif isinstance(axis.get_major_formatter(), ScalarFormatter):
                    axis.set_major_formatter(_engineering())
    return figure


def line(axes: Axes, x: np.ndarray, y: np.ndarray, color: str, label: str = "", **look: object) -> None:
    """A line; of more points than fit, their mean and a band from the smallest to the largest."""
    low, middle, high, at = envelope(np.asarray(x), np.asarray(y))
    if len(y) > POINTS:
        axes.fill_between(at, low, high, color=color, alpha=0.3, lw=0)
    axes.plot(at, middle, color=color, label=label or None, **{"lw": 1.2, **look})  # type: ignore[arg-type]


def envelope(
    x: np.ndarray, y: np.ndarray, most: int = POINTS
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(smallest, mean, largest, position) in at most n equal groups; a group of one is its value."""
    if len(y) <= most:
        return y, y, y, x
    starts = np.unique(np.linspace(0, len(y), most, endpoint=False).astype(int))
    sizes = np.diff(np.append(starts, len(y)))
    return (
        np.minimum.reduceat(y, starts),
        np.add.reduceat(y, starts) / sizes,
        np.maximum.reduceat(y, starts),
        np.add.reduceat(x, starts) / sizes,
    )


def legend(axes: Axes) -> None:
    """The names of the lines above the axes, where nothing lies; of one line none but its own label's."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        longest = max(len(label) for label in labels)
        axes.legend(
            loc="lower left", bbox_to_anchor=(0, 1.0), ncols=max(1, min(len(labels), 96 // (longest + 6))),
            frameon=False, handlelength=1.4, columnspacing=1.4, borderaxespad=0.2, fontsize=8.5,
        )  # fmt: skip


def notes(plot: Figure | Plot) -> list[str]:
    """What a plot cannot show, a sentence each."""
    if isinstance(plot, Figure) or not plot.series:
        return []
    sentences = []
    x, y = (np.concatenate([np.asarray(getattr(one, name), float) for one in plot.series]) for name in "xy")
    infinite = int(np.isinf(x).sum() + np.isinf(y).sum())
    if infinite:
        sentences.append(
            f"{many(infinite, 'value')} {'is' if infinite == 1 else 'are'} infinite and left out."
        )
    for scale, values, label in ((plot.x_scale, x, plot.x_label), (plot.y_scale, y, plot.y_label)):
        values = values[np.isfinite(values)]
        lost = int((values <= 0).sum()) if scale == "log" else 0
        if lost and lost == len(values):
            sentences.append(f"No value of {label} is positive, so its axis is linear.")
        elif lost:
            sentences.append(
                f"{many(lost, 'value')} of {label} at or below zero cannot be shown on its axis."
            )
    return sentences


def _plot(plot: Plot, figure: Canvas) -> None:
    axes = figure.subplots()
    for scale, name in ((plot.x_scale, "x"), (plot.y_scale, "y")):
        _scale(axes, name, scale, plot)
    if plot.region is not None:
        _region(axes, plot.region)
    for series in plot.series:
        _series(axes, series)
    if not axes.lines and not axes.collections and plot.region is None:
        axes.text(0.5, 0.5, "no values", transform=axes.transAxes, color=MUTED, ha="center", va="center")
    for marks, mark, transform in (
        (plot.verticals, axes.axvline, axes.get_xaxis_transform()),
        (plot.horizontals, axes.axhline, axes.get_yaxis_transform()),
    ):
        for value, word in marks:
            mark(value, color=MUTED, lw=0.9, ls=(0, (4, 3)), zorder=1.6)
            upright = marks is plot.verticals
            place = (value, 0.98) if upright else (0.99, value)
            axes.annotate(
                typeset(word), place, xycoords=transform, color=MUTED, fontsize=8, ha="right",
                va="top" if upright else "bottom", rotation=90 if upright else 0,
            )  # fmt: skip
    axes.set_xlabel(typeset(plot.x_label))
    axes.set_ylabel(typeset(plot.y_label))
    if len(plot.series) > 1 or plot.region is not None:
        legend(axes)


def _scale(axes: Axes, name: str, scale: str, plot: Plot) -> None:
    values = [np.asarray(getattr(one, name), float) for one in (*plot.series, *filter(None, [plot.region]))]
    there = np.abs(np.concatenate([each[np.isfinite(each)].ravel() for each in values] or [np.zeros(0)]))
    smallest = there[there > 0].min(initial=np.inf)
    setter = axes.set_xscale if name == "x" else axes.set_yscale
    if scale == "symlog" and np.isfinite(smallest):
        # no more than eight decades on either side of zero
        setter("symlog", linthresh=max(smallest, there.max() * 1e-8))
    elif scale == "log" and any(np.any(each > 0) for each in values):
        setter("log", nonpositive="mask")


def _series(axes: Axes, series: Series) -> None:
    x, y = np.asarray(series.x, float), np.asarray(series.y, float)
    y = np.where(np.isfinite(x) & np.isfinite(y), y, np.nan)
    color, label = COLORS[series.role], typeset(series.label)
    look: dict[str, object] = {"ls": "--" if series.dashed else "-", "lw": 1.2}
    kept = (thin.points if series.mark == "points" else thin.line)(x, y)
    if series.mark == "steps":
        look["drawstyle"] = "steps-post"
    if series.mark in ("points", "line+points"):
        look |= {"marker": _MARKERS[series.role], "ms": 4, "mew": 0}
    if series.mark == "points":
        look["ls"] = "none"
    axes.plot(x[kept], y[kept], color=color, label=label, **look)  # type: ignore[arg-type]


def _region(axes: Axes, region: Region) -> None:
    for at, (color, word) in enumerate(zip(_CLASSES, region.words, strict=False)):
        # one path a class: a cell each would make a page heavy
        axes.contourf(region.x, region.y, region.value == at, levels=[0.5, 1.5], colors=[color], alpha=0.5)
        axes.plot([], [], "s", color=color, alpha=0.5, label=word)


def _engineering() -> ScalarFormatter:
    formatter = ScalarFormatter(useOffset=False, useMathText=False)
    formatter.set_powerlimits((-3, 5))
    return formatter


def few_ticks(axes: Axes, n: int = 5) -> None:
    """At most n ticks on the vertical axis."""
    axes.yaxis.set_major_locator(MaxNLocator(n))
