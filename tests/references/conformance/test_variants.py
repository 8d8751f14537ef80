"""Kept lists with mistakes that others reported, on an exact list that the suite was not written with."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from mdnum.references.conformance.lists import from_object
from mdnum.references.conformance.suite import examine


def images(x: np.ndarray, cell: np.ndarray, pbc: np.ndarray, reach: float):
    """All pairs within reach, by all images that can be."""
    x, cell = np.array(x, float), np.where(pbc[:, None], np.array(cell, float), 0.0)
    inverse = np.linalg.pinv(cell)
    home = np.floor(x @ inverse).astype(int) * pbc
    x = x - home @ cell
    far = [int(np.ceil(reach * np.linalg.norm(inverse[:, k]))) + 1 if pbc[k] else 0 for k in range(3)]
    rows: list[tuple[np.ndarray, ...]] = []
    for shift in itertools.product(*(range(-n, n + 1) for n in far)):
        inside = np.linalg.norm(x[None] + np.array(shift) @ cell - x[:, None], axis=-1) < reach
        if not any(shift):
            np.fill_diagonal(inside, False)
        i, j = np.nonzero(inside)
        rows.append((i, j, np.array(shift) - home[j] + home[i]))
    return tuple(np.concatenate([row[k] for row in rows]) for k in range(3))


class Kept:
    """Right: rebuilt where two atoms could have used up the skin."""

    full = True

    def allocate(self, positions, cell, pbc, r_cut, skin):
        self.pbc, self.r_cut, self.skin = np.array(pbc, bool), r_cut, skin
        self._build(positions, cell)
        return self._inside(positions, cell)

    def _build(self, positions, cell):
        self.x, self.cell = np.array(positions, float), np.array(cell, float)
        self.rows = images(self.x, self.cell, self.pbc, self.r_cut + self.skin)

    def due(self, moved: np.ndarray) -> bool:
        return len(moved) > 0 and 2 * moved.max() > self.skin

    def update(self, positions, cell):
        same = len(positions) == len(self.x) and np.array_equal(cell, self.cell)
        if not same or self.due(np.linalg.norm(positions - self.x, axis=1)):
            self._build(positions, cell)
        return self._inside(positions, cell)

    def _inside(self, positions, cell):
        (i, j, shift), x = self.rows, np.array(positions, float)
        cell = np.where(self.pbc[:, None], np.array(cell, float), 0.0)
        near = np.linalg.norm(x[j] + shift @ cell - x[i], axis=1) < self.r_cut
        return i[near], j[near], shift[near]


class TwoLargest(Kept):
    """Right, and rebuilt less often."""

    def due(self, moved):
        return np.sort(moved)[-2:].sum() > self.skin


class SixtyPercent(Kept):
    def due(self, moved):
        return len(moved) > 0 and moved.max() > 0.6 * self.skin


class MostOfThem(Kept):
    def due(self, moved):
        return len(moved) > 0 and 2 * np.percentile(moved, 90) > self.skin


class SecondLargest(Kept):
    def due(self, moved):
        return len(moved) > 1 and 2 * np.sort(moved)[-2] > self.skin


class LargestAndMean(Kept):
    def due(self, moved):
        return len(moved) > 0 and moved.max() + moved.mean() > self.skin


class NearestImageOnUpdate(Kept):
    def update(self, positions, cell):
        i, j, shift = images(positions, cell, self.pbc, self.r_cut)
        _, first = np.unique(i * len(positions) + j, return_index=True)
        return i[first], j[first], shift[first]


class NoOwnImageOnUpdate(Kept):
    def update(self, positions, cell):
        i, j, shift = images(positions, cell, self.pbc, self.r_cut)
        return i[i != j], j[i != j], shift[i != j]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("kind", "code"),
    [
        (Kept, None), (TwoLargest, None), (SixtyPercent, "MISSING"), (MostOfThem, "MISSING"),
        (SecondLargest, "MISSING"), (LargestAndMean, "MISSING"), (NearestImageOnUpdate, "MISSING"),
        (NoOwnImageOnUpdate, "MISSING"),
    ],
    ids=lambda one: getattr(one, "__name__", ""),
)  # fmt: skip
def test_a_kept_list_of_others_is_judged_rightly(kind, code):
    report = examine(from_object(kind), cases=20, large=False, shrink=False, stop=code is not None)
    codes = {failed.code for failed in report.failed}
    # an atom exactly at the cutoff from its own image may be decided otherwise from its other side
    assert codes <= {"ONE_SIDED"} if code is None else codes & {code, "ONE_SIDED"}
