"""Tables that can be sorted, searched and paged in the browser. The tables are readable without a script."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from markupsafe import Markup

from mdnum.report.words import count, number

#: Number of rows that are shown without a script and on paper.
STATIC_ROWS = 20


@dataclass(frozen=True)
class Column:
    """A column of a table that can be searched in the browser."""

    # name, unit: its heading
    name: str
    of: Any  # a value for each row; a pair of them for a "pair"
    # how a value is written and searched. A "count" is whole, and searched as `name:10..20`; a "pair" is two
    # subjects joined by a dash; a "word" is one of `words`, which are searched for; a "ratio" is in rounding
    # bounds, ambiguous at 1 and below; "fixed" has so many decimals, "number" digits
    kind: Literal["count", "pair", "number", "fixed", "word", "text", "ratio"] = "number"
    unit: str = ""
    digits: int = 3
    words: Sequence[str] = ()  # for "word": what values 0, 1, ... are called
    aliases: Sequence[str] = ()  # for "word": what else may be typed for them
    colors: Sequence[str] = ()  # for "word": class of the cell by value
    subject: bool = False  # whether a bare number, or the column's name and a number, is looked for in it

    @property
    def missing(self) -> str:
        """Text shown instead of a missing value."""
        return "∞" if self.kind == "ratio" else "–"

    @property
    def plain(self) -> list[list[Any]]:
        """Values of the column as lists of plain values. None replaces values that are not finite."""
        if self.kind == "pair":
            return [np.asarray(values).astype(int).tolist() for values in self.of]
        values = np.asarray(self.of)
        if self.kind in ("count", "word"):
            return [values.astype(int).tolist()]
        if self.kind == "text":
            return [values.tolist()]
        # more digits than are shown, so that rounding twice shows as rounding once
        kept = self.digits + 3
        return [[float(f"{x:.{kept}g}") if np.isfinite(x) else None for x in values.astype(float).tolist()]]

    def text(self, row: Sequence[Any], at: int) -> str:
        """Return the text of a table cell, from its row and the index of its value."""
        value = row[at]
        if self.kind == "pair":
            return f"{value}–{row[at + 1]}"
        if value is None:
            return self.missing
        if self.kind == "word":
            return str(self.words[value])
        if self.kind == "count":
            return count(value)
        return number(value, self.digits) if self.kind in ("number", "ratio") else str(value)


@dataclass(frozen=True)
class Browse:
    """A table that can be sorted, searched and paged in the browser."""

    name: str  # id of the table
    noun: str  # what is searched, in the plural
    placeholder: str  # examples of what can be searched for
    columns: Sequence[Column]

    @cached_property
    def placed(self) -> list[tuple[int, Column]]:
        """Columns of the table, each with its index in a row."""
        places = np.cumsum([0, *(1 + (column.kind == "pair") for column in self.columns)]).tolist()
        return list(zip(places, self.columns, strict=False))

    @cached_property
    def rows(self) -> list[list[Any]]:
        """Rows of the table as plain values. None replaces unknown values."""
        return [list(row) for row in zip(*(each for one in self.columns for each in one.plain), strict=True)]

    def is_ambiguous(self, row: Sequence[Any]) -> bool:
        """Return True if a row is marked as ambiguous."""
        at = self.search["ambiguous"]
        return at is not None and row[at] is not None and row[at] <= 1

    @cached_property
    def search(self) -> dict[str, Any]:
        """Keywords for the search box, each with the column to search."""
        found: dict[str, Any] = {"words": {}, "ranges": {}, "subjects": [], "nouns": [], "ambiguous": None}
        for at, one in self.placed:
            if one.kind == "word":
                for words in (one.words, one.aliases):
                    found["words"] |= {word.lower(): [at, value] for value, word in enumerate(words) if word}
            if one.kind == "count":
                found["ranges"][one.name] = at
            if one.kind == "pair" or one.subject:
                found["subjects"] += [at, at + 1] if one.kind == "pair" else [at]
                found["nouns"] += ["atom", "pair"] if one.kind == "pair" else [one.name]
            if one.kind == "ratio":
                found["ambiguous"] = at
        return found

    @property
    def spec(self) -> Markup:
        """Description of the table in JSON, for the script on the page."""
        columns = [
            {
                "at": at, "kind": "number" if one.kind == "ratio" else one.kind, "digits": one.digits,
                "words": one.words, "colors": one.colors, "missing": one.missing,
            }
            for at, one in self.placed
        ]  # fmt: skip
        return _script_safe({"rows": f"{self.name}-rows", "columns": columns, **self.search})

    @property
    def json(self) -> Markup:
        """Rows of the table, as JSON for a script element."""
        return _script_safe(self.rows)


def _script_safe(value: Any) -> Markup:
    """Return JSON text in which "</script>" is harmless."""
    return Markup(json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"))
