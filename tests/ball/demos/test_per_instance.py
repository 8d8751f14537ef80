"""The per-instance demonstration: counts by a plain loop for each rule."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum.ball.demos import Demo, run
from mdnum.ball.demos.per_instance import BATCH, STRANGER, TOL

# the whole demonstration is run
pytestmark = pytest.mark.slow

MEASURES = {"global sum": sum, "maximum": max}


@pytest.fixture(scope="module")
def demo() -> Demo:
    return run("per-instance")


def shared(depths: tuple[float, ...], measure) -> int:
    """Iterations of a batch that stops as one."""
    p, it = list(depths), 0
    while measure(p) >= TOL:
        p, it = [0.75 * one for one in p], it + 1
    return it


def test_every_check_holds(demo: Demo) -> None:
    assert [check.what for check in demo.checks if not check.ok] == []
    assert len(demo.checks) == 6


def test_coupling_is_one_under_a_sum_and_zero_per_instance(demo: Demo) -> None:
    assert demo.numbers["coupling"] == {
        "global sum": 1.0, "maximum": 0.0, "per instance": 0.0, "fixed count": 0.0,
    }  # fmt: skip


@pytest.mark.parametrize("name", MEASURES)
def test_counts_of_rules_for_all_are_those_of_a_loop(demo: Demo, name: str) -> None:
    alone, joined = shared(BATCH, MEASURES[name]), shared((*BATCH, STRANGER), MEASURES[name])
    assert demo.numbers["iterations_before"][name] == [alone] * len(BATCH)
    assert demo.numbers["iterations_after"][name] == [joined] * len(BATCH)


def test_a_rule_for_each_ball_counts_as_if_it_were_alone(demo: Demo) -> None:
    alone = [shared((depth,), sum) for depth in BATCH]
    assert len(set(alone)) > 2
    assert demo.numbers["iterations_before"]["per instance"] == alone
    assert demo.numbers["iterations_after"]["per instance"] == alone


def test_the_derivative_that_the_stranger_changes(demo: Demo) -> None:
    counts = [shared(BATCH, sum), shared((*BATCH, STRANGER), sum)]
    assert counts == [7, 8]
    expected = [-np.mean(BATCH) * n * 0.75 ** (n - 1) * 0.5 for n in counts]
    np.testing.assert_allclose(demo.numbers["grad_k"]["global sum"], expected, rtol=1e-12)
    before, after = demo.numbers["grad_k"]["per instance"]
    assert before == after < 0
