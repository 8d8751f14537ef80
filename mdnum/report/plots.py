"""Draws plots that were declared (series, regions, marked values), for a page and for a phone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from mdnum.report import thin
from mdnum.report.axes import PAGE_WIDTH, drawn, folded, legend, text_width
from mdnum.report.scales import Scale
from mdnum.report.svg import BAD, FIRST, HALO, INK, MUTED, SECOND, THIRD
from mdnum.report.words import MINUS, listed, many, typeset

if TYPE_CHECKING:
    from mdnum.ball.demos.base import Plot, Region, Series

COLORS = {"first": FIRST, "second": SECOND, "third": THIRD, "bad": BAD, "muted": MUTED, "ink": INK}
_MARKERS = {"first": "o", "second": "s", "third": "^", "bad": "X", "muted": "D", "ink": "o"}
#: Colors of a region's classes, in order: as a rule all is well, look here, do not.
_CLASSES = ((THIRD, 0.35), (SECOND, 0.55), (BAD, 0.7), (FIRST, 0.45), (MUTED, 0.35), (INK, 0.6))
_NOTE = 8.0


@dataclass(frozen=True)
class _Part:
    """A series in the space of the axes, and how many later ones lie upon it."""

    source: Series
    x: np.ndarray
    y: np.ndarray
    covered: int


def draw(plot: Plot, width: float = PAGE_WIDTH, x_range: tuple[float, float] | None = None) -> Figure:
    """A plot as a figure.

    Args:
        width: inches, `axes.PAGE_WIDTH` or `axes.PHONE_WIDTH`.
        x_range: what the horizontal axis shows, where figures are to be compared.
    """
    height = 3.3 if plot.region else 2.9
    return drawn(lambda figure: _compose(plot, figure, x_range), height, width)


def notes(plot: Plot) -> list[str]:
    """What the figure cannot show, a sentence each."""
    scales = _scales(plot)
    found = []
    for scale, name in zip(scales, (plot.x_label, plot.y_label), strict=True):
        if scale.fell_back:
            found.append(f"No value of {name} is positive, so its axis is linear.")
    lost = [series for series in plot.series if scales[1].kind == "log" and _lost(scales, series).any()]
    if lost:
        which = listed([f"“{series.label}”" for series in lost if series.label] or [""])
        total = sum(int(_lost(scales, series).sum()) for series in lost)
        negative = any(np.any(np.asarray(series.y).astype(float) < 0) for series in lost)
        found.append(
            f"{many(total, 'value')}{f' of {which}' if which else ''} "
            f"{'is' if total == 1 else 'are'} {'zero or negative' if negative else 'zero'}: "
            "▿ at the lower edge."
        )
    if scales[0].lost:
        found.append(f"{many(scales[0].lost, 'point')} at {plot.x_label} ≤ 0 cannot be shown.")
    infinite = sum(_infinite(series.x) + _infinite(series.y) for series in plot.series)
    if infinite:
        found.append(f"{many(infinite, 'value')} {'is' if infinite == 1 else 'are'} infinite and left out.")
    return found


def _infinite(values: Any) -> int:
    return int(np.isinf(np.asarray(values).astype(float)).sum())


def _lost(scales: tuple[Scale, Scale], series: Series) -> np.ndarray:
    x, y = scales[0].shown(series.x), np.asarray(series.y).astype(float)
    return np.isfinite(x) & (y <= 0)


def _scales(plot: Plot) -> tuple[Scale, Scale]:
    x = [np.asarray(series.x) for series in plot.series]
    y = [np.asarray(series.y) for series in plot.series]
    if plot.region is not None:
        x.append(np.asarray(plot.region.x))
        y.append(np.asarray(plot.region.y))
    # marked values must be seen, but they alone do not decide whether an axis can be logarithmic
    x.append(np.array([value for value, _ in plot.verticals], float))
    y.append(np.array([value for value, _ in plot.horizontals], float))
    return Scale.choose(plot.x_scale, x), Scale.choose(plot.y_scale, y)


def _compose(plot: Plot, figure: Figure, x_range: tuple[float, float] | None) -> None:
    axes = figure.subplots()
    x_scale, y_scale = _scales(plot)
    x_scale.apply(axes, "x")
    y_scale.apply(axes, "y")
    if plot.region is not None:
        _region(axes, plot.region, x_scale, y_scale)
    parts = _parts(plot.series, x_scale, y_scale)
    for part in parts:
        _series(axes, part, x_scale, y_scale)
    y_scale.limit(axes)
    for value, _ in plot.verticals:
        axes.axvline(float(x_scale.shown(np.array(value))), color=MUTED, lw=0.9, ls=(0, (4, 3)), zorder=1.6)
    for value, _ in plot.horizontals:
        axes.axhline(float(y_scale.shown(np.array(value))), color=MUTED, lw=0.9, ls=(0, (4, 3)), zorder=1.6)
    if not axes.lines and plot.region is None:
        axes.text(0.5, 0.5, "no values", transform=axes.transAxes, color=MUTED, ha="center", va="center")
    if (
        x_range is not None
        and np.isfinite(x_range).all()
        and x_scale.kind == "linear"
        and not x_scale.shift
        and x_range[1] > x_range[0]
    ):
        room = 0.02 * (x_range[1] - x_range[0])
        axes.set_xlim(x_range[0] - room, x_range[1] + room)
    wide = figure.get_figwidth() >= PAGE_WIDTH
    x_label = x_scale.label(_formula(plot.x_label), x_scale.ticks(axes, "x", 7 if wide else 5))
    y_label = y_scale.label(_formula(plot.y_label), y_scale.ticks(axes, "y", 6))
    points = 72 * figure.get_figwidth()
    axes.set_xlabel(folded(x_label, points - 60, 9), color=INK)
    axes.set_ylabel(folded(y_label, 58 * figure.get_figheight(), 9), color=INK)
    labels = axes.get_legend_handles_labels()[1]
    if len(labels) > 1 or (labels and labels[0] != plot.y_label) or plot.region is not None:
        lines = legend(axes)
        figure.set_figheight(figure.get_figheight() + 0.16 * max(0, lines - 1))
    _label_lines(axes, plot, parts, x_scale, y_scale)


def _formula(label: str) -> str:
    return typeset(label).replace(" - ", f" {MINUS} ")


def _parts(series: Sequence[Series], x_scale: Scale, y_scale: Scale) -> list[_Part]:
    shown = [(x_scale.shown(item.x), y_scale.shown(item.y)) for item in series]
    return [
        _Part(
            item,
            *shown[n],
            # a line of the same color hides nothing
            covered=min(
                2,
                sum(
                    series[later].role != item.role and _same(shown[n], shown[later])
                    for later in range(n + 1, len(series))
                ),
            ),
        )
        for n, item in enumerate(series)
    ]


def _same(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether two series would hide one another."""
    if first[0].shape != second[0].shape or not first[0].size or not np.array_equal(first[0], second[0]):
        return False
    share = float(np.mean(np.isclose(first[1], second[1], rtol=1e-3, atol=0, equal_nan=True)))
    return share > (0.25 if len(first[0]) > 20 else 0.5)


def _series(axes: Axes, part: _Part, x_scale: Scale, y_scale: Scale) -> None:
    item, color = part.source, COLORS[part.source.role]
    x, y = _thinned(part, x_scale, y_scale)
    points = "points" in item.mark
    lines = item.mark != "points"
    finite = np.isfinite(x) & np.isfinite(y)
    few = max(1, int(finite.sum()))
    # a value between two gaps has no line to either side
    alone = finite & ~np.r_[False, finite[:-1]] & ~np.r_[finite[1:], False]
    size = 2.4 if few > 300 else 3.4 if few > 60 else 4.4
    style: dict[str, Any] = {"color": color, "zorder": 2.0}
    if lines:
        style |= {"lw": 1.3 + 2.5 * part.covered, "alpha": 0.45 if part.covered else 1.0}
        style |= {"ls": (0, (5, 2.5)) if item.dashed else "-", "solid_joinstyle": "round"}
        if item.mark == "steps":
            style["drawstyle"] = "steps-mid"
    else:
        style["ls"] = ""
    marker: dict[str, Any] = {"marker": _MARKERS[item.role], "ms": size, "mew": 0}
    if part.covered or (item.dashed and not lines):
        marker |= {"mfc": "none", "mew": 1.1, "ms": size + 2.4 * max(1, part.covered)}
    if points:
        style |= marker
    elif alone.any():
        axes.plot(x[alone], y[alone], ls="", color=color, zorder=2.0, **marker)
    if finite.any():
        axes.plot(x, y, label=item.label or None, **style)
    if y_scale.kind == "log":
        lost = _lost((x_scale, y_scale), item)
        if lost.any():
            at = part.x[lost]
            hidden = None if finite.any() else item.label or None
            at = at[thin.points(x_scale.flat(at), np.zeros(len(at)), 200)]
            axes.plot(
                at, np.zeros(len(at)), "v", label=hidden, color=color, mfc="none", mew=1.0, ms=4.5,
                clip_on=False, transform=axes.get_xaxis_transform(), zorder=3,
            )  # fmt: skip


def _thinned(part: _Part, x_scale: Scale, y_scale: Scale) -> tuple[np.ndarray, np.ndarray]:
    reduce = thin.points if part.source.mark == "points" else thin.line
    keep = reduce(x_scale.flat(part.x), y_scale.flat(part.y))
    return part.x[keep], part.y[keep]


def _region(axes: Axes, region: Region, x_scale: Scale, y_scale: Scale) -> None:
    x_edges, y_edges = (
        scale.edges(scale.shown(values)) for scale, values in ((x_scale, region.x), (y_scale, region.y))
    )
    value = np.asarray(region.value)
    for number, word in enumerate(region.words):
        if not np.any(value == number):
            continue
        color, alpha = _CLASSES[number % len(_CLASSES)]
        path = _outline(value == number, x_edges, y_edges)
        axes.add_patch(PathPatch(path, facecolor=color, alpha=alpha, lw=0, label=word, zorder=0.5))
    axes.set_xlim(x_edges.min(), x_edges.max())
    axes.set_ylim(y_edges.min(), y_edges.max())


def _outline(inside: np.ndarray, x_edges: np.ndarray, y_edges: np.ndarray) -> Path:
    """Rectangles that cover the cells: runs along a row, grown over rows in which they are the same."""
    vertices: list[tuple[float, float]] = []
    open_runs: dict[tuple[int, int], int] = {}
    for row in range(len(inside) + 1):
        runs = set()
        if row < len(inside):
            steps = np.diff(np.r_[0, inside[row].astype(int), 0])
            starts, ends = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
            runs = set(zip(starts.tolist(), ends.tolist(), strict=True))
        for run in [run for run in open_runs if run not in runs]:
            (left, right), low = run, open_runs.pop(run)
            x, y = (x_edges[left], x_edges[right]), (y_edges[low], y_edges[row])
            vertices += [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1]), (x[0], y[0])]
        for run in runs:
            open_runs.setdefault(run, row)
    codes = [Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    return Path(np.asarray(vertices, float), codes * (len(vertices) // 5))


def _label_lines(axes: Axes, plot: Plot, parts: Sequence[_Part], x_scale: Scale, y_scale: Scale) -> None:
    """Writes the words of marked values beside their lines, where there is least to cover."""
    figure = axes.get_figure(root=True)
    inches = (figure.get_figwidth() - 0.75, figure.get_figheight() - 0.85)  # type: ignore[union-attr]
    cloud = _cloud(axes, parts, x_scale, y_scale)
    for which, marked, scale in (("x", plot.verticals, x_scale), ("y", plot.horizontals, y_scale)):
        along, across = (0, 1) if which == "x" else (1, 0)
        length, room = 72 * inches[across], 72 * inches[along]
        limits = scale.flat(np.array(axes.get_xlim() if which == "x" else axes.get_ylim()))
        shown = scale.flat(scale.shown(np.array([value for value, _ in marked], float)))
        places = (shown - limits[0]) / (limits[1] - limits[0])
        for place, side, words in _groups(places, [words for _, words in marked], 12 / max(room, 1)):
            text = folded(typeset(words), 0.85 * length, _NOTE)
            takes = min(1.0, text_width(text, _NOTE) / max(length, 1))
            near = cloud[np.abs(cloud[:, along] - place) < 14 / max(room, 1), across]
            far = np.count_nonzero(near > 1 - takes) <= np.count_nonzero(near < takes)
            if which == "x":
                spot, turn = (place, 0.98 if far else 0.02), dict[str, Any](rotation=90)
                turn |= {"va": "top" if far else "bottom", "ha": "left" if side > 0 else "right"}
                offset = (1.5 * side, 0)
            else:
                spot, turn = (0.99 if far else 0.01, place), dict[str, Any]()
                turn |= {"ha": "right" if far else "left", "va": "bottom" if side > 0 else "top"}
                offset = (0, 1.0 * side)
            label = axes.annotate(
                text, spot, offset, xycoords="axes fraction", textcoords="offset points", color=MUTED,
                fontsize=_NOTE, linespacing=1.05, zorder=4, annotation_clip=False, **turn,
            )  # fmt: skip
            label.set_gid(HALO)


def _groups(places: np.ndarray, words: Sequence[str], near: float) -> list[tuple[float, int, str]]:
    """(place, side, words): neighbors take different sides of their lines, more than two share a label."""
    order = [int(n) for n in np.argsort(places) if np.isfinite(places[n]) and -0.001 <= places[n] <= 1.001]
    found: list[tuple[float, int, str]] = []
    group: list[int] = []
    for n in [*order, None]:
        if n is not None and (not group or places[n] - places[group[-1]] < near):
            group.append(n)
            continue
        if len(group) == 1:
            found.append((places[group[0]], -1 if places[group[0]] > 1 - near else 1, words[group[0]]))
        elif len(group) == 2:
            found += [
                (places[member], side, words[member]) for member, side in zip(group, (-1, 1), strict=True)
            ]
        elif group:
            some = list(dict.fromkeys(words[member] for member in group))
            text = " · ".join(some) if len(some) < 4 else f"{some[0]} … {some[-1]}"
            last = places[group[-1]]
            found.append((last, -1 if last > 1 - 2 * near else 1, text))
        group = [] if n is None else [n]
    return found


def _cloud(axes: Axes, parts: Sequence[_Part], x_scale: Scale, y_scale: Scale) -> np.ndarray:
    """Places of what is drawn, in fractions of the axes."""
    clouds = [np.zeros((0, 2))]
    for part in parts:
        columns = []
        for scale, values, limits in (
            (x_scale, part.x, axes.get_xlim()),
            (y_scale, part.y, axes.get_ylim()),
        ):
            low, high = scale.flat(np.array(limits))
            columns.append((scale.flat(values) - low) / (high - low))
        clouds.append(np.stack(columns, axis=1))
    cloud = np.concatenate(clouds)
    return cloud[np.isfinite(cloud).all(axis=1)]
