"""Bins: atoms sorted by place, in any box, so that what is near one another is looked for nearby.

Bins are those of the reduced lattice's coordinates. Directions that do not repeat have bins too, folded onto
a fixed number of them, so that one atom far away makes neither many bins nor a full one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float, Int

from mdnum.trajectories.lattice import Lattice

#: repeats of a box along one direction within the cutoff
MOST_IMAGES = 500


@dataclass(frozen=True)
class Grid:
    """Bins of one search.

    Attributes:
        bins: number along each axis.
        reach: how many bins away a pair can be.
        step: width of a bin in the lattice's coordinates; folded where the axis does not repeat.
    """

    bins: Int[np.ndarray, "3"]
    reach: Int[np.ndarray, "3"]
    step: Float[np.ndarray, "3"]


def grid_for(lattice: Lattice, radius: float, atoms: int, extent: Float[np.ndarray, "3"]) -> Grid:
    """Bins for pairs within radius.

    Args:
        radius: length, guard included.
        atoms: how many are to be binned; there are no more than about twice as many bins.
        extent: of the atoms along each axis that does not repeat, length.
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
                reach[k] = int(np.ceil(safe * bins[k] / lattice.widths[k]))
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
    return Grid(bins, reach, step)


@numba.njit(cache=True, nogil=True)
def place(x, vectors, inverse, periodic, bins, step, wrapped, home, bin_of):
    """Wrap every atom and name its bin."""
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


@numba.njit(cache=True, nogil=True)
def sorted_by_bin(bin_of, chosen, total):
    """(start, order) of the chosen atoms: a counting sort that keeps their order within a bin."""
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


@numba.njit(cache=True, nogil=True)
def lattice_code(n0, n1, n2):
    """Three whole numbers of at most `MOST_IMAGES` as one."""
    return ((n0 + 512) << 20) + ((n1 + 512) << 10) + (n2 + 512)


@numba.njit(cache=True, nogil=True)
def lattice_vector(code):
    """The three whole numbers of `lattice_code`."""
    code = np.int64(code)
    return (code >> 20) - 512, ((code >> 10) & 1023) - 512, (code & 1023) - 512


@numba.njit(cache=True, nogil=True)
def run_of_bins(d0, d1, d2, b0, b1, b2, bins, last):
    """The run of bins that begins d away from a bin: lattice vector, first and last bin, next d2."""
    n0, n1, n2 = (b0 + d0) // bins[0], (b1 + d1) // bins[1], (b2 + d2) // bins[2]
    c0, c1, low = b0 + d0 - n0 * bins[0], b1 + d1 - n1 * bins[1], b2 + d2 - n2 * bins[2]
    high = min(bins[2] - 1, low + last - d2)
    row = (c0 * bins[1] + c1) * bins[2]
    return n0, n1, n2, row + low, row + high, d2 + high - low + 1


@numba.njit(cache=True, nogil=True)
def most_around(bins, reach, start):
    """Most atoms, and most runs, around any bin."""
    atoms, runs = 0, 0
    for b0 in range(bins[0]):
        for b1 in range(bins[1]):
            for b2 in range(bins[2]):
                found, kinds = 0, 0
                for d0 in range(-reach[0], reach[0] + 1):
                    for d1 in range(-reach[1], reach[1] + 1):
                        d2 = -reach[2]
                        while d2 <= reach[2]:
                            _, _, _, first, last, d2 = run_of_bins(d0, d1, d2, b0, b1, b2, bins, reach[2])
                            found += start[last + 1] - start[first]
                            kinds += 1
                atoms, runs = max(atoms, found), max(runs, kinds)
    return atoms + 1, runs + 1
