"""report.html of an audited calculator: a verdict, findings with evidence, and what each check saw."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mdnum.audit.causes import grouped
from mdnum.ball.demos.base import Plot, Series
from mdnum.report.fork.findings import Verdict
from mdnum.report.fork.question import Question, declared, load, verdict, write_page
from mdnum.report.verdict import Finding, restore
from mdnum.report.words import count, heading, many, number, typeset
from mdnum.store import RunFolder
from mdnum.store.atomic import read_text

_ROLES = ("first", "second", "third", "bad", "muted", "ink")
#: Rows of a table that are shown at once; the others unfold.
_SHOWN = 8


def write_report(folder: RunFolder | str | Path) -> Path:
    """Writes report.html and figures/*.svg, and puts findings into summary.json.

    Returns:
        the path of report.html.

    Raises:
        FolderError: no audit in the folder, or it cannot be written.
    """
    folder, run = load(folder, "audit", "audit")
    drawn = {
        curve["name"]: declared(plot)
        for part in run.summary["parts"]
        for curve in part["curves"]
        if (plot := _plot(run, curve)) is not None
    }
    judged = judge(run)
    return write_page(
        folder,
        run,
        judged,
        "audit/run.html.j2",
        drawn,
        captions={curve["name"]: curve["title"] for part in run.summary["parts"] for curve in part["curves"]},
        figures=list(_key_figures(run)),
        parts=[_part(part) for part in run.summary["parts"]],
        groups=_groups(judged.findings),
        what=list(_what(run)),
        reproduce=_script(folder.path),
    )


def record(folder: RunFolder | str | Path) -> Verdict:
    """Puts headline and findings into an audit's summary.json."""
    folder, run = load(folder, "audit", "audit")
    judged = judge(run)
    judged.store(folder, run.summary)
    return judged


def judge(run: Question) -> Verdict:
    """Headline, evidence and findings of an audit, which its checks have written down."""
    summary = run.summary
    return verdict(
        typeset(summary["headline"]),
        [typeset(sentence) for sentence in summary["evidence"]],
        [_typeset(restore(one)) for one in summary["findings"]],
        plain_tone="good",
        judged=True,
    )


def _typeset(one: Finding) -> Finding:
    return replace(one, title=typeset(one.title), text=typeset(one.text), remedy=typeset(one.remedy))


def _groups(findings: Sequence[Finding]) -> list[tuple[Finding, list[Finding]]]:
    """Findings that stand by themselves, each with what may be of the same cause."""
    return grouped(findings, [(one.code, one.severity) for one in findings])


def _key_figures(run: Question) -> Iterator[tuple[str, str, str]]:
    """(label, value, small print) of the strip below the verdict."""
    summary = run.summary
    yield "To run", summary["safe_to_run"], "a simulation with it"
    yield "To differentiate", summary["safe_to_differentiate"], "through it"
    alone = [one.severity for one, _ in _groups([restore(one) for one in summary["findings"]])]
    errors = alone.count("error")
    yield "Findings", count(errors + alone.count("warning")), many(errors, "error")
    numbers = {part["name"]: part["numbers"] for part in summary["parts"]}
    if "dynamics" in numbers and numbers["dynamics"].get("drift") is not None:
        yield "Drift", number(numbers["dynamics"]["drift"], 2, signed=True), numbers["dynamics"]["drift_unit"]
    if "forces" in numbers and "largest_difference" in numbers["forces"]:
        force = f"{summary['units']['energy']}/{summary['units']['length']}"
        yield "Forces", number(numbers["forces"]["largest_difference"], 1), f"from differences, {force}"
    if "invariance" in numbers and "told_apart" in numbers["invariance"]:
        one = numbers["invariance"]
        yield "Told apart", f"{count(one['told_apart'])} of {count(one['ways'])}", "ways to write it down"


def _part(part: Mapping[str, Any]) -> dict[str, Any]:
    """A check as its section shows it."""
    return {
        "title": part["title"],
        "says": typeset(part["says"]),
        "curves": [curve["name"] for curve in part["curves"]],
        "tables": [_table(title, rows) for title, rows in part["tables"].items() if rows],
        "skipped": [(heading(one["what"]), one["why"]) for one in part["skipped"]],
        "ways": _ways(part),
    }


def _ways(part: Mapping[str, Any]) -> str:
    asked, possible = part.get("asked"), part.get("possible")
    if asked is None or possible is None:  # a folder from before they were counted
        return ""
    return (
        f"{many(asked, 'way')} asked"
        if asked == possible
        else f"{count(asked)} of {count(possible)} ways asked"
    )


def _table(title: str, rows: list[Mapping[str, Any]]) -> dict[str, Any]:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    numeric = [all(_is_number(row.get(name)) for row in rows) for name in columns]
    cells = [[_cell(row.get(name)) for name in columns] for row in rows]
    # what went wrong is on top, where it is seen
    bad = [any(row.get(name) is False for name in columns) for row in rows]
    order = sorted(range(len(rows)), key=lambda n: not bad[n])
    lines = [{"cells": list(zip(cells[n], numeric, strict=True)), "bad": bad[n]} for n in order]
    return {
        "title": title,
        "columns": list(zip(columns, numeric, strict=True)),
        "lines": lines[:_SHOWN],
        "more": lines[_SHOWN:],
    }


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | None) and not isinstance(value, bool)


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return count(value)
    if isinstance(value, float):
        return number(value, 3)
    return str(value)


def _plot(run: Question, curve: Mapping[str, Any]) -> Plot | None:
    """A curve of a part, from the points in curves.parquet."""
    table = run.tables["curves"]
    mine = table["curve"] == curve["name"]
    series = []
    for at, line in enumerate(curve["lines"]):
        chosen = mine & (table["line"] == line)
        role: Any = _ROLES[at % len(_ROLES)]
        few = int(chosen.sum()) < 40
        series.append(
            Series(line, table["x"][chosen], table["y"][chosen], "line+points" if few else "line", role)
        )
    if not any(np.isfinite(one.y).any() for one in series):
        return None
    log_x = bool(series) and "step" in curve["x_label"] and float(np.min(series[0].x, initial=0.0)) >= 0
    positive = all(np.all(one.x > 0) for one in series)
    return Plot(
        curve["title"], curve["x_label"], curve["y_label"], tuple(series),
        x_scale="log" if log_x and positive and curve["log_y"] else "linear",
        y_scale="log" if curve["log_y"] else "linear",
        verticals=tuple((float(value), word) for word, value in curve["marks"].items() if value is not None),
    )  # fmt: skip


def _what(run: Question) -> Iterator[tuple[str, str]]:
    summary = run.summary
    axes = [axis for axis, yes in zip("abc", summary["periodic"], strict=True) if yes]
    yield "Calculator", summary["calculator"]
    yield (
        "Structure",
        f"{summary['formula']}, {count(summary['atoms'])} atoms, "
        + (f"periodic along {', '.join(axes)}" if axes else "not periodic"),
    )
    if summary.get("structure"):
        yield "Which is", summary["structure"]
    yield "kT", f"{number(summary['kT'], 4)} {summary['units']['energy']}"
    yield "Took", f"{number(summary.get('seconds'), 2)} s"


def _script(folder: Path) -> str:
    return read_text(folder / "reproduce.py")
