"""Gradients by the parameters and the radius of each term: against a closed form and differences."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from ase.build import bulk
from gradient_problems import everything

import mdnum
from mdnum import Cut, LennardJones, PairFunction, Term
from mdnum.gradients import Problem, method
from mdnum.gradients.averages import BoundaryTerm
from mdnum.gradients.losses import Custom
from mdnum.systems import build
from mdnum.systems.parameters import value


def yukawa(r, strength, kappa):
    return strength * jnp.exp(-kappa * r) / r


def leaving():
    """The shipped pair that leaves a well, in a sum of two wells with an end each; one is of charges."""
    plain = build("pair/leaving-well")
    atoms = plain.structure.copy()
    atoms.set_velocities(plain.velocities)
    terms = {
        "core": Term(LennardJones(sigma=1.0, epsilon=1.0), Cut("hard", 2.2)),
        "tail": Term(PairFunction(yukawa, strength=0.9, kappa=0.4), Cut("hard", 2.6), np.array([1.0, -0.5])),
    }
    made = mdnum.simulation(atoms, terms, units="lj", timestep=plain.timestep, skin=0.3)
    axis = int(np.argmax(np.abs(plain.positions[1] - plain.positions[0])))
    loss = Custom(see=lambda frame, *_: frame.v[axis, 1] - frame.v[axis, 0], first=2000)
    return Problem(made, loss, 2000), axis


#: Parameter and symbol of the closed form.
NAMES = {
    "terms.core.potential.sigma": "sigma", "terms.core.potential.epsilon": "epsilon",
    "terms.tail.potential.strength": "strength", "terms.tail.potential.kappa": "kappa",
    "terms.core.cutoff.radius": "first", "terms.tail.cutoff.radius": "second",
}  # fmt: skip


def exact():
    """Derivatives of the final speed, by conservation of energy with one step down at each radius.

    mu v²/2 = mu v0²/2 + u1(r0) + u2(r0) - u1(first) - u2(second), the reduced mass 1.
    """
    names = "r0 v0 sigma epsilon strength kappa first second"
    r0, v0, sigma, epsilon, strength, kappa, first, second = every = sympy.symbols(names, positive=True)

    def core(r):
        return 4 * epsilon * ((sigma / r) ** 12 - (sigma / r) ** 6)

    def tail(r):
        return -0.5 * strength * sympy.exp(-kappa * r) / r

    v = sympy.sqrt(v0**2 + 2 * (core(r0) + tail(r0) - core(first) - tail(second)))
    at = dict(zip(every, (1.8, 1, 1, 1, 0.9, 0.4, 2.2, 2.6), strict=True))
    return {str(q): float(sympy.diff(v, q).subs(at)) for q in every} | {"v": float(v.subs(at))}


def test_leaving_two_wells_has_the_derivatives_of_the_closed_form():
    problem, axis = leaving()
    true = exact()
    made = method("event-aware")(problem, (*NAMES, "initial.positions"))
    assert made.value == pytest.approx(true["v"], abs=2e-5) and made.details["crossings"] == 2
    for name, symbol in NAMES.items():
        assert float(made.gradient[name]) == pytest.approx(true[symbol], abs=2e-4), name
    x = made.gradient["initial.positions"]
    assert (x[1, axis] - x[0, axis]) / 2 == pytest.approx(true["r0"], abs=2e-4)
    # a pair's energy goes with the product of the weights of its atoms, 1 and -0.5, and with the strength
    weights = method("event-aware")(problem, ("terms.tail.weight",)).gradient["terms.tail.weight"]
    np.testing.assert_allclose(weights, 0.9 * true["strength"] / np.array([1.0, -0.5]), atol=2e-4)
    # without the flips it is wrong, and no radius seems to matter
    plain = method("symmetric")(problem, tuple(NAMES))
    assert float(plain.gradient["terms.core.cutoff.radius"]) == 0.0
    assert abs(float(plain.gradient["terms.tail.potential.kappa"]) - true["kappa"]) > 1e-3


@pytest.fixture(scope="module")
def mixed():
    """Two species, three terms, two radii; one term has weights."""
    atoms = bulk("Ar", "fcc", a=5.5, cubic=True).repeat(4)
    rng = np.random.default_rng(4)
    atoms.symbols[rng.choice(len(atoms), 90, replace=False)] = "Kr"
    atoms.positions += rng.normal(0, 0.15, atoms.positions.shape)
    sigma = {"Ar-Ar": 3.4, "Ar-Kr": 3.5, "Kr-Kr": 3.6}
    terms = {
        "core": Term(LennardJones(sigma=sigma, epsilon=0.0104), Cut("quintic", 7.0)),
        "tail": Term(
            PairFunction(yukawa, strength=0.2, kappa=0.3), Cut("force-shifted", 9.2), rng.normal(0, 1, 256)
        ),
        "more": Term(PairFunction(yukawa, strength=0.05, kappa=0.2), Cut("shifted", 9.2)),
    }
    made = mdnum.simulation(atoms, terms, timestep=0.004, temperature=150, seed=2, skin=0.6)
    return Problem(made, everything(256), 21)


WANTED = (
    "terms.core.potential.sigma", "terms.tail.potential.kappa", "terms.more.potential.strength",
    "terms.core.cutoff.radius", "terms.core.cutoff.onset", "box.scale", "dynamics.timestep",
)  # fmt: skip


@pytest.mark.nightly
def test_methods_agree_on_terms(mixed):
    by_hand = method("symmetric")(mixed, WANTED)
    assert by_hand.gradient["terms.core.potential.sigma"].shape == (3,)
    for name in ("unrolled", "forward"):
        other = method(name)(mixed, WANTED)
        for key in WANTED:
            scale = np.abs(by_hand.gradient[key]).max()
            np.testing.assert_allclose(other.gradient[key], by_hand.gradient[key], rtol=0, atol=1e-9 * scale)


@pytest.mark.nightly
def test_differences_agree_on_terms(mixed):
    problem = replace(mixed, steps=8)
    names = (
        "terms.core.potential.pairs.Ar-Kr.sigma",
        "terms.tail.potential.kappa",
        "terms.core.cutoff.radius",
    )
    by_hand = method("symmetric")(problem, names)
    for name in names:
        # of a parameter with an entry for each pair type all of them
        here, size = value(problem.simulation, name), 1e-5
        ends = [
            method("symmetric")(
                replace(problem, simulation=mdnum.changed(problem.simulation, {name: here + sign * size})),
                ("box.scale",),
            ).value
            for sign in (1, -1)
        ]
        expected = (ends[0] - ends[1]) / (2 * size)
        assert float(np.sum(by_hand.gradient[name])) == pytest.approx(expected, rel=2e-5), name


@pytest.mark.nightly
def test_derivatives_by_weights(mixed):
    """In a sum of three terms whose middle one has weights, and in one whose terms share a decision."""
    names, shared = ("terms.tail.weight", "terms.core.potential.epsilon"), {"terms.core.cutoff.radius": 9.2}
    every = mixed.simulation, mdnum.changed(mixed.simulation, {**shared, "terms.core.cutoff.onset": 8.0})
    assert [one.channels for one in every] == [2, 1]
    for simulation in every:
        problem = replace(mixed, simulation=simulation, steps=6)
        by_hand = method("symmetric")(problem, names).gradient
        unrolled = method("unrolled")(problem, names).gradient
        for name in names:
            scale = np.abs(unrolled[name]).max()
            np.testing.assert_allclose(by_hand[name], unrolled[name], rtol=0, atol=1e-9 * scale)
        atom = int(np.argmax(np.abs(by_hand[names[0]])))
        entry, here = f"{names[0]}.{atom}", value(simulation, names[0])[atom]
        ends = [problem.at({entry: here + shift}).value() for shift in (1e-4, -1e-4)]
        expected = (ends[0] - ends[1]) / 2e-4
        assert by_hand[names[0]][atom] == pytest.approx(expected, rel=2e-5)
        tangent = method("forward")(problem, (entry,)).gradient[entry]
        assert float(tangent) == pytest.approx(by_hand[names[0]][atom], rel=1e-9)


def test_paths_of_terms(mixed):
    simulation = mixed.simulation
    found = mdnum.parameters(simulation)
    terms = {key: found[key] for key in found if key.startswith(("terms.", "potential.", "cutoff."))}
    # two terms that share a decision beside another have one radius each, and all three none
    assert list(terms) == [
        "terms.core.potential.sigma", "terms.core.potential.epsilon", "terms.core.cutoff.radius",
        "terms.core.cutoff.onset", "terms.tail.potential.strength", "terms.tail.potential.kappa",
        "terms.tail.weight", "terms.more.potential.strength", "terms.more.potential.kappa",
        "terms.tail.cutoff.radius", "terms.more.cutoff.radius",
    ]  # fmt: skip
    assert terms["terms.core.potential.sigma"].by == "pair type"
    assert terms["terms.core.cutoff.radius"].unit == "Å"
    other = mdnum.changed(
        simulation, {"terms.core.cutoff.radius": 7.5, "terms.more.potential.kappa": [0.3] * 3}
    )
    assert other.decider.r_cut == (7.5,) * 3 + (9.2,) * 3
    assert mdnum.parameters(other)["terms.more.potential.kappa"].value.tolist() == [0.3] * 3
    with pytest.raises(mdnum.InputError, match="onset"):
        mdnum.changed(simulation, {"terms.core.cutoff.radius": 6.0})
    for name in ("terms.tail.cutoff.radius", "terms.more.cutoff.radius"):
        with pytest.raises(mdnum.InputError, match="tail, more"):
            method("symmetric")(mixed, (name,))
    # of terms that all share their decisions it is one
    terms = {name: Term(LennardJones(sigma=3.4, epsilon=0.01), Cut("hard", 7.0)) for name in "ab"}
    shared = mdnum.simulation(bulk("Ar", "fcc", a=5.5, cubic=True).repeat(4), terms, timestep=0.004)
    assert "cutoff.radius" in mdnum.parameters(shared) and shared.channels == 1
    wider = mdnum.changed(shared, {"cutoff.radius": 8.0})
    assert wider.decider.r_cut == (8.0,) and wider.evaluate().energy != shared.evaluate().energy


def test_methods_for_one_potential_refuse_terms(mixed):
    for made in (BoundaryTerm(), method("reweighting"), method("surrogate")):
        with pytest.raises(mdnum.InputError, match=r"core \+ tail"):
            made(mixed, ("terms.core.potential.epsilon",))
