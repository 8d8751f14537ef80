"""The loops of a search.

Around each bin the atoms of the bins in reach are gathered, with the lattice vector that brings them near, as
often as a small box repeats; then every atom of the bin is held against all of them.
"""

from __future__ import annotations

import numba
import numpy as np

from mdnum.trajectories.bins import lattice_code, run_of_bins

#: what a search writes down: pairs inside; pairs near their threshold; all in reach, from the centers
INSIDE, BAND, DIRECTED = 0, 1, 2


# Not inlined, and in loops from 0 over slices: an index that could be negative costs a test for each
# candidate, and the loop its vector instructions.
@numba.njit(cache=True, nogil=True, inline="never")
def _within(near, first, last, x0, x1, x2, largest, squares, flags, chosen):
    """Squares of near[:, first:last] as seen from x, and which of them, counted from first, are within."""
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


@numba.njit(cache=True, nogil=True)
def _copy(sorted_x, order, begin, more, n0, n1, n2, vectors, kind, found, near, atom, run):
    """Put the atoms of a run of bins, at an image, behind those found so far."""
    s0 = n0 * vectors[0, 0] + n1 * vectors[1, 0] + n2 * vectors[2, 0]
    s1 = n0 * vectors[0, 1] + n1 * vectors[1, 1] + n2 * vectors[2, 1]
    s2 = n0 * vectors[0, 2] + n1 * vectors[1, 2] + n2 * vectors[2, 2]
    for q in range(more):
        near[0, found + q] = sorted_x[0, begin + q] + s0
        near[1, found + q] = sorted_x[1, begin + q] + s1
        near[2, found + q] = sorted_x[2, begin + q] + s2
        atom[found + q] = order[begin + q]
        run[found + q] = kind


@numba.njit(cache=True, nogil=True)
def met_once(
    first_bin, end_bin, room, runs, sorted_x, vectors, free, bins, reach, start, order,
    kind, species, low, high, largest, tally, i_out, j_out, i_open, j_open, code_open, value_open,
):  # fmt: skip
    """All pairs of one set of atoms, each met once: from a bin, half of the bins around are looked at.

    Bins from first_bin to before end_bin; room, runs: most atoms and most runs around a bin.
    """
    written, left = 0, 0
    # one species: no need to look it up
    several = low.shape[0] > 1
    near, squares, flags = np.empty((3, room)), np.empty(room), np.empty(room, np.uint8)
    atom, chosen, run = np.empty(room, np.int32), np.empty(room, np.uint32), np.empty(room, np.int32)
    codes = np.zeros(runs, np.int32)
    for here in range(first_bin, end_bin):
        own = start[here + 1] - start[here]
        if own == 0:
            continue
        b0, b1, b2 = here // (bins[1] * bins[2]), here // bins[2] % bins[1], here % bins[2]
        found, kinds = 0, 0
        for d0 in range(reach[0] + 1):
            for d1 in range(-reach[1] if d0 > 0 else 0, reach[1] + 1):
                # the bin itself comes first, then those after it
                d2 = -reach[2] if d0 > 0 or d1 > 0 else 0
                last = reach[2] if d0 > 0 or d1 > 0 else 0
                while d2 <= reach[2]:
                    n0, n1, n2, low_bin, high_bin, d2 = run_of_bins(d0, d1, d2, b0, b1, b2, bins, last)
                    last = reach[2]
                    begin, more = start[low_bin], start[high_bin + 1] - start[low_bin]
                    if more == 0:
                        continue
                    codes[kinds] = lattice_code(n0 * free[0], n1 * free[1], n2 * free[2])
                    _copy(sorted_x, order, begin, more, n0, n1, n2, vectors, kinds, found, near, atom, run)
                    found += more
                    kinds += 1
        for q in range(own):
            kept = _within(
                near, q + 1, found, near[0, q], near[1, q], near[2, q], largest, squares, flags, chosen
            )
            i = atom[q]
            si = species[i]
            for m in range(kept):
                k = chosen[m]
                j = atom[q + 1 + k]
                sj = species[j] if several else 0
                if squares[k] > high[si, sj] or i == j:
                    continue
                if squares[k] < low[si, sj] and kind != DIRECTED:
                    if kind == INSIDE and written < i_out.shape[0]:
                        i_out[written], j_out[written] = i, j
                    written += 1
                else:
                    if left < i_open.shape[0]:
                        i_open[left], j_open[left], code_open[left] = i, j, codes[run[q + 1 + k]]
                        value_open[left] = squares[k]
                    left += 1
    tally[0], tally[1] = written, left


@numba.njit(cache=True, nogil=True)
def met_from_centers(
    first_bin, end_bin, room, runs, wrapped, sorted_x, vectors, free, bins, reach,
    center_start, center_order, start, order, both,
    kind, species, low, high, largest, tally, i_out, j_out, i_open, j_open, code_open, value_open,
):  # fmt: skip
    """Everything around each center; two atoms that are on both sides are met twice and count once."""
    written, left = 0, 0
    # one species: no need to look it up
    several = low.shape[0] > 1
    near, squares, flags = np.empty((3, room)), np.empty(room), np.empty(room, np.uint8)
    atom, chosen, run = np.empty(room, np.int32), np.empty(room, np.uint32), np.empty(room, np.int32)
    codes = np.zeros(runs, np.int32)
    for here in range(first_bin, end_bin):
        if center_start[here] == center_start[here + 1]:
            continue
        b0, b1, b2 = here // (bins[1] * bins[2]), here // bins[2] % bins[1], here % bins[2]
        found, kinds = 0, 0
        for d0 in range(-reach[0], reach[0] + 1):
            for d1 in range(-reach[1], reach[1] + 1):
                d2 = -reach[2]
                while d2 <= reach[2]:
                    n0, n1, n2, low_bin, high_bin, d2 = run_of_bins(d0, d1, d2, b0, b1, b2, bins, reach[2])
                    begin, more = start[low_bin], start[high_bin + 1] - start[low_bin]
                    if more == 0:
                        continue
                    codes[kinds] = lattice_code(n0 * free[0], n1 * free[1], n2 * free[2])
                    _copy(sorted_x, order, begin, more, n0, n1, n2, vectors, kinds, found, near, atom, run)
                    found += more
                    kinds += 1
        for q in range(center_start[here], center_start[here + 1]):
            i = center_order[q]
            kept = _within(
                near, 0, found, wrapped[i, 0], wrapped[i, 1], wrapped[i, 2], largest, squares, flags, chosen
            )
            si = species[i]
            twice = both[i] and kind != DIRECTED
            for m in range(kept):
                k = chosen[m]
                j = atom[k]
                sj = species[j] if several else 0
                if squares[k] > high[si, sj] or i == j or (twice and both[j] and j < i):
                    continue
                if squares[k] < low[si, sj] and kind != DIRECTED:
                    if kind == INSIDE and written < i_out.shape[0]:
                        i_out[written], j_out[written] = i, j
                    written += 1
                else:
                    if left < i_open.shape[0]:
                        i_open[left], j_open[left], code_open[left] = i, j, codes[run[k]]
                        value_open[left] = squares[k]
                    left += 1
    tally[0], tally[1] = written, left
