"""One trajectory by the code of molecular dynamics and by that of the ball."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from ase import Atoms
from oracles import broken_alternations
from small_systems import make

from mdnum import ball
from mdnum.md.pairforce import MdState, PairDynamics
from mdnum.numerics.events import Ledger
from mdnum.rollout.engine import first_state
from mdnum.systems.build import build


def test_a_contact_is_a_pair_inside_the_cutoff():
    """A ball on a spring floor is a pair of soft spheres, reduced mass 1: one trajectory and one ledger."""
    k, h, steps, speed = 1000.0, 2e-3, 400, 1.03
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [1.2, 0, 0]], masses=[2.0, 2.0])
    atoms.set_velocities([[speed / 2, 0, 0], [-speed / 2, 0, 0]])
    simulation = build(
        make(
            atoms,
            {"kind": "soft-sphere", "sigma": 1.0, "epsilon": k, "alpha": 2.0},
            {"kind": "hard", "radius": 1.0, "compare": "r <"},
            neighbors={"skin": 1.0},
            dynamics={"kind": "nve", "timestep": h, "remove_drift": False},
        )
    )
    start = first_state(simulation)
    table = simulation.verlet_list().build(start.reference, simulation.cell)
    masses = jnp.asarray(simulation.masses[table.order])
    dynamics = PairDynamics(simulation.force, simulation.integrator, masses, simulation.tables(table))
    state = MdState(jnp.zeros((), jnp.int64), start.state.x[:, table.order], start.state.v[:, table.order])

    def advance(state, _):
        own = dynamics.decide(state)
        distance = jnp.abs(state.x[0, 0] - state.x[0, 1])
        return dynamics.step(state, own), (distance, jnp.max(dynamics.margins(state)), jnp.any(own > 0))

    _, rows = jax.jit(lambda state: jax.lax.scan(advance, state, length=steps + 1))(state)
    distance, margin, inside = (np.asarray(column) for column in rows)

    world = ball.World.create(ball.Penalty(k), ball.BallVerlet(h), gravity=0.0)
    rollout = ball.simulate(world, world.start(0.2, -speed), steps)
    np.testing.assert_allclose(rollout.y[:, 0] + 1, distance, rtol=0, atol=2e-13)
    np.testing.assert_array_equal(rollout.contact[:, 0], inside[1:])
    contacts = rollout.contacts
    assert isinstance(contacts, Ledger) and broken_alternations(contacts) == 0
    assert list(contacts.entered) == [True, False]
    np.testing.assert_allclose(contacts.margin, margin[contacts.step], rtol=0, atol=2e-13)
