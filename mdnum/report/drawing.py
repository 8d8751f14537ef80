"""Plots made with matplotlib, as SVG figures that adapt to the page."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from html import escape
from textwrap import fill

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator, ScalarFormatter

from mdnum.report.section import Figure, Plot, Region, Series
from mdnum.report.words import MINUS, many, power, typeset

# by role, in a light and in a dark page
_THEMES = {
    "ink": ("#1c2430", "#e4e7ec"), "muted": ("#66707e", "#98a2b0"), "grid": ("#e3e6ea", "#2b323c"),
    "first": ("#2563a8", "#74a9e8"), "second": ("#ad5712", "#e79a58"), "third": ("#2c7a63", "#63bda1"),
    "bad": ("#b3261e", "#f07b72"), "paper": ("#ffffff", "#14181e"),
}  # fmt: skip
LIGHT, DARK = ({role: colors[k] for role, colors in _THEMES.items()} for k in range(2))
# figures are drawn in those of a light page; each is one role's, so it can be replaced in the finished file
INK, MUTED, GRID, FIRST, SECOND, THIRD, BAD, _ = LIGHT.values()

#: gid of text on top of lines, which gets an outline in the background color.
HALO = "halo"
_RIM = "paint-order: stroke; stroke: var(--paper); stroke-width: 3px; stroke-linejoin: round;"

FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", "Helvetica Neue", Arial, sans-serif'
#: Size in inches; the page scales figures.
WIDTH = 7.2
#: Largest number of points of a line; longer lines are replaced by an envelope of smallest and largest
#: values.
POINTS = 600
_MARKERS = {"first": "o", "second": "s", "third": "^", "bad": "X", "muted": "D", "ink": "o"}
#: Colors of the classes of a region, in order: as expected, needs attention, not acceptable.
_CLASSES = (THIRD, SECOND, BAD, FIRST, MUTED, INK)
#: Number of bins across a figure, about the number of pixels of a screen.
BINS = 700
#: Largest number of markers in a figure; more of them would only make the page larger.
MARKS = 1500


def draw(figure: Figure | Plot) -> Canvas:
    """Draw a figure for a report page with matplotlib."""
    if isinstance(figure, Plot):
        height = 2.9 if figure.region is None else 5.6 if figure.y_names else 3.3
        return canvas(lambda empty: _plot(figure, empty), height)
    return canvas(figure.draw, figure.height)


def canvas(draw_into: Callable[[Canvas], None], height: float) -> Canvas:
    """Create a figure in the style of the report.

    Args:
        draw_into: function that draws into the given figure.
        height: height of the figure, inches.
    """
    with style():
        figure = Canvas(figsize=(WIDTH, height), layout="constrained")
        draw_into(figure)
        figure.align_ylabels()
        for axes in figure.axes:
            axes.grid(True, color=GRID, lw=0.6)
            axes.set_axisbelow(True)
            axes.spines[["top", "right", "left"]].set_visible(False)
            axes.tick_params(which="both", length=0)
            for axis, scale in ((axes.xaxis, axes.get_xscale()), (axes.yaxis, axes.get_yscale())):
                if scale != "linear":
                    axis.set_minor_locator(NullLocator())
                    # matplotlib's own sets them as formulas, which takes as long as all the rest
                    axis.set_major_formatter(FuncFormatter(_decade))
                elif isinstance(axis.get_major_formatter(), ScalarFormatter):
                    axis.set_major_formatter(_engineering())
            # left of the legend
            axes.yaxis.get_offset_text().set_horizontalalignment("right")
    return figure


def line(axes: Axes, x: np.ndarray, y: np.ndarray, color: str, label: str = "", **look: object) -> None:
    """Draw a line. Many points become averages, with a band from smallest to largest values."""
    low, middle, high, at = envelope(np.asarray(x), np.asarray(y))
    if len(y) > POINTS:
        axes.fill_between(at, low, high, color=color, alpha=0.3, lw=0)
    axes.plot(at, middle, color=color, label=label or None, **{"lw": 1.2, **look})  # type: ignore[arg-type]


def envelope(
    x: np.ndarray, y: np.ndarray, most: int = POINTS
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Divide points into at most `most` groups. Return smallest, mean and largest y, and mean x."""
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
    """Draw a legend above the axes, where the legend covers no data."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        longest = max(len(label) for label in labels)
        axes.legend(
            loc="lower left", bbox_to_anchor=(0, 1.0), ncols=max(1, min(len(labels), 96 // (longest + 6))),
            frameon=False, handlelength=1.4, columnspacing=1.4, borderaxespad=0.2, fontsize=8.5,
        )  # fmt: skip


def notes(plot: Figure | Plot) -> list[str]:
    """Return a sentence for each kind of value that a plot cannot show."""
    if isinstance(plot, Figure) or not plot.series:
        return []
    sentences = []
    x, y = (np.concatenate([np.asarray(getattr(one, name), float) for one in plot.series]) for name in "xy")
    infinite = int(np.isinf(x).sum() + np.isinf(y).sum())
    if infinite:
        sentences.append(f"Infinite and left out: {many(infinite, 'value')}.")
    for scale, values, label in ((plot.x_scale, x, plot.x_label), (plot.y_scale, y, plot.y_label)):
        values = values[np.isfinite(values)]
        lost = int((values <= 0).sum()) if scale == "log" else 0
        if lost and lost == len(values):
            sentences.append(f"No value of {label} is positive, so its axis is linear.")
        elif lost:
            sentences.append(f"Not shown: {many(lost, 'value')} of {label} at or below zero.")
    return sentences


def _plot(plot: Plot, figure: Canvas) -> None:
    axes = figure.subplots()
    bases = {name: _base(plot, name) for name in "xy"}
    for scale, name in ((plot.x_scale, "x"), (plot.y_scale, "y")):
        _scale(axes, name, scale, plot)
    if plot.region is not None:
        _region(axes, plot.region)
    for at, series in enumerate(plot.series):
        _series(axes, series, bases, sum(_coincide(series, other) for other in plot.series[at + 1 :]))
    if not axes.lines and not axes.collections:
        axes.text(0.5, 0.5, "no values", transform=axes.transAxes, color=MUTED, ha="center", va="center")
    curves = list(axes.lines)
    for value, word in _apart(plot.verticals, bases["x"], axes.get_xlim()):
        axes.axvline(value, color=MUTED, lw=0.9, ls=(0, (4, 3)), zorder=1.6)
        up = not _high(curves, axes, value)
        place = {"xy": (value, 0.98 if up else 0.02), "xycoords": axes.get_xaxis_transform(), "rotation": 90}
        place |= {"va": "top" if up else "bottom", "ha": "right"}
        axes.annotate(typeset(word), **place, color=MUTED, fontsize=8, gid=HALO)
    for value, word in _apart(plot.horizontals, bases["y"], axes.get_ylim()):
        axes.axhline(value, color=MUTED, lw=0.9, ls=(0, (4, 3)), zorder=1.6)
        # beside the axes, where no curve is
        place = {"xy": (1.005, value), "xycoords": axes.get_yaxis_transform(), "va": "center", "ha": "left"}
        axes.annotate(fill(typeset(word), 14), **place, color=MUTED, fontsize=8, gid=HALO)
    for setter, label, base in (
        (axes.set_xlabel, plot.x_label, bases["x"]),
        (axes.set_ylabel, plot.y_label, bases["y"]),
    ):
        text = f"{typeset(label)} {MINUS} {base!r}" if base else typeset(label)
        setter(fill(text, 90 if setter == axes.set_xlabel else 40))
    for axis, names in ((axes.xaxis, plot.x_names), (axes.yaxis, plot.y_names)):
        if names:
            axis.set_major_locator(MaxNLocator(8, integer=True))
            axis.set_major_formatter(FuncFormatter(partial(_named, names)))
    # a line alone is named too, unless the axis names it
    if plot.region is not None or any(one.label != plot.y_label for one in plot.series):
        legend(axes)


def _high(curves: list[Line2D], axes: Axes, x: float) -> bool:
    """Return True if curves near x pass only through the upper part of the axes."""
    to_axes = axes.transData + axes.transAxes.inverted()
    points = [to_axes.transform(np.asarray(one.get_xydata(), float)) for one in curves]
    at = np.concatenate(points or [np.zeros((0, 2))])
    beside = np.abs(at[:, 0] - to_axes.transform((x, axes.get_ylim()[0]))[0]) < 0.04
    heights = at[beside & np.isfinite(at[:, 1]), 1]
    return bool(np.any(heights > 0.65) and not np.any(heights < 0.3))


def _values(plot: Plot, name: str) -> np.ndarray:
    """Return all finite numbers that a plot shows along one axis."""
    sources = (*plot.series, *filter(None, [plot.region]))
    values = [np.ravel(getattr(source, name)).astype(float) for source in sources]
    joined = np.concatenate(values or [np.zeros(0)])
    return joined[np.abs(joined) < 1e250]


def _base(plot: Plot, name: str) -> float:
    """Return an offset for an axis whose values differ only in their last digits, else 0."""
    values = _values(plot, name)
    span = np.ptp(values) if len(values) else 0.0
    # differences of neighboring floats are exact, so none of them is lost
    return float(np.sort(values)[len(values) // 2]) if 0 < span < 1e-7 * abs(values).max() else 0.0


def _coincide(one: Series, other: Series) -> bool:
    x, y, z = (np.asarray(values, float) for values in (one.x, one.y, other.y))
    if z.shape != y.shape or not np.array_equal(x, other.x, equal_nan=True):
        return False
    finite = np.isfinite(y)
    # relative to the extent of the curve, too: curves of a large value differ by little of it
    apart, span = np.abs(y - z)[finite].max(initial=0.0), np.ptp(y[finite]) if finite.any() else 0.0
    return np.allclose(y, z, rtol=1e-3, atol=0.0, equal_nan=True) and (span == 0 or bool(apart < 0.02 * span))


def _apart(
    marks: tuple[tuple[float, str], ...], base: float, limits: tuple[float, float]
) -> list[tuple[float, str]]:
    """Return marked values with labels. Labels of close values are joined."""
    kept: list[tuple[float, str]] = []
    near = 0.025 * abs(limits[1] - limits[0])
    for value, word in sorted((value - base, word) for value, word in marks):
        if kept and value - kept[-1][0] < near:
            kept[-1] = (kept[-1][0], f"{kept[-1][1]}; {word}")
        else:
            kept.append((value, word))
    return kept


def _scale(axes: Axes, name: str, scale: str, plot: Plot) -> None:
    values = _values(plot, name)
    largest = np.abs(values).max(initial=0.0)
    setter = axes.set_xscale if name == "x" else axes.set_yscale
    if scale == "symlog" and largest:
        # no more than eight decades on either side of zero
        setter("symlog", linthresh=max(np.abs(values[values != 0]).min(), largest * 1e-8))
    elif scale == "log" and np.any(values > 0):
        marks = plot.verticals if name == "x" else plot.horizontals
        seen = np.concatenate([values, [value for value, _ in marks]])
        # within a decade a logarithmic axis has no numbers on it
        if plot.region or seen.min() <= 0 or seen.max() >= 10 * seen.min():
            setter("log", nonpositive="mask")


def _series(axes: Axes, series: Series, bases: dict[str, float], covered: int) -> None:
    """Draw a series of points. The line is broader if later series would hide a thin line."""
    x, y = (np.asarray(getattr(series, name), float) - bases[name] for name in "xy")
    # what is infinite, or too large for an axis to have room beyond it, leaves a gap
    there = (np.abs(x) < 1e250) & (np.abs(y) < 1e250)
    y = np.where(there, y, np.nan)
    color, label = LIGHT[series.role], typeset(series.label)
    kept = (thin_points if series.mark == "points" else thin_line)(x, y)
    look: dict[str, object] = {"ls": "--" if series.dashed else "-", "lw": 1.2 + 1.8 * covered}
    if series.mark == "steps":
        look["drawstyle"] = "steps-post"
    if series.mark in ("points", "line+points"):
        look |= {"marker": _MARKERS[series.role], "ms": 4 + 2 * covered, "mew": 0}
    if series.mark == "points":
        look["ls"] = "none"
    axes.plot(x[kept], y[kept], color=color, label=label, **look)  # type: ignore[arg-type]
    alone = there & ~np.r_[False, there[:-1]] & ~np.r_[there[1:], False]
    if series.mark in ("line", "steps") and alone.any():
        # a value between two gaps has no line to be seen by
        axes.plot(x[alone], y[alone], "o", color=color, ms=3, mew=0)


def _region(axes: Axes, region: Region) -> None:
    x, y = (_edges(axis, log == "log") for axis, log in
            ((region.x, axes.get_xscale()), (region.y, axes.get_yscale())))  # fmt: skip
    grades = len(region.words) - 1
    for at, word in enumerate(region.words):
        color, alpha = (FIRST, at / grades) if region.graded else (_CLASSES[at], 0.5)
        if not alpha:
            continue
        inside = (region.value == at).astype(int)
        axes.plot([], [], "s", color=color, alpha=alpha, label=word)
        for row, steps in enumerate(np.diff(inside, axis=1, prepend=0, append=0)):
            # neighbors in a row are one rectangle: a cell each would make a page heavy
            starts, ends = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
            bars = list(zip(x[starts], x[ends] - x[starts], strict=True))
            axes.broken_barh(bars, (y[row], y[row + 1] - y[row]), color=color, alpha=alpha, lw=0)
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(y[0], y[-1])


def _edges(centers: np.ndarray, log: bool) -> np.ndarray:
    """Return the edges of cells, halfway between adjacent centers on the axis scale."""
    centers = np.log(centers) if log else np.asarray(centers, float)
    half = np.diff(centers) / 2 if len(centers) > 1 else np.array([0.5])
    edges = np.concatenate(
        [centers[:1] - half[:1], (centers[1:] + centers[:-1]) / 2, centers[-1:] + half[-1:]]
    )
    return np.exp(edges) if log else edges


def _named(names: tuple[str, ...], value: float, _: int | None = None) -> str:
    """Return the label of an integer position on an axis, or an empty string."""
    return names[round(value)] if value == round(value) and 0 <= value < len(names) else ""


def _decade(value: float, _: int | None = None) -> str:
    """Return the label of a power of ten on a logarithmic axis, or an empty string."""
    exponent = np.log10(abs(value)) if value else 0.0
    if not np.isclose(exponent, round(exponent), atol=1e-6):
        return ""
    return f"{MINUS if value < 0 else ''}{power(round(exponent))}" if value else "0"


def _engineering() -> ScalarFormatter:
    formatter = ScalarFormatter(useOffset=False, useMathText=False)
    formatter.set_powerlimits((-3, 5))
    return formatter


# -- fewer points that look the same: lines keep every peak, points keep every place


def thin_line(x: Float[np.ndarray, "points"], y: Float[np.ndarray, "points"]) -> Int[np.ndarray, "kept"]:
    """Select at most four points of a line per bin (first, lowest, highest, last). All gaps are kept.

    Args:
        x: positions on the scale of the axis (logarithms on a logarithmic axis), NaN for a gap.
        y: values on the scale of the y axis, NaN for a gap.
    """
    if len(x) <= 4 * BINS:
        return np.arange(len(x))
    gap = ~(np.isfinite(x) & np.isfinite(y))
    inside = x[~gap]
    if not len(inside) or inside[-1] == inside[0] or np.any(np.diff(inside) < 0):
        # it doubles back: only equal neighbors can go
        return np.flatnonzero(np.r_[True, (np.diff(x) != 0) | (np.diff(y) != 0)])
    place = np.zeros(len(x), int)
    place[~gap] = ((inside - inside[0]) / (inside[-1] - inside[0]) * BINS).astype(int)
    # a gap, and each side of one, is a group of its own
    key = 2 * np.cumsum(np.r_[False, gap[1:] != gap[:-1]]) * (BINS + 2) + place
    starts = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    ends = np.append(starts[1:], len(x))
    filled = np.where(gap, 0.0, y)
    chosen = [starts, ends - 1]
    group = np.repeat(np.arange(len(starts)), ends - starts)
    # lexsort puts the lowest of each group first and the highest last
    order = np.lexsort((filled, group))
    chosen += [order[starts], order[ends - 1]]
    return np.unique(np.concatenate(chosen))


def thin_points(x: Float[np.ndarray, "points"], y: Float[np.ndarray, "points"]) -> Int[np.ndarray, "kept"]:
    """Select one point of a scatter plot in each occupied cell of a fine grid.

    Args:
        x, y: coordinates on the scales of the axes.
    """
    finite = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(finite) <= BINS:
        return finite
    # which of a cell's points stays is drawn by lot, or the grid would show
    finite = np.random.default_rng(0).permutation(finite)
    cells = BINS / 2
    while True:
        place = np.zeros(len(finite), np.int64)
        for values in (x[finite], y[finite]):
            low, span = values.min(), float(np.ptp(values))
            place = place * (BINS + 1) + ((values - low) / (span or 1.0) * cells).astype(np.int64)
        _, first = np.unique(place, return_index=True)
        # a curve stays a curve; a cloud that fills the figure gets a coarser grid
        if len(first) <= MARKS:
            return finite[np.sort(first)]
        cells *= 0.7


# -- as SVG


def style() -> AbstractContextManager[None]:
    """Return a context with the matplotlib settings for all figures."""
    return mpl.rc_context(
        {
            # any backend will do, and to ask for the one in use imports pyplot
            **{key: value for key, value in mpl.rcParamsDefault.items() if key != "backend"},
            "font.family": "DejaVu Sans",
            **dict.fromkeys(("font.size", "axes.labelsize"), 9),
            **dict.fromkeys(("xtick.labelsize", "ytick.labelsize"), 8.5),
            **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), MUTED),
            **dict.fromkeys(("axes.labelcolor", "text.color", "xtick.labelcolor", "ytick.labelcolor"), INK),
            **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"),
            "axes.linewidth": 0.7,
            "axes.unicode_minus": True,
            "axes.formatter.useoffset": False,
            "path.simplify_threshold": 0.3,
            "svg.fonttype": "none",
        }
    )


def markup(figure: Canvas, name: str) -> str:
    """Return a figure as an <svg> element whose colors are named by role.

    Args:
        name: prefix that makes the ids of the element unique on a page.
    """
    sink = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        # savefig would draw it once more, for a box that is tight around it
        FigureCanvasSVG(figure).print_svg(sink, metadata={"Date": None, "Creator": None})
    text = sink.getvalue()
    text = text[text.index("<svg ") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    for role, color in LIGHT.items():
        text = text.replace(color, f"var(--{role})")
    # the page's own font instead of the one it was measured with
    text = text.replace("font-family: 'DejaVu Sans'; ", "")
    text = text.replace(f' id="{HALO}"', f' class="{HALO}"')
    text = re.sub(r' transform="rotate\(-0 [^)]*\)"', "", text)
    referenced = set(re.findall(r"#([\w.-]+)", text))
    text = re.sub(r' id="([^"]+)"', lambda found: found[0] if found[1] in referenced else "", text)
    text = re.sub(r'id="([^"]+)"', rf'id="{name}-\1"', text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{name}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", text)
    # a hundredth of a point is finer than any screen; what stands between the tags are the labels
    text = re.sub(r"<[^>]+>", lambda tag: re.sub(r"(\d+\.\d{2})\d+", r"\1", tag[0]), text)
    return re.sub(r"\n\s*\n*", "\n", text)


def inline(text: str, title: str) -> str:
    """Return an <svg> element for an HTML page that defines its colors."""
    text = re.sub(r'<svg [^>]*?viewBox="([^"]+)"[^>]*>', r'<svg viewBox="\1" role="img">', text, count=1)
    return text.replace('role="img">', f'role="img" aria-label="{escape(title)}">', 1)


def standalone(text: str) -> str:
    """Return a complete SVG file with light and dark colors."""
    rules = (
        f"svg {{ {_properties(LIGHT)} }} "
        f"@media (prefers-color-scheme: dark) {{ svg {{ {_properties(DARK)} }} }} "
        f"text {{ font-family: {FONT}; }} .{HALO} text {{ {_RIM} }}"
    )
    return re.sub(r"(<svg [^>]*>)", rf"\1<style>{rules}</style>", text, count=1)


def _properties(colors: dict[str, str]) -> str:
    return " ".join(f"--{role}: {color};" for role, color in colors.items())
