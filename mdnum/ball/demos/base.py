"""Plots as pages that are not on the frame yet declare them; mdnum.report.section has the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Scale = Literal["linear", "log", "symlog"]
Mark = Literal["line", "points", "steps", "line+points"]


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
