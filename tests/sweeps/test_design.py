"""Choices, their values, and the points that they make."""

from __future__ import annotations

from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.errors import InputError
from mdnum.sweeps.design import Axis, label, parse, points, with_base


@given(st.integers(-50, 50), st.integers(0, 40), st.integers(1, 9), st.integers(0, 6))
def test_a_range_has_the_decimals_that_were_written(low, count, step, digits):
    texts = [str(Decimal(k).scaleb(-digits)) for k in (low, low + count * step, step)]
    if digits and any("E" in text for text in texts):
        return
    axis = parse("key=" + ":".join(texts))
    expected = [Decimal(low + k * step).scaleb(-digits) for k in range(count + 1)]
    assert [Decimal(repr(one)) if digits else one for one in axis.values] == expected


def test_lists_words_and_precision():
    assert parse("structure.repeat=[2, 2, 2],[4,4,4]").values == ([2, 2, 2], [4, 4, 4])
    assert parse("cutoff.kind=hard,switched").values == ("hard", "switched")
    assert parse("precision").settings("float32") == {
        "precision.state": "float32",
        "precision.force": "float32",
    }


@pytest.mark.parametrize(
    "text", ["a", "=1,2", "a=", "a=1:2", "a=2:1:1", "a=0:1:0", "a=1,1", "a=0:1:1e-9", "a=1:x:2"]
)
def test_what_is_no_choice_is_refused(text):
    with pytest.raises(InputError):
        parse(text)


def test_one_at_a_time_goes_around_the_base_seed_by_seed():
    axes = [with_base(Axis("a", (1.0, 3.0)), 2.0), with_base(Axis("b", ("x", "y")), "x")]
    made = points(axes, {"a": 2.0, "b": "x"}, [0, 1])
    first = [tuple(one.choices.values()) for one in made[:4]]
    assert first == [(2.0, "x"), (1.0, "x"), (3.0, "x"), (2.0, "y")]
    assert [one.seed for one in made] == [0] * 4 + [1] * 4
    assert len(points(axes, {"a": 2.0, "b": "x"}, [0], "factorial")) == 6


def test_a_space_is_filled_between_the_ends():
    axes = [Axis("a", (1, 9)), Axis("b", (0.5, 1.5)), Axis("c", ("x", "y"))]
    made = points(axes, {}, [0], "space-filling", 16)
    for key, low, high in (("a", 1, 9), ("b", 0.5, 1.5)):
        values = [one.choices[key] for one in made]
        assert min(values) >= low and max(values) <= high and len({*values}) > 4
    assert {one.choices["c"] for one in made} == {"x", "y"}
    with pytest.raises(InputError):
        points(axes, {}, [0], "space-filling", 12)


def test_labels_are_short():
    assert [label(one) for one in (0.1 + 0.2, 3, "x", 1e-7)] == ["0.3", "3", "x", "1e-07"]
