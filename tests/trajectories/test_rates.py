"""Rates by class, chatter and the busiest pairs against loops over tables of decisions."""

from __future__ import annotations

import itertools
from collections import Counter

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from trajectories.membership import ledger, random_membership

from mdnum.trajectories.contacts import contacts
from mdnum.trajectories.history import History
from mdnum.trajectories.rates import Busiest, Chatter, Tally, by_group, mean_stay

seeds = st.integers(0, 10**6)


@given(seeds, st.booleans())
@settings(max_examples=20)
def test_flips_and_time_inside_by_class(seed: int, directed: bool) -> None:
    inside, names = random_membership(seed)
    history = History.of(*ledger(inside, names), inside.shape[1])
    classes = np.random.default_rng(seed).integers(0, 3, 8)
    found = Tally.of(contacts(history), classes, ("a", "b", "c"), inside.shape[1], directed)
    entered, left, time, exposed = Counter(), Counter(), Counter(), Counter()
    for (i, j, _), row in zip(names, inside.astype(int), strict=True):
        pair = (int(classes[i]), int(classes[j]))
        key = pair if directed else tuple(sorted(pair))
        entered[key] += int((np.diff(row) == 1).sum())
        left[key] += int((np.diff(row) == -1).sum())
        time[key] += int(row.sum())
        exposed[key] += int(row[:-1].sum())
    for a in range(3):
        for b in range(3):
            assert found.entered[a, b] == entered[a, b] and found.left[a, b] == left[a, b]
            assert found.inside[a, b] == time[a, b] and found.exposure[a, b] == exposed[a, b]
    assert np.isnan(mean_stay(found)[found.left == 0]).all()


@given(seeds, st.integers(1, 8))
@settings(max_examples=20)
def test_flips_taken_back_and_how_soon(seed: int, window: int) -> None:
    inside, names = random_membership(seed)
    found = Chatter.of(History.of(*ledger(inside, names), inside.shape[1]), window)
    within, beyond, total = Counter(), Counter(), 0
    for row in inside:
        at = np.flatnonzero(np.diff(row.astype(int))) + 1
        total += len(at)
        for one, following in itertools.pairwise(at):
            (within if row[one] else beyond)[int(following - one)] += 1
    assert found.flips == total and found.window == window
    assert found.inside.tolist() == [within[n] for n in range(window + 1)]
    assert found.outside.tolist() == [beyond[n] for n in range(window + 1)]
    assert found.undone == sum(found.inside) + sum(found.outside)


@given(seeds)
@settings(max_examples=20)
def test_the_busiest_pairs_are_the_same_from_parts(seed: int) -> None:
    inside, names = random_membership(seed)
    frames = inside.shape[1]
    whole = History.of(*ledger(inside, names), frames)
    found = Busiest.of(whole, contacts(whole), 6)
    expected = sorted(
        (-int((np.diff(row.astype(int)) != 0).sum()), name, int(row.sum()))
        for name, row in zip(names, inside, strict=True)
    )[:6]
    told = [
        (-flips, (i, j, rank), time)
        for i, j, rank, flips, time in zip(
            found.i, found.j, found.rank, found.flips, found.inside, strict=True
        )
    ]
    assert told == [row for row in expected if row[0]]
    parts = []
    for part in (range(0, 30, 2), range(1, 30, 2)):
        one = History.of(*ledger(inside[part], [names[p] for p in part]), frames)
        parts.append(Busiest.of(one, contacts(one), 6))
    joined = parts[0].joined(parts[1], 6)
    for name in ("i", "j", "rank", "flips", "inside"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(found, name))


def test_flips_of_groups_with_others_and_within() -> None:
    inside, names = random_membership(4)
    history = History.of(*ledger(inside, names), inside.shape[1])
    residues = np.array([0, 0, 1, 1, 1, 2, 3, 3])
    between, within = by_group(history, residues, 5)
    expected = np.zeros((2, 5), int)
    for (i, j, _), row in zip(names, inside, strict=True):
        flips = int((np.diff(row.astype(int)) != 0).sum())
        if residues[i] == residues[j]:
            expected[1, residues[i]] += flips
        else:
            expected[0, residues[i]] += flips
            expected[0, residues[j]] += flips
    np.testing.assert_array_equal([between, within], expected)
