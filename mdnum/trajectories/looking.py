"""A look at the pairs of a list that are due.

Pairs are measured in coordinates that follow each atom from the frame at which the list was made, so that the
image of a pair stays what it was. Where what these round could matter, the number that decides is computed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.trajectories.binned import Sides
from mdnum.trajectories.lattice import Lattice
from mdnum.trajectories.pairs import exact_square
from mdnum.trajectories.superset import Superset


@dataclass(frozen=True)
class Looked:
    """What the pairs that were due turned out to be.

    Attributes:
        i, j: of the pairs that flipped.
        entered: what they became.
        close: pairs within the bound of their threshold.
        smallest: smallest |margin|; at least the horizon where it is not known.
        count: pairs that were looked at.
    """

    i: Int[np.ndarray, "flips"]
    j: Int[np.ndarray, "flips"]
    entered: Bool[np.ndarray, "flips"]
    close: int
    smallest: float
    count: int


def look(
    superset: Superset,
    positions: Float[np.ndarray, "atoms 3"],
    lattice: Lattice,
    sides: Sides,
    radii: Float[np.ndarray, "species species"],
    *,
    bound: float,
    horizon: float,
    guard: float,
) -> Looked:
    """Look at the pairs that are due at the odometer's reading, and at those that can be nearest.

    Args:
        superset: the list; the atoms' lattice vectors are those at this frame.
        bound: pairs this close are counted, length.
        horizon: the smallest |margin| is known up to here, length.
        guard: how far a distance in following coordinates can be off, length.
    """
    followed, shifts = np.empty_like(positions), np.empty((27, 3))
    _follow(positions, superset.home, lattice.vectors, followed, shifts)
    flip = np.empty(superset.pairs, np.int64)
    chosen, margins, tally = np.empty(1025, np.uint32), np.empty(1024), np.zeros(3, np.int64)
    square = np.where(radii >= 0, radii * radii, -1.0)
    slack = 1e-6 * superset.skin + guard
    smallest = np.inf
    # mostly the pairs at hand hold the nearest of all; where they may not, those that can be are due too
    seen = max(bound, 0.02 * superset.last)
    for reach in (seen, max(bound, horizon)):
        if smallest <= seen:
            break
        tally[1] = 0
        smallest = _evaluate(
            positions, followed, shifts, superset.home, lattice.vectors, sides.species, radii, square,
            superset.i, superset.j, superset.code, superset.due, superset.inside,
            superset.start, superset.earliest, superset.gone, superset.gone + min(smallest, reach),
            bound, guard, slack, chosen, margins, flip, tally, smallest,
        )  # fmt: skip
    k = flip[: int(tally[0])]
    return Looked(
        superset.i[k].astype(np.int64), superset.j[k].astype(np.int64), superset.inside[k],
        int(tally[1]), float(smallest), int(tally[2]),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _follow(x, home, vectors, followed, shifts):
    """Coordinates less the lattice vectors that were taken off, and the vector of each `shift_code`."""
    for i in range(x.shape[0]):
        h0, h1, h2 = home[i, 0], home[i, 1], home[i, 2]
        for c in range(3):
            followed[i, c] = x[i, c] - (h0 * vectors[0, c] + h1 * vectors[1, c] + h2 * vectors[2, c])
    for code in range(27):
        for c in range(3):
            shifts[code, c] = (
                (code // 9 - 1) * vectors[0, c]
                + (code // 3 % 3 - 1) * vectors[1, c]
                + (code % 3 - 1) * vectors[2, c]
            )


@numba.njit(cache=True, nogil=True)
def _evaluate(
    x, followed, shifts, home, vectors, species, radius, square, i, j, code, due, inside, start, earliest,
    gone, limit, bound, guard, slack, chosen, margins, flip, tally, smallest,
):  # fmt: skip
    """Look at the pairs that are due; flips go into `flip`, counts into tally = (flips, close, looked at)."""
    block = margins.shape[0]
    flips, close, looked = tally[0], tally[1], tally[2]
    y = np.empty((4, block))
    # margins up to here are computed from the coordinates as stored: all that are counted or compared
    near = max(bound, smallest) + guard
    for g in range(earliest.shape[0]):
        if earliest[g] > limit:
            continue
        first_due = np.float32(np.inf)
        for begin in range(start[g], start[g + 1], block):
            end = min(begin + block, start[g + 1])
            i_here, j_here, code_here, due_here = i[begin:end], j[begin:end], code[begin:end], due[begin:end]
            kept = _due(due_here, limit, chosen)
            _measured(chosen[:kept], i_here, j_here, code_here, followed, shifts, species, radius, y, margins)
            for m in range(kept):
                k = chosen[m]
                margin = abs(margins[m])
                due_here[k] = gone + margin - slack
                if margin > near and (margins[m] > 0) == inside[begin + k]:
                    continue
                a, b, s = i_here[k], j_here[k], np.int64(code_here[k])
                real = exact_square(x, home, a, b, s // 9 - 1, s // 3 % 3 - 1, s % 3 - 1, vectors)
                margin = abs(radius[species[a], species[b]] - np.sqrt(real))
                yes = real < square[species[a], species[b]]
                if margin < smallest:
                    smallest = margin
                    near = max(bound, smallest) + guard
                close += int(margin <= bound)
                if yes != inside[begin + k]:
                    inside[begin + k] = yes
                    flip[flips] = begin + k
                    flips += 1
            looked += kept
            first_due = min(first_due, _least(due_here))
        earliest[g] = first_due
    tally[0], tally[1], tally[2] = flips, close, looked
    return smallest


@numba.njit(cache=True, nogil=True, inline="never")
def _due(due, limit, chosen):
    """Which pairs of a block are due, and how many."""
    kept = 0
    for k in range(due.shape[0]):
        chosen[kept] = k
        kept += int(due[k] <= limit)
    return kept


@numba.njit(cache=True, nogil=True, inline="never")
def _measured(chosen, i, j, code, followed, shifts, species, radius, y, margins):
    """Margins of the chosen pairs in following coordinates; gathered first, so that the rest vectorizes."""
    y0, y1, y2, reach = y[0], y[1], y[2], y[3]
    several = radius.shape[0] > 1
    for m in range(chosen.shape[0]):
        k = chosen[m]
        a, b, s = np.uint32(i[k]), np.uint32(j[k]), code[k]
        y0[m] = followed[b, 0] - followed[a, 0] + shifts[s, 0]
        y1[m] = followed[b, 1] - followed[a, 1] + shifts[s, 1]
        y2[m] = followed[b, 2] - followed[a, 2] + shifts[s, 2]
        reach[m] = radius[species[a], species[b]] if several else radius[0, 0]
    for m in range(chosen.shape[0]):
        margins[m] = reach[m] - np.sqrt(y0[m] * y0[m] + y1[m] * y1[m] + y2[m] * y2[m])


@numba.njit(cache=True, nogil=True, inline="never")
def _least(due):
    # sixteen at once: a single minimum waits for the one before
    held = np.full(16, np.float32(np.inf))
    whole = due.shape[0] // 16 * 16
    for k in range(0, whole, 16):
        for c in range(16):
            value = due[k + c]
            held[c] = value if value < held[c] else held[c]
    least = np.float32(np.inf)
    for c in range(16):
        least = min(least, held[c])
    for k in range(whole, due.shape[0]):
        least = min(least, due[k])
    return least
