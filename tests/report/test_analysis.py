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


FLIPS = table([(1, 0, 5, True), (2, 0, 7, False), (3, 0, 5, False), (9, 0, 5, True), (9, 0, 7, True)])


def test_stays_are_counted_between_two_flips_of_one_pair():
    stays = analysis.stays(FLIPS)
    assert stays.inside.tolist() == [2]
    assert sorted(stays.outside.tolist()) == [6, 7]
    assert stays.undone_within(1) == 0
    assert stays.undone_within(6) == 2


def test_pairs_of_large_indices_are_kept_apart():
    big = 2**31 - 2
    flips = table([(1, 0, big, True), (2, 1, big, True), (3, 0, big, False), (4, big - 1, big, True)])
    assert analysis.stays(flips).inside.tolist() == [2]
    pairs = analysis.busiest_pairs(flips)
    assert next(zip(pairs.i, pairs.j, pairs.flips, strict=True)) == (0, big, 2)
    assert sorted(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)) == [
        (0, big),
        (1, big),
        (big - 1, big),
    ]


def test_busiest_pairs_come_first():
    pairs = analysis.busiest_pairs(FLIPS)
    assert (pairs.i.tolist(), pairs.j.tolist(), pairs.flips.tolist()) == ([0, 0], [5, 7], [3, 2])


@given(st.integers(0, 4))
def test_a_flip_taken_out_of_the_middle_breaks_the_alternation(pair):
    rows = [(step, pair, 9, step % 2 == 0) for step in range(7)]
    assert analysis.alternates(table(rows))
    assert not analysis.alternates(table(rows[:3] + rows[4:]))


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
    assert analysis.flips_match_series(series, FLIPS).all()
    # the same number in all, at another step
    series["left"] = np.roll(series["left"], 1)
    assert np.flatnonzero(~analysis.flips_match_series(series, FLIPS)).tolist() == [2, 4]


def test_a_run_without_flips():
    empty = {key: values[:0] for key, values in FLIPS.items()}
    assert len(analysis.stays(empty).all) == 0
    assert analysis.alternates(empty)
    assert len(analysis.busiest_pairs(empty).i) == 0
    ratio = analysis.margins_in_bounds(empty)
    assert analysis.expected_ambiguous(ratio) == 0
    assert len(analysis.closest(ratio, 5)) == 0
