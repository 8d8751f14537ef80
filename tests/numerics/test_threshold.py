"""Thresholds: the margin has the sign that the program acted on."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.errors import InputError
from mdnum.numerics import Threshold

POSITIVE = st.floats(1e-290, 1e290)
ANY = st.floats(allow_nan=False, allow_infinity=False)


@given(value=ANY, quantity=ANY)
def test_the_sign_of_the_margin_is_the_decision(value, quantity):
    strict, inclusive = Threshold(value), Threshold(value, "<=")
    with np.errstate(over="ignore"):
        margin = strict.margin(np.float64(quantity))
    assert (margin > 0) == strict.decide(quantity) == (quantity < value)
    assert (margin >= 0) == inclusive.decide(quantity) == (quantity <= value)


@given(value=POSITIVE, factor=st.floats(0.5, 2.0))
def test_margins_near_the_threshold_are_exact(value, factor):
    quantity = value * factor
    if not value / 2 <= quantity <= 2 * value:
        return
    assert Fraction(Threshold(value).margin(quantity)) == Fraction(value) - Fraction(quantity)


@given(value=POSITIVE)
def test_the_neighbors_of_a_threshold_are_on_its_two_sides(value):
    threshold = Threshold(value)
    below, above = np.nextafter(value, 0), np.nextafter(value, np.inf)
    assert threshold.decide(below) and not threshold.decide(value) and not threshold.decide(above)
    assert threshold.margin(below) > 0 > threshold.margin(above)


@given(value=POSITIVE, quantity=POSITIVE, bound=POSITIVE)
def test_ambiguous_is_within_the_bound(value, quantity, bound):
    threshold = Threshold(value)
    expected = abs(Fraction(threshold.margin(quantity))) <= Fraction(bound)
    assert bool(threshold.ambiguous(quantity, bound)) == expected


def test_arrays_and_not_a_number():
    threshold = Threshold(2.0, "<=", "r2")
    quantity = np.array([1.0, 2.0, 3.0, np.nan])
    assert threshold.decide(quantity).tolist() == [True, True, False, False]
    assert threshold.space == "r2"


def test_an_unknown_comparison_is_refused():
    with pytest.raises(InputError, match="'>'"):
        Threshold(1.0, ">")
