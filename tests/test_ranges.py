"""Which numbers a format cannot hold, and at which row first."""

from __future__ import annotations

import numpy as np
import pytest

from mdnum import ranges

# numbers that fall and come to rest by halves; 65519 still rounds to the largest float16
ROWS = [
    [65519.0, 0.0],
    [65520.0, -1.0],
    [0.0, 0.0],
    [2.0**-15, 1.0],
    [2.0**-24, 1.0],
    [1.0, 2.0**-25],
    [1e-46, 3.0],
]


def test_largest_and_smallest_of_each_row():
    found = ranges.columns({"y": np.array(ROWS), "z": np.zeros((7, 0))})
    assert found["largest_y"].tolist() == [65519.0, 65520.0, 0.0, 1.0, 1.0, 1.0, 3.0]
    np.testing.assert_array_equal(
        found["smallest_y"], [65519.0, 1.0, np.nan, 2.0**-15, 2.0**-24, 2.0**-25, 1e-46]
    )
    assert not found["largest_z"].any() and np.isnan(found["smallest_z"]).all()


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("float16", {"overflows": (1, 65520.0), "subnormal": (3, 2.0**-15), "lost": (5, 2.0**-25)}),
        # what is subnormal in these is flushed to zero
        ("bfloat16", {"lost": (6, 1e-46)}),
        ("float32", {"lost": (6, 1e-46)}),
        ("float64", {}),
    ],
)
def test_the_row_at_which_a_format_overflows_or_loses_a_number(name, expected):
    made = ranges.columns({"y": ROWS})
    assert ranges.first_outside(made["largest_y"], made["smallest_y"], name) == expected


def test_float32_ends_before_bfloat16_does():
    # 3.4e38 is above the largest bfloat16 by more than half its spacing, and below the largest float32
    least = np.full(2, np.nan)
    for name, first in (("float32", (1, np.inf)), ("bfloat16", (0, 3.4e38))):
        assert ranges.first_outside(np.array([3.4e38, np.inf]), least, name) == {"overflows": first}
    assert ranges.first_outside([1e39, np.inf], [1.0, np.nan], "float32") == {"overflows": (0, 1e39)}
    assert ranges.first_outside([1e38, np.inf], [1.0, np.nan], "bfloat16") == {"overflows": (1, np.inf)}
