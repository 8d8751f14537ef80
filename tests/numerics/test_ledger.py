"""The ledger's algebra, against a table of decisions that it was made from."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mdnum.numerics import Ledger, broken_alternations, sort_rows

# decisions of up to six subjects over up to twelve steps
HISTORIES = st.tuples(st.integers(2, 12), st.integers(1, 6)).flatmap(lambda s: arrays(np.bool_, s))


def ledger_of(history) -> Ledger:
    """Every flip of a (steps + 1, subjects) table; subject s is labeled (s, s + 10)."""
    step, subject = np.nonzero(history[1:] != history[:-1])
    step = step + 1
    entered = history[step, subject]
    labels = np.stack([subject, subject + 10], axis=1)
    order = sort_rows(step, labels)
    jump = np.where(entered, -0.25, 0.25)
    size = len(step)
    return Ledger(
        "pair",
        step[order],
        labels[order],
        entered[order],
        np.linspace(-1.0, 1.0, size),
        np.full(size, 0.5),
        jump[order],
    )


def without(ledger: Ledger, row: int) -> Ledger:
    keep = np.arange(len(ledger)) != row
    columns = (ledger.step, ledger.subject, ledger.entered, ledger.margin, ledger.bound, ledger.jump)
    return Ledger(ledger.channel, *(column[keep] for column in columns))


@given(HISTORIES)
def test_first_plus_entered_minus_left_is_what_is_inside(history):
    ledger = ledger_of(history)
    steps = len(history) - 1
    assert np.array_equal(ledger.inside(int(history[0].sum()), steps), history.sum(axis=1))
    entered, left = ledger.counts(steps)
    assert int(entered.sum() + left.sum()) == len(ledger)
    assert entered[0] == left[0] == 0


@given(HISTORIES)
def test_jumps_add_up_step_by_step(history):
    ledger = ledger_of(history)
    steps = len(history) - 1
    expected = -0.25 * np.diff(history.sum(axis=1), prepend=history[0].sum())
    assert np.array_equal(ledger.jumps(steps), expected)


@given(HISTORIES)
def test_rows_are_sorted_by_step_and_then_by_labels(history):
    ledger = ledger_of(history)
    rows = list(zip(ledger.step.tolist(), *ledger.subject.T.tolist(), strict=True))
    assert rows == sorted(rows)


@given(HISTORIES, st.data())
def test_a_complete_ledger_alternates_and_one_that_misses_a_flip_in_between_does_not(history, data):
    ledger = ledger_of(history)
    assert broken_alternations(ledger) == 0
    # a flip with an earlier and a later one of the same subject: dropping it leaves two alike in a row
    subjects, counts = np.unique(ledger.subject[:, 0], return_counts=True)
    inner = [
        row
        for subject in subjects[counts > 2]
        for row in np.flatnonzero(ledger.subject[:, 0] == subject)[1:-1].tolist()
    ]
    if inner:
        assert broken_alternations(without(ledger, data.draw(st.sampled_from(inner)))) == 1


@given(HISTORIES)
def test_ambiguous_rows_are_those_within_their_bound(history):
    ledger = ledger_of(history)
    assert np.array_equal(ledger.ambiguous, [abs(m) <= 0.5 for m in ledger.margin])


def test_the_first_label_decides_before_the_second():
    step = np.array([2, 1, 1, 1])
    subject = np.array([[0, 1], [3, 4], [2, 9], [2, 5]])
    assert sort_rows(step, subject).tolist() == [3, 2, 1, 0]
