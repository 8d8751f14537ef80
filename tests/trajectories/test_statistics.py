"""Contacts, lifetimes, rates and strides against loops over tables of decisions, and estimates by hand."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace
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
    between_frames,
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
    history = History.of(flips[keep], first, inside.shape[1])
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
    # 4 leaves in 1 + 2 + 2 + 4 frames inside, and 2 more after which the last one was seen to stay
    assert mean_by_rate(Durations(*counts)) == (11 / 4, 11 / 8)


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


@given(seeds, st.booleans())
@settings(max_examples=20)
def test_flips_and_time_inside_by_class(seed: int, directed: bool) -> None:
    inside, names, history = made(seed)
    classes = np.random.default_rng(seed).integers(0, 3, 8)
    found = ClassTally.of(contacts(history), Classes(classes, ["a", "b", "c"]), inside.shape[1], directed)
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
    assert np.isnan(found.mean_stay[found.left == 0]).all()


@given(seeds, st.integers(1, 8))
@settings(max_examples=20)
def test_flips_taken_back_and_how_soon(seed: int, window: int) -> None:
    inside, _, history = made(seed)
    found = Chatter.of(history, window)
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
    inside, names, whole = made(seed)
    frames = inside.shape[1]
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
    joined = (parts[0] + parts[1]).first(6)
    for name in ("i", "j", "rank", "flips", "inside"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(found, name))


def test_flips_of_groups_with_others_and_within() -> None:
    inside, names, history = made(4)
    residues = np.array([0, 0, 1, 1, 1, 2, 3, 3])
    found = Residues.of(history, Classes(residues, ["r"] * 5))
    expected = np.zeros((2, 5), int)
    for (i, j, _), row in zip(names, inside, strict=True):
        flips = int((np.diff(row.astype(int)) != 0).sum())
        if residues[i] == residues[j]:
            expected[1, residues[i]] += flips
        else:
            expected[0, residues[i]] += flips
            expected[0, residues[j]] += flips
    np.testing.assert_array_equal([found.between, found.within], expected)


def flips_of(inside: np.ndarray) -> int:
    return int((np.diff(inside.astype(int), axis=1) != 0).sum())


@given(st.integers(0, 10**6), st.integers(1, 9))
@settings(max_examples=30)
def test_flips_of_every_so_manieth_frame(seed: int, stride: int) -> None:
    inside, _, history = made(seed)
    found = Strides.of_history(history, [1, stride])
    assert found.flips[1] == flips_of(inside[:, ::stride])
    assert found.of[1] == flips_of(inside[:, : (inside.shape[1] - 1) // stride * stride + 1])
    assert found.flips[0] == found.of[0] == flips_of(inside)
    doubled = found + found
    np.testing.assert_array_equal(doubled.flips, 2 * found.flips)


def test_strides_leave_four_intervals() -> None:
    assert doublings(1) == doublings(8) == [1]
    assert doublings(9) == [1, 2] and doublings(41) == [1, 2, 4, 8]


def history_of(inside: np.ndarray) -> History:
    return History.of(*ledger(inside, [(n, n + 1, 0) for n in range(len(inside))]), inside.shape[1])


def test_smooth_motion_tells_what_lies_between_its_frames() -> None:
    """Distances that swing with a few frequencies; the truth is the same motion at 32 times the frames."""
    rng = np.random.default_rng(2)
    fine = np.arange(0, 32 * 120) / 32
    phases, rates = rng.uniform(0, 2 * np.pi, (300, 4, 1)), rng.uniform(0.2, 1.6, (300, 4, 1))
    distance = np.sum(np.cos(rates * fine + phases), axis=1)
    inside = distance < 1.0
    found = between_frames(Strides.of_history(history_of(inside[:, ::32]), doublings(120)))
    truth = 1 - flips_of(inside[:, ::32]) / flips_of(inside)
    assert found is not None and found.lost is not None
    assert 0.01 < truth < 0.2
    assert found.low is not None and found.high is not None
    assert found.low <= truth <= found.high and truth / 3 < found.lost < 3 * truth


def test_brownian_motion_has_no_number_between_its_frames_and_is_told_so() -> None:
    rng = np.random.default_rng(3)
    inside = np.cumsum(rng.normal(size=(1500, 200)), axis=1) < 0
    found = between_frames(Strides.of_history(history_of(inside), doublings(200)))
    assert found is not None and found.lost is None and found.high is None and found.doubled > 0.2
    assert found.reason == "brownian"


def test_a_liquid_tells_what_lies_between_its_frames() -> None:
    """Flips left at strides 1, 2, 4, ... of argon/liquid-864, 10,000 steps of 2 fs, as mdnum counted them."""
    left = [218131, 218111, 218089, 217979, 217609, 215709, 209961, 191843, 154071, 109495, 72569]
    of = [218131, 218131, 218131, 218131, 218131, 217773, 217773, 217773, 217773, 212205, 201009]
    share = np.array(left) / np.array(of)
    for start in (4, 5, 6):
        # the run as a file with every 16th, 32nd or 64th step would hold it
        kept = np.round(1e6 * share[start : start + 4] / share[start]).astype(int)
        found = between_frames(Strides(np.array([1, 2, 4, 8]), kept, np.full(4, 10**6), np.zeros(4, int)))
        truth = 1 - share[start]
        assert found is not None and None not in (found.lost, found.low, found.high)
        assert found.low < truth < found.high
        assert found.lost == pytest.approx(truth, rel=0.25)
    # and where flips are few and the loss is small, it says so
    none = np.zeros(4, int)
    few = between_frames(Strides(np.array([1, 2, 4, 8]), np.array(left[:4]), np.array(of[:4]), none))
    assert few is not None and few.lost is not None and few.lost < 1e-3


def test_every_range_has_a_width_that_holds_the_truth_with_three_strides_and_with_few_flips() -> None:
    """Shares of liquid argon's flips at strides 1, 2 and 4 of every 64th step, where 3.7 % were lost."""
    for flips in (10**6, 43_000, 3_000):
        kept = np.round(flips * np.array([1.0, 0.9132, 0.7301])).astype(int)
        found = between_frames(Strides(np.array([1, 2, 4]), kept, np.full(3, flips), np.zeros(3, int)))
        assert found is not None and None not in (found.lost, found.low, found.high)
        assert found.low < 0.037 < found.high < 0.2 and found.low < found.lost < found.high
    nothing = between_frames(Strides(np.array([1, 2, 4]), *np.array([[90] * 3, [90] * 3, [0] * 3])))
    assert nothing is not None and nothing.lost == 0.0 and 0.0 < nothing.high < 0.2


def hovering(rng: np.random.Generator, grid: float) -> tuple[History, int]:
    """Pairs in smooth slow motion, read with and without rounding to a grid; and the flips that happened."""
    time = np.arange(200) / 16
    phases, rates = rng.uniform(0, 2 * np.pi, (400, 4, 1)), rng.uniform(0.2, 1.6, (400, 4, 1))
    distance = 5.0 + np.sum(np.cos(rates * time + phases), axis=1)
    seen = distance + rng.uniform(-grid / 2, grid / 2, distance.shape)
    inside = seen < 6.0
    flips, first = ledger(inside, [(n, n + 1, 0) for n in range(len(inside))])
    near = np.abs(seen - 6.0) <= grid / 2
    # decided by the file: neither end of the flip is further from the threshold than the grid reaches
    unsure = near[flips.i, flips.frame] | near[flips.i, flips.frame - 1]
    return History.of(replace(flips, ambiguous=unsure), first, 200), flips_of(distance < 6.0)


def test_chatter_within_the_digits_of_a_file_is_not_told_as_motion_between_its_frames() -> None:
    rng = np.random.default_rng(11)
    found, happened = hovering(rng, 0.3)
    assert len(found.frame) > 1.2 * happened  # rounding made flips up
    strides = Strides.of_history(found, doublings(200))
    said = between_frames(strides)
    assert said is not None and said.lost is None and said.low is None and said.reason == "rounding"
    # a grid that is fine for the same motion takes nothing from the number
    fine, happened = hovering(np.random.default_rng(11), 1e-9)
    said = between_frames(Strides.of_history(fine, doublings(200)))
    assert said is not None and said.lost is not None and said.lost < 0.01
    # and the count of what rounding may have made adds up over parts of the pairs
    np.testing.assert_array_equal((strides + strides).doubtful, 2 * strides.doubtful)


def test_too_few_frames_or_no_flips_say_nothing() -> None:
    inside, names = random_membership(5, frames=8)
    one = History.of(*ledger(inside, names), 8)
    assert between_frames(Strides.of_history(one, doublings(8))) is None
    still = History.of(*ledger(np.ones((3, 40), bool), [(0, 1, 0), (0, 2, 0), (1, 2, 0)]), 40)
    assert between_frames(Strides.of_history(still, doublings(40))) is None


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
