"""What all figures share: size, thinning, ticks, labels and legends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from mdnum.report.svg import GRID, INK, style
from mdnum.report.words import MINUS, power

#: Inches.
PAGE_WIDTH, PHONE_WIDTH = 7.6, 3.7
#: Points a line is thinned to; longer ones become an envelope of smallest and largest values.
POINTS = 600
#: Points of type in legends and notes.
_SMALL = 8.5


def drawn(draw: Callable[[Figure], None], height: float, width: float = PAGE_WIDTH) -> Figure:
    """A figure in the report's style.

    Args:
        draw: draws into it.
        height, width: inches; on a phone's width it becomes a little lower, its labels as large.
    """
    with style():
        figure = Figure(
            figsize=(width, height if width == PAGE_WIDTH else 0.85 * height), layout="constrained"
        )
        figure.get_layout_engine().set(h_pad=0.05, w_pad=0.02, hspace=0.04)  # type: ignore[union-attr]
        draw(figure)
        if width != PAGE_WIDTH:
            _fit_legends(figure)
        figure.align_ylabels()
        for axes in figure.axes:
            axes.grid(True, color=GRID, lw=0.6)
            axes.set_axisbelow(True)
            for side in ("top", "right", "left"):
                axes.spines[side].set_visible(False)
            axes.tick_params(length=0)
    return figure


def envelope(
    at: Float[np.ndarray, "points"], values: Float[np.ndarray, "points"], most: int = POINTS
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(smallest, mean, largest, position) in at most so many equal groups; a group of one is its value."""
    if len(values) <= most:
        return values, values, values, at
    starts = np.unique(np.linspace(0, len(values), most, endpoint=False).astype(int))
    sizes = np.diff(np.append(starts, len(values)))
    return (
        np.minimum.reduceat(values, starts),
        np.add.reduceat(values, starts) / sizes,
        np.maximum.reduceat(values, starts),
        np.add.reduceat(at, starts) / sizes,
    )


def line(
    axes: Axes,
    at: np.ndarray,
    values: np.ndarray,
    color: str,
    label: str = "",
    width: float = 1.2,
    alpha: float = 1.0,
    band: bool = True,
) -> None:
    """A line with plain tick labels; of more points than fit, their mean and range."""
    low, middle, high, position = envelope(at, values)
    if band and len(values) > POINTS:
        axes.fill_between(position, low, high, color=color, alpha=0.3, lw=0)
    axes.plot(position, middle, color=color, lw=width, alpha=alpha, label=label or None)
    axes.yaxis.set_major_formatter(Engineering())
    axes.yaxis.set_major_locator(MaxNLocator(5))


class Engineering(FuncFormatter):
    """Plain numbers, with one power of ten for the axis written into its topmost label's place."""

    def __init__(self) -> None:
        super().__init__(lambda value, _: f"{value:g}")
        self.exponent = 0

    def set_locs(self, locs: list[float]) -> None:
        super().set_locs(locs)
        largest = max((abs(loc) for loc in locs), default=0.0)
        exponent = int(np.floor(np.log10(largest))) if largest > 0 else 0
        # the power itself must be a float
        self.exponent = max(exponent, -300) if exponent < -2 or exponent > 4 else 0

    def __call__(self, x: float, pos: int | None = None) -> str:
        scaled = round(x / 10.0**self.exponent, 6)
        return f"{scaled:g}".replace("-", MINUS)

    def get_offset(self) -> str:
        return f"× {power(self.exponent)}" if self.exponent else ""


def log_ticks(axes: Axes) -> None:
    """Few ticks on a logarithmic vertical axis, as powers where numbers would be long."""
    axes.yaxis.set_major_locator(LogLocator(numticks=6))
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: f"{value:g}" if 0.1 < value < 999 else power(round(np.log10(value))))
    )
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(NullFormatter())
    axes.minorticks_off()


def y_label(axes: Axes, text: str) -> None:
    """The label of the vertical axis."""
    axes.set_ylabel(text, color=INK)


def legend(axes: Axes) -> int:
    """Labels above the axes, in one line where they fit and below one another where not.

    Returns:
        how many lines they take.
    """
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return 0
    label = axes.get_ylabel()
    left = 30 + 11 * (label.count("\n") + 1) * bool(label)
    width = 72.0 * axes.get_figure(root=True).get_figwidth() - left  # type: ignore[union-attr]
    columns = len(handles)
    while columns > 1 and _legend_width(labels, columns) > width:
        columns -= 1
    return _place_legend(axes, columns, width - 20)


def _place_legend(axes: Axes, columns: int, width: float) -> int:
    """Draws the legend in so many columns, its labels folded; returns the lines it takes."""
    handles, labels = axes.get_legend_handles_labels()
    labels = [folded(text, width, _SMALL) for text in labels]
    axes.legend(
        handles, labels, loc="lower left", bbox_to_anchor=(0, 1.0),
        ncols=columns, frameon=False, handlelength=1.3, columnspacing=1.4, borderaxespad=0.1, fontsize=_SMALL,
    )  # fmt: skip
    deepest = max(text.count("\n") for text in labels) + 1
    return deepest * -(-len(labels) // columns)


def _fit_legends(figure: Figure) -> None:
    """Takes columns out of legends that are wider than the figure once its axes have their place."""
    for axes in figure.axes:
        while (legend := axes.get_legend()) is not None:
            labels = [text.get_text() for text in legend.get_texts()]
            columns: int = legend._ncols  # type: ignore[attr-defined]
            if _legend_width(labels, columns) < 0.7 * 72.0 * figure.get_figwidth():
                break
            figure.draw_without_rendering()
            box = legend.get_window_extent()
            over = (box.x1 - figure.bbox.x1) * 72 / figure.dpi
            if over <= 0 or (columns == 1 and all("\n" in text or " " not in text for text in labels)):
                break
            before = -(-len(labels) // columns)
            room = 72.0 * figure.get_figwidth() - box.x0 * 72 / figure.dpi - 24
            lines = _place_legend(axes, max(1, columns - 1), room)
            figure.set_figheight(figure.get_figheight() + 0.16 * max(0, lines - before))
            if columns == 1:
                break


@lru_cache(4096)
def text_width(text: str, size: float) -> float:
    """Points that the widest line of a text takes, in a font as wide as any that a page is shown in."""
    font = FontProperties(size=size)
    return max(text_to_path.get_text_width_height_descent(line, font, False)[0] for line in text.split("\n"))


def folded(text: str, width: float, size: float) -> str:
    """The text in lines of at most so many points, broken between words."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and text_width(longer, size) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return "\n".join(lines)


def _legend_width(labels: Sequence[str], columns: int) -> float:
    # matplotlib fills columns first, and the first of them get one entry more
    rows, more = divmod(len(labels), columns)
    ends = np.cumsum([rows + (column < more) for column in range(columns)])
    parts = np.split(np.array([text_width(text, _SMALL) for text in labels]), ends[:-1])
    return sum(float(part.max(initial=0)) + 18 for part in parts) + 12 * (columns - 1)
