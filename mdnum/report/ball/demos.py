"""The demonstrations as one page: question, answer, numbers, checks, tables and figures of each."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mdnum.ball.demos import NAMES
from mdnum.ball.demos.base import Demo, Plot, Table
from mdnum.report import page, plots
from mdnum.report.ball.values import cells, is_number, json_value, value_text
from mdnum.report.words import count, many
from mdnum.store.atomic import disk_errors, write_text

#: Rows of a table that the page carries; demos.json has all.
TABLE_ROWS = 60


@dataclass(frozen=True)
class _Picture:
    title: str
    caption: str
    notes: tuple[str, ...]
    markup: Markup


@dataclass(frozen=True)
class _Table:
    title: str
    columns: tuple[str, ...]
    numeric: tuple[bool, ...]
    rows: list[list[str]]
    left_out: int


def write_report(path: Path, demos: Sequence[Demo]) -> Path:
    """Writes report.html, demos.json and figures/<demo>-<n>.svg into a folder.

    Args:
        path: the folder, made if missing. Demonstrations that are not given are listed as not run.

    Returns:
        the path of report.html.

    Raises:
        FolderError: the folder cannot be written.
    """
    path = Path(path)
    with disk_errors(path):
        path.mkdir(parents=True, exist_ok=True)
    document = json.dumps([as_dict(demo) for demo in demos], indent=2, ensure_ascii=False, allow_nan=False)
    write_text(path / "demos.json", document + "\n")
    pictures = {demo.name: list(_pictures(path, demo)) for demo in demos}
    written = path / "report.html"
    write_text(written, render(demos, pictures))
    return written


def render(demos: Sequence[Demo], pictures: Mapping[str, Sequence[_Picture]]) -> str:
    """The page's text.

    Args:
        pictures: the figures of each demonstration.
    """
    by_name = {demo.name: demo for demo in demos}
    names = [*NAMES, *(name for name in by_name if name not in NAMES)]
    done = [name for name in names if name in by_name]
    around = dict(zip(done, zip([None, *done], [*done[1:], None], strict=False), strict=False))
    return page.render(
        "ball/demos.html.j2",
        demos=[by_name[name] for name in done],
        names=names,
        by_name=by_name,
        around=around,
        pictures=pictures,
        tables={demo.name: [_table(table) for table in demo.tables] for demo in demos},
        numbers={demo.name: list(_numbers(demo.numbers)) for demo in demos},
        verdict=_verdict(demos),
        value_text=value_text,
        is_number=is_number,
    )


def as_dict(demo: Demo) -> dict[str, Any]:
    """A demonstration as plain values, without its plots; NaN and infinity become null."""
    return {
        "name": demo.name,
        "title": demo.title,
        "ok": demo.ok,
        "question": demo.question,
        "answer": demo.answer,
        "numbers": json_value(demo.numbers),
        "checks": [
            {
                "what": check.what,
                "seen": json_value(check.seen),
                "expected": check.expected,
                "ok": bool(check.ok),
            }
            for check in demo.checks
        ],
        "tables": [
            {"title": table.title, "columns": list(table.columns), "rows": json_value(table.rows)}
            for table in demo.tables
        ],
        "in_md": demo.in_md,
        "data": json_value(demo.data),
    }


def _verdict(demos: Sequence[Demo]) -> dict[str, str]:
    failed = [demo.name for demo in demos if not demo.ok]
    checks = [check for demo in demos for check in demo.checks]
    held = sum(bool(check.ok) for check in checks)
    if failed:
        headline = (
            f"{len(failed)} of {many(len(demos), 'demonstration')} did not come out: {', '.join(failed)}."
        )
    elif not demos:
        headline = "No demonstration was run."
    elif len(demos) == 1:
        headline = "The demonstration came out as it should."
    else:
        headline = f"All {count(len(demos))} demonstrations came out as they should."
    return {
        "tone": "error" if failed else "good",
        "headline": headline,
        "text": f"{count(held)} of {many(len(checks), 'check')} held.",
    }


def _pictures(path: Path, demo: Demo) -> Iterator[_Picture]:
    for number, plot in enumerate(demo.plots, 1):
        yield _Picture(
            title=plot.title,
            caption=plot.caption,
            notes=tuple(plots.notes(plot)),
            markup=page.picture(path, f"{demo.name}-{number}", plot.title, _drawer(plot)),
        )


def _drawer(plot: Plot):
    return lambda width: plots.draw(plot, width)


def _table(table: Table) -> _Table:
    shown = [cells([row[at] for row in table.rows]) for at in range(len(table.columns))]
    numeric = tuple(
        bool(table.rows) and all(is_number(row[at]) for row in table.rows) for at in range(len(table.columns))
    )
    rows = [list(row) for row in zip(*shown, strict=True)]
    return _Table(table.title, table.columns, numeric, rows[:TABLE_ROWS], max(0, len(rows) - TABLE_ROWS))


def _numbers(numbers: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """(name, text, all digits) of each number; those of nested tables by both names."""
    first = not prefix
    for name, value in numbers.items():
        words = f"{prefix}{name}".replace("_", " ")
        if isinstance(value, Mapping):
            yield from _numbers(value, f"{words}: ")
        else:
            # the first is what the demonstration is known by
            yield words, value_text(value, 10 if first else 6), str(json_value(value))
        first = False
