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

from dataclasses import dataclass, field

import numba
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mdnum.trajectories.binned import Limits, Sides, binned
from mdnum.trajectories.bins import lattice_vector
from mdnum.trajectories.candidates import BAND
from mdnum.trajectories.lattice import Lattice
from mdnum.trajectories.pairs import exact_square

#: a skin is meant to last this many frames; shorter than the least, a fresh search is as good
FRAMES, FEWEST = 24.0, 4.0
#: largest skin, as a share of the radius
LARGEST = 0.3
#: a list is kept shorter than this, about
MOST_LISTED = 24_000_000
#: groups of pairs by |margin|, in each batch of a search; a group is passed over until its first pair is due
GROUPS = 64


@dataclass
class Superset:
    """A list in use.

    Attributes:
        skin: no unlisted pair was nearer to its threshold when the list was made, length.
        i, j: pairs, batch by batch of the search, and by |margin| within a batch.
        code: the lattice vector that is added to wrapped j, see `shift_code`.
        due: reading of the odometer at which each pair has to be looked at again.
        inside: the decision on each pair at the last frame.
        start: first pair of each group; the last is their number.
        earliest: reading before which no pair of the group is due.
        home: lattice vectors that have been taken off each atom.
        gone: reading of the odometer, length.
        last: what the last frame added to it, length.
    """

    skin: float
    i: Int[np.ndarray, "room"]
    j: Int[np.ndarray, "room"]
    code: UInt8[np.ndarray, "room"]
    due: Float[np.ndarray, "room"]
    inside: Bool[np.ndarray, "room"]
    start: Int[np.ndarray, "edges"]
    earliest: Float[np.ndarray, "groups"]
    home: Int[np.ndarray, "atoms 3"]
    gone: float = 0.0
    last: float = field(default=0.0)

    @property
    def pairs(self) -> int:
        """How many are listed."""
        return int(self.start[-1])

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


@numba.njit(cache=True, nogil=True, inline="always")
def shift_code(n0, n1, n2):
    """Three whole numbers from -1 to 1 as one: no other brings a wrapped atom within half a box's width."""
    return (n0 + 1) * 9 + (n1 + 1) * 3 + (n2 + 1)


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
    guard: float,
    pairs: int,
    spare: Superset | None = None,
) -> Superset:
    """A list made at this frame; no direction may repeat so soon that a pair has two images in it.

    Args:
        positions, lattice, sides, radii, guard: as of `pairs.search`.
        skin: length.
        pairs: inside, about.
        spare: a list that is not needed any more: its memory is used again.
    """
    radius = float(radii.max(initial=0.0))
    placed = binned(positions, lattice, sides, radius + skin, guard)
    limits, square = Limits.of(radii, BAND, skin), np.where(radii >= 0, radii * radii, -1.0)
    # twice the inner shell: the outer one holds more
    room = int(pairs * ((1 + skin / radius) ** 3 - (1 - skin / radius) ** 3) * 1.1) + 4096
    held = [spare.i, spare.j, spare.code, spare.due, spare.inside] if spare is not None else _room(0)
    if len(held[0]) < room:
        held = _room(room)
    batches, none = list(placed.batches()), np.zeros(0, np.int32)
    start = np.zeros(len(batches) * GROUPS + 1, np.int64)
    earliest = np.empty(len(batches) * GROUPS)
    batch, tally = _batch(4096), np.zeros(3, np.int64)
    for at, bins in enumerate(batches):
        _, left = placed.met(limits, bins, tally, none, none, *batch)
        if left > len(batch[0]):
            batch = _batch(int(1.2 * left))
            placed.met(limits, bins, tally, none, none, *batch)
        count = int(start[at * GROUPS])
        if count + left > len(held[0]):
            share = (at + 1) / len(batches)
            larger = _room(int(max(1.5, 1.1 / share) * (count + left)))
            for old, new in zip(held, larger, strict=True):
                new[:count] = old[:count]
            held = larger
        groups = start[at * GROUPS : (at + 1) * GROUPS + 1], earliest[at * GROUPS : (at + 1) * GROUPS]
        arrays = [*batch, *groups, *held]
        _store(
            positions, placed.home, lattice.vectors, sides.species, radii, square, skin, guard, left, *arrays
        )
    i, j, code, due, inside = held
    return Superset(skin, i, j, code, due, inside, start, earliest, placed.home)


def _room(pairs: int) -> list[np.ndarray]:
    return [np.empty(pairs, kind) for kind in (np.int32, np.int32, np.uint8, np.float32, np.bool_)]


def _batch(pairs: int) -> list[np.ndarray]:
    return [np.empty(pairs, kind) for kind in (np.int32, np.int32, np.int32, np.float64)]


@numba.njit(cache=True, nogil=True)
def _store(
    x, home, vectors, species, radius, square, skin, guard, count, i_in, j_in, code_in, value,
    start, earliest, i, j, code, due, inside,
):  # fmt: skip
    """Sort a batch of pairs by |margin|, coarsely: those in later groups are not due for some time.

    value holds squares of wrapped coordinates; start and earliest are those of the batch.
    """
    groups = earliest.shape[0]
    scale = groups / skin
    several = radius.shape[0] > 1
    cursor = np.zeros(groups + 1, np.int64)
    for k in range(count):
        si, sj = (species[i_in[k]], species[j_in[k]]) if several else (0, 0)
        margin = radius[si, sj] - np.sqrt(value[k])
        if abs(margin) <= guard:
            n0, n1, n2 = lattice_vector(code_in[k])
            real = exact_square(x, home, i_in[k], j_in[k], n0, n1, n2, vectors)
            # with the sign of the decision, whatever the root rounds to
            margin = abs(radius[si, sj] - np.sqrt(real))
            if not real < square[si, sj]:
                margin = -margin
        value[k] = margin
        cursor[min(groups - 1, np.uint32(abs(margin) * scale)) + 1] += 1
    cursor[0] = start[0]
    for g in range(groups):
        cursor[g + 1] += cursor[g]
        start[g + 1] = cursor[g + 1]
        # rounded down, so that a pair is due too early rather than too late
        earliest[g] = g * (skin / groups) - guard - 1e-6 * skin
    for k in range(count):
        margin = abs(value[k])
        g = min(groups - 1, np.uint32(margin * scale))
        at = cursor[g]
        cursor[g] += 1
        n0, n1, n2 = lattice_vector(code_in[k])
        i[at], j[at], code[at] = i_in[k], j_in[k], shift_code(n0, n1, n2)
        due[at] = margin - guard - 1e-6 * skin
        inside[at] = not np.signbit(value[k])
