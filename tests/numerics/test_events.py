"""Thresholds and hysteresis, packed decisions and their ledger: against rationals, automata and tables."""

from __future__ import annotations

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracles import broken_alternations

from mdnum.errors import InputError
from mdnum.numerics import Hysteresis, Ledger, Threshold, changes_in_time, count_set, set_bits

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
def test_margins_near_the_threshold_are_exact_and_its_neighbors_on_two_sides(value, factor):
    threshold, quantity = Threshold(value), value * factor
    if value / 2 <= quantity <= 2 * value:
        assert Fraction(threshold.margin(quantity)) == Fraction(value) - Fraction(quantity)
    below, above = np.nextafter(value, 0), np.nextafter(value, np.inf)
    assert threshold.decide(below) and not threshold.decide(value) and not threshold.decide(above)
    assert threshold.margin(below) > 0 > threshold.margin(above)


def test_arrays_and_not_a_number():
    assert Threshold(2.0, "<=", "r2").decide(np.array([1.0, 2.0, 3.0, np.nan])).tolist() == [
        True, True, False, False
    ]  # fmt: skip
    with pytest.raises(InputError, match="'>'"):
        Threshold(1.0, ">")


# --- two thresholds: a decision with a memory -----------------------------------------------------------

TRIGGER = Hysteresis(Threshold(0.0, "<", "height"), Threshold(1.0, "<=", "height"))


@given(st.lists(st.floats(-2, 3), max_size=40), st.booleans())
def test_hysteresis_is_the_automaton_of_two_thresholds(quantities, start):
    decided = told = start
    for quantity in quantities:
        before, decided = decided, bool(TRIGGER.decide(quantity, decided))
        told = quantity <= 1 if told else quantity < 0
        assert decided == told
        assert TRIGGER.margin(np.float64(quantity), before) == (1.0 if before else 0.0) - quantity


def test_hysteresis_can_be_traced_with_thresholds_that_are_arrays():
    @jax.jit
    def decide(enter, leave, quantity, before):
        return Hysteresis(Threshold(enter), Threshold(leave, "<=")).decide(quantity, before)

    out = decide(jnp.asarray(0.0), jnp.asarray(1.0), jnp.asarray([0.5, 0.5]), jnp.asarray([True, False]))
    assert list(np.asarray(out)) == [True, False]


def test_thresholds_that_make_no_gap_are_refused():
    with pytest.raises(InputError, match="below the threshold"):
        Hysteresis(Threshold(0.0), Threshold(-1.0))
    with pytest.raises(InputError, match="different quantities"):
        Hysteresis(Threshold(0.0, "<", "r"), Threshold(1.0, "<", "r2"))


# --- packed bits, against numpy's unpackbits ------------------------------------------------------------


def unpacked(packed):
    """(slots, columns) of booleans; slot k of a word is bit k."""
    words, columns = packed.shape
    bits = np.unpackbits(packed[:, None, :], axis=1, bitorder="little")
    return bits.reshape(words * 8, columns).astype(bool)


STEPS = st.tuples(st.integers(1, 4), st.integers(1, 5), st.integers(1, 9)).flatmap(
    lambda shape: arrays(np.uint8, shape)
)


@given(STEPS)
def test_changes_are_the_exclusive_or_of_consecutive_rows(steps):
    rows, slots, columns, values = changes_in_time(steps[0], steps[1:])
    bits = np.array([unpacked(step) for step in steps])
    found = sorted(zip(rows.tolist(), slots.tolist(), columns.tolist(), strict=True))
    assert found == [tuple(place) for place in np.argwhere(bits[1:] != bits[:-1]).tolist()]
    assert np.array_equal(values.astype(bool), bits[1:][rows, slots, columns])
    places = np.stack(set_bits(steps[0]), axis=1).tolist()
    assert sorted(places) == np.argwhere(bits[0]).tolist() and count_set(steps[0]) == len(places)


def test_counting_is_for_any_shape_and_for_slices():
    packed = np.random.default_rng(2).integers(0, 256, (3, 4, 17)).astype(np.uint8)
    assert int(count_set(packed)) == int(np.unpackbits(packed).sum())
    assert int(count_set(packed[:, ::2])) == int(np.unpackbits(np.ascontiguousarray(packed[:, ::2])).sum())


# --- the ledger, against the table of decisions that it was made from -----------------------------------

# decisions of up to six subjects over up to twelve steps
HISTORIES = st.tuples(st.integers(2, 12), st.integers(1, 6)).flatmap(lambda s: arrays(np.bool_, s))


def ledger_of(history) -> Ledger:
    """Every flip of a (steps + 1, subjects) table; subject s is labeled (s, s + 10)."""
    step, subject = np.nonzero(history[1:] != history[:-1])
    step = step + 1
    entered = history[step, subject]
    labels = np.stack([subject, subject + 10], axis=1)
    order = np.lexsort((labels[:, 1], labels[:, 0], step))
    size, jump = len(step), np.where(entered, -0.25, 0.25)
    bounds = np.linspace(-1.0, 1.0, size), np.full(size, 0.5)
    return Ledger("pair", step[order], labels[order], entered[order], *bounds, jump[order])


@given(HISTORIES)
def test_the_algebra_of_a_ledger(history):
    ledger, steps = ledger_of(history), len(history) - 1
    entered, left = ledger.counts(steps)
    assert np.array_equal(history[0].sum() + np.cumsum(entered - left), history.sum(axis=1))
    assert int(entered.sum() + left.sum()) == len(ledger)
    assert np.array_equal(ledger.jumps(steps), -0.25 * np.diff(history.sum(axis=1), prepend=history[0].sum()))
    rows = list(zip(ledger.step.tolist(), *ledger.subject.T.tolist(), strict=True))
    assert rows == sorted(rows)
    assert np.array_equal(ledger.ambiguous, [abs(m) <= 0.5 for m in ledger.margin])
    assert broken_alternations(ledger) == 0
