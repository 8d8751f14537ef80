"""The sums inside the force loop of molecular dynamics: every order, its bound, and its history."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rollout.harness import liquid, write_system

from mdnum.md.cell import wrap_positions
from mdnum.numerics.reductions import BY_NAME, Exact
from mdnum.numerics.sums import Tap, running_sum_table
from mdnum.systems import load
from mdnum.systems.build import build

# a force is compiled for every reduction
pytestmark = pytest.mark.slow

#: All of them in float32; each compiles the force anew, so a few in float64.
NAMES = {"float32": tuple(BY_NAME), "float64": ("sequential", "pairwise", "blocked", "kahan", "exact")}
SAME_IN_EVERY_ORDER = ("sorted", "exact", "fixed-point")


@pytest.fixture(scope="module", params=["float64", "float32"])
def world(request, tmp_path_factory):
    """A liquid, its list, and the terms of every sum that its force makes."""
    folder = tmp_path_factory.mktemp(request.param)
    sim = build(
        load(write_system(folder, liquid(), precision={"force": request.param, "accumulate": request.param}))
    )
    wrapped, _ = wrap_positions(sim.cell, np.asarray(sim.positions))
    table = sim.verlet_list().build(wrapped, sim.cell)
    x = jnp.asarray(wrapped[table.order].T)
    tap = Tap(Exact())
    sums = forces(replace(sim, reduction=tap), x, sim.tables(table))
    jax.block_until_ready(sums)
    jax.effects_barrier()
    return sim, x, sim.tables(table), tap.seen


@eqx.filter_jit
def evaluated(force, x, tables):
    return force(x, tables, decisions=False)


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


def test_every_order_is_within_its_bound_of_the_exact_sum(world):
    sim, x, tables, terms = world
    assert len(terms) == 5  # three components, the energy and the virial
    for name in NAMES[sim.policy.force]:
        reduction = BY_NAME[name]
        seen = forces(replace(sim, reduction=reduction), x, tables)
        for sums, of in zip(seen, terms, strict=False):
            assert of.dtype == sums.dtype == sim.policy.dtype("accumulate")
            exact = [sum(Fraction(float(v)) for v in column) for column in of.T]
            error = [abs(float(Fraction(float(s)) - e)) for s, e in zip(sums, exact, strict=True)]
            assert (np.array(error) <= reduction.bound(of)).all(), name


def test_some_sums_do_not_depend_on_the_order_of_neighbors(world):
    sim, x, tables, _ = world
    shuffled = [permuted(tables, seed) for seed in range(3)]
    for name in NAMES[sim.policy.force]:
        one = replace(sim, reduction=BY_NAME[name])
        first = forces(one, x, tables)
        same = [np.array_equal(forces(one, x, other), first) for other in shuffled]
        # compensated sums mostly agree too, but nothing says that they must
        if name not in ("kahan", "neumaier"):
            assert same == [name in SAME_IN_EVERY_ORDER] * 3, name


def test_the_history_of_the_force_on_an_atom(world):
    sim, x, tables, terms = world
    for name in ("sorted", "sequential"):
        seen = forces(replace(sim, reduction=BY_NAME[name]), x, tables)
        for atom in (0, 50):
            history = running_sum_table(terms[0][:, atom], BY_NAME[name])
            assert history.exact == sum(Fraction(float(v)) for v in terms[0][:, atom])
            assert history.bits_lost > 0
            # pairs in the list but outside the cutoff add zeros, and zeros lose nothing
            assert all(row.bits_lost == 0 for row in history.rows if row.addend == 0)
            if name == "sequential":
                # it streams, and there XLA contracts the product and the sum into one rounding
                near = float(np.abs(terms[0][:, atom]).max() * 8 * np.finfo(terms[0].dtype).eps)
                assert history.result == pytest.approx(float(seen[0, atom]), abs=near, rel=0)
            else:
                assert history.result == seen[0, atom], name


def test_a_run_can_be_made_with_any_of_them(tmp_path):
    for name in BY_NAME:
        sim = build(load(write_system(tmp_path / name, liquid(), precision={"reduction": name})))
        assert sim.reduction == BY_NAME[name]
