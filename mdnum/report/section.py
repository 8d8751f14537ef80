"""Elements of pages and terminal output: sections with text, tables and figures.

This module only defines the data of pages. `page` renders sections as HTML; `cli.output` prints sections.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mdnum.report.words import count, number, typeset

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

AxisScale = Literal["linear", "log", "symlog"]
Mark = Literal["line", "points", "steps", "line+points"]
Role = Literal["first", "second", "third", "bad", "muted", "ink"]


@dataclass(frozen=True)
class Table:
    """Table of values in named columns."""

    # names, with their unit in parentheses; all empty for a table without a head, whose first column then
    # names its rows
    columns: tuple[str, ...]
    # plain values; floats are written with 3 digits, None as a dash, text as it is
    rows: Sequence[Sequence[Any]]
    title: str = ""  # a small heading, empty for none
    shown: int = 20  # rows that are shown at once; the others unfold
    bad: frozenset[int] = frozenset()  # rows that are marked, by their number

    @cached_property
    def numeric(self) -> tuple[bool, ...]:
        """For each column, True if it contains only numbers and is therefore right-aligned."""
        columns = [[row[k] for row in self.rows] for k in range(len(self.columns))]
        return tuple(
            any(map(_is_number, values)) and all(value is None or _is_number(value) for value in values)
            for values in columns
        )


def records(rows: Sequence[Mapping[str, Any]], title: str = "", shown: int = 20) -> Table:
    """Build a table from dictionaries. Columns have the order in which keys first occur."""
    columns = tuple(dict.fromkeys(name for row in rows for name in row))
    return Table(columns, [[row.get(name) for name in columns] for row in rows], title, shown)


def table_of(
    rows: Iterable[Any],
    columns: Mapping[str, str | Callable[[Any], Any]],
    title: str = "",
    shown: int = 20,
    bad: Callable[[Any], Any] | None = None,
) -> Table:
    """Build a table with a row for each record.

    Args:
        rows: records, as mappings.
        columns: for each column heading, the key of the column's value or a function of the record.
        bad: function that returns True for records whose row is to be marked.
    """
    rows = list(rows)
    getters = [itemgetter(get) if isinstance(get, str) else get for get in columns.values()]
    lines = [tuple(get(row) for get in getters) for row in rows]
    marked = frozenset(k for k, row in enumerate(rows) if bad is not None and bad(row))
    return Table(tuple(columns), lines, title, shown, marked)


def pairs(rows: Sequence[tuple[str, Any]], title: str = "") -> Table:
    """Build a table of names and values, without a header row."""
    return Table(("", ""), rows, title, shown=1000)


def cell(value: Any) -> str:
    """Format the value of a table cell as text."""
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return count(int(value))
    if isinstance(value, float | np.floating):
        return number(float(value), 3)
    return typeset(str(value))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


@dataclass(frozen=True)
class Code:
    """A file or a command to copy. On the report page, the text is folded below its title."""

    title: str  # what it is
    text: str  # word for word


@dataclass(frozen=True)
class Series:
    """One set of points of a plot."""

    label: str
    # x, y: equally long; NaN leaves a gap
    x: np.ndarray
    y: np.ndarray
    mark: Mark = "line"
    role: Role = "first"  # its color
    dashed: bool = False  # for what is expected rather than measured


#: Roles of lines, in drawing order.
ROLES: tuple[Role, ...] = ("first", "second", "third", "bad", "ink", "muted")


def positive(values: np.ndarray) -> np.ndarray:
    """Return values with NaN in place of values that a logarithmic axis cannot show."""
    values = np.asarray(values, float)
    return np.where(np.isfinite(values) & (values > 0), values, np.nan)


def curves(
    x: np.ndarray, lines: Mapping[str, np.ndarray], mark: Mark = "line", log: bool = True
) -> tuple[Series, ...]:
    """Build a plot series for each line. The position of a line in `lines` determines its style.

    Args:
        x: positions shared by all lines.
        lines: values of each line, by label.
        log: True for a logarithmic axis; values ≤ 0 are left out, and so are lines with only such values.
    """
    if log:
        lines = {label: positive(y) for label, y in lines.items() if np.any(np.nan_to_num(y) > 0)}
    return tuple(
        Series(label, x, y, mark, ROLES[k % len(ROLES)], dashed=k >= len(ROLES))
        for k, (label, y) in enumerate(lines.items())
    )


def points_of(lines: Iterable[tuple[str, str, str, Any, Any]]) -> dict[str, np.ndarray]:
    """Return a table with one row for each point in the figures of a run.

    Args:
        lines: part, curve, label, x and y of each line.
    """
    lines = list(lines)
    parts, curves, labels = (np.array([line[k] for line in lines], dtype=str) for k in range(3))
    sizes = [len(line[3]) for line in lines]
    words = {"part": parts, "curve": curves, "line": labels}
    x, y = (np.concatenate([np.zeros(0), *(line[k] for line in lines)]) for k in (3, 4))
    return {name: np.repeat(column, sizes) for name, column in words.items()} | {"x": x, "y": y}


@dataclass(frozen=True)
class Region:
    """Grid of cells. Each cell has an integer. Each integer stands for a word (such as "stable")."""

    # x, y: centers of the cells, shapes (columns,) and (rows,)
    x: np.ndarray
    y: np.ndarray
    value: np.ndarray  # class of each cell, shape (rows, columns)
    words: tuple[str, ...]  # what each class means, in the order 0, 1, 2, ...
    graded: bool = False  # whether classes are grades of one thing, from none of it on


@dataclass(frozen=True)
class Plot:
    """A figure, described by its data."""

    name: str  # of figures/<name>.svg, unique on its page
    title: str  # what is seen, a phrase
    # x_label, y_label: quantities with their units
    x_label: str
    y_label: str
    series: tuple[Series, ...] = ()
    region: Region | None = None
    x_scale: AxisScale = "linear"
    y_scale: AxisScale = "linear"
    caption: str = ""  # what to see in it; the title by default
    # verticals, horizontals: marked values with a word for each
    verticals: tuple[tuple[float, str], ...] = ()
    horizontals: tuple[tuple[float, str], ...] = ()
    # x_names, y_names: what is at 0, 1, 2, ... of an axis, in words; empty where numbers are meant
    x_names: tuple[str, ...] = ()
    y_names: tuple[str, ...] = ()

    @property
    def alt(self) -> str:
        """Text alternative of the figure, for readers who cannot see it."""
        parts = [f"{self.title}: {self.y_label} against {self.x_label}."]
        for series in self.series:
            y = np.asarray(series.y, float)
            y = y[np.isfinite(y)]
            name = series.label or self.y_label
            if not len(y):
                parts.append(f"{name}: no values.")
            elif y.min() == y.max():
                parts.append(f"{name}: {number(float(y[0]))} throughout.")
            else:
                ends = f"{number(float(y[0]))} at first, {number(float(y[-1]))} at last"
                parts.append(f"{name}: {number(float(y.min()))} to {number(float(y.max()))}, {ends}.")
        if self.region is not None:
            shares = [float(np.mean(self.region.value == at)) for at in range(len(self.region.words))]
            told = (
                f"{word} {100 * share:.0f} %" for word, share in zip(self.region.words, shares, strict=True)
            )
            parts.append(f"Share of the map: {', '.join(told)}.")
        for value, word in (*self.verticals, *self.horizontals):
            parts.append(f"Marked: {word} at {number(float(value))}.")
        return " ".join(parts)


@dataclass(frozen=True)
class Figure:
    """Figure drawn by a function with matplotlib."""

    name: str  # of figures/<name>.svg, unique on its page
    caption: str  # what to see in it
    alt: str  # what it shows, in words and numbers, for who cannot see it
    draw: Callable[[Canvas], None]  # draws into an empty matplotlib figure, in the colors of `figures`
    height: float = 3.0  # inches, of a width of `figures.WIDTH`


#: Content of a section; a text is a paragraph.
Part = Any  # str | Table | Browse | Code | Plot | Figure


@dataclass(frozen=True)
class Section:
    """Section of a page: a heading with its contents, in order."""

    title: str  # also what a finding names that this section shows
    parts: Sequence[Part] = ()  # paragraphs, tables, code, plots and figures
    terminal: bool = False  # whether its tables and text are printed in a terminal too
    level: Literal[2, 3] = 2  # 2, or 3 for a section within the one before


@dataclass(frozen=True)
class Key:
    """A key number at the top of a page, with a label and a note."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Page:
    """Complete page with the result of a command."""

    title: str  # heading
    about: str = ""  # one line below it
    keys: Sequence[Key] = ()  # the numbers in brief
    sections: Sequence[Section] = ()  # in order; findings come before them, provenance after
    system_file: str = ""  # name of the file that says what was run, empty where nothing was
    system: str = ""  # its text
    provenance: Mapping[str, Any] = field(default_factory=dict)  # of the folder
    pictures: Mapping[str, str] = field(default_factory=dict)  # figures that are drawn already, by their name
