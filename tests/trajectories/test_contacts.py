"""Contacts and lifetimes against loops over tables of decisions, and against estimates worked out by hand."""

from __future__ import annotations

import itertools
from dataclasses import fields
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trajectories.membership import ledger, random_membership, stays

from mdnum.trajectories.contacts import Contacts, contacts, mended
from mdnum.trajectories.history import History
from mdnum.trajectories.lifetimes import Durations, again, mean_by_rate, residence, survival

seeds = st.integers(0, 10**6)


def made(seed: int, frames: int = 25, pairs: int = 30) -> tuple[np.ndarray, list, History]:
    inside, names = random_membership(seed, pairs, frames)
    flips, first = ledger(inside, names)
    return inside, names, History.of(flips, first, frames)


def listed(found: Contacts, names: list) -> list[tuple]:
    columns = (found.i, found.j, found.rank, found.begin, found.end, found.began, found.ended)
    return [
        (names.index((i, j, r)), *rest) for i, j, r, *rest in zip(*(c.tolist() for c in columns), strict=True)
    ]


@given(seeds)
@settings(max_examples=40)
def test_every_stay_is_found_with_what_was_not_seen_of_it(seed: int) -> None:
    inside, names, history = made(seed)
    assert listed(contacts(history), names) == stays(inside)
    assert not len(history.broken())
    kept = [row for row in range(len(names)) if inside[row].any()]
    assert [names.index(name) for name in zip(history.i, history.j, history.rank, strict=True)] == kept
    np.testing.assert_array_equal(history.last, inside[kept, -1])


def test_pairs_too_many_to_pack_into_one_number_are_sorted_all_the_same() -> None:
    inside, names = random_membership(3)
    far = [(i + 2**31, j + 2**31, rank) for i, j, rank in names]
    found = contacts(History.of(*ledger(inside, far), inside.shape[1]))
    assert listed(found, far) == stays(inside)


def test_a_missing_flip_is_noticed() -> None:
    inside, names = random_membership(1)
    flips, first = ledger(inside, names)
    keep = np.arange(len(flips)) != 7
    cut = type(flips)(**{one.name: getattr(flips, one.name)[keep] for one in fields(flips)})
    history = History.of(cut, first, inside.shape[1])
    # unless it was the pair's last one, after which nothing contradicts
    gone = (int(flips.i[7]), int(flips.j[7]), int(flips.rank[7]))
    assert [(history.i[p], history.j[p], history.rank[p]) for p in history.broken()] == [gone]
    with pytest.raises(ValueError, match="missing"):
        contacts(history)


@given(seeds, st.integers(0, 6))
@settings(max_examples=30)
def test_stays_with_short_gaps_between_count_as_one(seed: int, gap: int) -> None:
    inside, names, history = made(seed)
    filled = inside.copy()
    for row in filled:
        at = np.flatnonzero(row)
        for one, following in itertools.pairwise(at):
            if following - one - 1 <= gap:
                row[one:following] = True
    assert listed(mended(contacts(history), gap), names) == stays(filled)


def test_no_pair_at_all_and_one_frame() -> None:
    flips, first = ledger(np.zeros((0, 4), bool), [])
    history = History.of(flips, first, 4)
    found = Durations.of(contacts(history), 4)
    assert not len(contacts(history)) and mean_by_rate(found)[0] == np.inf
    assert survival(found).longest == 0 and survival(found).mean == 0
    single = History.of(*ledger(np.ones((2, 1), bool), [(0, 1, 0), (0, 2, 0)]), 1)
    (begin, end), only = (contacts(single).begin, contacts(single).end), contacts(single)
    assert begin.tolist() == [0, 0] and end.tolist() == [1, 1]
    assert not only.began.any() and not only.ended.any()


@given(seeds)
@settings(max_examples=30)
def test_survival_is_the_product_of_what_survives_each_frame(seed: int) -> None:
    inside, _, history = made(seed, pairs=20)
    found = survival(Durations.of(contacts(history), history.frames))
    followed = [(end - begin, ended) for _, begin, end, began, ended in stays(inside) if began]
    share = Fraction(1)
    for length in range(1, history.frames):
        # at risk: those looked at again after `length` frames inside
        risk = sum(1 for n, ended in followed if n > length or (n == length and ended))
        gone = sum(1 for n, ended in followed if n == length and ended)
        if not gone:
            continue
        share *= 1 - Fraction(gone, risk)
        at = found.frames.tolist().index(length)
        assert found.share[at] == pytest.approx(float(share), abs=1e-14)
        assert found.at_risk[at] == risk
    half = [n for n, left in zip(found.frames.tolist(), found.share, strict=True) if left <= 0.5]
    assert found.at(0.5) == (half[0] if half else None)


def test_a_worked_example_of_survival() -> None:
    # stays of 1, 2, 2 and 4 frames seen whole; one that goes on after 3 frames: seen to survive 2
    counts = np.zeros((4, 6), np.int64)
    counts[0, [1, 4]], counts[0, 2], counts[1, 3] = 1, 2, 1
    found = survival(Durations(*counts))
    assert found.frames.tolist() == [1, 2, 4] and found.at_risk.tolist() == [5, 4, 1]
    np.testing.assert_allclose(found.share, [4 / 5, 2 / 5, 0.0])
    # Greenwood by hand: S(2)^2 (1/(5*4) + 2/(4*2))
    np.testing.assert_allclose(found.error[:2], [0.8 * (1 / 20) ** 0.5, 0.4 * (1 / 20 + 2 / 8) ** 0.5])
    assert found.mean == pytest.approx(1 + 0.8 + 2 * 0.4)


def test_pairs_that_leave_at_a_constant_rate_are_given_that_rate_however_much_is_cut_off() -> None:
    rng = np.random.default_rng(5)
    inside = np.empty((4_000, 30), bool)
    inside[:, 0] = rng.random(4_000) < 0.5
    for frame in range(1, 30):
        inside[:, frame] = np.where(inside[:, frame - 1], rng.random(4_000) > 0.05, rng.random(4_000) < 0.05)
    names = [(i, i + 1, 0) for i in range(4_000)]
    history = History.of(*ledger(inside, names), 30)
    found = Durations.of(contacts(history), 30)
    mean, error = mean_by_rate(found)
    assert abs(mean - 20) < 4 * error and error < 0.6
    left = survival(found)
    assert (np.abs(left.share - 0.95**left.frames) < 4 * left.error).all() and left.error.max() < 0.025
    # what a mean over finished stays would say is far off: that is why censoring has to be named
    finished = found.seen @ np.arange(31) / found.seen.sum()
    assert finished < 12
    stay = residence(found, inside.sum(0))
    np.testing.assert_allclose(stay[:20], 0.95 ** np.arange(20), atol=0.03)


@given(seeds)
@settings(max_examples=20)
def test_residence_and_its_intermittent_counterpart_are_averages_over_all_origins(seed: int) -> None:
    inside, _, history = made(seed, frames=15)
    found = contacts(history)
    parts = Durations.of(found, history.frames)
    pairs = inside.sum(0)
    kept = residence(parts, pairs)
    lags = np.arange(15)
    both, once = again(found, lags, 15)
    for lag in range(15):
        origins = range(15 - lag)
        whole = sum(int(inside[:, t : t + lag + 1].all(1).sum()) for t in origins)
        asked = sum(int(pairs[t]) for t in origins)
        assert kept[lag] == pytest.approx(whole / asked, abs=1e-12)
        assert both[lag] == sum(int((inside[:, t] & inside[:, t + lag]).sum()) for t in origins)
        assert once[lag] == asked


def test_counts_of_parts_of_the_pairs_add_up_to_those_of_all() -> None:
    inside, names, history = made(11)
    whole = Durations.of(contacts(history), history.frames)
    parts = [
        Durations.of(contacts(History.of(*ledger(inside[part], [names[p] for p in part]), 25)), 25)
        for part in (range(0, 30, 2), range(1, 30, 2))
    ]
    total = parts[0] + parts[1]
    for name in ("seen", "goes_on", "older", "throughout"):
        np.testing.assert_array_equal(getattr(total, name), getattr(whole, name))
    assert total.exposure == sum(int(row[:-1].sum()) for row in inside)
