"""jax-md's neighbor formats are orders of each atom's terms, and the choice adds in those orders."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_systems
from forks.harness import made as twin_of
from rollout.harness import evaluated, listed, terms_of

from mdnum.forks.choices import parse, unavailable
from mdnum.forks.choices.arithmetic import FORMATS
from mdnum.forks.reordered import ReorderedSimulation
from mdnum.forks.worlds import varied
from mdnum.md.cell import wrap_positions
from mdnum.md.jaxmd import as_neighbor_list, displacement, upstream
from mdnum.numerics.sums import Halves, Sequential, Twice
from mdnum.systems.build import Simulation, build


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    """A liquid's worth of disorder, 108 atoms."""
    dynamics = {"kind": "nve", "timestep": 0.004, "temperature": 1.0, "seed": 3}
    cutoff = {"kind": "hard", "radius": 2.0}
    system = small_systems.make(
        small_systems.crystal(3, 0.1), small_systems.LENNARD_JONES, cutoff, dynamics=dynamics
    )
    return build(system)


@pytest.fixture(scope="module")
def rows(simulation: Simulation) -> np.ndarray:
    """Neighbors within the list radius, one row per atom, sorted, padded at the end."""
    return np.sort(listed(simulation)[1].unsorted(), axis=1)


def forces_of_jax_md(simulation: Simulation, rows: np.ndarray, format: Any):
    """A function from a list's indices to jax-md's forces, minus the gradient of its energy; and the list."""
    jax_md = upstream()
    metric = jax_md.space.canonicalize_displacement_or_metric(
        displacement(np.asarray(simulation.cell.matrix))
    )
    energy = jax_md.smap.pair_neighbor_list(lennard_jones, metric)
    x = jnp.asarray(wrap_positions(simulation.cell, simulation.positions)[0])
    held: Any = as_neighbor_list(rows, np.asarray(x), format)

    @jax.jit
    def forces(idx):
        return -jax.grad(lambda at: energy(at, replace(held, idx=idx)))(x)

    return forces, np.asarray(held.idx)


def lennard_jones(dr, **_):
    """With a hard cutoff; distance 0 is padding."""
    inside = (dr > 0) & (dr < 2.0)
    s6 = (1 / jnp.where(inside, dr, 1.0)) ** 6
    return jnp.where(inside, 4 * (s6 * s6 - s6), 0.0)


def in_order(terms, start=None) -> np.ndarray:
    total = np.zeros(3) if start is None else start
    for term in terms:
        total = total + term
    return total


def in_windows(terms: list[np.ndarray], slots: int, width: int = 32) -> np.ndarray:
    """How XLA on a CPU adds along an axis: whole windows, the axis in the middle of them."""
    windows = -(-slots // width)
    before = (windows * width - slots) // 2
    padded = [np.zeros(3)] * before + terms
    return in_order([in_order(padded[width * w : width * (w + 1)]) for w in range(windows)])


def modeled(rows: np.ndarray, terms: dict[tuple[int, int], np.ndarray], format: str) -> np.ndarray:
    """The forces if a format were nothing but an order of the terms."""
    atoms = len(rows)
    force = np.empty((atoms, 3))
    named_by = [np.flatnonzero((rows == i).any(axis=1)).tolist() for i in range(atoms)]
    zero = np.zeros(3)
    for i, naming in enumerate(named_by):
        own = [j for j in rows[i].tolist() if j < atoms]
        if format == "ordered-sparse":
            later, earlier = [j for j in naming if j > i], [j for j in own if j < i]
            force[i] = in_order(terms[i, j] for j in later) + in_order(terms[i, j] for j in earlier)
        elif format == "sparse":
            force[i] = in_order(0.5 * terms[i, j] for j in own) + in_order(0.5 * terms[i, j] for j in naming)
        else:
            # padding may stand between the neighbors of a row, and windows count it
            row = [0.5 * terms[i, j] if j < atoms else zero for j in rows[i].tolist()]
            force[i] = in_order((0.5 * terms[i, j] for j in naming), in_windows(row, rows.shape[1]))
    return force


@pytest.mark.slow
@pytest.mark.jax_md
@pytest.mark.filterwarnings("ignore:scatter inputs")
def test_the_forces_of_each_format_of_jax_md_are_sums_in_one_order(simulation, rows):
    once, pairs = forces_of_jax_md(simulation, rows, "ordered-sparse")
    # the terms, by the program's own arithmetic: each pair alone in the list
    atoms, terms = len(rows), {}
    for k in np.flatnonzero(pairs[0] < atoms).tolist():
        alone = np.full_like(pairs, atoms)
        alone[:, k] = pairs[:, k]
        force = np.asarray(once(jnp.asarray(alone)))
        i, j = pairs[:, k].tolist()
        assert np.array_equal(force[i], -force[j])
        terms[i, j], terms[j, i] = force[i], force[j]
    assert rows.shape[1] > 32
    mixed = np.stack([np.random.default_rng(i).permutation(row) for i, row in enumerate(rows)])
    seen = {}
    for kind, order in (("sorted", rows), ("mixed", mixed)):
        for format in FORMATS:
            forces, idx = forces_of_jax_md(simulation, order, format)
            seen[kind, format] = np.asarray(forces(jnp.asarray(idx)))
            # a list on the host is packed to the front; a dense one stays as it is
            assert np.array_equal(seen[kind, format], modeled(order, terms, format)), (kind, format)
    different = {force.tobytes() for force in seen.values()}
    assert len(different) == 6


@pytest.mark.slow
@pytest.mark.parametrize("format", FORMATS)
def test_the_choice_adds_in_the_order_of_the_format(simulation, rows, format):
    made = ReorderedSimulation.of(simulation, format)
    assert made.reduction == {"dense": Twice(), "sparse": Sequential(), "ordered-sparse": Halves()}[format]
    x, table, tables = listed(made)
    seen, atoms = terms_of(made, x, tables), len(table.order)
    terms = {}
    for slot, column in zip(*np.nonzero(table.index < atoms), strict=True):
        pair = int(table.order[column]), int(table.order[table.index[slot, column]])
        terms[pair] = np.array([seen[axis][slot, column] for axis in range(3)])
    assert all(np.array_equal(term, -terms[j, i]) for (i, j), term in terms.items())
    real = [[j for j in row if j < atoms] for row in rows.tolist()]
    if format == "ordered-sparse":
        expected = modeled(rows, terms, format)
    elif format == "sparse":
        # in sorted rows both halves of the sum are one order
        plain = np.array([in_order(terms[i, j] for j in row) for i, row in enumerate(real)])
        assert np.array_equal(modeled(rows, terms, "sparse"), plain)
        # backwards, because forwards the loop streams, and XLA then contracts a product and a sum into one
        made = replace(made, reduction=Sequential("reversed"))
        expected = np.array([in_order(terms[i, j] for j in row[::-1]) for i, row in enumerate(real)])
    else:
        halves = [[0.5 * terms[i, j] for j in row] for i, row in enumerate(real)]
        expected = np.array([in_order(row, in_order(row)) for row in halves])
    force = np.empty((atoms, 3))
    force[table.order] = np.asarray(evaluated(made.force, x, tables).force).T
    assert np.array_equal(force, expected)


def test_a_list_in_another_format_holds_the_same_pairs(simulation):
    plain = listed(simulation)[1]
    for word in FORMATS:
        twin = twin_of(f"format={word}", simulation.system)
        table = listed(twin.b.simulation)[1]
        held, before = (np.sort(one.unsorted(), axis=1)[:, : plain.occupancy] for one in (table, plain))
        assert np.array_equal(held, before)
        assert table.pairs == plain.pairs and table.slots % 8 == 0
        assert twin.a.simulation.lists != twin.b.simulation.lists
        # by label, padding last in each half
        labels = np.append(table.order, len(table.order))[table.index]
        for half in np.split(labels, 2 if word == "ordered-sparse" else 1):
            assert (np.diff(half, axis=0) >= 0).all()
    pairwise = varied(simulation.system, {"precision.reduction": "pairwise"})
    assert unavailable(parse("format=sparse"), pairwise)
