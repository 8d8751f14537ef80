"""The coalescing demonstration against loops over the entries and exact sums."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mdnum.ball.demos import Demo, run
from mdnum.ball.demos.coalesce import ORDERS, PANELS, assembled, contacts
from mdnum.precision.coalesce import orders


@pytest.fixture(scope="module")
def demo() -> Demo:
    return run("coalesce")


def test_every_check_holds(demo: Demo):
    assert [check.what for check in demo.checks if not check.ok] == []


def test_the_count_is_that_of_a_loop_over_the_entries(demo: Demo):
    panel, load = contacts()
    seen = set()
    for order in orders(len(load), ORDERS, seed=1):
        totals = np.zeros(PANELS, np.float32)
        for k in order:
            totals[panel[k]] += load[k]
        seen.add(totals.tobytes())
    assert demo.numbers["distinct_scatter_add"] == len(seen) > 100
    assert demo.numbers["distinct_sorted_by_index"] == len(seen)


def test_what_does_not_care_for_order_is_one_answer(demo: Demo):
    for name in ("distinct_sorted_by_value", "distinct_exact", "distinct_fixed_point"):
        assert demo.numbers[name] == 1


def test_the_exact_answer_is_exact():
    panel, load = contacts()
    found = assembled(panel, load)["exact sum"][0]
    expected = [np.float32(math.fsum(load[panel == k].astype(float))) for k in range(PANELS)]
    assert np.array_equal(found, expected)
