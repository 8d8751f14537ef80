"""What a crossing does to the energy: h for a force jump, h² for a kink in the force, h³ beyond that.

Pairs of atoms fly at one another from beyond the cutoff, bounce and fly apart again. Before and after, they
are free and their energy is exactly that of their motion, so the energy error of the collision is that of
its two crossings. Pairs that differ in where a step meets the cutoff get different errors; their spread
is the random kick.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms
from rollout.harness import write_system

from mdnum.rollout.engine import Engine
from mdnum.systems import load
from mdnum.systems.build import build

PHASES = 64
# relative; from pair to pair a little different, so that the ways in and out are not in step with each other
SPEED = 1.0 + 0.1 * (np.arange(PHASES) * 0.6180339887 % 1.0)


def collisions(folder, kind):
    onset = {"onset": 2.1} if kind in ("switched", "quintic", "cosine") else {}
    atoms = Atoms(f"Ar{2 * PHASES}", masses=np.ones(2 * PHASES), positions=np.zeros((2 * PHASES, 3)))
    atoms.positions[:, 1] = np.repeat(np.arange(PHASES), 2) * 10.0
    atoms.positions[1::2, 0] = 2.6
    path = write_system(
        folder, atoms, cutoff={"kind": kind, "radius": 2.5, **onset}, dynamics={"temperature": 0.0}
    )
    return build(load(path))


def kicks(simulation, timestep):
    """Energy gained by each pair in its collision."""
    positions, velocities = simulation.positions.copy(), np.zeros_like(simulation.positions)
    # the phase of a pair: where within a step it meets the cutoff
    positions[1::2, 0] = 2.5 + timestep * SPEED * (2 + np.arange(PHASES) / PHASES)
    velocities[0::2, 0], velocities[1::2, 0] = SPEED / 2, -SPEED / 2
    integrator = eqx.tree_at(lambda i: i.timestep, simulation.integrator, jnp.asarray(timestep, jnp.float64))
    run = replace(simulation, positions=positions, velocities=velocities, integrator=integrator)
    *_, segment = Engine(run, int(3.6 / timestep)).segments()
    x, v = (segment.unsorted(name, segment.rows - 1) for name in ("x", "v"))
    assert np.all(x[1::2, 0] - x[0::2, 0] > 2.5), "some pair has not left yet"
    relative = v[1::2, 0] - v[0::2, 0]
    assert np.all(relative > 0.5 * SPEED)
    return 0.25 * (relative**2 - SPEED**2)


@pytest.mark.parametrize(
    "kind, order",
    [
        ("hard", 1),
        pytest.param("switched", 2, marks=pytest.mark.slow),
        ("quintic", 3),
        pytest.param("shifted", 1, marks=pytest.mark.slow),
        pytest.param("force-shifted", 2, marks=pytest.mark.slow),
        pytest.param("cosine", 2, marks=pytest.mark.slow),
    ],
)
def test_the_random_kick_of_a_crossing_scales_with_its_smoothness(tmp_path, kind, order):
    simulation = collisions(tmp_path, kind)
    steps = 0.008 / 2.0 ** np.arange(4)
    spreads = [np.std(kicks(simulation, h)) for h in steps]
    slope = np.polyfit(np.log(steps), np.log(spreads), 1)[0]
    assert slope == pytest.approx(order, abs=0.25), spreads
    assert simulation.cutoff.smoothness + (2 if kind == "hard" else 1) == order
