"""Fewer points that look the same: lines keep every peak, points keep every place."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

#: Bins across a figure; a screen has not many more pixels there.
BINS = 700
#: Markers that a figure carries; more of them make a page heavy and nothing clearer.
MARKS = 1500


def line(
    x: Float[np.ndarray, "points"], y: Float[np.ndarray, "points"], bins: int = BINS
) -> Int[np.ndarray, "kept"]:
    """Which points of a line to keep: at most four a bin (first, lowest, highest, last), gaps kept.

    Args:
        x: in the space of the axis (logarithms where it is logarithmic), NaN for a gap.
        y: likewise.
    """
    if len(x) <= 4 * bins:
        return np.arange(len(x))
    gap = ~(np.isfinite(x) & np.isfinite(y))
    inside = x[~gap]
    if not len(inside) or inside[-1] == inside[0] or np.any(np.diff(inside) < 0):
        # it doubles back: only equal neighbors can go
        return np.flatnonzero(np.r_[True, (np.diff(x) != 0) | (np.diff(y) != 0)])
    place = np.zeros(len(x), int)
    place[~gap] = ((inside - inside[0]) / (inside[-1] - inside[0]) * bins).astype(int)
    # a gap, and each side of one, is a group of its own
    key = 2 * np.cumsum(np.r_[False, gap[1:] != gap[:-1]]) * (bins + 2) + place
    starts = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    ends = np.append(starts[1:], len(x))
    filled = np.where(gap, 0.0, y)
    chosen = [starts, ends - 1]
    group = np.repeat(np.arange(len(starts)), ends - starts)
    # lexsort puts the lowest of each group first and the highest last
    order = np.lexsort((filled, group))
    chosen += [order[starts], order[ends - 1]]
    return np.unique(np.concatenate(chosen))


def points(
    x: Float[np.ndarray, "points"], y: Float[np.ndarray, "points"], bins: int = BINS
) -> Int[np.ndarray, "kept"]:
    """Which points to keep: one for each place of a fine grid that has any.

    Args:
        x, y: in the space of the axes.
    """
    finite = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(finite) <= bins:
        return finite
    # which of a cell's points stays is drawn by lot, or the grid would show
    finite = np.random.default_rng(0).permutation(finite)
    cells = bins / 2
    while True:
        place = np.zeros(len(finite), np.int64)
        for values in (x[finite], y[finite]):
            low, span = values.min(), float(np.ptp(values))
            place = place * (bins + 1) + ((values - low) / (span or 1.0) * cells).astype(np.int64)
        _, first = np.unique(place, return_index=True)
        # a curve stays a curve; a cloud that fills the figure gets a coarser grid
        if len(first) <= MARKS:
            return finite[np.sort(first)]
        cells *= 0.7
