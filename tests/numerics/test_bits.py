"""Packed decisions, against numpy's unpackbits."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mdnum.numerics import changed_bits, count_set, set_bits

SHAPES = st.tuples(st.integers(1, 5), st.integers(1, 9))


def unpacked(packed):
    """(slots, columns) of booleans; slot k of a word is bit k."""
    words, columns = packed.shape
    bits = np.unpackbits(packed[:, None, :], axis=1, bitorder="little")
    return bits.reshape(words * 8, columns).astype(bool)


@st.composite
def two_steps(draw):
    shape = draw(SHAPES)
    return draw(arrays(np.uint8, shape)), draw(arrays(np.uint8, shape))


@given(two_steps())
def test_changed_bits_are_the_exclusive_or(steps):
    before, now = steps
    slots, columns, values = changed_bits(before, now)
    changed = unpacked(before) != unpacked(now)
    assert set(zip(slots.tolist(), columns.tolist(), strict=True)) == {
        (int(s), int(c)) for s, c in np.argwhere(changed)
    }
    assert len(slots) == int(changed.sum())
    assert np.array_equal(values.astype(bool), unpacked(now)[slots, columns])


@given(two_steps())
def test_set_bits_are_the_yes_decisions(steps):
    packed, _ = steps
    slots, columns = set_bits(packed)
    assert sorted(zip(slots.tolist(), columns.tolist(), strict=True)) == [
        (int(s), int(c)) for s, c in np.argwhere(unpacked(packed))
    ]
    assert int(count_set(packed)) == int(unpacked(packed).sum())


def test_counting_is_for_any_shape_and_for_slices():
    rng = np.random.default_rng(2)
    packed = rng.integers(0, 256, (3, 4, 17)).astype(np.uint8)
    assert int(count_set(packed)) == int(np.unpackbits(packed).sum())
    assert int(count_set(packed[:, ::2])) == int(np.unpackbits(np.ascontiguousarray(packed[:, ::2])).sum())


def test_nothing_changed_gives_nothing():
    packed = np.full((2, 3), 255, np.uint8)
    slots, columns, values = changed_bits(packed, packed)
    assert len(slots) == len(columns) == len(values) == 0
