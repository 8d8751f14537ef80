"""The sums inside the force loop of molecular dynamics: every order within its bound."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest
from rollout.harness import evaluated, liquid, listed, terms_of, write_system

from mdnum.numerics.reductions import BY_NAME
from mdnum.systems import load
from mdnum.systems.build import build

#: All of them in float32; each compiles the force again, so a few in float64.
NAMES = {"float32": tuple(BY_NAME), "float64": ("sequential", "pairwise", "blocked", "kahan", "exact")}
SAME_IN_EVERY_ORDER = ("sorted", "exact", "fixed-point")


def forces(sim, x, tables):
    """Force components and (twice) energies, shape (4, atoms)."""
    result = evaluated(sim.force, x, tables)
    return np.concatenate([np.asarray(result.force), 2 * np.asarray(result.energy)[None]])


def permuted(tables, seed):
    """The same list with its slots in another order."""
    shape = tables.index.shape
    flat = np.asarray(tables.index).reshape(-1, shape[-1])
    order = np.random.default_rng(seed).permutation(len(flat))
    return tables._replace(index=jnp.asarray(flat[order].reshape(shape)))


# a force is compiled for every reduction
@pytest.mark.slow
@pytest.mark.parametrize("dtype", NAMES)
def test_every_order_is_within_its_bound_and_some_do_not_depend_on_the_order_of_neighbors(dtype, tmp_path):
    sim = build(load(write_system(tmp_path, liquid(), precision={"force": dtype, "accumulate": dtype})))
    x, _, tables = listed(sim)
    terms = terms_of(sim, x, tables)
    assert len(terms) == 5
    exact = [[sum(Fraction(float(v)) for v in column) for column in of.T] for of in terms]
    for name in NAMES[dtype]:
        one = replace(sim, reduction=BY_NAME[name])
        seen = forces(one, x, tables)
        for sums, of, true in zip(seen, terms, exact, strict=False):
            assert of.dtype == sums.dtype == dtype
            error = [abs(float(Fraction(float(s)) - e)) for s, e in zip(sums, true, strict=True)]
            assert (np.array(error) <= BY_NAME[name].bound(of)).all(), name
        same = [np.array_equal(forces(one, x, permuted(tables, seed)), seen) for seed in range(3)]
        # compensated sums mostly agree too, but nothing says that they must
        assert name in ("kahan", "neumaier") or same == [name in SAME_IN_EVERY_ORDER] * 3, name
