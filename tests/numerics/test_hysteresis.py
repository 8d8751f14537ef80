"""Two thresholds: a decision with a memory."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.errors import InputError
from mdnum.numerics import Hysteresis, Threshold

TRIGGER = Hysteresis(Threshold(0.0, "<", "height"), Threshold(1.0, "<=", "height"))


@given(st.lists(st.floats(-2, 3), max_size=40), st.booleans())
def test_it_is_the_automaton_of_two_thresholds(quantities, start):
    decided = told = start
    for quantity in quantities:
        decided = bool(TRIGGER.decide(quantity, decided))
        if not told and quantity < 0:
            told = True
        elif told and quantity > 1:
            told = False
        assert decided == told


def test_the_margin_is_that_of_the_threshold_that_holds():
    quantity = np.array([0.5, 0.5, -0.25, 1.5])
    before = np.array([False, True, False, True])
    np.testing.assert_array_equal(TRIGGER.margin(quantity, before), [-0.5, 0.5, 0.25, -0.5])
    np.testing.assert_array_equal(TRIGGER.decide(quantity, before), [False, True, True, False])


def test_it_can_be_traced_with_thresholds_that_are_arrays():
    @jax.jit
    def decide(enter, leave, quantity, before):
        trigger = Hysteresis(Threshold(enter, "<", "r"), Threshold(leave, "<=", "r"))
        return trigger.decide(quantity, before)

    out = decide(jnp.asarray(0.0), jnp.asarray(1.0), jnp.asarray([0.5, 0.5]), jnp.asarray([True, False]))
    assert list(np.asarray(out)) == [True, False]


def test_thresholds_that_make_no_gap_are_refused():
    with pytest.raises(InputError, match="before it begins"):
        Hysteresis(Threshold(0.0), Threshold(-1.0))
    with pytest.raises(InputError, match="different spaces"):
        Hysteresis(Threshold(0.0, "<", "r"), Threshold(1.0, "<", "r2"))
