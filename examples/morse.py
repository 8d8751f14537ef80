"""A pair potential of one's own: run, recorded, compared, forked and differentiated like mdnum's."""

import ase.build
import jax.numpy as jnp

import mdnum


def morse(r, depth, alpha, r0):
    """Pair energy (eV) at a distance (Å); mdnum differentiates it."""
    bond = jnp.exp(-alpha * (r - r0))
    return depth * (bond * bond - 2 * bond)


copper = ase.build.bulk("Cu", "fcc", a=3.615, cubic=True).repeat(5)
potential = mdnum.PairFunction(morse, depth=0.3429, alpha=1.3588, r0=2.866)
simulation = mdnum.simulation(
    copper, potential, mdnum.Cut("switched", 6.0), timestep=0.002, temperature=600, name="copper-morse"
)

run = mdnum.run(simulation, steps=100)
print(run.summary["flips_entered"], "pairs entered the cutoff; ASE's list agrees:", run.summary["ase"]["ok"])

fork = mdnum.fork(simulation, "precision", steps=100)
print(fork.verdict.headline)

grad = mdnum.grad(simulation, "potential", ["alpha", "depth", "r0", "r_cut"], steps=50, methods="event-aware")
for method in grad.summary["methods"]:
    print(method["method"], method["gradient"])
