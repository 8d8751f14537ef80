"""The sequential sign test: every sequence of coins, and delays of which only a part was seen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.numerics.verdicts import ERROR, FEWEST, REPEATS, Delay, count, looks


def words(coins: np.ndarray, most: int) -> list[bool | None]:
    """What the rule says of rows of coins, each True for a pair that is delayed, drawn as it wants them."""
    said = []
    for row in coins:
        pairs = tuple(Delay(100, 160 if heads else 100, 500, 500) for heads in row)
        found = count(pairs[:1], 50.0, most)
        while found.wanted:
            found = count(pairs[: found.pairs + found.wanted], 50.0, most)
        said.append(found.delayed)
    return said


@pytest.mark.parametrize("pairs", [5, 6, 7, 11])
def test_fair_coins_are_taken_for_delayed_in_a_twentieth_of_all_sequences_at_most(pairs):
    """Looked at as often as the rule looks, by going through all of them."""
    every = (np.arange(2**pairs)[:, None] >> np.arange(pairs)) & 1
    said = words(every.astype(bool), pairs)
    for word in (True, False):
        assert 0.015 < said.count(word) / len(said) <= ERROR


def test_at_the_default_the_error_is_nearly_spent():
    coins = np.random.default_rng(0).random((1500, 1 + REPEATS)) < 0.5
    share = words(coins, 1 + REPEATS).count(True) / len(coins)
    # 0.0487; three standard errors of 1,500 draws
    assert abs(share - 0.0487) < 0.0167


def test_a_clear_majority_is_found():
    coins = np.random.default_rng(1).random((300, 1 + REPEATS)) < 0.9
    said = words(coins, 1 + REPEATS)
    assert said.count(True) > 285 and said.count(False) == 0


def test_the_fewest_repeats_are_those_that_leave_less_than_a_twentieth():
    # five of five by coins: 1/32; four of four: 1/16
    assert FEWEST == 4 and looks(4) == () and looks(5) == ((5, 5),)


@given(
    st.integers(1, 400),
    st.integers(1, 400),
    st.integers(0, 300),
    st.integers(0, 300),
    st.floats(0, 100),
)
def test_what_is_said_of_a_part_holds_of_the_whole(free, imposed, free_until, imposed_until, steps):
    """A split beyond what was followed is not seen; what is said all the same is true of it."""
    seen = Delay(
        free if free <= free_until else None,
        imposed if imposed <= imposed_until else None,
        free_until,
        imposed_until,
    )
    said = seen.beyond(steps)
    assert said is None or said == (imposed - free > steps)
    assert said is not None or seen.free is None or seen.imposed is None


def test_splits_are_read_from_separations():
    free, imposed = np.array([0.0, 0.05, 0.2, 0.3]), np.array([0.0, 0.05, np.nan, np.nan])
    assert Delay.of(free, imposed, 0.1) == Delay(2, None, 3, 1)
