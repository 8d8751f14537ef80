"""The figures of a comparison: how two runs part, and what their flips had to do with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mdnum.ball.demos.base import Plot, Series
from mdnum.report import plots, thin
from mdnum.report.axes import PAGE_WIDTH
from mdnum.report.fork import atoms, choices
from mdnum.report.fork.findings import FITS
from mdnum.report.fork.run import ForkFolder
from mdnum.report.svg import BAD, FIRST, HALO, MUTED, SECOND, THIRD
from mdnum.report.words import many, number, plain

Drawer = Callable[[float], Figure]
Role = Literal["first", "second", "third", "bad", "muted", "ink"]

#: Flips that are drawn as ticks.
_TICKS = 1_500
#: Points of the lines by color: free runs, counterfactuals, a decision taken back, repeats.
_WIDTHS = {FIRST: 2.6, SECOND: 1.8, THIRD: 1.0, BAD: 1.0, MUTED: 0.7}
#: How the counterfactual is dashed, shorter than a fit.
_HANDED = (0, (3.0, 1.5))
#: A fit is drawn on where it predicts a split, for at most so many times the steps that were followed.
_BEYOND = 2.0


def figures(run: ForkFolder) -> Iterator[tuple[str, str, Drawer, list[str]]]:
    """(name, title, what draws it at a width, notes) of every figure that the folder has numbers for."""
    if run.screened:
        if run.ranking:
            yield "ranking", "Choices by the step at which they fork", partial(choices.ranking, run), []
        return
    plot = separation(run)
    if plot is not None:
        yield "separation", plot.title, partial(draw_separation, run, plot), []
    if len(run.around.get("atom", ())) > 1:
        yield "atoms", "The atoms around the deciding pair at the fork", partial(atoms.draw, run), []
    for name, plot in (("protection", protection(run)), ("cross", cross(run)),
                       ("overridden", overridden(run)), ("furthest", furthest(run)),
                       ("energy", energy(run))):  # fmt: skip
        if plot is not None:
            yield name, plot.title, partial(plots.draw, plot), plots.notes(plot)


def separation(run: ForkFolder) -> Plot | None:
    """The separation of A from B and from B under A's decisions, with the three dates."""
    step = run.series.get("step", np.zeros(0))
    if not run.has("free") or not np.any(run.series["free"] > 0):
        return None
    series = []
    for k, name in enumerate(run.repeats):
        # a repeat is close to the run that it repeats and must not hide it: it comes first
        label = "" if k else "B again, start perturbed"
        series.append(Series(label, step, _positive(run.series[name]), role="muted"))
    named: tuple[tuple[str, str, Role], ...] = (
        ("free", "A and B, free", "first"),
        ("handed", "A and B under A’s decisions", "second"),
        ("back", "B and A under B’s decisions", "third"),
        ("pinned", "A and B, decision taken back", "bad"),
    )
    for name, label, role in named:
        if run.has(name):
            series.append(Series(label, step, _positive(run.series[name]), role=role))
    fit = _fit(run)
    if fit is not None:
        series.append(Series("growth, fitted", *fit, role="ink", dashed=True))
    verticals = tuple((float(at), f"{name} {at:,}") for name, at in run.dates.items())
    guess = run.summary.get("predicted_split")
    if guess is not None and guess <= _BEYOND * run.steps:
        verticals += ((float(guess), f"split expected {guess:,}"),)
    tolerance = float(run.summary["tolerance"])
    return Plot(
        "Separation of the two runs",
        f"step (of {plain(run.summary.get('timestep'))} {run.units.time})",
        f"largest distance of an atom from itself ({run.units.length})",
        tuple(series),
        y_scale="log",
        verticals=verticals,
        horizontals=((tolerance, ""),),
    )


def _positive(values: np.ndarray) -> np.ndarray:
    """Without the zeros before the seed, which a logarithmic axis has no place for."""
    return np.where(values > 0, values, np.nan)


def _fit(run: ForkFolder) -> tuple[np.ndarray, np.ndarray] | None:
    """The fitted growth as a line, drawn on to a predicted split that is near enough."""
    fit = (run.summary.get("growth") or {}).get("B") or {}
    if fit.get("rate") is None or fit["r_squared"] < FITS:
        return None
    end = float(fit["last"])
    guess = run.summary.get("predicted_split")
    if guess is not None and guess <= _BEYOND * run.steps:
        end = float(guess)
    at = np.linspace(fit["first"], end, 60)
    return at, np.exp(fit["intercept"] + fit["rate"] * at)


def draw_separation(run: ForkFolder, plot: Plot, width: float) -> Figure:
    """The separation with its lines by weight, its tolerance named, and a tick for each cross-run flip."""
    figure = plots.draw(plot, width)
    figure.set_figheight(figure.get_figheight() + (1.5 if width >= PAGE_WIDTH else 0.9))
    axes = figure.axes[0]
    legend = axes.get_legend()
    for line in (*axes.lines, *(legend.get_lines() if legend is not None else ())):
        if line.get_linestyle() == "-" and line.get_color() in _WIDTHS:
            # before the fork the lines lie upon one another: the wider one shows at both sides of the others
            line.set(linewidth=_WIDTHS[str(line.get_color())], alpha=1.0)
            if line.get_color() == SECOND:
                # above all of them, with gaps that show those below
                line.set(linestyle=_HANDED, zorder=2.5)
    _name_tolerance(axes, run)
    _ticks(axes, run)
    return figure


def _name_tolerance(axes: Axes, run: ForkFolder) -> None:
    """Writes what the horizontal line is into the widest gap between the dates, whose names stand upright.

    Up to the split only: beyond it the separation runs where the words would stand.
    """
    low, high = axes.get_xlim()
    end = run.dates.get("split", high)
    edges = np.sort([low, *(at for at in run.dates.values() if at < end), end])
    widest = int(np.argmax(np.diff(edges)))
    tolerance = float(run.summary["tolerance"])
    label = axes.annotate(
        f"split: beyond {number(tolerance, 3)} {run.units.length}",
        (float(edges[widest] + edges[widest + 1]) / 2, tolerance), (0, 3), textcoords="offset points",
        ha="center", va="bottom", fontsize=8, color=MUTED, zorder=4,
    )  # fmt: skip
    label.set_gid(HALO)


def _ticks(axes: Axes, run: ForkFolder) -> None:
    """A tick below the axis for each flip that one run made and the other did not."""
    step = np.unique(run.flips.get("step", np.zeros(0)))
    if not len(step):
        return
    step = step[thin.points(step.astype(float), np.zeros(len(step)), _TICKS)]
    low, high = axes.get_xlim()
    # below the axis, where they hide neither a line nor the name of a date
    axes.vlines(
        step,
        -0.045,
        -0.012,
        transform=axes.get_xaxis_transform(),
        color=BAD,
        lw=0.6,
        alpha=0.8,
        clip_on=False,
    )
    axes.set_xlim(low, high)
    axes.tick_params(axis="x", pad=14)


def protection(run: ForkFolder) -> Plot | None:
    """How far the nearest pair is from its cutoff at each step, and how far the runs can have moved it."""
    if not run.has("nearest_a") or not np.any(run.series["free"] > 0):
        return None
    step = run.series["step"]
    moved = 2.0 * run.series["free"]
    series = (
        Series("nearest pair of A to its cutoff", step, _positive(run.series["nearest_a"]), mark="points",
               role="muted"),
        Series("twice the separation of A and B", step, _positive(moved), role="first"),
    )  # fmt: skip
    verticals = _dates(run)
    until = run.summary.get("protected_until")
    if until is not None and 0 <= until < run.steps:
        verticals = ((float(until), "protected"), *verticals)
    return Plot(
        "Nearest decision and separation", "step", f"length ({run.units.length})", series, y_scale="log",
        verticals=verticals,
    )  # fmt: skip


def cross(run: ForkFolder) -> Plot | None:
    """How many pairs the two runs decide differently."""
    values = run.series.get("cross", np.zeros(0))
    if not np.any(values):
        return None
    shown = np.where(values > 0, values.astype(float), np.nan)
    series = (Series("pairs that differ", run.series["step"], shown, mark="steps"),)
    wide = np.nanmax(shown) > 30
    return Plot(
        "Pairs that the two runs decide differently", "step", "pairs", series,
        y_scale="log" if wide else "linear", verticals=_dates(run),
    )  # fmt: skip


def overridden(run: ForkFolder) -> Plot | None:
    """How many of its own decisions the counterfactual was not allowed."""
    values = run.series.get("overridden", np.zeros(0))
    if not np.any(np.nan_to_num(values)):
        return None
    some = np.nan_to_num(values) > 0
    sparse = np.count_nonzero(some) < 200
    values = np.where(some, values, np.nan) if sparse else values
    mark: Literal["points", "steps"] = "points" if sparse else "steps"
    series = (Series("decisions overridden", run.series["step"], values, mark=mark, role="second"),)
    return Plot(
        "Decisions overridden in the run under A’s decisions", "step", "decisions overridden", series,
        verticals=_dates(run),
    )  # fmt: skip


def furthest(run: ForkFolder) -> Plot | None:
    """How far from its cutoff the furthest overridden pair was."""
    values = run.series.get("furthest", np.zeros(0))
    if not np.any(np.nan_to_num(values) > 0):
        return None
    series = (Series("", run.series["step"], _positive(values), mark="points", role="second"),)
    return Plot(
        "Distance of overridden pairs from their cutoff", "step",
        f"furthest from its cutoff ({run.units.length})", series, y_scale="log",
        verticals=_dates(run), horizontals=((float(run.summary["tolerance"]), "split tolerance"),),
    )  # fmt: skip


def energy(run: ForkFolder) -> Plot | None:
    """How far apart the energies of the runs are."""
    if not run.has("energy_b"):
        return None
    first = run.series["energy_a"]
    series = []
    named: tuple[tuple[str, str, Role], ...] = (
        ("energy_b", "B, free", "first"),
        ("energy_handed", "B under A’s decisions", "second"),
    )
    for name, label, role in named:
        off = np.abs(run.series[name] - first)
        if np.any(off[np.isfinite(off)] > 0):
            series.append(Series(label, run.series["step"], _positive(off), role=role))
    if not series:
        return None
    return Plot(
        "Difference of total energies", "step", f"|energy − energy of A| ({run.units.energy})",
        tuple(series), y_scale="log", verticals=_dates(run),
    )  # fmt: skip


def _dates(run: ForkFolder) -> tuple[tuple[float, str], ...]:
    return tuple((float(at), name) for name, at in run.dates.items() if name != "seed")


def captions(run: ForkFolder) -> dict[str, str]:
    """What stands below the figures."""
    ticks = "; a tick below the axis for each step at which only one run flips a pair" if len(
        run.flips.get("step", ())
    ) else ""  # fmt: skip
    handed = (
        " Under A’s decisions B keeps its own arithmetic, and is told which pairs are inside: "
        "what the dashed line does not do, the flips did."
        if run.has("handed")
        else ""
    )
    made = run.decision or {}
    also = f" ({many(made['also'], 'more pair')} at this step)" if made.get("also") else ""
    return {
        "separation": f"Largest distance between an atom in A and the same atom in B{ticks}.{handed}",
        "atoms": "Seen with the deciding pair in the plane"
        f"{also}; the circle is the cutoff around its first atom. Paler atoms are further "
        "behind or in front. Arrows: where B’s atoms are off A’s, magnified.",
        "protection": "Two atoms may each be off by the separation. A point below the line is a decision "
        "that the difference of the runs can have changed.",
        "cross": "From the fork on; a pair counts as long as the two runs disagree about it.",
        "overridden": "Decisions that the run under A’s decisions would have made otherwise, by step.",
        "furthest": "An overridden decision far from its threshold is no longer one that rounding "
        "could have changed; the run under A’s decisions is ended there.",
        "energy": "Total energies of both runs, one minus the other.",
        "ranking": "A filled mark where the first decision differs, an open one where the first bit does; "
        "a cross where the runs have split.",
    }
