"""What is read from a table of flips, against a table small enough to read by eye."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.report import analysis


def table(
    rows: list[tuple[int, int, int, bool]], margin: float = 0.5, bound: float = 0.1
) -> dict[str, np.ndarray]:
    step, i, j, entered = (np.array(column) for column in zip(*rows, strict=True))
    size = len(rows)
    return {"step": step, "i": i.astype(np.int32), "j": j.astype(np.int32), "entered": entered,
            "margin": np.full(size, margin), "bound": np.full(size, bound)}  # fmt: skip


def lengths(counts: np.ndarray) -> list[int]:
    return np.repeat(np.arange(len(counts)), counts).tolist()


FLIPS = table([(1, 0, 5, True), (2, 0, 7, False), (3, 0, 5, False), (9, 0, 5, True), (9, 0, 7, True)])


def test_stays_are_counted_between_two_flips_of_one_pair():
    stays = analysis.scan(FLIPS).stays
    assert lengths(stays.inside) == [2]
    assert lengths(stays.outside) == [6, 7]
    assert stays.total == 3
    assert (analysis.median(stays.inside), analysis.median(stays.outside)) == (2, 6.5)
    assert stays.undone_within(1) == 0
    assert stays.undone_within(6) == 2


def test_pairs_of_large_indices_are_kept_apart():
    big = 2**31 - 2
    flips = table([(1, 0, big, True), (2, 1, big, True), (3, 0, big, False), (4, big - 1, big, True)])
    assert lengths(analysis.scan(flips).stays.inside) == [2]
    pairs = analysis.scan(flips).busiest
    assert next(zip(pairs.i, pairs.j, pairs.flips, strict=True)) == (0, big, 2)
    assert sorted(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)) == [
        (0, big),
        (1, big),
        (big - 1, big),
    ]


def test_busiest_pairs_come_first():
    pairs = analysis.scan(FLIPS).busiest
    assert (pairs.i.tolist(), pairs.j.tolist(), pairs.flips.tolist()) == ([0, 0], [5, 7], [3, 2])


@given(st.integers(0, 4))
def test_a_flip_taken_out_of_the_middle_breaks_the_alternation(pair):
    rows = [(step, pair, 9, step % 2 == 0) for step in range(7)]
    assert analysis.scan(table(rows)).alternates
    assert not analysis.scan(table(rows[:3] + rows[4:])).alternates


def test_margins_in_units_of_rounding():
    flips = table([(1, 0, 5, True)] * 4)
    flips["margin"] = np.array([-3e-14, 1e-14, 0.0, 0.5])
    flips["bound"] = np.array([1e-14, 2e-14, 0.0, 0.0])
    ratio = analysis.margins_in_bounds(flips)
    np.testing.assert_allclose(ratio, [3, 0.5, 0, np.inf])
    assert analysis.closest(ratio, 2).tolist() == [2, 1]


def test_expected_ambiguous_flips_of_even_margins():
    rng = np.random.default_rng(0)
    flips = table([(1, 0, 5, True)] * 40_000)
    # even over 1000 bounds: one in a thousand lies within one
    flips["margin"] = rng.uniform(-1, 1, 40_000)
    flips["bound"] = np.full(40_000, 1e-3)
    assert analysis.expected_ambiguous(analysis.margins_in_bounds(flips)) == pytest.approx(40, rel=0.03)


def test_event_algebra():
    series = {"step": np.arange(4), "pairs": np.array([7, 9, 8, 8]), "entered": np.array([0, 3, 0, 2]),
              "left": np.array([0, 1, 1, 2])}  # fmt: skip
    assert analysis.algebra_holds(series).all()
    series["pairs"][2] += 1
    assert analysis.algebra_holds(series).tolist() == [True, True, False, True]


def test_flips_are_matched_with_the_series_step_by_step():
    series = {"step": np.arange(10), "entered": np.array([0, 1, 0, 0, 0, 0, 0, 0, 0, 2]),
              "left": np.array([0, 0, 1, 1, 0, 0, 0, 0, 0, 0])}  # fmt: skip
    assert analysis.scan(FLIPS, 10).matches(series).all()
    # the same number in all, at another step
    series["left"] = np.roll(series["left"], 1)
    assert np.flatnonzero(~analysis.scan(FLIPS, 10).matches(series)).tolist() == [2, 4]


def test_a_run_without_flips():
    empty = {key: values[:0] for key, values in FLIPS.items()}
    seen = analysis.scan(empty)
    assert seen.stays.total == 0 and analysis.median(seen.stays.inside) is None
    assert seen.alternates
    assert len(seen.busiest.i) == 0
    ratio = analysis.margins_in_bounds(empty)
    assert analysis.expected_ambiguous(ratio) == 0
    assert len(analysis.closest(ratio, 5)) == 0


@given(st.integers(1, 400), st.integers(0, 2**32 - 1))
def test_a_table_seen_in_parts_says_what_it_says_as_a_whole(size, seed):
    rng = np.random.default_rng(seed)
    step = np.sort(rng.integers(0, 50, 400))
    flips = table([(int(s), *map(int, rng.integers(0, 6, 2)), bool(rng.integers(2))) for s in step])
    flips["margin"] = rng.normal(size=400)
    whole, parts = analysis.scan(flips, 50, 20), analysis.Scan(50, 20)
    for first in range(0, 400, size):
        parts.take({name: values[first : first + size] for name, values in flips.items()})
    # by hand: the stays of each pair, one pair at a time
    stays = {True: [], False: []}
    last: dict[tuple[int, int], tuple[int, bool]] = {}
    turned = True
    rows = zip(*(flips[name].tolist() for name in ("step", "i", "j", "entered")), strict=True)
    for s, *pair, entered in rows:
        if tuple(pair) in last:
            before, inside = last[tuple(pair)]
            stays[inside].append(s - before)
            turned = turned and inside != entered
        last[tuple(pair)] = (s, entered)
    for seen in (whole, parts):
        assert lengths(seen.stays.inside) == sorted(stays[True])
        assert lengths(seen.stays.outside) == sorted(stays[False])
        assert seen.alternates == turned
        assert analysis.median(seen.stays.inside) == pytest.approx(np.median(stays[True]))
        assert sorted(seen.nearest["ratio"]) == sorted(seen.ratios)[:20]
        assert seen.total == seen.busiest.flips.sum() == 400
    assert whole.busiest.flips.tolist() == parts.busiest.flips.tolist()
    assert whole.nearest["step"].tolist() == parts.nearest["step"].tolist()


def test_a_flip_at_a_step_that_was_not_made_is_refused():
    with pytest.raises(ValueError, match="of a run of 9 rows"):
        analysis.scan(FLIPS, 9)
