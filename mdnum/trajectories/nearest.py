"""Directed neighbors: the nearest few of each atom, and how far each decision is from being another."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float

from mdnum.trajectories.binned import Sides
from mdnum.trajectories.candidates import DIRECTED
from mdnum.trajectories.lattice import Lattice, own_images
from mdnum.trajectories.pairs import Rows, rows_of, search
from mdnum.trajectories.rules import Capped, Nearest


@dataclass(frozen=True)
class Chosen:
    """The neighbors of each center, nearest first.

    Attributes:
        rows: as of a search; the squares are those of the neighbors.
        last_in: distance under which a neighbor stays one: that of the first outside, or the radius.
        first_out: distance under which another would be one: that of the last inside, or the radius.
    """

    rows: Rows
    last_in: Float[np.ndarray, "atoms"]
    first_out: Float[np.ndarray, "atoms"]


@numba.njit(cache=True, nogil=True)
def _choose(
    first, count, other, square, own, centers, both, most, reach, bound, complete, searched,
    new_first, new_count, new_other, new_square, last_in, first_out, lacking,
):  # fmt: skip
    """Sort each row by (square, index) and keep the first; returns (written, close, smallest, lacking)."""
    written, close, smallest, short = 0, 0, np.inf, 0
    for i in range(first.shape[0]):
        if not centers[i]:
            continue
        selfs = own.shape[0] if both[i] else 0
        length = count[i] + 2 * selfs
        squares, js = np.empty(length), np.empty(length, np.int32)
        for k in range(count[i]):
            squares[k], js[k] = square[first[i] + k], other[first[i] + k]
        for k in range(2 * selfs):
            squares[count[i] + k], js[count[i] + k] = own[k // 2], i
        # by index first, so that the stable sort by square breaks ties by index
        order = np.argsort(js, kind="mergesort")
        squares, js = squares[order], js[order]
        order = np.argsort(squares, kind="mergesort")
        inside = 0
        for k in range(length):
            inside += int(squares[k] < reach * reach)
        kept = min(inside, most)
        # the first outside must have been seen, and all that come as close as it matters
        if not complete and (length <= kept or np.sqrt(squares[order[kept]]) > searched):
            lacking[i] = True
            short += 1
            continue
        limit_in, limit_out = reach, reach
        if kept == most:
            limit_out = np.sqrt(squares[order[kept - 1]])
            if kept < length:
                limit_in = min(reach, np.sqrt(squares[order[kept]]))
        last_in[i], first_out[i] = limit_in, limit_out
        new_first[i], new_count[i] = written, kept
        for k in range(length):
            distance = np.sqrt(squares[order[k]])
            margin = abs((limit_in if k < kept else limit_out) - distance)
            close += int(margin <= bound)
            smallest = min(smallest, margin)
            if k < kept:
                if written < new_other.shape[0]:
                    new_other[written], new_square[written] = js[order[k]], squares[order[k]]
                written += 1
    return written, close, smallest, short


def chosen(
    positions: Float[np.ndarray, "atoms 3"],
    lattice: Lattice,
    sides: Sides,
    rule: Nearest | Capped,
    *,
    band: float,
    bound: float,
    guard: float,
) -> Chosen:
    """The nearest few of each center; arguments as of `pairs.search`."""
    atoms = len(positions)
    both = sides.centers & sides.others
    everything = _span(positions, lattice)
    reach = rule.reach
    radius = reach if np.isfinite(reach) else _guess(positions, lattice, sides, rule.most, everything)
    new_first, new_count = np.zeros(atoms, np.int64), np.zeros(atoms, np.int64)
    last_in, first_out = np.full(atoms, reach), np.full(atoms, reach)
    centers = sides.centers
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    offset, close, smallest = 0, 0, np.inf
    one = np.zeros(atoms, np.int64)
    while True:
        found = search(
            positions, lattice, Sides(centers, sides.others, one), np.array([[radius]]), DIRECTED,
            band=band, bound=bound, guard=guard,
        )  # fmt: skip
        rows = rows_of(found, atoms)
        own = own_images(lattice, radius + band)
        room = int(centers.sum()) * rule.most
        room = min(room, len(rows.other) + 2 * len(own) * int(centers.sum()))
        other, square = np.empty(room, np.int32), np.empty(room)
        lacking = np.zeros(atoms, bool)
        # a free direction ends somewhere; along a lattice there is always one more
        complete = np.isfinite(reach) or radius >= everything
        written, near, least, short = _choose(
            rows.first, rows.count, rows.other, rows.square, own, centers, both, rule.most, reach, bound,
            complete, radius, new_first, new_count, other, square, last_in, first_out, lacking,
        )  # fmt: skip
        done = centers & ~lacking
        new_first[done] += offset
        parts.append((other[:written], square[:written]))
        offset, close, smallest = offset + written, close + near, min(smallest, least)
        if not short:
            break
        centers, radius = lacking, min(radius * 1.4, everything) if np.isfinite(everything) else radius * 1.4
    made = Rows(
        new_first, new_count, np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]),
        int(close), float(smallest),
    )  # fmt: skip
    return Chosen(made, last_in, first_out)


def _span(positions, lattice: Lattice) -> float:
    """A distance no pair exceeds, length; inf in a lattice, which has no end."""
    if lattice.periodic.any() or len(positions) == 0:
        return np.inf if lattice.periodic.any() else 0.0
    return float(np.linalg.norm(np.ptp(positions, axis=0))) * (1 + 1e-9) + 1e-300


def _guess(positions, lattice: Lattice, sides: Sides, most: int, everything: float) -> float:
    """A radius in which most atoms have enough neighbors."""
    candidates = int(sides.others.sum())
    if not candidates:
        return 1.0 if not np.isfinite(everything) else max(everything, 1e-300)
    extent = np.ptp(positions @ lattice.inverse, axis=0)
    extent = np.where(lattice.periodic, 1.0, np.maximum(extent, 1e-3 * max(extent.max(), 1e-12)))
    volume = float(np.prod(extent)) * lattice.volume
    radius = (3.0 * (1.6 * most + 8) * volume / (4.0 * np.pi * candidates)) ** (1 / 3)
    return float(min(radius, everything))
