"""A network as a pair potential: trained here, run, and an observable differentiated by its weights."""

import ase.build
import jax
import jax.numpy as jnp
import numpy as np

import mdnum


def network(r, layers):
    """Pair energy (ε) at distances (σ) of a network of two layers."""
    h = (r[..., None] - 1.5) * 2
    for layer in layers:
        h = jnp.tanh(h @ layer["weight"] + layer["bias"])
    return jnp.sum(h, -1)


def loss(layers):
    """Against Lennard-Jones energies of pairs."""
    r = jnp.linspace(0.95, 2.5, 100)
    return jnp.mean((network(r, layers) - 4 * (r**-12 - r**-6)) ** 2)


rng = np.random.default_rng(0)
layers = [
    {"weight": jnp.asarray(rng.normal(size=(a, b)) / a**0.5), "bias": jnp.zeros(b)}
    for a, b in ((1, 16), (16, 16))
]
step = jax.jit(lambda at: jax.tree.map(lambda w, slope: w - 0.01 * slope, at, jax.grad(loss)(at)))
for _ in range(4000):
    layers = step(layers)
print("root mean square error", float(loss(layers)) ** 0.5)

crystal = ase.build.bulk("Ar", "fcc", a=1.6, cubic=True).repeat(4)
potential = mdnum.PairFunction(network, layers=layers)
settings = {"units": "lj", "timestep": 0.004, "temperature": 1.0, "name": "network"}
simulation = mdnum.simulation(crystal, potential, mdnum.Cut("switched", 2.2), **settings)
run = mdnum.run(simulation, steps=50)
print(run.summary["flips_entered"], "pairs entered the cutoff; ASE agrees:", run.summary["ase"]["ok"])

problem = mdnum.Problem(simulation, mdnum.gradients.losses.MeanPotential(), steps=50)
value, slopes = mdnum.value_and_grad(problem, ["potential"], "symmetric")({})
along = {name: rng.normal(size=slope.shape) for name, slope in slopes.items()}
at = {name: mdnum.parameters(simulation)[name].value for name in slopes}
less, more = (problem.value({n: at[n] + h * along[n] for n in at}) for h in (-1e-5, 1e-5))
print("by weights:", sum(np.sum(slopes[n] * along[n]) for n in at), "differences:", (more - less) / 2e-5)
