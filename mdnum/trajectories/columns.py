"""Flips as the columns of a ledger: sorted, in the file's numbers, each with its two margins."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.trajectories.table import Flips


@dataclass(frozen=True)
class Thresholds:
    """What distances are compared with at two frames.

    Attributes:
        directed: whether they are those of an atom; else those of a pair of species.
        species: of each atom that takes part.
        radii: by species, length.
        last_in, first_out: of each atom, now, length; see `nearest.Chosen`.
        old_last_in, old_first_out: of each atom, at the frame before, length.
    """

    directed: bool
    species: Int[np.ndarray, "atoms"]
    radii: Float[np.ndarray, "species species"]
    last_in: Float[np.ndarray, "limits"]
    first_out: Float[np.ndarray, "limits"]
    old_last_in: Float[np.ndarray, "old_limits"]
    old_first_out: Float[np.ndarray, "old_limits"]


def sorted_order(
    first: Int[np.ndarray, "rows"], second: Int[np.ndarray, "rows"], atoms: int
) -> Int[np.ndarray, "rows"]:
    """The order of pairs by (first, second); those that are the same stay in theirs.

    Args:
        atoms: a number that none of them reaches.
    """
    if 4 * len(first) < atoms:
        # counting would look at every atom twice
        return np.argsort(first * np.int64(atoms) + second, kind="stable")
    return _counted(first, second, atoms)


@numba.njit(cache=True, nogil=True)
def _counted(first, second, atoms):
    """Two counting sorts, the second of which keeps the order of the first."""
    order, made = np.arange(first.shape[0]), np.empty(first.shape[0], np.int64)
    for key in (second, first):
        at = np.zeros(atoms + 1, np.int64)
        for k in range(key.shape[0]):
            at[key[k] + 1] += 1
        for a in range(atoms):
            at[a + 1] += at[a]
        for m in range(order.shape[0]):
            k = order[m]
            made[at[key[k]]] = k
            at[key[k]] += 1
        order, made = made, order
    return order


@dataclass(frozen=True)
class Changed:
    """Decisions that differ between two frames, in no order.

    Attributes:
        i, j: indices among the atoms that take part.
        rank: image, as in `Flips`.
        entered: whether the pair is inside now.
        distance, before: now, and at the frame before, length.
    """

    i: Int[np.ndarray, "flips"]
    j: Int[np.ndarray, "flips"]
    rank: Int[np.ndarray, "flips"]
    entered: Bool[np.ndarray, "flips"]
    distance: Float[np.ndarray, "flips"]
    before: Float[np.ndarray, "flips"]


def ledger(
    frame: int,
    changed: Changed,
    labels: Int[np.ndarray, "participants"],
    atoms: int,
    thresholds: Thresholds,
    bound: float,
) -> Flips:
    """The rows of one frame.

    Args:
        frame: its position among the frames looked at.
        labels: numbers in the file of the atoms that take part.
        atoms: of the file.
        thresholds: what the distances are compared with.
        bound: how far a margin can be off, length.
    """
    count = len(changed.i)
    first, second = np.empty(count, np.int64), np.empty(count, np.int64)
    _named(changed.i, changed.j, labels, thresholds.directed, first, second)
    if changed.rank.any():
        order = np.lexsort((changed.rank, second, first))
    else:
        order = sorted_order(first, second, atoms)
    whole = [np.empty(count, np.int64) for _ in range(3)]
    real, yes = [np.empty(count) for _ in range(4)], [np.empty(count, np.bool_) for _ in range(2)]
    _fill(
        order, first, second, changed.i, changed.j, changed.rank, changed.entered, changed.distance,
        changed.before, *vars(thresholds).values(), bound, *whole, *real, *yes,
    )  # fmt: skip
    return Flips(np.full(count, frame), *whole, yes[0], *real, np.full(count, bound), yes[1])


@numba.njit(cache=True, nogil=True)
def _named(i, j, labels, directed, first, second):
    """Numbers in the file, the lower one first unless the rule is directed."""
    for k in range(i.shape[0]):
        a, b = labels[i[k]], labels[j[k]]
        first[k], second[k] = (a, b) if directed or a < b else (b, a)


@numba.njit(cache=True, nogil=True)
def _fill(
    order, first_in, second_in, i, j, rank_in, entered_in, distance_in, before_in,
    directed, species, radii, last_in, first_out, old_last_in, old_first_out, bound,
    first, second, rank, distance, before, margin, margin_before, entered, ambiguous,
):  # fmt: skip
    """Every column in order, and the margins."""
    for m in range(order.shape[0]):
        k = order[m]
        first[m], second[m], rank[m] = first_in[k], second_in[k], rank_in[k]
        yes, here, there = entered_in[k], distance_in[k], before_in[k]
        entered[m], distance[m], before[m] = yes, here, there
        a = i[k]
        if directed:
            margin[m] = (last_in[a] if yes else first_out[a]) - here
            margin_before[m] = (old_first_out[a] if yes else old_last_in[a]) - there
        else:
            radius = radii[species[a], species[j[k]]]
            margin[m], margin_before[m] = radius - here, radius - there
        ambiguous[m] = abs(margin[m]) <= bound or abs(margin_before[m]) <= bound
