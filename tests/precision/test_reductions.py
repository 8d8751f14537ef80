"""The order of a sum, against the same sum written out."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mdnum.errors import InputError
from mdnum.precision import PrecisionPolicy
from mdnum.precision.reductions import BY_NAME, Pairwise, Sequential


def tree(values):
    """A balanced tree written as a recursion over levels: neighbors add, an odd one out waits."""
    if len(values) == 1:
        return values[0]
    level = [a + b for a, b in zip(values[0::2], values[1::2], strict=False)]
    return tree(level + ([values[-1]] if len(values) % 2 else []))


def reduce_in_blocks(reduction, terms, block=8):
    """As the force loop does it: blocks of terms through a scan, inside jit."""

    def step(total, some):
        return reduction.within(total, [some[k] for k in range(block)])

    @jax.jit
    def run(blocks):
        total, later = lax.scan(step, jnp.zeros(blocks.shape[2:], blocks.dtype), blocks)
        return reduction.finish(total, later)

    return np.asarray(run(jnp.asarray(terms.reshape(-1, block, *terms.shape[1:]))))


def wild(count, dtype=np.float64, columns=50):
    rng = np.random.default_rng(11)
    return (rng.normal(size=(count, columns)) * 10.0 ** rng.integers(-8, 8, (count, columns))).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("slots", [8, 40, 88])
def test_sequential_is_a_loop(dtype, slots):
    terms = wild(slots, dtype)
    expected = np.zeros(terms.shape[1], dtype)
    for term in terms:
        expected = expected + term
    assert np.array_equal(reduce_in_blocks(Sequential(), terms), expected)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("blocks", [1, 2, 3, 5, 11])
def test_pairwise_is_a_tree_of_trees(dtype, blocks):
    terms = wild(8 * blocks, dtype)
    expected = tree([tree(list(block)) for block in terms.reshape(blocks, 8, -1)])
    assert np.array_equal(reduce_in_blocks(Pairwise(), terms), expected)


def test_the_two_orders_are_two_programs():
    terms = wild(88)
    assert not np.array_equal(reduce_in_blocks(Sequential(), terms), reduce_in_blocks(Pairwise(), terms))
    assert set(BY_NAME) == {"sequential", "pairwise"}


def test_pairwise_keeps_more_of_many_equal_terms():
    terms = np.full((4096, 1), 0.1, np.float32)
    exact = 4096 * float(np.float32(0.1))
    loop, balanced = (float(reduce_in_blocks(r, terms)[0]) for r in (Sequential(), Pairwise()))
    assert abs(balanced - exact) < 1e-3 < abs(loop - exact)


def test_a_dtype_that_has_no_role_is_refused():
    assert PrecisionPolicy(state="float32").dtype("state") == np.float32
    with pytest.raises(InputError, match=r"precision\.force.*float16"):
        PrecisionPolicy(force="float16")
