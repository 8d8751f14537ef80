"""What is read from a table of flips, against tables small enough to read by eye."""

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


@given(st.integers(1, 400), st.integers(0, 2**32 - 1), st.sampled_from([0, 2**31 - 6]))
def test_a_table_seen_in_parts_says_what_a_loop_over_its_pairs_says(size, seed, label):
    """Whatever its labels, and wherever it is cut."""
    rng = np.random.default_rng(seed)
    step = np.sort(rng.integers(0, 50, 400))
    flips = table([(int(s), *(label * rng.integers(2, size=2) + rng.integers(0, 6, 2)), bool(rng.integers(2)))
                   for s in step])  # fmt: skip
    flips["margin"] = rng.normal(size=400)
    whole, parts = analysis.scan(flips, 50, 20), analysis.Scan(50, 20)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analysis, "_AT_ONCE", 30)
        for first in range(0, 400, size):
            parts.take({name: values[first : first + size] for name, values in flips.items()})
    stays = {True: [], False: []}
    last: dict[tuple[int, int], list[tuple[int, bool]]] = {}
    turned = True
    rows = zip(*(flips[name].tolist() for name in ("step", "i", "j", "entered")), strict=True)
    for s, *pair, entered in rows:
        seen = last.setdefault((pair[0], pair[1]), [])
        if seen:
            before, inside = seen[-1]
            stays[inside].append(s - before)
            turned = turned and inside != entered
        seen.append((s, entered))
    undone = sum(stay <= 3 for each in stays.values() for stay in each)
    for seen in (whole, parts):
        assert lengths(seen.stays.inside) == sorted(stays[True])
        assert lengths(seen.stays.outside) == sorted(stays[False])
        assert seen.alternates == turned and seen.stays.undone_within(3) == undone
        assert analysis.median(seen.stays.inside) == (
            pytest.approx(np.median(stays[True])) if stays[True] else None
        )
        assert sorted(seen.nearest["ratio"]) == sorted(seen.ratios)[:20]
        busiest = list(zip(seen.busiest.i.tolist(), seen.busiest.j.tolist(), strict=True))
        assert seen.busiest.flips.tolist() == [len(last[pair]) for pair in busiest]
        assert seen.busiest.flips.tolist() == sorted(map(len, last.values()), reverse=True)
        assert seen.total == seen.busiest.flips.sum() == 400
    assert whole.nearest["step"].tolist() == parts.nearest["step"].tolist()


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
    assert analysis.scan(flips, nearest=2).nearest["ratio"].tolist() == [0.5, 0]
    # even over 1000 bounds: one in a thousand lies within one
    even = np.abs(np.random.default_rng(0).uniform(-1, 1, 40_000)) / 1e-3
    assert analysis.expected_ambiguous(even) == pytest.approx(40, rel=0.03)


def test_flips_are_matched_with_the_series_step_by_step():
    series = {"step": np.arange(10), "entered": np.array([0, 1, 0, 0, 0, 0, 0, 0, 0, 2]),
              "left": np.array([0, 0, 1, 1, 0, 0, 0, 0, 0, 0])}  # fmt: skip
    series["pairs"] = 7 + np.cumsum(series["entered"] - series["left"])
    seen = analysis.scan(FLIPS, 10)
    assert seen.matches(series).all() and analysis.algebra_holds(series).all()
    series["pairs"][5] += 1
    assert np.flatnonzero(~analysis.algebra_holds(series)).tolist() == [5]
    # the same number in all, at another step
    series["left"] = np.roll(series["left"], 1)
    assert np.flatnonzero(~seen.matches(series)).tolist() == [2, 4]
    with pytest.raises(ValueError, match=r"steps 1 to 9 .* 9 steps"):
        analysis.scan(FLIPS, 9)


def test_a_run_without_flips():
    empty = {key: values[:0] for key, values in FLIPS.items()}
    seen = analysis.scan(empty)
    assert seen.stays.total == 0 and analysis.median(seen.stays.inside) is None
    assert seen.alternates and len(seen.busiest.i) == 0
    ratio = analysis.margins_in_bounds(empty)
    assert analysis.expected_ambiguous(ratio) == 0 and len(seen.nearest["ratio"]) == 0
