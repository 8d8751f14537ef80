"""Pairs on which two runs differ, against sets that are kept pair by pair."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.rollout.compared import CrossRecorder, PairFlips

ATOMS = 6


def history(rng, steps: int, chance: float) -> tuple[list[set[int]], PairFlips]:
    """Random decisions of all pairs, and their flips in order."""
    keys = [i * ATOMS + j for i in range(ATOMS) for j in range(i + 1, ATOMS)]
    inside = {key for key in keys if rng.random() < 0.5}
    sets, rows = [set(inside)], []
    for step in range(1, steps):
        flipped = [key for key in keys if rng.random() < chance]
        inside ^= set(flipped)
        rows += [(step, key, key in inside, rng.random(), 0.5) for key in flipped]
        sets.append(set(inside))
    columns = zip(*rows, strict=True) if rows else ((),) * 5
    dtypes = (np.int64, np.int64, bool, float, float)
    return sets, PairFlips(*(np.array(column, dtype) for column, dtype in zip(columns, dtypes, strict=True)))


@pytest.mark.parametrize("chance", [0.0, 0.05, 0.6])
def test_what_differs_is_the_difference_of_the_sets_at_every_step(chance):
    rng = np.random.default_rng(3)
    sets_a, a = history(rng, 40, chance)
    sets_b, b = history(rng, 40, chance)
    crossing = CrossRecorder(*(np.array(sorted(sets[0]), np.int64) for sets in (sets_a, sets_b)), ATOMS)
    known = {one.i * ATOMS + one.j for one in crossing.opening()}
    assert known == sets_a[0] ^ sets_b[0]
    seen, at = [], 0
    for first, rows in ((0, 7), (7, 1), (8, 32)):
        parts = [one.where((one.step >= first) & (one.step < first + rows)) for one in (a, b)]
        counts, flips = crossing.take(first, rows, *parts)
        listed = list(flips)
        assert [flips[k] for k in range(len(flips))] == listed == list(flips[:3]) + list(flips[3:])
        for row in range(rows):
            for flip in (one for one in listed if one.step == first + row):
                key = flip.i * ATOMS + flip.j
                known ^= {key}
                assert flip.differs == (key in known)
                # it is the flip of the run that is named
                own = a if flip.run == "A" else b
                (place,) = np.flatnonzero((own.step == flip.step) & (own.key == key))
                assert (flip.entered, flip.margin) == (own.entered[place], own.margin[place])
            assert known == sets_a[at] ^ sets_b[at]
            assert counts[row] == len(known)
            at += 1
        seen += [(one.step, one.i, one.j, one.run) for one in listed]
    assert seen == sorted(seen)
    assert (len(seen) > 0) == (chance > 0)
