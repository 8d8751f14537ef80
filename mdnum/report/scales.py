"""Axes that take any numbers: zeros on a logarithmic scale, values that differ in their last digits."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from mdnum.report.words import MINUS, number, power

#: Beyond this, there is no room for a margin around the values.
_LARGEST = 1e304
#: Linear values that differ by less than this share of their size are shown as differences.
_NEAR = 1e-5
#: Decades that a symmetric logarithmic axis shows on each side of zero at most.
_DECADES = 18


@dataclass(frozen=True)
class Scale:
    """How the values of one axis are shown.

    Attributes:
        kind: "linear" where a logarithm was asked for and no value has one.
        shift: subtracted from every value, 0 as a rule.
        threshold: symlog: what is smaller is on the linear piece around zero.
        whole: all values are whole numbers.
        lost: values that the scale cannot show, because they are not positive.
        fell_back: a logarithmic scale was asked for in vain.
    """

    kind: Literal["linear", "log", "symlog"]
    shift: float = 0.0
    threshold: float = 1.0
    whole: bool = False
    lost: int = 0
    fell_back: bool = False

    @classmethod
    def choose(cls, wanted: str, values: Iterable[np.ndarray]) -> Scale:
        """The scale for all these values.

        Args:
            wanted: "linear", "log" or "symlog".
            values: arrays, with NaN for what is missing.
        """
        everything = np.concatenate([np.zeros(0), *(clean(part).ravel() for part in values)])
        everything = everything[np.isfinite(everything)]
        size = np.abs(everything)
        if wanted == "log":
            lost = int(np.count_nonzero(everything <= 0))
            if lost < len(everything):
                return cls("log", lost=lost)
            return cls("linear", fell_back=lost > 0)
        if wanted == "symlog":
            if not np.any(size > 0):
                return cls("linear", fell_back=len(size) > 0)
            smallest, largest = size[size > 0].min(), size.max()
            return cls(
                "symlog", threshold=10.0 ** np.floor(np.log10(max(smallest, largest / 10.0**_DECADES)))
            )
        if not len(everything):
            return cls("linear")
        low, high = everything.min(), everything.max()
        whole = bool(np.all(everything == np.round(everything))) and (high - low >= 1 or high == low)
        if 0 < high - low < _NEAR * size.max():
            # a value that is there, so that the difference is exact
            return cls("linear", shift=float(np.sort(everything)[len(everything) // 2]), whole=whole)
        return cls("linear", whole=whole)

    def shown(self, values: np.ndarray) -> np.ndarray:
        """Values as they are plotted: shifted, NaN where the scale has no place for them."""
        values = clean(values) - self.shift
        if self.kind == "log":
            values = np.where(values > 0, values, np.nan)
        return values

    def flat(self, shown: np.ndarray) -> np.ndarray:
        """Plotted values in proportion to their place on the paper."""
        if self.kind == "log":
            return np.log10(shown)
        if self.kind == "symlog":
            scaled = np.abs(shown) / self.threshold
            return np.sign(shown) * np.where(scaled <= 1, scaled, 1 + np.log10(np.maximum(scaled, 1)))
        return shown

    def edges(self, centers: Float[np.ndarray, "cells"]) -> Float[np.ndarray, "edges"]:
        """Edges of cells around plotted centers, halfway between two of them on the paper."""
        flat = np.log10(centers) if self.kind == "log" else centers
        if len(flat) == 1:
            half = 0.5 if self.kind == "log" or flat[0] == 0 else 0.5 * abs(flat[0])
            edges = np.array([flat[0] - half, flat[0] + half])
        else:
            inner = (flat[1:] + flat[:-1]) / 2
            edges = np.r_[2 * flat[0] - inner[0], inner, 2 * flat[-1] - inner[-1]]
        return 10.0**edges if self.kind == "log" else edges

    def label(self, text: str, exponent: int = 0) -> str:
        """The axis' label; a shifted or scaled axis says by how much."""
        if self.shift:
            sign, size = ("+", -self.shift) if self.shift < 0 else (MINUS, self.shift)
            text = f"{text} {sign} {size!r}"
        if not exponent:
            return text
        if text.endswith(")") and " (" in text:
            words, unit = text[:-1].rsplit(" (", 1)
            return f"{words} ({power(exponent)} {unit})"
        return f"{text} ({power(exponent)})"

    def apply(self, axes: Axes, which: Literal["x", "y"]) -> None:
        """Sets the scale; before anything is drawn."""
        setter = axes.set_xscale if which == "x" else axes.set_yscale
        if self.kind == "symlog":
            setter("symlog", linthresh=self.threshold)
        else:
            setter(self.kind)

    def limit(self, axes: Axes) -> None:
        """Keeps the margin above the values of a vertical logarithmic axis from overflowing."""
        top = float(axes.dataLim.y1)
        if self.kind == "log" and top > 1e200:
            low = float(axes.dataLim.minposy)
            axes.set_autoscaley_on(False)
            axes.set_ylim(max(low / 1e10, 1e-300), top * 1e3)

    def ticks(self, axes: Axes, which: Literal["x", "y"], most: int) -> int:
        """Sets ticks; after the limits are final.

        Returns:
            the power of ten that the label has to name, 0 as a rule.
        """
        axis = axes.xaxis if which == "x" else axes.yaxis
        low, high = sorted(axes.get_xlim() if which == "x" else axes.get_ylim())
        axis.set_minor_locator(NullLocator())
        if self.kind == "linear":
            locator = MaxNLocator(
                most, min_n_ticks=1 if self.whole else 2, integer=self.whole, steps=[1, 2, 2.5, 5, 10]
            )
            largest = float(np.max(np.abs(locator.tick_values(low, high)), initial=0.0))
            exponent = int(np.floor(np.log10(largest))) if largest > 0 else 0
            exponent = max(exponent, -300) if exponent < -2 or exponent > 4 else 0
            axis.set_major_locator(locator)
            axis.set_major_formatter(
                FuncFormatter(lambda value, _: f"{value / 10.0**exponent:,.6g}".replace("-", MINUS))
            )
            return exponent
        places = _log_places(low, high, most) if self.kind == "log" else self._signed_places(low, high, most)
        axis.set_major_locator(FixedLocator(places))
        axis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
        return 0

    def _signed_places(self, low: float, high: float, most: int) -> list[float]:
        start = round(np.log10(self.threshold))
        tops = [int(np.floor(np.log10(side))) if side > self.threshold else None for side in (-low, high)]
        below, above = (0 if top is None else top - start + 1 for top in tops)
        stride = _stride(below + above, max(1, most - 1))
        # the same on both sides, and none too near to zero, whose own label needs its place
        sides = [
            [10.0 ** (start + n) for n in range(side) if (start + n) % stride == 0 and n >= stride // 2]
            for side in (below, above)
        ]
        return [*(-place for place in sides[0]), 0.0, *sides[1]]


def clean(values: np.ndarray) -> Float[np.ndarray, "..."]:
    """As float64, NaN for what is infinite or too large to have ticks."""
    values = np.asarray(values)
    values = values.astype(np.float64)
    return np.where(np.abs(values) <= _LARGEST, values, np.nan)


def _log_places(low: float, high: float, most: int) -> list[float]:
    first, last = int(np.ceil(np.log10(low) - 1e-9)), int(np.floor(np.log10(high) + 1e-9))
    if last - first >= 1:
        stride = _stride(last - first + 1, most)
        # at multiples of the stride, as a person would choose them
        places = [10.0**n for n in range(-(-first // stride) * stride, last + 1, stride)]
        if len(places) > 2 or last - first > 2:
            return places
    for factors in ((1, 3), (1, 2, 5), range(1, 10)):
        places = [
            factor * 10.0**n
            for n in range(first - 1, last + 2)
            for factor in factors
            if low <= factor * 10.0**n <= high
        ]
        if len(places) >= 3:
            return places if len(places) <= most + 1 else places[:: len(places) // most + 1]
    return [place for place in MaxNLocator(3).tick_values(low, high) if low <= place <= high and place > 0]


def _stride(decades: int, most: int) -> int:
    """Decades from one tick to the next."""
    return next(stride for stride in (1, 2, 3, 5, 10, 20, 50, 100, 200) if decades <= stride * most)


def _short(value: float) -> str:
    if value == 0:
        return "0"
    size, sign = abs(value), MINUS if value < 0 else ""
    if 0.00099 <= size < 9999:
        return f"{sign}{size:.4g}"
    exponent = int(np.floor(np.log10(size) + 1e-9))
    mantissa = size / 10.0**exponent
    if abs(mantissa - 1) < 1e-6:
        return sign + power(exponent)
    return sign + (f"{mantissa:.3g}×{power(exponent)}" if abs(exponent) > 2 else number(size, 3))
