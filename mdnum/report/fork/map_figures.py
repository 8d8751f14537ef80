"""The figures of a parameter map: the loss piece by piece, and how large its jumps are."""

from __future__ import annotations

from typing import Literal

import numpy as np

from mdnum.ball.demos.base import Plot, Series
from mdnum.report.fork.question import Question

#: Jumps that are a smaller share of the range of the loss are shown once more, without its trend.
_VISIBLE = 0.05
#: Degree of the trend that is taken off.
_TREND = 3
#: Share of the interval that a label with pair and step takes.
_ROOM = 0.03

Role = Literal["first", "bad", "muted"]


def parameter_map(run: Question) -> Plot | None:
    """The loss over the number, piece by piece, with its jumps."""
    pieces = _pieces(run, run.tables["points"]["loss"])
    if pieces is None:
        return None
    return _plot(run, pieces, f"The {run.summary['loss']} at step {run.steps:,} along {run.summary['key']}")


def detail(run: Question) -> Plot | None:
    """The same without its trend, where the jumps are too small to be seen beside it."""
    at, loss = run.tables["points"]["at"], run.tables["points"]["loss"]
    largest = run.summary["jump_largest"]
    finite = np.isfinite(loss)
    if largest is None or np.count_nonzero(finite) < 3 * _TREND or largest > _VISIBLE * np.ptp(loss[finite]):
        return None
    pieces = _pieces(run, loss - _trend(run, at, loss))
    if pieces is None:
        return None
    title = f"The {run.summary['loss']} along {run.summary['key']}, less its trend"
    return _plot(run, pieces, title, "less a cubic")


def _trend(run: Question, at: np.ndarray, loss: np.ndarray) -> np.ndarray:
    """A cubic through the intervals, each counted by its width: the runs crowd at the boundaries."""
    edges = np.concatenate([[at[0]], (at[1:] + at[:-1]) / 2, [at[-1]]])
    weight = np.sqrt(np.diff(edges))
    x = (at - at[0]) / (at[-1] - at[0])
    finite = np.isfinite(loss)
    fit = np.polynomial.polynomial.polyfit(x[finite], loss[finite], _TREND, w=weight[finite])
    return np.polynomial.polynomial.polyval(x, fit)


def _pieces(run: Question, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Runs with a gap between histories (at, values), and which runs stand at a gap."""
    at = run.tables["points"]["at"]
    if len(at) < 2 or not np.isfinite(values).any():
        return None
    breaks = np.flatnonzero(np.diff(run.tables["points"]["history"])) + 1
    return np.insert(at, breaks, np.nan), np.insert(values, breaks, np.nan), breaks


def _plot(
    run: Question, pieces: tuple[np.ndarray, np.ndarray, np.ndarray], title: str, less: str = ""
) -> Plot:
    summary = run.summary
    at, values, breaks = pieces
    places = breaks + np.arange(len(breaks))
    # a line from the last run of one history to the first of the next
    jump = np.full((3, len(breaks)), np.nan), np.full((3, len(breaks)), np.nan)
    for column, source in zip(jump, (at, values), strict=True):
        column[0], column[1] = source[places - 1], source[places + 1]
    series = [Series("one history", at, values, mark="line+points")]
    # a stretch whose ends differ and that was not searched holds jumps, and nobody knows where
    searched = np.isin(at[places - 1], [edge["below"] for edge in summary["boundaries"]])
    named: tuple[tuple[np.ndarray, str, Role, bool], ...] = (
        (~searched, "not searched", "muted", True),
        (searched, "jump", "bad", False),
    )
    for which, label, role, dashed in named:
        if which.any():
            x, y = (column[:, which].T.ravel() for column in jump)
            series.append(Series(label, x, y, role=role, dashed=dashed))
    edges = list(zip((edge["above"] for edge in summary["boundaries"]), labels(run), strict=True))
    own = summary.get("value")
    if own is not None and summary["low"] < own < summary["high"]:
        edges.append((own, "the system’s own"))
    loss = f"{summary['loss']}{', ' + less if less else ''}"
    return Plot(
        title,
        with_unit(summary["key"], summary["key_unit"]),
        with_unit(loss, summary["loss_unit"]),
        tuple(series),
        verticals=tuple(edges),
    )


def labels(run: Question) -> list[str]:
    """What stands beside the boundaries: pair and step, or their numbers where that would be too much."""
    edges = run.summary["boundaries"]
    if not numbered(run):
        return [f"{edge['who']}, step {edge['step']:,}" for edge in edges]
    return [f"{place}" for place in range(1, len(edges) + 1)]


def numbered(run: Question) -> bool:
    """Whether the boundaries are so close to one another that a figure can only number them."""
    summary = run.summary
    at = [edge["above"] for edge in summary["boundaries"]]
    return len(at) > 1 and bool(np.diff(at).min() < _ROOM * (summary["high"] - summary["low"]))


def jumps(run: Question) -> Plot | None:
    """How large each jump is."""
    edges = run.summary["boundaries"]
    if len(edges) < 2:
        return None
    at = np.array([edge["above"] for edge in edges])
    size = np.abs([np.nan if edge["jump"] is None else edge["jump"] for edge in edges])
    apart = np.array([np.nan if edge["apart"] is None else edge["apart"] for edge in edges])
    summary, length = run.summary, run.units.length
    loss = with_unit(f"jump of the {summary['loss']}", summary["loss_unit"])
    series = [Series(loss, at, size, mark="points", role="bad")]
    if np.isfinite(apart).any():
        series.append(
            Series(f"furthest atom in the final state ({length})", at, apart, mark="points", role="muted")
        )
    return Plot(
        "What changes at each boundary",
        with_unit(summary["key"], summary["key_unit"]),
        "across the boundary",
        tuple(series),
        y_scale="log",
    )  # fmt: skip


def with_unit(text: str, unit: str) -> str:
    """The label of an axis, with its unit where it has one."""
    return f"{text} ({unit})" if unit else text


def captions(run: Question) -> dict[str, str]:
    """What stands below each figure of a map, by the figure's name."""
    which = (
        "the boundary of this number in the table"
        if numbered(run)
        else "this decision is the first that comes out otherwise, at this step"
    )
    return {
        "map": "A line for each stretch with one history of decisions; dots are runs, which crowd where a "
        f"boundary was closed in. Upright: between two adjacent floats, {which}.",
        "detail": "The same runs, with a cubic in the number taken off: what is left are jumps and kinks.",
        "jumps": "Sizes, whatever their sign. A decision of the last steps has had no time to move anything.",
    }
