"""Is a trusted gradient of a learned potential correct? Sixty starting states of four small potentials are
compared with finite differences.

Answer. For 45 of the starting states 87 of 90 derivatives are trusted, and all trusted derivatives are
correct within 2 % (docs/own-energies.md). It takes an hour.

Derivatives are by the gains of two layers, factors of their weights: d/dgain is the derivative along all
weights of a layer. The loss is one of five in turn. The truth comes from central differences of mdnum's own
runs at an eighth of the time step, over shifts of a gain between 1e-5 and 1e-8; rules, counts and columns are
those of gradient_trust.py.

    pair network        2 x 16, trained on Lennard-Jones, switched; 108 atoms
    the same, listed    as an energy over a neighbor list, with an end of its own
    graph network       jax-md's, random weights; its energy jumps at the cutoff; 32 atoms
    Behler-Parrinello   jax-md's over a dense list, random weights; 32 atoms

Every start is kept in a file of its own (--store): the study goes on where it was stopped.

    nice python scripts/campaigns/learned_gradients.py
    python scripts/campaigns/learned_gradients.py --only "pair network" --seeds 2
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import _shared  # noqa: F401  what scripts share is found by it
import jax
import jax.numpy as jnp
import numpy as np
from _located import LOSSES
from _output import start
from ase.build import bulk
from gradient_trust import differences, finer, options, stored, table, word

import mdnum
from mdnum.gradients import Problem
from mdnum.gradients.diagnose import diagnose
from mdnum.gradients.differences import replica
from mdnum.gradients.losses import parse
from mdnum.md import jaxmd
from mdnum.systems import Simulation

#: Of the first two layers.
ONE = [jnp.ones(()), jnp.ones(())]


@cache
def trained() -> list[dict[str, jax.Array]]:
    """Layers of a pair network trained on Lennard-Jones."""
    rng = np.random.default_rng(0)
    sizes = ((1, 16), (16, 16))
    layers = [{"w": jnp.asarray(rng.normal(size=s) / s[0] ** 0.5), "b": jnp.zeros(s[1])} for s in sizes]
    r = jnp.linspace(0.95, 2.5, 100)

    def loss(layers):
        return jnp.mean((network(r, ONE, layers) - 4 * (r**-12 - r**-6)) ** 2)

    step = jax.jit(lambda at: jax.tree.map(lambda w, slope: w - 0.01 * slope, at, jax.grad(loss)(at)))
    for _ in range(4000):
        layers = step(layers)
    return layers


def network(r, gains, layers=None):
    """Pair energy (ε) at distances (σ)."""
    h = (r[..., None] - 1.5) * 2
    for layer, gain in zip(trained() if layers is None else layers, gains, strict=True):
        h = jnp.tanh(gain * (h @ layer["w"]) + layer["b"])
    return jnp.sum(h, -1)


def simulation(atoms, potential, *cutoff, **settings: Any) -> Simulation:
    settings = {"timestep": 0.004, "units": "lj", "temperature": 0.8, "name": "learned", **settings}
    return mdnum.simulation(atoms, potential, *cutoff, **settings)


@cache
def pairs() -> Simulation:
    trained()
    crystal = bulk("Ar", "fcc", a=1.6, cubic=True) * 3
    return simulation(crystal, mdnum.PairFunction(network, gains=ONE), mdnum.Cut("switched", 2.1), skin=0.25)


@cache
def listed() -> Simulation:
    """The pair network as an energy over a list, times (1 - r²/R²)³."""
    trained()

    def energy(gains, R, neighbor, cell):
        i, j = neighbor.idx
        real = i < len(R)
        d = jax.vmap(jaxmd.displacement(cell))(R[jnp.where(real, i, 0)], R[jnp.where(real, j, 0)])
        t = 1 - jnp.sum(jnp.where(real[:, None], d, 1.0) ** 2, axis=1) / 2.1**2
        there = real & (t > 0)
        r = 2.1 * jnp.sqrt(1 - jnp.where(there, t, 0.5))
        return 0.5 * jnp.sum(jnp.where(there, network(r, gains) * t**3, 0.0))

    crystal = bulk("Ar", "fcc", a=1.6, cubic=True) * 3
    made = mdnum.energy_function(energy, 2.1, parameters=ONE, format="sparse")
    return simulation(crystal, made, skin=0.25)


def of_jax_md(make: Callable[..., Any], r_cut: float, format: Any, **more: Any) -> Simulation:
    """A network of jax-md with random weights; gains multiply those of its first two kernels."""
    from flax import nnx

    side = 2 * 5.26
    space = jaxmd.upstream().space.periodic_general(jnp.eye(3) * side, fractional_coordinates=False)[0]
    with jaxmd.standard_promotion():
        sizes = {"dr_threshold": 0.3, "mlp_sizes": (8, 8)}
        _, function = make(space, jnp.asarray(side), key=jax.random.key(1), **sizes, **more)
        graph, state = nnx.split(function.model)
    leaves, tree = jax.tree.flatten(state)
    kernels = [place for place, leaf in enumerate(leaves) if jnp.ndim(leaf) == 2]

    def energy(gains, R, neighbor, **kw):
        scaled = list(leaves)
        for gain, place in zip(gains, kernels[:2], strict=True):
            scaled[place] = leaves[place] * gain
        return nnx.merge(graph, jax.tree.unflatten(tree, scaled))(R, neighbor, **kw)

    made = mdnum.energy_function(energy, r_cut, parameters=ONE, format=format, units=("Å", "meV"))
    crystal = bulk("Ar", "fcc", a=5.26, cubic=True) * 2
    crystal.rattle(0.1, seed=1)
    return simulation(crystal, made, units="metal", timestep=0.004, temperature=60, skin=0.3)


@cache
def graph() -> Simulation:
    make = jaxmd.upstream().energy.graph_network_neighbor_list
    return of_jax_md(make, 4.7, "sparse", r_cutoff=jaxmd.scalar(4.7))


@cache
def behler_parrinello() -> Simulation:
    md = jaxmd.upstream()
    make = partial(md.energy.behler_parrinello_neighbor_list, format=md.partition.Dense)
    return of_jax_md(make, 4.7, "dense", sym_kwargs={"cutoff_distance": jaxmd.scalar(4.7)})


#: How each is made, and how many starts it has.
CASES: dict[str, tuple[Callable[[], Simulation], int]] = {
    "pair network": (pairs, 24),
    "the same, listed": (listed, 24),
    "graph network": (graph, 6),
    "Behler-Parrinello": (behler_parrinello, 6),
}


def examined(make: Callable[[], Simulation], steps: int, seed: int) -> list[dict[str, Any]]:
    """Verdicts and differences of one start: a row for each gain."""
    here, loss = replica(make(), seed, 20), LOSSES[seed % len(LOSSES)]
    problem = Problem(here, parse(word(loss, steps), here, steps), steps)
    names = [name for name in mdnum.parameters(here) if name.endswith((".0", ".1"))]
    found = diagnose(problem, names, parts=("agreement", "trust"), methods=("symmetric", "event-aware"))
    assert found.agreement is not None and found.trust is not None
    own = found.agreement.gradient("event-aware") or found.agreement.gradient("symmetric")
    assert own is not None
    fine = finer(problem)
    return [
        {
            "loss": loss, "name": name, "gradient": float(np.sum(own.gradient[name])),
            "differences": [float(one) for one in differences(fine.value, name, 1.0)],
            "verdict": found.trust.by[name].verdict, "limited_by": found.trust.by[name].limited_by,
        }
        for name in names
    ]  # fmt: skip


def main() -> None:
    """Parse, examine what is missing, count."""
    chosen = options(__doc__, CASES, 40, "learned_gradients").parse_args()
    found = {}
    for name in chosen.only:
        make, count = CASES[name]
        seeds = range(chosen.seeds or count)
        found[name] = stored(chosen.store, name, seeds, partial(examined, make, chosen.steps))
    print(table(found))


if __name__ == "__main__":
    start(main)
