"""An ACE potential, fitted here by ace-jax to EMT: run, and differentiated by its coefficients.

Needs ace-jax and ace-jax-coupling. The coefficients are parameters, the rest of the model is held.
"""

import ase.build
import ase.io
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from ace_jax import cli
from ace_jax.eval.io import load
from ase.calculators.emt import EMT

import mdnum

frames = [ase.build.bulk("Cu", "fcc", a=3.5 + 0.02 * k, cubic=True) * 2 for k in range(12)]
for seed, frame in enumerate(frames):
    frame.rattle(0.15, seed=seed)
    frame.calc = EMT()
    frame.get_forces()  # which are written
ase.io.write("copper.extxyz", frames)
basis = ["--order", "2", "--max-degree", "6", "--rcut", "5.0"]
cli.main(["fit", "--train", "copper.extxyz", *basis, "--out", "ace"])
fitted, meta, _ = load("ace/model.npz", fold=False)


def energy(weights, R, neighbor, cell):
    """Energy (eV) of the model with other coefficients."""
    real, kinds = neighbor.idx[0] < len(R), jnp.zeros(len(R), int)
    i, j = jnp.where(real, neighbor.idx, 0)
    # padding is put where every function of the basis is 0
    d = jnp.where(real[:, None], jax.vmap(mdnum.md.jaxmd.displacement(cell))(R[j], R[i]), 5.0)
    model = eqx.tree_at(lambda m: (m.WB, m.Wpair), fitted, (weights["WB"], weights["Wpair"]))
    return jnp.sum(model.site_energies(d, kinds[i], kinds[j], i, len(R), kinds, real))


given = {"WB": fitted.WB, "Wpair": fitted.Wpair}
potential = mdnum.energy_function(energy, meta["rcut"], parameters=given, format="sparse", name="ace")
simulation = mdnum.simulation(frames[5] * 2, potential, timestep=0.002, temperature=300, seed=1, name="ace")
run = mdnum.run(simulation, steps=50)
print(run.summary["flips_entered"], "pairs entered; ASE agrees:", run.summary["ase"]["ok"])
problem = mdnum.Problem(simulation, mdnum.gradients.losses.MeanPotential(), steps=20)
value, slopes = mdnum.value_and_grad(problem, ["potential"], "symmetric")({})
at = {name: mdnum.parameters(simulation)[name].value for name in slopes}
less, more = (problem.value({name: (1 + h) * at[name] for name in at}) for h in (-1e-4, 1e-4))
print("by coefficients:", sum(np.sum(slopes[name] * at[name]) for name in at), (more - less) / 2e-4)
