"""The sum-order demonstration against a plain loop in numpy's float16."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball.demos import Demo, run


@pytest.fixture(scope="module")
def demo() -> Demo:
    return run("sum-order")


def loop(terms):
    total, seen = np.float16(0), []
    for term in terms:
        total = np.float16(total + np.float16(term))
        seen.append(float(total))
    return seen


LARGE, SMALL, TOL = 2.0**-10 - 2.0**-21, 2.0**-23, 2.0**-10


def test_every_check_holds(demo: Demo):
    assert [check.what for check in demo.checks if not check.ok] == []
    assert len(demo.checks) == 7


def test_the_two_sums_are_those_of_a_loop(demo: Demo):
    assert demo.numbers["large_first"] == loop([LARGE] + 4 * [SMALL])[-1] < TOL
    assert demo.numbers["small_first"] == loop(4 * [SMALL] + [LARGE])[-1] == TOL
    assert f"{demo.numbers['large_first']:.13f}" == "0.0009760856628"
    assert f"{demo.numbers['small_first']:.10f}" == "0.0009765625"
    assert demo.numbers["large_first_stops"] is True
    assert demo.numbers["small_first_stops"] is False
    # the solver of the ball did as the sums say: no iteration, and one
    assert demo.numbers["iterations"] == [0, 1]


def test_the_table_is_the_loop_with_what_was_lost(demo: Demo):
    large, small = demo.tables[:2]
    assert large.columns == ("term", "addend", "running sum", "exact sum", "bits lost")
    assert [row[2] for row in large.rows] == loop([LARGE] + 4 * [SMALL])
    assert [row[2] for row in small.rows] == loop(4 * [SMALL] + [LARGE])
    assert [row[4] for row in large.rows] == [0, 2, 2, 2, 2]
    assert [row[4] for row in small.rows] == [0, 0, 0, 0, 0]


def test_a_sum_in_float32_hides_it(demo: Demo):
    wide = float(np.sum(np.array([LARGE] + 4 * [SMALL], np.float16).astype(np.float32)))
    assert demo.numbers["jnp_sum"] == [wide, wide] == [TOL, TOL]


def test_compensated_and_exact_sums_are_right(demo: Demo):
    right = {name for name, total in demo.data["reductions"].items() if total == TOL}
    assert {"kahan", "neumaier", "exact", "fixed-point", "sorted", "reversed"} <= right
    assert "sequential" not in right
