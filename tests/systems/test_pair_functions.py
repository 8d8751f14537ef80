"""Pair functions of a person: of the species of both atoms, and what is checked before they are used."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms
from gradient_problems import everything

import mdnum
from mdnum.errors import InputError
from mdnum.gradients import Problem
from mdnum.md.cell import wrap_positions

SIGMA, EPSILON = {"Ar": 1.0, "Kr": 1.2, "Ne": 0.8}, {"Ar": 1.0, "Kr": 1.5, "Ne": 0.5}


def mixed(r2, sigma, epsilon):
    """Lennard-Jones by the rules of Lorentz and Berthelot."""
    s6 = ((sigma[0] + sigma[1]) / 2) ** 6 / r2**3
    return 4 * jnp.sqrt(epsilon[0] * epsilon[1]) * (s6 * s6 - s6)


def repulsion(r, species, strength):
    """Screened nuclei, the length of Ziegler, Biersack and Littmark with a single exponential."""
    z1, z2 = species
    return strength * z1 * z2 / r * jnp.exp(-(z1**0.23 + z2**0.23) * r / 2)


def atoms(symbols: str = "Ar12Kr8Ne7") -> Atoms:
    made = Atoms(symbols, cell=[5.0, 5.2, 5.4], pbc=True)
    rng = np.random.default_rng(2)
    points = np.indices((3, 3, 3)).reshape(3, -1).T
    made.set_scaled_positions((points[rng.permutation(27)] + rng.uniform(-0.12, 0.12, (27, 3))) / 3)
    return made


def simulation(potential, cut=None, symbols: str = "Ar12Kr8Ne7"):
    cut = mdnum.Cut("switched", 2.3) if cut is None else cut
    return mdnum.simulation(
        atoms(symbols), potential, cut, units="lj", timestep=0.002, temperature=1.0, skin=0.1
    )


def pairs(values, combine):
    names = sorted(values)
    return {f"{a}-{b}": combine(values[a], values[b]) for k, a in enumerate(names) for b in names[k:]}


@pytest.fixture(scope="module")
def by_species():
    return simulation(mdnum.PairFunction(mixed, sigma=SIGMA, epsilon=EPSILON))


@pytest.fixture(scope="module")
def by_pair():
    sigma, epsilon = pairs(SIGMA, lambda a, b: (a + b) / 2), pairs(EPSILON, lambda a, b: np.sqrt(a * b))
    return simulation(mdnum.LennardJones(sigma, epsilon))


def test_a_function_of_values_by_species_is_the_potential_of_its_mixing_rule(by_species, by_pair):
    mine, theirs = by_species.evaluate(), by_pair.evaluate()
    assert mine.energy == pytest.approx(theirs.energy, rel=1e-13)
    scale = np.abs(theirs.forces).max()
    np.testing.assert_allclose(mine.forces, theirs.forces, rtol=0, atol=1e-13 * scale)
    np.testing.assert_allclose(mine.stress, theirs.stress, rtol=1e-12, atol=1e-13 * scale)


def test_it_is_compiled_into_the_loop_over_the_list(by_species):
    wrapped, _ = wrap_positions(by_species.cell, by_species.positions)
    tables = by_species.tables(by_species.verlet_list().build(wrapped, by_species.cell))
    step = partial(by_species.force, decisions=True)
    assert "mdnum_pairs_" in str(jax.make_jaxpr(step)(jnp.asarray(wrapped.T), tables))


def test_values_by_species_have_names_and_derivatives(by_species, by_pair):
    """By the chain rule from those by pair."""
    found = mdnum.parameters(by_species)
    assert found["potential.sigma"].by == "species" and found["potential.sigma"].value.shape == (3,)
    changed = mdnum.changed(by_species, {"potential.species.Kr.sigma": 1.25})
    assert changed.potential.by_species["sigma"].tolist() == [1.0, 1.25, 0.8]
    names = ("potential.sigma", "potential.epsilon", "potential.species.Kr.sigma")
    loss = everything(27)
    mine = mdnum.method("symmetric")(Problem(by_species, loss, 8), names).gradient
    theirs = mdnum.method("symmetric")(Problem(by_pair, loss, 8), names[:2]).gradient
    symbols = sorted(SIGMA)
    kinds = [(a, b) for k, a in enumerate(symbols) for b in symbols[k:]]
    by_sigma = dict.fromkeys(symbols, 0.0)
    by_epsilon = dict.fromkeys(symbols, 0.0)
    for k, (a, b) in enumerate(kinds):
        for one, other in ((a, b), (b, a)):
            by_sigma[one] += theirs["potential.sigma"][k] / 2
            by_epsilon[one] += theirs["potential.epsilon"][k] * np.sqrt(EPSILON[other] / EPSILON[one]) / 2
    np.testing.assert_allclose(mine[names[0]], [by_sigma[one] for one in symbols], rtol=1e-10)
    np.testing.assert_allclose(mine[names[1]], [by_epsilon[one] for one in symbols], rtol=1e-10)
    assert mine[names[2]] == mine[names[0]][1]


def test_an_argument_species_is_the_atomic_numbers_of_both():
    made = simulation(mdnum.PairFunction(repulsion, strength=0.01), mdnum.Cut("shifted", 2.0))
    x, z, box = made.positions, made.structure.numbers.astype(float), np.diag(made.structure.cell)
    total = 0.0
    for i in range(27):
        for j in range(i):
            d = x[i] - x[j]
            r = np.linalg.norm(d - box * np.round(d / box))
            u = [0.01 * z[i] * z[j] / s * np.exp(-(z[i] ** 0.23 + z[j] ** 0.23) * s / 2) for s in (r, 2.0)]
            total += (u[0] - u[1]) * (r < 2.0)
    assert made.evaluate().energy == pytest.approx(total, rel=1e-12)
    assert mdnum.parameters(made)["potential.species"].value.tolist() == [18, 36, 10]


def one_sided(r, sigma):
    return sigma[0] / r


def nearly(r, species, c):
    z1, z2 = species
    return c * (z1 * z2 / r + 1e-6 * (z1 - z2) * r)


@pytest.mark.parametrize(
    ("potential", "message"),
    [
        (mdnum.PairFunction(one_sided, sigma=SIGMA), r"one_sided: u of Ar, Kr is .*r = 0\.69.* Kr, Ar"),
        (mdnum.PairFunction(nearly, c=1.0), r"nearly: u of Ar, Kr is"),
        (mdnum.PairFunction(mixed, sigma={"Ar": 1.0}, epsilon=EPSILON), r"potential\.sigma: .*Kr, Ne"),
        (mdnum.LennardJones({**pairs(SIGMA, min), "Kr-Ar": 3.0}, 1.0), r"potential\.sigma: Kr-Ar"),
    ],
)
def test_a_pair_that_is_not_the_same_in_either_order_is_refused(potential, message):
    with pytest.raises(InputError, match=message):
        simulation(potential)


def test_one_species_needs_no_order():
    own = mdnum.PairFunction(one_sided, sigma={"Ar": 1.5})
    assert simulation(own, symbols="Ar27").evaluate().energy > 0
    assert mdnum.parameters(simulation(own, symbols="Ar27"))["potential.sigma"].value.shape == ()
