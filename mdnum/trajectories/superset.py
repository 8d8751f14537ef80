"""Pairs near their threshold, each looked at again only once it can have flipped.

A list made at one frame holds the pairs within a skin of their threshold, on either side: no other can flip
while the atoms have come less than the skin. Of those, a pair with margin m cannot flip before two atoms have
come |m| between them. An odometer adds up, frame after frame, how far any two atoms can have come:

    the two largest displacements, beside those of the box, + what strain does to the longest distance

and each pair knows the reading at which it is due. Pairs that are not due are not touched.

Displacements are those of the nearest lattice translation, so atoms that a code wraps back into the box
between two frames have not moved far, and the pair's image is followed through it: pairs are measured in
coordinates that follow each atom from the frame at which the list was made. Where what these round could
matter, the number that decides is computed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mdnum.trajectories.lattice import (
    BAND,
    Candidates,
    Participants,
    Placed,
    ReducedLattice,
    SearchLimits,
    binned,
    lattice_vector,
    meet,
)
from mdnum.trajectories.search import Changed, exact_square

#: a skin is meant to last this many frames; shorter than the least, a fresh search is as good
FRAMES, FEWEST = 24.0, 4.0
#: largest skin, as a share of the radius
LARGEST = 0.3
#: a list is kept shorter than this, about
MOST_LISTED = 24_000_000
#: groups of pairs by |margin|, in each batch of a search; a group is passed over until its first pair is due
GROUPS = 64


class Listed(NamedTuple):
    """The pairs of a list."""

    i: Int[np.ndarray, "room"]  # pairs, batch by batch of the search, and by |margin| within a batch
    j: Int[np.ndarray, "room"]
    code: UInt8[np.ndarray, "room"]  # the lattice vector that is added to wrapped j, see `shift_code`
    due: Float[np.ndarray, "room"]  # reading of the odometer at which each pair has to be examined again
    inside: Bool[np.ndarray, "room"]  # the decision on each pair at the last frame

    @classmethod
    def room(cls, pairs: int) -> Listed:
        """Room for so many."""
        return cls(*(np.empty(pairs, kind) for kind in (np.int32, np.int32, np.uint8, np.float32, np.bool_)))


class Groups(NamedTuple):
    """Runs of pairs of a list, of about one |margin| each."""

    start: Int[np.ndarray, "edges"]  # first pair of each group; the last is the number of pairs
    earliest: Float[np.ndarray, "groups"]  # reading before which no pair of the group is due


@dataclass
class Superset:
    """A list in use."""

    skin: float  # no unlisted pair was nearer to its threshold when the list was made, length
    pairs: Listed  # what is listed
    groups: Groups
    home: Int[np.ndarray, "atoms 3"]  # lattice vectors that have been taken off each atom
    gone: float = 0.0  # reading of the odometer, length
    last: float = 0.0  # what the last frame added to it, length

    def serves(self, lattice: ReducedLattice, radius: float, clear: float) -> bool:
        """Whether every pair within `clear` of its threshold is listed, where `radius` is the largest one."""
        # a second image within reach would have a rank, and the list knows the nearest alone
        return self.gone + clear < self.skin and lattice.narrowest >= 2.0 * (radius + self.skin)


@numba.njit(cache=True, nogil=True, inline="always")
def shift_code(n0, n1, n2):
    """Three integers from -1 to 1 as one: no other brings a wrapped atom within half a box's width."""
    return (n0 + 1) * 9 + (n1 + 1) * 3 + (n2 + 1)


def displaced(before: Placed, now: Placed, home: Int[np.ndarray, "atoms 3"], radius: float) -> float:
    """How much nearer or further two atoms at most `radius` apart can have come between two frames, length.

    To home, the lattice vectors taken off each atom, those that atoms were moved by in between are added.
    """
    old, new = before.lattice, now.lattice
    same = old.vectors is new.vectors or np.array_equal(old.vectors, new.vectors)
    strain, stretch = np.eye(3), 0.0
    if not same:
        strain = old.inverse @ np.linalg.inv(new.inverse)
        stretch = float(np.abs(np.linalg.svd(strain, compute_uv=False) - 1.0).max())
    most, second = _displaced(before.positions, now.positions, strain, not same, new, home)
    return float(np.sqrt(most) + np.sqrt(second)) + radius * stretch


@numba.njit(cache=True, nogil=True)
def _displaced(before, now, strain, strained, lattice, home):
    """The two largest squared displacements; counts in home the lattice vectors that atoms were moved by."""
    most, second = 0.0, 0.0
    vectors, inverse, periodic = lattice.vectors, lattice.inverse, lattice.periodic
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


def skin_for(inc: float, radius: float, clear: float, lattice: ReducedLattice, pairs: int) -> float:
    """A skin that lasts, length; 0 where none would last long enough to be worth it.

    Two atoms come by inc in a frame, about so many pairs are inside the radius, and those within clear of it
    must be listed at any time.
    """
    room = min(LARGEST * radius, 0.499999 * lattice.narrowest - radius)
    # a shell of this thickness on either side of the radius holds so many
    room = min(room, radius * MOST_LISTED / (6.0 * max(pairs, 1)))
    if room < FEWEST * inc + clear:
        return 0.0
    return min(room, max(FRAMES * inc, 0.02 * radius) + clear)


def listed(
    placed: Placed, who: Participants, skin: float, pairs: int, spare: Superset | None = None
) -> Superset:
    """A list made at this frame; no direction may repeat so soon that a pair has two images in it.

    About so many pairs are inside; the memory of a spare list, which is not needed any more, is used again.
    """
    radius = who.radius
    atoms, limits = binned(placed, who, radius + skin), SearchLimits.of(who.radii, BAND, skin)
    # twice the inner shell: the outer one holds more
    room = int(pairs * ((1 + skin / radius) ** 3 - (1 - skin / radius) ** 3) * 1.1) + 4096
    held = Listed.room(0) if spare is None else spare.pairs
    if len(held.i) < room:
        held = Listed.room(room)
    batches = atoms.batches()
    start, earliest = np.zeros(len(batches) * GROUPS + 1, np.int64), np.empty(len(batches) * GROUPS)
    found = Candidates.room(0, 4096)
    for at, bins in enumerate(batches):
        _, left = meet(atoms, limits, *bins, found)
        if left > len(found.value):
            found = Candidates.room(0, int(1.2 * left))
            meet(atoms, limits, *bins, found)
        first = at * GROUPS
        count = int(start[first])
        if count + left > len(held.i):
            larger = Listed.room(int(max(1.5, 1.1 * len(batches) / (at + 1)) * (count + left)))
            for old, new in zip(held, larger, strict=True):
                new[:count] = old[:count]
            held = larger
        groups = Groups(start[first : first + GROUPS + 1], earliest[first : first + GROUPS])
        _store(placed.positions, atoms, who.radii, skin, placed.rounding, found, groups, held)
    return Superset(skin, held, Groups(start, earliest), atoms.home)


@numba.njit(cache=True, nogil=True)
def _store(x, atoms, radius, skin, guard, found, of, held):
    """Sort a batch of pairs by |margin|, coarsely: those in later groups are not due for some time."""
    start, value, count, groups = of.start, found.value, found.counts[1], of.earliest.shape[0]
    home, vectors, species = atoms.home, atoms.lattice.vectors, atoms.species
    scale = groups / skin
    several = radius.shape[0] > 1
    cursor = np.zeros(groups + 1, np.int64)
    for k in range(count):
        i, j = found.i_open[k], found.j_open[k]
        reach = radius[species[i], species[j]] if several else radius[0, 0]
        margin = reach - np.sqrt(value[k])
        if abs(margin) <= guard:
            n0, n1, n2 = lattice_vector(found.code[k])
            real = exact_square(x, home, i, j, n0, n1, n2, vectors)
            # with the sign of the decision, whatever the root rounds to
            margin = abs(reach - np.sqrt(real))
            if not real < reach * reach:
                margin = -margin
        value[k] = margin
        cursor[min(groups - 1, np.uint32(abs(margin) * scale)) + 1] += 1
    cursor[0] = start[0]
    for g in range(groups):
        cursor[g + 1] += cursor[g]
        start[g + 1] = cursor[g + 1]
        # rounded down, so that a pair is due too early rather than too late
        of.earliest[g] = g * (skin / groups) - guard - 1e-6 * skin
    for k in range(count):
        margin = abs(value[k])
        g = min(groups - 1, np.uint32(margin * scale))
        at = cursor[g]
        cursor[g] += 1
        n0, n1, n2 = lattice_vector(found.code[k])
        held.i[at], held.j[at], held.code[at] = found.i_open[k], found.j_open[k], shift_code(n0, n1, n2)
        held.due[at] = margin - guard - 1e-6 * skin
        held.inside[at] = not np.signbit(value[k])


def examine(
    superset: Superset, placed: Placed, who: Participants, *, bound: float, horizon: float, guard: float
) -> tuple[Changed, int, float]:
    """Examine the pairs that are due at the odometer's reading, and those that can be nearest.

    Args:
        superset: the list; the atoms' lattice vectors are those at this frame.
        bound: pairs this close are counted, length.
        horizon: the smallest |margin| is known up to here, length.
        guard: how far a distance in following coordinates can be off, length.
    Returns:
        (pairs that flipped, how many are within the bound, the smallest |margin|).
    """
    pairs, frame = superset.pairs, _Frame.of(placed, superset.home, who)
    flip = np.empty(int(superset.groups.start[-1]), np.int64)
    counts, smallest = np.zeros(2, np.int64), np.inf
    slack = 1e-6 * superset.skin + guard
    # mostly the pairs at hand hold the nearest of all; where they may not, those that can be are due too
    seen = max(bound, 0.02 * superset.last)
    for reach in (seen, max(bound, horizon)):
        if smallest <= seen:
            break
        counts[1] = 0
        limit = superset.gone + min(smallest, reach)
        smallest = _evaluate(
            frame, pairs, superset.groups, superset.gone, limit, bound, guard, slack, flip, counts, smallest
        )
    k = flip[: int(counts[0])]
    i, j = pairs.i[k].astype(np.int64), pairs.j[k].astype(np.int64)
    return Changed(i, j, np.zeros(len(k), np.int64), pairs.inside[k]), int(counts[1]), float(smallest)


class _Frame(NamedTuple):
    """What margins are computed from: positions as stored, and less the lattice vectors of home."""

    positions: Float[np.ndarray, "atoms 3"]
    followed: Float[np.ndarray, "atoms 3"]
    shifts: Float[np.ndarray, "codes 3"]
    home: Int[np.ndarray, "atoms 3"]
    vectors: Float[np.ndarray, "3 3"]
    species: Int[np.ndarray, "atoms"]
    radius: Float[np.ndarray, "species species"]
    square: Float[np.ndarray, "species species"]

    @classmethod
    def of(cls, placed: Placed, home: np.ndarray, who: Participants) -> _Frame:
        x, vectors = placed.positions, placed.lattice.vectors
        followed, shifts = np.empty_like(x), np.empty((27, 3))
        _follow(x, home, vectors, followed, shifts)
        return cls(x, followed, shifts, home, vectors, who.species, who.radii, who.squares)


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
def _evaluate(frame, pairs, groups, gone, limit, bound, guard, slack, flip, counts, smallest):
    """Examine the pairs that are due; flips go into `flip`, numbers into (flips, close)."""
    start, earliest, inside = groups.start, groups.earliest, pairs.inside
    x, home, vectors, species = frame.positions, frame.home, frame.vectors, frame.species
    radius, square, followed, shifts = frame.radius, frame.square, frame.followed, frame.shifts
    block = 1024
    chosen, margins, y = np.empty(block + 1, np.uint32), np.empty(block), np.empty((4, block))
    flips, close = counts[0], counts[1]
    # margins up to here are computed from the coordinates as stored: all that are counted or compared
    near = max(bound, smallest) + guard
    for g in range(earliest.shape[0]):
        if earliest[g] > limit:
            continue
        first_due = np.float32(np.inf)
        for begin in range(start[g], start[g + 1], block):
            end = min(begin + block, start[g + 1])
            i_here, j_here, code_here = pairs.i[begin:end], pairs.j[begin:end], pairs.code[begin:end]
            due_here = pairs.due[begin:end]
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
            first_due = min(first_due, _least(due_here))
        earliest[g] = first_due
    counts[0], counts[1] = flips, close
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
