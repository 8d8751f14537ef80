"""Dates, growth rates and verdicts of made-up separations whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.numerics import verdicts
from mdnum.numerics.verdicts import Dates, Delay, ForkVerdict, expected, growth, split_of
from mdnum.verbs.fork_verdict import TEXTS


def judge(*given, **options) -> ForkVerdict:
    """The verdict, each of whose reasons has a sentence for its values."""
    verdict = verdicts.judge(*given, **options)
    for code, values in verdict.reasons:
        assert TEXTS(f"reason_{code}", **values, unit="σ").endswith(".")
    return verdict


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
    assert dict(verdict.reasons)["growing"]["steps"] in (left - 1, left)


def test_a_cause_is_a_split_that_does_not_come(free):
    verdict = judge(dates(free), free, np.full(3000, 1e-9), 0.1)
    assert verdict.word == "cause" and verdict.e_foldings == float("inf")


def test_a_cause_needs_steps_after_the_split(free):
    end = split_of(free, 0.1) + 20
    assert judge(dates(free), free[:end], np.full(end, 1e-9), 0.1).word == "open"


def later(free, *gains):
    """Repeats whose flips are worth so many steps."""
    split = split_of(free, 0.1)
    return [Delay(split - 7, split - 7 + gain, 2999, 2999) for gain in gains]


def test_two_repeats_tell_nothing(free):
    """However little they scatter."""
    imposed = np.concatenate([np.full(300, 1e-15), free])[:3000]
    verdict = judge(dates(free), free, imposed, 0.1, later(free, 300, 301))
    assert verdict.word == "undecided" and verdict.wanted == 3
    assert judge(dates(free), free, imposed, 0.1, later(free, 300, 301), most=2).wanted == 0


def test_accelerated_is_later_in_most_repeats(free):
    imposed = np.concatenate([np.full(300, 1e-15), free])[:3000]
    verdict = judge(dates(free), free, imposed, 0.1, later(free, *5 * [60]))
    assert verdict.word == "accelerated" and verdict.wanted == 0
    assert verdict.e_foldings == pytest.approx(300 * 0.02, rel=1e-6)
    assert verdict.threshold == pytest.approx(50)
    # one of six not: it is looked at again after eleven, and after sixteen
    gains = [60, 60, 60, 60, 40]
    assert judge(dates(free), free, imposed, 0.1, later(free, *gains)).wanted == 5
    assert judge(dates(free), free, imposed, 0.1, later(free, *gains, *5 * [60])).word == "accelerated"
    verdict = judge(dates(free), free, imposed, 0.1, later(free, *gains, 40, *4 * [60]))
    assert verdict.word == "undecided" and verdict.wanted == 5
    verdict = judge(dates(free), free, imposed, 0.1, later(free, *gains, 40, *4 * [60], *5 * [40]))
    assert verdict.word == "undecided" and verdict.wanted == 0
    assert (verdict.count.later, verdict.count.not_later) == (9, 7)


def test_a_bystander_is_not_later_in_most_repeats(free):
    for gain in (0, -40, 40):
        assert judge(dates(free), free, free, 0.1, later(free, *5 * [gain])).word == "bystander"
    # less than one e-folding, which is 50 steps here, beyond any scatter
    imposed = np.concatenate([np.full(40, 1e-15), free])[:3000]
    verdict = judge(dates(free), free, imposed, 0.1, later(free, *5 * [40]))
    assert verdict.word == "bystander" and verdict.e_foldings == pytest.approx(0.8)


def test_without_repeats_nothing_is_said_of_a_delay(free):
    imposed = np.concatenate([np.full(300, 1e-15), free])[:3000]
    for run in (imposed, free):
        verdict = judge(dates(free), free, run, 0.1, most=0)
        assert verdict.word == "undecided" and verdict.wanted == 0


def test_what_was_not_seen_counts_for_neither(free):
    imposed = np.concatenate([np.full(300, 1e-15), free])[:3000]
    unseen = [Delay(1600, None, 2999, 1640)] * 5
    verdict = judge(dates(free), free, imposed, 0.1, unseen)
    assert verdict.word == "undecided" and (verdict.count.later, verdict.count.not_later) == (1, 0)
    seen_to_be_later = [Delay(1600, None, 2999, 1700)] * 5
    assert judge(dates(free), free, imposed, 0.1, seen_to_be_later).word == "accelerated"


def test_close_to_the_tolerance_is_no_cause(free):
    verdict = judge(dates(free), free, np.full(3000, 0.05), 0.1)
    assert verdict.word == "open"
    assert [code for code, _ in verdict.reasons] == ["kept", "within"]


def test_a_split_before_the_fork_is_no_flips_doing(free):
    verdict = judge(dates(free, fork=2500), free, free, 0.1)
    assert verdict.word == "bystander"
    assert verdict.reasons[0][0] == "had_split"


def test_first_steps_predict_nothing():
    step = np.arange(61.0)
    assert expected(1e-9 * step**2, 0.1) is None
    assert expected(1e-9 * step**2, 0.1, exponent=0.0036) == pytest.approx(np.log(0.1 / 3.6e-6) / 0.0036)
    verdict = judge(Dates(0, 5, None), 1e-9 * step**2, None, 0.1)
    assert "no_growth" in dict(verdict.reasons)


def test_an_end_of_one_run_is_a_fork_by_itself():
    ended = {"run": "B", "word": "runaway", "step": 0, "other": "A"}
    verdict = judge(Dates(0, 0, None), np.zeros(1), None, 0.1, ended=ended)
    assert verdict.word == "open" and verdict.reasons == (("ended", {**ended, "steps": 0}),)


def test_a_split_under_the_others_decisions_alone_is_told(free):
    verdict = judge(Dates(0, 400, None), free[:900], free[-900:], 0.1)
    assert verdict.word == "open" and verdict.imposed == 0
    assert dict(verdict.reasons)["together"] == {"step": 0}
