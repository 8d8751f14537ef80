"""The figures of two rollouts of a ball: how they part, and the deciding ball at the fork."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from matplotlib.figure import Figure

from mdnum.ball.demos.base import Plot, Series
from mdnum.report import plots
from mdnum.report.fork import figures
from mdnum.report.fork.run import ForkFolder

Role = Literal["first", "second", "third", "bad", "muted", "ink"]


def drawn(
    run: ForkFolder, around: dict[str, np.ndarray]
) -> Iterator[tuple[str, str, figures.Drawer, list[str]]]:
    """(name, title, what draws it at a width, notes) of every figure that the folder has numbers for.

    Args:
        around: table of heights of the deciding ball around the fork, arrays by column.
    """
    if run.screened:
        yield from figures.figures(run)
        return
    plot = figures.separation(run)
    if plot is not None:
        plot = replace(
            plot, title="Separation of the two rollouts", y_label="largest difference of heights (m)"
        )
        yield "separation", plot.title, partial(figures.draw_separation, run, plot), []
    for name, made in (
        ("around", near(run, around)),
        ("cross", cross(run)),
        ("overridden", overridden(run)),
        ("energy", energy(run)),
    ):
        if made is not None:
            span = None if name == "around" else (0.0, float(run.steps))
            yield name, made.title, partial(_draw, made, span), plots.notes(made)


def _draw(plot: Plot, span: tuple[float, float] | None, width: float) -> Figure:
    return plots.draw(plot, width, span)


def near(run: ForkFolder, around: dict[str, np.ndarray]) -> Plot | None:
    """Heights of the deciding ball in both runs around the fork, with its contacts."""
    if not len(around.get("step", ())) or run.decision is None:
        return None
    series = []
    named: tuple[tuple[str, Role], ...] = (("A", "first"), ("B", "second"))
    for name, role in named:
        mine = around["run"].astype(str) == name
        step, height = around["step"][mine], around["y"][mine]
        # B on A: before the fork one line hides the other
        series.append(Series(name, step, height, role=role, dashed=name == "B"))
        touching = around["contact"][mine].astype(bool)
        if touching.any():
            label = f"{name} in contact"
            series.append(Series(label, step[touching], height[touching], mark="points", role=role))
    ball = int(around["ball"][0])
    return Plot(
        f"Ball {ball} around the fork", "step", "height (m)", tuple(series),
        verticals=((float(run.decision["step"]), "fork"),), horizontals=((0.0, "floor"),),
    )  # fmt: skip


def cross(run: ForkFolder) -> Plot | None:
    """How many decisions differ at each step."""
    values = run.series.get("cross", np.zeros(0))
    if not np.any(values):
        return None
    shown = np.where(values > 0, values.astype(float), np.nan)
    series = (Series("decisions that differ", run.series["step"], shown, mark="points"),)
    return Plot(
        "Decisions that the two runs make differently", "step", "decisions that differ", series,
        verticals=_dates(run),
    )  # fmt: skip


def overridden(run: ForkFolder) -> Plot | None:
    """How many of its own decisions the counterfactual was not allowed."""
    values = np.nan_to_num(run.series.get("overridden", np.zeros(0)))
    if not np.any(values):
        return None
    shown = np.where(values > 0, values, np.nan)
    series = (Series("decisions overridden", run.series["step"], shown, mark="points", role="second"),)
    return Plot(
        "Decisions overridden in the run under A’s decisions", "step", "decisions overridden", series,
        verticals=_dates(run),
    )  # fmt: skip


def energy(run: ForkFolder) -> Plot | None:
    """How far apart the energies of the runs are."""
    plot = figures.energy(run)
    return None if plot is None else replace(plot, y_label="|energy per mass − that of A| (m²/s²)")


def _dates(run: ForkFolder) -> tuple[tuple[float, str], ...]:
    return tuple((float(at), name) for name, at in run.dates.items() if name != "seed")


def captions(run: ForkFolder) -> dict[str, str]:
    """What stands below the figures."""
    ticks = (
        "; a tick below the axis for each step at which a decision differs"
        if len(run.flips.get("step", ()))
        else ""
    )
    handed = (
        " Under A’s decisions B keeps its own arithmetic, and is told when each ball touches and how often "
        "each solve iterates: what the dashed line does not do, the decisions did."
        if run.has("handed")
        else ""
    )
    if handed and run.summary.get("handed_largest") == 0:
        handed += " Here it has no line: no bit of a height differs."
    return {
        "separation": f"Largest difference between the height of a ball in A and in B{ticks}.{handed}",
        "around": "The ball whose decision differs first, in both runs; points where it is in contact.",
        "cross": "Contacts and counts of iterations that differ between A and B, by step.",
        "overridden": "Decisions that the run under A’s decisions would have made otherwise, by step.",
        "energy": "Mechanical energies per mass, the mean over the balls, one minus the other.",
        "ranking": figures.captions(run)["ranking"] if run.screened else "",
    }
