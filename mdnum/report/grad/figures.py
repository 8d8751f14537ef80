"""The figures of a gradient: how it grows with the horizon, how far it is trusted, what single flips add."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np

from mdnum.ball.demos.base import Plot, Series
from mdnum.report.fork.question import Question
from mdnum.report.grad.words import size

Role = Literal["first", "second", "third", "bad", "muted", "ink"]
#: Colors of parameters, in order.
ROLES: tuple[Role, ...] = ("first", "second", "third", "ink", "muted", "bad")


def plots(run: Question) -> dict[str, Plot]:
    """The figures that the folder has numbers for, by name."""
    drawn = {"growth": growth(run), "state": state(run), "trust": trust(run)}
    drawn |= {"ranked": ranked(run), "running": running(run)}
    drawn |= {"spectrum": spectrum(run), "scaling": scaling(run)}
    return {name: plot for name, plot in drawn.items() if plot is not None}


def growth(run: Question) -> Plot | None:
    """What a relative change of each parameter does to the loss, against the horizon."""
    table = run.tables["growth"]
    unit = run.summary["loss"]["unit"]
    series = []
    for role, one in zip(ROLES, run.summary["parameters"], strict=False):
        values = _column(table, one["name"])
        scale = size(one["value"])
        if values is None or scale is None:
            continue
        if np.any(values):
            # of no steps at all there is no derivative
            shown = np.abs(values[1:]) * scale
            series.append(Series(one["name"], table["horizon"][1:], shown, role=role))
    if not series:
        return None
    label = "|parameter × derivative|"
    return Plot(
        f"The gradient of {run.summary['loss']['word']} against the horizon",
        "horizon (steps)",
        f"{label} ({unit})" if unit else label,
        tuple(series),
        y_scale="log",
        verticals=tuple(_horizons(run)),
    )


def _column(table: Mapping[str, np.ndarray], name: str) -> np.ndarray | None:
    """The gradient by a parameter; the norm of several entries."""
    if f"gradient.{name}" in table:
        return table[f"gradient.{name}"]
    parts = [values for key, values in table.items() if key.startswith(f"gradient.{name}.")]
    return np.sqrt(np.sum(np.square(parts), axis=0)) if parts else None


def _horizons(run: Question) -> Iterator[tuple[float, str]]:
    """Where trust in the gradient ends, where that was asked."""
    found = run.summary.get("trust")
    if found and found["limited_by"]:
        yield found["horizon"], f"limit: {found['limited_by']}"


def state(run: Question) -> Plot | None:
    """The gradient by the state, and the exponential that it follows."""
    table, found = run.tables["growth"], run.summary.get("growth")
    if found is None or not np.any(table["size"] > 0):
        return None
    horizon, norm = table["horizon"], table["size"]
    series = [Series("by all positions and velocities", horizon, norm, role="first")]
    rate = found["rate"]
    if rate and found["word"] == "forward bounded, gradient not":
        half = len(horizon) // 2
        middle = float(np.exp(np.mean(np.log(norm[half:]))))
        line = middle * np.exp(rate * (horizon - np.mean(horizon[half:])))
        shown = np.where(line >= norm[norm > 0].min(), line, np.nan)
        series.append(Series(f"a factor e in {1 / rate:.3g} steps", horizon, shown, role="bad", dashed=True))
    unit = run.summary["loss"]["unit"]
    per = f"{unit or '1'}/{run.units.length}"
    return Plot(
        "The gradient by the state against the horizon",
        "horizon (steps)",
        f"norm ({per})",
        tuple(series),
        y_scale="log",
        verticals=tuple(_horizons(run)),
    )


def trust(run: Question) -> Plot | None:
    """How far a wider precision and an ensemble disagree, against the horizon."""
    table, found = run.tables["trust"], run.summary.get("trust")
    if found is None or not len(table["horizon"]):
        return None
    series = [
        Series(f"{words}, {name}", table["horizon"], table[f"{key}.{name}"], role=role, dashed=key == "error",
               mark="line" if key == "step" else "line+points")
        for key, words in (
            ("relative", "other rounding"), ("step", "half the step"), ("error", "standard error / mean"),
        )
        for role, name in zip(ROLES, (one["name"] for one in run.summary["parameters"]), strict=False)
        if f"{key}.{name}" in table
    ]  # fmt: skip
    if not series:
        return None
    return Plot(
        "What other roundings, time steps and starts make of the gradient, against the horizon",
        "horizon (steps)",
        "relative difference",
        tuple(series),
        y_scale="log",
        verticals=tuple(_horizons(run)),
        horizontals=((found["tolerance"], "tolerance"),),
    )


def ranked(run: Question) -> Plot | None:
    """How large the contributions of flips are, the largest first."""
    series = []
    for role, name, added, total in _contributions(run):
        sizes = np.sort(np.abs(added))[::-1] / total
        series.append(Series(name, np.arange(1, len(sizes) + 1), sizes, role=role))
    if not series:
        return None
    return Plot(
        "Contributions of single flips, the largest first",
        "rank",
        "|contribution| / |derivative|",
        tuple(series),
        x_scale="log",
        y_scale="log",
    )


def running(run: Question) -> Plot | None:
    """What all flips up to a step add."""
    step = run.tables["flip_contributions"]["step"]
    order = np.argsort(step, kind="stable")
    series = tuple(
        Series(name, step[order], np.cumsum(added[order]) / total, role=role)
        for role, name, added, total in _contributions(run)
    )
    if not series:
        return None
    return Plot(
        "What the flips up to a step add",
        "step",
        "sum of contributions / |derivative|",
        series,
        horizontals=((0.0, ""),),
    )


def _contributions(run: Question) -> Iterator[tuple[Role, str, np.ndarray, float]]:
    """Color, parameter, contributions and size of the derivative, where flips add anything to it."""
    table: Mapping[str, np.ndarray] = run.tables["flip_contributions"]
    total = (run.summary.get("flips") or {}).get("total", {})
    names = [(name, f"contribution.{name}") for name in total]
    known = [(name, table[key]) for name, key in names if key in table and np.any(table[key])]
    for role, (name, added) in zip(ROLES, known, strict=False):
        if total[name]:
            yield role, name, added, abs(total[name])


def spectrum(run: Question) -> Plot | None:
    """How far the directions that stretch most have stretched."""
    found = run.summary.get("spectrum")
    if not found:
        return None
    curve = np.array(found["curve"], float)
    series = tuple(
        Series(f"{place + 1}", np.array(found["horizon"]), curve[:, place], role=role)
        for place, role in zip(range(curve.shape[1]), ROLES, strict=False)
    )
    return Plot(
        "How far the directions that stretch most have stretched", "step", "logarithm of the stretch", series
    )


def scaling(run: Question) -> Plot | None:
    """Sizes of the numbers that a reverse pass carries."""
    table, found = run.tables["scaling"], run.summary.get("scaling")
    if not found or not len(table["horizon"]):
        return None
    sizes = {
        name: np.where(np.isfinite(table[name]), table[name], np.nan) for name in ("largest", "smallest")
    }
    series = (
        Series("largest", table["horizon"], sizes["largest"]),
        Series("smallest", table["horizon"], sizes["smallest"], role="second"),
    )
    lost = table["overflow"] + table["underflow"]
    if lost.any():
        series += (Series(f"lost in {found['format']}", table["horizon"], lost.astype(float), role="bad"),)
    return Plot(
        f"Numbers of the reverse pass, held against {found['format']}",
        "horizon (steps)",
        "magnitude; count",
        series,
        y_scale="log",
    )


def captions(run: Question) -> dict[str, str]:
    """What stands below each figure, by its name."""
    shadow = (run.summary.get("trust") or {}).get("shadow", "")
    return {
        "growth": "A horizon of h steps is the last h steps of the run; all of them are read off one reverse "
        "pass. Times the parameter's value, a derivative is what a relative change of it does to the loss.",
        "state": "What the loss makes of a change of the state so many steps before the end; velocities are "
        "turned into lengths by a time of 30 steps.",
        "trust": f"Points: gradients of {shadow}. Lines: of the time step and its half. Dashed: the standard "
        "error over starts against the mean, where there were several.",
        "ranked": "Where a line is flat, many flips add alike; where it falls from the start, few decide.",
        "spectrum": "An orthonormal frame of changes carried along with decisions held; slopes are "
        "finite-time Lyapunov exponents.",
        "scaling": "Cotangents of positions and velocities at each step, unscaled; red: how many of them the "
        "narrow format cannot hold.",
        "running": "At the end: the share of the derivative that the flips add. What is beyond it cancels.",
    }
