"""Tables that can be sorted, searched and paged in the browser, and read without a script."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from markupsafe import Markup

from mdnum.report.words import count, number

#: Rows that are there without a script, and on paper.
STATIC_ROWS = 20


@dataclass(frozen=True)
class Column:
    """A column as it is shown.

    Attributes:
        at: where in a row its value is; it is sorted by.
        kind: how the value is written. "pair" joins it and the next with a dash; "word" takes
            `words`, by value.
        words: for "word": what values 0, 1, ... are called.
        colors: for "word": class of the cell by value.
        missing: what stands for no value.
    """

    at: int
    name: str
    unit: str = ""
    kind: Literal["count", "pair", "number", "fixed", "word", "text"] = "number"
    digits: int = 3
    words: tuple[str, ...] = ()
    colors: tuple[str, ...] = ()
    missing: str = "–"

    def text(self, row: Sequence[Any]) -> str:
        """What the cell of a row says."""
        value = row[self.at]
        if self.kind == "pair":
            return f"{value}–{row[self.at + 1]}"
        if value is None:
            return self.missing
        if self.kind == "word":
            return self.words[value]
        if self.kind == "count":
            return count(value)
        return number(value, self.digits) if self.kind == "number" else str(value)

    def color(self, row: Sequence[Any]) -> str:
        """Class of the cell of a row."""
        return self.colors[row[self.at]] if self.colors else ""


@dataclass(frozen=True)
class Browse:
    """A table and what can be asked of it.

    Attributes:
        name: id of the table; its rows stand in `<row_id>`.
        rows: plain values, None for what is not known.
        words: word typed into the search box: (column, value) that a row must have.
        ranges: "step" for `step:10..20`: column.
        subjects: columns in which a bare number is looked for; two of them make `3-7` a pair.
        nouns: what may stand before such a number.
        ambiguous: column of a ratio that is ambiguous at 1 and below.
    """

    name: str
    row_id: str
    columns: tuple[Column, ...]
    rows: Sequence[Sequence[Any]]
    placeholder: str = ""
    label: str = "Search"
    words: Mapping[str, tuple[int, Any]] = field(default_factory=dict)
    ranges: Mapping[str, int] = field(default_factory=dict)
    subjects: tuple[int, ...] = ()
    nouns: tuple[str, ...] = ()
    ambiguous: int | None = None

    @property
    def static(self) -> Sequence[Sequence[Any]]:
        """The rows that are there without a script."""
        return self.rows[:STATIC_ROWS]

    def is_ambiguous(self, row: Sequence[Any]) -> bool:
        """Whether a row is marked."""
        return self.ambiguous is not None and row[self.ambiguous] is not None and row[self.ambiguous] <= 1

    @property
    def spec(self) -> str:
        """What the script has to know."""
        return script_safe(
            {
                "rows": self.row_id,
                "columns": [
                    {
                        "at": column.at, "kind": column.kind, "digits": column.digits,
                        "words": column.words, "colors": column.colors, "missing": column.missing,
                    }
                    for column in self.columns
                ],
                "words": {word: list(value) for word, value in self.words.items()},
                "ranges": dict(self.ranges),
                "subjects": self.subjects,
                "nouns": self.nouns,
                "ambiguous": self.ambiguous,
            }
        )  # fmt: skip

    @property
    def json(self) -> Markup:
        """The rows, for a script element."""
        return script_safe(self.rows)


def script_safe(value: Any) -> Markup:
    """JSON that can stand in a script element: "</script>" inside a string would end it."""
    return Markup(json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"))


def plain_rows(columns: Sequence[tuple[np.ndarray, int | None]]) -> list[list[Any]]:
    """Rows of plain values from arrays.

    Args:
        columns: (values, significant digits to keep, or None for what is whole or text).
    """
    lists = [
        values.tolist() if digits is None else [_short(value, digits) for value in values.tolist()]
        for values, digits in columns
    ]
    return [list(row) for row in zip(*lists, strict=True)]


def _short(value: float, digits: int) -> float | None:
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None
