"""Compiled comparisons of rows have the bits of the numpy expressions that say what they mean."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.md.cell import Cell, HostCell
from mdnum.md.neighbors import PairTable
from mdnum.rollout.compared import Apart, differ, in_user_order

BOXES = {
    "cube": (np.diag([5.0, 5.0, 5.0]), (True, True, True)),
    "brick, one face open": (np.diag([4.0, 5.0, 6.0]), (True, False, True)),
    "tilted": (np.array([[5.0, 0, 0], [0.7, 4.5, 0], [-0.3, 0.4, 4.8]]), (True, True, True)),
    "tilted, one face open": (np.array([[5.0, 0, 0], [0.7, 4.5, 0], [0, 0, 4.8]]), (True, True, False)),
    "open": (np.diag([5.0, 5.0, 5.0]), (False, False, False)),
}


def rows(seed: int, count: int = 9, atoms: int = 31) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 6.0, (count, 3, atoms))


@pytest.mark.parametrize("box", BOXES)
def test_distances_have_the_bits_of_nearest_images(box):
    matrix, pbc = BOXES[box]
    cell = Cell.create(matrix, np.array(pbc))
    a, b = rows(1), rows(2)
    b[4] = a[4]
    b[5, 1, 3] = np.nan
    d = HostCell(cell).displacement(a.transpose(0, 2, 1), b.transpose(0, 2, 1))
    with np.errstate(invalid="ignore"):
        wanted = np.sqrt((d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).max(axis=1))
    found = Apart(cell)(a, b)
    np.testing.assert_array_equal(found, wanted)
    assert found[4] == 0 and np.isnan(found[5])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_atoms_are_put_in_the_users_order(dtype):
    values, order = rows(3).astype(dtype), np.random.default_rng(4).permutation(31)
    found = in_user_order(values, order)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found[:, :, order], values)


def test_rows_differ_where_a_number_does():
    a = rows(5)
    b = a.copy()
    b[2, 1, 30] = np.nextafter(b[2, 1, 30], 9)
    a[3, 0, 0] = b[3, 0, 0] = np.nan
    # zeros of either sign are one number
    a[4, 0, 0], b[4, 0, 0] = 0.0, -0.0
    also = np.zeros(9, bool)
    also[7] = True
    assert np.flatnonzero(differ(a, b)).tolist() == [2, 3]
    assert np.flatnonzero(differ(a, b, also)).tolist() == [2, 3, 7]
    assert not also[2]


def test_overridden_decisions_are_counted_once_with_their_distances():
    rng = np.random.default_rng(6)
    count, atoms, slots = 5, 31, 16
    matrix, pbc = BOXES["tilted"]
    cell, species = Cell.create(matrix, np.array(pbc)), rng.integers(0, 2, atoms)
    r_cut = np.array([[1.0, 1.2], [1.2, 1.5]])
    # a full list: every pair of sorted atoms within seven of one another, from both ends
    index = np.full((slots, atoms), atoms, np.int32)
    for k in range(atoms):
        others = [n for n in range(k - 7, k + 8) if n != k and 0 <= n < atoms]
        index[: len(others), k] = others
    table = PairTable(index, rng.permutation(atoms), 1.0, slots, 0.0)
    own = np.zeros((count, slots // 8, atoms), np.uint8)
    told, wanted = own.copy(), [[] for _ in range(count)]
    x = rows(7, count, atoms).astype(np.float32)
    for row in range(1, count):
        for _ in range(4 * row):
            k = int(rng.integers(0, atoms - 7))
            n = k + int(rng.integers(1, 8))
            for one, other in ((k, n), (n, k)):
                slot = int(np.flatnonzero(index[:, one] == other)[0])
                told[row, slot // 8, one] ^= np.uint8(1 << slot % 8)
            wanted[row] = sorted(set(wanted[row]) ^ {(k, n)})
    counts, furthest = Apart(cell).overridden(own, told, table, x, species, r_cut)
    assert counts.tolist() == [len(pairs) for pairs in wanted] and counts[4] > 6
    for row, pairs in enumerate(wanted):
        off = [0.0]
        for pair in pairs:
            k, n = sorted(pair, key=lambda one: table.order[one])
            d = HostCell(cell).displacement(x[row, :, [k]], x[row, :, [n]])
            distance = np.sqrt(sum(c[0] * c[0] for c in d))
            off.append(abs(distance - r_cut[species[table.order[k]], species[table.order[n]]]))
        assert furthest[row] == max(off)
