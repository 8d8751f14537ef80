"""Contacts, lifetimes, rates and strides against loops over tables of decisions, and estimates by hand."""

from __future__ import annotations

import itertools
from collections import Counter
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trajectories.membership import ledger, random_membership, stays

from mdnum.trajectories.frame import Box, Frame
from mdnum.trajectories.history import (
    Contacts,
    History,
    Strides,
    contacts,
    crossings,
    doublings,
    mended,
)
from mdnum.trajectories.statistics import (
    Busiest,
    Chatter,
    Classes,
    ClassTally,
    Durations,
    Lifetime,
    Residues,
    again,
    mean_by_rate,
    residence,
    survival,
)

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


@given(seeds, st.integers(0, 6))
@settings(max_examples=40)
def test_every_stay_is_found_with_what_was_not_seen_of_it(seed: int, gap: int) -> None:
    """And stays with short gaps between count as one where that is asked for."""
    inside, names, history = made(seed)
    assert listed(contacts(history), names) == stays(inside)
    kept = [row for row in range(len(names)) if inside[row].any()]
    assert [names.index(name) for name in zip(history.i, history.j, history.rank, strict=True)] == kept
    filled = inside.copy()
    for row in filled:
        for one, following in itertools.pairwise(np.flatnonzero(row)):
            if following - one - 1 <= gap:
                row[one:following] = True
    assert listed(mended(contacts(history), gap), names) == stays(filled)


def test_pairs_too_many_to_pack_into_one_number_are_sorted_all_the_same() -> None:
    inside, names = random_membership(3)
    far = [(i + 2**31, j + 2**31, rank) for i, j, rank in names]
    found = contacts(History.of(*ledger(inside, far), inside.shape[1]))
    assert listed(found, far) == stays(inside)


def test_a_missing_flip_is_noticed() -> None:
    inside, names = random_membership(1)
    flips, first = ledger(inside, names)
    history = History.of(flips[np.arange(len(flips)) != 7], first, inside.shape[1])
    # it was not the pair's last one, after which nothing contradicts
    with pytest.raises(ValueError, match="missing"):
        contacts(history)


def test_no_pair_at_all_and_one_frame() -> None:
    flips, first = ledger(np.zeros((0, 4), bool), [])
    history = History.of(flips, first, 4)
    found = Durations.of(contacts(history), 4)
    assert not len(contacts(history)) and mean_by_rate(found)[0] == np.inf
    assert survival(found).longest == 0 and survival(found).mean == 0
    only = contacts(History.of(*ledger(np.ones((2, 1), bool), [(0, 1, 0), (0, 2, 0)]), 1))
    assert only.begin.tolist() == [0, 0] and only.end.tolist() == [1, 1]
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
    # the first frames at which at most three quarters, half and a quarter are left
    lifetime = Lifetime.of(Durations(*counts))
    assert (lifetime.quarter_gone, lifetime.median, lifetime.three_quarters_gone) == (2, 2, 4)
    assert (lifetime.followed, lifetime.leaves, lifetime.longest) == (5, 4, found.longest)
    assert lifetime.mean == found.mean and lifetime.mean_is_whole
    # 4 leaves in 1 + 2 + 2 + 4 frames inside, and 2 more after which the last one was seen to stay
    assert mean_by_rate(Durations(*counts)) == (11 / 4, 11 / 8)


@given(seeds)
@settings(max_examples=20)
def test_residence_and_its_intermittent_counterpart_are_averages_over_all_origins(seed: int) -> None:
    inside, _, history = made(seed, frames=15)
    found, pairs = contacts(history), inside.sum(0)
    kept = residence(Durations.of(found, history.frames), pairs)
    both, once = again(found, np.arange(15), 15)
    for lag in range(15):
        origins = range(15 - lag)
        asked = sum(int(pairs[t]) for t in origins)
        whole = sum(int(inside[:, t : t + lag + 1].all(1).sum()) for t in origins)
        assert kept[lag] == pytest.approx(whole / asked, abs=1e-12)
        assert both[lag] == sum(int((inside[:, t] & inside[:, t + lag]).sum()) for t in origins)
        assert once[lag] == asked


@given(seeds, st.booleans(), st.integers(1, 9))
@settings(max_examples=30)
def test_what_is_counted_of_pairs_is_what_plain_loops_count(seed: int, directed: bool, window: int) -> None:
    """By class and group, by how soon a flip is reversed, by pair, by stride; and parts add up."""
    inside, names, history = made(seed)
    classes = np.random.default_rng(seed).integers(0, 3, 8)
    groups, frames, flips = Classes(classes, ["a", "b", "c"]), inside.shape[1], np.diff(inside.astype(int))
    parts = [range(0, 30, 2), range(1, 30, 2)]
    halves = [History.of(*ledger(inside[part], [names[p] for p in part]), frames) for part in parts]
    found = ClassTally.of(contacts(history), groups, frames, directed)
    entered, left, time, exposed = (np.zeros((3, 3), int) for _ in range(4))
    grouped, within, beyond = np.zeros((2, 3), int), Counter(), Counter()
    for (i, j, _), row, flipped in zip(names, inside.astype(int), flips, strict=True):
        pair = (classes[i], classes[j]) if directed else tuple(sorted((classes[i], classes[j])))
        entered[pair] += (flipped == 1).sum()
        left[pair] += (flipped == -1).sum()
        time[pair] += row.sum()
        exposed[pair] += row[:-1].sum()
        for group in {classes[i], classes[j]}:
            grouped[int(classes[i] == classes[j]), group] += np.count_nonzero(flipped)
        for one, following in itertools.pairwise(np.flatnonzero(flipped) + 1):
            (within if row[one] else beyond)[int(following - one)] += 1
    np.testing.assert_array_equal([found.entered, found.left, found.inside], [entered, left, time])
    np.testing.assert_array_equal(found.exposure, exposed)
    assert np.isnan(found.mean_stay[found.left == 0]).all()
    residues, chatter = Residues.of(history, groups), Chatter.of(history, window)
    np.testing.assert_array_equal([residues.between, residues.within], grouped)
    assert chatter.flips == np.count_nonzero(flips) and chatter.window == window
    assert chatter.inside.tolist() == [within[n] for n in range(window + 1)]
    assert chatter.outside.tolist() == [beyond[n] for n in range(window + 1)]
    assert chatter.undone == sum(chatter.inside) + sum(chatter.outside)
    busiest = Busiest.of(history, contacts(history), 40)
    expected = sorted(zip((-(flips != 0).sum(1)).tolist(), names, inside.sum(1).tolist(), strict=True))
    columns = (-busiest.flips, busiest.i, busiest.j, busiest.rank, busiest.inside)
    told = list(zip(*(column.tolist() for column in columns), strict=True))
    assert told == [(less, *name, there) for less, name, there in expected if less]
    one, other = (Busiest.of(half, contacts(half), 40) for half in halves)
    assert (one + other).first(40).equals(busiest)
    strides = Strides.of_history(history, [1, window])
    assert strides.flips[1] == flips_of(inside[:, ::window])
    assert strides.of[1] == flips_of(inside[:, : (frames - 1) // window * window + 1])
    assert strides.flips[0] == strides.of[0] == flips_of(inside)
    durations = [Durations.of(contacts(one), frames) for one in (history, *halves)]
    total, halved = durations[0], durations[1] + durations[2]
    for name in ("seen", "goes_on", "older", "throughout"):
        np.testing.assert_array_equal(getattr(halved, name), getattr(total, name))
    assert halved.exposure == exposed.sum()
    several = [Strides.of_history(one, [1, window]) for one in halves]
    np.testing.assert_array_equal((several[0] + several[1]).flips, strides.flips)


def flips_of(inside: np.ndarray) -> int:
    return int((np.diff(inside.astype(int), axis=1) != 0).sum())


def test_strides_leave_four_intervals() -> None:
    assert doublings(1) == doublings(8) == [1]
    assert doublings(9) == [1, 2] and doublings(41) == [1, 2, 4, 8]


def test_the_flux_of_an_ideal_gas_is_the_closed_form() -> None:
    """Points with Gaussian velocities cross r_cut at the rate pairs x 4 pi r² <|v_n|> / volume."""
    rng = np.random.default_rng(7)
    side, atoms, r_cut = 12.0, 1_500, 3.0
    frame = Frame(
        0, 0.0, rng.uniform(0, side, (atoms, 3)), Box(np.eye(3) * side, np.ones(3, bool)),
        rng.normal(size=(atoms, 3)),
    )  # fmt: skip

    def count(one: Frame, other: Frame) -> int:
        sets = []
        for positions in (one.positions, other.positions):
            apart = positions[:, None] - positions[None]
            apart -= side * np.round(apart / side)
            sets.append(np.sum(apart**2, axis=2) < r_cut**2)
        return int(np.triu(sets[0] ^ sets[1], 1).sum())

    found = crossings(frame, count, 0.02)
    assert found is not None
    flips, moment = found
    pairs = atoms * (atoms - 1) / 2
    # the radial part of the difference of two velocities has variance 2
    expected = pairs * 4 * np.pi * r_cut**2 / side**3 * np.sqrt(2) * np.sqrt(2 / np.pi)
    assert flips / moment == pytest.approx(expected, rel=0.1)
    assert moment == pytest.approx(0.02 / np.sqrt(3), rel=0.05)
    resting = Frame(0, 0.0, frame.positions, frame.box, np.zeros_like(frame.positions))
    assert crossings(resting, count, 0.02) is None
    assert crossings(Frame(0, 0.0, frame.positions, frame.box), count, 0.02) is None
