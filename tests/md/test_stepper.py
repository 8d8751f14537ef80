"""A step acts on the decisions it is told, whatever the distances say."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnum.md.pairforce import MdState, PairDynamics
from mdnum.rollout.engine import Engine, first_state
from mdnum.systems.build import build


@pytest.fixture(scope="module")
def crystal():
    simulation = build("argon/crystal-108")
    start = first_state(simulation)
    table = simulation.verlet_list().build(start.reference, simulation.cell)
    tables = simulation.tables(table)
    dynamics = PairDynamics(
        simulation.force, simulation.integrator, jnp.asarray(simulation.masses[table.order]), tables
    )
    state = MdState(jnp.zeros((), jnp.int64), start.state.x[:, table.order], start.state.v[:, table.order])
    return simulation, dynamics, state


def test_told_its_own_decisions_it_is_the_rollout(crystal):
    simulation, dynamics, state = crystal
    advance = jax.jit(lambda s: dynamics.step(s, dynamics.decide(s)))
    for _ in range(40):
        state = advance(state)
    (segment,) = list(Engine(simulation, 40).segments())
    ours = np.asarray(state.x)
    # two compiled programs of one arithmetic: the contraction of a*b + c may differ in the last bit
    assert np.allclose(ours, segment.rows_of("x")[40], rtol=0, atol=1e-13)
    assert np.array_equal(np.asarray(dynamics.decide(state)), segment.rows_of("bits")[40])


def test_margins_have_the_sign_of_the_decision(crystal):
    _, dynamics, state = crystal
    inside = np.asarray(dynamics.margins(state)).reshape(-1, state.x.shape[1]) > 0
    packed = np.packbits(inside.reshape(-1, 8, inside.shape[1]), axis=1, bitorder="little")[:, 0]
    assert np.array_equal(packed, np.asarray(dynamics.decide(state)))


def test_a_flipped_decision_takes_its_term_out_of_both_sums(crystal):
    simulation, dynamics, state = crystal
    own = dynamics.force(state.x, dynamics.tables, decisions=True)
    same = dynamics.force(state.x, dynamics.tables, decisions=True, given=own.decisions.bits)
    assert np.array_equal(np.asarray(own.force), np.asarray(same.force))

    bits, index = np.array(own.decisions.bits), np.asarray(dynamics.tables.index).reshape(-1, 108)
    slot = next(k for k in range(index.shape[0]) if (bits[k // 8, 0] >> (k % 8)) & 1)
    other = int(index[slot, 0])
    back = int(np.flatnonzero(index[:, other] == 0)[0])
    for k, atom in ((slot, 0), (back, other)):
        bits[k // 8, atom] ^= np.uint8(1 << (k % 8))
    told = dynamics.force(state.x, dynamics.tables, decisions=True, given=jnp.asarray(bits))

    d = np.asarray(state.x)[:, other] - np.asarray(state.x)[:, 0]
    d -= np.diag(simulation.cell.matrix) * np.rint(d / np.diag(simulation.cell.matrix))
    r2 = float(d @ d)
    energy = 4 * (r2**-6 - r2**-3)
    pull = d * 24 * (r2**-4 - 2 * r2**-7)
    change = np.asarray(told.force) - np.asarray(own.force)
    assert np.sum(told.energy) - np.sum(own.energy) == pytest.approx(-energy, abs=1e-11)
    assert np.allclose(change[:, 0], -pull, rtol=0, atol=1e-11)
    assert np.allclose(change[:, other], pull, rtol=0, atol=1e-11)
    untouched = np.setdiff1d(np.arange(108), [0, other])
    assert not change[:, untouched].any()
    # what it would have decided itself is still told
    assert np.array_equal(np.asarray(told.decisions.bits), np.asarray(own.decisions.bits))
