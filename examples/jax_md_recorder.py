"""jax-md's own loop, float32 in fractional coordinates: does its list lose pairs, and when do they flip?"""

import jax
import jax.numpy as jnp
from jax_md import energy, partition, simulate, space

import mdnum

R_CUT, SKIN, SIDE, CELLS = 2.0, 0.2, 1.68, 4

# a cubic crystal of 256 atoms in a tilted box, whose columns are the lattice vectors
box = SIDE * CELLS * jnp.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.05], [0.0, 0.0, 1.0]], jnp.float32)
sites = jnp.array([[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])
corners = jnp.stack(jnp.meshgrid(*[jnp.arange(CELLS)] * 3), -1).reshape(-1, 1, 3)
start = ((sites + corners) / CELLS).reshape(-1, 3).astype(jnp.float32)

displacement, shift = space.periodic_general(box, fractional_coordinates=True)
neighbor_fn, energy_fn = energy.lennard_jones_neighbor_list(
    displacement, box, r_onset=1.8, r_cutoff=R_CUT, dr_threshold=SKIN, fractional_coordinates=True,
    format=partition.Sparse,
)  # fmt: skip
init, apply = simulate.nve(energy_fn, shift, dt=4e-3)
neighbors = neighbor_fn.allocate(start)
state = init(jax.random.PRNGKey(0), start, kT=1.5, neighbor=neighbors)


apply, update = jax.jit(apply), jax.jit(lambda neighbors, x: neighbors.update(x))

with mdnum.Recorder(R_CUT, box=box, fractional=True, length="σ", name="jax-md") as recorder:
    for step in range(60):
        state = apply(state, neighbor=neighbors)
        # the list that the forces there are from, and only then the next
        recorder.see(step, state.position, neighbors=neighbors)
        neighbors = update(neighbors, state.position)

outcome = recorder.outcome
print(outcome.verdict.headline)
lists = outcome.summary["lists"]
print(f"{lists['lists']} lists, {lists['lost']} pairs lost, overflow: {lists['overflow']}")
