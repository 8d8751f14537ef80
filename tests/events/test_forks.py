"""Dates, growth rates and verdicts of made-up separations whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.events.forks import Dates, expected, growth, judge, split_of


def grown(rate: float, steps: int, start: float = 1e-15, top: float = 3.0) -> np.ndarray:
    return np.minimum(start * np.exp(rate * np.arange(steps)), top)


@given(st.floats(0.01, 0.2), st.floats(-16, -10))
def test_the_rate_of_an_exponential_is_found(rate, start):
    separation = grown(rate, 4000, 10.0**start)
    fit = growth(separation, 0.1)
    assert fit.rate == pytest.approx(rate, rel=1e-9)
    assert fit.r_squared > 1 - 1e-12
    assert fit.steps_to(1e-15, 1.0) == pytest.approx(np.log(1e15) / rate, rel=1e-6)


def test_without_growth_there_is_no_prediction():
    fit = growth(np.full(300, 1e-9), 0.1)
    assert fit.steps_to(1e-9, 1.0) is None or abs(fit.rate) < 1e-12
    assert np.isnan(growth(np.zeros(300), 0.1).rate)


@pytest.fixture
def free():
    return grown(0.02, 3000)


def dates(free, fork=400):
    return Dates(0, fork, split_of(free, 0.1))


def test_same_and_no_fork(free):
    assert judge(Dates(None, None, None), np.zeros(50), None, 0.1).word == "same"
    assert judge(Dates(0, None, None), free[:100], None, 0.1).word == "no fork"


def test_a_horizon_too_short_says_how_long_it_would_take(free):
    verdict = judge(Dates(0, 400, None), free[:900], None, 0.1)
    assert verdict.word == "open"
    left = split_of(free, 0.1) - 899
    assert any(
        f"about {left} steps" in reason or f"about {left - 1} steps" in reason for reason in verdict.reasons
    )


def test_a_cause_is_a_split_that_does_not_come(free):
    verdict = judge(dates(free), free, np.full(3000, 1e-9), 0.1, chance=[1600, 1620])
    assert verdict.word == "cause" and verdict.nats == float("inf")


def test_a_cause_needs_steps_after_the_split(free):
    end = split_of(free, 0.1) + 20
    assert judge(dates(free), free[:end], np.full(end, 1e-9), 0.1).word == "open"


def test_hurried_is_later_beyond_chance(free):
    handed = np.concatenate([np.full(300, 1e-15), free])[:3000]
    split = split_of(free, 0.1)
    assert judge(dates(free), free, handed, 0.1, chance=[split + 10, split - 15]).word == "hurried"
    assert judge(dates(free), free, handed, 0.1, chance=[split + 900, split - 700]).word == "bystander"
    verdict = judge(dates(free), free, handed, 0.1, chance=[split + 10, split - 15])
    assert verdict.nats == pytest.approx(300 * 0.02, rel=1e-6)


def test_a_bystander_splits_as_early_or_earlier(free):
    split = split_of(free, 0.1)
    assert judge(dates(free), free, free, 0.1, chance=[split + 5]).word == "bystander"
    earlier = np.append(free[40:], np.full(40, 3.0))
    assert judge(dates(free), free, earlier, 0.1, chance=[split + 5]).word == "bystander"


def test_without_repeats_that_split_a_delay_is_open(free):
    handed = np.concatenate([np.full(300, 1e-15), free])[:3000]
    for chance in ((), (None, None)):
        verdict = judge(dates(free), free, handed, 0.1, chance=chance)
        assert verdict.word == "open"
        assert "no repeat tells whether 300 steps later is chance" in verdict.reasons


def test_a_repeat_that_does_not_split_bounds_the_scatter_from_below(free):
    handed = np.concatenate([np.full(300, 1e-15), free])[:3000]
    split = split_of(free, 0.1)
    verdict = judge(dates(free), free, handed, 0.1, chance=[split, None])
    assert verdict.word == "bystander" and verdict.noise == pytest.approx(2 * (2999 - split))
    # eight of nine agree: later than the bound on their scatter proves nothing
    late = np.concatenate([np.full(299, 1e-15), free])[: split + 301]
    verdict = judge(dates(free), free[: split + 301], late, 0.1, chance=[*8 * [split], None])
    assert verdict.word == "open" and verdict.noise == pytest.approx(2 * np.sqrt(2) * 300 / 3)
    assert any(f"1 did not split within {split + 300} steps" in reason for reason in verdict.reasons)


def test_less_than_a_power_of_e_counts_as_no_difference_and_says_so(free):
    split = split_of(free, 0.1)
    handed = np.concatenate([np.full(40, 1e-15), free])[:3000]
    verdict = judge(dates(free), free, handed, 0.1, chance=[split + 2, split - 2])
    assert verdict.word == "bystander" and verdict.noise < 40
    assert any("less than one power of e of separation (0.8)" in reason for reason in verdict.reasons)


def test_close_to_the_tolerance_is_no_cause(free):
    verdict = judge(dates(free), free, np.full(3000, 0.05), 0.1, chance=[1600, 1620])
    assert verdict.word == "open"
    assert any("within one power of e" in reason for reason in verdict.reasons)


def test_a_split_before_the_fork_is_no_flips_doing(free):
    verdict = judge(dates(free, fork=2500), free, free, 0.1)
    assert verdict.word == "bystander"
    assert "before any decision differed" in verdict.reasons[0]


def test_first_steps_predict_nothing():
    step = np.arange(61.0)
    assert expected(1e-9 * step**2, 0.1) is None
    assert expected(1e-9 * step**2, 0.1, exponent=0.0036) == pytest.approx(np.log(0.1 / 3.6e-6) / 0.0036)
    verdict = judge(Dates(0, 5, None), 1e-9 * step**2, None, 0.1)
    assert any("so few steps" in reason for reason in verdict.reasons)


def test_an_end_of_one_run_is_a_fork_by_itself():
    verdict = judge(Dates(0, 0, None), np.zeros(1), None, 0.1, ended="run B ended in a runaway at step 0")
    assert verdict.word == "open" and "that is the fork" in verdict.reasons[0]


def test_a_split_under_the_others_decisions_alone_is_told(free):
    verdict = judge(Dates(0, 400, None), free[:900], free[-900:], 0.1)
    assert verdict.word == "open" and verdict.handed == 0
    assert any("keep them together" in reason for reason in verdict.reasons)
