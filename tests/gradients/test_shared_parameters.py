"""Derivatives by parameters that all pairs share: the weights of a small network as a pair potential."""

from __future__ import annotations

from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms
from gradient_problems import everything

import mdnum
from mdnum.errors import InputError
from mdnum.gradients import Problem, method, value_and_grad
from mdnum.gradients.losses import Custom

SIZES = (1, 8, 8)
DEPTHS = {"Ni-Ni": 0.3, "Ni-P": 0.2, "P-P": -0.1}
WEIGHTS = tuple(f"potential.layers.{k}.{word}" for k in (0, 1) for word in ("bias", "weight"))


def network(r, layers, depth):
    """Two layers, the outputs of the second added up."""
    h = r[..., None] / 3
    for layer in layers:
        h = jnp.tanh(h @ layer["weight"] + layer["bias"])
    return depth * jnp.sum(h, -1)


def weights() -> list[dict[str, np.ndarray]]:
    rng = np.random.default_rng(0)
    return [
        {"weight": rng.normal(size=(one, two)) / one**0.5, "bias": rng.normal(size=two)}
        for one, two in pairwise(SIZES)
    ]


def simulation(symbols: str, cut: mdnum.Cut, depth=DEPTHS, **options) -> mdnum.Simulation:
    """Atoms near the points of a cubic lattice, some of them missing."""
    rng = np.random.default_rng(1)
    points = rng.permutation(np.indices((4, 4, 4)).reshape(3, -1).T)
    atoms = Atoms(symbols, cell=[6.5] * 3, pbc=True)
    atoms.positions = points[: len(atoms)] * 1.5 + rng.normal(size=(len(atoms), 3)) * 0.1
    potential = mdnum.PairFunction(network, layers=weights(), depth=depth)
    settings = {"units": "lj", "timestep": 0.01, "temperature": 1.0, "skin": 0.3, **options}
    return mdnum.simulation(atoms, potential, cut, **settings)


@pytest.fixture(scope="module")
def mixture() -> Problem:
    made = simulation("Ni12P8", mdnum.Cut("switched", 2.4))
    return Problem(made, everything(made.atoms), 40)


@pytest.fixture(scope="module")
def by_hand(mixture):
    return method("symmetric")(mixture, ("potential",)).gradient


def test_one_path_stands_for_all_parameters_below_it(mixture, by_hand):
    assert set(by_hand) == {*WEIGHTS, "potential.depth"}
    shapes = {name: value.shape for name, value in by_hand.items()}
    assert shapes["potential.layers.1.weight"] == (8, 8) and shapes["potential.depth"] == (3,)
    assert all(np.all(value != 0) for value in by_hand.values())


@pytest.mark.parametrize("other", [pytest.param("unrolled", marks=pytest.mark.nightly), "forward"])
def test_other_ways_through_the_steps_give_the_same(mixture, by_hand, other):
    """Of tangents one layer: each weight takes one."""
    names = ("potential",) if other == "unrolled" else (*WEIGHTS[:2], "potential.depth")
    found = method(other)(mixture, names).gradient
    for name, value in found.items():
        np.testing.assert_allclose(value, by_hand[name], rtol=1e-9, atol=1e-11 * np.abs(by_hand[name]).max())


def test_single_weights_have_the_derivatives_of_differences(mixture, by_hand):
    names = (
        "potential.layers.0.weight.0.3", "potential.layers.0.bias.7", "potential.layers.1.weight.5.2",
        "potential.layers.1.bias.0", "potential.pairs.Ni-P.depth", "potential.depth.2",
    )  # fmt: skip
    differences = method("finite-differences")(mixture, names).gradient
    ours = method("symmetric")(mixture, names).gradient
    whole = {
        names[0]: by_hand["potential.layers.0.weight"][0, 3], names[1]: by_hand["potential.layers.0.bias"][7],
        names[2]: by_hand["potential.layers.1.weight"][5, 2], names[3]: by_hand["potential.layers.1.bias"][0],
        names[4]: by_hand["potential.depth"][1], names[5]: by_hand["potential.depth"][2],
    }  # fmt: skip
    for name, value in differences.items():
        assert ours[name] == whole[name]
        assert float(value) == pytest.approx(float(whole[name]), rel=1e-6), name


def test_all_weights_at_once_have_the_derivatives_of_differences_in_random_directions(mixture, by_hand):
    rng, h = np.random.default_rng(5), 1e-5
    for _ in range(2):
        along = {name: rng.normal(size=value.shape) for name, value in by_hand.items()}
        at = {name: mdnum.gradients.parameters.value(mixture.simulation, name) for name in along}
        ends = [mixture.value({name: at[name] + sign * h * along[name] for name in at}) for sign in (1, -1)]
        ours = sum(np.sum(by_hand[name] * along[name]) for name in at)
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(ours, rel=1e-6)


@pytest.mark.nightly
def test_pairs_of_one_type_in_single_precision(mixture):
    """Where all pairs are of one type the weights are still shared, and a bias of one number is no scalar."""
    policies = mdnum.PrecisionPolicy("float64", "float32", "float64", "float64"), mdnum.PrecisionPolicy()
    made = [simulation("Ni20", mdnum.Cut("shifted", 2.4), 0.3, precision=one) for one in policies]
    short, wide = (method("symmetric")(Problem(one, everything(20), 10), WEIGHTS).gradient for one in made)
    for name in WEIGHTS:
        np.testing.assert_allclose(short[name], wide[name], rtol=2e-3, atol=2e-3 * np.abs(wide[name]).max())


# --- two bodies ----------------------------------------------------------------------------------------

R0, RADIUS, SPEED = 1.2, 2.0, 1.0


def energy(r, layers) -> complex:
    """The network in numpy, of complex weights too."""
    h = np.array([r / 3])
    for layer in layers:
        h = np.tanh(h @ layer["weight"] + layer["bias"])
    return 0.3 * h.sum()


def left_at(layers) -> complex:
    """The speed behind the cutoff by conservation of energy, with a reduced mass of 1."""
    return np.sqrt(SPEED**2 + 2 * energy(R0, layers) - 2 * energy(RADIUS, layers))


def exact(k: int, word: str) -> np.ndarray:
    """Derivatives of that speed by imaginary steps, which have no truncation."""
    out = np.zeros(weights()[k][word].shape)
    for index in np.ndindex(out.shape):
        layers = [{key: value.astype(complex) for key, value in layer.items()} for layer in weights()]
        layers[k][word][index] += 1e-30j
        out[index] = left_at(layers).imag / 1e-30
    return out


def test_two_atoms_that_part_have_the_derivatives_of_the_closed_form():
    """The share of the energy at the cutoff comes from the time at which they pass it, and nothing else."""
    atoms = Atoms("Ni2", positions=[[0, 0, 0], [R0, 0, 0]], masses=[2, 2])
    atoms.set_velocities([[-SPEED / 2, 0, 0], [SPEED / 2, 0, 0]])
    potential = mdnum.PairFunction(network, layers=weights(), depth=0.3)
    made = mdnum.simulation(atoms, potential, mdnum.Cut("hard", RADIUS), units="lj", timestep=0.001, skin=0.3)
    last = 1200
    loss = Custom(see=lambda frame, *_: frame.v[0, 1] - frame.v[0, 0], first=last)
    problem = Problem(made, loss, last)
    value, gradient = value_and_grad(problem, ("potential.layers",), "event-aware")()
    assert float(value) == pytest.approx(left_at(weights()), abs=1e-4)
    for k in (0, 1):
        for word in ("bias", "weight"):
            true = exact(k, word)
            got = gradient[f"potential.layers.{k}.{word}"]
            # the kick in which the pair leaves is a whole one or none: an error of a share of a step
            np.testing.assert_allclose(got, true, atol=1e-3 * np.abs(true).max())
    plain = method("symmetric")(problem, ("potential.layers.1.bias",)).gradient["potential.layers.1.bias"]
    assert np.abs(plain - exact(1, "bias")).max() > 0.04 * np.abs(exact(1, "bias")).max()


# --- what is given and what is not -----------------------------------------------------------------------


def test_weights_are_told_from_numbers_by_pair_type_by_how_they_are_given():
    """Three weights of three pair types are still weights."""
    given = {"three": np.ones(3), "one": {"Ni-Ni": 1.0, "Ni-P": 2.0, "P-P": 3.0}, "deep": {"a": 2.0}}
    own = mdnum.PairFunction(lambda r, three, one, deep: one * deep["a"] * jnp.sum(three) / r, **given)
    atoms = simulation("Ni12P8", mdnum.Cut("shifted", 2.0)).structure
    made = mdnum.simulation(atoms, own, mdnum.Cut("shifted", 2.0), units="lj", timestep=0.01, skin=0.3)
    found = mdnum.parameters(made)
    assert found["potential.three"].by == "" and found["potential.one"].by == "pair type"
    assert found["potential.deep.a"].value.shape == ()
    again = mdnum.changed(made, {"potential.three.1": 4.0, "potential.pairs.Ni-P.one": 5.0})
    np.testing.assert_array_equal(again.potential.shared["three"], [1.0, 4.0, 1.0])
    np.testing.assert_array_equal(again.potential.leaves["one"], [1.0, 5.0, 3.0])
    assert made.evaluate().energy * 2 != pytest.approx(again.evaluate().energy, rel=1e-3)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"layers": [{"weight": "w.npy"}]}, r"potential\.layers\.0\.weight: 'w\.npy'; expected finite num"),
        ({"layers": [np.array([1.0, np.nan])]}, r"potential\.layers\.0: .*expected finite"),
        ({"layers": [jnp.tanh]}, r"potential\.layers\.0: .*expected finite"),
    ],
)
def test_what_is_no_number_is_refused(given, message):
    own = mdnum.PairFunction(lambda r, layers: r, **given)
    with pytest.raises(InputError, match=message):
        mdnum.simulation(
            Atoms("Ar2", positions=[[0, 0, 0], [2, 0, 0]]), own, mdnum.Cut("hard", 3.0), timestep=0.01
        )


def test_a_word_for_several_weights_is_refused(mixture):
    several = r"'weight' is ambiguous.*layers\.0\.weight, .*layers\.1\.weight"
    with pytest.raises(InputError, match=several):
        value_and_grad(mixture, ("weight",))
