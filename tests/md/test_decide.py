"""The pair decision in jit and on the host: one arithmetic, one answer."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import COMPARISONS

from mdnum.errors import InputError
from mdnum.md.decide import PairDecider
from mdnum.numerics.exact import zero_bits


def displacements(dtype, count=20_000, r_cut=2.5):
    """Random vectors, half of them within a few ulps of the cutoff."""
    rng = np.random.default_rng(9)
    d = rng.normal(size=(count, 3))
    length = r_cut * (1 + np.finfo(dtype).eps * rng.integers(-4, 5, count))
    length[::2] = rng.uniform(0.5, 4.0, len(length[::2]))
    return (d / np.linalg.norm(d, axis=1)[:, None] * length[:, None]).astype(dtype).T


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("compare", COMPARISONS)
def test_jit_and_host_compute_one_quantity_and_one_decision(dtype, compare):
    decider = PairDecider((2.5,), compare, np.dtype(dtype).name)
    dx, dy, dz = displacements(dtype)
    on_host = decider.host_quantity(dx, dy, dz)
    assert on_host.dtype == dtype

    @jax.jit
    def in_jit(x, y, z, zero):
        quantity = decider.quantity(x, y, z, zero)
        return quantity, decider.inside(quantity, decider.values()[0])

    quantity, inside = in_jit(*map(jnp.asarray, (dx, dy, dz)), zero_bits(dtype))
    assert np.array_equal(np.asarray(quantity), on_host)
    threshold = decider.thresholds[0]
    assert np.array_equal(np.asarray(inside), threshold.decide(on_host.astype(np.float64)))
    margin = threshold.margin(on_host.astype(np.float64))
    assert np.array_equal(margin >= 0 if compare.endswith("<=") else margin > 0, np.asarray(inside))
    assert threshold.space == decider.space == compare.split()[0]
    # the sample sits on both sides
    assert 0.2 < np.mean(np.asarray(inside)) < 0.8


def test_thresholds_are_the_numbers_the_program_compares_with():
    radius = 2.1 / 1.3
    assert PairDecider((radius,), "r2 <").thresholds[0].value == radius * radius
    assert PairDecider((radius,), "r <").thresholds[0].value == radius
    narrow = np.float32(radius)
    assert PairDecider((radius,), "r2 <", "float32").thresholds[0].value == float(narrow * narrow)
    several = PairDecider((2.5, 2.0, 2.2), "r2 <=")
    assert [t.value for t in several.thresholds] == [6.25, 4.0, 2.2 * 2.2]
    assert np.array_equal(several.values(), [6.25, 4.0, 2.2 * 2.2])


def test_an_unknown_convention_is_refused():
    with pytest.raises(InputError, match="r3 <"):
        PairDecider((1.0,), "r3 <")
