"""Pairs near their threshold, each looked at again only once it can have flipped.

A list made at one frame holds the pairs within a skin of their threshold, on either side: no other can flip
while the atoms have come less than the skin. Of those, a pair with margin m cannot flip before two atoms have
come |m| between them. An odometer adds up, frame after frame, how far any two atoms can have come:

    the two largest displacements, beside those of the box, + what strain does to the longest distance

and each pair knows the reading at which it is due. Pairs that are not due are not touched.

Displacements are those of the nearest lattice translation, so atoms that a code wraps back into the box
between two frames have not moved far, and the pair's image is followed through it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.trajectories.bins import lattice_vector
from mdnum.trajectories.candidates import BAND
from mdnum.trajectories.lattice import Lattice
from mdnum.trajectories.pairs import Found, Sides, exact_square, search

#: a skin is meant to last this many frames; shorter than the least, a fresh search is as good
FRAMES, FEWEST = 24.0, 4.0
#: largest skin, as a share of the radius
LARGEST = 0.3
#: a list is kept shorter than this, about
MOST_LISTED = 24_000_000
#: groups of pairs by |margin|; a group is passed over until its first pair is due
GROUPS = 64


@dataclass
class Superset:
    """A list in use.

    Attributes:
        skin: no unlisted pair was nearer to its threshold when the list was made, length.
        gone: reading of the odometer, length.
        found: pairs, and the lattice vectors that have been taken off each atom.
        due: reading at which each pair has to be looked at again.
        inside: the decision on each pair at the last frame.
        start: first pair of each group.
        earliest: reading before which no pair of the group is due.
    """

    skin: float
    found: Found
    due: Float[np.ndarray, "pairs"]
    inside: Bool[np.ndarray, "pairs"]
    start: Int[np.ndarray, "edges"]
    earliest: Float[np.ndarray, "groups"]
    gone: float = 0.0
    last: float = field(default=0.0)

    def serves(self, reading: float, lattice: Lattice, radius: float, clear: float) -> bool:
        """Whether every pair within `clear` of its threshold is in the list at this reading.

        Args:
            reading: of the odometer.
            lattice: of the frame.
            radius: largest one, length.
            clear: length.
        """
        # a second image within reach would have a rank, and the list knows the nearest alone
        return reading + clear < self.skin and lattice.narrowest >= 2.0 * (radius + self.skin)


@numba.njit(cache=True, nogil=True)
def _displaced(before, now, strain, strained, vectors, inverse, periodic, home):
    """The two largest squared displacements; counts in home the lattice vectors that atoms were moved by."""
    most, second = 0.0, 0.0
    for i in range(now.shape[0]):
        if strained:
            y0 = now[i, 0] - (
                before[i, 0] * strain[0, 0] + before[i, 1] * strain[1, 0] + before[i, 2] * strain[2, 0]
            )
            y1 = now[i, 1] - (
                before[i, 0] * strain[0, 1] + before[i, 1] * strain[1, 1] + before[i, 2] * strain[2, 1]
            )
            y2 = now[i, 2] - (
                before[i, 0] * strain[0, 2] + before[i, 1] * strain[1, 2] + before[i, 2] * strain[2, 2]
            )
        else:
            y0, y1, y2 = now[i, 0] - before[i, 0], now[i, 1] - before[i, 1], now[i, 2] - before[i, 2]
        square = y0 * y0 + y1 * y1 + y2 * y2
        if square > second:
            # rarely: most atoms move less than the fastest two, and are not asked whether they were wrapped
            for k in range(3):
                if periodic[k]:
                    n = np.rint(y0 * inverse[0, k] + y1 * inverse[1, k] + y2 * inverse[2, k])
                    if n != 0.0:
                        y0 -= n * vectors[k, 0]
                        y1 -= n * vectors[k, 1]
                        y2 -= n * vectors[k, 2]
                        home[i, k] += np.int64(n)
            square = y0 * y0 + y1 * y1 + y2 * y2
            if square > most:
                most, second = square, most
            elif square > second:
                second = square
    return most, second


def displaced(
    before: Float[np.ndarray, "atoms 3"],
    old: Lattice,
    now: Float[np.ndarray, "atoms 3"],
    new: Lattice,
    home: Int[np.ndarray, "atoms 3"],
    radius: float,
) -> float:
    """How much nearer or further two atoms at most `radius` apart can have come between two frames, length.

    Args:
        home: lattice vectors taken off each atom; those that atoms were moved by in between are added.
        radius: length.
    """
    same = old.vectors is new.vectors or np.array_equal(old.vectors, new.vectors)
    strain, stretch = np.eye(3), 0.0
    if not same:
        strain = old.inverse @ np.linalg.inv(new.inverse)
        sizes = np.linalg.svd(strain, compute_uv=False)
        stretch = float(np.abs(sizes - 1.0).max())
    most, second = _displaced(
        before, now, strain, not same, new.vectors, new.inverse, new.periodic, home
    )  # fmt: skip
    return float(np.sqrt(most) + np.sqrt(second)) + radius * stretch


def skin_for(inc: float, radius: float, clear: float, lattice: Lattice, pairs: int) -> float:
    """A skin that lasts, length; 0 where none would last long enough to be worth it.

    Args:
        inc: how far two atoms come in a frame, length.
        radius: largest one, length.
        clear: what the list must hold at any time, length.
        lattice: of the frame.
        pairs: inside.
    """
    room = min(LARGEST * radius, 0.499999 * lattice.narrowest - radius)
    # a shell of this thickness on either side of the radius holds so many
    room = min(room, radius * MOST_LISTED / (6.0 * max(pairs, 1)))
    if room < FEWEST * inc + clear:
        return 0.0
    return min(room, max(FRAMES * inc, 0.02 * radius) + clear)


def listed(
    positions: Float[np.ndarray, "atoms 3"],
    lattice: Lattice,
    sides: Sides,
    radii: Float[np.ndarray, "species species"],
    skin: float,
    *,
    bound: float,
    guard: float,
    clear: float,
    room: int = 0,
) -> Superset:
    """A list made at this frame; arguments as of `pairs.search`, and what it must always hold, length."""
    found = search(
        positions, lattice, sides, radii, BAND,
        band=skin, bound=bound, guard=guard, narrow=clear, open_room=room,
    )  # fmt: skip
    shape = len(found.i)
    i, j, code = (np.empty(shape, np.int32) for _ in range(3))
    due, inside, start = (
        np.empty(shape, np.float32),
        np.empty(shape, np.bool_),
        np.zeros(GROUPS + 1, np.int64),
    )
    _group(found.i, found.j, found.code, found.value, skin, start, i, j, code, due, inside)
    found = replace(found, i=i, j=j, code=code, value=found.value[:0])
    earliest = np.arange(GROUPS) * (skin / GROUPS) - 1e-6 * skin
    return Superset(skin, found, due, inside, start, earliest)


@numba.njit(cache=True, nogil=True)
def _group(i_in, j_in, code_in, value, skin, start, i, j, code, due, inside):
    """Sort pairs by |margin|, coarsely: those in later groups are not due for some time."""
    groups = start.shape[0] - 1
    scale = groups / skin
    for k in range(value.shape[0]):
        start[min(groups - 1, int(abs(value[k]) * scale)) + 1] += 1
    for g in range(groups):
        start[g + 1] += start[g]
    cursor = start[:-1].copy()
    for k in range(value.shape[0]):
        margin = abs(value[k])
        g = min(groups - 1, int(margin * scale))
        at = cursor[g]
        cursor[g] += 1
        i[at], j[at], code[at] = i_in[k], j_in[k], code_in[k]
        # rounded down, so that a pair is due too early rather than too late
        due[at] = margin - 1e-6 * skin
        inside[at] = not np.signbit(value[k])


@numba.njit(cache=True, nogil=True)
def _evaluate(
    x, home, vectors, species, radius, square, i, j, code, due, inside, start, earliest,
    gone, limit, bound, slack, chosen, flip, tally, smallest,
):  # fmt: skip
    """Look at the pairs that are due; flips go into `flip`, counts into tally = (flips, close, looked at)."""
    block = chosen.shape[0]
    flips, close, looked = tally[0], tally[1], tally[2]
    for g in range(earliest.shape[0]):
        if earliest[g] > limit:
            continue
        for begin in range(start[g], start[g + 1], block):
            kept = 0
            for k in range(begin, min(begin + block, start[g + 1])):
                chosen[kept] = k
                kept += int(due[k] <= limit)
            for m in range(kept):
                k = chosen[m]
                a, b = i[k], j[k]
                n0, n1, n2 = lattice_vector(code[k])
                real = exact_square(x, home, a, b, n0, n1, n2, vectors)
                margin = abs(radius[species[a], species[b]] - np.sqrt(real))
                yes = real < square[species[a], species[b]]
                smallest = min(smallest, margin)
                close += int(margin <= bound)
                due[k] = gone + margin - slack
                if yes != inside[k]:
                    inside[k] = yes
                    flip[flips] = k
                    flips += 1
            looked += kept
    tally[0], tally[1], tally[2] = flips, close, looked
    return smallest


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
) -> Looked:
    """Look at the pairs that are due at the odometer's reading, and at those that can be nearest."""
    found = superset.found
    flip = np.empty(len(found.i), np.int64)
    chosen, tally = np.empty(1024, np.int64), np.zeros(3, np.int64)
    square, slack = np.where(radii >= 0, radii * radii, -1.0), 1e-6 * superset.skin
    smallest = np.inf
    # mostly the pairs at hand hold the nearest of all; where they may not, those that can be are due too
    seen = max(bound, 0.02 * superset.last)
    for reach in (seen, max(bound, horizon)):
        if smallest <= seen:
            break
        tally[1] = 0
        smallest = _evaluate(
            positions, found.home, lattice.vectors, sides.species, radii, square,
            found.i, found.j, found.code, superset.due, superset.inside, superset.start, superset.earliest,
            superset.gone, superset.gone + min(smallest, reach), bound, slack, chosen, flip, tally, smallest,
        )  # fmt: skip
    k = flip[: int(tally[0])]
    return Looked(
        found.i[k].astype(np.int64), found.j[k].astype(np.int64), superset.inside[k],
        int(tally[1]), float(smallest), int(tally[2]),
    )  # fmt: skip
