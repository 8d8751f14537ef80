"""What a demonstration gives back: its numbers, the checks they passed, tables, plots and a conclusion.

Plots are declared, not drawn: the report draws them, and nothing here needs a plotting library.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

Scale = Literal["linear", "log", "symlog"]
Mark = Literal["line", "points", "steps", "line+points"]


@dataclass(frozen=True)
class Check:
    """A statement of the demonstration that was tested while it ran.

    Attributes:
        what: the statement, in words.
        seen: the number or word that was found.
        expected: what it was held against, in words ("0.0009765625", "below 1e-12").
        ok: whether it held.
    """

    what: str
    seen: Any
    expected: str
    ok: bool


@dataclass(frozen=True)
class Table:
    """Rows of plain values under named columns."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]


@dataclass(frozen=True)
class Series:
    """One set of points of a plot.

    Attributes:
        x, y: equally long; NaN leaves a gap.
        role: color: "first", "second", "third", "bad" or "muted".
        dashed: for what is expected rather than measured.
    """

    label: str
    x: np.ndarray
    y: np.ndarray
    mark: Mark = "line"
    role: Literal["first", "second", "third", "bad", "muted", "ink"] = "first"
    dashed: bool = False


@dataclass(frozen=True)
class Region:
    """A map over a grid: small integers with a word for each (a stability map, say).

    Attributes:
        x, y: centers of the cells, shapes (columns,) and (rows,).
        value: class of each cell, shape (rows, columns).
        words: what each class means, in the order 0, 1, 2, ...
    """

    x: np.ndarray
    y: np.ndarray
    value: np.ndarray
    words: tuple[str, ...]


@dataclass(frozen=True)
class Plot:
    """One panel of a figure.

    Attributes:
        title: what a screen reader says, and the panel's heading.
        caption: what to see in it, one or two sentences.
        verticals, horizontals: marked values with a word for each.
    """

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...] = ()
    region: Region | None = None
    x_scale: Scale = "linear"
    y_scale: Scale = "linear"
    caption: str = ""
    verticals: tuple[tuple[float, str], ...] = ()
    horizontals: tuple[tuple[float, str], ...] = ()


@dataclass(frozen=True)
class Demo:
    """The outcome of one demonstration.

    Attributes:
        name: such as "sum-order".
        title: a short heading.
        question: what it asks, one sentence.
        answer: what it shows, one to three sentences, with its numbers in words.
        numbers: the numbers it must show, plain values by name; the first is the headline.
        checks: statements tested while it ran.
        in_md: the counterpart in molecular dynamics, one sentence.
        data: more plain values for `--json` (histories and the like).
    """

    name: str
    title: str
    question: str
    answer: str
    numbers: Mapping[str, Any]
    checks: Sequence[Check]
    tables: Sequence[Table] = ()
    plots: Sequence[Plot] = ()
    in_md: str = ""
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether every check held."""
        return all(check.ok for check in self.checks)
