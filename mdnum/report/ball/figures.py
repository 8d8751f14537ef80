"""The figures of a ball's run: declared plots, and the one that compares derivatives by method."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Literal

import numpy as np
from matplotlib.figure import Figure

from mdnum.ball.demos.base import Plot, Series
from mdnum.report import plots
from mdnum.report.axes import PAGE_WIDTH, drawn, folded, legend
from mdnum.report.ball.run import BallFolder
from mdnum.report.scales import Scale
from mdnum.report.svg import FIRST, INK, MUTED, SECOND
from mdnum.report.words import number

Drawer = Callable[[float], Figure]
Role = Literal["first", "second", "third", "bad", "muted"]

#: Contacts that are marked one by one.
_MARKED = 400
_REASONS: tuple[tuple[str, str, Role], ...] = (
    ("tolerance", "ended by tolerance", "first"),
    ("fixed", "a fixed count", "muted"),
    ("cap", "gave up at the cap", "bad"),
    ("not finite", "not finite", "bad"),
    ("rest", "held at rest", "third"),
)
_COLORS: tuple[Role, ...] = ("first", "second", "third")


def figures(run: BallFolder) -> Iterator[tuple[str, str, Drawer, list[str]]]:
    """(name, title, what draws it at a width, notes) of every figure that the folder has numbers for."""
    for name, plot in (
        ("heights", heights(run)), ("nearest", nearest(run)), ("iterations", iterations(run)),
        ("stops", stops(run)), ("margins", margins(run)), ("separation", separation(run)),
    ):  # fmt: skip
        if plot is not None:
            span = (float(run.series["time"][0]), float(run.series["time"][-1]))
            yield name, plot.title, partial(_draw, plot, span), plots.notes(plot)
    if run.parameters:
        yield "gradient", "Derivatives by method", partial(gradient, run), []


def _draw(plot: Plot, span: tuple[float, float], width: float) -> Figure:
    return plots.draw(plot, width, span)


def heights(run: BallFolder) -> Plot | None:
    """Heights against time, with the contacts that began."""
    rows = run.heights
    series = []
    balls = np.unique(rows["ball"]).astype(int).tolist()
    if not balls:
        mean = run.series["mean_height"]
        if not np.isfinite(mean).any():
            return None
        series.append(Series("mean over the balls", run.series["time"], mean))
    for n, ball in enumerate(balls):
        mine = rows["ball"] == ball
        few = len(balls) <= 3
        label = f"ball {ball}" if few and run.balls > 1 else "height" if few else "balls" if not n else ""
        role = _COLORS[n] if few else "first"
        series.append(Series(label, run.time(rows["step"][mine]), rows["y"][mine], role=role))
    entered = run.contacts["entered"].astype(bool)
    told = np.isin(run.contacts["ball"], balls) if balls else np.ones(len(entered), bool)
    steps = run.contacts["step"][entered & told]
    if len(steps):
        # on the floor, where they are decided
        label = "contact begins" if run.balls == 1 else "a contact begins"
        series.append(Series(label, run.time(steps), np.zeros(len(steps)), mark="points", role="bad"))
    return Plot(
        "Heights against time", "time (s)", "height (m)", tuple(series), horizontals=((0.0, "floor"),)
    )


def nearest(run: BallFolder) -> Plot | None:
    """How near the nearest contact decision of each step was to the floor."""
    time, margin = run.series["time"], run.series["min_margin"]
    if not np.isfinite(margin).any():
        return None
    series = [Series("nearest height", time, margin)]
    doubtful = (run.series["ambiguous"] > 0) & np.isfinite(margin)
    if doubtful.any():
        series.append(
            Series("a decision within rounding", time[doubtful], margin[doubtful], mark="points", role="bad")
        )
    return Plot(
        "Margin of the nearest contact decision", "time (s)", "|height| decided on (m)", tuple(series),
        y_scale="log",
    )  # fmt: skip


def iterations(run: BallFolder) -> Plot | None:
    """What each step's solver did, by what ended it."""
    series, reason = run.series, run.series["reason"].astype(str)
    if not np.any((reason != "none") | (series["iterations"] > 0)):
        return None
    shown = []
    for word, label, role in _REASONS:
        mine = reason == word
        if mine.any():
            shown.append(
                Series(label, series["time"][mine], series["iterations"][mine], mark="points", role=role)
            )
    rest = (reason == "none") & (series["iterations"] > 0)
    if rest.any():
        shown.append(
            Series("impacts", series["time"][rest], series["iterations"][rest], mark="points", role="second")
        )
    what = "impacts per step" if run.located else "iterations per step"
    title = "Impacts located in each step" if run.located else "Iterations per step, by what ended them"
    return Plot(title, "time (s)", what, tuple(shown))


def stops(run: BallFolder) -> Plot | None:
    """Margins of all recorded stop decisions: above zero the solver stopped, below it went on."""
    rows = run.solver
    if not len(rows["step"]):
        return None
    stopped = rows["stopped"].astype(bool)
    reason = rows["reason"].astype(str)
    capped = ~stopped & (reason == "cap")
    time = run.time(rows["step"])
    series = []
    groups: tuple[tuple[np.ndarray, str, Role], ...] = (
        (stopped, "stopped", "first"),
        (~stopped & ~capped, "went on", "second"),
        (capped, "gave up", "bad"),
    )
    for mine, label, role in groups:
        if np.any(mine & np.isfinite(rows["margin"])):
            series.append(Series(label, time[mine], rows["margin"][mine], mark="points", role=role))
    if not series:
        return None
    return Plot(
        "Margins of stop decisions", "time (s)", "tolerance − residual", tuple(series), y_scale="symlog",
        horizontals=((0.0, "the tolerance"),),
    )  # fmt: skip


def margins(run: BallFolder) -> Plot | None:
    """How far from the floor a ball was when its contact was first decided otherwise, in rounding bounds."""
    ratio = run.margins
    if not np.any(np.isfinite(ratio)):
        return None
    time, entered = run.time(run.contacts["step"]), run.contacts["entered"].astype(bool)
    series = []
    groups: tuple[tuple[np.ndarray, str, Role], ...] = (
        (entered, "contact begins", "first"),
        (~entered, "contact ends", "second"),
    )
    for mine, label, role in groups:
        if mine.any():
            series.append(Series(label, time[mine], ratio[mine], mark="points", role=role))
    return Plot(
        "Margins of contact flips in units of rounding", "time (s)", "|margin| / rounding bound",
        tuple(series), y_scale="log", horizontals=((1.0, "below: decided by rounding"),),
    )  # fmt: skip


def separation(run: BallFolder) -> Plot | None:
    """How far variants are from the run, by step."""
    rows = run.separations
    names = list(dict.fromkeys(rows["variant"].astype(str).tolist()))
    if not names or not np.any(rows["separation"] > 0):
        return None
    roles: tuple[Role, ...] = ("first", "second", "third", "bad", "muted")
    series = []
    for n, name in enumerate(names):
        mine = rows["variant"].astype(str) == name
        time = run.time(rows["step"][mine])
        series.append(Series(name, time, rows["separation"][mine], role=roles[n % 5], dashed=n >= 5))
    forks = {
        str(one["name"]): float(run.time(np.array(one["fork"])))
        for one in run.variants
        if one.get("fork") is not None
    }
    verticals = tuple((time, f"{name} forks") for name, time in forks.items() if name in names)
    return Plot(
        "Separation of the variants", "time (s)", "largest |difference| of heights (m)", tuple(series),
        y_scale="log", verticals=verticals,
    )  # fmt: skip


def gradient(run: BallFolder, width: float = PAGE_WIDTH) -> Figure:
    """Each method's derivative on a line, a panel per parameter, with the closed form's where it is known."""
    methods = [str(made["method"]) for made in run.gradient]
    height = (0.55 + 0.3 * len(methods)) * len(run.parameters) + 0.3
    # `drawn` lowers a figure on a phone, whose lines need as much room
    scale = 1.0 if width == PAGE_WIDTH else 1 / 0.85
    return drawn(partial(_dots, run, methods), height * scale, width)


def _dots(run: BallFolder, methods: list[str], figure: Figure) -> None:
    wide = figure.get_figwidth() >= PAGE_WIDTH
    exact = run.exact.get("gradient") or {}
    panels = figure.subplots(len(run.parameters), 1, squeeze=False)[:, 0]
    for axes, name in zip(panels, run.parameters, strict=True):
        values = np.array([_value(made["gradient"].get(name)) for made in run.gradient])
        depends = [bool((made.get("depends") or {}).get(name, True)) for made in run.gradient]
        known = np.append(values, _value(exact.get(name)))
        scale = _scale(known)
        scale.apply(axes, "x")
        if np.isfinite(known[-1]):
            axes.axvline(known[-1], color=SECOND, lw=1.2, zorder=1.5, label="closed form")
        axes.axvline(0, color=MUTED, lw=0.6, zorder=1.2)
        place = np.arange(len(methods))[::-1]
        for at, value, used in zip(place, values, depends, strict=True):
            if np.isfinite(value):
                axes.plot(
                    value,
                    at,
                    "o",
                    color=FIRST if used else MUTED,
                    ms=6,
                    mfc=None if used else "none",
                    mew=1.2,
                )
        axes.set_yticks(place, [folded(method, 150 if wide else 85, 8.5) for method in methods])
        axes.set_ylim(-0.6, len(methods) - 0.4)
        span = known[np.isfinite(known)]
        if len(span) and scale.kind == "linear":
            low, high = min(0.0, span.min()), max(0.0, span.max())
            room = 0.08 * (high - low or 1.0)
            # room for the words beside the last dot
            axes.set_xlim(low - room, high + 2.5 * room)
        for at, value, used in zip(place, values, depends, strict=True):
            words = (
                number(value)
                if used and np.isfinite(value)
                else "not finite"
                if used
                else "0: does not depend"
            )
            spot = value if np.isfinite(value) else 0.0
            right = _fraction(axes, scale, spot) > 0.6
            label = axes.annotate(
                words, (spot, at), (-7 if right else 7, 0), textcoords="offset points", fontsize=8.5,
                color=INK if used else MUTED, va="center", ha="right" if right else "left", zorder=4,
            )  # fmt: skip
            label.set_gid("halo")
        exponent = scale.ticks(axes, "x", 6 if wide else 4)
        axes.set_xlabel(scale.label(f"dloss/d{name}", exponent), color=INK)
        if axes is panels[0]:
            legend(axes)


def _scale(values: np.ndarray) -> Scale:
    size = np.abs(values[np.isfinite(values) & (values != 0)])
    far = len(size) > 1 and size.max() > 300 * size.min()
    # zero is shown too, so that no axis is one of differences
    return Scale.choose("symlog" if far else "linear", [values, np.zeros(1)])


def _value(value: float | None) -> float:
    return np.nan if value is None else float(value)


def _fraction(axes, scale: Scale, value: float) -> float:
    low, high = scale.flat(np.array(axes.get_xlim()))
    return float((scale.flat(np.array(value)) - low) / (high - low))
