"""Reduction of lattice vectors, bins of atoms, and the search for pairs.

Lattice vectors are reduced first, so that skewed boxes are searched quickly. Pair decisions use the length of
(x_j - x_i) + s_0 a_0 + s_1 a_1 + s_2 a_2, in this order, with i < j. Here, x are stored coordinates, s
integers and a reduced vectors. A pair decision does not depend on the search algorithm.

For a search, the reduced box is divided into bins. Along a nonperiodic direction, the number of bins is
limited. For each bin, the atoms of all nearby bins and their images are gathered. Each atom of the bin is
compared with the gathered atoms.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.compiled import njit
from mdnum.errors import InputError
from mdnum.trajectories.frame import Box

_UNIT_ROUNDOFF = 2.0**-53
# sqrt(volume² / product of lengths²) under which vectors are called dependent
_FLAT = 1e-10
#: repeats of a box along one direction within the cutoff
MOST_IMAGES = 500
#: what a search records: pairs inside; all in reach, from the centers
#: (programs compiled and kept by modules that did not change hold these numbers)
INSIDE, DIRECTED = 0, 2


class ReducedLattice(NamedTuple):
    """Reduced lattice vectors of a box, for compiled neighbor searches."""

    vectors: Float[np.ndarray, "3 3"]  # reduced, as rows, length; zero along directions that do not repeat
    periodic: Bool[np.ndarray, "3"]  # which rows repeat
    inverse: Float[np.ndarray, "3 3"]  # of the vectors completed by normals: x @ inverse are coordinates
    widths: Float[np.ndarray, "3"]  # between opposite faces, length; inf along directions that do not repeat
    combination: Int[np.ndarray, "3 3"]  # vectors = combination @ matrix of the box

    @property
    def narrowest(self) -> float:
        """Smallest width of the box. No lattice vector is shorter."""
        return float(self.widths.min())

    @property
    def volume(self) -> float:
        """Volume of the box. A nonperiodic direction counts as one unit of length."""
        return float(1.0 / abs(np.linalg.det(self.inverse)))

    def rounding(self, largest: float, radius: float) -> float:
        """Return a bound on the rounding error (length) of a distance near `radius`.

        Source: Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., section 3.1.
        """
        combined = np.abs(self.combination).sum(axis=1).max()
        size = largest + float(np.abs(self.vectors).sum()) * max(1.0, float(combined) - 1.0) + radius
        return 16.0 * _UNIT_ROUNDOFF * size


def lattice_of(box: Box) -> ReducedLattice:
    """Return the reduced lattice of a box.

    Raises:
        InputError: a lattice vector of a periodic direction is zero, not finite, or coplanar with the others.
    """
    return _reduced(np.asarray(box.matrix, np.float64).tobytes(), np.asarray(box.pbc, bool).tobytes())


# of most files and loops there are a few
@lru_cache(maxsize=8)
def _reduced(rows: bytes, periodic: bytes) -> ReducedLattice:
    from ase.geometry import complete_cell
    from ase.geometry.minkowski_reduction import minkowski_reduce

    # copies: of what cannot be written, numba would compile every search a second time
    matrix, pbc = np.frombuffer(rows).reshape(3, 3).copy(), np.frombuffer(periodic, bool).copy()
    broken, matrix = Box(matrix, pbc).broken, np.where(pbc[:, None], matrix, 0.0)
    for axis in broken:
        message = f"axis {axis} of the box is periodic, but its vector is {matrix[axis].tolist()}"
        remedy = "Give the frame a box, or make this direction non-periodic"
        raise InputError(message, remedy=remedy, where="box")
    combination, vectors = np.eye(3, dtype=np.int64), matrix
    if pbc.any():
        scaled = matrix[pbc] / np.linalg.norm(matrix[pbc], axis=1)[:, None]
        if not np.sqrt(max(np.linalg.det(scaled @ scaled.T), 0.0)) > _FLAT:
            message = f"the vectors of the box lie in one plane: {matrix[pbc].tolist()}"
            raise InputError(message, remedy="Use the box of the simulation", where="box")
        if np.count_nonzero(matrix) > pbc.sum():
            # a box with right angles is reduced, and stays in its order
            # in the layout of the one above: of another, numba would compile every search a second time
            combination = np.ascontiguousarray(minkowski_reduce(matrix, pbc.tolist())[1], np.int64)
        vectors = np.where(pbc[:, None], combination @ matrix, 0.0)
    inverse = np.linalg.inv(complete_cell(vectors))
    widths = np.where(pbc, 1.0 / np.linalg.norm(inverse, axis=0), np.inf)
    return ReducedLattice(vectors, pbc, inverse, widths, combination)


def shortest(
    moved: Float[np.ndarray, "atoms 3"], box: Box
) -> tuple[Float[np.ndarray, "atoms 3"], Float[np.ndarray, "atoms 3"]]:
    """Return displacements by the minimum-image convention, and the numbers of lattice vectors subtracted.

    Each atom must have moved by less than half the box width. If the box is invalid, displacements are
    returned unchanged.
    """
    try:
        lattice = lattice_of(box)
    except InputError:
        return moved, np.zeros_like(moved)
    whole = np.where(lattice.periodic, np.rint(moved @ lattice.inverse), 0.0)
    return moved - whole @ lattice.vectors, whole


def own_images(lattice: ReducedLattice, radius: float) -> Float[np.ndarray, "images"]:
    """Return squared lengths of lattice vectors up to `radius`. Opposite vectors are counted once."""
    if not lattice.periodic.any() or radius < lattice.narrowest * (1 - 1e-9):
        return np.zeros(0)
    vectors, most = lattice.vectors, np.where(lattice.periodic, radius / lattice.widths + 1, 0).astype(int)
    spans = np.meshgrid(*(np.arange(-n, n + 1) for n in most), indexing="ij")
    # of each two opposite vectors the later one
    x, y, z = (span.reshape(-1, 1)[span.size // 2 + 1 :] for span in spans)
    d = x * vectors[0] + y * vectors[1] + z * vectors[2]
    squares = d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2]
    return np.sort(squares[squares <= radius * radius])


# inlined: a call that takes arrays costs more than what is done here
@njit(inline="always")
def square_of(x, i, j, s0, s1, s2, vectors):
    """Return the squared distance of atom i and an image of atom j (i < j)."""
    if s0 == 0 and s1 == 0 and s2 == 0:
        d0, d1, d2 = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
    else:
        d0 = (x[j, 0] - x[i, 0]) + (s0 * vectors[0, 0] + s1 * vectors[1, 0] + s2 * vectors[2, 0])
        d1 = (x[j, 1] - x[i, 1]) + (s0 * vectors[0, 1] + s1 * vectors[1, 1] + s2 * vectors[2, 1])
        d2 = (x[j, 2] - x[i, 2]) + (s0 * vectors[0, 2] + s1 * vectors[1, 2] + s2 * vectors[2, 2])
    return d0 * d0 + d1 * d1 + d2 * d2


@njit(inline="never")
def near_squares(x, i, j, lattice, y, squares):
    """Compute squared pair distances. `y` is a work array (3, block).

    Lattice vectors are zero along nonperiodic directions, so no branches are needed. Coordinates are gathered
    first, so that all other operations are vector instructions. The lattice vectors are loaded only once.
    """
    vectors, inverse = lattice.vectors, lattice.inverse
    y0, y1, y2 = y[0], y[1], y[2]
    for k in range(i.shape[0]):
        # unsigned: no test for indices from the end
        a, b = np.uint32(i[k]), np.uint32(j[k])
        y0[k], y1[k], y2[k] = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
    v00, v01, v02 = vectors[0, 0], vectors[0, 1], vectors[0, 2]
    v10, v11, v12 = vectors[1, 0], vectors[1, 1], vectors[1, 2]
    v20, v21, v22 = vectors[2, 0], vectors[2, 1], vectors[2, 2]
    r00, r01, r02 = inverse[0, 0], inverse[0, 1], inverse[0, 2]
    r10, r11, r12 = inverse[1, 0], inverse[1, 1], inverse[1, 2]
    r20, r21, r22 = inverse[2, 0], inverse[2, 1], inverse[2, 2]
    for k in range(i.shape[0]):
        s0 = -np.rint(y0[k] * r00 + y1[k] * r10 + y2[k] * r20)
        s1 = -np.rint(y0[k] * r01 + y1[k] * r11 + y2[k] * r21)
        s2 = -np.rint(y0[k] * r02 + y1[k] * r12 + y2[k] * r22)
        d0 = y0[k] + (s0 * v00 + s1 * v10 + s2 * v20)
        d1 = y1[k] + (s0 * v01 + s1 * v11 + s2 * v21)
        d2 = y2[k] + (s0 * v02 + s1 * v12 + s2 * v22)
        squares[k] = d0 * d0 + d1 * d1 + d2 * d2


@njit
def image_square(x, i, j, rank, lattice):
    """Return the squared distance from atom i to an image of atom j. `rank` images are nearer.

    Either i < j, or i == j (opposite images count once). If no image of j has the given rank, the result is
    inf.
    """
    vectors, periodic, widths = lattice.vectors, lattice.periodic, lattice.widths
    # the image that rounding names; nearest where that is near enough
    base = np.zeros(3, np.int64)
    for k in range(3):
        if periodic[k]:
            f = 0.0
            for c in range(3):
                f += (x[j, c] - x[i, c]) * lattice.inverse[c, k]
            base[k] = -np.int64(np.rint(f))
    narrowest = min(widths[0], widths[1], widths[2])
    if narrowest == np.inf:
        return np.inf if rank > 0 or i == j else square_of(x, i, j, 0, 0, 0, vectors)
    best = np.empty(rank + 1)
    span = np.zeros(3, np.int64)
    for k in range(3):
        span[k] = 1 if periodic[k] else 0
    while True:
        best[:] = np.inf
        for s0 in range(base[0] - span[0], base[0] + span[0] + 1):
            for s1 in range(base[1] - span[1], base[1] + span[1] + 1):
                for s2 in range(base[2] - span[2], base[2] + span[2] + 1):
                    if i == j and (s0 < 0 or (s0 == 0 and s1 < 0) or (s0 == 0 and s1 == 0 and s2 <= 0)):
                        continue
                    square = square_of(x, i, j, s0, s1, s2, vectors)
                    place = rank
                    if square < best[place]:
                        while place > 0 and best[place - 1] > square:
                            best[place] = best[place - 1]
                            place -= 1
                        best[place] = square
        # an image not tried is at least (span + 1/2) widths away
        grown = False
        reach = np.sqrt(best[rank])
        for k in range(3):
            if periodic[k] and not reach <= (span[k] + 0.499999) * widths[k]:
                # the vectors are reduced: the nearest of all is among the 27 around the rounded one
                if rank == 0 and i != j and span[k] >= 1:
                    continue
                grown = True
                span[k] = span[k] + 1 if reach == np.inf else np.int64(reach / widths[k] + 0.6)
        if not grown:
            return best[rank]


# ---- who is looked for, and where they are


@dataclass(frozen=True)
class Participants:
    """Atoms to which a membership rule applies, numbered consecutively."""

    labels: Int[np.ndarray, "atoms"]  # their numbers in the file
    centers: Bool[np.ndarray, "atoms"]  # whose neighbors are wanted
    others: Bool[np.ndarray, "atoms"]  # who can be one; the same array as centers where all are on both sides
    species: Int[np.ndarray, "atoms"]  # number of each atom's species
    radii: Float[np.ndarray, "species species"]  # length; negative for pairs that are never inside

    @property
    def radius(self) -> float:
        """Largest cutoff radius of all pairs of species, in length units."""
        return float(self.radii.max(initial=0.0))

    @property
    def squares(self) -> Float[np.ndarray, "species species"]:
        """Squared cutoff radius of each pair of species. Negative if never neighbors."""
        return np.where(self.radii >= 0, self.radii * self.radii, -1.0)

    @property
    def both(self) -> Bool[np.ndarray, "atoms"]:
        """True for atoms that belong to both groups."""
        return self.centers & self.others

    @cached_property
    def kinds(self) -> list[Int[np.ndarray, "some"]]:
        """Groups of atoms with equal species and equal group membership, smallest group first."""
        kind = 4 * self.species + 2 * self.centers + self.others
        return sorted((np.flatnonzero(kind == one) for one in np.unique(kind)), key=len)


@dataclass(frozen=True)
class Placed:
    """Positions and reduced lattice vectors of one frame, for one membership rule."""

    positions: Float[np.ndarray, "atoms 3"]  # as stored, anywhere, length
    lattice: ReducedLattice  # of the box
    rounding: float  # how far a distance can be off through float64, length


class SearchLimits(NamedTuple):
    """Lower and upper limits of squared distances, for each pair of species."""

    kind: int  # `INSIDE` or `DIRECTED`
    low: Float[np.ndarray, "species species"]  # pairs nearer than this are inside for certain
    high: Float[np.ndarray, "species species"]  # pairs further than this are not looked for
    largest: float  # of high

    @classmethod
    def of(cls, radii: Float[np.ndarray, "species species"], kind: int, band: float) -> SearchLimits:
        """Return the squares of the cutoff radii minus `band` and plus `band`."""
        low = np.where(radii >= 0, np.maximum(radii - band, 0.0) ** 2, np.inf)
        high = np.where(radii >= 0, (radii + band) ** 2, -1.0)
        return cls(kind, low, high, float((radii.max(initial=0.0) + band) ** 2))


class Candidates(NamedTuple):
    """Output buffers of a search. Pairs beyond the capacity are only counted."""

    i: Int[np.ndarray, "room"]  # pairs that are inside for certain
    j: Int[np.ndarray, "room"]
    i_open: Int[np.ndarray, "open"]  # pairs that are not
    j_open: Int[np.ndarray, "open"]
    code: Int[np.ndarray, "open"]  # of j's lattice vector, see `lattice_vector`
    value: Float[np.ndarray, "open"]  # squared distance by wrapped coordinates
    counts: Int[np.ndarray, "3"]  # of the first and of the second; the third is free for whoever decides

    @classmethod
    def room(cls, certain: int, open: int) -> Candidates:
        """Allocate buffers for decided pairs and for pairs still to be decided."""
        i, j, i_open, j_open, code = (np.empty(n, np.int32) for n in (certain, certain, open, open, open))
        return cls(i, j, i_open, j_open, code, np.empty(open), np.zeros(3, np.int64))


class Binned(NamedTuple):
    """Atoms of one frame sorted into bins, as input of the search loop."""

    lattice: ReducedLattice  # of the frame
    species: Int[np.ndarray, "atoms"]
    bins: Int[np.ndarray, "3"]  # number along each axis, and how many bins away a pair can be
    reach: Int[np.ndarray, "3"]
    half: bool  # pairs of one set, each met once from one of its atoms
    both: Bool[np.ndarray, "atoms"]  # atoms on both sides
    wrapped: Float[np.ndarray, "atoms 3"]  # positions in the box, length
    home: Int[np.ndarray, "atoms 3"]  # lattice vectors that wrapping took off each atom
    start: Int[np.ndarray, "edges"]  # atoms that can be a neighbor, by bin
    order: Int[np.ndarray, "others"]
    center_start: Int[np.ndarray, "edges"]  # atoms that are asked, by bin: the same arrays where `half`
    center_order: Int[np.ndarray, "centers"]
    sorted_x: Float[np.ndarray, "3 others"]  # wrapped positions in the order of `order`
    atoms: int  # most atoms, and most runs of bins, around a bin
    runs: int


def binned(placed: Placed, who: Participants, reach: float) -> Binned:
    """Sort atoms into bins for pairs up to the distance `reach`.

    Raises:
        InputError: the box is so small that too many images are within `reach`.
    """
    positions, lattice, atoms = placed.positions, placed.lattice, len(placed.positions)
    extent = np.zeros(3)
    if atoms and not lattice.periodic.all():
        extent = np.where(lattice.periodic, 0.0, np.ptp(positions @ lattice.inverse, axis=0))
    bins, away, step = grid_for(lattice, reach + placed.rounding, atoms, extent)
    wrapped, home, bin_of = wrap(positions, lattice, bins, step)
    if (away // bins * lattice.periodic).max() >= MOST_IMAGES - 1:
        message = f"a box of widths {np.round(lattice.widths, 6).tolist()} cannot hold pairs within {reach:g}"
        raise InputError(message, remedy="Check the length units of the cutoff and the box", where="cutoff")
    total, half = int(np.prod(bins)), who.centers is who.others
    start, order = _sorted_by_bin(bin_of, who.others, total)
    first, centers = (start, order) if half else _sorted_by_bin(bin_of, who.centers, total)
    most, runs = _most_around(bins, away, start)
    return Binned(
        lattice, who.species, bins, away, half, who.both, wrapped, home, start, order, first, centers,
        np.ascontiguousarray(wrapped[order].T), most, runs,
    )  # fmt: skip


def grid_for(lattice: ReducedLattice, radius: float, atoms: int, extent: Float[np.ndarray, "3"]):
    """Return the number of bins, the search range and the bin width by axis.

    The number of bins is at most about twice the number of atoms. `extent` is the extent of the atoms along
    nonperiodic axes.
    """
    bins, reach, step = np.ones(3, np.int64), np.ones(3, np.int64), np.ones(3)
    room = max(64.0, 2.0 * atoms)
    safe = radius * (1.0 + 1e-9)
    width = safe
    free = ~lattice.periodic
    while True:
        for k in range(3):
            if lattice.periodic[k]:
                bins[k] = max(1, int(min(lattice.widths[k] / width, 1e6)))
                step[k] = 1.0 / bins[k]
                # no memory holds as many images
                reach[k] = int(min(np.ceil(safe * bins[k] / lattice.widths[k]), 1e9))
            else:
                # three at least, so that no bin is met twice
                bins[k], step[k] = 3 + int(min(extent[k] / safe, 1e6)), safe
        # folding costs nothing, so the free directions give way first
        while np.prod(bins.astype(float)) > room and bins[free].max(initial=0) > 3:
            most = np.argmax(np.where(free, bins, 0))
            bins[most] = max(3, int(bins[most] * 0.8))
        if np.prod(bins.astype(float)) <= room or bins.max() <= 3:
            break
        width *= 1.1
    return bins, reach, step


@njit
def wrap(x, lattice, bins, step):
    """Wrap atoms. Return the wrapped positions, subtracted lattice vectors, and bins."""
    wrapped, home, bin_of = np.empty(x.shape), np.empty(x.shape, np.int64), np.empty(x.shape[0], np.int64)
    vectors, inverse, periodic = lattice.vectors, lattice.inverse, lattice.periodic
    for i in range(x.shape[0]):
        here = 0
        for c in range(3):
            wrapped[i, c] = x[i, c]
        for k in range(3):
            f = x[i, 0] * inverse[0, k] + x[i, 1] * inverse[1, k] + x[i, 2] * inverse[2, k]
            if periodic[k]:
                h = np.floor(f)
                b = np.int64((f - h) * bins[k])
                # a tiny negative coordinate rounds to the far end of the box
                b = min(max(b, 0), bins[k] - 1)
                home[i, k] = np.int64(h)
                if h != 0.0:
                    for c in range(3):
                        wrapped[i, c] -= h * vectors[k, c]
            else:
                g = np.floor(f / step[k])
                b = np.int64(g - bins[k] * np.floor(g / bins[k]))
                b = min(max(b, 0), bins[k] - 1)
                home[i, k] = 0
            here = here * bins[k] + b
        bin_of[i] = here
    return wrapped, home, bin_of


@njit
def _sorted_by_bin(bin_of, chosen, total):
    """Sort atoms by bin. Return the first index of each bin, and the sorted atoms."""
    start = np.zeros(total + 1, np.int64)
    count = 0
    for i in range(bin_of.shape[0]):
        if chosen[i]:
            start[bin_of[i] + 1] += 1
            count += 1
    for b in range(total):
        start[b + 1] += start[b]
    cursor = start[:-1].copy()
    order = np.empty(count, np.int32)
    for i in range(bin_of.shape[0]):
        if chosen[i]:
            order[cursor[bin_of[i]]] = i
            cursor[bin_of[i]] += 1
    return start, order


@njit
def lattice_vector(code):
    """Decode the three integer coefficients of a lattice vector from their code."""
    code = np.int64(code)
    return (code >> 20) - 512, ((code >> 10) & 1023) - 512, (code & 1023) - 512


@njit
def _run(d0, d1, d2, b0, b1, b2, bins, last):
    """Return a row of bins: lattice vector, first bin, last bin, next offset."""
    n0, n1, n2 = (b0 + d0) // bins[0], (b1 + d1) // bins[1], (b2 + d2) // bins[2]
    c0, c1, low = b0 + d0 - n0 * bins[0], b1 + d1 - n1 * bins[1], b2 + d2 - n2 * bins[2]
    high = min(bins[2] - 1, low + last - d2)
    row = (c0 * bins[1] + c1) * bins[2]
    return n0, n1, n2, row + low, row + high, d2 + high - low + 1


@njit
def _most_around(bins, reach, start):
    """Return upper limits of the number of atoms and of rows of bins near one bin."""
    atoms, runs = 0, 0
    for b0 in range(bins[0]):
        for b1 in range(bins[1]):
            for b2 in range(bins[2]):
                found, kinds = 0, 0
                for d0 in range(-reach[0], reach[0] + 1):
                    for d1 in range(-reach[1], reach[1] + 1):
                        d2 = -reach[2]
                        while d2 <= reach[2]:
                            _, _, _, first, last, d2 = _run(d0, d1, d2, b0, b1, b2, bins, reach[2])
                            found += start[last + 1] - start[first]
                            kinds += 1
                atoms, runs = max(atoms, found), max(runs, kinds)
    return atoms + 1, runs + 1


# Not inlined, and in loops from 0 over slices: an index that could be negative costs a test for each
# candidate, and the loop its vector instructions.
@njit(inline="never")
def _within(near, first, last, x0, x1, x2, largest, squares, flags, chosen):
    """List and count the atoms whose squared distance from a point is at most `largest`."""
    near0, near1, near2 = near[0, first:last], near[1, first:last], near[2, first:last]
    for k in range(near0.shape[0]):
        y0, y1, y2 = near0[k] - x0, near1[k] - x1, near2[k] - x2
        squares[k] = y0 * y0 + y1 * y1 + y2 * y2
    for k in range(near0.shape[0]):
        flags[k] = squares[k] <= largest
    kept = 0
    # no branch to mispredict: every candidate is written, and overwritten unless it is kept
    for k in range(near0.shape[0]):
        chosen[kept] = k
        kept += flags[k]
    return kept


@njit
def meet(atoms, limits, found):
    """Record neighbor pairs. Return the numbers of decided and undecided pairs.

    Within one group, half of the bins around each bin are examined. For two groups, all bins around each bin
    are examined. A pair of atoms that is found twice counts once.
    """
    written, left = 0, 0
    start, bins, reach, species = atoms.start, atoms.bins, atoms.reach, atoms.species
    vectors, sorted_x, order, wrapped = atoms.lattice.vectors, atoms.sorted_x, atoms.order, atoms.wrapped
    center_start, center_order, periodic = atoms.center_start, atoms.center_order, atoms.lattice.periodic
    kind, low, high, largest = limits.kind, limits.low, limits.high, limits.largest
    half = atoms.half and kind != DIRECTED
    # one species: no need to look it up
    several = low.shape[0] > 1
    near, squares, flags = np.empty((3, atoms.atoms)), np.empty(atoms.atoms), np.empty(atoms.atoms, np.uint8)
    atom, run = np.empty(atoms.atoms, np.int32), np.empty(atoms.atoms, np.int32)
    chosen, codes = np.empty(atoms.atoms, np.uint32), np.zeros(atoms.runs, np.int32)
    for here in range(len(start) - 1):
        if center_start[here] == center_start[here + 1]:
            continue
        b0, b1, b2 = here // (bins[1] * bins[2]), here // bins[2] % bins[1], here % bins[2]
        count, runs = 0, 0
        for d0 in range(0 if half else -reach[0], reach[0] + 1):
            for d1 in range(0 if half and d0 == 0 else -reach[1], reach[1] + 1):
                # of half the bins the bin itself comes first, then those after it
                alone = half and d0 == 0 and d1 == 0
                d2, last = (0, 0) if alone else (-reach[2], reach[2])
                while d2 <= reach[2]:
                    n0, n1, n2, low_bin, high_bin, d2 = _run(d0, d1, d2, b0, b1, b2, bins, last)
                    last = reach[2]
                    begin, more = start[low_bin], start[high_bin + 1] - start[low_bin]
                    if more == 0:
                        continue
                    high_bits = ((n0 * periodic[0] + 512) << 20) + ((n1 * periodic[1] + 512) << 10)
                    codes[runs] = high_bits + n2 * periodic[2] + 512
                    s0 = n0 * vectors[0, 0] + n1 * vectors[1, 0] + n2 * vectors[2, 0]
                    s1 = n0 * vectors[0, 1] + n1 * vectors[1, 1] + n2 * vectors[2, 1]
                    s2 = n0 * vectors[0, 2] + n1 * vectors[1, 2] + n2 * vectors[2, 2]
                    for q in range(more):
                        near[0, count + q] = sorted_x[0, begin + q] + s0
                        near[1, count + q] = sorted_x[1, begin + q] + s1
                        near[2, count + q] = sorted_x[2, begin + q] + s2
                        atom[count + q] = order[begin + q]
                        run[count + q] = runs
                    count += more
                    runs += 1
        for q in range(center_start[here + 1] - center_start[here]):
            i = center_order[center_start[here] + q]
            first = q + 1 if half else 0
            x0, x1, x2 = wrapped[i, 0], wrapped[i, 1], wrapped[i, 2]
            kept = _within(near, first, count, x0, x1, x2, largest, squares, flags, chosen)
            atom_here, run_here, si = atom[first:count], run[first:count], species[i]
            twice = not half and atoms.both[i] and kind != DIRECTED
            for m in range(kept):
                k = chosen[m]
                j = atom_here[k]
                sj = species[j] if several else 0
                if squares[k] > high[si, sj] or i == j or (twice and atoms.both[j] and j < i):
                    continue
                if squares[k] < low[si, sj] and kind == INSIDE:
                    if written < found.i.shape[0]:
                        found.i[written], found.j[written] = i, j
                    written += 1
                else:
                    if left < found.i_open.shape[0]:
                        found.i_open[left], found.j_open[left] = i, j
                        found.code[left], found.value[left] = codes[run_here[k]], squares[k]
                    left += 1
    found.counts[0], found.counts[1] = written, left
    return written, left
