"""Neighbors by trying every atom and every image: nothing of mdnum in it but the contract of its answers."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np


def image_list(positions, matrix, pbc, i, j, reach):
    """Ascending squared distances (float64, from the coordinates as given) of images of j seen from i.

    Images of an atom itself: one of each ± pair. Every lattice vector that could matter is tried.
    """
    rows = np.where(np.asarray(pbc)[:, None], np.asarray(matrix, float), 0.0)
    d = positions[j] - positions[i]
    inverse = np.linalg.pinv(rows)
    middle = d @ inverse
    margin = reach * np.linalg.norm(inverse, axis=0)
    spans = [
        np.arange(np.floor(-middle[k] - margin[k]) - 1, np.ceil(-middle[k] + margin[k]) + 2)
        if pbc[k]
        else [0.0]
        for k in range(3)
    ]
    shifts = np.array(list(itertools.product(*spans)))
    if i == j:
        keep = (shifts[:, 0] > 0) | ((shifts[:, 0] == 0) & (shifts[:, 1] > 0))
        keep |= (shifts[:, 0] == 0) & (shifts[:, 1] == 0) & (shifts[:, 2] > 0)
        shifts = shifts[keep]
    moved = d + shifts @ rows
    squares = np.sort((moved * moved).sum(axis=1))
    return squares[squares <= reach * reach]


def everything(positions, matrix, pbc, first, second, reach):
    """{(i, j): squared distances of images} of symmetric pairs between the two sides, i <= j."""
    found = {}
    for i in range(len(positions)):
        for j in range(i, len(positions)):
            if (i in first and j in second) or (i in second and j in first):
                squares = image_list(positions, matrix, pbc, i, j, reach)
                if len(squares):
                    found[i, j] = squares
    return found


def members(pairs, radius_of):
    """{(i, j, rank): distance} of the pairs inside."""
    inside = {}
    for (i, j), squares in pairs.items():
        radius = radius_of(i, j)
        if radius is None:
            continue
        for rank, square in enumerate(squares):
            if square < radius * radius:
                inside[i, j, rank] = float(np.sqrt(square))
    return inside


def clear(pairs, radius_of, by=1e-9):
    """Whether no pair is so close to its radius that another order of operations could decide otherwise."""
    close = (
        radius_of(i, j) is not None and (abs(np.sqrt(squares) - radius_of(i, j)) < by).any()
        for (i, j), squares in pairs.items()
    )
    return not any(close)


def nearest(positions, matrix, pbc, first, second, most, radius, reach):
    """{(i, j, rank): distance}, per center (distance of the last inside, of the first outside), and whether
    no two distances that compete for a last place are the same but for rounding."""
    inside, limits, clearly = {}, {}, True
    for i in first:
        candidates = []
        for j in second:
            squares = image_list(positions, matrix, pbc, min(i, j), max(i, j), reach)
            if i == j:
                squares = np.repeat(squares, 2)
            candidates += [(float(square), int(j), rank) for rank, square in enumerate(squares)]
        candidates.sort()
        within = [one for one in candidates if one[0] < radius * radius]
        for square, j, rank in within[:most]:
            inside[i, j, rank] = float(np.sqrt(square))
        full = len(within) >= most
        last = float(np.sqrt(within[most - 1][0])) if full else radius
        after = float(np.sqrt(candidates[most][0])) if full and len(candidates) > most else np.inf
        limits[i] = (last, min(radius, after))
        clearly &= not full or after - last > 1e-9
        clearly &= all(abs(np.sqrt(one[0]) - radius) > 1e-9 for one in candidates)
    return inside, limits, clearly


def exactly_inside(positions, matrix, pbc, i, j, rank, radius):
    """Whether the image of that rank is inside, in rational arithmetic."""
    rows = np.where(np.asarray(pbc)[:, None], np.asarray(matrix, float), 0.0)
    d = positions[j] - positions[i]
    inverse = np.linalg.pinv(rows)
    middle = -np.rint(d @ inverse).astype(int)
    spans = [range(m - 3, m + 4) if p else [0] for m, p in zip(middle, pbc, strict=True)]
    squares = []
    for shift in itertools.product(*spans):
        if i == j and shift <= (0, 0, 0):
            continue
        if np.linalg.norm(d + np.array(shift) @ rows) > 2.0 * radius:
            # fractions are slow
            continue
        total = Fraction(0)
        for axis in range(3):
            one = Fraction(float(positions[j][axis])) - Fraction(float(positions[i][axis]))
            one += sum(int(s) * Fraction(float(row[axis])) for s, row in zip(shift, rows, strict=True))
            total += one * one
        squares.append(total)
    squares.sort()
    return rank < len(squares) and squares[rank] < Fraction(float(radius)) ** 2
