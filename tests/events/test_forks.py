"""Dates, growth rates and verdicts of made-up separations whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.events.forks import Dates, growth, judge, split_of


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
