"""jax-md's graph network as a potential, and the same run in float32 beside it.

The network is what `jax_md.energy.graph_network_neighbor_list` returns, with random weights. Its own cutoff
is a little longer than `r_cut`, so that the list decides which pairs are edges: then one run can be given
the decisions of the other.
"""

from typing import Any

import ase.build
import jax
import jax.numpy as jnp
import jax_md

import mdnum
from mdnum.md.jaxmd import scalar

SIDE = 2 * 5.26
# jax-md annotates a float where it keeps the digits of an array alone
cutoff: Any = scalar(4.7)
atoms = ase.build.bulk("Ar", "fcc", a=5.26, cubic=True) * 2
atoms.rattle(0.1, seed=1)

displacement, _ = jax_md.space.periodic(scalar(SIDE))
network = jax_md.energy.graph_network_neighbor_list(
    displacement, jnp.asarray(SIDE), cutoff, 0.3, key=jax.random.key(0), mlp_sizes=(8, 8)
)
potential = mdnum.energy_function(network, 4.5, units=("Å", "meV"))
simulation = mdnum.simulation(
    atoms, potential, timestep=0.002, temperature=60, seed=1, skin=0.3, name="network"
)
print("noted:", *(code for code, _ in simulation.model.notes), "the list decides:", simulation.imposable)

outcome = mdnum.fork(simulation, "precision", steps=60)
print(outcome)
