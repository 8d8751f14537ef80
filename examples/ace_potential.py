"""An ACE potential, fitted here by `ace-jax` to forces of EMT: run, and a gradient by its coefficients.

Needs ace-jax and ace-jax-coupling. mdnum gives the pairs, the fitted model takes them as vectors; what is a
parameter is given as one, the rest is held.
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

copper = ase.build.bulk("Cu", "fcc", a=3.6, cubic=True) * 2
frames = [copper.copy() for _ in range(12)]
for seed, frame in enumerate(frames):
    strain = np.random.default_rng(seed).normal(scale=0.02, size=(3, 3))
    frame.set_cell(frame.cell.array @ (np.eye(3) + strain), scale_atoms=True)
    frame.rattle(0.15, seed=seed)
    frame.calc = EMT()
    frame.get_forces()
ase.io.write("copper.extxyz", frames)
cli.main("fit --train copper.extxyz --order 2 --max-degree 6 --rcut 5.0 --out ace".split())
fitted, meta, _ = load("ace/model.npz", fold=False)


def energy(coefficients, R, neighbor, cell):
    """Energy (eV) of the model with these coefficients in place of the fitted ones."""
    atoms, (i, j) = len(R), neighbor.idx
    real, kinds = i < atoms, jnp.zeros(len(R), int)
    i, j = jnp.where(real, i, 0), jnp.where(real, j, 0)
    # padding is where no function of the basis is
    d = jnp.where(real[:, None], jax.vmap(mdnum.md.jaxmd.displacement(cell))(R[j], R[i]), 5.0)
    model = eqx.tree_at(lambda m: (m.WB, m.Wpair), fitted, (coefficients["WB"], coefficients["Wpair"]))
    return jnp.sum(model.site_energies(d, kinds[i], kinds[j], i, atoms, kinds, real))


given = {"WB": fitted.WB, "Wpair": fitted.Wpair}
potential = mdnum.energy_function(energy, meta["rcut"], parameters=given, format="sparse", species=("Cu",))
simulation = mdnum.simulation(copper * 2, potential, timestep=0.002, temperature=300, seed=1, name="ace")
run = mdnum.run(simulation, steps=50)
print(run.summary["flips_entered"], "pairs entered the cutoff; ASE agrees:", run.summary["ase"]["ok"])

problem = mdnum.Problem(simulation, mdnum.gradients.losses.MeanPotential(), steps=20)
value, slopes = mdnum.value_and_grad(problem, ["potential"], "symmetric")({})
at = {name: mdnum.parameters(simulation)[name].value for name in slopes}
less, more = (problem.value({n: at[n] * (1 + h) for n in at}) for h in (-1e-6, 1e-6))
print("by coefficients:", sum(np.sum(slopes[n] * at[n]) for n in at), "differences:", (more - less) / 2e-6)
