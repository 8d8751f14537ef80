"""Two pair terms that add: a Lennard-Jones core and a screened charge with a longer reach of its own."""

import ase.build
import jax.numpy as jnp
import numpy as np

import mdnum


def screened(r, strength, kappa):
    """Pair energy (eV) of two unit charges at a distance (Å)."""
    return strength * jnp.exp(-kappa * r) / r


salt = ase.build.bulk("NaCl", "rocksalt", a=5.8, cubic=True).repeat(4)
sigma = {"Na-Na": 2.6, "Na-Cl": 2.5, "Cl-Cl": 3.9}
terms = {
    "core": mdnum.Term(mdnum.LennardJones(sigma=sigma, epsilon=0.01), mdnum.Cut("switched", 7.0)),
    "charge": mdnum.Term(
        mdnum.PairFunction(screened, strength=2.0, kappa=0.3),
        mdnum.Cut("hard", 9.0),
        weight={"Na": 1.0, "Cl": -1.0},
    ),
}
simulation = mdnum.simulation(salt, terms, timestep=0.002, temperature=600, name="screened-salt")

run = mdnum.run(simulation, steps=60)
flips = mdnum.store.RunFolder.open(run.folder).read("flips")
for term, count in zip(*np.unique(flips["terms"].astype(str), return_counts=True), strict=True):
    print(count, "flips of", term)
print("energy budget closes:", run.summary["energy_budget_closes"])
print("an independent sum agrees:", run.summary["ase"]["ok"])

names = ["terms.core.potential.epsilon", "terms.charge.potential.kappa", "terms.charge.cutoff.radius"]
grad = mdnum.grad(simulation, "potential", names, steps=20, methods="event-aware")
for method in grad.summary["methods"]:
    print(method["method"], method["gradient"])
