"""The history of a sum: its last row has the bits of the program, its exact column those of fractions."""

from __future__ import annotations

import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest

from mdnum.errors import InputError
from mdnum.numerics.reductions import BY_NAME
from mdnum.numerics.running import running_sum_table

DTYPES = [np.float64, np.float32, np.float16, ml_dtypes.bfloat16]
SUMS = {name: BY_NAME[name] for name in ("sequential", "reversed", "permuted", "sorted")}
EVERY = jax.jit(lambda terms: {name: reduction(terms) for name, reduction in SUMS.items()})

TOL = np.float16(2.0**-10)
SMALL = [np.float16(2.0**-23)] * 4
LARGE = np.float16(2.0**-10 - 2.0**-21)


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_last_row_has_the_bits_of_the_program(dtype):
    rng = np.random.default_rng(8)
    terms = (rng.normal(size=(37, 6)) * 2.0 ** rng.integers(-5, 6, (37, 6))).astype(dtype)
    for name, totals in EVERY(jnp.asarray(terms)).items():
        for column in range(6):
            history = running_sum_table(terms[:, column], SUMS[name])
            assert history.result == float(totals[column]), name
            exact = sum(Fraction(float(t)) for t in terms[:, column])
            assert history.exact == exact
            assert history.error == float(Fraction(history.result) - exact)
            assert history.rows[-1].exact == exact


def test_four_small_terms_after_a_large_one_leave_no_trace():
    history = running_sum_table([LARGE, *SMALL], dtype=np.float16)
    assert [row.running for row in history.rows] == [float(LARGE)] * 5
    assert [row.absorbed for row in history.rows] == [False, True, True, True, True]
    # 2^-23 below a last place of 2^-21: two binary digits each time
    assert [row.bits_lost for row in history.rows] == [0, 2, 2, 2, 2]
    assert history.exact == Fraction(2) ** -10
    assert history.result < TOL
    assert history.error == -(2.0**-21)


def test_the_same_terms_small_first_lose_nothing():
    history = running_sum_table([*SMALL, LARGE], dtype=np.float16)
    assert [row.running for row in history.rows] == [2.0**-23, 2.0**-22, 3 * 2.0**-23, 2.0**-21, 2.0**-10]
    assert history.bits_lost == 0
    assert history.error == 0
    assert not history.result < TOL


def test_one_bit_lost_is_one_bit_lost():
    for extra, lost in [(2.0**-24, 1), (2.0**-25, 2), (2.0**-24 + 2.0**-30, 7), (2.0**-23, 0)]:
        assert running_sum_table([1.0, extra], dtype=np.float32).rows[1].bits_lost == lost


def test_what_has_no_history_is_refused():
    with pytest.raises(InputError, match=r"terms of shape \(0,\)"):
        running_sum_table(np.zeros(0))
    with pytest.raises(InputError, match="not finite"):
        running_sum_table([1.0, math.inf])
    with pytest.raises(InputError, match="no loop over the terms"):
        running_sum_table([1.0], BY_NAME["exact"])


def test_the_table_has_a_row_for_each_addition():
    history = running_sum_table(np.arange(1.0, 4.0))
    assert history.columns == ("term", "addend", "running sum", "exact sum", "bits lost")
    assert history.table()[2] == ("2", 3.0, 6.0, 6.0, 0)
    assert history.text().splitlines()[-1].split() == ["2", "3", "6", "6", "0"]
