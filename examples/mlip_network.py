"""A MACE network of mlip with random weights: run, and differentiated by its weights.

Needs mlip. Its force field takes a graph, which is made here of mdnum's pairs and displacements.
"""

import ase.build
import jax
import jax.numpy as jnp
import numpy as np
from mlip.data import DatasetInfo
from mlip.graph import EdgeOrdering, Graph, GraphEdges, GraphGlobals, GraphNodes
from mlip.models import ForceField, Mace

import mdnum

atoms = ase.build.bulk("Cu", "fcc", a=3.6, cubic=True) * 3
atoms.rattle(0.05, seed=1)
small = {"num_channels": 4, "l_max": 1, "correlation": 2, "radial_mlp_hidden": [8]}
data = DatasetInfo(atomic_energies_map={29: 0.0}, graph_cutoff_angstrom=4.0, avg_num_neighbors=18.0)
network = Mace(Mace.Config(**small, readout_irreps=("4x0e", "0e")), data)
field = ForceField.from_mlip_network(network, seed=42)


def energy(weights, R, neighbor, cell):
    """Energy (eV) of the network with these weights."""
    (i, j), space = neighbor.idx, jax.vmap(mdnum.md.jaxmd.displacement(cell))
    graph = Graph(
        GraphNodes(atomic_numbers=jnp.full(len(R), 29)),
        GraphEdges(displ_fun=jax.tree_util.Partial(lambda a, b, _: space(b, a))),
        GraphGlobals(cell=cell[None], weight=jnp.ones(1)),
        n_node=jnp.array([len(R)]), n_edge=jnp.array([len(i)]), senders=i, receivers=j,
        ordering=EdgeOrdering.SENDER,
    )  # fmt: skip
    strain = jnp.zeros((1, 3, 3))
    return field.predictor.apply(weights, R, strain, graph, method="compute_energy")[0]


potential = mdnum.energy_function(energy, 4.0, parameters=field.params, format="sparse", name="mace")
simulation = mdnum.simulation(atoms, potential, timestep=0.002, temperature=300, seed=1, name="mace")
run = mdnum.run(simulation, steps=50)
print(run.summary["flips_entered"], "pairs entered; ASE agrees:", run.summary["ase"]["ok"])
problem = mdnum.Problem(simulation, mdnum.gradients.losses.MeanPotential(), steps=20)
value, slopes = mdnum.value_and_grad(problem, ["potential"], "symmetric")({})
at = {name: mdnum.parameters(simulation)[name].value for name in slopes}
less, more = (problem.value({name: (1 + h) * at[name] for name in at}) for h in (-1e-4, 1e-4))
print("by weights:", sum(np.sum(slopes[name] * at[name]) for name in at), (more - less) / 2e-4)
